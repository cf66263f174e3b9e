"""Bilinear primitives against einsum: values, both modes of derivatives, and batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.linalg.bilinear import BilinearMap
from jaxmb.linalg.blocks import matrix_products, transpose_vector_products, vector_products


def random_map(shape, seed):
    """A map with some entries missing, and one component that is always zero."""
    random = np.random.default_rng(seed)
    table = random.choice([0.0, 1.0, -1.0, 0.5, -2.0], shape)
    table[0] = 0.0
    return BilinearMap.of(table), lambda a, b: jnp.einsum("ijk,...j,...k->...i", table, a, b)


CASES = {
    "by components": (*random_map((3, 4, 2), 0), (4,), (2,)),
    "by columns": (*random_map((7, 2, 3), 1), (2,), (3,)),
    "of stacks": (*random_map((4, 3, 3), 2), (5, 3), (5, 3)),
    "blocks": (matrix_products, lambda a, b: jnp.einsum("...ij,...jl->...il", a, b), (2, 3, 4), (2, 4, 5)),
    "empty blocks": (matrix_products, lambda a, b: jnp.einsum("...ij,...jl->...il", a, b), (2, 3, 0), (2, 0, 5)),
    "one block": (matrix_products, lambda a, b: jnp.einsum("...ij,...jl->...il", a, b), (3, 4), (2, 4, 5)),
    "vectors": (vector_products, lambda a, b: jnp.einsum("...ij,...j->...i", a, b), (2, 3, 4), (2, 4)),
    "transposed": (transpose_vector_products, lambda a, b: jnp.einsum("...ij,...i->...j", a, b), (2, 3, 4), (2, 3)),
}


@pytest.mark.slow(but=("empty blocks",))
@pytest.mark.parametrize("name", CASES)
def test_values_derivatives_and_batches(name):
    own, expected, *shapes = CASES[name]
    random = np.random.default_rng(3)
    a, b = (jnp.asarray(random.normal(size=shape)) for shape in shapes)
    close = lambda found, right: np.testing.assert_allclose(found, right, rtol=0, atol=1e-13)
    close(own(a, b), expected(a, b))
    close(own(np.asarray(a), np.asarray(b)), expected(a, b))
    weighted = lambda f: lambda a, b: jnp.sum(jnp.sin(f(a, b)))
    forward, reverse = jax.jacfwd, jax.jacrev
    for once, twice in ((forward, reverse), (reverse, forward), (reverse, reverse)):
        derivatives = lambda f, once=once, twice=twice: jax.jit(
            lambda a, b: (once(f, (0, 1))(a, b), twice(once(weighted(f), (0, 1)), (0, 1))(a, b))
        )
        jax.tree.map(close, derivatives(own)(a, b), derivatives(expected)(a, b))
    many = jnp.asarray(random.normal(size=(*a.shape, 3))), jnp.asarray(random.normal(size=(3, *b.shape)))
    for axes, operands in (((a.ndim, 0), many), ((None, 0), (a, many[1])), ((a.ndim, None), (many[0], b))):
        close(jax.jit(jax.vmap(own, axes))(*operands), jax.vmap(expected, axes)(*operands))
    # One square, and a linear function of one operand.
    if a.shape == b.shape:
        close(jax.grad(lambda a: jnp.sum(own(a, a)))(a), jax.grad(lambda a: jnp.sum(expected(a, a)))(a))
    (pulled,) = jax.linear_transpose(lambda a: own(a, b), a)(jnp.ones_like(own(a, b)))
    close(pulled, jax.grad(lambda a: jnp.sum(expected(a, b)))(a))


def test_types_are_promoted():
    own, expected, *_ = CASES["by components"]
    a, b = np.arange(4.0), np.arange(2.0)
    np.testing.assert_allclose(own(a, jnp.asarray(b)), expected(a, b))
    with jax.numpy_dtype_promotion("standard"):
        found = own(jnp.asarray(a + 1j), jnp.asarray(b))
        np.testing.assert_allclose(found, expected(a + 1j, b))
