"""First states of a plan: straight in coordinates from the start to the end, on the constraints; or along a motion."""

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..._types import Scalar, State
from ...linalg.jitted import jitted
from ...parts.names import unknown
from ...parts.series import AbstractSignal
from ...states.assembly import assemble
from ...system import AbstractSystem, parameters, with_parameters
from ...system.instant import Instant
from ...trajectory import Trajectory
from ..evaluate import evaluate
from .task import Limits, Task


class Guess(NamedTuple):
    """States at the nodes, stacked along axis 0, at times `ts`; numbers of the controls, one array for each, with
    axes for times and components; values of the designed parameters, flat.
    """

    states: State
    ts: np.ndarray
    controls: tuple[np.ndarray, ...]
    design: np.ndarray


def first_guess(task: Task, given: Any) -> Guess:
    """The guess of a task from a user's guess: None, values by name, a motion, or another plan.

    **Raises:** `ValueError` for unknown names, and for ends that cannot be assembled.
    """
    named: dict[str, Any] = dict(given) if isinstance(given, Mapping) else {}
    motion = None if isinstance(given, Mapping) else given
    low, high = task.duration
    usual = float(motion.ts[-1] - motion.ts[0]) if motion is not None else np.sqrt(low * high)
    duration = float(np.clip(named.pop("duration", usual), low, high))
    ts = task.t0 + duration * task.shares
    system, design = _designed(task, named, motion)
    controls = _controls(task, named, motion, ts)
    first = {c.name: jnp.asarray(c.course.series(ts, x.reshape(-1, *c.shape))(ts[0])) for c, x in zip(task.controls, controls, strict=True)}
    system = with_parameters(system, first)
    states = _along(task, system, motion, ts) if motion is not None else _straight(task, system, named, ts)
    return Guess(states, ts, controls, design)


def _designed(task, named, motion):
    existing, values = parameters(task.system), {}
    for (name, shape), (low, high) in zip(task.design, task.design_bounds, strict=True):
        value = named.pop(name, getattr(motion, "parameters", {}).get(name, existing[name]))
        values[name] = jnp.asarray(np.clip(np.broadcast_to(np.asarray(value, float), shape), low, high))
    flat = np.concatenate([np.zeros(0), *(np.ravel(value) for value in values.values())])
    return (with_parameters(task.system, values) if values else task.system), flat


def _controls(task, named, motion, ts):
    existing, out = parameters(task.system), []
    known = getattr(motion, "controls", {})
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
        rates = np.gradient(values, ts, axis=0)
        out.append(control.course.numbers(values, rates).reshape(-1, control.size))
    return tuple(out)


def _straight(task: Task, system: AbstractSystem, named: dict[str, Any], ts: np.ndarray) -> State:
    start = _end_state(system, task.start, None, ts[0], "start")
    coordinates = {name: value for name, value in named.items()}
    for name in coordinates:
        if name not in _assembled(system):
            raise unknown("coordinate", name, _assembled(system), "plan: guess")
    values = {name: np.stack([np.asarray(value(t) if callable(value) else value) for t in ts]) for name, value in coordinates.items()}
    fixed = _coordinates(system, task.end) if isinstance(task.end, Limits) else {}
    if not values and fixed:
        if start is None:
            start = system_state(system)
        names = list(fixed)
        begin = evaluate(system, start, names, t=ts[0])
        values = {name: np.asarray(begin[name]) + np.multiply.outer(task.shares, fixed[name] - np.asarray(begin[name])) for name in names}
    last = task.end if isinstance(task.end, State) else None
    states, state = [], start if start is not None else (last if last is not None else system_state(system))
    for k, t in enumerate(ts):
        if last is not None and not values:
            share = 1.0 / max(len(ts) - k, 1)
            state = State(state.q + share * (last.q - state.q), jnp.zeros_like(state.u), state.z)
        if k == 0 and start is not None:
            state = start
        else:
            fix = {name: value[k] for name, value in values.items()}
            try:
                state = assemble(system, State(state.q, jnp.zeros_like(state.u), state.z), fix=fix or None, t=t)
            except ValueError as error:
                where = "; ".join(f"{name} = {np.asarray(value):.6g}" if np.ndim(value) == 0 else name for name, value in fix.items())
                raise ValueError(f"plan: no configuration for the guess at node {k}{' with ' + where if where else ''}: {error}") from None
        states.append(state)
    return _with_rates(system, states, ts, start, last)


