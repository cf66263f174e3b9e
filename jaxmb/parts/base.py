"""Base classes of the parts of a scene: a name, the bodies that the part acts on, and a pure residual or force law.

A user-defined part derives from a class here and declares its fields with the helpers of `fields`. It is then treated
like the parts of the library. Parts of a type are stacked and `vmap`ped; the Jacobian and γ follow from the residual;
numbers become named, differentiable parameters. Redundant rows, reactions and pictures need no further code.

A kernel (`residual`, `wrenches`, `energy`) is written for one part. It takes the poses of that part's bodies, shape
`(len(bodies), pose size)`; `space` converts them to points, directions and wrenches.
"""

import abc
import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._compat import with_values
from .._types import Scalar
from ..linalg.arrays import namespace
from ..linalg.rotations import norm
from . import fields
from .inherited import with_inherited_arguments
from .names import check_arguments
from .shapes import AbstractShape
from .space import AbstractSpace, both_points

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar

Poses = Float[Array, "k p"]
Velocities = Float[Array, "k v"]
Wrenches = Float[Array, "k v"]

GROUND = "ground"

# How a picture draws the line of a part.
PathKind = Literal["rod", "coil", "belt", "cord", "bar"]
# The quantity of each coordinate by name: an angle [rad], a rotation vector [rad] or a length [m].
Quantities = Mapping[str, Literal["angle", "rotation", "length"]]


class ScalarCoordinate(NamedTuple):
    """A scalar coordinate that a part adds to the scene, `"rotor.angle"`, or a modal coordinate of a flexible body.

    **Fields:** `is_length`: a length [m], otherwise an angle [rad]; `moves`: whether it has a velocity, and so an
    inertia, as modal coordinates do. Without a velocity it only counts the turns of an angle that is known up to full
    turns.
    """

    name: str
    is_length: bool = False
    moves: bool = False


class KnownParts(NamedTuple):
    """Parts already resolved; the remaining parts are resolved from these.

    **Fields:** the `space`; `numbers`: the index of a body, by its name or the name of a frame in it; `scalars`: the
    indices of scalar coordinates, by the name of their part or flexible body; `frames` by name; `observed`: the frames
    that the scene names; the given `poses` of all bodies and scalar coordinates; the `joints` by name, each with the
    indices of its bodies.
    """

    space: AbstractSpace
    numbers: Mapping[str, int]
    scalars: Mapping[str, tuple[int, ...]]
    frames: Mapping[str, Any]
    observed: frozenset[str]
    poses: Any
    joints: dict[str, tuple[Any, tuple[int, ...]]]

    def source(self, name: str) -> tuple[Any, tuple[int, ...]]:
        """The joint, the frame, or None for a body, with the indices of its bodies."""
        if name in self.joints:
            return self.joints[name]
        frame = self.frames[name] if name in self.observed else None
        return frame, (self.numbers[name], *(() if frame is None else self.modal(frame)))

    def modal(self, frame: Any) -> tuple[int, ...]:
        """The indices of the modal coordinates that a frame moves with."""
        return self.scalars[frame.of_body] if frame.is_flexible else ()


class AbstractPart(eqx.Module):
    """A named element of a scene. `dimensions` lists the spaces that it supports: 2 for the plane, 3 for space."""

    name: AbstractVar[str]
    dimensions: ClassVar[tuple[int, ...]] = (2, 3)

    def __init_subclass__(cls, **options: Any):
        super().__init_subclass__(**options)
        cls.__doc__ = with_inherited_arguments(cls)

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        check_arguments(cls.__name__, _signature(cls), len(args), kwargs)
        return super().__new__(cls)

    def __check_init__(self):
        fields.check_kinds(self, self.label)

    @property
    def kind(self) -> str:
        """The type of the part, for descriptions and error messages."""
        return type(self).__name__

    @property
    def modal_rows(self) -> int:
        """The number of modal coordinates with which frames move that the part names. They stand between its bodies
        and its scalar coordinates, and its kernels do not see them.
        """
        return 0

    @property
    def label(self) -> str:
        """The type and name of the part, for error messages."""
        return f"{self.kind} {getattr(self, 'name', '')!r}"

    def check(self, dimension: int | None = None) -> None:
        """Raise a `ValueError` that names the part and the field if a number is invalid.

        **Arguments:** `dimension` of the scene, default the part's.
        """
        fields.check_numbers(self, self.label, self.dimensions[0] if dimension is None else dimension)
        type(self).validate(self)
        fields.check_matrices(self, self.label)

    def validate(self) -> None:
        """Hook: raise a `ValueError` for inconsistent numbers; each number has already been checked by itself."""

    def numbers_agree(self) -> Any:
        """Hook: whether the numbers satisfy `validate`, also for traced numbers, which `validate` cannot check."""
        return True

    def is_of_length(self, field: str) -> Any:
        """Hook: whether a number that has one unit for angles and one for lengths belongs to a length, for each
        component if they differ; None if unknown.
        """
        del field

    def is_angle(self, field: str, unit: fields.Unit) -> Any:
        """Hook: whether a number of this unit is an angle [rad], for each component if they differ."""
        if not isinstance(unit, tuple):
            return unit == "rad"
        of_length = self.is_of_length(field) if unit[0] == "rad" else None
        return False if of_length is None else np.logical_not(of_length)

    def filled(self, **values: Any) -> Self:
        """A copy with these numbers in fields that are None."""
        current = fields.values_of(self)
        missing = {name: fields.as_parameter(value) for name, value in values.items() if current[name] is None}
        return type(self).with_fields(self, **missing) if missing else self

    def named(self, name: str) -> Self:
        """A copy with another name."""
        return type(self).with_fields(self, name=name)

    def with_fields(self, **values: Any) -> Self:
        """A copy with some fields replaced."""
        return with_values(type(self), fields.values_of(self) | values)


