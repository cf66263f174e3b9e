"""Structured positive definite matrices against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.linalg.block_tridiagonal import BlockTridiagonal
from jaxmb.linalg.positive_definite import DensePositiveDefinite


def dense(diagonal, coupling):
    k, r, _ = diagonal.shape
    T = np.zeros((k * r, k * r))
    for i in range(k):
        here, ahead = slice(i * r, i * r + r), slice(i * r + r, i * r + 2 * r)
        T[here, here] = diagonal[i]
        if i + 1 < k:
            T[here, ahead], T[ahead, here] = coupling[i], coupling[i].T
    return T


@pytest.mark.parametrize(("k", "r"), [(1, 2), (7, 1), (6, 2), (5, 3)])
def test_solution_and_its_derivatives(k, r):
    rng = np.random.default_rng(k)
    half = rng.normal(size=(2, k, r, r))
    diagonal = half[0] @ half[0].swapaxes(1, 2) + 6 * r * np.eye(r)
    coupling = half[1] * (np.arange(k) < k - 1)[:, None, None]
    b = rng.normal(size=(k, r))
    change = rng.normal(size=(k, r, r))
    moves = change + change.swapaxes(1, 2), rng.normal(size=(k, r, r)) * (coupling != 0), rng.normal(size=(k, r))
    weights = jnp.asarray(rng.normal(size=(k, r)))
    arguments = tuple(map(jnp.asarray, (diagonal, coupling, b)))
    moves = tuple(map(jnp.asarray, moves))
    solve = lambda diagonal, coupling, b: BlockTridiagonal(diagonal, coupling).eliminate().solve(b)

    @jax.jit
    def evaluate(arguments, moves):
        x, dx = jax.jvp(solve, arguments, moves)
        gradient = jax.grad(lambda a: jnp.vdot(weights, solve(*a)))(arguments)
        factor = BlockTridiagonal(*arguments[:2]).eliminate()
        twice = jax.vmap(lambda b: solve(*arguments[:2], b))(jnp.stack([arguments[2], 2 * arguments[2]]))
        return x, dx, gradient, factor.smallest_pivot(), factor.matrix.product(x), twice

    x, dx, gradient, pivot, back, twice = evaluate(arguments, moves)
    T, dT = dense(diagonal, coupling), dense(*moves[:2])
    expected = np.linalg.solve(T, b.ravel())
    np.testing.assert_allclose(x.ravel(), expected, rtol=0, atol=1e-13)
    np.testing.assert_allclose(back, b, rtol=0, atol=1e-12)
    np.testing.assert_allclose(twice, np.stack([x, 2 * x]), rtol=0, atol=1e-13)
    np.testing.assert_allclose(dx.ravel(), np.linalg.solve(T, moves[2].ravel() - dT @ expected), rtol=0, atol=1e-13)
    assert sum(map(jnp.vdot, gradient, moves)) == pytest.approx(float(jnp.vdot(weights, dx)), rel=1e-11)
    # What the last block leaves over of a row, given all others, from the inverse of the whole.
    last = np.diag(np.linalg.inv(T))[-r:] * np.diag(T)[-r:]
    assert 0 < pivot <= np.min(1 / last) * (1 + 1e-12)


@pytest.mark.parametrize("n", [1, 4])
def test_dense_matrices(n):
    rng = np.random.default_rng(n)
    root, change = rng.normal(size=(2, n, n))
    T, dT = root @ root.T + n * np.eye(n), change + change.T
    b = rng.normal(size=n)
    solve = lambda T: DensePositiveDefinite(T).eliminate().solve(b)
    x, dx = jax.jvp(solve, (jnp.asarray(T),), (jnp.asarray(dT),))
    np.testing.assert_allclose(x, np.linalg.solve(T, b), rtol=0, atol=1e-13)
    np.testing.assert_allclose(dx, -np.linalg.solve(T, dT @ x), rtol=0, atol=1e-12)
    # The factor of one matrix with the derivatives of another of the same value.
    borrowed = lambda s: DensePositiveDefinite(T).eliminate().for_matrix(DensePositiveDefinite(T + s * dT)).solve(b)
    np.testing.assert_allclose(jax.jacrev(borrowed)(0.0), dx, rtol=0, atol=1e-12)
    pivot = DensePositiveDefinite(jnp.asarray(T)).eliminate().smallest_pivot()
    assert pivot == pytest.approx(np.min(1 / (np.diag(np.linalg.inv(T)) * np.diag(T))), rel=1e-12)
