"""Quantities that can be measured of a motion."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Array, Float


class Solved(NamedTuple):
    """What the equations of motion give along a motion: accelerations u̇ and multipliers, axis 0 is time."""

    accelerations: Float[Array, "times nu"]
    multipliers: Float[Array, "times rows"]


class Quantity(NamedTuple):
    """A quantity that can be measured of a motion, such as the position of a body or the force of a joint.

    **Fields:** `shape` at one time; `value(ts, ys, solved)`: its values along a motion, axis 0 is time; `of_forces`:
    whether the values depend on accelerations or multipliers, `solved`, which is None otherwise.
    """

    shape: tuple[int, ...]
    value: Callable[[Any, Any, Any], Array]
    of_forces: bool = False


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

    def __dir__(self) -> list[str]:
        return list(self._fields)

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"The motion of a body has {', '.join(self._fields)}; got {name!r}.")


class Reaction(NamedTuple):
    """The force that a joint exerts on the last of its bodies that is not the ground.

    **Fields:** `force` [N], world axes; `moment` [N m] about the joint's point on that body (its mass centre where the
    joint has none), world axes, a scalar in the plane; `multipliers` of the joint's rows. The other body receives the
    opposite.
    """

    force: Float[Array, "*times d"]
    moment: Float[Array, "..."]
    multipliers: Float[Array, "*times rows"]
