"""A vector field on raveled states, its second derivative in time, and its linearisation."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from .linear_map import filled

# `(t, y) -> ((y on the manifold, f), other outputs)`, for raveled y; a pytree, so that it can carry parameters.
Field = Callable[[Any, Float[Array, " n"]], tuple[tuple[Float[Array, " n"], Float[Array, " n"]], PyTree]]
# `(t, y, f, along) -> (y, f, g)`: a known state, its f, and g along a rate of the state (None: f), with their
# derivatives by the equations; a pytree as well.
Solution = Callable[..., tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]]


class Derivatives(NamedTuple):
    """A state with its first and second time derivatives; `rest`: the other outputs of the field."""

    y: Float[Array, " n"]
    f: Float[Array, " n"]
    g: Float[Array, " n"]
    rest: PyTree


def derivatives(field: Field, t: Any, y: Float[Array, " n"]) -> Derivatives:
    """The state on the manifold, and its time derivatives."""
    (y, f), push, rest = jax.linearize(field, t, y, has_aux=True)
    return Derivatives(y, f, push(jnp.ones_like(t), f)[1], rest)


def probed_derivatives(
    field: Field, t: Any, y: Float[Array, " n"], size: Float[Array, " n"] | None = None, along: bool = False
) -> tuple[Derivatives, Bool[Array, ""]]:
    """The result of `derivatives`, and whether differences of f contradict the derivative of f.

    **Arguments:** `size` of the components, if known; `along`: whether to take differences along the manifold only,
    for a field that projects states on it.
    """
    eps = jnp.finfo(y.dtype).eps
    size = jnp.abs(y) + (jnp.mean(jnp.abs(y)) if size is None else size)
    signs = jnp.where(jnp.arange(y.size) % 2 == 0, 1.0, -0.7).astype(y.dtype)
    aside = lax.stop_gradient(eps ** (1 / 3) * signs * jnp.where(size > 0, size, jnp.ones_like(size)))

    # A loop, so that the field is compiled once for both states.
    def at(carry, _):
        y, way = carry
        (state, f), push, rest = jax.linearize(field, t, y, has_aux=True)
        times = jnp.stack([jnp.ones_like(t), jnp.zeros_like(t)])
        (_, move), (g, slope) = jax.vmap(push)(times, jnp.stack([f, way]))
        # With the same direction at both states, the mean slope is the slope of the difference to second order.
        way = lax.stop_gradient(move) if along else way
        return (y + way, way), (Derivatives(state, f, g, rest), slope)

    _, (both, slopes) = lax.scan(at, (y, aside), None, length=2)
    f = lax.stop_gradient(both.f)
    change, expected = f[1] - f[0], lax.stop_gradient(jnp.mean(slopes, axis=0))
    wrong = jnp.abs(change - expected)
    rounding = 1e-6 * jnp.max(jnp.abs(change)) + 1e3 * eps * jnp.max(jnp.abs(f))
    contradiction = jnp.any((wrong > 0.3 * jnp.maximum(jnp.abs(change), jnp.abs(expected))) & (wrong > rounding))
    return jax.tree.map(lambda x: x[0], both), contradiction


@eqx.filter_custom_jvp
def at_start(
    end: tuple[Array, Array, Array], solution: Solution, t: Any, y: Float[Array, " n"]
) -> tuple[Array, Array, Array]:
    """`(y, f, g)` at a known state y, with their derivatives by the equations."""
    del solution, t, y
    return end


@at_start.def_jvp
def _at_start_jvp(primals, tangents):
    _, f, _ = out = at_start(*primals)
    tangents = eqx.filter_jvp(lambda solution, t, y: solution(t, y, f, None), primals[1:], tangents[1:])[1]
    return out, filled(out, tangents)


def linearized(
    solution: Callable[[PyTree], Solution], numbers: PyTree, t: Any, y: Float[Array, " n"], f: Float[Array, " n"]
) -> tuple[Callable[..., tuple[Array, Array, Array]], Callable[..., tuple[Array, Array, Array]]]:
    """The tangents of `(y, f, g)` at a known state as two linear functions.

    The first takes the tangents of the `numbers` that the solution depends on and of time (None: no tangent), for a
    held rate. The second takes the tangents of the state and of the rate that g is along (None: held).
    """
    out, push = jax.linearize(lambda x, *at: solution(x)(*at[:2], f, at[2]), numbers, t, y, f)
    zeros, still = jax.tree.map(jnp.zeros_like, (numbers, t, y, f)), jax.tree.map(lambda _: None, numbers)

    def tangents_of(*tangents):
        # A derivative of the linear function leaves out numbers without tangents.
        return filled(out, eqx.filter_jvp(push, zeros, tangents)[1])

    return lambda along, dt: tangents_of(along, dt, None, None), lambda y, rate: tangents_of(still, None, y, rate)
