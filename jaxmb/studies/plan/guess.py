"""First states of a plan: straight in coordinates from the start to the end, on the constraints; or along a motion."""

import warnings
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..._types import Scalar, State
from ...linalg.jitted import jitted
from ...manifold import Chart
from ...parts.names import unknown
from ...parts.series import AbstractSignal, Series
from ...states.assembly import assemble
from ...system import AbstractSystem, parameters, with_parameters
from ...system.instant import Instant
from ..evaluate import evaluate
from ..inverse.required import RequiredForces
from .lanes import in_lanes
from .task import Limits, Task

# The largest number of intervals between states that are assembled, and corrections of states between them.
_KNOTS, _CORRECTIONS = 12, 4


class Guess(NamedTuple):
    """States at the nodes, stacked along axis 0, at times `ts`; numbers of the controls, one array for each, with
    axes for times and components; values of the designed parameters, flat.
    """

    states: State
    ts: np.ndarray
    controls: tuple[np.ndarray, ...]
    design: np.ndarray


def first_guess(task: Task, given: Any, begin: State | None = None) -> Guess:
    """The guess of a task from a user's guess: None, values by name, a motion with or without forces, or a plan.

    **Arguments:** `begin`: the state at the start, if the task gives none.

    **Raises:** `ValueError` for unknown names, and for ends that cannot be assembled.
    """
    named: dict[str, Any] = dict(given) if isinstance(given, Mapping) else {}
    motion = None if isinstance(given, Mapping) else given
    if motion is not None and getattr(motion, "ts", None) is None:
        raise ValueError(f"plan: guess must be values by name, a Trajectory, RequiredForces or a Plan; got {motion!r}.")
    low, high = task.duration
    usual = float(motion.ts[-1] - motion.ts[0]) if motion is not None else np.sqrt(low * high)
    duration = float(np.clip(named.pop("duration", usual), low, high))
    ts = task.t0 + duration * task.shares
    system, design = _designed(task, named, motion)
    controls = _controls(task, named, motion, ts)
    # The first number of each course is the value at the first node.
    first = {c.name: x[0].reshape(c.shape) for c, x in zip(task.controls, controls, strict=True)}
    system = with_parameters(system, first)
    if motion is None:
        states, angles = _straight(task, system, named, ts, begin)
    else:
        states, angles = _along(task, system, motion, ts)
    states = with_turns(system, ts, states, angles)
    if states.angles is not None:
        states = State(states.q, states.u, states.z, jnp.asarray(np.unwrap(states.angles, axis=0)))
    return Guess(states, ts, controls, design)


def with_turns(system: AbstractSystem, ts: np.ndarray, states: State, near: Any = None) -> State:
    """The states with angles of joints in space, those next to others."""
    if not system.wrapped_angle_names():
        return State(states.q, states.u, states.z)
    angles = in_lanes(_wrapped, system, ts, states.q)
    near = angles if near is None else np.broadcast_to(near, angles.shape)
    turned = angles + 2 * np.pi * np.round((near - angles) / (2 * np.pi))
    return State(states.q, states.u, states.z, np.where(np.isfinite(turned), turned, near))


@jitted
def _wrapped(system, ts, qs):
    return jax.vmap(system.wrapped_angles)(ts, qs)


def _designed(task, named, motion):
    existing, values = parameters(task.system), {}
    for (name, shape), (low, high) in zip(task.design, task.design_bounds, strict=True):
        value = named.pop(name, getattr(motion, "parameters", {}).get(name, existing[name]))
        values[name] = jnp.asarray(np.clip(np.broadcast_to(np.asarray(value, float), shape), low, high))
    flat = np.concatenate([np.zeros(0), *(np.ravel(value) for value in values.values())])
    return (with_parameters(task.system, values) if values else task.system), flat


def _controls(task, named, motion, ts):
    existing, out, known = parameters(task.system), [], _known_controls(task, motion)
    shares = (ts - ts[0]) / (ts[-1] - ts[0])
    for control, (low, high) in zip(task.controls, task.control_bounds, strict=True):
        value = named.pop(control.name, known.get(control.name, existing[control.name]))
        if isinstance(value, AbstractSignal) or callable(value):
            series: Any = value
            if control.name in known:
                # The motion's time is stretched to the duration.
                span = np.asarray(known[control.name].ts)
                values = np.stack([np.asarray(series(span[0] + s * (span[-1] - span[0]))) for s in shares])
            else:
                values = np.stack([np.asarray(series(t)) for t in ts])
        else:
            values = np.broadcast_to(np.asarray(value, float), (len(ts), *control.shape))
        values = np.clip(values, low, high)
        rates = np.gradient(values, shares, axis=0)
        out.append(control.course.numbers(values, rates).reshape(-1, control.size))
    return tuple(out)


