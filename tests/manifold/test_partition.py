"""Charts near positions where constraints lose rank: linkages that lie flat go on as their momentum tells."""

import flat_linkages
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folding():
    """A slider-crank with a rod as long as its crank, which folds where the crank stands upright, beside a skate: with
    its row of velocities, coordinates have a stored factor.
    """
    bars = [
        planar.Body("crank", mass=1.0, inertia=0.02, position=(0.2, 0.0)),
        planar.Body("rod", mass=1.0, inertia=0.02, position=(0.6, 0.0)),
        planar.Body("skate", mass=1.0, inertia=0.02, position=(0.0, -1.0)),
    ]
    joints = [
        planar.Revolute("pin", "ground", "crank", point=(0.0, 0.0)),
        planar.Revolute("elbow", "crank", "rod", point=(0.4, 0.0)),
        planar.PointOnLine("slider", "ground", "rod", axis_a=(1.0, 0.0), point_a=(0.0, 0.0), point_b=(0.2, 0.0)),
        planar.KnifeEdge("blade", "skate", axis=(1.0, 0.0)),
    ]
    return mb.Scene(bars, joints=joints).compile()


def test_a_stored_position_factor_serves_no_other_side_of_a_flat_position(folding):
    """Newton's method failed after it, however short the steps were."""

    @jax.jit
    def run(speed, rtol):
        start = mb.State(
            jnp.array([0.2, 0, 0, 0.6, 0, 0, 0, -1, 0]),
            speed * jnp.array([0, 0.2, 1, 0, 0.2, -1, 0, 0, 0.3]),
        )
        motion = mb.simulate(
            folding, start, t1=5.0, rtol=rtol, saveat=jnp.linspace(0, 5, 11), max_steps=2000, throw=False
        )
        return motion["crank"].angle, motion["rod"].angle, motion.energy

    for speed in (3.0, -5.0):
        for rtol in (1e-6, 1e-9):
            crank, rod, energy = run(speed, rtol)
            np.testing.assert_allclose(rod + crank, 0.0, atol=100 * rtol)
            np.testing.assert_allclose(energy, energy[0], rtol=100 * rtol)
            assert np.abs(crank[-1]) > 6.0


CASES = [
    ("parallelogram", False),
    ("parallelogram", True),
    ("parallelogram without redundancy", True),
    ("row of parallelograms", False),
    ("scissors", True),
    ("pantograph", False),
]


@pytest.mark.parametrize("name, in_space", CASES)
def test_linkages_go_on_after_flat_positions(name, in_space):
    """From random states: positions are those of Lagrange's equations for the freedoms of the linkage."""
    linkage, rng, times = flat_linkages.LINKAGES[name], np.random.default_rng(7), jnp.linspace(0.0, 2.0, 9)
    system = linkage.system(in_space)

    @jax.jit
    def run(x, rates, rtol):
        start = linkage.state(x, rates, in_space)
        motion = mb.simulate(system, start, t1=2.0, rtol=rtol, saveat=times, max_steps=3000, throw=False)
        centres = linkage.centres(linkage.path(x, rates, times), in_space)
        return motion.result, jnp.max(jnp.stack([jnp.abs(motion[k].position - at) for k, at in centres.items()]))

    # Where two linkages lie flat at once, steps in the plane may creep up to that position at 1e-10.
    finest = 1e-9 if name == "row of parallelograms" else 1e-10
    for rtol in 3 * (1e-4, 1e-6, 1e-8, finest):
        x = np.array(linkage.start) + rng.uniform(-0.3, 0.6, len(linkage.start))
        rates = rng.choice([-1.0, 1.0], x.size) * rng.uniform(1.0, 6.0, x.size)
        result, error = run(x, rates, rtol)
        assert result == mb.RESULTS.successful and error < 300 * rtol + 1e-8, (rtol, result, error)


def test_derivatives_beyond_a_flat_position(folding):
    """Forward, reverse, and central differences of a tighter solution."""

    def end(speed, rtol):
        rates = jnp.array([0, 0.2, 1, 0, 0.2, -1, 0, 0, 0.3])
        start = mb.State(jnp.array([0.2, 0, 0, 0.6, 0, 0, 0, -1, 0]), speed * rates)
        return mb.simulate(folding, start, t1=1.0, rtol=rtol, max_steps=400)["crank"].angle[-1]

    forward = jax.jit(jax.jvp, static_argnums=0)(lambda s: end(s, 1e-9), (3.0,), (1.0,))[1]
    reverse = jax.jit(jax.grad(lambda s: end(s, 1e-9)))(3.0)
    value = jax.jit(lambda s: end(s, 1e-10))
    assert value(3.0) > np.pi / 2 + 0.3
    np.testing.assert_allclose(forward, (value(3.0 + 1e-3) - value(3.0 - 1e-3)) / 2e-3, rtol=1e-5)
    np.testing.assert_allclose(reverse, forward, rtol=1e-8)
