"""What every part of a scene is: a name, the bodies it touches, and a pure residual or law of those bodies alone.

A part of one's own is a class derived from one of these, with its fields declared by the helpers of `fields`. It then
has all that the parts of the library have: it is stacked with others of its type and `vmap`ped, its Jacobian and the
accelerations that it asks for follow from its residual, its numbers are parameters with names and derivatives, and its
redundant rows, reactions and pictures are found like those of others.

A kernel (`residual`, `wrenches`, `energy`) is written for a single part, and for the poses of its own bodies, shape
`(len(bodies), pose size)`, which `space` turns into points, directions and wrenches.
"""

import abc
from typing import TYPE_CHECKING, Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar
from . import fields
from .space import AbstractSpace

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar

Poses = Float[Array, "k p"]
Velocities = Float[Array, "k v"]
Wrenches = Float[Array, "k v"]

GROUND = "ground"


class AbstractPart(eqx.Module):
    """Anything with a name in a scene. `dimensions`: of the spaces that it belongs to, 2 for the plane, 3 for space."""

    name: AbstractVar[str]
    dimensions: ClassVar[tuple[int, ...]] = (2, 3)

    def __check_init__(self):
        fields.check_kinds(self, self.label)

    @property
    def label(self) -> str:
        """What messages call the part."""
        return f"{type(self).__name__} {getattr(self, 'name', '')!r}"

    def check(self, dimension: int | None = None) -> None:
        """Raise a `ValueError` that names the part and the field for numbers that make no sense.

        **Arguments:** `dimension` of the scene, default that of the part itself.
        """
        fields.check_numbers(self, self.label, self.dimensions[0] if dimension is None else dimension)
        type(self).validate(self)

    def validate(self) -> None:
        """A hook: raise a `ValueError` for numbers that do not go together. Each by itself has been checked."""

    def filled(self, **values: Any) -> Self:
        """The same part with these numbers in fields that have none."""
        missing = {name: fields.as_parameter(value) for name, value in values.items() if getattr(self, name) is None}
        return type(self).with_fields(self, **missing) if missing else self

    def with_fields(self, **values: Any) -> Self:
        """The same part with other values in some fields."""
        out = object.__new__(type(self))
        for field in fields.field_names(type(self)):
            object.__setattr__(out, field, values[field] if field in values else getattr(self, field))
        return out


class AbstractPlanarPart(AbstractPart):
    """A part of planar scenes only."""

    dimensions: ClassVar[tuple[int, ...]] = (2,)


class AbstractSpatialPart(AbstractPart):
    """A part of spatial scenes only."""

    dimensions: ClassVar[tuple[int, ...]] = (3,)


class AbstractBody(AbstractPart):
    """Something with mass. Its frame has its origin in the mass centre.

    Fields declared with `fields.guess` hold the state that it is given with; all other numbers are parameters. `mass`
    and `inertia` are fields, or properties worked out from other numbers, such as a radius and a density.

    - `mass` [kg] > 0; `inertia` [kg m²] about the mass centre, () in the plane and (3, 3) in body axes in space; zero
        for a body that does not rotate.
    - `rotates`: whether it has a rotation; a point mass has not.
    """

    mass: AbstractVar[Float[Array, ""]]
    inertia: AbstractVar[Array]
    rotates: ClassVar[bool]

    @property
    def dimension(self) -> int:
        """2 in the plane, 3 in space."""
        return self.dimensions[0]

    @abc.abstractmethod
    def pose(self) -> Any:
        """The pose that it is given with, a vector; the position alone for a body that does not rotate."""

    @abc.abstractmethod
    def velocities(self) -> Any:
        """The velocity that it is given with, in the same way."""


class _Bodies:
    """`part.bodies`: the names in its fields of bodies, in their order. A field called `bodies` takes its place."""

    def __get__(self, part: Any, owner: type | None = None) -> Any:
        if part is None:
            return self
        declared = fields.declarations(type(part))
        return tuple(getattr(part, name) for name, own in declared.items() if own.kind == "body")