def _known_controls(task: Task, motion: Any) -> Mapping[str, Series]:
    """The controls of a motion as functions of its time: of another plan, or required forces."""
    # A concrete class: a trajectory has forces, too, of its force elements.
    if not isinstance(motion, RequiredForces):
        return getattr(motion, "controls", {})
    for name in motion.forces:
        if name not in (control.name for control in task.controls):
            raise unknown("control", name, [c.name for c in task.controls], "plan: guess, required_forces(…, by=)")
    return {name: Series(motion.ts, force, "linear") for name, force in motion.forces.items()}


def _straight(task: Task, system: AbstractSystem, named: dict[str, Any], ts: np.ndarray, begin: State | None) -> Any:
    """Coordinates by name along the way, or straight from the start to the end; on the constraints at some times, one
    after the other, and between them nearly straight. Also the angles at the start that tell its turns, or None.
    """
    known = (*system.coordinate_names(), *system.joint_coordinates())
    for name in named:
        if name not in known:
            raise unknown("coordinate", name, known, "plan: guess")
    at = lambda t: {name: value(t) if callable(value) else value for name, value in named.items()}
    near = _assembled(system, None, at(ts[0]), ts[0], "the guess") if named else None
    start = _first(system, task.start, ts[0], near) or begin
    state = start or (task.end if isinstance(task.end, State) else assemble(system, t=ts[0]))
    shares = task.shares[np.unique(np.linspace(0, task.intervals, min(task.intervals, _KNOTS) + 1).round().astype(int))]
    times = ts[0] + (ts[-1] - ts[0]) * shares
    guessed = [at(t) for t in times]
    fixed = {name: [values[name] for values in guessed] for name in named}
    if not named and not isinstance(task.end, State) and (there := _given(system, task.end, known, state, ts[0])):
        here = evaluate(system, state, list(there), t=ts[0])
        fixed = {
            name: [(1 - share) * np.asarray(here[name]) + share * value for share in shares]
            for name, value in there.items()
        }
    towards = task.end if isinstance(task.end, State) and not named else None
    states, where = [], "the guess" if named else "the way to the end"
    for k, t in enumerate(times):
        if towards is not None:
            share = 1.0 / max(len(times) - k, 1)
            state = State(state.q + share * (towards.q - state.q), jnp.zeros_like(state.u), state.z)
        fix = {name: values[k] for name, values in fixed.items()}
        state = State(state.q, jnp.zeros_like(state.u), state.z)
        if k or start is None:
            state = _assembled(system, state, fix, t, f"{where} at t = {t:.4g} s")
        states.append(state if k or start is None else start)
    angles = states[0].angles
    several = jax.tree.map(lambda *x: np.stack(x), *(State(s.q, s.u, s.z) for s in states))
    between = lambda y: np.stack([np.interp(ts, times, column) for column in y.T], axis=1)
    q, z = between(several.q), None if several.z is None else between(several.z)
    slopes = np.gradient(q, ts, axis=0)
    states = _near(system, ts, q, z, slopes)
    return _with_ends(states, start, task.end if isinstance(task.end, State) else None), angles


def _assembled(
    system: AbstractSystem, state: State | None, fix: Mapping[str, Any], t: Scalar, where: str, **rates: Any
) -> State:
    try:
        with warnings.catch_warnings():
            # Angles along the way may pass full turns.
            warnings.simplefilter("ignore")
            return assemble(system, state, fix=dict(fix) or None, t=t, **rates)
    except ValueError as error:
        given = ", ".join(f"{name} = {np.array2string(np.asarray(value), precision=4)}" for name, value in fix.items())
        raise ValueError(
            f"plan: {where} contradicts the constraints{f', with {given}' if given else ''}: {error}"
        ) from None


def carried(before: AbstractSystem, state: State, system: AbstractSystem, t: Scalar) -> State:
    """The state of a system with the independent coordinates and rates of the state of another one, by their names.

    **Raises:** `ValueError` naming coordinates that the system has not.
    """
    names, known = Chart.at(before, t, state).names, (*system.coordinate_names(), *system.joint_coordinates())
    values = {name: evaluate(before, state, name, t=t) for name in names}
    rates = {name: value for name, value in values.items() if name.endswith("_rate")}
    coordinates = {name: value for name, value in values.items() if name not in rates}
    for name in coordinates:
        if name not in known:
            raise unknown("coordinate", name, known, "plan_phases: a phase begins where the last ended")
    begin = _assembled(system, None, coordinates, t, "the start of a phase", rates=rates or None)
    same = before.wrapped_angle_names() == system.wrapped_angle_names()
    return State(begin.q, begin.u, begin.z, state.angles if same else begin.angles)


