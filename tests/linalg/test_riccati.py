"""The algebraic Riccati equation against SciPy, its derivatives, and equations without a stabilising solution."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from jaxmb.linalg.riccati import is_stabilising, lyapunov, riccati

MOST_PROGRAMS = 60

solved, stabilises = jax.jit(riccati), jax.jit(is_stabilising)


def equation(states, inputs, spread=1.0, seed=0):
    """A random equation whose states have units that differ by the factor `spread` in both directions."""
    rng = np.random.default_rng(seed)
    size = spread ** rng.uniform(-1.0, 1.0, states)
    A = rng.normal(size=(states, states)) * size[:, None] / size
    B = rng.normal(size=(states, inputs)) * size[:, None]
    return A, B, np.diag(rng.uniform(0.1, 1.0, states) / size**2), size


@pytest.mark.parametrize(("states", "inputs", "spread"), [(4, 1, 1.0), (8, 2, 1e3), (12, 3, 1e5)])
def test_riccati_is_scipys(states, inputs, spread):
    A, B, Q, size = equation(states, inputs, spread)
    X = solved(A, B @ B.T, Q)
    direct = scipy.linalg.solve_continuous_are(A, B, Q, np.eye(inputs))
    units = np.outer(size, size)
    np.testing.assert_allclose(X * units, direct * units, rtol=1e-10, atol=1e-10 * np.max(np.abs(direct * units)))
    assert stabilises(A, B @ B.T, Q, X)


def test_lyapunov_is_scipys():
    A, _, Q, _ = equation(5, 1)
    np.testing.assert_allclose(lyapunov(A, Q), scipy.linalg.solve_continuous_lyapunov(A.T, -Q), rtol=1e-10)


def test_riccati_has_derivatives_of_any_order():
    A, B, Q, _ = equation(3, 1, seed=1)

    def cost(x):
        return riccati(jnp.asarray(A).at[0, 1].add(x), (1.0 + x) * B @ B.T, Q * (1.0 - x))[0, 2]

    value, slope, bend = (jax.jit(f) for f in (cost, jax.grad(cost), jax.jacfwd(jax.grad(cost))))
    h = 1e-4
    np.testing.assert_allclose(jax.jit(jax.jacfwd(cost))(0.0), slope(0.0), rtol=1e-11)
    np.testing.assert_allclose(slope(0.0), (value(h) - value(-h)) / (2 * h), rtol=1e-6)
    np.testing.assert_allclose(bend(0.0), (slope(h) - slope(-h)) / (2 * h), rtol=1e-6)


def test_riccati_of_a_batch_loses_no_member_to_another():
    A = np.stack([np.diag([1.0, -1.0]), np.array([[0.0, 1.0], [2.0, 0.0]])])
    G, Q = np.diag([0.0, 1.0]), np.eye(2)
    X = jax.jit(jax.vmap(riccati, (0, None, None)))(A, G, Q)
    direct = scipy.linalg.solve_continuous_are(A[1], np.array([[0.0], [1.0]]), Q, np.eye(1))
    np.testing.assert_allclose(X[1], direct, rtol=1e-10)
    assert not stabilises(A[0], G, Q, X[0]) and stabilises(A[1], G, Q, X[1])


@pytest.mark.parametrize("free", [1.0, 0.0])
def test_riccati_without_a_solution_is_not_stabilising(free):
    """A mode that no input reaches, unstable and at rest; and a displacement without cost."""
    G, Q = np.diag([0.0, 1.0, 1.0]), np.eye(3)
    A = np.diag([free, -1.0, 0.5])
    assert not stabilises(A, G, Q, solved(A, G, Q))
    A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    Q = np.diag([0.0, 1.0, 1.0])
    assert not stabilises(A, G, Q, solved(A, G, Q))