@functools.cache
def _signature(part: type) -> inspect.Signature:
    return inspect.signature(part)


class AbstractPlanarPart(AbstractPart):
    """A part of planar scenes only."""

    dimensions: ClassVar[tuple[int, ...]] = (2,)


class AbstractSpatialPart(AbstractPart):
    """A part of spatial scenes only."""

    dimensions: ClassVar[tuple[int, ...]] = (3,)


class AbstractDynamicPart(AbstractPart):
    """A part with internal states of first order; another base class says what else it is.

    Forces, laws of friction and contacts, and bodies may depend on their internal states, such as friction that fades
    as a brake becomes hot. The rows of constraints must not. See `AbstractDynamicForce` for forces.

    ```python
    class FadingFriction(jaxmb.DryFriction, jaxmb.parts.AbstractDynamicPart):
        fade: jaxmb.parts.Number = jaxmb.parts.internal_state(unit="1")
        lag: jaxmb.parts.Number = jaxmb.parts.parameter(unit="s", sign="positive", default=1.0)

        @property
        def contact_law(self):
            return jaxmb.parts.Coulomb(self.coefficient * (1 - self.fade), None)

        def state_rates(self, space, poses, velocities, t):
            return {"fade": (0.5 - self.fade) / self.lag}

    brake = FadingFriction("brake", "pin", coefficient=0.4, radius=0.1, lag=2.0)
    ```
    """

    @abc.abstractmethod
    def state_rates(self, space: AbstractSpace, poses: Poses, velocities: Velocities, t: Scalar) -> dict[str, Array]:
        """The rate of every internal state [its unit/s], by the name of the field."""

    def state_sizes(self) -> dict[str, Any]:
        """Hook: the typical sizes of internal states by the name of the field, default one in its unit. For error
        control, the largest value of a state so far counts as at least 1e-4 of its size.
        """
        return {}


class AbstractBody(AbstractPart):
    """A body with mass. The origin of its frame is the mass centre, unless a field `centre` gives the mass centre [m]
    in the frame.

    The points of parts on a body, and the poses, velocities and wrenches in kernels, refer to the frame. The body's
    coordinates and its motion refer to the mass centre.

    Fields declared with `fields.guess` hold its initial guess; all other numbers are parameters. `mass` and `inertia`
    are fields, or properties computed from other fields, such as a radius and a density.

    - `mass` [kg] > 0; `inertia` [kg m²] about the mass centre, () in the plane and (3, 3) in body axes in space; zero
        for a body that does not rotate.
    - `rotates`: whether the body has rotational coordinates; a point mass has none.
    """

    mass: AbstractVar[Float[Array, ""]]
    inertia: AbstractVar[Array]
    rotates: ClassVar[bool]

    @property
    def mass_centre(self) -> Array | None:
        """The mass centre [m] in the frame, `centre`; None where it is the origin."""
        return fields.values_of(self).get("centre")

    @property
    def dimension(self) -> int:
        """2 in the plane, 3 in space."""
        return self.dimensions[0]

    @abc.abstractmethod
    def pose(self) -> Any:
        """The initial guess of the pose at the mass centre, a vector; only the position for a body that does not
        rotate.
        """

    @abc.abstractmethod
    def velocities(self) -> Any:
        """The initial guess of the velocity at the mass centre; only the linear velocity for a body that does not
        rotate.
        """