def _first(system: AbstractSystem, given: State | Limits, t: Scalar, near: State | None) -> State | None:
    """The state next to a guess with the coordinates and rates that are given at the start, None if none is."""
    if isinstance(given, State):
        return given
    if not given.names:
        return None
    state, joints = near or assemble(system, t=t), system.joint_coordinates()
    coordinates = _given(system, given, (*system.coordinate_names(), *joints), state, t)
    rates = _given(system, given, (*system.rate_names(), *(f"{name}_rate" for name in joints)), state, t)
    return _assembled(system, near, coordinates, t, "the start", rates=rates or None)


def _given(
    system: AbstractSystem, limits: Limits, known: Iterable[str], state: State, t: Scalar
) -> dict[str, np.ndarray]:
    """The values of quantities with known names; of bounds, those that a state violates, by the bound."""
    out, known = {}, set(known)
    for name, (low, high) in limits.by_name().items():
        if name not in known:
            continue
        is_value = np.all(low == high)
        value = low if is_value else np.asarray(evaluate(system, state, name, t=t))
        # Within its bounds a coordinate follows from others, on which it may depend.
        if is_value or np.any((value < low) | (value > high)):
            out[name] = np.clip(value, low, high)
    return out


def _with_ends(states: State, start: State | None, end: State | None) -> State:
    """The states with other first and last states."""
    for k, given in ((0, start), (-1, end)):
        if given is not None:
            states = jax.tree.map(lambda y, x, k=k: _replaced(y, k, x), states, State(given.q, given.u, given.z))
    return states


def _replaced(values: np.ndarray, k: int, value: Any) -> np.ndarray:
    values[k] = value
    return values


def _near(system: AbstractSystem, ts: np.ndarray, q: Any, z: Any, slopes: np.ndarray) -> State:
    """The nearest states on the constraints, with velocities for which coordinates have nearly these slopes."""
    rest: Any = np.zeros((len(ts), system.nu))
    return in_lanes(_on_constraints, system, ts, State(q, rest, z), slopes)


@jitted
def _on_constraints(system, ts, states, slopes):
    def of_one(t, state, slope):
        at = Instant.of(system, t, state)
        for _ in range(_CORRECTIONS if system.position_rows else 0):
            at = at.with_(q=at.q - jnp.linalg.pinv(at.coordinate_jacobian) @ at.coordinate_residual)
        of_velocities = jax.jacfwd(lambda u: at.with_(u=u).rates)(jnp.zeros_like(at.u))
        here = at.with_(u=jnp.linalg.lstsq(of_velocities, slope)[0])
        if system.velocity_rows:
            rows = here.jacobian[: system.velocity_rows]
            here = here.with_(u=here.u - jnp.linalg.pinv(rows) @ here.velocity_residual)
        return here.state

    return jax.vmap(of_one)(ts, states, slopes)


def _along(task: Task, system: AbstractSystem, motion: Any, ts: np.ndarray) -> Any:
    """States along a motion or another plan, its time stretched to the duration; the angles at its start, or None."""
    ys, times = motion.states if hasattr(motion, "states") else motion.ys, np.asarray(motion.ts)
    if times.ndim != 1 or times.size < 2:
        raise ValueError("plan: a motion as the guess needs at least two saved times: simulate(…, saveat=times).")
    if np.shape(ys.q)[1:] != (system.nq,):
        raise ValueError(
            f"plan: the guess is a motion of another system, with {np.shape(ys.q)[1]} coordinates instead of "
            f"{system.nq}."
        )
    places = times[0] + (times[-1] - times[0]) * task.shares
    between = lambda y: np.stack([np.interp(places, times, column) for column in np.asarray(y).T], axis=1)
    q, z = between(ys.q), None if ys.z is None else between(ys.z)
    # Another duration has other rates.
    slopes = (
        between(in_lanes(_rates, system, times, State(ys.q, ys.u, ys.z))) * (times[-1] - times[0]) / (ts[-1] - ts[0])
    )
    states = _near(system, ts, q, z, slopes)
    ends = (x if isinstance(x, State) else None for x in (task.start, task.end))
    return _with_ends(states, *ends), None if ys.angles is None else ys.angles[0]


@jitted
def _rates(system, ts, states):
    return jax.vmap(lambda t, state: Instant.of(system, t, state).rates)(ts, states)
