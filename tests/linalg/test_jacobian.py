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
