"""Dry friction that sticks exactly: Coulomb's law, with stick and slip as modes that change at exact times."""

import abc
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._compat import with_values
from ..linalg.jitted import on_host
from ..linalg.rotations import norm
from ..linalg.sums import unchecked_take
from . import fields
from .base import (
    AbstractForce,
    AbstractLink,
    AbstractPart,
    AbstractVelocityConstraint,
    Poses,
    ScalarCoordinate,
    Velocities,
)
from .combinations import JointCoupling
from .contact_laws import AbstractSlipLaw, Coulomb, GivenForce
from .coordinate_parts import AbstractCoordinateForce, AbstractOfJoints, AbstractScalarPart
from .modes import CLOSED, STICK, kind_of, slip_direction
from .space import AbstractSpace, rate_of
from .unilateral import AbstractRigidContact, AbstractUnilateralConstraint

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class AbstractStickSlip(AbstractVelocityConstraint):
    """A law of dry friction whose rows stick or slip, each by its mode: a scalar coordinate after the bodies."""

    linear: ClassVar[bool] = True
    # The number of directions of one slip: two rows that stick and slip together, or one.
    directions: AbstractVar[int]
    # What the law needs of its joint: reaction "wrenches", the "multipliers" of its rows, the "normal" force of a
    # contact, or "nothing" if the friction does not depend on a normal force.
    needs: AbstractVar[Any]

    @property
    @abc.abstractmethod
    def contact_law(self) -> AbstractSlipLaw:
        """The law of each row."""

    @property
    def coupled(self) -> bool:
        """Whether the normal force of a row depends on the friction of other rows without other constraints."""
        return False

    @property
    def homogeneous(self) -> bool:
        return True

    @property
    @abc.abstractmethod
    def joint_name(self) -> str:
        """The name of the joint or contact that rubs, whose force is the normal force."""

    def residual(self, space, poses, velocities, t):
        del t
        slip, modes = self.slips(space, poses, velocities), velocities[-self.rows :, 0]
        return jnp.where(kind_of(self._modes(poses)) == STICK, slip, modes)

    @abc.abstractmethod
    def slips(self, space: AbstractSpace, poses: Poses, velocities: Velocities) -> Float[Array, "rows"]:
        """The velocities of slip [m/s], from poses and velocities of all bodies and modes."""

    @abc.abstractmethod
    def normal_force(self, space: AbstractSpace, poses: Poses, reactions: Any) -> Float[Array, "..."]:
        """The normal force [N], from what the law `needs` of its joint."""

    def slip_forces(
        self, space: AbstractSpace, poses: Poses, slips: Float[Array, "rows"], reactions: Any
    ) -> Float[Array, "rows"]:
        """The forces [N] of slip along the directions of slip, zero in stick, from the `slips` and from what the law
        `needs` of its joint.
        """
        # The direction does not depend on reactions; an iteration solves for these.
        law, against = self.contact_law, -slip_direction(self._modes(poses), slips)
        speed = norm(slips) if law.varies else jnp.zeros((), slips.dtype)
        size = law.coefficient(speed) * self.normal_force(space, poses, reactions)
        return (size + law.resistance(speed) if law.resists else size) * against

    def limits(self, space: AbstractSpace, poses: Poses, reactions: Any) -> Float[Array, "rows"]:
        """The normal force for each direction of slip; linear in the reactions, from contacts and joint rows."""
        return jnp.broadcast_to(self.normal_force(space, poses, reactions), (self.rows,))

    def _modes(self, poses):
        return lax.stop_gradient(poses[-self.rows :, 0])