class AbstractFlexibleBody(AbstractBody):
    """A body whose points move in its frame with modal coordinates ζ, which have names and are coordinates of the
    scene, `"rod.bend"`.

    ```python
    # A body with a bob on a spring, which slides along the body's x axis.
    class Slider(planar.AbstractRigidBody, jaxmb.parts.AbstractFlexibleBody):
        mass: jaxmb.parts.Number = jaxmb.parts.parameter(unit="kg", sign="positive")
        inertia: jaxmb.parts.Number = jaxmb.parts.parameter(unit="kg m²", sign="positive")
        bob: jaxmb.parts.Number = jaxmb.parts.parameter(unit="kg", sign="positive")
        stiffness: jaxmb.parts.Number = jaxmb.parts.parameter(unit="N/m", sign="positive")
        modes = (jaxmb.parts.ScalarCoordinate("slide", is_length=True, moves=True),)

        def mass_matrix(self, space, zeta):
            case, nothing = self.mass - self.bob, jnp.zeros_like(self.bob)
            # The velocity of the bob by those of the frame and by the rate of ζ.
            along = jnp.array([[1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 0.0]]).at[1, 2].set(zeta[0])
            return jnp.diag(jnp.stack([case, case, self.inertia, nothing])) + self.bob * along.T @ along

        def energy(self, space, zeta):
            return 0.5 * self.stiffness * zeta[0] ** 2

    box = Slider("box", mass=1.0, inertia=0.1, bob=0.3, stiffness=50.0)
    system = jaxmb.Scene([box]).compile()
    state = jaxmb.assemble(system, fix={"box.slide": 0.1})
    ```

    It moves by its kinetic energy `½ wᵀ M(ζ) w`, where w holds the velocity of the frame's origin [m/s] and the angular
    velocity [rad/s], both in body axes, and ζ̇. Gravity and all inertia forces follow from M. Frames of a class derived
    from `AbstractFlexibleFrame` move with ζ; parts that name the body itself, or another frame, see the rigid frame.

    **Fields:** `modes`: names within the body, and kinds, of the modal coordinates. `mass` is the whole mass, and
    `inertia` the undeformed body's about the frame's origin, for pictures; the origin need not be the mass centre.
    """

    modes: AbstractVar[tuple[ScalarCoordinate, ...]]

    @abc.abstractmethod
    def mass_matrix(self, space: AbstractSpace, zeta: Float[Array, "k"]) -> Float[Array, "n n"]:
        """M(ζ) for the velocities w: 3 + k rows in the plane, 6 + k in space."""

    def prepared(self, space: AbstractSpace) -> Any:
        """Hook: an object with the same kernels, for the steps of a motion, that holds values of the numbers alone; by
        default the body. A class of a user has its kernels themselves.
        """
        del space
        return self

    def energy(self, space: AbstractSpace, zeta: Float[Array, "k"]) -> Float[Array, ""]:
        """Hook: the elastic energy [J]."""
        del space
        return jnp.zeros((), zeta.dtype)

    def internal_force(
        self, space: AbstractSpace, zeta: Float[Array, "k"], rates: Float[Array, "k"]
    ) -> Float[Array, "k"]:
        """Hook: generalized forces along ζ that no energy stores, such as damping."""
        del space, rates
        return jnp.zeros_like(zeta)

    def line(self, space: AbstractSpace, zeta: Float[Array, "k"]) -> Float[Array, "points d"] | None:
        """Hook: points [m] in the body's frame of the deformed line by which a picture shows it; by default it is shown
        by straight lines to its frames.
        """
        del space, zeta
        return None

    def scalar_coordinates(self) -> tuple[ScalarCoordinate, ...]:
        """The modal coordinates by their names in the scene."""
        return tuple(mode._replace(name=f"{self.name}.{mode.name}") for mode in self.modes)

    def check(self, dimension: int | None = None) -> None:
        super().check(dimension)
        names = [mode.name for mode in self.modes]
        wrong = [name for name in names if not name.isidentifier() or names.count(name) > 1]
        if wrong or not names:
            raise ValueError(f"{self.label}: modes need one name each, an identifier such as 'bend', got {names}.")
        if still := [mode.name for mode in self.modes if not mode.moves]:
            raise ValueError(f"{self.label}: modal coordinates move; declare moves=True for {', '.join(still)}.")


class _Bodies:
    """`part.bodies`: the values of the body-name fields, in order; a field named `bodies` overrides it."""

    def __get__(self, part: Any, owner: type | None = None) -> Any:
        if part is None:
            return self
        values = fields.values_of(part)
        return tuple(
            values[name] for name, declaration in fields.declarations(type(part)).items() if declaration.kind == "body"
        )


class AbstractLaw(eqx.Module):
    """A law with parameters that is a field of a part, such as a terrain or a contact law; it has no name."""

    def __check_init__(self):
        fields.check_kinds(self, type(self).__name__)