def system_state(system: AbstractSystem) -> State:
    """The state at the poses given with the bodies, on the constraints."""
    return assemble(system)


def _end_state(system: AbstractSystem, end: State | Limits, guess: State | None, t: Scalar, where: str) -> State | None:
    """A state at an end, None if nothing of it is given."""
    if isinstance(end, State):
        return end
    fixed = _coordinates(system, end)
    rates = {name: value for name, value in _middles(end).items() if name in _rates(system)}
    if not fixed and not rates:
        return None
    try:
        return assemble(system, guess, fix=fixed or None, rates=rates or None, t=t)
    except ValueError as error:
        raise ValueError(f"plan: the {where} contradicts the constraints or the reach: {error}") from None


def _coordinates(system, limits):
    return {name: value for name, value in _middles(limits).items() if name in _assembled(system)}


def _middles(limits: Limits) -> dict[str, np.ndarray]:
    """Values between the limits, of quantities with two of them."""
    middle, out, k = 0.5 * (limits.low + limits.high), {}, 0
    for name in limits.names:
        own = [j for j, component in enumerate(limits.components) if component == name or component.startswith(f"{name}[")]
        if np.all(np.isfinite(middle[own])):
            out[name] = middle[own] if len(own) > 1 else middle[own[0]]
    return out


def _assembled(system: AbstractSystem) -> tuple[str, ...]:
    return (*system.coordinate_names(), *system.joint_coordinates())


def _rates(system: AbstractSystem) -> tuple[str, ...]:
    return (*system.rate_names(), *(f"{name}_rate" for name in system.joint_coordinates()))


def _with_rates(system: AbstractSystem, states: list[State], ts: np.ndarray, start: State | None, end: State | None) -> State:
    """The states with velocities by differences; those of given ends stay."""
    together = jax.tree.map(lambda *x: jnp.stack(x), *(State(s.q, s.u, s.z) for s in states))
    slopes = np.gradient(np.asarray(together.q), ts, axis=0)
    u = np.array(_velocities(system, jnp.asarray(ts), together, jnp.asarray(slopes)))
    for k, given in ((0, start), (-1, end)):
        if given is not None:
            u[k] = np.asarray(given.u)
    return State(together.q, jnp.asarray(u), together.z)


@functools.partial(jitted)
def _velocities(system, ts, states, slopes):
    """The velocities on the constraints whose rates of coordinates are nearest to some slopes."""

    def of_one(t, state, slope):
        at = Instant.of(system, t, state)
        of_velocities = jax.jacfwd(lambda u: at.with_(u=u).rates)(jnp.zeros_like(at.u))
        u = jnp.linalg.lstsq(of_velocities, slope)[0]
        here = at.with_(u=u)
        rows = here.jacobian[: system.velocity_rows]
        return u - (jnp.linalg.pinv(rows) @ here.velocity_residual if system.velocity_rows else 0.0)

    return jax.vmap(of_one)(ts, states, slopes)


def _along(task: Task, system: AbstractSystem, motion: Any, ts: np.ndarray) -> State:
    """States along a motion or another plan, its time stretched to the duration."""
    given: Any = motion if not isinstance(motion, Trajectory) else motion.ys
    ys = given.states if hasattr(given, "states") else given
    times = np.asarray(motion.ts)
    if times.ndim != 1 or times.size < 2:
        raise ValueError("plan: a motion as the guess needs at least two saved times: simulate(…, saveat=times).")
    places = times[0] + (times[-1] - times[0]) * task.shares
    between = lambda y: np.stack([np.interp(places, times, column) for column in np.asarray(y).T], axis=1)
    q, u = between(ys.q), between(ys.u)
    z = None if ys.z is None else jnp.asarray(between(ys.z))
    # Another duration has other velocities.
    u = u * (times[-1] - times[0]) / (ts[-1] - ts[0])
    states = []
    for k, t in enumerate(ts):
        state = State(jnp.asarray(q[k]), jnp.asarray(u[k]), None if z is None else z[k])
        states.append(assemble(system, state, t=t))
    return jax.tree.map(lambda *x: jnp.stack(x), *(State(s.q, s.u, s.z) for s in states))
