"""The result of a plan: states, controls, prices of conditions, and a check by one simulation."""

import dataclasses
import functools
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from ..._pictured import picture
from ..._printed import Printed
from ..._types import State
from ...linalg.arrays import is_traced
from ...linalg.jitted import jitted
from ...parts.series import Series
from ...simulate.simulate import simulate
from ...system import AbstractSystem, with_inputs, with_parameters
from ...trajectory import Trajectory
from ..evaluate import Reading
from .guess import Guess, first_guess
from .lanes import Model, by_name
from .sensitivity import Sensitivity, derivatives, sensitivities
from .solve import Iteration, Solution, solved
from .task import Named, Task

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Saved times in each interval, and the tolerance of the simulation that checks a plan.
_SAVED, _CHECK = 8, 1e-10
# The distance from the end, relative to typical changes, at which a simulation arrives there.
_ARRIVES = 1e-5
# The distance from a bound, relative to typical changes, at which a value is at the bound.
_AT_BOUND = 1e-6
# The largest number of iterations when a plan is found again for other parameters.
_LIMIT = 300


@dataclasses.dataclass(frozen=True, repr=False)
class Plan(Printed):
    """An optimal motion, the result of `plan`; `print` shows a table.

    ```python
    print(best)  # Tables of controls, prices and bounds, for `best` from `plan`.
    motion = jaxmb.simulate(best.system, start, t1=1.0, inputs=best.controls)
    best.prices["end pin.angle"], best.derivatives("bar.mass"), best.arrival
    ```

    **Fields:**

    - `objective`; `duration` [s]; `ts` [s]: the times of the nodes, and `states` there, stacked along axis 0.
    - `controls`: functions of time by name, `Series` for `simulate(…, inputs=plan.controls)`.
    - `parameters`: the optimised parameters by name; `system`: the system with them.
    - `prices`: the growth of the objective per unit by which a value given at an end grows, or a bound along the way
        (the extreme over the nodes), by name; of a fixed start or end `State` by coordinate.
    - `active`: names of controls, parameters and times that are at a bound somewhere, and of bounds along the way.
    - `iterations`: the log of the method. `success`: whether the method converged; `message`: why it ended.
    - `integration_error`: the largest error of an interval's end, relative to typical changes.
    """

    system: AbstractSystem
    objective: float
    ts: np.ndarray
    states: State
    controls: dict[str, Series]
    parameters: dict[str, np.ndarray]
    prices: dict[str, np.ndarray]
    active: tuple[str, ...]
    iterations: tuple[Iteration, ...]
    success: bool
    message: str
    integration_error: float
    solution: Solution
    method: str | None
    tol: float

    @classmethod
    def of(cls, solution: Solution, method: str | None, tol: float) -> "Plan":
        """The plan of a solution."""
        task, found = solution.transcription.task, solution.found
        design = Model(task.system, task.controls, task.design)
        numbers = [x.reshape(-1, *c.shape) for c, x in zip(task.controls, found.controls, strict=True)]
        each = zip(task.controls, numbers, strict=True)
        problem = solution.transcription.problem
        return cls(
            system=design.designed(jnp.asarray(found.design)),
            objective=float(problem.at(solution.answer.z).rows[0])
            + (0.0 if task.timed else task.of_time * task.duration[0]),
            ts=found.ts,
            states=found.states,
            controls={control.name: control.course.series(found.ts, own) for control, own in each},
            parameters=by_name(task.design, found.design),
            prices=_prices(solution),
            active=_active(solution),
            iterations=solution.iterations,
            success=solution.answer.success,
            message=solution.answer.message,
            integration_error=solution.error,
            solution=solution,
            method=method,
            tol=tol,
        )

    @property
    def duration(self) -> float:
        """The time from start to end [s]."""
        return float(self.ts[-1] - self.ts[0])

    @functools.cached_property
    def trajectory(self) -> Trajectory:
        """One simulation from the start through all intervals with the found controls."""
        start = jax.tree.map(lambda y: y[0], self.states)
        times = np.interp(
            np.linspace(0, len(self.ts) - 1, _SAVED * (len(self.ts) - 1) + 1), range(len(self.ts)), self.ts
        )
        return simulate(
            with_inputs(self.system, self.controls),
            start,
            t0=self.ts[0],
            t1=self.ts[-1],
            saveat=times,
            rtol=_CHECK,
            throw=False,
        )

    @functools.cached_property
    def arrival(self) -> float:
        """The distance of the end of `trajectory` from the plan's end, relative to the largest coordinates and
        velocities, or to such coordinates in the duration.
        """
        end, there = (jax.tree.map(lambda y: np.asarray(y[-1]), ys) for ys in (self.trajectory.ys, self.states))
        q, u = (max(float(np.max(np.abs(x), initial=0.0)), 1e-300) for x in (self.states.q, self.states.u))
        each = (end.q, there.q, q), (end.u, there.u, max(u, q / self.duration))
        return float(max(np.max(np.abs(a - b), initial=0.0) / scale for a, b, scale in each))

    @functools.cached_property
    def violation(self) -> dict[str, float]:
        """The largest violation of each bound along the way, at nodes, just before them and at seven times between, in
        its unit; zero within.
        """
        limits, ts, ys = self.solution.transcription.task.path, self.trajectory.ts, self.trajectory.ys
        if not limits.names:
            return {}
        quantities, nodes = Named(limits.names), np.arange(_SAVED, len(ts), _SAVED)
        values = np.asarray(_along(self.system, quantities, ts, ys, self.along))
        if any(not control.course.continuous for control in self.solution.transcription.task.controls):
            before = {name: np.asarray(series.values)[:-1] for name, series in self.controls.items()}
            at_nodes = jax.tree.map(lambda y: y[nodes], ys)
            values = np.concatenate([values, _along(self.system, quantities, ts[nodes], at_nodes, before)])
        excess = np.maximum(np.maximum(limits.low - values, values - limits.high), 0.0)
        return dict(zip(limits.components, map(float, np.max(excess, axis=0)), strict=True))

    @functools.cached_property
    def along(self) -> dict[str, np.ndarray]:
        """The controls by name at the times of `trajectory`."""
        return {name: np.asarray(jax.vmap(series)(self.trajectory.ts)) for name, series in self.controls.items()}

    @property
    def bounds(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """The bounds of controls and of quantities along the way, by name; infinite where there is none."""
        task = self.solution.transcription.task
        controls = zip((control.name for control in task.controls), task.control_bounds, strict=True)
        return {**dict(controls), **task.path.by_name()}

    def plot(self, *names: str) -> "Figure":
        """Plot the controls with their bounds over time, and further quantities of the motion by name.

        **Returns:** a matplotlib `Figure`.

        **Raises:** `ValueError` for an unknown name; `ImportError` without matplotlib.
        """
        return picture("plan.plot", self, names)

    def derivatives(self, *names: str) -> dict[str, np.ndarray]:
        """The derivatives of the objective by parameters of the system, or by a fixed `"duration"`, at the optimum.

        They follow from the multipliers (the envelope theorem), so no motion is optimised again.

        **Raises:** `ValueError` for an unknown parameter, and for one that is optimised itself.
        """
        return derivatives(self.solution, names)

    def sensitivities(self, *names: str) -> dict[str, Sensitivity]:
        """The derivatives of the optimum by parameters of the system, or by a fixed `"duration"`: of controls, duration
        and designed parameters, by the optimality conditions with the active bounds as they are.

        **Raises:** as `derivatives`.
        """
        self._check_alone("sensitivities")
        return sensitivities(self.solution, names)

    def refined(self) -> "Plan":
        """The plan on twice the intervals, found from this plan: the change of the objective tells its error.

        **Raises:** `ValueError` for a part of a `PhasedPlan`, whose ends belong to other phases.
        """
        self._check_alone("refined")
        task, nodes = self.solution.transcription.task, np.arange(len(self.ts))
        shares = np.interp(np.arange(2 * len(nodes) - 1) / 2, nodes, (self.ts - self.ts[0]) / self.duration)
        finer = dataclasses.replace(task, shares=shares, arcs=tuple(2 * node for node in task.arcs))
        return self._found_again(finer, first_guess(finer, self))

    def _check_alone(self, what: str) -> None:
        if not self.solution.alone:
            raise ValueError(f"Plan.{what}: this is a phase of a plan; take the whole plan again by plan_phases.")

    def _found_again(self, task: Task, guess: Guess) -> "Plan":
        (again,) = solved([task], [guess], self.method, _LIMIT, self.tol, lambda _: None)
        return judged(Plan.of(again, self.method, self.tol))

    def objective_of(self, values: Mapping[str, Any]) -> Any:
        """The optimal objective for other parameters of the system, found from this plan; differentiable by `jax.grad`.

        ```python
        slope = jax.grad(lambda mass: best.objective_of({"bar.mass": mass}))(1.2)
        ```

        Derivatives hold while the same bounds are active. It is computed outside of JAX, so not under `jit` or `vmap`.

        **Raises:** `RuntimeError` if the method does not converge.
        """
        self._check_alone("objective_of")
        names = tuple(values)

        def optimum(values):
            if is_traced(values):
                raise ValueError("Plan.objective_of runs outside of JAX: it cannot be used under jit or vmap.")
            solution, system = self.solution, with_parameters(self.solution.transcription.task.system, values)
            task = dataclasses.replace(solution.transcription.task, system=system)
            other = self._found_again(task, solution.found)
            if not other.success:
                raise RuntimeError(f"Plan.objective_of: the plan for {dict(values)!r} {other.message}.")
            return other

        def forward(values):
            other = optimum(values)
            return jnp.asarray(other.objective), {name: jnp.asarray(x) for name, x in other.derivatives(*names).items()}

        objective = jax.custom_vjp(lambda values: jnp.asarray(optimum(values).objective))
        objective.defvjp(forward, lambda slopes, cotangent: (jax.tree.map(lambda slope: cotangent * slope, slopes),))
        return objective({name: jnp.asarray(value, float) for name, value in values.items()})

    def __repr__(self) -> str:
        return f"Plan: objective {self.objective:.6g}, duration {self.duration:.6g} s, {self.message}"

    def __str__(self) -> str:
        rows: list[tuple[str, ...]] = [
            ("objective", f"{self.objective:.9g}"),
            ("duration [s]", f"{self.duration:.9g}"),
            (),
        ]
        rows.append(("control", "start", "end", "least", "largest"))
        for name, series in self.controls.items():
            values = np.asarray(series.values).reshape(len(self.ts), -1)
            for k, own in enumerate(values.T):
                label = name if values.shape[1] == 1 else f"{name}[{k}]"
                rows.append((label, *(f"{x:.6g}" for x in (own[0], own[-1], own.min(), own.max()))))
        if self.parameters:
            rows += [(), ("parameter", "value")]
            rows += [(name, np.array2string(value, precision=6)) for name, value in self.parameters.items()]
        if self.prices:
            rows += [(), ("condition", "price")]
            rows += [(name, np.array2string(value, precision=6)) for name, value in self.prices.items()]
        if self.active:
            rows += [(), ("at a bound", ", ".join(self.active))]
        rows += [
            (),
            ("iterations", str(len(self.iterations))),
            ("error of integration", f"{self.integration_error:.1e}"),
        ]
        width = max(len(row[0]) for row in rows if row)
        lines = [f"{row[0]:{width}}" + "".join(f"  {cell:>12}" for cell in row[1:]) if row else "" for row in rows]
        return "\n".join([*(line.rstrip() for line in lines), "", self.message])


def judged(plan: Plan) -> Plan:
    """The plan, without success if contacts or dry friction would change their modes, which the intervals hold."""
    contacts = plan.system.contacts
    if not plan.success or not (contacts.contact_names or contacts.friction_names):
        return plan
    events = plan.trajectory.events
    # Friction at the start may have another mode than the state, with another motion.
    changes = [*(events.at_start if plan.arrival > _ARRIVES else ()), *events]
    if not changes:
        return plan
    first = changes[0]
    message = (
        f"{first.part!r} has the event {first.kind!r} at t = {first.time:.4g} s, and a plan holds the modes of its "
        "start; take a phase up to there and another one from there, by plan_phases"
    )
    return dataclasses.replace(plan, success=False, message=message)


@jitted
def _along(system, quantities, ts, ys, given):
    def of_one(t, state, own):
        now = with_parameters(system, own) if own else system
        return jnp.concatenate([jnp.ravel(x) for x in quantities(Reading(now, state, t, own))])

    return jax.vmap(of_one)(ts, ys, given)


def _prices(solution: Solution) -> dict[str, np.ndarray]:
    transcription, answer = solution.transcription, solution.answer
    task, out = transcription.task, {}
    for where, limits in (("start", task.start), ("end", task.end), ("path", task.path)):
        if isinstance(limits, State):
            k = 0 if where == "start" else -1
            names = transcription.names_at(k)
            values = -answer.of_bounds[transcription.places.x[k]]
            out |= {f"{where} {name}": value for name, value in zip(names, values, strict=True)}
        elif limits.names:
            rows = transcription.rows_of[where] - 1
            values = -answer.multipliers[rows].reshape(-1, len(limits.components)) / limits.sizes
            chosen = values[np.argmax(np.abs(values), axis=0), np.arange(values.shape[1])]
            out |= {f"{where} {name}": value for name, value in zip(limits.components, chosen, strict=True)}
    return out


def _active(solution: Solution) -> tuple[str, ...]:
    transcription, z = solution.transcription, solution.answer.z
    problem, task, places = transcription.problem, transcription.task, transcription.places
    free = problem.low < problem.high
    at_bound = free & (np.minimum(np.abs(z - problem.low), np.abs(z - problem.high)) <= _AT_BOUND * problem.scale)
    near_row = problem.row_low < problem.row_high
    rows = problem.at(z).rows[1:]
    near_row &= np.minimum(np.abs(rows - problem.row_low), np.abs(rows - problem.row_high)) <= _AT_BOUND
    row_at_bound = lambda name: near_row[transcription.rows_of.get(name, np.zeros(0, int)) - 1]
    out = [
        control.name
        for control, where in zip(task.controls, places.controls, strict=True)
        if at_bound[where].any() or row_at_bound(control.name).any()
    ]
    out += [name for name, own in by_name(task.design, at_bound[places.design]).items() if own.any()]
    out += ["duration"] if not task.moving and task.timed and at_bound[places.times].any() else []
    if task.path.names:
        components = task.path.components
        near = row_at_bound("path").reshape(-1, len(components)).any(axis=0)
        out += [components[k] for k in np.flatnonzero(near)]
    return tuple(out)
