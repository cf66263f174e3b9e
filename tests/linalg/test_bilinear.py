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


SOME = ("by components", "by columns", "transposed", "empty blocks")


def every(f, a, b, along, many):
    """Values, both modes of derivatives and their combinations along directions, and batches."""
    loss = lambda a, b: jnp.sum(jnp.sin(f(a, b)))
    slope = lambda a, b: jax.jvp(loss, (a, b), along)[1]
    gradient = jax.grad(loss, (0, 1))
    back = lambda a, b: sum(jnp.vdot(x, y) for x, y in zip(gradient(a, b), along, strict=True))
    yield f(a, b), slope(a, b), gradient(a, b)
    yield jax.grad(slope, (0, 1))(a, b), jax.grad(back, (0, 1))(a, b), jax.jvp(gradient, (a, b), along)[1]
    for axes, operands in (((a.ndim, 0), many), ((None, 0), (a, many[1])), ((a.ndim, None), (many[0], b))):
        yield jax.vmap(f, axes)(*operands)
    # One square, and a linear function of one operand.
    if a.shape == b.shape:
        yield jax.grad(lambda a: jnp.sum(f(a, a)))(a)
    yield jax.linear_transpose(lambda a: f(a, b), a)(jnp.ones_like(f(a, b)))


@pytest.mark.slow("others")
@pytest.mark.parametrize("some", [SOME, [name for name in CASES if name not in SOME]], ids=["some", "others"])
def test_values_derivatives_and_batches(some):
    random = np.random.default_rng(3)
    given = {}
    for name in some:
        *_, of_a, of_b = CASES[name]
        a, b, *along = (0.5 * random.normal(size=shape) for shape in (of_a, of_b, of_a, of_b))
        given[name] = a, b, tuple(along), (random.normal(size=(*of_a, 3)), random.normal(size=(3, *of_b)))

    @jax.jit
    def run(given):
        given = jax.tree.map(jnp.asarray, given)
        return {k: [list(every(f, *given[k])) for f in CASES[k][:2]] for k in some}

    for name, (found, expected) in jax.device_get(run(given)).items():
        close = lambda x, y, name=name: np.testing.assert_allclose(x, y, rtol=0, atol=1e-13, err_msg=name)
        jax.tree.map(close, found, expected)
        close(CASES[name][0](*given[name][:2]), expected[0][0])


def test_types_are_promoted():
    own, *_ = CASES["by components"]
    a, b = np.arange(4.0), np.arange(2.0)
    with jax.numpy_dtype_promotion("standard"):
        found = jax.jit(own)(a + 1j, b)
    np.testing.assert_allclose(found, own(a, b) + 1j * own(np.ones(4), b))
