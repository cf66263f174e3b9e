"""Jacobians whose independent rows are some of all."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.linalg.inertia import DiagonalInertia
from jaxmb.linalg.jacobian import DenseJacobian


@pytest.mark.slow("True")
@pytest.mark.parametrize("redundant", [False, True])
def test_a_projector_on_some_rows(redundant):
    """Others bind nothing, and have no multipliers."""
    random = np.random.default_rng(0)
    A, mass, numbers = random.normal(size=(5, 6)), random.uniform(1.0, 2.0, 6), (0, 2, 3)
    if redundant:
        A[3] = A[0] - 2 * A[2]
    own = DenseJacobian(jnp.asarray(A)).of_rows(numbers).selected(2 if redundant else 3, jnp.ones(6))
    force, velocity = random.normal(size=(2, 6))
    rows = A @ velocity
    projector = own.projector(DiagonalInertia(jnp.asarray(mass)))
    x, multipliers = map(np.asarray, projector.solve(jnp.asarray(force), jnp.asarray(rows)))
    np.testing.assert_allclose((A @ x)[list(numbers)], rows[list(numbers)], atol=1e-12)
    np.testing.assert_allclose(mass * x, force + A.T @ multipliers, atol=1e-12)
    assert np.count_nonzero(multipliers) == (2 if redundant else 3)
    assert not np.any(multipliers[[1, 4]])
    np.testing.assert_array_equal(own.active, multipliers != 0)