class AbstractDryFriction(AbstractOfJoints, AbstractStickSlip):
    """Coulomb friction in a joint or a rigid contact, along one direction of slip, or two in a contact in space.

    Subclasses define the velocity of `slip`. The part adds one coordinate, one velocity and one row to the scene. The
    coordinate is its mode, `"rub.mode"`: 2 for stick, 1 or -1 for slip forwards or backwards, and 0 before the start of
    a motion and in open contacts. In stick, `slip = 0` is a constraint whose force is at most `static_coefficient`
    times the normal force. In slip, the force is `coefficient` times the normal force, against the slip. `simulate`
    finds the times of transitions.

    Contacts in space, and joints whose bodies slide over each other in two directions, add two of each. The modes
    `"rub.mode_1"` and `"rub.mode_2"` are both 2 in stick. In slip they are the components of a vector near the
    direction of slip: of length one, or one half if slip has just begun from rest and is still below its tolerance.

    **Fields:** `joint`, its name, or `"joint.coordinate"`; `coefficient` μ ≥ 0 in slip; `static_coefficient` ≥ μ in
    stick, default μ.
    """

    joint: str = fields.name()
    coefficient: fields.Number = fields.parameter(unit="1", sign="non-negative")
    static_coefficient: fields.Number = fields.parameter(unit="1", sign="non-negative", optional=True)
    directions: int = eqx.field(static=True, default_factory=lambda: 1, init=False)

    @property
    def needs(self) -> Literal["wrenches", "multipliers", "normal"]:
        return "normal" if self.in_contact else "wrenches"

    @property
    def contact_law(self):
        return Coulomb(self.coefficient, self.static_coefficient)

    @property
    def in_contact(self) -> bool:
        """Whether it rubs in a rigid contact."""
        return isinstance(self.joints["0"], AbstractRigidContact)

    @property
    def rows(self) -> int:
        return self.directions

    @property
    def joint_name(self) -> str:
        return self.joint.partition(".")[0]

    @property
    def sources(self):
        return (self.joint_name,)

    @property
    def last(self) -> int:
        """The index of the joint's last body."""
        return len(self.joints["0"].bodies) - 1

    def validate(self):
        if self.static_coefficient is not None and not self.static_coefficient >= self.coefficient:
            raise ValueError(
                f"{self.label}: static_coefficient must not be less than coefficient, got {self.static_coefficient} "
                f"and {self.coefficient}."
            )

    def numbers_agree(self):
        return True if self.static_coefficient is None else self.static_coefficient >= self.coefficient

    def scalar_coordinates(self, space, parts):
        if self._directions(space, parts.get(self.joint_name)) == 2:
            return tuple(ScalarCoordinate(f"{self.name}.mode_{k}", moves=True) for k in (1, 2))
        return (ScalarCoordinate(f"{self.name}.mode", moves=True),)

    def complete(self, space, poses):
        return self.with_fields(directions=self._directions(space, self.joints["0"]))

    def _directions(self, space: AbstractSpace, held: AbstractPart | None) -> int:
        """The number of directions of slip in a joint or contact."""
        if isinstance(held, AbstractRigidContact):
            return space.dimension - 1
        return 2 if isinstance(held, AbstractLink) and held.slides and "." not in self.joint else 1

    @abc.abstractmethod
    def slip(self, space: AbstractSpace, poses: Poses, velocities: Velocities) -> Float[Array, "rows"]:
        """The velocities of slip [m/s], from poses and velocities of the bodies of the joint."""

    def normal_force(self, space: AbstractSpace, poses: Poses, reactions: Array) -> Float[Array, ""]:
        """The normal force [N]: the size of a joint's force, from the reactions on its bodies; or a closed contact's
        force along its normal, positive if it pushes.
        """
        if not self.in_contact:
            return norm(reactions[self.last, : space.dimension])
        closed = kind_of(lax.stop_gradient(poses[self.places[0][-1], 0])) == CLOSED
        return jnp.where(closed, reactions[0], 0.0)

    def seen_wrenches(self, space, poses, wrenches):
        return super().seen_wrenches(space, poses, wrenches) if self.needs == "wrenches" else wrenches

    def slips(self, space, poses, velocities):
        at = np.array(self.places[0])
        return self.slip(space, unchecked_take(poses, at), unchecked_take(velocities, at))


