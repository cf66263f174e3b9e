"""Optimal control: controls, duration and parameters of a motion between two ends that minimise an objective."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import ArrayLike

from ..._arguments import check_kind, real_array, whole_number
from ..._traced_functions import traced_by_jax
from ..._types import State
from ...parts.names import names_arguments
from ...simulate.arguments import checked_state
from ...states.consistency import consistent
from ...system import AbstractSystem
from ...system.design import Bounds
from ..evaluate import Reading
from ..told import told_apart
from .guess import first_guess
from .result import Plan, judged
from .solve import Iteration, arcs_of, solved
from .task import (
    Effort,
    Task,
    checked_controls,
    checked_design,
    checked_duration,
    checked_limits,
    checked_shares,
)

_OBJECTIVES = "running= a function of the instant or 'effort', or final= a function of the end or 'time'"


@names_arguments
def plan(
    system: AbstractSystem,
    *,
    controls: Mapping[str, Bounds | None],
    duration: float | tuple[float, float],
    start: State | Mapping[str, Any],
    end: State | Mapping[str, Any] | None = None,
    running: Callable[..., Any] | Literal["effort"] | None = None,
    final: Callable[..., Any] | Literal["time"] | None = None,
    path: Mapping[str, Any] | None = None,
    design: Mapping[str, Bounds] | None = None,
    periodic: bool = False,
    intervals: int | ArrayLike = 32,
    interpolation: Literal["held", "linear", "cubic"] = "linear",
    moving: bool = False,
    guess: Any = None,
    t0: float = 0.0,
    method: Literal["ipopt", "slsqp"] | None = None,
    max_iterations: int = 300,
    tol: float = 1e-8,
    verbose: bool = False,
) -> Plan:
    """Find the best controls of a machine between two ends: optimal control, also over closed loops and rolling.

    ```python
    rest = {"pin.angle": 0.0, "pin.angle_rate": 0.0}
    turned = {"pin.angle": 1.0, "pin.angle_rate": 0.0}
    best = jaxmb.plan(system, controls={"motor.force": (-2, 2)}, duration=1.0, start=rest, end=turned, running="effort")
    best.objective, best.controls["motor.force"]
    ```

    The objective is the integral of `running` plus `final`; it is minimised by multiple shooting. The unknowns of each
    node are independent coordinates and rates, so every state is on the constraints.

    **Arguments:**

    - `controls`: bounds `(low, high)` of parameters that become functions of time, either of them None, or None
        without bounds; parameters of forces as of `with_inputs`. `{}` with a `design` alone.
    - `duration` [s]: a number, or bounds `(low, high)` of a free duration.
    - `start`, `end`: a `State`, whose independent coordinates and rates are given; or by name values, or bounds `(low,
        high)`, of quantities as `evaluate` knows them: `{"pin.angle": 1.0, "pin.angle_rate": 0.0}`. Others are free.
        For vectors of two components `(x, y)` is the value, and `((x, y), (x, y))` are bounds. Angles of joints in
        space count turns from the start on, as in a motion.
    - `running`: a function of the instant by names, `lambda at: at["motor.force"] ** 2`; or `"effort"`, the sum of the
        squares of the controls.
    - `final`: a function of the end, `lambda at: -at["tip.position"][0]`; or `"time"`, the duration.
    - `path`: bounds of quantities along the way, `{"A.force": (-500.0, 500.0)}`; they hold at nodes, and
        `Plan.violation` tells what happens between nodes.
    - `design`: bounds of parameters that are constant, and optimised as well.
    - `periodic`: whether the end is the start, up to turns of angles.

    **The method:**

    - `intervals`: their number, or the nodes as ascending shares of the duration from 0 to 1.
    - `interpolation` of controls: `"held"`, constant on each interval; `"linear"`; `"cubic"`, with continuous rates.
        Their bounds hold between nodes, too.
    - `moving`: whether nodes then move to where controls jump; the others stay evenly between them. For least time,
        with `"held"`.
    - `guess`: values or functions of time by name, of coordinates, controls, designed parameters and `"duration"`; or a
        `Trajectory`; or `required_forces` of a motion by the names of controls, which are then feasible; or another
        `Plan`. By default coordinates go straight from start to end, and controls have the values of the system.
    - `t0` [s]: the time of the start.
    - `method`: `"ipopt"`, with exact derivatives (the default if `ipyopt` is installed, by the extra `plan`); or
        `"slsqp"` of SciPy for small plans.
    - `max_iterations`; `tol`: the tolerance of conditions in units of typical changes, of the objective, and of the
        errors of integration; `verbose`: whether to print a line for each iteration.

    The optimum is local: another guess may lead to another one. Ctrl-C ends the iteration, and the plan so far is
    returned. Contacts and dry friction keep the modes of the start; the plan says whether they would change.

    **Returns:** a `Plan`. `success` is False, and `message` says why, if the method did not converge.

    **Raises:** `ValueError` for unknown names, reversed bounds, ends that contradict the constraints, conditions that
    depend on each other, and a guess that cannot be integrated.
    """
    task = task_of(
        system,
        controls=controls,
        duration=duration,
        ends=(start, {} if end is None else end),
        objective=(running, final),
        path=path,
        design=design,
        periodic=periodic,
        nodes=(intervals, interpolation),
        t0=t0,
    )
    check_minimised([(running, final)])
    if moving and interpolation != "held":
        raise ValueError(
            f"plan: moving nodes need controls that jump: take interpolation='held', got {interpolation!r}."
        )
    options = method_options(method, max_iterations, tol, verbose)
    (solution,) = solved([task], [first_guess(task, guess)], *options)
    if moving and solution.answer.success:
        first, task = solution.iterations, dataclasses.replace(task, arcs=arcs_of(task, solution.found))
        (solution,) = solved([task], [solution.found], *options)
        solution = dataclasses.replace(solution, iterations=(*first, *solution.iterations))
    return judged(Plan.of(solution, method, tol))


def method_options(method: Any, max_iterations: Any, tol: Any, verbose: bool) -> tuple[Any, int, float, Any]:
    """The checked options of `solved`."""
    whole_number("plan: max_iterations", max_iterations)
    if not real_array("plan: tol", tol, float) > 0:
        raise ValueError(f"plan: tol must be positive, got {tol!r}.")
    return method, max_iterations, tol, _print if verbose else lambda iteration: None


def check_minimised(objectives: Sequence[tuple[Any, Any]]) -> None:
    """Refuse objectives of phases, `(running, final)`, of another kind, or none at all."""
    if all(running is None and final is None for running, final in objectives):
        raise ValueError(f"plan: there is nothing to minimise; give {_OBJECTIVES}.")
    for running, final in objectives:
        for given, word in ((running, "effort"), (final, "time")):
            if not (given is None or given == word or callable(given)):
                raise ValueError(f"plan: give {_OBJECTIVES}; got {given!r}.")


def _told(system: AbstractSystem, where: str, function: Any, others: Any) -> Any:
    """A user's function of the instant, compared by its program; words as they are.

    **Raises:** `ValueError` for a value that is no number.
    """
    if not callable(function):
        return function
    numbers, rest = eqx.partition(system, eqx.is_array)
    state = State(jnp.zeros(system.nq), jnp.zeros(system.nu), jnp.zeros(system.nz) if system.nz else None)

    def number(at):
        value: Any = function(at)
        if value is None or jnp.shape(value):
            got = "nothing" if value is None else f"shape {jnp.shape(value)}"
            raise ValueError(f"plan: {where}= must return a number, and returns {got}.")
        return value

    seen = lambda numbers, state, t, given: Reading(eqx.combine(numbers, rest), state, t, given)
    with traced_by_jax("the objective of plan", "the instant"):
        return told_apart(number, seen, numbers, state, jnp.zeros(()), others)


def _print(iteration: Iteration) -> None:
    number, objective, violation, seconds = iteration
    print(f"{number:4d}  objective {objective:16.9g}  violation {violation:8.1e}  {seconds:7.1f} s", flush=True)


def task_of(
    system: AbstractSystem,
    *,
    controls: Any,
    duration: Any,
    ends: tuple[Any, Any],
    objective: tuple[Any, Any],
    path: Any = None,
    design: Any = None,
    periodic: bool = False,
    nodes: tuple[Any, Any],
    t0: Any = 0.0,
) -> Task:
    """The checked task of the arguments of `plan`."""
    check_kind("plan: system", system, AbstractSystem, "a compiled scene", "use scene.compile()")
    intervals, interpolation = nodes
    chosen, control_bounds = checked_controls(system, controls, interpolation)
    shapes, design_bounds = checked_design(system, design, chosen)
    if not (chosen or shapes):
        raise ValueError("plan: there is nothing to choose; give controls={'motor.force': (-2.0, 2.0)} or design=.")
    others = {control.name: jnp.zeros(control.shape) for control in chosen}
    others |= {name: jnp.zeros(shape) for name, shape in shapes} | {"time": jnp.zeros(())}
    start, end = (
        consistent(system, t0, checked_state(system, given))
        if isinstance(given, State)
        else checked_limits(system, where, given, others)
        for where, given in zip(("start", "end"), ends, strict=True)
    )
    each = zip(("running", "final"), objective, strict=True)
    running, final = (_told(system, where, given, others) for where, given in each)
    shares = checked_shares(intervals)
    return Task(
        system=system,
        controls=chosen,
        control_bounds=control_bounds,
        design=shapes,
        design_bounds=design_bounds,
        t0=float(real_array("plan: t0", t0, float)),
        duration=checked_duration(duration),
        shares=shares,
        arcs=(0, len(shares) - 1),
        start=start,
        end=end,
        path=checked_limits(system, "path", path, others),
        running=Effort(tuple(control.name for control in chosen)) if running == "effort" else running,
        final=None if final == "time" else final,
        of_time=float(final == "time"),
        periodic=bool(periodic),
    )
