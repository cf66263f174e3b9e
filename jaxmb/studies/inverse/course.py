"""Motions with their accelerations, from trajectories or from coordinates as functions of time."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ..._arguments import real_array
from ..._types import Coordinates, Scalar, State, Velocities
from ...linalg.arrays import is_traced
from ...linalg.elimination import Factor, PivotSearch, eliminate, full_pivot
from ...linalg.jitted import jitted
from ...parts.coordinate_parts import shortest
from ...parts.names import unknown
from ...parts.series import AbstractSignal, Series, as_signal
from ...simulate.integrate import integrated
from ...simulate.room import MOST_ROWS, Room
from ...solvers import Adams, MultistepController
from ...solvers.tangent import TangentControl
from ...states.arguments import holding
from ...states.assembly import configuration
from ...states.closest import tolerance
from ...system import AbstractSystem
from ...system.quantities import directions
from ...trajectory import Trajectory, states_of
from ..identify.measurements import have_times

# The number of corrections of velocities for constraints that are not linear in them.
_CORRECTIONS = 8
# The largest number of steps along positions that constraints on velocities leave.
_MOST_STEPS = 4**8


class Course(NamedTuple):
    """A motion: times, states and accelerations; `off`: the remaining distance from prescribed coordinates with these
    `names`; `met`: whether a state was found.
    """

    ts: Float[Array, "times"]
    ys: State
    accelerations: Float[Array, "times nu"]
    off: Float[Array, "times c"]
    met: Bool[Array, "times"]
    names: tuple[str, ...]


def recorded(system: AbstractSystem, motion: Trajectory) -> Course:
    """The motion of a trajectory, with the internal states of the `system`."""
    if states_of(motion).q.ndim != 2:
        raise ValueError(
            "required_forces takes a single motion; jax.vmap(lambda motion: …)(motions) takes each member of a batch."
        )
    if motion.system.coordinate_names() != system.coordinate_names():
        raise ValueError("required_forces: the trajectory is of a machine with other bodies or coordinates.")
    motion, z = motion.trimmed(), None
    if system.nz:
        known = motion.system.state_names()
        missing = [name for name in system.state_names() if name not in known]
        if missing:
            raise ValueError(f"required_forces: the trajectory has no values of {', '.join(missing)}.")
        z = motion.ys.z[:, np.concatenate([known[name] for name in system.state_names()])]
    same = motion.system.wrapped_angle_names() == system.wrapped_angle_names()
    ys = State(motion.ys.q, motion.ys.u, z, motion.ys.angles if same else None)
    _check_contacts(system, motion.ts, ys.q)
    nothing = jnp.zeros((motion.ts.size, 0), ys.q.dtype)
    return Course(motion.ts, ys, motion.accelerations, nothing, jnp.ones(motion.ts.size, bool), ())


def planned(system: AbstractSystem, motion: Any, ts: Any, guess: State) -> Course:
    """The motion that coordinates determine as functions of time."""
    if have_times(motion):
        motion, ts = motion.values, motion.ts if ts is None else ts
    if not isinstance(motion, Mapping) or not motion:
        raise ValueError(
            "required_forces: motion is a Trajectory, or by names of coordinates cubic Series, functions of time or "
            f"measured positions, {{'pin.angle': series}}; got {motion!r}."
        )
    if system.nz:
        raise ValueError(
            f"required_forces: positions do not determine {', '.join(system.state_names())}. Give a Trajectory, or "
            "name the part among the actuators."
        )
    if system.contacts.m:
        raise ValueError(
            f"required_forces: positions do not determine whether {', '.join(system.contacts.friction_names)} sticks. "
            "Give a Trajectory, or remove the friction."
        )
    series = [value for value in motion.values() if isinstance(value, AbstractSignal) and value.of_arrays]
    if ts is None and not series:
        raise ValueError("required_forces: ts is missing, the times of the motion.")
    ts = series[0].samples(0.0, 0.0) if ts is None else real_array("required_forces: ts", ts, guess.q.dtype, None)
    ts = jnp.asarray(ts)
    if ts.ndim != 1 or not ts.size:
        raise ValueError(f"required_forces: ts must be a vector of times, got shape {ts.shape}.")
    if not is_traced(ts) and np.any(np.diff(ts) < 0):
        raise ValueError("required_forces: ts must be ascending.")
    # In the order that compiled functions see.
    signals = {name: _signal(system, name, motion[name], ts) for name in sorted(motion, key=str)}
    _check_contacts(system, ts[:1], guess.q[None])
    _check_freedoms(system, signals, guess, ts)
    q, u, udot, off, met = _followed(system, signals, guess, ts)
    return Course(ts, State(q, u), udot, off, met, _components(system, signals))


def _signal(system, name, value: Any, ts) -> AbstractSignal:
    """A coordinate as a function of time with two derivatives."""
    joints, names = system.joint_coordinates(), system.coordinate_names()
    if name not in joints and name not in names:
        raise unknown("coordinate", name, [*joints, *names], "required_forces")
    positions: Any = value
    is_function = isinstance(value, AbstractSignal) or callable(value)
    signal = as_signal(name, value) if is_function else Series(ts, positions, "cubic")
    if signal.break_times(of_rates=True).size:
        raise ValueError(
            f"required_forces: {name!r} has no accelerations, since its rate jumps; give Series(ts, values, 'cubic')."
        )
    signal.check_interval(name, ts[0], ts[-1])
    components = _components(system, [name])
    shape = joints[name].shape if name in joints else components[1:] and (len(components),)
    if signal.shape(ts[0]) != shape:
        found = signal.shape(ts[0])
        raise ValueError(f"required_forces: {name!r} must have shape {shape} at each time, got {found}.")
    return signal


def _components(system, names) -> tuple[str, ...]:
    """The name of each component of some coordinates."""
    joints, index = system.joint_coordinates(), system.coordinate_names()
    size = lambda name: int(np.prod(joints[name].shape)) if name in joints else len(index[name])
    return tuple(name for name in names for _ in range(size(name)))


class _Kinematics(NamedTuple):
    """The velocities and accelerations of a motion in prescribed coordinates, at a position q."""

    system: Any
    signals: dict[str, AbstractSignal]
    t: Scalar
    q: Coordinates

    def values(self, t, q):
        """The coordinates, one after the other."""
        joints, index = self.system.joint_coordinates(), self.system.coordinate_names()
        of_joint = lambda name: self.system.catalogue.joint_coordinate(joints[name], t, q).reshape(-1)
        return jnp.concatenate([of_joint(n) if n in joints else q[np.array(index[n])] for n in self.signals])

    def wanted(self, t):
        """Their prescribed values."""
        return jnp.concatenate([signal(t).astype(self.q.dtype).reshape(-1) for signal in self.signals.values()])

    def rates(self, t, q, u):
        return jax.jvp(self.values, (t, q), (jnp.ones_like(t), self.system.rates(t, q, u)))[1]

    def wanted_rates(self, t):
        return jax.jvp(self.wanted, (t,), (jnp.ones_like(t),))[1]

    def of_velocities(self, u):
        """The residuals of the constraints, then of the prescribed rates."""
        t, q = self.t, self.q
        unmet = self.system.velocity_residual(t, q, u)
        return jnp.concatenate([unmet, self.rates(t, q, u) - self.wanted_rates(t)])

    def of_accelerations(self, u, udot):
        """Their time derivatives."""
        system, t, q, one = self.system, self.t, self.q, jnp.ones_like(self.t)
        unmet = system.acceleration_residual(t, q, u, udot)[: system.velocity_rows]
        _, changes = jax.jvp(self.rates, (t, q, u), (one, system.rates(t, q, u), udot))
        _, wanted = jax.jvp(self.wanted_rates, (t,), (one,))
        return jnp.concatenate([unmet, changes - wanted])

    def searched(self, u) -> tuple[Array, PivotSearch]:
        """The derivatives of both by velocities and accelerations, and pivots, in rows of constraints first."""
        jacobian = jax.jacfwd(lambda udot: self.of_accelerations(u, udot))(jnp.zeros_like(u))
        level = jnp.asarray(np.arange(jacobian.shape[0]) >= self.system.velocity_rows, int)
        return jacobian, full_pivot(jacobian, scale=self.system.velocity_scale(), level=level)

    def corrected(self, u) -> tuple[Velocities, Factor, PivotSearch]:
        """Velocities after a correction, with the factor and pivots before it."""
        jacobian, search = self.searched(u)
        factor = eliminate(jacobian, search.order, u.size)
        return u - factor.right_inverse @ self.of_velocities(u), factor, search

    def solved(self, near: Velocities) -> tuple[Array, Array, Bool[Array, ""]]:
        """u, u̇, and whether they are determined; `near` counts for constraints that are not linear in velocities."""
        still = jnp.zeros_like(near)
        u = still if self.system.linear else near
        for _ in range(0 if self.system.linear else _CORRECTIONS):
            u, *_ = self.corrected(u)
        u, factor, search = self.corrected(u)
        return u, -(factor.right_inverse @ self.of_accelerations(u, still)), search.rank == near.size


@jitted
def _followed(system, signals, guess, ts):
    """q, u, u̇, the distance from prescribed coordinates, and whether a state was found, at all times."""
    joints = system.joint_coordinates()
    periodic = np.array([n in joints and joints[n].periodic for n in _components(system, signals)], bool)

    def motion(t, q):
        """q with u, u̇, the distance, and whether the velocities are determined."""
        at = _Kinematics(system, signals, t, q)
        u, udot, determined = at.solved(guess.u)
        off = at.values(t, q) - at.wanted(t)
        return q, u, udot, jnp.where(periodic, shortest(off), off), determined

    def advance(carry, t):
        before, q, qdot = carry
        q, met = _positioned(system, signals, t, q + (t - before) * qdot)
        *found, determined = motion(t, q)
        # The constraints determine the position; the position before is only where the search for it starts.
        return lax.stop_gradient((t, q, system.rates(t, q, found[1]))), (*found, met & determined)

    def corrected(t, q):
        q, met = _positioned(system, signals, t, q)
        *found, determined = motion(t, q)
        return *found, met & determined

    if system.nq - system.coordinate_rank == system.nu - system.velocity_rank:
        return lax.scan(advance, lax.stop_gradient((ts[0], guess.q, jnp.zeros_like(guess.q))), ts)[1]
    *found, met = lax.map(lambda at: corrected(*at), _rolled(system, signals, guess, ts))
    return *found, met


def _positioned(system, signals, t, near):
    """The position nearest to another in which coordinates are prescribed, and whether it was found."""
    joints, near = system.joint_coordinates(), system.normalize(t, near)
    values = {name: signal(t).astype(near.dtype) for name, signal in signals.items()}
    held = holding(system, {name: value for name, value in values.items() if name in joints}, {}, t)
    fix = {name: value for name, value in values.items() if name not in joints}
    q, _, met = configuration(held, near, fix, t, False)
    return q, met


class _Rates(eqx.Module):
    """The rates of all coordinates in a motion in prescribed coordinates; `near`: see `_Kinematics.solved`."""

    system: Any
    signals: dict[str, AbstractSignal]
    near: Velocities

    def __call__(self, t, q, args):
        del args
        u, *_ = _Kinematics(self.system, self.signals, t, q).solved(self.near)
        return self.system.rates(t, q, u)


def _rolled(system, signals, guess, ts) -> tuple[Array, Array]:
    """All times, and positions at these up to errors of integration, from the first; NaN from where a step failed.

    Constraints on velocities, such as rolling, leave positions that prescribed coordinates do not determine. They are
    integrated with error control, whatever times are asked for.
    """
    first, _ = _positioned(system, signals, ts[0], guess.q)
    if ts.size == 1:
        return ts, first[None]
    rates, still = _Rates(system, signals, guess.u), lax.stop_gradient(ts)
    precision, scale = tolerance(first.dtype), lax.stop_gradient(system.coordinate_scale())
    # No step passes over a feature of the motion that the times resolve.
    longest = jnp.max(jnp.diff(still))
    control = MultistepController(precision, precision * scale, dtmax=jnp.where(longest > 0, longest, 1.0))
    options = {
        "y0": first - (ts[0] - still[0]) * rates(still[0], first, None),
        "t0": still[0],
        "t1": still[-1],
        "dt0": None,
        "saveat": diffrax.SaveAt(subs=[diffrax.SubSaveAt(ts=still)], solver_state=True),
        "stepsize_controller": control,
    }
    problem = diffrax.ODETerm(rates), Adams(), options
    watched = TangentControl(scale, (first.size,))
    room = Room(_MOST_STEPS, np.asarray(_MOST_STEPS), MOST_ROWS)
    ys = integrated(problem, watched, room, False, False, None)[0].ys[0]
    ys = jnp.where(jnp.isfinite(ys), ys, jnp.nan)
    return ts, ys + jax.vmap(lambda t, q, ahead: ahead * rates(t, q, None))(still, ys, ts - still)


def _check_contacts(system, ts, positions):
    """Raise a `ValueError` for positions in which contacts are closed or friction sticks."""
    contacts = system.contacts
    if not contacts or is_traced((ts, positions)):
        return

    def bears_force(q):
        modes = contacts.modes(q)
        return jnp.concatenate([modes.shut, modes.held])

    bears = np.asarray(jax.vmap(bears_force)(positions))
    if bears.any():
        k = int(np.argmax(bears.any(axis=1)))
        names = ", ".join(dict.fromkeys(name for name, bad in zip(contacts.names, bears[k], strict=True) if bad))
        raise ValueError(
            f"required_forces: at t = {float(ts[k]):g} {names} bears a force, since a contact is closed or friction "
            "sticks; required_forces finds none. Leave such times out, or put a joint in its place."
        )


def _check_freedoms(system, signals, guess, ts):
    """Raise a `ValueError` for coordinates that do not determine the motion, or that the constraints hold."""
    names, freedoms = _components(system, signals), system.nu - system.velocity_rank
    traced, listed = is_traced((system, guess, signals, ts)), ", ".join(signals)
    if traced and len(names) < freedoms:
        raise ValueError(f"required_forces: {listed} do not determine the motion of {freedoms} freedoms.")
    if traced:
        return
    rows, columns = map(np.asarray, _pivots(system, signals, guess, ts[0]))
    if not columns.all():
        free = free_names(system, ~columns)
        raise ValueError(f"required_forces: {listed} leave {free} free; give another coordinate as well.")
    held = [name for name, has_pivot in zip(names, rows[system.velocity_rows :], strict=True) if not has_pivot]
    if held and system.velocity_rows == system.position_rows:
        raise ValueError(
            f"required_forces: {', '.join(dict.fromkeys(held))} is not a freedom: the constraints and the other "
            "coordinates determine it. Leave it out."
        )


@jitted
def _pivots(system, signals, guess, t):
    return have_pivots(_Kinematics(system, signals, jnp.asarray(t, guess.q.dtype), guess.q).searched(guess.u)[1])


def have_pivots(search: PivotSearch) -> tuple[Bool[Array, "m"], Bool[Array, "n"]]:
    """Which rows and which columns have pivots."""
    order, rank = search.order, search.rank.astype(search.order.packed.dtype)
    return order.row_place < rank, order.column_place < rank


def free_names(system: AbstractSystem, columns: Any) -> str:
    """The names of some velocities as directions, for messages."""
    known = directions(system.rate_names())
    return ", ".join(known.get(int(k), f"velocity {k}") for k in np.flatnonzero(columns))