class DryFriction(AbstractDryFriction):
    """Coulomb friction in a joint or in a rigid contact, which sticks exactly.

    ```python
    block = planar.Body("block", mass=1.0, inertia=0.1)
    slide = planar.Prismatic("slide", "ground", "block", point=(0.0, 0.0), axis=(1.0, 0.0))
    rub = jaxmb.DryFriction("rub", "slide", coefficient=0.3, static_coefficient=0.4)
    scene = jaxmb.Scene([block], joints=[slide], forces=[rub, jaxmb.Gravity((0.0, -9.81))])
    ```

    The slip of a joint is the rate of its displacement, or `radius` times the rate of its angle. In a
    `spatial.Cylindrical` it has both as components, and in a `spatial.Planar` both rates of displacement. Friction then
    acts against the direction of slip: a turning pin slides along its axis under the smallest force. Other joints with
    several coordinates need a name such as `"cardan.angle_a"`, and a separate part for each. The normal force is the
    size of the joint's reaction force, without moments.

    The slip of a contact (`RigidContact`, `RigidBallContact`, `RigidPlaneContact`, `RigidBoxContact`) is the velocity
    of the last body relative to the other body at the point of contact. In the plane it is taken along the outward
    normal turned clockwise, which on level ground points along x. In space it lies in the tangent plane, with
    components along two tangents, x and y on level ground; the force is opposite to it, without a moment against spin
    about the normal. The normal force is the contact's. In an impact, friction in contacts has an impulse of at most
    `coefficient` times the contact's, and exactly this if slip does not end; friction in joints has none.

    In a gear, a `JointCoupling`, it acts along the first coordinate, and the normal force is the gear's force or moment
    along it. With the coefficient c the efficiency of the gear is `1 − c` where power leaves it by this coordinate, and
    `1 / (1 + c)` where power enters there.

    In the thread of a `spatial.Screw` it acts about `"screw.angle"`, by the whole force of the joint; `Screw` has the
    coefficient.

    With a `speed` the first body, or the terrain, is a belt: its surface moves at this speed along the directions of
    slip, and slip is measured against it.

    Several contacts in space that stick, such as the feet of a table, share undetermined forces. These are as small as
    possible, and where a contact reaches its limit others take more. If the normal forces are undetermined too, as with
    four feet, their shares are as small as possible. In slip they may leave the motion undetermined, as of a table that
    slides and spins: the run ends there with a failure that names contacts and friction. In the plane the run finds a
    possible distribution, in which a foot of a body at rest may be at its limit: its mode is slip, at velocity zero,
    and another foot bears the rest. The motion and the sum of the forces are determined.

    `Trajectory.reactions["rub"]` is its force on the last body, in stick and in slip.

    If no normal force exists, or several do (Painlevé's paradox), the run ends with a failure that names the friction.
    `JointFriction(…, exact=True)` has a given size, without a normal force. `Friction` lists the ways in which a joint
    rubs.

    **Arguments:**

    - `joint`: the name of the joint, contact or gear, or `"joint.coordinate"`. The reaction must be determinate: no
      other joint may imply any of its rows.
    - `coefficient` μ ≥ 0 in slip; `static_coefficient` ≥ μ in stick, default μ. Both may be inputs, as of a brake that
        closes: `inputs={"rub.coefficient": Series(ts, values, "held")}`. Stick never has the smaller one.
    - `radius` [m] > 0 of the pin, for a coordinate that is an angle.
    - `speed` [m/s] of a belt, a number, or two numbers for two directions of slip; default none.
    """

    radius: fields.Number = fields.length(sign="positive", optional=True)
    speed: fields.Number = fields.parameter(shape=None, unit="m/s", optional=True, constant=True)
    # The coordinates of a joint whose rates are the slip.
    within: tuple[str, ...] = eqx.field(static=True, default_factory=tuple, init=False)
    # The axis from which the tangents of a contact in space turn, see `AbstractRigidContact.tangents`; otherwise zero.
    pole: int = eqx.field(static=True, default_factory=int, init=False)
    # Whether it rubs in a coupling of coordinates, along the first of them.
    in_gear: bool = eqx.field(static=True, default_factory=bool, init=False)

    @property
    def needs(self):
        return "multipliers" if self.in_gear else super().needs

    @property
    def homogeneous(self):
        return self.speed is None

    def complete(self, space, poses):
        held, part = self.joints["0"], super().complete(space, poses)
        shape = () if part.directions == 1 else (2,)
        if self.speed is not None and np.shape(self.speed) != shape:
            raise ValueError(
                f"{self.label}: slip has {'one direction' if shape == () else 'two directions'}, and speed must have "
                f"shape {shape}, got {np.shape(self.speed)}."
            )
        if isinstance(held, AbstractUnilateralConstraint):
            return part._of_contact(space, held, poses)
        # A concrete class: no other joint without coordinates has a force along one of them.
        if isinstance(held, JointCoupling):
            if self.radius is not None or "." in self.joint:
                raise ValueError(f"{self.label}: friction in {held.label} is given by its name, without a radius.")
            return part.with_fields(in_gear=True)
        within = part._slip_coordinates(space, held, poses)
        if all(self.source_is_length(0, name) for name in within) != (self.radius is None):
            needs = "slides and has no radius" if self.radius is not None else "turns: give the radius of its pin"
            raise ValueError(f"{self.label}: {held.label} {needs}.")
        return part.with_fields(within=within)

    def _slip_coordinates(self, space, held, poses) -> tuple[str, ...]:
        """The coordinates of the joint whose rates are the slip."""
        coordinates = self.coordinates_of(0, space, poses)
        numbers = [name for name, value in coordinates.items() if value.size == 1]
        named = self.joint.partition(".")[2]
        if named:
            if self.given_coordinate(0, self.joint, space, poses).size != 1:
                raise ValueError(f"{self.label}: {self.joint!r} must be a number.")
            return (named,)
        if held.slides:
            return held.slides
        if len(coordinates) == len(numbers) == 1:
            return tuple(numbers)
        if numbers:
            names = " or ".join(repr(f"{self.joint}.{name}") for name in numbers)
            raise ValueError(f"{self.label}: {held.label} has several coordinates: give {names} as joint.")
        raise ValueError(
            f"{self.label}: {held.label} has no coordinate that is a number, as a pin or a slide has; it has "
            f"{', '.join(coordinates) or 'none'}. Use Friction."
        )

    def _of_contact(self, space, held, poses):
        if self.radius is not None:
            raise ValueError(f"{self.label}: {held.label} slides and has no radius.")
        if not isinstance(held, AbstractRigidContact):
            raise ValueError(f"{self.label}: {held.label} has no point at which bodies touch, and no friction.")
        if "." in self.joint:
            raise ValueError(f"{self.label}: friction in {held.label} is given by its name, {self.joint_name!r}.")
        if space.dimension == 2:
            return self
        normal = _normal_to(held, space, held.seen_poses(space, poses[: len(held.bodies) + held.modal_rows]))
        # The axis nearest to the normal.
        k = int(np.argmax(np.abs(normal)))
        return self.with_fields(pole=(k + 1) * int(np.sign(normal[k])))

    def may_vary(self, keys):
        # Points of contact are fixed in the bodies, but a terrain rises and sinks.
        in_contact = keys[0] == "joints" and isinstance(self.joints["0"], AbstractRigidContact)
        return not in_contact or "terrain" in keys

    def normal_force(self, space, poses, reactions):
        return norm(reactions) if self.in_gear else super().normal_force(space, poses, reactions)

    def limits(self, space, poses, reactions):
        # With its sign, since the force along the coordinate of a coupling is a sum of forces by several laws.
        return reactions if self.in_gear else super().limits(space, poses, reactions)

    def slip(self, space, poses, velocities):
        return self.over_belt(self._relative_velocity(space, poses, velocities))

    def over_belt(self, slip: Float[Array, "rows"]) -> Float[Array, "rows"]:
        """The velocities of slip against the belt, from those against its body."""
        return slip if self.speed is None else slip - self.speed.reshape(-1)

    def _relative_velocity(self, space, poses, velocities):
        held = self.joints["0"]
        if self.in_gear:
            first = lambda part, x: jnp.stack(part.joints["0"].values(space, x)[:1])
            return rate_of(space, self, first, poses, velocities)[1]
        if isinstance(held, AbstractRigidContact):
            if self.drift is not None:
                held = held.with_fields(drift=self.drift.joints["0"])
            bodies = len(held.bodies) + held.modal_rows
            return held.slip(space, *held.seen(space, poses[:bodies], velocities[:bodies]), self.pole)
        if self.drift is None and held.knows_rates:
            return self._lengths(held.rates_at(space, poses, velocities))
        lengths = lambda part, x: part._lengths(part.joints["0"].coordinates_at(space, x))
        return rate_of(space, self, lengths, poses, velocities)[1]

    def _lengths(self, coordinates):
        return jnp.concatenate([self._length(name, coordinates[name].reshape(-1)) for name in self.within])

    def _length(self, name, value):
        return value if self.radius is None or self.joints["0"].is_length(name) else self.radius * value


