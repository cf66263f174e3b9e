"""Dry friction that sticks exactly: Coulomb's law, with stick and slip as modes that change at exact times."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..linalg.rotations import norm
from . import fields
from .base import AbstractVelocityConstraint, Poses, ScalarCoordinate, Velocities, Wrenches
from .coordinate_parts import AbstractOfJoints, is_length
from .space import AbstractSpace
from .unilateral import AbstractRigidContact, AbstractUnilateralConstraint

# The mode of friction that sticks, as `jaxmb.system` numbers modes; 1 and -1 are those of slip in either direction.
_STICK = 2


class AbstractDryFriction(AbstractOfJoints, AbstractVelocityConstraint):
    """Coulomb friction in a joint or a rigid contact, along one direction of slip.

    Subclasses define the velocity of `slip`. The scene has one coordinate, one velocity and one row more for each: its
    mode, `"rub.mode"`, which is 2 where it sticks, 1 or -1 where it slips forwards or backwards, and 0 before the
    start of a motion and in contacts that are open. Where it sticks, `slip = 0` is a constraint, whose force is at most
    `static_coefficient` times the normal force; where it slips, the force is `coefficient` times the normal force,
    against the slip. `simulate` finds the times at which one turns into the other.

    **Fields:** `joint`, its name; `coefficient` μ ≥ 0 of slip; `static_coefficient` ≥ μ of stick, default μ.
    """

    joint: str = fields.name()
    coefficient: fields.Number = fields.parameter(sign="non-negative", constant=True)
    static_coefficient: fields.Number = fields.parameter(sign="non-negative", optional=True, constant=True)
    rows: ClassVar[int] = 1
    linear: ClassVar[bool] = True
    homogeneous: ClassVar[bool] = True

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

    def scalar_coordinates(self, parts):
        del parts
        return (ScalarCoordinate(f"{self.name}.mode", moves=True),)

    @abc.abstractmethod
    def slip(self, space: AbstractSpace, poses: Poses, velocities: Velocities) -> Float[Array, ""]:
        """The velocity of slip [m/s], from poses and velocities of the bodies of the joint."""

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
        slip, mode = self._slip(space, poses, velocities), velocities[-1, 0]
        return jnp.where(self._kind(poses) == _STICK, slip, mode)[None]

    def wrenches(
        self, space: AbstractSpace, poses: Poses, velocities: Velocities, reactions: Wrenches, t: float
    ) -> Wrenches:
        """The wrench of slip on each of the joint's bodies; `reactions`: those that the joint exerts besides."""
        del t
        kind = self._kind(poses)
        direction = jnp.where(kind == _STICK, 0.0, kind)
        normal = self.normal_force(space, poses, reactions)
        along = jax.jacfwd(lambda v: self._slip(space, poses, v))(velocities)
        return -self.coefficient * normal * direction * along

    def _slip(self, space, poses, velocities):
        at = jnp.array(self.places[0])
        return self.slip(space, poses[at], velocities[at])

    def _kind(self, poses):
        return lax.stop_gradient(jnp.round(poses[-1, 0]))


class DryFriction(AbstractDryFriction):
    """Coulomb friction in a joint with one coordinate, or in a rigid contact in the plane, which sticks exactly.

    ```python
    jaxmb.DryFriction("rub", "slide", coefficient=0.3, static_coefficient=0.4)
    ```

    The slip of a joint is the rate of its displacement, or `radius` times that of its angle; the normal force is the
    size of the joint's reaction force, in which moments do not count. The slip of a contact (`RigidContact`,
    `RigidBallContact`, `RigidPlaneContact`, `RigidBoxContact`) is the velocity of the last body against the other one
    where they touch, along the tangent that is the outward normal turned clockwise, so that on level ground it points
    along x; the normal force is that of the contact. In an impact the friction of the contacts has an impulse of at
    most `static_coefficient` times theirs where slip ends, and of `coefficient` times theirs where it does not; that
    of joints has none.

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

    def complete(self, space, poses):
        held = self.joints["0"]
        if isinstance(held, AbstractUnilateralConstraint):
            return self._of_contact(space, held)
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

    def _of_contact(self, space, held):
        if space.dimension == 3:
            raise ValueError(f"{self.label}: friction of rigid contacts is planar; use a compliant contact in space.")
        if self.radius is not None:
            raise ValueError(f"{self.label}: {held.label} slides and has no radius.")
        if not isinstance(held, AbstractRigidContact):
            raise ValueError(f"{self.label}: {held.label} has no point at which bodies touch, and no friction.")
        return self

    def slip(self, space, poses, velocities):
        held = self.joints["0"]
        if isinstance(held, AbstractRigidContact):
            bodies = len(held.bodies)
            return held.slip(space, *held.seen(space, poses[:bodies], velocities[:bodies]))
        rates = jax.vmap(space.rates)(poses, velocities)
        value = lambda x: held.coordinates_at(space, x)[self.within].reshape(())
        rate = jax.jvp(value, (poses,), (rates,))[1]
        return rate if self.radius is None else self.radius * rate
