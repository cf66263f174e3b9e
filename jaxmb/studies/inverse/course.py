"""Motions with their accelerations, from trajectories or from coordinates as functions of time."""

from collections.abc import Mapping
from typing import Any, NamedTuple

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
from ...states.arguments import holding
from ...states.assembly import configuration
from ...system import AbstractSystem
from ...system.quantities import directions
from ...trajectory import Trajectory
from ..identify.measurements import have_times

# The number of corrections of velocities for constraints that are not linear in them.
_CORRECTIONS = 8


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
    if motion.ts.ndim != 1:
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
    # In the order that compiled functions see.
    signals = {name: _signal(system, name, motion[name], ts) for name in sorted(motion, key=str)}
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
    """q, u, u̇, the distance from prescribed coordinates, and whether a state was found, position after position."""
    joints = system.joint_coordinates()
    of_joints = [name for name in signals if name in joints]
    periodic = np.array([n in joints and joints[n].periodic for n in _components(system, signals)], bool)

    def advance(carry, t):
        before, q, qdot = carry
        values = {name: signal(t).astype(q.dtype) for name, signal in signals.items()}
        held = holding(system, {name: values[name] for name in of_joints}, {}, t)
        fix = {name: value for name, value in values.items() if name not in joints}
        q, _, met = configuration(held, system.normalize(t, q + (t - before) * qdot), fix, t, False)
        kinematics = _Kinematics(system, signals, t, q)
        u, udot, determined = kinematics.solved(guess.u)
        off = kinematics.values(t, q) - kinematics.wanted(t)
        off = jnp.where(periodic, shortest(off), off)
        # The position before is only where the search for the next one starts.
        carry = lax.stop_gradient((t, q, system.rates(t, q, u)))
        return carry, (q, u, udot, off, met & determined)

    return lax.scan(advance, lax.stop_gradient((ts[0], guess.q, jnp.zeros_like(guess.q))), ts)[1]


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
