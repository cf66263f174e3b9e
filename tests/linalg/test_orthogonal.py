"""Orthonormal bases against their definition, and derivatives of results that do not depend on the choice."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxmb.linalg.orthogonal import orthogonal_basis

RNG = np.random.default_rng(0)


def test_basis_is_orthonormal_and_adapted():
    matrices = [RNG.normal(size=size) for size in ((1, 1), (5, 5), (7, 3), (6, 0), (45, 30))]
    badly_scaled = RNG.normal(size=(6, 4)) * 10.0 ** np.array([-150, -6, 0, 150])
    run = jax.jit(lambda Cs: [(basis := orthogonal_basis(C), basis.pseudoinverse) for C in Cs])
    *found, (other, _) = jax.device_get(run([*matrices, badly_scaled]))
    for C, (basis, pseudoinverse) in zip(matrices, found, strict=True):
        bases = np.concatenate([basis.range, basis.complement], axis=1)
        np.testing.assert_allclose(bases.T @ bases, np.eye(len(C)), rtol=0, atol=1e-13)
        np.testing.assert_allclose(basis.complement.T @ C, 0.0, atol=1e-13)
        np.testing.assert_allclose(basis.inverse @ (basis.range.T @ C), np.eye(C.shape[1]), rtol=0, atol=1e-11)
        np.testing.assert_allclose(pseudoinverse, np.linalg.pinv(C), rtol=0, atol=1e-11)
    bases = np.concatenate([other.range, other.complement], axis=1)
    np.testing.assert_allclose(bases.T @ bases, np.eye(6), rtol=0, atol=1e-14)
    assert np.all(np.isfinite(other.inverse))


def test_derivatives_of_what_does_not_depend_on_the_choice():
    """Projections and pseudo-inverses, against the same from normal equations, to the second order."""

    def orders(C, direction, weights):
        def by_basis(s):
            basis = orthogonal_basis(C + s * direction)
            return jnp.vdot(weights, jnp.concatenate([basis.complement @ basis.complement.T, basis.pseudoinverse]))

        def plain(s):
            moved = C + s * direction
            pseudoinverse = jnp.linalg.solve(moved.T @ moved, moved.T)
            return jnp.vdot(weights, jnp.concatenate([jnp.eye(len(C)) - moved @ pseudoinverse, pseudoinverse]))

        for _ in range(3):
            yield by_basis(0.0), plain(0.0)
            by_basis, plain = jax.grad(by_basis), jax.jacfwd(plain)

    sizes = ((4, 4), (6, 3))
    given = [(*RNG.normal(size=(2, n, r)), RNG.normal(size=(n + r, n))) for n, r in sizes]
    for pairs in jax.jit(lambda given: [list(orders(*own)) for own in given])(given):
        for order, (found, expected) in enumerate(pairs):
            np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-12, err_msg=f"derivative {order}")
