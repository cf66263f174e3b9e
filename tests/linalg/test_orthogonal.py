"""Orthonormal bases against their definition, and derivatives of results that do not depend on the choice."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.linalg.orthogonal import orthogonal_basis

RNG = np.random.default_rng(0)


@pytest.mark.parametrize(("n", "r"), [(1, 1), (5, 5), (7, 3), (6, 0), (45, 30)])
def test_basis_is_orthonormal_and_adapted(n, r):
    C = jnp.asarray(RNG.normal(size=(n, r)))
    basis = orthogonal_basis(C)
    bases = np.concatenate([basis.range, basis.complement], axis=1)
    np.testing.assert_allclose(bases.T @ bases, np.eye(n), rtol=0, atol=1e-13)
    np.testing.assert_allclose(basis.complement.T @ C, 0.0, atol=1e-13)
    np.testing.assert_allclose(basis.inverse @ (basis.range.T @ C), np.eye(r), rtol=0, atol=1e-11)
    np.testing.assert_allclose(basis.pseudoinverse, np.linalg.pinv(C), rtol=0, atol=1e-11)


def test_badly_scaled_columns_stay_orthonormal():
    C = jnp.asarray(RNG.normal(size=(6, 4)) * 10.0 ** np.array([-150, -6, 0, 150]))
    basis = orthogonal_basis(C)
    bases = np.concatenate([basis.range, basis.complement], axis=1)
    np.testing.assert_allclose(bases.T @ bases, np.eye(6), rtol=0, atol=1e-14)
    assert np.all(np.isfinite(basis.inverse))


@pytest.mark.slow
@pytest.mark.parametrize(("n", "r"), [(4, 4), (6, 3)])
def test_derivatives_of_what_does_not_depend_on_the_choice(n, r):
    """Projections and pseudo-inverses, against the same from normal equations, to the third order."""
    C, direction = (jnp.asarray(RNG.normal(size=(n, r))) for _ in range(2))
    weights = jnp.asarray(RNG.normal(size=(n + r, n)))

    def by_basis(s):
        basis = orthogonal_basis(C + s * direction)
        return jnp.vdot(weights, jnp.concatenate([basis.complement @ basis.complement.T, basis.pseudoinverse]))

    def plain(s):
        moved = C + s * direction
        pseudoinverse = jnp.linalg.solve(moved.T @ moved, moved.T)
        return jnp.vdot(weights, jnp.concatenate([jnp.eye(n) - moved @ pseudoinverse, pseudoinverse]))

    for order in range(4):
        np.testing.assert_allclose(by_basis(0.0), plain(0.0), rtol=1e-8, err_msg=f"derivative {order}")
        by_basis, plain = jax.grad(by_basis), jax.jacfwd(plain)
