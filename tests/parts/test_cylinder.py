"""Cylinders: a boom on a pin, lifted by pressures or by a prescribed length, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import jaxmb as mb
from jaxmb import planar, spatial

G, MASS, INERTIA = 9.81, 40.0, 6.0
# The pin is at the origin. Along the boom lie its centre and point B; A is fixed in the ground.
CENTRE, REACH, A = 0.9, 0.6, np.array([0.2, -0.5])
BORE, ANNULUS = 2e-3, 1.2e-3
ANGLE = 0.3
SPACES = pytest.mark.parametrize("space", [planar, spatial])


def of(space, vector):
    return tuple(vector) if space is planar else (*vector, 0.0)


def lift(space, **options):
    place = {"point_a": of(space, A), "point_b": of(space, (REACH - CENTRE, 0.0))}
    return space.Cylinder("lift", "ground", "boom", **place, **({"bore_area": BORE} | options))


def boom(space, cylinder, *, joints=(), forces=(), gravity=G):
    position = of(space, (CENTRE * np.cos(ANGLE), CENTRE * np.sin(ANGLE)))
    if space is planar:
        body = planar.Body("boom", mass=MASS, inertia=INERTIA, position=position, angle=ANGLE)
        pin = planar.Revolute("pin", "ground", "boom", point=(0.0, 0.0))
    else:
        turned = mb.rotations.from_axis_angle((0.0, 0.0, 1.0), ANGLE)
        inertia = (0.5, INERTIA, INERTIA)
        body = spatial.Body("boom", mass=MASS, inertia=inertia, position=position, orientation=turned)
        pin = spatial.Revolute("pin", "ground", "boom", point=of(space, (0.0, 0.0)), axis=(0.0, 0.0, 1.0))
    weight = mb.Gravity(of(space, (0.0, -gravity)))
    return mb.Scene([body], joints=[pin, cylinder, *joints], forces=[weight, *forces]).compile()


def length(angle):
    """The distance between A and B."""
    b = REACH * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    return jnp.linalg.norm(b - A)


def angle_of(length):
    """The boom's angle, by the law of cosines."""
    to_a = np.hypot(*A)
    return jnp.arccos((to_a**2 + REACH**2 - length**2) / (2 * to_a * REACH)) + np.arctan2(A[1], A[0])


def needed_force(lengths, t):
    """From the moment about the pin, for a length that is a function of time."""
    angle = lambda t: angle_of(lengths(t))
    acceleration = jax.grad(jax.grad(angle))(t)
    about_pin = INERTIA + MASS * CENTRE**2
    moment = about_pin * acceleration + MASS * G * CENTRE * jnp.cos(angle(t))
    return moment / jax.grad(length)(angle(t))


@SPACES
def test_the_forces_at_the_points(space):
    pressures = {"pressure": 5e5, "rod_area": ANNULUS, "rod_pressure": 2e5}
    system = boom(space, lift(space, **pressures), gravity=0.0)
    wrench = system.force(0.0, system.guess.q, system.guess.u)
    size = 5e5 * BORE - 2e5 * ANNULUS
    along = np.array([np.cos(ANGLE), np.sin(ANGLE)])
    force = size * (REACH * along - A) / float(length(ANGLE))
    moment = (REACH - CENTRE) * (along[0] * force[1] - along[1] * force[0])
    expected = [*force, moment] if space is planar else [*force, 0.0, 0.0, 0.0, moment]
    np.testing.assert_allclose(wrench, expected, rtol=1e-12, atol=1e-10)
    assert lift(space, **pressures).filled(rod_pressure=0.0).force == pytest.approx(size)


def stroke(t):
    return mb.smooth_step(t, length(ANGLE), 1.02, 0.5)


@pytest.mark.slow
def test_the_pressure_for_a_prescribed_length_moves_the_boom_likewise():
    """By the closed form, and by a motion under that pressure as an input."""
    rod = {"rod_area": ANNULUS, "rod_pressure": 1e5}
    own = lift(spatial, **rod)
    ts = np.linspace(0.0, 0.5, 6)
    driven = boom(spatial, own, joints=[mb.JointDriver("move", "lift.length")])
    driven = mb.with_inputs(driven, {"move.value": stroke})
    motion = mb.simulate(driven, mb.assemble(driven), t1=ts[-1], saveat=ts, rtol=1e-10)
    np.testing.assert_allclose(motion["lift"].length, jax.vmap(stroke)(ts), rtol=0, atol=1e-12)
    pressure = own.needed_pressure(motion.reactions["move"].multipliers[:, 0])
    closed = jax.vmap(lambda t: (needed_force(stroke, t) + 1e5 * ANNULUS) / BORE)
    np.testing.assert_allclose(pressure, closed(ts), rtol=1e-9)

    pushed = mb.with_inputs(boom(spatial, own), {"lift.pressure": lambda t: closed(t[None])[0]})
    free = mb.simulate(pushed, mb.assemble(pushed), t1=ts[-1], saveat=ts, rtol=1e-10)
    np.testing.assert_allclose(free["lift"].length, motion["lift"].length, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_a_stop_ends_the_stroke():
    """The spring of the stop bears the force of the cylinder."""
    k, width = 1e5, 1e-2
    stop = mb.JointStop("end", "lift.length", lower=0.7, upper=1.0, stiffness=k, smoothing=width)
    system = boom(planar, lift(planar, pressure=1e6), forces=[stop], gravity=0.0)
    rest = mb.equilibrium(system)
    found = length(rest.q[2])

    def unbalanced(beyond):
        root = np.hypot(beyond, width)
        return k * (0.5 * (beyond + root)) ** 2 / root - 1e6 * BORE

    np.testing.assert_allclose(found, 1.0 + brentq(unbalanced, 0.0, 0.1, xtol=1e-12), rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"bore_area": 0.0}, "bore_area must be positive"),
        ({"rod_area": -1e-3}, "rod_area must be positive"),
        ({"rod_area": 3e-3}, "rod_area is the annulus around the rod, at most bore_area 0.002, got 0.003"),
        ({"rod_pressure": 1e5}, "a rod_pressure needs the area on which it acts; give rod_area"),
        ({"pressure": np.ones(2)}, r"pressure must have shape \(\), got \(2,\)"),
        ({"pressure": np.nan}, "pressure must be finite"),
    ],
)
def test_numbers_that_are_refused(options, message):
    with pytest.raises(ValueError, match=f"Cylinder 'lift': {message}"):
        boom(planar, lift(planar, **options))


def test_scenes_that_are_refused():
    with pytest.raises(ValueError, match="its points coincide at the given poses; move one"):
        boom(planar, planar.Cylinder("lift", "ground", "boom", bore_area=BORE, point_b=(-CENTRE, 0.0)))
    with pytest.raises(ValueError, match="Cylinder 'lift'; it belongs in joints="):
        mb.Scene([planar.Body("boom", mass=1.0, inertia=1.0)], forces=[lift(planar)])
    with pytest.raises(ValueError, match="lower must be less than upper"):
        stop = mb.JointStop("end", "lift.length", lower=1.0, upper=0.7, stiffness=1e5)
        boom(planar, lift(planar), forces=[stop])
    ball = planar.PointMass("boom", mass=1.0, position=(1.0, 0.0))
    with pytest.raises(ValueError, match="acts on the rotation of a PointMass"):
        mb.Scene([ball], joints=[lift(planar)]).compile()
