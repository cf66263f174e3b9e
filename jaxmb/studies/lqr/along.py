"""Gains along a plan, by the Riccati differential equation backward from its end.

The named states are functions y(x) of all coordinates and velocities x, with `ẏ = h(x, w)`. Small changes z of y
follow `ż = (∂h/∂x R) z + ∂h/∂w δw`, where `δx = R z` is tangent to the constraints. So the equations do not depend on
the charts in which the motion between nodes is computed.

Source: B. D. O. Anderson and J. B. Moore, "Optimal Control: Linear Quadratic Methods", Prentice Hall, 1990.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ..._types import Scalar, State
from ...linalg.jitted import jitted
from ...manifold import Chart
from ...parts.names import unknown
from ...parts.series import Series
from ...system import AbstractSystem, with_inputs
from ..linear.linear_equations import vector_field
from ..linear.linearise import check_contacts
from ..linear.perturbations import (
    StateNames,
    coordinate_function,
    counts,
    internal_names,
    is_rate,
    joined,
    parted,
    perturbations,
    rate_function,
)
from ..linear.quantities import components
from ..plan import Plan
from ..plan.courses import Piece
from ..plan.lanes import Control, in_lanes
from ..plan.transcription import nodes_at
from .algebraic import algebraic
from .regulator import Regulator, measured_as

# The parts of an interval of a plan, and the tolerance and the largest number of steps of each.
_PARTS, _RTOL, _STEPS = 4, 1e-9, 2000


class _Course(NamedTuple):
    """A control on one interval: the weighted `numbers` of its course, the `start` and the length `h` [s]."""

    numbers: tuple[Any, ...]
    start: Any
    h: Any


class _Model(eqx.Module):
    """The equations of a `system` about its motion under `controls`, in the states `names`, with the input components
    `chosen`, pairs of a control and a place in it.
    """

    system: AbstractSystem
    controls: tuple[Control, ...] = eqx.field(static=True)
    names: StateNames = eqx.field(static=True)
    chosen: tuple[tuple[str, int], ...] = eqx.field(static=True)

    def driven(self, course: _Course, changes: Any = ()) -> AbstractSystem:
        """The system on an interval, with constant changes of the chosen inputs."""
        pieces = {}
        for control, numbers in zip(self.controls, course.numbers, strict=True):
            own = numbers.reshape(control.course.local, *control.shape)
            powers = control.course.powers(own)
            for change, (name, place) in zip(changes, self.chosen, strict=False):
                if name == control.name:
                    powers[0] = jnp.ravel(powers[0]).at[place].add(change).reshape(control.shape)
            pieces[control.name] = Piece(powers, course.start, course.h, control.course.smooth)
        return with_inputs(self.system, pieces)

    def values(self, t: Scalar, state: State, at: State) -> Float[Array, "k"]:
        """The states by name; `at`: any state, for its structure."""
        system = self.system
        coordinates = [coordinate_function(system, t, None, name)(state) for name in self.names.coordinates]
        rates = [rate_function(system, t, at, name)(state) for name in self.names.rates or ()]
        return jnp.concatenate([jnp.stack([*coordinates, *rates]), *([] if state.z is None else [state.z])])

    def equations(self, t: Scalar, state: State, course: _Course) -> "_Equations":
        """The linear equations about a state of the motion."""
        perturbed = perturbations(self.driven(course), t, state, self.names)
        x, k = joined(state), perturbed.basis.shape[1]

        def rates(changes):
            driven = self.driven(course, changes[k:])
            moved = parted(driven, x + perturbed.basis @ changes[:k])
            field, _ = vector_field(driven, t, moved)
            read = lambda t, y: self.values(t, y, state)
            residuals = driven.position_residual(t, moved.q), driven.velocity_residual(t, moved.q, moved.u)
            return jax.jvp(read, (t, moved), (jnp.ones_like(t), field))[1], jnp.concatenate(residuals)

        of_rates, of_rows = jax.jacfwd(rates)(jnp.zeros(k + len(self.chosen), x.dtype))
        bound = jnp.max(jnp.abs(of_rows[:, k:]), axis=0, initial=0.0) > 0
        return _Equations(
            of_rates[:, :k], of_rates[:, k:], self.values(t, state, state), jnp.all(perturbed.regular), bound
        )


class _Equations(NamedTuple):
    """`ż = A z + B w` at an instant, the `values` of the states there; `regular`: whether the names are independent;
    `bound`: the mask of inputs that move constraints.
    """

    A: Float[Array, "k k"]
    B: Float[Array, "k i"]
    values: Float[Array, "k"]
    regular: Bool[Array, ""]
    bound: Bool[Array, "i"]


def along(
    plan: Plan, states: Mapping[str, Any], inputs: Mapping[str, Any], final: Mapping[str, Any] | None
) -> Regulator:
    """The regulator along a plan."""
    check_contacts("lqr", plan.system, plan.states.q)
    task, ts = plan.solution.transcription.task, np.asarray(plan.ts)
    first = jax.tree.map(lambda y: jnp.asarray(y[0]), State(plan.states.q, plan.states.u, plan.states.z))
    names, labels = _state_names(plan.system, ts[0], first, tuple(states))
    for given in final or ():
        if given not in labels:
            raise unknown("state", given, labels, "lqr: final")
    chosen = components("control", tuple(inputs), {control.name: control.shape for control in task.controls})
    if len(chosen) > len(inputs):
        raise ValueError(f"lqr: name components of a control, {chosen[0][0]}[0]; got {', '.join(inputs)}.")
    model = _Model(plan.system, task.controls, names, chosen)
    q, r = jnp.array([states.get(name, 0.0) for name in labels]), jnp.array([*inputs.values()])
    courses = _courses(plan)
    last = jax.tree.map(lambda x: x[-1:], (ts, State(plan.states.q, plan.states.u, plan.states.z), courses))
    end = jax.tree.map(lambda x: x[0], _Equations(*in_lanes(_equations, model, *last)))
    _check(ts[-1:], end.regular[None], end.bound, labels, tuple(inputs))
    cost = np.diag(q)
    if final is not None:
        cost = np.diag([final.get(name, 0.0) for name in labels])
    elif bool((after := algebraic(end.A, end.B, q, r)).ok):
        cost = after.cost
    return _regulator(plan, model, courses, (q, r), cost, labels, tuple(inputs))


def _regulator(plan, model, courses, weights, cost, labels, inputs):
    ts, nodes = np.asarray(plan.ts), nodes_at(plan.system, plan.ts, plan.states)
    after = jax.tree.map(lambda x: x[1:], (nodes.charts, nodes.coordinates, nodes.scales))
    states, costs = _backward(model, after, courses, weights, cost)
    # From the first node to the last, each but the last at the start of its part.
    share = np.arange(_PARTS) / _PARTS
    times = np.append((ts[:-1, None] + np.diff(ts)[:, None] * share).reshape(-1), ts[-1])
    ends = jax.tree.map(lambda y: np.asarray(y)[-1:], State(plan.states.q, plan.states.u, plan.states.z))
    states = jax.tree.map(lambda y, end: np.concatenate([np.asarray(y).reshape(-1, y.shape[-1]), end]), states, ends)
    costs = np.concatenate([np.asarray(costs).reshape(-1, *cost.shape), np.asarray(cost)[None]])
    intervals = np.minimum(np.arange(len(times)) // _PARTS, len(ts) - 2)
    found = _Equations(*in_lanes(_equations, model, times, states, jax.tree.map(lambda x: x[intervals], courses)))
    if not (np.all(np.isfinite(costs)) and np.all(np.isfinite(found.A))):
        at = times[np.flatnonzero(~np.isfinite(costs).all(axis=(1, 2)))[-1:]]
        raise ValueError(
            f"lqr: the Riccati equation cannot be integrated beyond t = {float(at[0]) if at.size else ts[0]:.4g} s. "
            "Give the plan more intervals, or larger weights of the inputs."
        )
    _check(times, found.regular, found.bound.any(axis=0), labels, inputs)
    gains = np.swapaxes(found.B, 1, 2) @ costs / np.asarray(weights[1])[None, :, None]
    measured = tuple(measured_as(plan.system, name) for name in labels)
    values = found.values.copy()
    for k, own in enumerate(measured):
        if own is not None and own.periodic:
            values[:, k] = np.unwrap(values[:, k])
    return Regulator(
        *map(jnp.asarray, (gains, costs, found.A - found.B @ gains)),
        reference_states=Series(times, values, "cubic"),
        reference_inputs=_inputs(plan, model.chosen),
        ts=jnp.asarray(times),
        states=labels,
        inputs=inputs,
        measured=measured,
    )


def _state_names(system, t, state, given) -> tuple[StateNames, tuple[str, ...]]:
    """Coordinates and rates among the given names, with rates of coordinates where rates are missing; and the names of
    all states in their order.
    """
    internal = internal_names(system)
    named = [name for name in given if name not in internal]
    given_rates = [name for name in named if is_rate(system, t, state, name)]
    coordinates, most = tuple(name for name in named if name not in given_rates), counts(system)
    of_coordinates = [f"{name}_rate" for name in coordinates]
    missing = [name for name in of_coordinates if name not in given_rates]
    added = missing[: max(most[1] - len(given_rates), 0)]
    others = [name for name in given_rates if name not in of_coordinates]
    rates = (*(name for name in of_coordinates if name in given_rates or name in added), *others)
    for kind, names, count in zip(("coordinate", "rate"), (coordinates, rates), most, strict=True):
        if len(names) != count:
            listed = ", ".join(names) or "none"
            raise ValueError(
                f"lqr: states must name {count} independent {kind}{'s' if count != 1 else ''} along a plan, with "
                f"weight zero if need be; there are {len(names)}: {listed}."
            )
    return StateNames(coordinates, rates), (*coordinates, *rates, *internal)


def _check(times, regular, bound, labels, inputs):
    if not np.all(regular):
        at = times[np.flatnonzero(~np.asarray(regular))[0]]
        raise ValueError(f"lqr: the states {', '.join(labels)} are not independent at t = {at:.4g} s. Name others.")
    if np.any(bound):
        moves = ", ".join(name for name, is_bound in zip(inputs, np.asarray(bound), strict=True) if is_bound)
        raise ValueError(f"lqr: {moves} cannot be an input: it moves the constraints. Use a force or a torque.")


def _courses(plan: Plan) -> _Course:
    """The controls of all intervals, stacked along axis 0."""
    task, found = plan.solution.transcription.task, plan.solution.found
    numbers = tuple(
        (control.course.weights(task.shares)[:, :, None] * x[control.course.places(task.intervals)]).reshape(
            task.intervals, -1
        )
        for control, x in zip(task.controls, found.controls, strict=True)
    )
    return _Course(numbers, plan.ts[:-1], np.diff(plan.ts))


def _inputs(plan: Plan, chosen: tuple[tuple[str, int], ...]) -> Series:
    """The planned inputs as one series; all controls of a plan have courses of one kind."""
    several = [plan.controls[name] for name, _ in chosen]
    stacked = lambda arrays: jnp.stack(
        [jnp.reshape(x, (len(x), -1))[:, k] for x, (_, k) in zip(arrays, chosen, strict=True)], axis=1
    )
    values = stacked([one.values for one in several])
    if several[0].slopes is not None:
        slopes = stacked([one.slopes for one in several])
        return eqx.tree_at(lambda series: series.slopes, Series(plan.ts, values, "cubic"), slopes)
    return Series(plan.ts, values, "held" if several[0].interpolation == "held" else "linear")


@jitted
def _equations(model, ts, states, courses):
    return jax.vmap(model.equations)(ts, states, courses)


@jitted
def _backward(model, after, courses, weights, cost):
    """States and costs at the starts of all parts of intervals, with axes for intervals and parts."""
    q, r = weights
    n, k = after[1].shape[1], len(q)

    def of_interval(cost, given):
        (chart, x, scales), course = given
        here = Chart(model.driven(course), *chart)

        def field(t, y, _):
            state, rates = here.moving(t, y[:n])
            equations, P = model.equations(t, state, course), y[n:].reshape(k, k)
            pushed = P @ equations.B
            change = equations.A.T @ P + P @ equations.A - (pushed / r[None, :]) @ pushed.T + jnp.diag(q)
            return jnp.concatenate([rates, -change.reshape(-1)])

        def of_part(y, number):
            size = jnp.sqrt(jnp.maximum(jnp.diag(y[n:].reshape(k, k)), 0.0))
            size = jnp.maximum(size, 1e-6 * jnp.max(size) + 1e-30)
            atol = _RTOL * jnp.concatenate([scales, jnp.outer(size, size).reshape(-1)])
            end, start = (course.start + course.h * (number + side) / _PARTS for side in (1, 0))
            solution = diffrax.diffeqsolve(
                diffrax.ODETerm(field),
                diffrax.Dopri8(),
                end,
                start,
                -course.h / _PARTS,
                y,
                stepsize_controller=diffrax.PIDController(_RTOL, atol),
                adjoint=diffrax.ForwardMode(),
                max_steps=_STEPS,
                throw=False,
            )
            met = solution.result == diffrax.RESULTS.successful
            y = jnp.asarray(solution.ys)[-1] * jnp.where(met, 1.0, jnp.nan)
            return y, (here.state(start, y[:n]), y[n:].reshape(k, k))

        y = jnp.concatenate([x, cost.reshape(-1)])
        y, found = lax.scan(of_part, y, jnp.arange(_PARTS, dtype=x.dtype), reverse=True)
        cost = y[n:].reshape(k, k)
        return 0.5 * (cost + cost.T), found

    _, (states, costs) = lax.scan(of_interval, jnp.asarray(cost), (after, courses), reverse=True)
    return State(states.q, states.u, states.z), costs
