"""Dry friction that sticks exactly: Coulomb's law, with stick and slip as modes that change at exact times."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..linalg.complementarity import slip_direction
from ..linalg.rotations import norm
from . import fields
from .base import AbstractVelocityConstraint, Poses, ScalarCoordinate, Velocities, Wrenches
from .coordinate_parts import AbstractOfJoints, is_length
from .space import AbstractSpace
from .unilateral import AbstractRigidContact, AbstractUnilateralConstraint

# The mode of friction that sticks, as `jaxmb.system` numbers modes; 1 and -1 are those of slip in either direction.
_STICK = 2


class AbstractDryFriction(AbstractOfJoints, AbstractVelocityConstraint):
    """Coulomb friction in a joint or a rigid contact, along one direction of slip, or two in a contact in space.

    Subclasses define the velocity of `slip`. The scene has one coordinate, one velocity and one row more for each: its
    mode, `"rub.mode"`, which is 2 where it sticks, 1 or -1 where it slips forwards or backwards, and 0 before the
    start of a motion and in contacts that are open. Where it sticks, `slip = 0` is a constraint, whose force is at most
    `static_coefficient` times the normal force; where it slips, the force is `coefficient` times the normal force,
    against the slip. `simulate` finds the times at which one turns into the other.

    In a contact in space all of these are two, along two tangents. Its modes `"rub.mode_1"` and `"rub.mode_2"` are both
    2 where it sticks, and where it slips the components of a unit vector near the direction of slip, or of half of one
    where slip has begun from rest and is not to be seen yet.

    **Fields:** `joint`, its name; `coefficient` μ ≥ 0 of slip; `static_coefficient` ≥ μ of stick, default μ.
    """

    joint: str = fields.name()
    coefficient: fields.Number = fields.parameter(sign="non-negative", constant=True)
    static_coefficient: fields.Number = fields.parameter(sign="non-negative", optional=True, constant=True)
    linear: ClassVar[bool] = True
    homogeneous: ClassVar[bool] = True

    @property
    def rows(self) -> int:
        return 1

    @property
    def sources(self):
        return (self.joint,)

    @property
    def last(self) -> int:
        """The number of the joint's last body."""
        return len(self.joints["0"].bodies) - 1

    @property
    def limit(self) -> Array:
        """The coefficient of stick."""
        return self.coefficient if self.static_coefficient is None else self.static_coefficient

    def validate(self):
        if self.static_coefficient is not None and not self.static_coefficient >= self.coefficient:
            raise ValueError(
                f"{self.label}: static_coefficient must not be less than coefficient, got {self.static_coefficient} "
                f"and {self.coefficient}."
            )

    def scalar_coordinates(self, space, parts):
        if space.dimension == 3 and isinstance(parts.get(self.joint), AbstractRigidContact):
            return tuple(ScalarCoordinate(f"{self.name}.mode_{k}", moves=True) for k in (1, 2))
        return (ScalarCoordinate(f"{self.name}.mode", moves=True),)

    @abc.abstractmethod
    def slip(self, space: AbstractSpace, poses: Poses, velocities: Velocities) -> Float[Array, "rows"]:
        """The velocities of slip [m/s], from poses and velocities of the bodies of the joint."""

    def normal_force(self, space: AbstractSpace, poses: Poses, reactions: Wrenches) -> Float[Array, ""]:
        """The normal force [N], from the reactions of the joint on its bodies: the size of the force of a joint, and
        the force along the normal of a contact, which is positive where it pushes.
        """
        held = self.joints["0"]
        force = reactions[self.last, : space.dimension]
        if isinstance(held, AbstractRigidContact):
            return jnp.dot(held.outward(space, held.seen_poses(space, poses[: len(held.bodies)])), force)
        return norm(force)

    def residual(self, space, poses, velocities, t):
        del t
        slip, modes = self._slip(space, poses, velocities), velocities[-self.rows :, 0]
        return jnp.where(jnp.round(self._modes(poses)) == _STICK, slip, modes)

    def wrenches(
        self, space: AbstractSpace, poses: Poses, velocities: Velocities, reactions: Wrenches, t: float
    ) -> Wrenches:
        """The wrench of slip on each of the joint's bodies; `reactions`: those that the joint exerts besides."""
        del t
        slip, pull = jax.vjp(lambda v: self._slip(space, poses, v), velocities)
        force = self.coefficient * self.normal_force(space, poses, reactions)
        return pull(-force * slip_direction(self._modes(poses), slip))[0]

    def _slip(self, space, poses, velocities):
        at = jnp.array(self.places[0])
        return self.slip(space, poses[at], velocities[at])

    def _modes(self, poses):
        return lax.stop_gradient(poses[-self.rows :, 0])


