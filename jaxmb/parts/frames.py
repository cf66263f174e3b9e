"""Named frames in bodies, which parts may act on and whose motion may be observed."""

import abc
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..linalg.arrays import namespace
from . import fields
from .base import GROUND, AbstractBody, AbstractFlexibleBody, AbstractPart
from .names import unknown
from .space import AbstractSpace, Point, Pose, Velocity, Wrench


class AbstractFrame(AbstractPart):
    """A frame in a body. A part that names it in place of the body sees the pose and the velocity of the frame: points
    and axes given with the part are in the frame's axes, from its origin.

    Kinematics are given from the body itself, and from its modal coordinates ζ and their rates if the frame moves with
    them.

    **Fields:** `rows`, which a scene fills in: where these modal coordinates begin and end among the bodies of the part
    that names the frame.
    """

    name: str = fields.name()
    body: str = fields.body_name()
    rows: tuple[int, int] = eqx.field(static=True, default_factory=lambda: (0, 0), init=False)
    # Further quantities along a motion, from a method `measured`: their shapes by name, with `"d"` for the dimension.
    quantities: ClassVar[Mapping[str, tuple[Any, ...]]] = MappingProxyType({})

    @property
    @abc.abstractmethod
    def of_body(self) -> str:
        """The name of the body that the frame is in."""

    @property
    @abc.abstractmethod
    def is_flexible(self) -> bool:
        """Whether the frame moves in its body with the body's modal coordinates."""

    @abc.abstractmethod
    def pose(self, space: AbstractSpace, pose: Pose, *zeta: Array) -> Pose:
        """The frame's pose; with prepared quantities if the body's has them."""

    @abc.abstractmethod
    def velocity(self, space: AbstractSpace, pose: Pose, velocity: Velocity, *modal: Array) -> Velocity:
        """The frame's velocity."""

    @abc.abstractmethod
    def wrench(self, space: AbstractSpace, pose: Pose, wrench: Wrench, *zeta: Array) -> Wrench:
        """The wrench on the body that is equivalent to a wrench on the frame."""

    @abc.abstractmethod
    def modal_force(self, space: AbstractSpace, pose: Pose, wrench: Wrench, zeta: Array) -> Float[Array, "k"]:
        """The generalized forces on the modal coordinates by a wrench on a frame that moves with them."""

    @abc.abstractmethod
    def wrench_on_frame(self, space: AbstractSpace, pose: Pose, wrench: Wrench, *zeta: Array) -> Wrench:
        """The wrench on the frame that is equivalent to a wrench on the body."""

    @abc.abstractmethod
    def point(self, space: AbstractSpace, point: Point, *zeta: Array) -> Point:
        """The point of the body [m] at a point of the frame; without ζ of the undeformed body."""

    def modal(self, rows: Array) -> tuple[Array, ...]:
        """The modal coordinates with which it moves, or their rates, from rows of a part's bodies; none if it is fixed
        in its body.
        """
        start, end = self.rows
        return (rows[start:end, 0],) if end > start else ()

    def pose_in_body(self, space: AbstractSpace, *zeta: Any) -> Pose:
        """The frame's pose in the axes of the body; without ζ of the undeformed body."""
        start, end = self.rows
        if end > start and not zeta:
            zeta = (np.zeros(end - start),)
        origin: Any = np.array(space.ground)
        return self.pose(space, origin, *zeta)