class AbstractLaw(eqx.Module):
    """A law that a part is given, with numbers of its own, such as a terrain or a law of contact; it has no name."""

    def __check_init__(self):
        fields.check_kinds(self, type(self).__name__)


class AbstractLink(AbstractPart):
    """A part that acts between bodies, `bodies`."""

    bodies = _Bodies()

    def resolve(self, space: AbstractSpace, poses: Poses) -> Self:
        """The same part, checked, with every number filled in: world points and axes turned into body-fixed ones at the
        given poses.
        """
        # By the class: a bound method of a module is a module, and too dear for scenes of thousands of parts.
        cls = type(self)
        cls.check(self, space.dimension)
        part = cls.complete(_body_fixed(self, space, poses), space, poses)
        if part is not self:
            cls.check(part, space.dimension)
        return part

    def complete(self, space: AbstractSpace, poses: Poses) -> Self:
        """A hook: the same part with numbers that were left out worked out from the given poses; see `filled`."""
        del space, poses
        return self

    def anchor(self, k: int) -> Array | None:
        """The part's point [m] on its k-th body, in that body's frame; None if it has none."""
        for name, own in fields.declarations(type(self)).items():
            if own.is_point and own.body == k and getattr(self, name) is not None:
                return getattr(self, name)
        return None


class AbstractPair(AbstractLink):
    """A part that acts between two bodies, either of which may be `"ground"`."""

    name: str = fields.name()
    body_a: str = fields.body_name()
    body_b: str = fields.body_name()


class AbstractConstraint(AbstractLink):
    """A constraint between positions, `residual = 0`.

    `rows` is the static number of scalar equations; `rheonomic` says whether the residual depends on time.
    """

    rows: AbstractVar[int]
    rheonomic: AbstractVar[bool]

    @abc.abstractmethod
    def residual(self, space: AbstractSpace, poses: Poses, t: Scalar) -> Float[Array, "rows"]:
        """Φ(poses, t) of this part."""


class AbstractJoint(AbstractPair, AbstractConstraint):
    """A constraint between a point of `body_a` and one of `body_b`.

    The points are given in the bodies' own frames (`point_a`, `point_b`), or both by a world point at the given poses
    (`point`), [m].
    """

    point_a: fields.Number = fields.point(body=0, optional=True)
    point_b: fields.Number = fields.point(body=1, optional=True)
    point: fields.Number = fields.point(body=None, gives=("point_a", "point_b"))
    rheonomic: ClassVar[bool] = False


class AbstractVelocityConstraint(AbstractLink):
    """A constraint between velocities that is not the derivative of one between positions, `residual = 0`.

    `linear` says whether the residual is linear in the velocities (perhaps with a constant term), `homogeneous`
    whether it vanishes at rest.
    """

    rows: AbstractVar[int]
    linear: AbstractVar[bool]
    homogeneous: AbstractVar[bool]

    @abc.abstractmethod
    def residual(self, space: AbstractSpace, poses: Poses, velocities: Velocities, t: Scalar) -> Float[Array, "rows"]:
        """ψ(poses, velocities, t) of this part."""


class AbstractCompound(AbstractLink):
    """A part made of several others under its own name."""

    @abc.abstractmethod
    def components(self) -> tuple[AbstractLink, ...]:
        """The parts that it is made of; asked for when its numbers have been filled in."""


class AbstractForce(AbstractLink):
    """A force law without potential energy: all its power is dissipated or supplied."""

    conservative = False

    @abc.abstractmethod
    def wrenches(self, space: AbstractSpace, poses: Poses, velocities: Velocities, t: Scalar) -> Wrenches:
        """The wrench on each of its bodies."""


