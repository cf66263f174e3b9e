"""Linear complementarity problems: solutions of random ones, singular matrices, equal right-hand sides, none at all."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.linalg.complementarity import independent_components, positive_components, solved_components


@jax.jit
def solve(W, b):
    positive, solvable = positive_components(W, b)
    return solved_components(W, b, positive), positive, solvable


@pytest.mark.parametrize("k", [1, 3, 6])
def test_solutions_of_random_problems(k):
    """Half of the matrices are singular, as those of redundant contacts are."""
    random = np.random.default_rng(k)
    for _ in range(100):
        A = random.normal(size=(k, random.integers(1, k + 1)))
        x, w = np.maximum(random.normal(size=(2, k)), 0.0)
        b = w * (x == 0) - A @ (A.T @ x)
        found, positive, solvable = map(np.asarray, solve(A @ A.T, b))
        assert solvable
        left = A @ (A.T @ found) + b
        assert np.all(found >= -1e-9) and np.all(left >= -1e-9)
        np.testing.assert_allclose(found * left, 0.0, atol=1e-8)
        # Columns of components that are not zero are independent.
        assert np.linalg.matrix_rank(A[positive], tol=1e-10) == np.sum(positive)


def test_equal_right_hand_sides():
    found, _, solvable = solve(jnp.ones((4, 4)), -jnp.ones(4))
    assert solvable
    np.testing.assert_allclose(jnp.sum(found), 1.0)


def test_nothing_to_solve():
    found, positive, solvable = solve(jnp.eye(3), jnp.array([0.0, 1.0, 2.0]))
    assert solvable and not np.any(positive) and not np.any(found)


def test_a_problem_without_solution_says_so():
    assert not solve(jnp.array([[-1.0]]), jnp.array([-1.0]))[2]


def test_independent_components():
    """Of random matrices, in units of any size: as many as the rank of those that are among them."""
    random = np.random.default_rng(0)
    independent = jax.jit(independent_components)
    for _ in range(100):
        among = random.random(6) < 0.7
        A = random.normal(size=(6, random.integers(1, 7))) * 10.0 ** random.integers(-4, 5, (6, 1))
        A[random.integers(6)] = 3 * A[random.integers(6)]
        found = np.asarray(independent(A @ A.T, among))
        units = A / np.linalg.norm(A, axis=1, keepdims=True)
        rank = lambda rows: np.linalg.matrix_rank(rows, tol=1e-4) if len(rows) else 0
        assert not np.any(found & ~among)
        assert rank(units[found]) == np.sum(found) == rank(units[among])


def test_derivative_of_a_solution():
    W, b = jnp.array([[2.0, 1.0], [1.0, 3.0]]), jnp.array([-1.0, 2.0])
    jacobian = jax.jacfwd(lambda b: solve(W, b)[0])(b)
    np.testing.assert_allclose(jacobian, [[-0.5, 0.0], [0.0, 0.0]], atol=1e-15)