class AbstractFixedFrame(AbstractFrame):
    """A frame fixed in a body or in another frame; a scene fills in its `base`, the other frame, or None."""

    base: Any = fields.part(AbstractPart)

    @abc.abstractmethod
    def own_pose(self, space: AbstractSpace, pose: Pose) -> Pose:
        """The frame's pose from its base's, with or without prepared quantities."""

    @abc.abstractmethod
    def own_velocity(self, space: AbstractSpace, pose: Pose, velocity: Velocity) -> Velocity:
        """The frame's velocity from pose and velocity of its base."""

    @abc.abstractmethod
    def own_wrench(self, space: AbstractSpace, pose: Pose, wrench: Wrench) -> Wrench:
        """The wrench on the base that is equivalent to a wrench on the frame."""

    @abc.abstractmethod
    def own_point(self, point: Point) -> Point:
        """The point of the base [m] at a point of the frame."""

    @property
    def of_body(self):
        return self.body if self.base is None else self.base.of_body

    @property
    def is_flexible(self):
        return self.base is not None and self.base.is_flexible

    def pose(self, space, pose, *zeta):
        placed = self.own_pose(space, pose if self.base is None else self.base.pose(space, pose, *zeta))
        return space.prepare(placed) if pose.shape[0] > placed.shape[0] else placed

    def velocity(self, space, pose, velocity, *modal):
        if self.base is not None:
            velocity = self.base.velocity(space, pose, velocity, *modal)
            pose = self.base.pose(space, pose, *modal[:1])
        return self.own_velocity(space, pose, velocity)

    def wrench(self, space, pose, wrench, *zeta):
        if self.base is None:
            return self.own_wrench(space, pose, wrench)
        return self.base.wrench(space, pose, self._on_base(space, pose, wrench, *zeta), *zeta)

    def modal_force(self, space, pose, wrench, zeta):
        return self.base.modal_force(space, pose, self._on_base(space, pose, wrench, zeta), zeta)

    def _on_base(self, space, pose, wrench, *zeta):
        return self.own_wrench(space, self.base.pose(space, pose, *zeta), wrench)

    def wrench_on_frame(self, space, pose, wrench, *zeta):
        if self.base is not None:
            wrench = self.base.wrench_on_frame(space, pose, wrench, *zeta)
            pose = self.base.pose(space, pose, *zeta)
        d = space.dimension
        at_origin = space.point_force(pose, self.own_point(jnp.zeros(d, wrench.dtype)), wrench[:d])
        # Moments transform like angular velocities.
        moment = jnp.concatenate([jnp.zeros_like(wrench[:d]), wrench[d:] - at_origin[d:]])
        return jnp.concatenate([wrench[:d], self.own_velocity(space, pose, moment)[d:]])

    def point(self, space, point, *zeta):
        in_base = self.own_point(point)
        return in_base if self.base is None else self.base.point(space, in_base, *zeta)


class AbstractFlexibleFrame(AbstractFrame):
    """A frame that moves in a flexible body with its modal coordinates ζ, by the function `pose_at`.

    ```python
    class OnSlide(jaxmb.parts.AbstractFlexibleFrame):
        # The place of the bob in the example of `AbstractFlexibleBody`.
        dimensions = (2,)

        def pose_at(self, space, pose, zeta):
            return jnp.append(space.point(pose, jnp.append(zeta, 0.0)), pose[2])

    pull = planar.PointForce("pull", "bob", force=(1.0, 0.0))
    system = jaxmb.Scene([box], forces=[pull], frames=[OnSlide("bob", "box")]).compile()
    ```

    Parts that name it load the modal coordinates too. Its velocity and the forces along ζ follow from its pose.
    """

    quantities: ClassVar[Mapping[str, tuple[Any, ...]]] = MappingProxyType({"deflection": ("d",)})

    def placed(self, body: AbstractFlexibleBody) -> Self:
        """Hook: the frame in this body. A frame whose pose depends on the body's numbers is a copy that holds the body,
        in a field declared with `part`.

        **Raises:** `ValueError` for a body in which it cannot be.
        """
        del body
        return self

    def measured(self, space: AbstractSpace, zeta: Float[Array, "k"]) -> dict[str, Array]:
        """Hook: further quantities along a motion by name, such as the `deflection`, the displacement [m] of the origin
        in the body's axes.
        """
        origin = jnp.zeros(space.dimension, zeta.dtype)
        return {"deflection": self.point(space, origin, zeta) - self.point(space, origin, jnp.zeros_like(zeta))}

    @abc.abstractmethod
    def pose_at(self, space: AbstractSpace, pose: Pose, zeta: Float[Array, "k"]) -> Pose:
        """The frame's pose, without prepared quantities, from the body's and from ζ."""

    @property
    def of_body(self):
        return self.body

    @property
    def is_flexible(self):
        return True

    def pose(self, space, pose, *zeta):
        placed = self.pose_at(space, pose, *zeta)
        return space.prepare(placed) if pose.shape[0] > placed.shape[0] else placed

    def velocity(self, space, pose, velocity, *modal):
        zeta, rates = modal
        at = lambda pose, zeta: self.pose_at(space, pose, zeta)
        placed, rate = jax.jvp(at, (pose, zeta), (space.rates(pose, velocity), rates))
        # The rows of N are orthogonal, and the rate is a combination of them.
        moves = space.moves(space.prepare(placed))[:, : space.pose_size]
        return moves @ rate / jnp.sum(moves**2, axis=1)

    def point(self, space, point, *zeta):
        return space.point(self.pose_in_body(space, *zeta), point)

    def wrench(self, space, pose, wrench, *zeta):
        return self._loads(space, pose, wrench, *zeta)[0]

    def modal_force(self, space, pose, wrench, zeta):
        return self._loads(space, pose, wrench, zeta)[1]

    def _loads(self, space, pose, wrench, zeta):
        """The wrench on the body, and the forces along ζ, by their power."""
        rest = jnp.zeros_like(wrench), jnp.zeros_like(zeta)
        return jax.vjp(lambda v, rates: self.velocity(space, pose, v, zeta, rates), *rest)[1](wrench)

    def wrench_on_frame(self, space, pose, wrench, *zeta):
        d, placed = space.dimension, self.pose(space, pose, *zeta)
        moment = wrench[d:] - space.force_at(pose, placed[:d], wrench[:d])[d:]
        turning = space.turning(pose, jnp.concatenate([jnp.zeros_like(wrench[:d]), moment]))
        return jnp.concatenate([wrench[:d], space.moment(placed, turning)[d:]])


