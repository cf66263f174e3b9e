"""A motion, with views by name."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from ._results import RESULTS
from ._types import State
from .formulations import AbstractFormulation, accelerations
from .manifold import project
from .parts.names import unknown
from .system import RigidBodySystem
from .system.reactions import Reaction, applied_force, constraint_force, force_names, joint_names, reaction


class ConstraintViolation(NamedTuple):
    """Largest residuals, scaled by the system's size; shape (times,). `position` of Φ, `velocity` of ψ [1/s]."""

    position: Float[Array, "times"]
    velocity: Float[Array, "times"]


class BodyMotion(NamedTuple):
    """Motion of one body; axis 0 is time.

    **Fields:** `position` [m] of the mass centre and `velocity` [m/s], world axes, shape (times, 2) or (times, 3); in
    the plane `angle` [rad] and `angular_velocity` [rad/s], shape (times,); in space `orientation` (Euler parameters,
    (times, 4)) and `angular_velocity` [rad/s] in the body frame, (times, 3). A point mass has no attitude: None.
    """

    position: Array
    velocity: Array
    angle: Array | None
    orientation: Array | None
    angular_velocity: Array | None


class _ByName(Mapping[str, Any]):
    """Something of each part by name, worked out when asked for."""

    def __init__(self, kind: str, names: tuple[str, ...], value: Callable[[str], Any]):
        self._kind, self._names, self._value = kind, names, value

    def __getitem__(self, name: str) -> Any:
        if name not in self._names:
            raise unknown(self._kind, name, self._names)
        return self._value(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


class Trajectory(eqx.Module):
    """What `simulate` returns.

    **Fields:** `ts` [s], shape (times,); `ys`, a `State` with a leading axis of time; `stats`, counts of the
    integration (`num_steps`, `num_rejected_steps`, `num_evaluations`, `newton_iterations`, `charts`, `orders`:
    accepted steps at order 1, 2, …; with `solver="auto"` or `"switch"` also `stiff` and `stiff_steps`; of `Hermite`
    `num_evaluations` of f with its time derivative, `num_matrices` made, and `points`: accepted steps with 1, 2, …
    points of the past); `result`, how it ended. `trajectory["crank"]` is the motion of a body, and of a
    system with coordinates of the user's that of a coordinate, shape (times,).
    """

    system: Any
    formulation: AbstractFormulation
    ts: Float[Array, "times"]
    ys: Any
    stats: dict[str, Any]
    result: RESULTS
    interpolation: diffrax.AbstractPath | None
    event_mask: Any

    def __getitem__(self, body: str) -> Any:
        system = self.system
        if not isinstance(system, RigidBodySystem):
            names = system.coordinate_names()
            if body not in names:
                raise unknown("coordinate", body, names)
            return self.ys.q[:, names[body][0]]
        if body not in system.body_names:
            raise unknown("body", body, system.body_names)
        k = system.body_names.index(body)
        d = system.layout.space.dimension
        # Entries of a body follow one another.
        i, j = int(system.layout.pose_index[k][0]), int(system.layout.velocity_index[k][0])
        position, velocity = self.ys.q[:, i : i + d], self.ys.u[:, j : j + d]
        if not system.layout.rotates[k]:
            return BodyMotion(position, velocity, None, None, None)
        if d == 2:
            return BodyMotion(position, velocity, self.ys.q[:, i + 2], None, self.ys.u[:, j + 2])
        return BodyMotion(position, velocity, None, self.ys.q[:, i + 3 : i + 7], self.ys.u[:, j + 3 : j + 6])

    def at(self, t: ArrayLike) -> State:
        """The state at any time or times [s] of a run with `SaveAt(dense=True)`, on the constraints."""
        interpolation = self.interpolation
        if interpolation is None:
            raise ValueError("at(t) needs simulate(..., saveat=diffrax.SaveAt(dense=True)).")
        t = jnp.asarray(t, self.ys_dtype)
        out = _between(self.system, interpolation, t.reshape(-1))
        return jax.tree.map(lambda y: y.reshape(t.shape + y.shape[1:]), out)

    @property
    def ys_dtype(self):
        return self.system.guess.q.dtype

    @property
    @eqx.filter_jit
    def kinetic_energy(self) -> Float[Array, "times"]:
        """Kinetic energy [J]."""
        return jax.vmap(lambda t, y: self.system.kinetic_energy(t, y.q, y.u))(self.ts, self.ys)

    @property
    @eqx.filter_jit
    def potential_energy(self) -> Float[Array, "times"]:
        """Potential energy [J] of gravity and conservative forces."""
        return jax.vmap(lambda t, y: self.system.potential_energy(t, y.q))(self.ts, self.ys)

    @property
    def energy(self) -> Float[Array, "times"]:
        """Kinetic and potential energy [J]."""
        return self.kinetic_energy + self.potential_energy

    @property
    @eqx.filter_jit
    def linear_momentum(self) -> Float[Array, "times d"]:
        """`Σ m v` [kg m/s], world axes."""
        return jax.vmap(lambda y: self.system.linear_momentum(y.q, y.u))(self.ys)

    @property
    @eqx.filter_jit
    def angular_momentum(self) -> Float[Array, "times *d"]:
        """Moment of momentum about the world origin [kg m²/s]."""
        return jax.vmap(lambda y: self.system.angular_momentum(y.q, y.u))(self.ys)

    @property
    @eqx.filter_jit
    def rates(self) -> Float[Array, "times nq"]:
        """q̇ of every coordinate."""
        return jax.vmap(lambda t, y: self.system.rates(t, y.q, y.u))(self.ts, self.ys)

    @property
    def accelerations(self) -> Float[Array, "times nu"]:
        """u̇ of every velocity."""
        return self._solved[0]

    @property
    def multipliers(self) -> Float[Array, "times rows"]:
        """Multipliers λ of every row, `M u̇ = F + Aᵀλ`; zero for implied rows."""
        return self._solved[1]

    @property
    @eqx.filter_jit
    def _solved(self):
        return jax.vmap(lambda t, y: accelerations(self.system, self.formulation, t, y.q, y.u))(self.ts, self.ys)

    @property
    def reactions(self) -> Mapping[str, Reaction]:
        """Forces of the joints of rigid bodies by name: `reactions["A"].force`."""
        if not isinstance(self.system, RigidBodySystem):
            raise ValueError("reactions are of joints between bodies; this system has constraint_forces.")
        return self._by_constraint(reaction)

    @property
    def constraint_forces(self) -> Mapping[str, Array]:
        """Generalized forces `Aᵀ λ` of the constraints by name, shape (times, nu)."""
        return self._by_constraint(constraint_force)

    def _by_constraint(self, what):
        value = lambda name: _of_constraint(what, self.system, name, self.ts, self.ys, self.multipliers)
        return _ByName("joint", joint_names(self.system), value)

    @property
    def forces(self) -> Mapping[str, Array]:
        """Wrenches of the applied forces by name, on each of the part's bodies in order, shape (times, bodies, 3) or
        (times, bodies, 6): force [N] in world axes and moment [N m] about the mass centre, in space in body axes.
        """
        if not isinstance(self.system, RigidBodySystem):
            raise ValueError("forces are of parts that act on bodies; this system has none.")
        value = lambda name: _of_force(self.system, name, self.ts, self.ys)
        return _ByName("force", force_names(self.system), value)

    @property
    @eqx.filter_jit
    def constraint_violation(self) -> ConstraintViolation:
        """Largest scaled residuals of position and velocity constraints at every saved time."""

        def at(t, y):
            length = self.system.length
            position = jnp.max(jnp.abs(self.system.coordinate_residual(t, y.q)), initial=0.0) / length
            velocity = jnp.max(jnp.abs(self.system.velocity_residual(t, y.q, y.u)), initial=0.0)
            return ConstraintViolation(position, velocity / length)

        return jax.vmap(at)(self.ts, self.ys)

    def trimmed(self) -> "Trajectory":
        """Without the padding of `SaveAt(steps=True)` and of runs that ended early; the same under `jit` and `vmap`."""
        if isinstance(self.ts, Tracer) or self.ts is None or self.ts.ndim != 1:
            return self
        finite = np.isfinite(np.asarray(self.ts))
        if finite.all():
            return self
        where = lambda t: (t.ts, t.ys)
        return eqx.tree_at(where, self, (self.ts[finite], jax.tree.map(lambda y: y[finite], self.ys)))

    def to_dict(self) -> dict[str, np.ndarray]:
        """Arrays by name: `t`, `energy`, `"crank.angle"`, …, and `stats.…`."""
        out = {"t": np.asarray(self.ts), "q": np.asarray(self.ys.q), "u": np.asarray(self.ys.u)}
        if isinstance(self.system, RigidBodySystem):
            for body in self.system.body_names:
                for field, value in self[body]._asdict().items():
                    if value is not None:
                        out[f"{body}.{field}"] = np.asarray(value)
        else:
            out |= {name: np.asarray(self[name]) for name in self.system.coordinate_names()}
        out["energy"] = np.asarray(self.energy)
        for name, value in self.stats.items():
            if value is not None:
                out[f"stats.{name}"] = np.asarray(value)
        return out

    def save(self, path: str | Path) -> None:
        """Write `to_dict` as a compressed `.npz`."""
        np.savez_compressed(path, allow_pickle=False, **self.to_dict())  # pyright: ignore[reportArgumentType]


@eqx.filter_jit
def _of_constraint(what, system, name, ts, ys, multipliers):
    return jax.vmap(lambda t, y, own: what(system, name, t, y, own))(ts, ys, multipliers)


@eqx.filter_jit
def _of_force(system, name, ts, ys):
    return jax.vmap(lambda t, y: applied_force(system, name, t, y))(ts, ys)


@eqx.filter_jit
def _between(system, interpolation, ts):
    def single(t):
        y = interpolation.evaluate(t)
        return project(system, t, State(system.normalize(y.q), y.u))

    return jax.vmap(single)(ts)


def load(path: str | Path) -> dict[str, np.ndarray]:
    """Read what `Trajectory.save` wrote, as a dictionary of arrays."""
    with np.load(path) as data:
        return {name: data[name] for name in data.files}
