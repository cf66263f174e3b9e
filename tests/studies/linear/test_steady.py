"""Steady motions and their stability: cones, discs, wheels."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import lagrangian, planar, spatial

G = 9.81


@functools.cache
def conical():
    """A ball of 1 kg on a string of 2 m."""
    ball = spatial.PointMass("ball", mass=1.0, position=(1.0, 0.0, -np.sqrt(3.0)), velocity=(0.0, 2.0, 0.0))
    string = spatial.Distance("string", "ground", "ball", point_a=(0.0, 0.0, 0.0), length=2.0)
    return mb.Scene([ball], joints=[string], forces=[mb.Gravity((0.0, 0.0, -G))]).compile()


@pytest.mark.slow
def test_a_conical_pendulum_runs_in_its_circle_and_nutates():
    system, angle = conical(), 0.6
    state = mb.steady_motion(system, fix={"ball.z": -2.0 * np.cos(angle)})
    rate = np.sqrt(G / (2.0 * np.cos(angle)))
    assert np.hypot(*state.u[:2]) == pytest.approx(rate * 2.0 * np.sin(angle), rel=1e-10)
    assert abs(state.u[2]) < 1e-10
    linear = mb.linearise(system, state)
    # ω² = Ω² (1 + 3 cos²α); the azimuth and a change of the cone make a double zero.
    found = np.asarray(linear.eigenvalues)
    nutation = rate * np.sqrt(1 + 3 * np.cos(angle) ** 2)
    np.testing.assert_allclose(found[2:].imag, [nutation, -nutation], rtol=1e-9)
    assert np.max(np.abs(found[:2])) < 1e-6 and np.max(np.abs(found[2:].real)) < 1e-9


@pytest.mark.slow
def test_a_motion_that_nothing_prescribes_is_found_near_the_guess():
    radius, height = 2.0 * np.sin(0.6), 2.0 * np.cos(0.6)
    faster = 1.02 * radius * np.sqrt(G / height)
    guess = mb.State(jnp.array([radius, 0.0, -height]), jnp.array([0.0, faster, 0.0]))
    state = mb.steady_motion(conical(), guess)
    x, y, z = state.q
    assert np.hypot(x, y) == pytest.approx(radius, rel=0.1)
    np.testing.assert_allclose(np.hypot(*state.u[:2]), np.hypot(x, y) * np.sqrt(G / -z), rtol=1e-9)
    assert abs(state.u[2]) < 1e-9


@pytest.mark.slow
def test_the_speed_of_a_cone_is_differentiable():
    system = conical()

    def speed(angle):
        state = mb.steady_motion(system, fix={"ball.z": -2.0 * jnp.cos(angle)})
        return jnp.sqrt(state.u[0] ** 2 + state.u[1] ** 2) / (2.0 * jnp.sin(angle))

    exact = lambda a: np.sqrt(G / (2.0 * np.cos(a)))
    slope = 0.5 * exact(0.6) * np.tan(0.6)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(speed))(0.6), slope, rtol=1e-8)
    np.testing.assert_allclose(jax.jit(jax.grad(speed))(0.6), slope, rtol=1e-8)
    angles = np.array([0.5, 0.6])
    np.testing.assert_allclose(jax.jit(jax.vmap(speed))(angles), exact(angles), rtol=1e-9)


def disc(speed):
    """A disc of 1 kg and 0.3 m that rolls upright along x."""
    body = spatial.Body("disc", mass=1.0, inertia=spatial.disc(1.0, 0.3, "y"), position=(0.0, 0.0, 0.3))
    plane = spatial.RollingDisc("plane", "disc", radius=0.3, axis=(0.0, 1.0, 0.0))
    system = mb.Scene([body], joints=[plane], forces=[mb.Gravity((0.0, 0.0, -G))]).compile()
    return system, mb.assemble(system, rates={"disc.wy": speed / 0.3, "disc.wx": 0.0, "disc.wz": 0.0})


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.8, 1.2])
def test_a_rolling_disc_falls_below_its_critical_speed(speed):
    """λ² (A + m r²) = m g r − C (C + m r²) ω² / A, which changes its sign at v² = g r / 3 (Routh)."""
    r, A, C, mr2 = 0.3, 0.0225, 0.045, 0.09
    linear = mb.linearise(*disc(speed))
    square = (G * r - C * (C + mr2) * (speed / r) ** 2 / A) / (A + mr2)
    found = np.asarray(linear.eigenvalues)[-2:]
    np.testing.assert_allclose(found**2, square, rtol=1e-9)
    assert (speed**2 < G * r / 3) == (np.max(found.real) > 1e-6)


@pytest.mark.slow
def test_ignorable_coordinates_of_a_lagrangian():
    """A bead on a turning hoop in the coordinates θ and the hoop's angle φ: cos θ = g / (r Ω²)."""
    hoop = lagrangian.LagrangianSystem(
        kinetic=lambda t, q, v, p: 0.5 * (v[0] ** 2 + (2.0 + jnp.sin(q[0]) ** 2) * v[1] ** 2),
        potential=lambda t, q, p: -G * jnp.cos(q[0]),
        q=(1.0, 0.0),
        u=(0.0, 4.0),
        coordinates=("theta", "phi"),
    )
    state = mb.steady_motion(hoop, rates={"phi": 4.0}, ignorable=["phi"])
    assert float(state.q[0]) == pytest.approx(np.arccos(G / 16.0), rel=1e-10)
    linear = mb.linearise(hoop, state)
    s, c = np.sin(float(state.q[0])), G / 16.0
    J = 2.0 + s**2
    # At constant angular momentum: ω² = Ω² s² (1 + 4 c² / J).
    assert float(np.max(linear.frequencies)) == pytest.approx(4.0 * s * np.sqrt(1 + 4 * c**2 / J), rel=1e-9)
    with pytest.raises(ValueError, match="No steady motion"):
        mb.steady_motion(hoop, rates={"phi": 4.0})