class JointFriction(AbstractCoordinateForce, AbstractScalarPart, AbstractForce):
    """Dry friction of constant size on a coordinate: generalized force `−force tanh(rate / transition_speed)`, or with
    exact stick.

    ```python
    bar = planar.Body("bar", mass=1.0, inertia=0.1, angular_velocity=2.0)
    pin = planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))
    rub = jaxmb.JointFriction("rub", "pin.angle", force=0.1)
    brake = jaxmb.JointFriction("brake", "pin.angle", force=0.5, static_force=0.6, exact=True)
    system = jaxmb.Scene([bar], joints=[pin], forces=[rub, brake]).compile()
    ```

    It does not depend on the reaction of the joint; `Friction` lists the ways in which a joint rubs. By default it is
    smooth, and creeps at rest under a load.

    If it is `exact`, it sticks: a seal, a brake, a preloaded bearing. It is then the law of `DryFriction` without a
    normal force. In slip the generalized force acts against the rate of the coordinate; in stick the coordinate is held
    by at most `static_force`. This costs a coordinate, a row, and an event with a new start of the method at each
    transition. `Trajectory.events` lists them, the coordinate `"brake.mode"` is 2 in stick and 1 or -1 in slip, and
    `Trajectory.reactions["brake"]` is the force and moment on the last body. In an impact it has no impulse.

    **Arguments:**

    - `coordinate`: a number, of a joint or tendon, such as `"pin.angle"`, `"slide.displacement"` or `"cord.length"`.
    - `force` [N m, N] ≥ 0; `transition_speed` [rad/s, m/s] > 0, below which smooth friction is viscous, default 0.01.
    - `exact`: whether it sticks; `static_force` ≥ `force` [N m, N] of exact friction in stick, default `force`. Both
        forces may be inputs; stick never has the smaller one.
    """

    force: fields.Number = fields.parameter(unit=("N m", "N"), sign="non-negative")
    transition_speed: fields.Number = fields.parameter(unit=("rad/s", "m/s"), sign="positive", optional=True)
    static_force: fields.Number = fields.parameter(unit=("N m", "N"), sign="non-negative", optional=True)
    exact: bool = eqx.field(static=True, default=False, kw_only=True)

    def validate(self):
        if self.exact and self.transition_speed is not None:
            raise ValueError(f"{self.label}: exact friction has no transition_speed; leave it out.")
        if self.static_force is not None and not self.exact:
            raise ValueError(f"{self.label}: static_force needs friction that sticks; give exact=True.")
        if self.static_force is not None and not self.static_force >= self.force:
            raise ValueError(
                f"{self.label}: static_force must not be less than force, got {self.static_force} and {self.force}."
            )

    def scalar_coordinates(self, space, parts):
        return (ScalarCoordinate(f"{self.name}.mode", moves=True),) if self.exact else ()

    def with_numbers(self, given):
        if self.exact and isinstance(self.joint, AbstractUnilateralConstraint):
            raise ValueError(
                f"{self.label}: {self.joint.label} is not a joint; friction of bodies that touch is DryFriction."
            )
        return super().with_numbers(given)._in_itself()

    def components(self):
        if not self.exact:
            return (self,)
        own = fields.values_of(self)
        return (with_values(ExactFriction, {name: own[name] for name in fields.field_names(ExactFriction)}),)

    def law(self, x, v):
        return -self.force * (jnp.sign(v) if self.exact else jnp.tanh(v / self.transition_speed))

    def _in_itself(self):
        return self if self.exact else self.filled(transition_speed=1e-2)


class ExactFriction(AbstractScalarPart, AbstractStickSlip):
    """`JointFriction` that sticks."""

    force: fields.Number = fields.parameter(unit=("N m", "N"), sign="non-negative")
    static_force: fields.Number = fields.parameter(unit=("N m", "N"), sign="non-negative", optional=True)
    rows: ClassVar[int] = 1
    directions: ClassVar[int] = 1
    needs: ClassVar[Literal["nothing"]] = "nothing"

    @property
    def contact_law(self):
        return GivenForce(self.force, self.static_force)

    @property
    def joint_name(self):
        return self.coordinate.partition(".")[0]

    def numbers_agree(self):
        return True if self.static_force is None else self.static_force >= self.force

    def slips(self, space, poses, velocities):
        return self.measured_with_rate(space, poses, velocities)[1]

    def normal_force(self, space, poses, reactions):
        return jnp.zeros_like(self.force)


@on_host
def _normal_to(contact: AbstractRigidContact, space: AbstractSpace, poses: Any) -> Any:
    """The normal of a contact in the first body, or in the world; `poses` as the contact sees them."""
    poses = jnp.asarray(poses)
    normal = contact.outward(space, poses)
    return space.body_direction(poses[0], normal) if len(poses) == 2 else normal