class AbstractActor(AbstractPart):
    """A part that acts on bodies, or on frames fixed in them.

    Its kernels see the poses and velocities of the frames and return wrenches on them. A scene fills in `body_frames`
    by the index of the body, `"0"` for the first, where the part names a frame instead of a body.
    """

    body_frames: Any = eqx.field(init=False, repr=False, metadata={"declaration": fields.Declaration("parts", of=dict)})
    # A copy of the part that holds the rates of its time-dependent numbers, and None in all other fields; None without
    # any. See `with_drift`.
    drift: Any = eqx.field(init=False, repr=False)
    # When a scene resolves the part: 0 from its bodies, 1 after the joints between them, 2 after tendons as well.
    stage: ClassVar[int] = 0
    # `takes_drift`: whether kernels receive `drift`. `moving`: further numbers whose rates `drift` contains, besides
    # points, axes and the numbers of joints.
    takes_drift: ClassVar[bool] = True
    moving: ClassVar[tuple[str, ...]] = ()
    # The fields, by the names of parameters, with the two limits to which each parameter is clipped.
    ranges: ClassVar[Mapping[str, str]] = MappingProxyType({})
    # Whether the part may act on bodies and frames among its `sources`, other than joints and tendons.
    takes_bodies: ClassVar[bool] = False
    # Whether `given_in_time` is its function of time, at whose turns steps end. Pulses are found without it as well, in
    # all kernels that depend on time.
    of_time: ClassVar[bool] = False

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        out = super().__new__(cls, *args, **kwargs)
        # Set here, so that parts with a custom `__init__` have it as well.
        object.__setattr__(out, "body_frames", {})
        object.__setattr__(out, "drift", None)
        return out

    @property
    def sources(self) -> tuple[str, ...]:
        """Hook: the names of the parts that it acts on or measures, except bodies that its fields name."""
        return ()

    def may_vary(self, keys: tuple[str, ...]) -> bool:
        """Hook: whether the number at the end of these keys may be an input. It may not if it moves a body-fixed point
        whose velocity matters, unless the kernels use `with_drift`.
        """
        del keys
        return True

    @abc.abstractmethod
    def settled(self, known: KnownParts) -> tuple[Self, tuple[int, ...]]:
        """The part in a scene, with every number filled in, and the indices of its bodies."""

    def seen_poses(self, space: AbstractSpace, poses: Poses) -> Poses:
        """The poses that the kernels see, from poses of the bodies."""
        of_frame = lambda frame, x: frame.pose(space, x, *frame.modal(poses))
        return type(self)._on_frames(self, of_frame, self._of_bodies(poses))

    def seen(self, space: AbstractSpace, poses: Poses, velocities: Velocities) -> tuple[Poses, Velocities]:
        """The poses and velocities that the kernels see, from poses and velocities of the bodies."""
        of_frame = lambda frame, x, v: frame.velocity(space, x, v, *frame.modal(poses), *frame.modal(velocities))
        seen = self._on_frames(of_frame, self._of_bodies(poses), self._of_bodies(velocities))
        return self.seen_poses(space, poses), seen

    def seen_wrenches(self, space: AbstractSpace, poses: Poses, wrenches: Wrenches) -> Wrenches:
        """The wrenches that the kernels see, from wrenches on the bodies."""
        of_frame = lambda frame, x, w: frame.wrench_on_frame(space, x, w, *frame.modal(poses))
        return self._on_frames(of_frame, self._of_bodies(poses), self._of_bodies(wrenches))

    def wrenches_on_bodies(self, space: AbstractSpace, poses: Poses, wrenches: Wrenches) -> Wrenches:
        """The wrenches on the bodies that are equivalent to the kernels' wrenches."""
        of_frame = lambda frame, x, w: frame.wrench(space, x, w, *frame.modal(poses))
        out = self._on_frames(of_frame, self._of_bodies(poses), wrenches)
        if not self.modal_rows:
            return out
        start, end = self._modal_span
        modal = jnp.zeros(end - start, out.dtype)
        for k, frame in self.body_frames.items():
            for zeta in frame.modal(poses):
                first, last = frame.rows
                force = frame.modal_force(space, poses[int(k)], wrenches[int(k)], zeta)
                modal = modal + jnp.pad(force, (first - start, end - last))
        rows = jnp.pad(modal[:, None], ((0, 0), (0, out.shape[1] - 1)))
        return jnp.concatenate([out[:start], rows, out[start:]])

    @property
    def modal_rows(self) -> int:
        start, end = self._modal_span
        return end - start

    @property
    def _modal_span(self) -> tuple[int, int]:
        """Where the modal coordinates of all its frames begin and end among its bodies."""
        spans = [frame.rows for frame in self.body_frames.values() if frame.rows[1]]
        return (min(start for start, _ in spans), max(end for _, end in spans)) if spans else (0, 0)

    def _of_bodies(self, rows: Any) -> Any:
        """The rows without those of modal coordinates."""
        start, end = self._modal_span
        if not end:
            return rows
        return rows[:start] if end == len(rows) else namespace(rows).concatenate([rows[:start], rows[end:]])

    def _on_frames(self, of_frame: Callable[..., Any], *rows: Any) -> Any:
        """The last array; `of_frame(frame, …)` of its rows in all arrays replaces a row of a body with a frame."""
        frames = self.body_frames
        if not frames:
            return rows[-1]
        numbered = enumerate(zip(*rows, strict=True))
        out = [of_frame(frames[str(k)], *row) if str(k) in frames else row[-1] for k, row in numbered]
        return namespace(*out).stack(out)

    def placed(self, known: KnownParts, names: Sequence[str]) -> tuple[Self, tuple[int, ...]]:
        """A copy with the frames among the bodies that it names, and the indices of these bodies and of the modal
        coordinates with which the frames move.
        """
        frames, numbers = {}, [known.numbers[name] for name in names]
        for k, name in enumerate(names):
            if name not in known.frames:
                continue
            frame, modal = known.frames[name], known.modal(known.frames[name])
            if modal and modal[0] not in numbers:
                numbers += modal
            first = numbers.index(modal[0]) if modal else 0
            frames[str(k)] = frame.with_fields(rows=(first, first + len(modal))) if modal else frame
        return type(self).with_fields(self, body_frames=frames), tuple(numbers)