@pytest.mark.slow
def test_what_is_no_steady_motion():
    rod = planar.Body("rod", mass=1.0, inertia=1 / 12, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0))
    system = mb.Scene([rod], joints=[pin], forces=[mb.Gravity((0.0, -G))]).compile()
    with pytest.raises(ValueError, match=r"No steady motion was found with rod.angle prescribed"):
        mb.steady_motion(system, rates={"rod.angle": 3.0})
    with pytest.raises(ValueError, match=r"Unknown coordinate 'rod.angel'"):
        mb.steady_motion(system, fix={"rod.angel": 3.0})
    with pytest.raises(ValueError, match="Unknown coordinate 'x'"):
        mb.steady_motion(system, ignorable=["x"])
    with pytest.raises(ValueError, match="not a steady motion"):
        mb.linearise(system, mb.assemble(system, fix={"rod.angle": -np.pi / 2}, rates={"rod.angle": 3.0}))


@pytest.mark.slow
def test_a_wheel_that_winds_up_a_cord():
    """The count of its turns advances with it, however often it has turned."""
    wheel = spatial.Body("wheel", mass=1.0, inertia=(2.0, 2.0, 2.0))
    hinge = spatial.Revolute("hinge", "ground", "wheel", point=(0.0, 0.0, 0.0), axis=(0.6, 0.0, 0.8))
    cord = mb.FixedTendon("cord", ["hinge.angle"], coefficients=(0.3,))
    system = mb.Scene([wheel], joints=[hinge, cord]).compile()
    state = mb.steady_motion(system, rates={"hinge.angle_rate": 3.0})
    np.testing.assert_allclose(system.rates(0.0, state.q, state.u)[-1], 3.0, rtol=1e-9)
    motion = mb.simulate(system, state, t1=5.0, saveat=[5.0])
    np.testing.assert_allclose(motion["cord"].length[-1], 0.3 * 15.0, rtol=1e-7)
    later = mb.State(motion.ys.q[-1], motion.ys.u[-1])
    np.testing.assert_allclose(mb.linearise(system, later).A, [[0.0, 1.0], [0.0, 0.0]], atol=1e-9)


@pytest.mark.slow
def test_a_motion_against_a_contact_is_not_steady():
    bar = planar.Body("bar", mass=1.0, inertia=planar.rod(1.0, 1.0), position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "bar", point_a=(0.0, 0.0), point_b=(-0.5, 0.0))
    stop = mb.Stop("stop", "pin.angle", lower=-0.6, upper=0.6)
    system = mb.Scene([bar], joints=[pin, stop], forces=[mb.Gravity((0.0, -G))]).compile()
    above = mb.assemble(system, fix={"pin.angle": -0.5})
    with pytest.raises(ValueError, match=r"stop is open and overlapped: .*fix=\{'stop.mode': 1\}"):
        mb.steady_motion(system, above)
    held = mb.steady_motion(system, mb.assemble(system, above, fix={"stop.mode": 1}))
    assert held.q[2] == pytest.approx(-0.6)
    closed = mb.assemble(system, above, fix={"stop.mode": 1})
    upwards = mb.with_parameters(system, {"gravity.acceleration": (0.0, G)})
    with pytest.raises(ValueError, match=r"stop would have to pull: .*fix=\{'stop.mode': 0\}"):
        mb.steady_motion(upwards, closed)
    found = jax.jit(lambda down: mb.steady_motion(mb.with_parameters(system, {"gravity.acceleration": down}), closed).q)
    assert np.all(np.isfinite(found(jnp.array([0.0, -G])))) and np.all(np.isnan(found(jnp.array([0.0, G]))))


def test_friction_that_may_stick_has_no_steady_motion():
    block = planar.Body("block", mass=1.0, inertia=0.1)
    slide = planar.Prismatic("slide", "ground", "block", point=(0.0, 0.0), axis=(1.0, 0.0))
    belt = mb.DryFriction("belt", "slide", coefficient=0.3, speed=1.0)
    system = mb.Scene([block], joints=[slide], forces=[belt, mb.Gravity((0.0, -G))]).compile()
    with pytest.raises(ValueError, match="belt may stick or slip"):
        mb.steady_motion(system)
