"""Motions of members that a `jax.vmap` computes at once, side by side where the processor is told to."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from .._compat import custom_vmap
from .._setup import computes_side_by_side
from ..linalg.members import in_blocks
from .evaluate import in_lanes
from .sizes import loops

# The number of members side by side, which fill a vector register in double precision; and the most bytes that their
# loop carries for one: larger loops, such as of the gradient of Bricard's mechanism, would compile for minutes.
SIDE_BY_SIDE, _MOST = 8, 400_000


def stand_side_by_side(carried: int) -> bool:
    """Whether members are computed side by side whose largest loop carries this many bytes."""
    return computes_side_by_side() and 0 < carried <= _MOST and jax.default_backend() == "cpu"


def of_one_or_more(function: Callable[..., PyTree], *arguments: Any) -> PyTree:
    """The function of some arguments, in which `jax.vmap` has members stand side by side. It has no derivatives."""
    if not computes_side_by_side():
        return function(*arguments)
    arrays, static = eqx.partition(arguments, eqx.is_array)
    rest = []

    @custom_vmap
    def of_one(arrays):
        values, other = eqx.partition(function(*eqx.combine(arrays, static)), eqx.is_array)
        rest[:] = [other]
        return values

    @of_one.def_vmap
    def of_members(size, batched, arrays):
        del size
        (varies,), all_batched = batched, lambda out: jax.tree.map(lambda _: True, out)
        like = jax.tree.map(lambda x, varies: jax.ShapeDtypeStruct(x.shape[varies:], x.dtype), arrays, varies)
        program, out = jax.make_jaxpr(of_one.fun, return_shape=True)(like)
        if not stand_side_by_side(max((carried for carried, _ in loops(program)), default=0)):
            axes = jax.tree.map(lambda varies: 0 if varies else None, varies)
            return jax.vmap(of_one.fun, (axes,))(arrays), all_batched(out)

        def of_block(members):
            last = eqx.combine(jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), members), arrays)
            evaluated = in_lanes(program, jax.tree.leaves(members)[0].shape[0], jax.tree.leaves(varies))
            return [jnp.moveaxis(x, -1, 0) for x in evaluated(*jax.tree.leaves(last))]

        results = in_blocks(of_block, eqx.filter(arrays, varies), SIDE_BY_SIDE)
        return jax.tree.unflatten(jax.tree.structure(out), results), all_batched(out)

    return eqx.combine(of_one(arrays), *rest)