class AbstractLink(AbstractActor):
    """A part that acts between bodies, `bodies`."""

    bodies = _Bodies()
    # How a picture draws the line between its points A and B; none by default.
    path_kind: ClassVar[PathKind | None] = None

    # Index from which bodies may repeat, as several places on one body; None if all must differ.
    several_from: ClassVar[int | None] = None
    # The quantities of its coordinates; unknown without an entry.
    quantities: ClassVar[Quantities] = {}
    # Whether bodies touch each other, the ground or a road in it, as in a contact and a tyre.
    touches: ClassVar[bool] = False
    # Whether it pulls with a tension [N] in each of its `spans`: the multiplier of each row, or among the `observables`
    # of a force.
    has_tension: ClassVar[bool] = False
    # Names of the coordinates whose rates are the slip, if the bodies slide over each other in two directions.
    slides: ClassVar[tuple[str, ...]] = ()
    # How a pose at which `heading` vanishes is told, with the part's {name}; None for parts without a heading.
    lost_heading: ClassVar[str | None] = None

    def heading(self, space: AbstractSpace, poses: Poses) -> Float[Array, "d"]:
        """Hook, of a class with `lost_heading`: a vector whose direction the part needs, with a length of one where the
        pose is far from one at which it vanishes. A motion in which it vanishes ends there.
        """
        raise NotImplementedError(f"{self.kind} says lost_heading, and needs a method heading.")

    # Whether `limit_reached` knows limits.
    has_limits: ClassVar[bool] = False

    def limit_reached(self, space: AbstractSpace, poses: Poses) -> str:
        """Hook, of a class with `has_limits`: the limit of its equations at which concrete poses are, for messages;
        empty if at none.
        """
        del space, poses
        return ""

    def is_length(self, coordinate: str) -> bool | None:
        """Whether a coordinate is a length, otherwise an angle; None if it is not known."""
        return None if coordinate not in self.quantities else self.quantities[coordinate] == "length"

    @property
    def angles(self) -> frozenset[str]:
        """Names of the coordinates that are angles."""
        return frozenset(name for name, quantity in self.quantities.items() if quantity == "angle")

    @property
    def periodic(self) -> frozenset[str]:
        """Names of the coordinates that are angles known up to full turns; in the plane full turns are counted."""
        return frozenset() if 2 in self.dimensions else self.angles

    def coordinates(self, space: AbstractSpace, poses: Poses) -> dict[str, Array]:
        """Hook: the coordinates of the part by name, numbers or vectors, such as the `angle` of a joint."""
        del space, poses
        return {}

    def given_in_time(self, space: AbstractSpace, poses: Poses, velocities: Velocities, t: Scalar) -> Array:
        """Hook: for a part that is `of_time`, the values of its function of time at fixed poses and velocities."""
        raise NotImplementedError(f"{self.kind} says of_time = True, and needs a method given_in_time.")

    def coordinates_at(self, space: AbstractSpace, poses: Poses) -> dict[str, Array]:
        """The coordinates at these poses of the bodies."""
        return type(self).coordinates(self, space, self.seen_poses(space, poses))

    def coordinate_rates(self, space: AbstractSpace, poses: Poses, velocities: Velocities) -> dict[str, Array]:
        """Hook: the rates of `coordinates` of a joint with constant numbers on its constraints, linear in velocities;
        otherwise they follow by automatic differentiation.
        """
        raise NotImplementedError(f"{self.kind} has no rates of coordinates in closed form.")

    @property
    def knows_rates(self) -> bool:
        """Whether the rates of its coordinates have a closed form."""
        return self.drift is None and type(self).declares("coordinate_rates", "coordinates")

    def rates_at(self, space: AbstractSpace, poses: Poses, velocities: Velocities) -> dict[str, Array]:
        """The rates of the coordinates at these poses and velocities of the bodies, of a joint that `knows_rates`."""
        return type(self).coordinate_rates(self, space, *self.seen(space, poses, velocities))

    def resolve(self, space: AbstractSpace, poses: Poses) -> Self:
        """A checked copy with every number filled in; world points and axes become body-fixed at the given poses."""
        # Methods are called through the class: binding a method creates a module, too slow for thousands of parts.
        cls = type(self)
        cls.check(self, space.dimension)
        part = cls.complete(_body_fixed(self, space, poses), space, poses)
        if part is not self:
            cls.check(part, space.dimension)
        return part

    @classmethod
    def declares(cls, hook: str, *laws: str) -> bool:
        """Whether the class defines a hook, and no subclass of that class has redefined `residual` or the `laws`."""
        where = lambda name: next((k for k, kind in enumerate(cls.__mro__) if name in vars(kind)), len(cls.__mro__))
        return all(where(hook) <= where(law) for law in ("residual", *laws))

    @classmethod
    def distinct(cls, bodies: Sequence[Any]) -> list[Any]:
        """The bodies that must differ: a body on which the part may have several places counts once."""
        first = len(bodies) if cls.several_from is None else cls.several_from
        return [*bodies[:first], *dict.fromkeys(bodies[first:])]

    def complete(self, space: AbstractSpace, poses: Poses) -> Self:
        """Hook: a copy with omitted numbers computed from the given poses; see `filled`."""
        del space, poses
        return self

    def settled(self, known: KnownParts) -> tuple[Self, tuple[int, ...]]:
        cls, names = type(self), self.bodies
        numbers = tuple(known.numbers[name] for name in names)
        moving = [k for k in cls.distinct(numbers) if k != known.numbers[GROUND]]
        if len({*moving}) < len(moving):
            raise ValueError(f"{self.label} connects two frames of one body: {', '.join(names)}.")
        part, bodies = cls.placed(self, known, names)
        part = cls.resolve(part, known.space, cls.seen_poses(part, known.space, known.poses[list(bodies)]))
        return part, (*bodies, *known.scalars.get(self.name, ()))

    def components(self) -> tuple["AbstractLink", ...]:
        """Hook: the component parts, by default itself; called after the numbers have been filled in."""
        return (self,)

    def scalar_coordinates(
        self, space: AbstractSpace, parts: Mapping[str, "AbstractLink"]
    ) -> tuple[ScalarCoordinate, ...]:
        """Hook: the scalar coordinates that the part adds, from all joints of the scene by name.

        The part's kernel sees each coordinate as a further body after `bodies`, and as the first entry of that body's
        pose.
        """
        del space, parts
        return ()

    def anchor(self, space: AbstractSpace, k: int, poses: Poses | None = None) -> Array | None:
        """The part's point [m] on its k-th body, in that body's axes; None if it has none.

        **Arguments:** `poses` of the part's bodies, for a point that moves in a flexible body; by default undeformed.
        """
        for name, declaration in fields.declarations(type(self)).items():
            point = getattr(self, name) if declaration.is_point and declaration.body == k else None
            if point is not None:
                frame = self.body_frames.get(str(k))
                if frame is None:
                    return point
                return frame.point(space, point, *(() if poses is None else frame.modal(poses)))
        return None

    def pictured(self, space: AbstractSpace) -> Self:
        """Hook: the part as a picture shows it: a copy that acts in the same way, with points where they are seen.

        A slide acts along a whole line: a picture shows the point of the line nearest to the middle of the sliding
        body.
        """
        del space
        return self

    def shapes(self, space: AbstractSpace, size: float) -> tuple[tuple[int | None, AbstractShape], ...]:
        """Hook: the shapes by which a picture shows the part, each with the index of its body, None for the world.

        **Arguments:** `size` [m]: the radius of a bar, by which symbols such as pins are scaled.
        """
        del space, size
        return ()

    def path(self, space: AbstractSpace, poses: Poses) -> Float[Array, "points d"] | None:
        """Hook: the world points [m] of the line by which a picture shows the part; None without a line.

        By `path_kind`, `"rod"` (also for None) and `"coil"` have two points; `"bar"` is a line, as thick as a body,
        `"cord"` a line and `"belt"` a closed line, through any number of points.
        """
        return None if self.path_kind is None else both_points(space, self, poses)

    def slack(self, space: AbstractSpace, poses: Poses) -> Scalar | None:
        """Hook: how much longer [m] the part is than its `path` of two points, between which a picture lets it hang."""
        del space, poses
        return None

    def followed(self, space: AbstractSpace, poses: Poses) -> Array | None:
        """Hook: a place or length [m] along a motion, which `shapes_along` takes; None without such shapes."""
        del space, poses
        return None

    def shapes_along(
        self, space: AbstractSpace, size: float, followed: Float[np.ndarray, "times ..."]
    ) -> tuple[tuple[int, AbstractShape], ...]:
        """Hook: further `shapes`, as large as a motion needs; arguments as of `shapes`, and what is `followed` at its
        times.
        """
        del space, size, followed
        return ()

    def pitch_radii(self, distance: float) -> tuple[float, float] | None:
        """Hook: the pitch radii [m] of two gears, `bodies[:2]`, from the distance of their axes; None of other parts.
        The last body holds their axes; of an internal mesh one radius is negative, and its gear a ring.
        """
        del distance
        return None


