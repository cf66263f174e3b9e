"""The integration of a term by any solver, with derivatives on its mesh."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from .closures import opened
from .mesh import on_mesh
from .stepping import begun, loop, solution_of

_END, _STEPS, _NO_METER = diffrax.SaveAt(t1=True), diffrax.ConstantStepSize(), diffrax.NoProgressMeter()


def integrate(
    terms: PyTree,
    solver: diffrax.AbstractSolver,
    t0: Any,
    t1: Any,
    dt0: Any,
    y0: PyTree,
    args: PyTree = None,
    *,
    saveat: diffrax.SaveAt | None = None,
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    event: diffrax.Event | None = None,
    max_steps: int = 4096,
    kept: int = 2048,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
    throw: bool = True,
) -> diffrax.Solution:
    """Integrate a differential equation, as `diffrax.diffeqsolve` does, with the derivatives of a simulation.

    ```python
    import diffrax
    from jaxmb.solvers import Adams, MultistepController, integrate

    term, control = diffrax.ODETerm(lambda t, y, rate: -rate * y), MultistepController(rtol=1e-8, atol=1e-10)


    def end(rate):
        start = jnp.ones(1)
        return integrate(term, Adams(), 0.0, 1.0, None, start, rate, stepsize_controller=control).ys[-1, 0]


    slope = jax.grad(end)(2.0)
    ```

    Forward mode, reverse mode and their combinations differentiate the same steps. The functions of an event see the
    times of the user, also in a run backwards.

    **Arguments:** as of `diffrax.diffeqsolve`, with its defaults; `kept`: the number of steps whose rows derivatives
    keep at once. Second derivatives need the rows of all steps. A function of saved states (`SaveAt(fn=...)`) rules out
    derivatives.

    **Returns:** the solution, with the last states of the solver and the controller.

    **Raises:** `ValueError` for a solver of other terms. `RuntimeError` if the integration fails, unless `throw` is
    false.
    """
    terms, event = jax.tree.map(opened, (terms, event))
    times = [x for x in (t0, t1, dt0) if x is not None]
    with jax.numpy_dtype_promotion("standard"):
        kind = jnp.result_type(float, *times)
        y0 = jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(x, kind)), y0)
    in_time = lambda t: None if t is None else jnp.asarray(t, kind)
    has_times = lambda saveat: [sub.ts for sub in jax.tree.leaves(saveat.subs, is_leaf=_is_sub) if sub.ts is not None]
    options = {
        "t0": in_time(t0),
        "t1": in_time(t1),
        "dt0": in_time(dt0),
        "y0": y0,
        "args": args,
        "saveat": eqx.tree_at(has_times, _END if saveat is None else saveat, replace_fn=in_time),
        "stepsize_controller": _STEPS if stepsize_controller is None else stepsize_controller,
        "event": event,
        "max_steps": max_steps,
        "progress_meter": _NO_METER if progress_meter is None else progress_meter,
    }
    solution = _compiled(terms, solver, options, kept)
    if throw:
        solution = solution.result.error_if(solution, ~diffrax.is_okay(solution.result))
    return solution


@eqx.filter_jit
def _compiled(terms, solver, options, kept):
    return _integrated(terms, solver, options, kept)


@eqx.filter_custom_jvp
def _integrated(terms, solver, options, kept):
    del kept
    solve, first = begun(terms, solver, **options)
    return solution_of(solve, loop(solve, first, solve.max_steps)[0], first.y)


@_integrated.def_jvp
def _integrated_jvp(primals, tangents):
    *numbers, kept = primals

    def solution(terms, solver, options):
        solve, first = begun(terms, solver, **options)
        return solution_of(solve, on_mesh(solve, first, solve.max_steps, kept), first.y)

    return eqx.filter_jvp(solution, tuple(numbers), tuple(tangents[:-1]))


def _is_sub(x):
    return isinstance(x, diffrax.SubSaveAt)