class LinkFrame(AbstractFixedFrame):
    """The frame of a body whose mass centre is not its origin.

    **Arguments:** `centre` [m]: the mass centre in the frame, whose axes are the body's.
    """

    centre: fields.Number = fields.parameter(shape=("d",), unit="m")

    def own_pose(self, space, pose):
        # Prepared quantities belong to the attitude, which is the body's.
        xp = namespace(pose, self.centre)
        return xp.concatenate([space.point(pose, -self.centre), pose[space.dimension :]])

    def own_velocity(self, space, pose, velocity):
        d = space.dimension
        return jnp.concatenate([space.point_velocity(pose, velocity, -self.centre), velocity[d:]])

    def own_wrench(self, space, pose, wrench):
        d = space.dimension
        moment = jnp.concatenate([jnp.zeros_like(wrench[:d]), wrench[d:]])
        return space.point_force(pose, -self.centre, wrench[:d]) + moment

    def own_point(self, point):
        return point - self.centre


def frames_by_name(frames: Sequence[AbstractFrame], bodies: Sequence[AbstractBody]) -> dict[str, AbstractFrame]:
    """Checked frames with their bases, by name; each body whose mass centre is not its origin has a frame under its own
    name.

    **Raises:** `ValueError` for frames on unknown bodies, and frames that are fixed in themselves.
    """
    given, bodies_by_name = {frame.name: frame for frame in frames}, {body.name: body for body in bodies}
    out: dict[str, Any] = {
        name: LinkFrame(name=name, body=name, centre=centre)
        for name, body in bodies_by_name.items()
        if (centre := body.mass_centre) is not None
    }

    def based(name, path):
        if name in out or name not in given:
            return
        frame: Any = given[name]
        if name in path:
            raise ValueError(f"{frame.label} is fixed in itself, by way of {', '.join(map(repr, path))}.")
        if frame.body not in (*given, *bodies_by_name, GROUND):
            raise unknown("body", frame.body, [*bodies_by_name, GROUND, *given], frame.label)
        based(frame.body, (*path, name))
        frame.check(bodies[0].dimension)
        if isinstance(frame, AbstractFixedFrame):
            out[name] = frame.with_fields(base=out.get(frame.body))
        elif isinstance(bodies_by_name.get(frame.body), AbstractFlexibleBody):
            out[name] = frame.placed(bodies_by_name[frame.body])
        else:
            raise ValueError(
                f"{frame.label} moves with modal coordinates, and {frame.body!r} has none; name a flexible body, or "
                "use a Frame, which is fixed."
            )

    for name in given:
        based(name, ())
    return out
