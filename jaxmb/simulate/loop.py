"""The loop of a run, without diffrax's checks in the program, and without a program for each number of steps."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from .._compat import direction_of, while_loop, with_loops
from ..solvers import MeshAdjoint
from ..solvers.stepping import loop, with_tables_of_angles


class Loop(diffrax.AbstractAdjoint):
    """diffrax's loop with saved times and a number of steps that have been checked.

    diffrax checks times by a host callback, and JAX does not cache programs with callbacks for later processes. It also
    compiles a program for each number of steps.

    **Fields:** the `times` of the first series of saved states, None if it has none; `end`: whether that series ends
    with the end of the run; `limit`: the largest number of steps; `derivatives` on the mesh, or None.
    """

    times: Any
    end: bool = eqx.field(static=True)
    limit: Any
    derivatives: MeshAdjoint | None

    @classmethod
    def around(cls, saveat: diffrax.SaveAt, limit: Any, derivatives: MeshAdjoint | None):
        """A loop for `saveat`, and the `SaveAt` that diffrax gets instead."""
        first, *rest = saveat.subs
        # diffrax does not take an empty series.
        placeholder = first.t1 or first.ts is not None
        told = diffrax.SubSaveAt(t0=first.t0, t1=placeholder, steps=first.steps, fn=first.fn)
        saveat = eqx.tree_at(lambda saveat: saveat.subs, saveat, (told, *rest))
        return cls(first.ts, first.t1, limit, derivatives), saveat

    def loop(self, *, terms, solver, saveat, init_state, max_steps, **options):
        if self.times is not None:
            saveat, init_state = self._with_times(saveat, init_state, direction_of(terms))
        init_state = with_tables_of_angles(init_state)
        given = options | {"terms": terms, "saveat": saveat, "init_state": init_state}
        if self.derivatives is not None:
            return self.derivatives.run(max_steps, self.limit, solver=solver, **given)
        for name in ("throw", "passed_solver_state", "passed_controller_state"):
            del given[name]

        def outer(cond_fun, body_fun, init, *, max_steps, buffers):
            del max_steps
            proceed = lambda state: cond_fun(state) & (state.num_steps < self.limit)
            return while_loop(proceed, body_fun, init, max_steps=None, buffers=buffers, kind="lax")

        return loop(solver=with_loops(solver, "lax"), max_steps=max_steps, outer_while_loop=outer, **given)

    def _with_times(self, saveat, init_state, direction):
        first, *rest = saveat.subs
        times = self.times * jnp.asarray(direction, self.times.dtype)
        series = diffrax.SubSaveAt(t0=first.t0, t1=self.end, ts=times, steps=first.steps, fn=first.fn)
        extra_rows = times.size + int(self.end) - int(first.t1)
        longer = lambda x: jnp.full((x.shape[0] + extra_rows, *x.shape[1:]), jnp.inf, x.dtype)
        tables = init_state.save_state[0]
        tables = eqx.tree_at(
            lambda s: (s.ts, s.ys), tables, (direction * longer(tables.ts), jax.tree.map(longer, tables.ys))
        )
        return (
            eqx.tree_at(lambda saveat: saveat.subs, saveat, (series, *rest)),
            eqx.tree_at(lambda s: s.save_state[0], init_state, tables),
        )