class AbstractPair(AbstractLink):
    """A part that acts between two bodies.

    **Arguments:**

    - `name`, of the part; `body_a`, `body_b`: the bodies that it connects, or frames in them, by name. Either may be
        `"ground"`.
    """

    name: str = fields.name()
    body_a: str = fields.body_name()
    body_b: str = fields.body_name()


class AbstractPointPair(AbstractPair):
    """A part that acts between points of two bodies.

    **Arguments:**

    - `point_a`, `point_b` [m]: A fixed in `body_a`, B fixed in `body_b`, default the origins of the frames.
    """

    point_a: fields.Number = fields.point(body=0, default="origin")
    point_b: fields.Number = fields.point(body=1, default="origin")
    # Whether it is a spring along the line between its points, whose motion ratio a suspension has.
    is_spring: ClassVar[bool] = False


class AbstractConstraint(AbstractLink):
    """A position constraint, `residual = 0`.

    `rows` is the static number of scalar equations; `rheonomic` says whether the residual depends on time.
    """

    rows: AbstractVar[int]
    rheonomic: AbstractVar[bool]
    # Constraints need no `drift`: their residuals are differentiated with respect to time.
    takes_drift: ClassVar[bool] = False

    @abc.abstractmethod
    def residual(self, space: AbstractSpace, poses: Poses, t: Scalar) -> Float[Array, "rows"]:
        """Φ(poses, t) of this part."""

    @property
    def elements(self) -> Any:
        """Hook: the elementary constraints of a joint in the order of its rows, from `parts.coincident`,
        `perpendicular`, `in_planes` and `apart`; None if the joint has its residual alone.

        They vanish with the residual and have the same derivatives there; `jaxmb.report.check_elements` compares them.
        """
        return None

    def elementary_joints(self, space: AbstractSpace, poses: Any) -> Any:
        """Hook: a spatial joint as a succession of hinges, slides and balls from `body_a` to `body_b`: an
        `ElementaryJoint` for each of its coordinates at these poses. None if the joint is not such a succession.
        """
        del space, poses
        return None


