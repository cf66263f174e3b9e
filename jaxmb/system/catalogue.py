"""The motions, quantities and forces of a system by name."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .._types import Coordinates, Scalar, State, Velocities
from .picture import Picture
from .quantities import Measure, Reaction, entries_along, view_of_motion
from .structures import of_structure


# Not a module: methods of modules take many times as long to call.
@dataclasses.dataclass(frozen=True)
class Catalogue:
    """Motions, quantities and forces by name, along a motion with time as axis 0: `ts` of shape (times,), `ys` a
    `State`, `multipliers` of shape (times, rows).

    This base class describes systems without bodies: their motion is the motion of their coordinates. Names follow from
    the structure of the system, and are cached for all systems of one structure.
    """

    system: Any

    def motion_names(self) -> tuple[str, ...]:
        """Names of the bodies, or of the coordinates of a system without bodies."""
        return tuple(self.system.coordinate_names())

    def motion(self, name: str, ys: State) -> Any:
        """The motion under a name of `motion_names`: a `BodyMotion`, or values of a coordinate, shape (times,)."""
        return _coordinate(np.array(self.system.coordinate_names()[name][0]), ys.q)

    @of_structure
    def measures(self) -> dict[str, Measure]:
        """All quantities of a motion, by name."""
        names, out = self.system.coordinate_names(), {}
        for name in self.motion_names():
            out[name] = Measure((), entries_along, ("q", np.array(names[name][0]), ()))
        for name, (index,) in names.items():
            out[f"{name}_rate"] = Measure((), _rate_along, np.array(index))
        for name in self.constraint_names():
            out[f"{name}.force"] = Measure((self.system.nu,), _force_along, self._rows_of(name), of_forces=True)
        return out

    @property
    def lost_headings(self) -> tuple[str, ...]:
        """For each of the system's `headings` what it means that it vanishes, for messages."""
        return ()

    def cautions(self, motion: Any, reach: Any) -> list[str]:
        """Sentences about a concrete motion in which a part is used beyond its model.

        **Arguments:** `reach`: of the `wrapped_angles` at the start, the least and the largest, shape (3, k); None if
        they were not counted.
        """
        del motion, reach
        return []

    def jumps_of_rows(self, t: Scalar, q: Coordinates) -> list[str]:
        """Sentences about constraints that jump at a concrete position."""
        del t, q
        return []

    @of_structure
    def joint_coordinates(self) -> dict[str, Any]:
        """The coordinates of joints by name; each has a `shape`."""
        return {}

    def joint_coordinate(self, coordinate: Any, t: Scalar, q: Coordinates) -> Float[Array, "*shape"]:
        """The value of a joint coordinate; an angle known up to full turns is in (−π, π]."""
        raise ValueError("This system has no joints between bodies, and so no coordinates of joints.")

    def position_quantities(self) -> tuple[str, ...]:
        """Names of quantities that determine the configuration up to the attitudes of bodies."""
        return self.motion_names()

    def rates_along(self, ts: Float[Array, "times"], ys: State) -> Float[Array, "times nq"]:
        """q̇ along a motion."""
        return _rates_along(self.system, (), ts, ys)

    def constraint_names(self) -> tuple[str, ...]:
        """Names of the parts that exert constraint forces."""
        return tuple(dict.fromkeys(name for name, _ in self.system.rows))

    def _rows_of(self, name) -> Bool[np.ndarray, "rows"]:
        return np.array([row == name for row, _ in self.system.rows])

    def constraint_force(
        self, name: str, ts: Float[Array, "times"], ys: State, multipliers: Float[Array, "times rows"]
    ) -> Float[Array, "times nu"]:
        """The part of one constraint in `Aᵀ λ`."""
        return _forces_along(self.system, self._rows_of(name), ts, ys, multipliers)

    # Forces on bodies; a system without bodies raises a `ValueError`.

    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        raise ValueError(_NO_REACTIONS)

    def reaction(
        self, name: str, ts: Float[Array, "times"], ys: State, multipliers: Float[Array, "times rows"]
    ) -> Reaction:
        """Reactions of one joint."""
        raise ValueError(_NO_REACTIONS)

    def undetermined(self, ts: Float[Array, "times"], ys: State) -> tuple[str, ...]:
        """Names of the joints and contacts whose shares of a force the equations leave open; without derivatives."""
        raise ValueError(_NO_REACTIONS)

    def force_names(self) -> tuple[str, ...]:
        """Names of the force elements."""
        raise ValueError(_NO_FORCES)

    def applied_wrenches(
        self, name: str, ts: Float[Array, "times"], ys: State, multipliers: Float[Array, "times rows"] | None
    ) -> Float[Array, "times bodies v"]:
        """Wrenches of one force element, or of the friction of one joint, on its bodies.

        `multipliers` may be None if the constraints are ideal.
        """
        raise ValueError(_NO_FORCES)

    def picture(self, ts: Float[Array, "times"], ys: State, deformation: float = 1.0) -> Picture:
        """The bodies and parts in a picture, where flexible bodies have `deformation` times their deformation.

        **Raises:** `ValueError` for a system without bodies.
        """
        kind = type(self.system).__name__
        raise ValueError(f"A picture shows bodies, and a {kind} has none; viz.plot_motion shows its coordinates.")

    def limits(self, t: Scalar, q: Coordinates) -> tuple[str, ...]:
        """The parts that are at a limit of their equations, for messages."""
        del t, q
        return ()

    def not_finite(self, t: Scalar, q: Coordinates, u: Velocities) -> tuple[str, ...]:
        """Names of forces, residuals and rates of internal states that are not finite at a state, for messages."""
        system, t = self.system, jnp.asarray(t, q.dtype)
        residuals = (system.position_residual(t, q), system.acceleration_residual(t, q, u, jnp.zeros_like(u)))
        wrong = [system.rows[k][0] for values in residuals for k in np.flatnonzero(~np.isfinite(np.asarray(values)))]
        forces = () if np.all(np.isfinite(system.force(t, q, u))) else ("the force on the coordinates",)
        return (*forces, *dict.fromkeys(f"the residual of {name!r}" for name in wrong))


# One program for all coordinates.
@jax.jit
def _coordinate(k, q):
    return lax.dynamic_index_in_dim(q, k, axis=-1, keepdims=False)


@view_of_motion
def _rates_along(system, place, ts, ys):
    del place
    return jax.vmap(lambda t, y: system.rates(t, y.q, y.u))(ts, ys)


@view_of_motion
def _rate_along(system, index, ts, ys, solved):
    del solved
    return _coordinate(index, _rates_along(system, (), ts, ys))


@view_of_motion
def _forces_along(system, rows, ts, ys, multipliers):
    multipliers = jnp.where(rows[None, :], multipliers, jnp.zeros_like(multipliers))
    return jax.vmap(lambda t, y, forces: system.constraint_force(t, y.q, y.u, forces))(ts, ys, multipliers)


@view_of_motion
def _force_along(system, rows, ts, ys, solved):
    return _forces_along(system, rows, ts, ys, solved.multipliers)


_NO_REACTIONS = "reactions are defined for joints between bodies; this system has constraint_forces."
_NO_FORCES = "forces are defined for parts that act on bodies; this system has none."
