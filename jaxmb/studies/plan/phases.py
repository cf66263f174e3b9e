"""Optimal control in phases with different systems: a load is picked up, a joint locks."""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import ArrayLike

from ..._arguments import check_kind
from ..._printed import Printed
from ..._types import State
from ...parts.names import names_arguments
from ...system import AbstractSystem
from ...system.design import Bounds
from .guess import carried, first_guess
from .plan import check_minimised, method_options, task_of
from .result import Plan, judged
from .solve import Iteration, solved

# The largest distance of states where phases meet, relative to the size of the system.
_APART = 1e-6


@dataclasses.dataclass(frozen=True)
class Phase:
    """A part of a motion with a system of its own, for `plan_phases`.

    ```python
    swing = jaxmb.Phase(system, controls={"motor.force": (-2, 2)}, duration=0.5, running="effort")
    ```

    **Fields:** as the arguments of `plan`; `end`: what holds at the end of this phase, besides the `end=` of the plan.
    Time begins with `t0` = 0 in each phase.
    """

    system: AbstractSystem
    _: dataclasses.KW_ONLY
    controls: Mapping[str, Bounds | None]
    duration: float | tuple[float, float]
    end: Mapping[str, Any] | None = None
    running: Callable[..., Any] | Literal["effort"] | None = None
    final: Callable[..., Any] | Literal["time"] | None = None
    path: Mapping[str, Any] | None = None
    intervals: int | ArrayLike = 16
    interpolation: Literal["held", "linear", "cubic"] = "linear"
    guess: Any = None


@dataclasses.dataclass(frozen=True, repr=False)
class PhasedPlan(Printed):
    """The result of `plan_phases`: a `Plan` for each of the `phases`; `print` shows them.

    ```python
    print(both)  # For `both` from `plan_phases`.
    both.objective, both.phases[1].controls["motor.force"]
    ```

    **Fields:** the whole `objective` and `duration` [s]; `iterations`, `success` and `message` as of a `Plan`.
    """

    phases: tuple[Plan, ...]
    objective: float
    duration: float
    iterations: tuple[Iteration, ...]
    success: bool
    message: str

    def __repr__(self) -> str:
        return f"PhasedPlan: objective {self.objective:.6g}, {len(self.phases)} phases, {self.message}"

    def __str__(self) -> str:
        parts = [f"phase {k}\n{phase}" for k, phase in enumerate(self.phases, 1)]
        return "\n\n".join([f"objective {self.objective:.9g}, duration {self.duration:.9g} s", *parts])


@names_arguments
def plan_phases(
    phases: Sequence[Phase],
    *,
    start: State | Mapping[str, Any],
    end: State | Mapping[str, Any] | None = None,
    method: Literal["ipopt", "slsqp"] | None = None,
    max_iterations: int = 300,
    tol: float = 1e-8,
    verbose: bool = False,
) -> PhasedPlan:
    """Find the best controls of a motion in phases, each with a system of its own, as one optimum.

    ```python
    swing = jaxmb.Phase(system, controls={"motor.force": (-2, 2)}, duration=0.5, running="effort", intervals=4)
    rest, turned = ({"pin.angle": angle, "pin.angle_rate": 0.0} for angle in (0.0, 1.0))
    best = jaxmb.plan_phases([swing, swing], start=rest, end=turned)
    best.objective, best.phases[0].controls["motor.force"]
    ```

    Each phase begins where the last ended: independent coordinates of the last system have the same values in the next
    system, by their names. If both have the same bodies, constraints that take hold with the next phase exert their
    ideal impulses, and velocities jump: a load is caught. Otherwise rates have the same values by their names. The next
    system has no further freedoms. The durations of phases may be free, and so their ends.

    **Arguments:** `start` of the first phase and `end` of the last phase, and the others, as of `plan`.

    **Raises:** `ValueError` as `plan`, and for a system that lacks the coordinates of the last.
    """
    phases = list(phases)
    for k, phase in enumerate(phases):
        check_kind(f"plan_phases: phase {k}", phase, Phase, "a jaxmb.Phase", "make it of a system and its options")
    if not phases:
        raise ValueError("plan_phases: give at least one jaxmb.Phase.")
    check_minimised([(phase.running, phase.final) for phase in phases])
    options, tasks, guesses = method_options(method, max_iterations, tol, verbose), [], []
    for k, phase in enumerate(phases):
        last = k == len(phases) - 1
        if last and end is not None and phase.end is not None:
            raise ValueError("plan_phases: the last phase has an end=, and the plan another one; give one of them.")
        there = end if last and end is not None else phase.end
        task = task_of(
            phase.system,
            controls=phase.controls,
            duration=phase.duration,
            ends=({} if k else start, {} if there is None else there),
            objective=(phase.running, phase.final),
            path=phase.path,
            nodes=(phase.intervals, phase.interpolation),
        )
        begin = None
        if k:
            state = jax.tree.map(lambda y: y[-1], guesses[-1].states)
            begin = carried(phases[k - 1].system, state, phase.system, 0.0)
        tasks.append(task)
        guesses.append(first_guess(task, phase.guess, begin))
    solutions = solved(tasks, guesses, *options)
    plans = tuple(judged(Plan.of(solution, method, tol)) for solution in solutions)
    failed = next((one for one in plans if not one.success), plans[0])
    message = failed.message if not failed.success else _jumps(plans) or failed.message
    return PhasedPlan(
        phases=plans,
        objective=sum(one.objective for one in plans),
        duration=sum(one.duration for one in plans),
        iterations=solutions[0].iterations,
        success=message == plans[0].message and failed.success,
        message=message,
    )


def _jumps(plans: Sequence[Plan]) -> str:
    """What is wrong where phases meet: positions of bodies that would jump, "" if there are none."""
    for k, (before, after) in enumerate(itertools.pairwise(plans), 1):
        names = before.system.coordinate_names()
        if names != after.system.coordinate_names():
            continue
        apart = np.abs(np.asarray(after.states.q[0]) - np.asarray(before.states.q[-1]))
        worst = int(np.argmax(apart / np.asarray(before.system.coordinate_scale())))
        if apart[worst] > _APART * np.asarray(before.system.coordinate_scale())[worst]:
            name = next(name for name, places in names.items() if list(places) == [worst])
            where = f"{name!r} jumps by {apart[worst]:.3g} between phases {k} and {k + 1}"
            return f"{where}: give the place where they meet as the end= of the first"
    return ""
