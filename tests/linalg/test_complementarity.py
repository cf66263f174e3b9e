"""Linear complementarity problems: solutions of random ones, singular matrices, equal right-hand sides, none at all."""

import jax
import numpy as np
import pytest
from scipy.optimize import linprog, nnls

from jaxmb.linalg.complementarity import (
    independent_components,
    largest_least,
    least_norm,
    positive_components,
    reduced,
    solved_components,
)


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


def test_solutions_of_special_problems():
    """Equal right-hand sides, nothing to solve, and no solution."""
    found, _, solvable = solve(np.ones((3, 3)), -np.ones(3))
    assert solvable and np.sum(found) == pytest.approx(1.0)
    found, positive, solvable = solve(np.eye(3), np.array([0.0, 1.0, 2.0]))
    assert solvable and not np.any(positive) and not np.any(found)
    assert not solve(-np.eye(3), -np.ones(3))[2]
    W, b = np.array([[2.0, 1.0], [1.0, 3.0]]), np.array([-1.0, 2.0])
    jacobian = jax.jit(jax.jacfwd(lambda b: solve(W, b)[0]))(b)
    np.testing.assert_allclose(jacobian, [[-0.5, 0.0], [0.0, 0.0]], atol=1e-15)


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


def test_elimination_of_components():
    """What is left between the others has the inverse that they have among all; what is eliminated is zero."""
    random = np.random.default_rng(1)
    A, given = random.normal(size=(5, 7)), np.array([False, True, False, True, False])
    left = np.asarray(jax.jit(reduced)(A @ A.T, given))
    others = np.ix_(~given, ~given)
    np.testing.assert_allclose(np.linalg.inv(left[others]), np.linalg.inv(A @ A.T)[others], rtol=1e-10)
    np.testing.assert_allclose(left[given], 0.0, atol=1e-12)


def moves_of(instead, free):
    """The changes of all components by a unit of each free one."""
    return (instead + np.diag(free.astype(float)))[:, free]


def choices(random, k):
    """Random components of which one to three are free, and how they change the others."""
    free = np.isin(np.arange(k), random.choice(k, random.integers(1, 4), replace=False))
    instead = np.where(~free[:, None] & free[None, :], random.normal(size=(k, k)), 0.0)
    x = np.where(free, 0.0, random.uniform(-1.0, 1.0, k) if random.random() < 0.5 else random.integers(0, 2, k))
    return x.astype(float), instead, free


def test_the_largest_least_component_is_that_of_a_linear_program():
    """Against SciPy's; half of the problems have components that are zero."""
    random, found = np.random.default_rng(1), jax.jit(largest_least)
    for _ in range(60):
        x, instead, free = choices(random, 6)
        moves = np.concatenate([moves_of(instead, free), -np.ones((6, 1))], axis=1)
        n = moves.shape[1] - 1
        bounds = [*n * [(None, None)], (None, 1.0)]
        known = linprog(np.append(np.zeros(n), -1.0), -moves, x, bounds=bounds).x[-1]
        np.testing.assert_allclose(found(x, instead, ~free, free), known, atol=1e-12)


def test_derivatives_of_the_largest_least_component():
    """By the components and by how they change, in both modes, against central differences."""
    random = np.random.default_rng(3)
    x, instead, free = choices(random, 6)
    x = np.where(free, 0.0, random.uniform(-1.0, 1.0, 6))
    along, change = random.normal(size=6), np.where(instead != 0, random.normal(size=(6, 6)), 0.0)

    @jax.jit
    def run(step):
        found = lambda h: largest_least(x + h * along, instead + h * change, ~free, free)
        return (found(step) - found(-step)) / (2 * step), jax.jacfwd(found)(0.0), jax.jacrev(found)(0.0)

    known, *derivatives = run(1e-5)
    np.testing.assert_allclose(derivatives, known, rtol=1e-8)


def test_the_least_norm_of_components_that_are_not_negative():
    """No allowed change lowers the sum of squares. Four feet under an eccentric load, by hand: their shares are a
    plane, until the foot opposite to the load has none.
    """
    random, found, least = np.random.default_rng(2), jax.jit(least_norm), jax.jit(largest_least)
    for _ in range(60):
        x, instead, free = choices(random, 6)
        if least(x, instead, ~free, free) < 1e-3:
            continue
        y, moves = np.asarray(found(x, instead, free)), moves_of(instead, free)
        np.testing.assert_allclose(y, x + moves @ y[free], atol=1e-12)
        # Forces from below hold the components that are zero, and only these.
        zero = y < 1e-12
        unbalanced = nnls(moves[zero].T, moves.T @ y)[1] if np.any(zero) else np.linalg.norm(moves.T @ y)
        assert np.all(y >= 0) and unbalanced < 1e-10
    # The force of the last foot moves to its neighbours, and comes from the opposite foot.
    instead, last = np.zeros((4, 4)), np.arange(4) == 3
    instead[:3, 3] = 1.0, -1.0, -1.0
    for load, shares in (((0.0, 1.0, 1.0), (0.5, 0.5, 0.5, 0.5)), ((0.8, 0.1, 0.3), (0.8, 0.1, 0.3, 0.0))):
        np.testing.assert_allclose(found(np.array([*load, 0.0]), instead, last), shares, atol=1e-15)
