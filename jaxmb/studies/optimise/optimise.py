"""Designs by gradients: the best values of named parameters, with constraints on named outputs."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import ArrayLike

from ..._arguments import whole_number
from ..._printed import Printed
from ..._types import VectorLike
from ...parts.names import names_arguments
from ...system import AbstractSystem
from ...system.design import Bounds
from ...system.quantities import component_names
from .constrained import balance_at, slsqp, trust_constr
from .evaluation import (
    Limits,
    Program,
    chosen_objective,
    limits,
    output_shapes,
    rows_of_batch,
    told_apart,
    with_derivatives,
)
from .space import Space, space
from .trials import HOLDS, Iteration, Trial, Trials, evaluate, first_feasible
from .unconstrained import bfgs, first_order
from .verdict import objection

# Local optimisations from the best of several starts.
_LOCAL = 4

# Gradients below this, relative to that at the start, are those of an optimum.
_BALANCED = 1e-3

# Lines of the log that are printed.
_FIRST, _LAST = 3, 9


@dataclasses.dataclass(frozen=True)
class ConstrainedOutput:
    """A component of a constrained output at the optimum: its bounds, the values before and after, whether a bound is
    active, its multiplier, what one unit more of that bound would gain of the objective, and the `tolerance` by which
    the value may be out of bounds, in the output's unit.
    """

    name: str
    low: float
    high: float
    before: float
    after: float
    active: bool
    multiplier: float
    tolerance: float


@dataclasses.dataclass(frozen=True)
class Attempt:
    """One local optimisation: start and result, the objectives there, the largest violation of a constraint relative to
    its size, and how it ended.
    """

    start: dict[str, np.ndarray]
    parameters: dict[str, np.ndarray]
    before: float
    after: float
    violation: float
    success: bool
    message: str


@dataclasses.dataclass(frozen=True, repr=False)
class Optimum(Printed):
    """The result of `optimise`; `print` shows tables.

    ```python
    print(best)  # Tables of parameters, outputs and constraints, for `best` from `optimise`.
    best.parameters["bar.inertia"], best.outputs["angle"], best.success
    ```

    **Fields:**

    - `parameters`: the best values by name; `start`: those it started from.
    - `objective`: its value; `outputs`: all outputs by name; `before`: the outputs at the start, not finite where they
        could not be computed there.
    - `constraints`: for every component of a constrained output, its bounds, values, whether it is active, and its
        multiplier.
    - `iterations`: the log of the local optimisation that gave the result; `trials`: how often the function was
        differentiated for it, of which `failed` trials were rejected.
    - `attempts`: all local optimisations, the best first, if there were several.
    - `success`: whether the method converged to a minimum and all constraints hold within their `tolerance`. An edge
        beyond which trials fail or the objective leaps up is no minimum, nor is a maximum, a saddle, or a point where
        the objective changes in steps; `message`: how it ended.
    - `derivatives`: the mode, `"forward"` or `"reverse"`.
    """

    parameters: dict[str, np.ndarray]
    start: dict[str, np.ndarray]
    objective: float
    outputs: dict[str, np.ndarray]
    before: dict[str, np.ndarray]
    constraints: tuple[ConstrainedOutput, ...]
    iterations: tuple[Iteration, ...]
    trials: int
    failed: int
    attempts: tuple[Attempt, ...]
    success: bool
    message: str
    derivatives: str

    def __repr__(self) -> str:
        return f"Optimum: objective {self.objective:.6g}, {self.message}"

    def __str__(self) -> str:
        rows: list[tuple[str, ...]] = [("parameter", "start", "optimum")]
        for name, value in self.parameters.items():
            own = component_names(name, value.shape)
            rows += [
                (n, f"{a:.6g}", f"{b:.6g}") for n, a, b in zip(own, self.start[name].flat, value.flat, strict=True)
            ]
        rows += [(), ("output", "before", "after")]
        for name, value in self.outputs.items():
            if value.ndim == 0:
                rows.append((name, f"{float(self.before[name]):.6g}", f"{float(value):.6g}"))
        if self.constraints:
            rows += [(), ("constraint", "before", "after", "low", "high", "within", "multiplier")]
            for c in self.constraints:
                shown = f"{c.multiplier:.3g}" if c.active else ""
                rows.append(
                    (c.name, *(f"{x:.6g}" for x in (c.before, c.after, c.low, c.high)), f"{c.tolerance:.1g}", shown)
                )
        if len(self.attempts) > 1:
            rows += [(), ("attempt", "before", "after", "violation")]
            rows += [
                (str(k + 1), f"{a.before:.6g}", f"{a.after:.6g}", f"{a.violation:.1e}")
                for k, a in enumerate(self.attempts)
            ]
        rows += [(), ("iteration", "objective", "violation", "step", "trials", "failed")]
        for k, i in enumerate(self.iterations):
            if _FIRST <= k < len(self.iterations) - _LAST:
                if k == _FIRST:
                    rows.append(("…",))
                continue
            numbers = f"{i.objective:.8g}", f"{i.violation:.1e}", f"{i.step:.1e}"
            rows.append((str(i.number), *numbers, str(i.trials), str(i.failed)))
        # The last iteration need not be the best trial, which is the result.
        rows.append(("result", f"{self.objective:.8g}"))
        width = max(len(row[0]) for row in rows if row)
        lines = [f"{row[0]:{width}}" + "".join(f"  {cell:>13}" for cell in row[1:]) if row else "" for row in rows]
        return "\n".join([*(line.rstrip() for line in lines), "", self.message])


@names_arguments
def optimise(
    function: Callable[..., Any],
    start: Mapping[str, VectorLike] | Sequence[str],
    *,
    objective: str | None = None,
    constraints: Mapping[str, tuple[ArrayLike | None, ArrayLike | None] | ArrayLike] | None = None,
    bounds: Mapping[str, Bounds] | None = None,
    system: AbstractSystem | None = None,
    method: str | optax.GradientTransformation = "slsqp",
    starts: int = 1,
    local: int | None = None,
    seed: int = 0,
    max_iterations: int = 200,
    tol: float = 1e-8,
    derivatives: Literal["auto", "forward", "reverse"] = "auto",
) -> Optimum:
    """Find the values of named parameters that make an objective smallest, with constraints on named outputs.

    ```python
    def fall(values):
        motion = jaxmb.simulate(jaxmb.with_parameters(system, values), state, t1=0.4)
        return {"inertia": values["bar.inertia"], "angle": motion["bar"].angle[-1]}

    limits = {"constraints": {"angle": (0.0, None)}, "bounds": {"bar.inertia": (0.01, 1.0)}}
    best = jaxmb.optimise(fall, {"bar.inertia": 0.3}, objective="inertia", **limits)
    best.parameters["bar.inertia"], best.success
    ```

    **Arguments:**

    - `function(values)`: outputs by name, numbers or arrays, from parameters by name; or a number, which is the
        objective. It is made of JAX functions and compiled once. A trial whose `simulate` or `assemble` fails is NaN,
        and steps are shorter.
    - `start`: starting values by name, or names alone of parameters of `system`.
    - `objective`: the output to make small, a number; may be left out if there is but one without a constraint.
    - `constraints`: outputs by name with their bounds `(low, high)`, either of them None, or with the number that they
        equal. Those of an array hold for all its components; bounds may be arrays of its shape.
    - `bounds`: of parameters, `(low, high)` by name, either of them None; numbers, or arrays of the parameter's shape.
    - `system`: a system with design variables, whose bounds and scales are the default, by name. Without a scale a
        parameter is scaled by the distance of its bounds, or its start.

    **The method:**

    - `method`: `"slsqp"` or `"trust-constr"` of SciPy, with bounds and constraints; `"bfgs"` of optimistix or an optax
        optimiser such as `optax.adam(0.02)`, without constraints, which keep bounds by a change of variables.
    - `starts`: a number of starts: the given one, and others that fill the bounds evenly (a Sobol sequence by `seed`).
        All are evaluated in one batch, and the best `local` of them, default four at most, are optimised.
    - `max_iterations`, of each local optimisation; `tol`: the method's tolerance, of the objective relative to its size
        (SLSQP), of the gradient, the barrier and steps (trust-constr), of steps and objective (BFGS), or of a step
        (optax).
    - `derivatives`: `"forward"`, cheaper for few parameters, or `"reverse"`, for many parameters and few outputs.
        `"auto"` chooses by their numbers, among the modes that the function allows. Values and derivatives of all that
        is needed come from one program.

    **Trials that fail**, where the mechanism cannot be assembled, the simulation fails or an output is NaN,
    are rejected: the step is shortened. **A start that fails** needs an output that tells how far it is from one that
    does not, such as `"gap": jaxmb.assembly_gap(…)`, with a constraint, `{"gap": (None, 0)}`: violations of constraints
    that have a value are made small first, until all outputs have one. A gap is zero up to the edge of what can be
    assembled and gives no warning of it: where the best designs lie there, constrain a margin as well, such as the sine
    of the transmission angle.

    **Constraints hold** to a millionth of their bound, or of the distance of both bounds where that is smaller. A bound
    of zero has no size: there it is a millionth of the output at the start, or of its change where a parameter changes
    by its scale, whichever is larger. `Optimum.constraints` has the tolerances.

    **A minimum** is told from a maximum, a saddle and a flat objective by some trials beside the result, which `trials`
    does not count.

    **Returns:** an `Optimum`, the best of all trials whose constraints hold; of `"slsqp"`, where it converged, the last
    one, unless a better one breaks them by no more.

    **Raises:** `ValueError` for unknown names, bounds that are reversed, a start out of bounds, an objective that is no
    number, a function without derivatives, and a start that fails if no constraint leads away from it.
    """
    where = space(start, bounds, system)
    shapes = output_shapes(Program(function, where, (), False))
    function = told_apart(function, where)
    objective = chosen_objective(objective, shapes, constraints)
    limited = limits(constraints, shapes)
    _check(method, limited, starts, local, max_iterations, tol)
    names = (objective, *limited.names)
    program = with_derivatives(Program(function, where, names, False), derivatives, 1 + len(limited.components))
    box = where.box
    first = evaluate(program, np.zeros(where.size))
    before, spent = first, 0
    chosen = [first.z]
    if starts > 1:
        chosen = _best_starts(program, limited, starts, _LOCAL if local is None else local, seed)
    if not chosen or (starts == 1 and not first.good):
        found, spent = _from_nowhere(program, limited, shapes, first, box, max_iterations)
        chosen = [found.z]
    runs = [_run(program, limited, box, z, method, tol, max_iterations) for z in chosen]
    runs.sort(key=lambda run: run[0].merit(run[0].best))
    named = lambda z: {name: np.asarray(value) for name, value in where(jnp.asarray(z)).items()}
    attempts = tuple(
        Attempt(
            named(begin.z),
            named(trials.best.z),
            float(begin.rows[0]),
            float(trials.best.rows[0]),
            trials.violation(trials.best),
            ok,
            message,
        )
        for trials, begin, ok, message in runs
    )
    trials, _, ok, message = runs[0]
    best = trials.best
    balance = balance_at(trials, best)
    slope = np.max(np.abs(trials.start.jacobian[0]), initial=0.0)
    against = None
    if trials.failed > 0 and np.max(np.abs(balance.rest), initial=0.0) > _BALANCED * slope:
        against = "trials fail where the objective decreases: constrain a margin from there"
    elif ok:
        against = objection(lambda z: evaluate(program, z), trials, balance, where.components())
    if against:
        message = against if ok else f"{message}; {against}"
    if spent:
        message = f"{message}; {spent} trials led from the start, which failed, to one that does not"
    if trials.violation(best) > HOLDS:
        worst = limited.worst(best.rows[1:], trials.scales)
        message = f"{message}; constraints are violated, most of all {worst}"
        if ends := where.at_bounds(best.z):
            message = f"{message}, with {', '.join(map(repr, ends))} at a bound"
    rows_before = _rows(before, names)
    columns = (
        limited.components,
        *(limited.low, limited.high, rows_before[1:], best.rows[1:]),
        *(balance.active, np.abs(balance.pull), HOLDS * np.min(trials.scales, axis=0)),
    )
    return Optimum(
        parameters=named(best.z),
        start=named(before.z),
        objective=float(best.rows[0]),
        outputs=best.outputs,
        before=before.outputs or {name: np.full(shape, np.nan) for name, shape in shapes.items()},
        constraints=tuple(
            ConstrainedOutput(own, float(low), float(high), float(a), float(b), bool(on), float(pull), float(within))
            for own, low, high, a, b, on, pull, within in zip(*columns, strict=True)
        ),
        iterations=tuple(trials.log),
        trials=trials.count,
        failed=trials.failed,
        attempts=attempts,
        success=ok and not against and trials.violation(best) <= HOLDS,
        message=message,
        derivatives="forward" if program.forward else "reverse",
    )


def _check(method: Any, limited: Limits, starts: Any, local: Any, max_iterations: Any, tol: Any) -> None:
    known = ("slsqp", "trust-constr", "bfgs")
    if method not in known and not isinstance(method, optax.GradientTransformation):
        raise ValueError(f"method must be {', '.join(map(repr, known))} or an optax optimiser, got {method!r}.")
    if limited.components and method not in known[:2]:
        raise ValueError("Constraints need method='slsqp' or 'trust-constr'.")
    for name, value in (
        ("starts", starts),
        ("max_iterations", max_iterations),
        ("local", 1 if local is None else local),
    ):
        whole_number(name, value)
    if local is not None and local > starts:
        raise ValueError(f"There are {starts} starts, so local can be {starts} at most; got {local}.")
    if not tol > 0:
        raise ValueError(f"tol must be positive, got {tol!r}.")


def _run(program: Program, limited: Limits, box: Any, z: np.ndarray, method: Any, tol: float, limit: int):
    """One local optimisation: its trials, its start, whether it converged, and a message."""
    if isinstance(method, str) and method != "bfgs":
        begin = evaluate(program, z)
        trials = Trials(program, limited, box, begin)
        return trials, begin, *(slsqp if method == "slsqp" else trust_constr)(trials, begin, tol, limit)
    linear: Any = program.space
    here = dataclasses.replace(linear, start=linear.start + linear.scale * jnp.asarray(z))
    free = Program(program.function, here.unbounded(), program.names, program.forward)
    begin = evaluate(free, np.zeros(here.size))
    trials = Trials(free, limited, (np.full(here.size, -np.inf), np.full(here.size, np.inf)), begin)
    ended = bfgs(trials, begin, tol, limit) if method == "bfgs" else first_order(method, trials, begin, tol, limit)
    return _in_space(trials, here, program), dataclasses.replace(begin, z=z), *ended


def _in_space(trials: Trials, here: Space, program: Program) -> Trials:
    """Trials of a change of variables, with the best one as a vector of the space of the program."""
    linear: Any = program.space
    values = trials.program.space(jnp.asarray(trials.best.z))
    flat = np.concatenate([np.ravel(values[name]) for name in here.names])
    z = (flat - np.asarray(linear.start)) / np.asarray(linear.scale)
    trials.best = evaluate(program, z)
    trials.box = linear.box
    return trials


def _best_starts(program: Program, limited: Limits, starts: int, local: int, seed: int) -> list[np.ndarray]:
    """The best of several starts, evaluated at once; none where all fail."""
    linear: Any = program.space
    others = linear.sample(starts - 1, seed)
    z = jnp.concatenate([jnp.zeros((1, linear.size), others.dtype), others])
    rows = np.asarray(rows_of_batch(program, z))
    good = np.all(np.isfinite(rows), axis=1)
    if not good.any():
        return []
    typical = np.median(np.abs(rows[good, 1:]), axis=0)
    scales = np.tile(np.where(typical > 0, typical, 1.0), (2, 1))
    excess = np.array([np.max(limited.excess(r, scales), initial=0.0) for r in rows[:, 1:]])
    order = np.lexsort((rows[:, 0], np.where(excess > HOLDS, excess, 0.0), ~good))
    return [np.asarray(z[k], float) for k in order[:local] if good[k]]


def _from_nowhere(program, limited, shapes, first: Trial, box, most) -> tuple[Trial, int]:
    """From a start that fails to one that does not, by the constraints that have a value there."""
    finite = [name for name in limited.names if name in first.outputs and np.all(np.isfinite(first.outputs[name]))]
    lost = [name for name in program.names if name not in finite]
    named = f"{', '.join(map(repr, lost))} {'is' if len(lost) == 1 else 'are'}" if lost else "derivatives are"
    what = f"At the start {named} not finite"
    cure = (
        "Start elsewhere, or return an output that tells how far the start is from a feasible one, such as "
        "jaxmb.assembly_gap(...), with a constraint: constraints={'gap': (None, 0)}."
    )
    if not finite:
        raise ValueError(f"{what}. {cure}")
    own = np.concatenate([np.full(int(np.prod(shapes[name])), name in finite) for name in limited.names])
    kept = Limits(
        tuple(finite),
        tuple(c for c, k in zip(limited.components, own, strict=True) if k),
        limited.low[own],
        limited.high[own],
    )
    # In forward mode, since a reverse pass through anything that is NaN is NaN, whatever its weight.
    part = Program(program.function, program.space, tuple(finite), True)
    start = evaluate(part, first.z)
    if not start.good or not kept.excess(start.rows, np.ones((2, start.rows.size))).any():
        raise ValueError(f"{what}, and no constraint that is violated leads away from it. {cure}")
    found, spent = first_feasible(part, lambda z: evaluate(program, z), kept, first.z, box, most)
    if found is None:
        raise ValueError(
            f"{what}, and {spent} trials that made {', '.join(finite)} small found no start that is. {cure}"
        )
    return found, spent


def _rows(trial: Trial, names: Sequence[str]) -> np.ndarray:
    if trial.outputs:
        return np.concatenate([np.ravel(trial.outputs[name]) for name in names])
    return trial.rows
