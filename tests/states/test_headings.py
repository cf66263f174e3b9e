"""Discs that lie flat, or come to lie flat: poses and motions that are refused with the disc's name."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import jaxmb as mb
from jaxmb import spatial

MASS, RADIUS, DIAMETRAL, G = 1.0, 0.1, 0.0025, 9.81
GRAVITY = mb.Gravity((0.0, 0.0, -G))
turned = mb.rotations.from_axis_angle


def disc(name="coin", tilt=1.0, *, about=(1.0, 0.0, 0.0), height=None, place=0.0, **start):
    """A disc whose axle z is tilted from the vertical; upright at a quarter turn."""
    height = RADIUS * abs(np.sin(tilt)) if height is None else height
    pose = {"position": (place, 0.0, height), "orientation": turned(about, tilt)}
    return spatial.Body(name, mass=MASS, inertia=(DIAMETRAL, DIAMETRAL, 2 * DIAMETRAL), **pose, **start)


def scene(*bodies, **options):
    rolling = [spatial.RollingDisc(f"rolling {body.name}", body.name, radius=RADIUS, **options) for body in bodies]
    return mb.Scene(bodies, joints=rolling, forces=[GRAVITY])


def falls(tilt):
    """The time after which a disc that is released at a tilt lies flat: it turns about its tangent on the ground."""
    inertia = DIAMETRAL + MASS * RADIUS**2
    # With tilt − x² as the angle, so that the integrand stays finite.
    rate = lambda x: np.sqrt(2 * MASS * G * RADIUS * (np.sin(tilt) - np.sin(tilt - x * x)) / inertia)
    return quad(lambda x: 2 * x / rate(x), 0.0, np.sqrt(tilt))[0]


def test_disc_that_lies_flat_is_refused():
    """On level ground, with any side up, at any height; and beside a disc that stands."""
    for tilt in (0.0, 1e-9, np.pi):
        flat = scene(disc(tilt=tilt, height=0.1), disc("upright", np.pi / 2, place=1.0))
        message = "the disc 'rolling coin' lies flat on its plane, and has no contact point"
        with pytest.raises(ValueError, match=message):
            flat.compile()


def test_disc_flat_on_a_slope_is_refused():
    slope = {"normal": (0.0, np.sin(0.4), np.cos(0.4)), "axis": (0.0, 0.0, 1.0)}
    with pytest.raises(ValueError, match="'rolling coin' lies flat"):
        scene(disc(tilt=-0.4), **slope).compile()
    # Level, it does not lie flat on the slope.
    assert scene(disc(tilt=0.0, height=0.05), **slope).compile().velocity_rank == 3


def test_wheels_and_blades_that_lie_flat_are_refused():
    flat = {"orientation": turned((1.0, 0.0, 0.0), np.pi / 2), "position": (0.0, 0.0, 0.1)}
    wheel = spatial.Body("wheel", mass=1.0, inertia=(0.1, 0.2, 0.1), **flat)
    grip = {"coefficient": 0.9, "slip_stiffness": 15.0, "relaxation_length": 0.2}
    ground = {"terrain": mb.terrain.Flat(), "normal": mb.contact.Linear(2e5)}
    tyre = spatial.Tyre("tyre", "wheel", radius=0.3, **ground, **grip)
    with pytest.raises(ValueError, match="Tyre 'tyre': the wheel lies flat at the given pose; tilt it"):
        mb.Scene([wheel], forces=[tyre]).compile()
    # A blade along the normal binds nothing.
    blade = spatial.KnifeEdge("blade", "wheel", axis=(0.0, 1.0, 0.0))
    with pytest.raises(ValueError, match="KnifeEdge 'blade': the blade stands along the normal of its plane"):
        mb.Scene([wheel], joints=[blade]).compile()


def test_disc_is_checked_within_a_trace_too():
    """A scene of numbers that is assembled while JAX traces something else."""
    system = scene(disc(tilt=1.2)).compile()
    height = jax.jit(lambda x: x * mb.assemble(system).q[2])(1.0)
    np.testing.assert_allclose(height, RADIUS * np.sin(1.2), rtol=1e-9)


@pytest.mark.slow
def test_disc_that_is_assembled_flat_is_refused():
    system = scene(disc(tilt=1.2)).compile()
    with pytest.raises(ValueError, match="At the assembled pose the disc 'rolling coin' lies flat"):
        mb.assemble(system, fix={"coin.orientation": (1.0, 0.0, 0.0, 0.0)})
    state = mb.assemble(system, fix={"coin.orientation": turned((1.0, 0.0, 0.0), 0.2)})
    np.testing.assert_allclose(state.q[2], RADIUS * np.sin(0.2), rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["auto", mb.solvers.Hermite(), diffrax.Tsit5()], ids=["Adams", "Hermite", "Tsit5"])
def test_disc_that_falls_flat_ends_its_motion(solver):
    """At the time of the closed form, with the disc's name, beside a disc that stands."""
    tilt = 1.1
    system = scene(disc(tilt=tilt), disc("upright", np.pi / 2, place=1.0)).compile()
    state, expected = mb.assemble(system), falls(tilt)
    with pytest.raises(
        RuntimeError, match=r"came to t = 0\.22.* of 1\. There the disc 'rolling coin' lies flat on its plane"
    ):
        mb.simulate(system, state, t1=1.0, solver=solver, rtol=1e-8)
    motion = mb.simulate(system, state, t1=1.0, solver=solver, rtol=1e-8, throw=False)
    assert motion.result == mb.RESULTS.singular_configuration
    np.testing.assert_allclose(motion.ts[-1], expected, rtol=1e-6)
    # Up to there the motion is whole, and nothing is refused.
    ends = mb.simulate(system, state, t1=0.99 * expected, solver=solver, rtol=1e-8)
    np.testing.assert_allclose(ends.energy[-1], system.potential_energy(0.0, state.q), rtol=1e-6)


@pytest.mark.slow
def test_disc_that_whirls_next_to_the_ground_is_not_stopped():
    """With some spin a falling disc turns round quickly and rises again; in a batch one that falls flat fails alone."""
    system = scene(disc(tilt=1.1)).compile()
    still = mb.assemble(system)
    spinning = mb.assemble(system, mb.State(still.q, jnp.zeros(6).at[5].set(1.0), still.z))
    motion = mb.simulate(system, spinning, t1=0.6, rtol=1e-8, saveat=np.linspace(0.0, 0.6, 61))
    heights = np.asarray(motion["coin"].position[:, 2])
    assert np.min(heights) < 0.03 and heights[-1] > 0.05
    np.testing.assert_allclose(motion.energy, motion.energy[0], rtol=1e-6)
    both = jax.tree.map(lambda *x: jnp.stack(x), still, spinning)

    def run(state):
        end = mb.simulate(system, state, t1=0.6, rtol=1e-8, throw=False)
        return end.result == mb.RESULTS.successful, end.ys.q[-1]

    successful, ends = jax.jit(jax.vmap(run))(both)
    assert successful.tolist() == [False, True]
    np.testing.assert_allclose(ends[1], motion.ys.q[-1], rtol=0, atol=1e-6)