class AbstractPotentialForce(AbstractForce):
    """A force law with a potential energy; what power is not taken from it is dissipated or supplied."""

    conservative = True

    @abc.abstractmethod
    def energy(self, space: AbstractSpace, poses: Poses, t: Scalar) -> Float[Array, ""]:
        """Potential energy [J]."""


class AbstractNonIdeal(AbstractPart):
    """A non-ideal constraint force: one that does work in the motions that its joint allows.

    `joint` is the joint's name. The force may depend on the joint's own reactions, those that it would exert if all
    joints were ideal. Components of it along which the joints allow no motion have no effect.
    """

    joint: AbstractVar[str]

    def resolve(self, space: AbstractSpace, joint: AbstractLink, poses: Poses) -> Self:
        """The same part, checked, with every number filled in, from its joint and the poses of the joint's bodies."""
        self.check(space.dimension)
        part = self.complete(space, joint, poses)
        part.check(space.dimension)
        return part

    def complete(self, space: AbstractSpace, joint: AbstractLink, poses: Poses) -> Self:
        """A hook: the same part with numbers that were left out worked out from its joint; see `filled`."""
        del space, joint, poses
        return self

    @abc.abstractmethod
    def wrenches(
        self, space: AbstractSpace, poses: Poses, velocities: Velocities, reactions: Wrenches, t: Scalar
    ) -> Wrenches:
        """The wrench on each of the joint's bodies; `reactions`: what the ideal joint does to them."""


def _body_fixed(part: Any, space: AbstractSpace, poses: Poses) -> Any:
    """The part with body-fixed points and directions in place of those in the world, and unit directions."""
    declared, values = fields.declarations(type(part)), {}
    for name, own in declared.items():
        value = getattr(part, name)
        if own.centred and value is None:
            values[name] = fields.as_parameter(np.zeros(space.dimension))
        elif own.gives:
            _check_given(part, name, own)
            if value is None:
                continue
            values[name] = None
            for fixed in own.gives:
                pose = poses[declared[fixed].body]
                convert = space.body_point if own.is_point else space.body_direction
                values[fixed] = convert(pose, value if own.is_point else value / np.linalg.norm(value))
        elif (own.is_direction or own.is_attitude) and value is not None:
            values[name] = value / np.linalg.norm(value)
    return type(part).with_fields(part, **values) if values else part


def _check_given(part: Any, world: str, own: fields.Declaration) -> None:
    """A point or direction is given in the world or in the bodies' frames."""
    given = [name for name in own.gives if getattr(part, name) is not None]
    in_world = getattr(part, world) is not None
    if len(own.gives) == 1:
        if in_world == bool(given) and (in_world or own.needed):
            (fixed,) = own.gives
            body = part.bodies[fields.declarations(type(part))[fixed].body]
            raise ValueError(
                f"{part.label}: give {fixed} (fixed in {body!r}) or {world} (world), and only one of them."
            )
        return
    listed = " and ".join(own.gives)
    if in_world and given:
        raise ValueError(f"{part.label}: give either {world} (world) or {listed} (body-fixed), not both.")
    if not in_world and len(given) < len(own.gives):
        raise ValueError(f"{part.label}: give {listed} (body-fixed), or {world} (world).")


def rows_of(part: Any, space: AbstractSpace, poses: Poses) -> Array:
    """Derivative of the rows of a constraint, between positions or velocities, with respect to the velocities of its
    bodies, (rows, k, velocity size).
    """
    velocities = jnp.ones((poses.shape[0], space.velocity_size), poses.dtype)
    if isinstance(part, AbstractVelocityConstraint):
        return jax.jacfwd(lambda v: part.residual(space, poses, v, jnp.zeros((), poses.dtype)))(velocities)

    def rate(v):
        rates = jax.vmap(space.rates)(poses, v)
        return jax.jvp(lambda x: part.residual(space, x, jnp.zeros((), poses.dtype)), (poses,), (rates,))[1]

    return jax.jacfwd(rate)(velocities)
