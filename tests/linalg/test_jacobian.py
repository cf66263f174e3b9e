"""Jacobians whose independent rows are some of all."""

import jax
import numpy as np

from jaxmb.linalg.inertia import DiagonalInertia
from jaxmb.linalg.jacobian import DenseJacobian


def test_projector_on_some_rows():
    """Others bind nothing, and have no multipliers; also where one of them is implied."""
    random = np.random.default_rng(0)
    A, mass, numbers = random.normal(size=(5, 6)), random.uniform(1.0, 2.0, 6), (0, 2, 3)
    implied = A.copy()
    implied[3] = A[0] - 2 * A[2]
    force, velocity = random.normal(size=(2, 6))

    def solve(A, rank):
        own = DenseJacobian(A).of_rows(numbers).selected(rank, np.ones(6))
        return own.active, *own.projector(DiagonalInertia(mass)).solve(force, A @ velocity)

    found = jax.device_get(jax.jit(lambda A, implied: (solve(A, 3), solve(implied, 2)))(A, implied))
    for matrix, rank, (active, x, multipliers) in zip((A, implied), (3, 2), found, strict=True):
        np.testing.assert_allclose((matrix @ x)[list(numbers)], (matrix @ velocity)[list(numbers)], atol=1e-12)
        np.testing.assert_allclose(mass * x, force + matrix.T @ multipliers, atol=1e-12)
        assert np.count_nonzero(multipliers) == rank
        assert not np.any(multipliers[[1, 4]])
        np.testing.assert_array_equal(active, multipliers != 0)


def test_null_space_solution_beside_large_forces_of_the_rows():
    """It stays on the rows to all digits, although almost all of the force is theirs."""
    random = np.random.default_rng(1)
    A, B, mass = random.normal(size=(3, 6)), random.normal(size=(6, 6)), random.uniform(1.0, 2.0, 6)
    curved, own = B @ B.T + np.eye(6), random.normal(size=6)
    force = own + A.T @ (1e8 * random.normal(size=3))

    @jax.jit
    def solve(force):
        projector = DenseJacobian(A).of_rows((0, 1, 2)).selected(3, np.ones(6)).projector(DiagonalInertia(mass))
        return projector.null_space_solution(lambda x: curved @ x, force)

    x = np.asarray(solve(force))
    space = np.linalg.svd(A)[2][3:].T
    expected = space @ np.linalg.solve(space.T @ curved @ space, space.T @ own)
    np.testing.assert_allclose(x, expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(A @ x, 0.0, atol=1e-13)
