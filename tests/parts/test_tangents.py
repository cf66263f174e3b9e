"""The derivatives of tangents between circles are those of the formula for the tangents."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxmb.parts import tangents


def derivatives(lines, weights, numbers, along):
    """Of a weighted sum of all results: forwards and backwards, and along one change the second ones in both modes."""

    def measure(between, offsets, tilts):
        # Axes of unit length, also as they change.
        axes = tilts / jnp.sqrt(jnp.sum(tilts**2, axis=1, keepdims=True)) if tilts.size else None
        return sum(jnp.sum(w * x) for w, x in zip(weights, lines(between, offsets, axes), strict=True))

    slope = lambda *numbers: jax.jvp(measure, numbers, along)[1]
    return jax.jvp(slope, numbers, along), jax.jvp(jax.grad(measure, (0, 1, 2)), numbers, along)


def test_tangent_lines_first_and_second_derivatives():
    rng, cases = np.random.default_rng(3), {}
    for dimension in (2, 3):
        # In the plane there are no axes.
        shapes = ((4, dimension), (4,), (4, 3) if dimension == 3 else (0,))
        draw = lambda scales, shapes=shapes: tuple(s * rng.normal(size=x) for s, x in zip(scales, shapes, strict=True))
        weights = rng.normal(size=4), rng.normal(size=(4, dimension))
        cases[dimension] = weights, draw((2.0, 0.2, 1.0)), draw((1.0, 1.0, 1.0))
    both = tangents.tangent_lines, tangents._lines.fun
    found, expected = jax.jit(lambda x: [{d: derivatives(own, *x[d]) for d in x} for own in both])(cases)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-11), found, expected)
    assert min(np.max(np.abs(x)) for x in jax.tree.leaves(found) if x.size) > 0.1