class AbstractInertialConstraint(AbstractConstraint):
    """A position constraint on a scalar coordinate that the part adds, whose only property is an `inertia` [kg m² of an
    angle, kg of a length].
    """

    inertia: AbstractVar[Float[Array, ""]]


class AbstractJoint(AbstractPair, AbstractConstraint):
    """A constraint between a point of `body_a` and a point of `body_b`.

    **Arguments:**

    - `point_a`, `point_b` [m]: A fixed in `body_a`, B fixed in `body_b`; or `point` [m]: both, at this place of the
        world at the given poses. In the plane they have shape (2,), in space (3,).
    """

    point_a: fields.Number = fields.point(body=0, optional=True)
    point_b: fields.Number = fields.point(body=1, optional=True)
    point: fields.Number = fields.point(body=None, gives=("point_a", "point_b"))
    rheonomic: ClassVar[bool] = False


class AbstractAxisJoint(AbstractJoint):
    """A joint with an axis in `body_a`.

    **Arguments:**

    - `axis_a`, unit, shape (2,) in the plane and (3,) in space: the axis fixed in `body_a`; or `axis`, unit: the axis
        in the world at the given poses.
    """

    axis_a: fields.Number = fields.axis(body=0, optional=True)
    axis: fields.Number = fields.axis(body=None, gives=("axis_a",))


class AbstractTendon(AbstractLink):
    """A length along joints or bodies, on which other parts act; by itself it exerts no force.

    Its coordinate is `length`. It may have scalar coordinates that count turns of angles; `rows` is their number.
    """

    rheonomic: ClassVar[bool] = False
    quantities: ClassVar[Quantities] = {"length": "length"}

    @property
    def rows(self) -> int:
        return 0

    @abc.abstractmethod
    def length(self, space: AbstractSpace, poses: Poses) -> Float[Array, ""]:
        """The length at these poses of its bodies."""

    def residual(self, space: AbstractSpace, poses: Poses, t: Scalar) -> Float[Array, "rows"]:
        """Hook: the scalar coordinates minus the angles that they count, modulo full turns; zero along a motion."""
        del space, t
        return jnp.zeros(0, poses.dtype)

    def coordinates(self, space, poses):
        return {"length": self.length(space, poses)}


