"""Light bodies between heavy ones: accelerations, derivatives and steps keep their accuracy."""

import decimal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import manifold, planar, spatial
from jaxmb.formulations import Multipliers, accelerations

pytestmark = pytest.mark.slow


def planar_chain(n, closed=False):
    """Rods in a zigzag, which hang on a pin, or between two."""
    turns = [0.6 if i % 2 else -0.6 for i in range(n)]
    ends = np.concatenate([np.zeros((1, 2)), np.cumsum([(np.cos(a), np.sin(a)) for a in turns], axis=0)])
    rods = [
        planar.Body(f"rod{i}", mass=1.0, inertia=1 / 12, position=(ends[i] + ends[i + 1]) / 2, angle=turns[i])
        for i in range(n)
    ]
    pins = [planar.Revolute(f"pin{i}", f"rod{i - 1}" if i else "ground", f"rod{i}", point=ends[i]) for i in range(n)]
    if closed:
        pins.append(planar.Revolute("end", f"rod{n - 1}", "ground", point=ends[n]))
    return mb.Scene(rods, joints=pins, forces=[mb.Gravity((0.0, -9.81))])


def spatial_chain(n):
    """Rods on ball joints and pins in turns."""
    rods, joints = [], []
    for i in range(n):
        before, rod, point = f"rod{i - 1}" if i else "ground", f"rod{i}", (float(i), 0.0, 0.0)
        rods.append(spatial.Body(rod, mass=1.0, inertia=(0.1, 0.09, 0.08), position=(i + 0.5, 0.0, 0.0)))
        if i % 2:
            joints.append(spatial.Revolute(f"joint{i}", before, rod, point=point, axis=(0.0, 0.0, 1.0)))
        else:
            joints.append(spatial.Spherical(f"joint{i}", before, rod, point=point))
    return mb.Scene(rods, joints=joints, forces=[mb.Gravity((0.0, -9.81, 0.0))])


SCENES = {
    "planar chain": planar_chain,
    "planar loop": lambda n: planar_chain(n, closed=True),
    "spatial chain": spatial_chain,
}


def alternating(system, ratio):
    """The same chain with every other body so many times as heavy."""
    values = mb.parameters(system)
    names = [f"{name}.{field}" for name in system.body_names[1::2] for field in ("mass", "inertia")]
    return mb.with_parameters(system, {name: ratio * values[name] for name in names})


def moving(system):
    """A state away from symmetry."""
    rng = np.random.default_rng(5)
    guess = mb.assemble(system)
    q, u = (x + size * rng.normal(size=x.shape) for x, size in ((guess.q, 0.05), (guess.u, 1.0)))
    return mb.assemble(system, mb.State(q, u))


def exact(system, state):
    """Accelerations by Gaussian elimination of all equations at once, with 50 digits."""
    q, u, n = state.q, state.u, system.nu
    M, A = system.inertia(0.0, q, u).product(jnp.eye(n)), system.jacobian(0.0, q, u)
    force, gamma = system.force(0.0, q, u), -system.acceleration_residual(0.0, q, u, jnp.zeros(n))
    rows = np.block([[M, -A.T, force[:, None]], [A, np.zeros((len(A), len(A))), gamma[:, None]]]).astype(float)
    with decimal.localcontext(decimal.Context(prec=50)):
        rows = np.vectorize(decimal.Decimal, otypes=[object])(rows)
        for k in range(len(rows)):
            pivot = k + np.argmax(np.abs(rows[k:, k]))
            rows[[k, pivot]] = rows[[pivot, k]]
            rows[k, k:] = rows[k, k:] / rows[k, k]
            rows[k + 1 :, k:] = rows[k + 1 :, k:] - rows[k + 1 :, k, None] * rows[k, k:]
        for k in reversed(range(len(rows))):
            rows[:k, -1] = rows[:k, -1] - rows[:k, k] * rows[k, -1]
        return rows[:n, -1].astype(float)


@pytest.mark.parametrize(
    "name, n", [("planar chain", 16), ("planar loop", 5), ("planar loop", 17), ("spatial chain", 5)]
)
def test_accelerations(name, n):
    system = SCENES[name](n).compile()
    assert (system.elimination is not None) == (n > 10)
    state = moving(system)
    solve = jax.jit(lambda system: accelerations(system, Multipliers(), 0.0, state.q, state.u)[0])
    for ratio in (1e-8, 1.0, 1e8):
        own = alternating(system, ratio)
        expected = exact(own, state)
        np.testing.assert_allclose(solve(own), expected, rtol=0, atol=1e-12 * np.max(np.abs(expected)))


def test_steps_are_those_of_partitioning():
    """Sparse elimination takes as many steps as partitioning with the same accelerations, but for some at the start,
    where the factor is that of a state before the step. The motion has its derivatives.
    """
    system = alternating(planar_chain(16).compile(), 1e8)
    state = mb.assemble(system, rates={f"rod{i}.angle": 1.0 for i in range(16)})
    options = {"t1": 0.2, "max_steps": 1000}
    for rtol in (1e-6, 1e-10):
        run = lambda policy, rtol=rtol, **own: mb.simulate(system, state, rtol=rtol, manifold=policy, **options, **own)
        projected, partitioned = run(manifold.Projection()), run(manifold.Partition(), formulation=Multipliers())
        assert projected.stats["num_steps"] <= 1.05 * partitioned.stats["num_steps"] + 8
        np.testing.assert_allclose(projected.ys.q[-1], partitioned.ys.q[-1], rtol=0, atol=100 * rtol)

    def end(factor, rtol=1e-10):
        changed = mb.with_parameters(system, {"rod3.mass": 1e8 * factor, "rod4.mass": factor})
        motion = mb.simulate(changed, state, rtol=rtol, manifold=manifold.Projection(), **options)
        return motion["rod15"].position[-1, 1]

    one, h, tight = jnp.ones(()), 1e-3, jax.jit(lambda x: end(x, 1e-12))
    forward, reverse = jax.jit(jax.jacfwd(end))(one), jax.jit(jax.grad(end))(one)
    np.testing.assert_allclose(forward, reverse, rtol=1e-6)
    np.testing.assert_allclose(reverse, (tight(one + h) - tight(one - h)) / (2 * h), rtol=1e-5)
