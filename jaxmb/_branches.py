"""Branches and loops that stay so under `vmap`: the lanes of a batch that need them pay for them."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from ._compat import any_of_batch, custom_vmap


def cond_of_any_lane(pred: Any, true_fn: Callable, false_fn: Callable, operand: Any) -> Any:
    """`lax.cond` that stays a branch under `vmap`: computed if any lane takes it, used only by these lanes."""
    new = lax.cond(any_of_batch(pred), true_fn, false_fn, operand)
    return jax.tree.map(lambda a, b: jnp.where(pred, a, b), new, false_fn(operand))


# The number of lanes that take a branch at once on a GPU, where thousands of them cost as much as one.
_LANES = 4096


def cond_of_lanes(pred: Any, true_fn: Callable, false_fn: Callable, operand: Any) -> Any:
    """`lax.cond` that under `vmap` is computed only for the lanes that take it, one after the other on a CPU.

    So a branch that a lane rarely takes costs the other lanes nothing. Elsewhere up to `_LANES` lanes go at once.
    Under differentiation it is `cond_of_any_lane`.
    """
    taken, static = eqx.partition((eqx.filter_closure_convert(true_fn, operand), operand), eqx.is_array)
    other, rest = eqx.partition(false_fn(operand), eqx.is_array)

    def branch(taken):
        function, operand = eqx.combine(taken, static)
        return eqx.filter(function(operand), eqx.is_array)

    @custom_vmap
    def of_lane(pred, taken, other):
        return lax.cond(pred, branch, lambda taken: other, taken)

    @of_lane.def_vmap
    def of_lanes(size, batched, pred, taken, other):
        of_all = lambda x, is_batched: x if is_batched else jnp.broadcast_to(x, (size, *jnp.shape(x)))
        pred, other = of_all(pred, batched[0]), jax.tree.map(of_all, other, batched[2])
        lanes, all_batched = jnp.nonzero(pred, size=size, fill_value=size)[0], jax.tree.map(lambda x: True, other)
        together = 1 if jax.default_backend() == "cpu" else min(size, _LANES)

        def compute(lanes, out):
            lane_operands = jax.tree.map(lambda x, is_batched: x[lanes] if is_batched else x, taken, batched[1])
            axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, batched[1])
            new = jax.vmap(branch, (axes,))(lane_operands) if jnp.ndim(lanes) else branch(lane_operands)
            return jax.tree.map(lambda x, new: x.at[lanes].set(new, mode="drop"), out, new)

        if size == 1:
            # XLA would compute the branch before a loop, as it does not depend on which lane takes it.
            return lax.cond(pred[0], lambda: compute(0, other), lambda: other), all_batched
        if together == 1:
            return lax.fori_loop(0, jnp.sum(pred), lambda k, out: compute(lanes[k], out), other), all_batched
        lanes = jnp.pad(lanes, (0, -size % together), constant_values=size)
        of_round = lambda k, out: compute(lax.dynamic_slice_in_dim(lanes, k * together, together), out)
        return lax.fori_loop(0, -(-jnp.sum(pred) // together), of_round, other), all_batched

    @jax.custom_jvp
    def chosen(pred, taken, other):
        return of_lane(pred, taken, other)

    @chosen.defjvp
    def derivatives(primals, tangents):
        of_any = lambda pred, taken, other: cond_of_any_lane(pred, branch, lambda taken: other, taken)
        return jax.jvp(of_any, primals, tangents)

    return eqx.combine(chosen(pred, taken, other), rest)


def loop_of_lanes(together: Callable, going: Callable, advance: Callable, start: Any) -> Any:
    """`lax.while_loop`, without derivatives, in which under `vmap` few lanes hold up the others.

    Lanes advance side by side while `together` holds for them; then the lanes still `going` continue as in
    `cond_of_lanes`.
    """
    start = lax.stop_gradient(start)
    closed, static = eqx.partition(eqx.filter_closure_convert(advance, start), eqx.is_array)

    def advanced(condition, closed, state):
        return lax.while_loop(condition, lambda state: eqx.combine(closed, static)(state), state)

    @custom_vmap
    def of_lane(closed, start):
        return advanced(going, closed, start)

    @of_lane.def_vmap
    def of_lanes(_, batched, closed, start):
        def alone(closed, start):
            first = advanced(together, closed, start)
            finish = lambda state: advanced(going, closed, state)
            return cond_of_lanes(going(first), finish, lambda state: state, first)

        axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, tuple(batched))
        return jax.vmap(alone, axes)(closed, start), jax.tree.map(lambda is_batched: True, batched[1])

    return of_lane(lax.stop_gradient(closed), start)