class AbstractVelocityConstraint(AbstractLink):
    """A velocity constraint that is not the derivative of a position constraint, `residual = 0`.

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
    """A part that consists of several others under one name."""

    @abc.abstractmethod
    def components(self) -> tuple[AbstractLink, ...]:
        """The component parts; called after the numbers have been filled in."""


class AbstractForce(AbstractLink):
    """A force law without potential energy: all its power is dissipated or supplied."""

    conservative = False
    # Whether the force acts only where one of its `gaps` is closed; then no step of the solver skips the force.
    has_gaps: ClassVar[bool] = False

    @abc.abstractmethod
    def wrenches(self, space: AbstractSpace, poses: Poses, velocities: Velocities, t: Scalar) -> Wrenches:
        """The wrench on each of its bodies."""

    def observables(
        self, space: AbstractSpace, poses: Poses, velocities: Velocities, t: Scalar
    ) -> dict[str, Float[Array, "..."]]:
        """Hook: quantities of a motion by their names within the part, such as section forces of a beam."""
        del space, poses, velocities, t
        return {}

    def gaps(self, space: AbstractSpace, poses: Poses, t: Scalar) -> Float[Array, "gaps"]:
        """Hook: the gaps [m, rad] of a part that `has_gaps`, negative where the force acts. Each is a distance from a
        convex shape, or varies with a joint.
        """
        raise NotImplementedError(f"{self.kind} says has_gaps = True, and needs a method gaps.")

    @property
    def gap_width(self) -> Any:
        """Hook: the width [m, rad] of a smooth onset of the force, before a gap is closed."""
        return 0.0

    def gap_pace(self, space: AbstractSpace, poses: Poses, velocities: Velocities, t: Scalar) -> Float[Array, ""]:
        """Hook: a rate [1/s]; in an interval of 1/pace no gap closes and opens unless its rates at both ends show it.
        By default an upper bound of the relative angular velocity of two bodies.
        """
        del poses, t
        return 2 * jnp.max(norm(velocities[:, space.dimension :]))


class AbstractPotentialForce(AbstractForce):
    """A force law with a potential energy; it may also dissipate or supply power."""

    conservative = True
    # Whether the stored energy depends on velocities, as `energy_in_motion` gives it.
    stores_by_speed: ClassVar[bool] = False

    @abc.abstractmethod
    def energy(self, space: AbstractSpace, poses: Poses, t: Scalar) -> Float[Array, ""]:
        """Potential energy [J], at rest."""

    def energy_in_motion(
        self, space: AbstractSpace, poses: Poses, velocities: Velocities, t: Scalar
    ) -> Float[Array, ""]:
        """Hook, of a class with `stores_by_speed = True`: the stored energy [J], such as of a tyre that its rotation
        stiffens.
        """
        del velocities
        return self.energy(space, poses, t)


class AbstractDynamicForce(AbstractForce, AbstractDynamicPart):
    """A force law with internal states of first order: a motor with lag, a tyre with relaxation, a filter.

    Each state is a field declared with `fields.internal_state`. It holds the current value in the kernels `wrenches`,
    `state_rates` and `energy` (for a part with a potential). `State.z` holds the internal states of all parts; their
    names are `"motor.torque"`.
    """


class AbstractNonIdeal(AbstractActor):
    """A non-ideal constraint force: it does virtual work.

    `joint` is the joint's name. The joint exerts its reactions and this force. The force may depend on the reactions;
    both are solved for together. Its components in directions that the joint blocks do not change the motion: they only
    reduce the reactions.
    """

    joint: AbstractVar[str]
    stage: ClassVar[int] = 2
    # As for `AbstractStickSlip`.
    needs: ClassVar[str] = "wrenches"

    @property
    def sources(self):
        return (self.joint,)

    def settled(self, known: KnownParts) -> tuple[Self, tuple[int, ...]]:
        joint, bodies = known.joints[self.joint]
        # The law sees what its joint sees.
        law = self.with_fields(body_frames=joint.body_frames)
        poses = law.seen_poses(known.space, known.poses[list(bodies)])
        return law.resolve(known.space, joint.with_fields(body_frames={}), poses), bodies

    def resolve(self, space: AbstractSpace, joint: AbstractLink, poses: Poses) -> Self:
        """A checked copy with every number filled in, from its joint and the poses of the joint's bodies.

        **Raises:** `ValueError` also if the joint has no rows, and therefore no reaction.
        """
        if isinstance(joint, AbstractConstraint) and not joint.rows:
            raise ValueError(f"{self.label} acts in {joint.label}, which leaves all motions free and has no reaction.")
        self.check(space.dimension)
        part = self.complete(space, joint, poses)
        part.check(space.dimension)
        return part

    def complete(self, space: AbstractSpace, joint: AbstractLink, poses: Poses) -> Self:
        """Hook: a copy with omitted numbers computed from its joint; see `filled`."""
        del space, joint, poses
        return self

    @abc.abstractmethod
    def wrenches(
        self, space: AbstractSpace, poses: Poses, velocities: Velocities, reactions: Wrenches, t: Scalar
    ) -> Wrenches:
        """The wrench on each of the joint's bodies; `reactions`: the joint's reaction wrenches on them."""


def _body_fixed(part: Any, space: AbstractSpace, poses: Poses) -> Any:
    """A copy with world points and directions made body-fixed, and directions normalised."""
    declared, given, values = fields.declarations(type(part)), fields.values_of(part), {}
    for name, declaration in declared.items():
        value = given[name]
        if declaration.at_origin and value is None:
            values[name] = fields.as_parameter(np.zeros(space.dimension))
        elif declaration.gives:
            _check_given(part, name, declaration)
            if value is None:
                continue
            values[name] = None
            for fixed in declaration.gives:
                pose = poses[declared[fixed].body]
                convert = space.body_point if declaration.is_point else space.body_direction
                in_body = lambda row, declaration=declaration, pose=pose, convert=convert: convert(
                    pose, row if declaration.is_point else _unit(row)
                )
                several = value.ndim > 1
                values[fixed] = namespace(pose, value).stack([*map(in_body, value)]) if several else in_body(value)
        elif (declaration.is_direction or declaration.is_attitude) and value is not None:
            values[name] = _unit(value)
    return type(part).with_fields(part, **values) if values else part


def _unit(value: Any) -> Any:
    return value / np.linalg.norm(value, axis=-1, keepdims=True)


def _check_given(part: Any, world: str, declaration: fields.Declaration) -> None:
    """Check that a point or direction is given either in the world or in the body frames."""
    values = fields.values_of(part)
    given = [name for name in declaration.gives if values[name] is not None]
    in_world = values[world] is not None
    if len(declaration.gives) == 1:
        if in_world == bool(given) and (in_world or declaration.needed):
            (fixed,) = declaration.gives
            body = part.bodies[fields.declarations(type(part))[fixed].body]
            raise ValueError(
                f"{part.label}: give {fixed} (fixed in {body!r}) or {world} (world), and only one of them."
            )
        return
    listed = " and ".join(declaration.gives)
    if in_world and given:
        raise ValueError(f"{part.label}: give either {world} (world) or {listed} (body-fixed), not both.")
    if not in_world and len(given) < len(declaration.gives):
        raise ValueError(f"{part.label}: give {listed} (body-fixed), or {world} (world).")


def rows_of(part: Any, space: AbstractSpace, poses: Poses) -> Array:
    """Jacobian of a constraint with respect to the velocities of its bodies, (rows, k, velocity size)."""
    velocities, t = jnp.ones((poses.shape[0], space.velocity_size), poses.dtype), jnp.zeros((), poses.dtype)
    if isinstance(part, AbstractVelocityConstraint):
        return jax.jacfwd(lambda v: part.residual(space, *part.seen(space, poses, v), t))(velocities)

    def rate(v):
        rates = jax.vmap(space.rates)(poses, v)
        return jax.jvp(lambda x: part.residual(space, part.seen_poses(space, x), t), (poses,), (rates,))[1]

    return jax.jacfwd(rate)(velocities)