class DryFriction(AbstractDryFriction):
    """Coulomb friction in a joint with one coordinate, or in a rigid contact, which sticks exactly.

    ```python
    block = planar.Body("block", mass=1.0, inertia=0.1)
    slide = planar.Prismatic("slide", "ground", "block", point=(0.0, 0.0), axis=(1.0, 0.0))
    rub = jaxmb.DryFriction("rub", "slide", coefficient=0.3, static_coefficient=0.4)
    scene = jaxmb.Scene([block], joints=[slide], forces=[rub, jaxmb.Gravity((0.0, -9.81))])
    ```

    The slip of a joint is the rate of its displacement, or `radius` times that of its angle; the normal force is the
    size of the joint's reaction force, in which moments do not count. The slip of a contact (`RigidContact`,
    `RigidBallContact`, `RigidPlaneContact`, `RigidBoxContact`) is the velocity of the last body against the other one
    where they touch: in the plane along the tangent that is the outward normal turned clockwise, so that on level
    ground it points along x; in space in the tangent plane, where the force has the direction of the slip (there is no
    moment against a spin about the normal). The normal force is that of the contact. In an impact the friction of the
    contacts has an impulse of at most `coefficient` times theirs, and just that where slip does not end; friction of
    joints has none.

    Several contacts in space that stick, as the feet of a table do, share forces that are not determined: they are as
    small as they can be, and where one reaches its limit others take more. Where the normal forces are not determined
    either, as those of four feet, the motion that slips may not be, and the run may end with a failure.

    `Trajectory.reactions["rub"]` is its force on the last body, of stick and of slip.

    If the normal force does not exist, or more than one does (Painlevé's paradox), the run ends with a failure that
    names the friction. `Friction` is smooth instead: it creeps where this one sticks.

    **Arguments:**

    - `joint`: the name of the joint or contact. Its reaction must be determinate: no other joint may imply any of its
      rows.
    - `coefficient` μ ≥ 0, of slip; `static_coefficient` ≥ μ, of stick, default μ.
    - `radius` [m] > 0 of the pin, for a joint whose coordinate is an angle.
    """

    radius: fields.Number = fields.length(sign="positive", optional=True)
    within: str = eqx.field(static=True, default_factory=str, init=False)
    # In a contact in space the axis from which its tangents turn, see `AbstractRigidContact.tangents`; otherwise zero.
    pole: int = eqx.field(static=True, default_factory=int, init=False)

    @property
    def rows(self):
        return 2 if self.pole else 1

    def complete(self, space, poses):
        held = self.joints["0"]
        if isinstance(held, AbstractUnilateralConstraint):
            return self._of_contact(space, held, poses)
        coordinates = self.coordinates_of(0, space, poses)
        numbers = [name for name, value in coordinates.items() if value.size == 1]
        if len(coordinates) != 1 or len(numbers) != 1:
            raise ValueError(
                f"{self.label}: {held.label} must have one coordinate, a number, as a pin or a slide has; it has "
                f"{', '.join(coordinates) or 'none'}. Use Friction."
            )
        (within,) = numbers
        if is_length(within) != (self.radius is None):
            needs = "slides and has no radius" if is_length(within) else "turns: give the radius of its pin"
            raise ValueError(f"{self.label}: {held.label} {needs}.")
        return self.with_fields(within=within)

    def _of_contact(self, space, held, poses):
        if self.radius is not None:
            raise ValueError(f"{self.label}: {held.label} slides and has no radius.")
        if not isinstance(held, AbstractRigidContact):
            raise ValueError(f"{self.label}: {held.label} has no point at which bodies touch, and no friction.")
        if space.dimension == 2:
            return self
        seen = jnp.asarray(held.seen_poses(space, poses[: len(held.bodies)]))
        normal = held.outward(space, seen)
        if len(held.bodies) == 2:
            normal = space.body_direction(seen[0], normal)
        # The axis nearest to the normal.
        k = int(np.argmax(np.abs(normal)))
        return self.with_fields(pole=(k + 1) * int(np.sign(normal[k])))

    def slip(self, space, poses, velocities):
        held = self.joints["0"]
        if isinstance(held, AbstractRigidContact):
            bodies = len(held.bodies)
            return held.slip(space, *held.seen(space, poses[:bodies], velocities[:bodies]), self.pole)
        rates = jax.vmap(space.rates)(poses, velocities)
        value = lambda x: held.coordinates_at(space, x)[self.within].reshape(())
        rate = jax.jvp(value, (poses,), (rates,))[1][None]
        return rate if self.radius is None else self.radius * rate
