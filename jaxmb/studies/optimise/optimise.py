"""Designs by gradients: the best values of named parameters, with constraints on named outputs."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import ArrayLike

from ..._arguments import package_for_tables, whole_number
from ..._pictured import picture
from ..._printed import Printed
from ..._types import VectorLike
from ...bodies.units import parameter_unit
from ...parts.names import names_arguments
from ...system import AbstractSystem
from ...system.design import Bounds
from ...system.quantities import component_names
from ..told import told_apart
from .constrained import Balance, balance_at, slsqp
from .evaluation import Limits, Program, chosen_objective, limits, output_shapes, with_derivatives
from .space import Space, space
from .starts import starting_points
from .trials import HOLDS, Iteration, Trial, Trials, evaluate
from .unconstrained import first_order
from .verdict import objection

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Gradients below this, relative to the start's, belong to an optimum.
_BALANCED = 1e-3

# The printed first and last lines of the log.
_FIRST, _LAST = 3, 9


@dataclasses.dataclass(frozen=True)
class ConstrainedOutput:
    """A component of a constrained output at the optimum.

    **Fields:**

    - `name`; `low` and `high`: its bounds; `before` and `after`: its values at the start and at the optimum.
    - `active`: whether the value is at a bound.
    - `multiplier` ≥ 0: the gain in the objective per unit by which the active bound is relaxed.
    - `tolerance`: by how much the value may be out of bounds, in the output's unit.
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
    its size, and its status.
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
    best.plot().savefig("optimum.png")
    ```

    **Fields:**

    - `parameters`: the best values by name; `start`: the starting values.
    - `objective`: its value; `outputs`: all outputs by name; `before`: the outputs at the start, not finite if they
        could not be computed.
    - `constraints`: for every component of a constrained output, its bounds, values, whether it is active, and its
        multiplier.
    - `iterations`: the log of the local optimisation that gave the result. A row that is the best so far is "accepted",
        another one is only "tried".
    - `trials`: the number of its trials with derivatives; `failed`: the number of failed trials.
    - `attempts`: all local optimisations, the best first, if there were several.
    - `success`: whether the method converged to a minimum and all constraints hold within their `tolerance`. A maximum,
        a saddle, a step of the objective, and an edge beyond which trials fail or the objective leaps up are not
        minima; `message`: why the method ended.
    - `derivatives`: the mode, `"forward"` or `"reverse"`; `units` of the components of the parameters by name, where
        `optimise` was given their `system`.
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
    units: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @property
    def components(self) -> list[tuple[str, float, float]]:
        """The components of the parameters: their names, and their values at start and optimum."""
        return [
            (name, float(a), float(b))
            for key, value in self.parameters.items()
            for name, a, b in zip(component_names(key, value.shape), self.start[key].flat, value.flat, strict=True)
        ]

    def plot(
        self, *outputs: str, along: Mapping[str, Any] | None = None, units: Mapping[str, str] | None = None
    ) -> "Figure":
        """Plot the objective along the iterations, and the parameters before and after; or outputs before and after.

        **Arguments:** `outputs` by name, to show instead; `along`: the label and the values of their horizontal axis,
        `{"t [s]": ts}`, default the numbers of the components; `units` of outputs by name. Bounds that hold for all
        components are dotted lines.

        **Returns:** a matplotlib `Figure`. Parameters are drawn relative to the larger of start and optimum.

        **Raises:** `ValueError` for an unknown output, and values of another number; `ImportError` without matplotlib.
        """
        return picture("optimum.plot", self, outputs, along, units)

    def to_pandas(self) -> Any:
        """A `pandas.DataFrame` with a row for each component of the parameters: `start` and `optimum`.

        **Raises:** `ImportError` without pandas.
        """
        names, *numbers = zip(*self.components, strict=True)
        frame = package_for_tables("pandas", "pandas").DataFrame
        return frame(dict(zip(("start", "optimum"), numbers, strict=True)), index=list(names))

    def __repr__(self) -> str:
        return f"Optimum: objective {self.objective:.6g}, {self.message}"

    def __str__(self) -> str:
        numbers = lambda *given: tuple(f"{float(x):.6g}" for x in given)
        rows: list[tuple[str, ...]] = [("parameter", "start", "optimum", "unit" * bool(self.units))]
        rows += [(word, *numbers(a, b), self.units.get(word, "")) for word, a, b in self.components]
        rows += [(), ("output", "before", "after")]
        rows += [(name, *numbers(self.before[name], x)) for name, x in self.outputs.items() if x.ndim == 0]
        if self.constraints:
            rows += [(), ("constraint", "before", "after", "low", "high", "within", "multiplier")]
        for c in self.constraints:
            shown = f"{c.multiplier:.3g}" if c.active else ""
            rows.append((c.name, *numbers(c.before, c.after, c.low, c.high), f"{c.tolerance:.1g}", shown))
        if len(self.attempts) > 1:
            rows += [(), ("attempt", "before", "after", "violation")]
            each = enumerate(self.attempts, 1)
            rows += [
                (str(k), *numbers(attempt.before, attempt.after), f"{attempt.violation:.1e}") for k, attempt in each
            ]
        rows += [(), ("iteration", "objective", "violation", "step", "trials", "failed", "")]
        log = [
            (
                *(str(i.number), f"{i.objective:.8g}", f"{i.violation:.1e}", f"{i.step:.1e}"),
                *(str(i.trials), str(i.failed), "accepted" if i.accepted else "tried"),
            )
            for i in self.iterations
        ]
        rows += [*log[:_FIRST], ("…",), *log[-_LAST:]] if len(log) > _FIRST + _LAST else log
        # The last iteration need not be the best trial, which is the result.
        rows.append(("result", f"{self.objective:.8g}"))
        width = max(len(row[0]) for row in rows if row)
        lines = [f"{row[0]:{width}}" + "".join(f"  {cell:>13}" for cell in row[1:]) if row else "" for row in rows]
        return "\n".join([*(line.rstrip() for line in lines), "", self.message])


_GONE = {
    "local": "the best four of several starts are optimised",
    "derivatives": "the cheaper mode that the function allows is chosen",
}


@functools.partial(names_arguments, gone=_GONE)
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
    seed: int = 0,
    max_iterations: int = 200,
    tol: float = 1e-8,
) -> Optimum:
    """Find the values of named parameters that minimise an objective, with constraints on named outputs.

    ```python
    def fall(values):
        motion = jaxmb.simulate(jaxmb.with_parameters(system, values), state, t1=0.4)
        return {"inertia": values["bar.inertia"], "angle": motion["bar"].angle[-1]}

    limits = {"constraints": {"angle": (0.0, None)}, "bounds": {"bar.inertia": (0.01, 1.0)}}
    best = jaxmb.optimise(fall, {"bar.inertia": 0.3}, objective="inertia", **limits)
    best.parameters["bar.inertia"], best.success
    ```

    **Arguments:**

    - `function(values)`: outputs by name, numbers or arrays, from parameters by name; or a number, the objective. It
        consists of JAX functions and is compiled once. A trial whose `simulate` or `assemble` fails is NaN and shortens
        the step.
    - `start`: starting values by name, or names alone of parameters of `system`.
    - `objective`: the output to minimise, a number; may be left out if only one output has no constraint.
    - `constraints`: bounds `(low, high)` of outputs by name, either of them None, or the number that the output equals.
        They hold for all components of an array; bounds may be arrays of its shape.
    - `bounds`: of parameters, `(low, high)` by name, either of them None; numbers, or arrays of the parameter's shape.
    - `system`: a system with design variables, whose bounds and scales are the default, by name. Without a scale a
        parameter is scaled by the distance of its bounds, or its start.

    **The method:**

    - `method`: `"slsqp"` of SciPy, with bounds and constraints (a BFGS method without them); or an optax optimiser such
        as `optax.adam(0.02)`, without constraints, which keeps bounds by a change of variables.
    - `starts`: the number of starts: the given start, and others that fill the bounds evenly (a Sobol sequence by
        `seed`). All are evaluated in one batch, and the best four are optimised.
    - `max_iterations`, of each local optimisation; `tol`: the method's tolerance, of the objective relative to its size
        (SLSQP), or of a step (optax).

    One program computes all values and derivatives: in forward mode for few parameters, in reverse mode for many
    parameters and few outputs.

    **A trial fails** if the mechanism cannot be assembled, the simulation fails or an output is NaN; the trial is
    rejected, and the step shortened. **A start that fails** needs an output that measures its distance from a feasible
    start, such as `"gap": jaxmb.assembly_gap(…)`, with a constraint, `{"gap": (None, 0)}`. Violations of finite
    constraints are reduced first, until all outputs are finite. A gap is zero up to the edge of feasible designs,
    without a warning: if the best designs lie there, constrain a margin as well, such as the sine of the transmission
    angle.

    **Constraints hold** to a millionth of their bound, or of the distance of both bounds if smaller. To a bound of
    zero, they hold to a millionth of the output at the start or, if larger, of its change when a parameter changes by
    its scale. `Optimum.constraints` has the tolerances.

    **A minimum** is distinguished from a maximum, a saddle and a flat objective by some trials beside the result, which
    `trials` does not count.

    **Returns:** an `Optimum`: the feasible trial (violation ≤ 1e-6 of the bound) with the smallest objective. If SLSQP
    converged, it is its final point, unless another trial is better and no less feasible.

    **Raises:** `ValueError` for unknown names, reversed bounds, a start out of bounds, an objective that is not a
    number, a function without derivatives, and a start that fails if no constraint leads away from it.
    """
    where = space(start, bounds, system)
    shapes = output_shapes(Program(function, where, (), False))
    objective = chosen_objective(objective, shapes, constraints)
    limited = limits(constraints, shapes)
    _check(method, limited, starts, max_iterations, tol)
    program = Program(told_apart(function, where, jnp.zeros(where.size)), where, (objective, *limited.names), False)
    program = with_derivatives(program, 1 + len(limited.components))
    first = evaluate(program, np.zeros(where.size))
    points, spent = starting_points(program, limited, first, shapes, starts, seed, max_iterations)
    runs = [_run(program, limited, z, method, tol, max_iterations) for z in points]
    runs.sort(key=lambda run: run.trials.merit(run.trials.best))
    best = _optimum(first, shapes, runs, spent)
    found = {name: "" if system is None else parameter_unit(system, name) for name, *_ in best.components}
    return dataclasses.replace(best, units={name: unit for name, unit in found.items() if unit})


class _Run(NamedTuple):
    """A local optimisation: its trials, whether the method converged, and its message."""

    trials: Trials
    ok: bool
    message: str


def _run(program: Program, limited: Limits, z: np.ndarray, method: Any, tol: float, limit: int) -> _Run:
    begin = evaluate(program, z)
    trials = Trials(program, limited, begin)
    if isinstance(method, str):
        return _Run(trials, *slsqp(trials, begin, tol, limit))
    return _Run(trials, *first_order(method, trials, begin, tol, limit))


def _check(method: Any, limited: Limits, starts: Any, max_iterations: Any, tol: Any) -> None:
    optax_s = isinstance(method, optax.GradientTransformation)
    if method != "slsqp" and not optax_s:
        instead = "; it is 'slsqp' now" if method in ("bfgs", "trust-constr") else ""
        raise ValueError(f"method must be 'slsqp' or an optax optimiser, got {method!r}{instead}.")
    if limited.components and optax_s:
        raise ValueError("Constraints need method='slsqp'.")
    for name, value in (("starts", starts), ("max_iterations", max_iterations)):
        whole_number(name, value)
    if not tol > 0:
        raise ValueError(f"tol must be positive, got {tol!r}.")


def _optimum(first: Trial, shapes: Mapping[str, tuple[int, ...]], runs: list[_Run], spent: int) -> Optimum:
    """The result. `first`: the trial at the start; `runs`: the best first; `spent`: the number of trials that led from
    a failed start.
    """
    trials, ok, message = runs[0]
    best, program = trials.best, trials.program
    balance = balance_at(trials, best)
    against = _against(trials, ok, balance)
    if against:
        message = against if ok else f"{message}; {against}"
    if spent:
        message = f"{message}; {spent} trials led from the failed start to a valid start"
    holds = trials.violation(best) <= HOLDS
    if not holds:
        message += f"; constraints are violated, most of all {trials.limits.worst(best.rows[1:], trials.scales)}"
        if ends := program.space.at_bounds(best.z):
            message = f"{message}, with {', '.join(map(repr, ends))} at a bound"
    return Optimum(
        parameters=_named(program.space, best.z),
        start=_named(program.space, first.z),
        objective=float(best.rows[0]),
        outputs=best.outputs,
        before=first.outputs or {name: np.full(shape, np.nan) for name, shape in shapes.items()},
        constraints=_constraints(trials, balance, first),
        iterations=tuple(trials.log),
        trials=trials.count,
        failed=trials.failed,
        attempts=tuple(_attempt(run) for run in runs),
        success=ok and not against and holds,
        message=message,
        derivatives="forward" if program.forward else "reverse",
    )


def _against(trials: Trials, ok: bool, balance: Balance) -> str | None:
    """The objection to the best trial, or None."""
    slope = np.max(np.abs(trials.start.jacobian[0]), initial=0.0)
    if trials.failed > 0 and np.max(np.abs(balance.rest), initial=0.0) > _BALANCED * slope:
        return "trials fail where the objective decreases: constrain a margin from there"
    program = trials.program
    return objection(lambda z: evaluate(program, z), trials, balance, program.space.components()) if ok else None


def _named(where: Space, z: np.ndarray) -> dict[str, np.ndarray]:
    return {name: np.asarray(value) for name, value in where(jnp.asarray(z)).items()}


def _attempt(run: _Run) -> Attempt:
    trials, start, best = run.trials, run.trials.start, run.trials.best
    where = trials.program.space
    return Attempt(
        start=_named(where, start.z),
        parameters=_named(where, best.z),
        before=float(start.rows[0]),
        after=float(best.rows[0]),
        violation=trials.violation(best),
        success=run.ok,
        message=run.message,
    )


def _constraints(trials: Trials, balance: Balance, first: Trial) -> tuple[ConstrainedOutput, ...]:
    """The components of constrained outputs at the best trial, and at the first trial."""
    limited, before = trials.limits, first.rows
    if first.outputs:
        before = np.concatenate([np.ravel(first.outputs[name]) for name in trials.program.names])
    columns = (
        limited.components,
        *(limited.low, limited.high, before[1:], trials.best.rows[1:]),
        *(balance.active, np.abs(balance.pull), HOLDS * np.min(trials.scales, axis=0)),
    )
    return tuple(
        ConstrainedOutput(component, float(low), float(high), float(a), float(b), bool(on), float(pull), float(within))
        for component, low, high, a, b, on, pull, within in zip(*columns, strict=True)
    )
