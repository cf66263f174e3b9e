"""Parts of one type, stacked, with the kernels of their kind: one kernel and one `vmap` serve any number of them."""

import abc
import dataclasses
import functools
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import Any, ClassVar, NamedTuple, Self, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, Int

from .._captured import Captured
from .._types import Scalar
from ..linalg.blocks import vector_products
from ..linalg.rotations import cross
from ..linalg.sums import unchecked_take
from ..parts.base import AbstractPart
from ..parts.boundary import captured
from ..parts.fields import anonymous, entry, inner_parts
from ..parts.series import AbstractSignal, of_each, of_one_kind
from ..parts.servo import Servo
from ..parts.space import AbstractSpace
from ..system.contact_set import ContactMotion, ContactPlace
from .layout import Layout

# Prepared poses, and velocities or accelerations, of all bodies, scalar coordinates and the ground, in this order.
BodyPoses: TypeAlias = Float[Array, "b_ground p"]
BodyVelocities: TypeAlias = Float[Array, "b_ground v"]


# For more parts than this, `turning` gives one combination of the parts' functions of time.
_MOST_TURNING = 32

# Wrenches of parts, shape (parts, k, v), and the indices of the loaded bodies, shape (parts, k).
Acting: TypeAlias = tuple[Float[Array, "parts k v"], np.ndarray]


class Placed(NamedTuple):
    """A scene at rest: time `t` [s], prepared `poses` of bodies, scalar coordinates and ground; `places`: what each
    group of contacts and of dry friction says of them, see `law_groups`, and `contacts`: all together.
    """

    t: Scalar
    poses: BodyPoses
    places: tuple[Any, ...] = ()
    contacts: ContactPlace | None = None


class Kinematics(NamedTuple):
    """A scene in motion: as `Placed`, with the `velocities`; `motions`: what each group of laws says of these, and
    `contacts`: all together.
    """

    t: Scalar
    poses: BodyPoses
    velocities: BodyVelocities
    places: tuple[Any, ...] = ()
    motions: tuple[Any, ...] = ()
    contacts: ContactMotion | None = None


class Input(eqx.Module):
    """A parameter of stacked parts that is a function of time, or several functions of one kind.

    **Fields:** the `signal`; `names` of the parameters; `keys` that lead to the parameter in a part; `members`: indices
    of the parts; `moves`: whether the parameter moves points, axes or joints, so that its rate counts too.
    """

    signal: AbstractSignal
    names: tuple[str, ...] = eqx.field(static=True)
    keys: tuple[str, ...] = eqx.field(static=True)
    members: tuple[int, ...] = eqx.field(static=True)
    moves: bool = eqx.field(static=True)

    def alone(self) -> "list[Input]":
        """One input for each part."""
        signals = of_each(self.signal, len(self.names))
        entries = zip(signals, self.names, self.members, strict=True)
        return [Input(signal, (name,), self.keys, (member,), self.moves) for signal, name, member in entries]

    def value(self, member: Any, t: Scalar) -> Array:
        """The value for one of the `members`. Functions of one kind are all computed, once for all parts."""
        if len(self.members) == 1:
            return self.signal(t)
        values = jax.vmap(lambda signal: signal(t))(self.signal)
        place = self._entry(np.arange(len(self.members)), 0, member)
        return values.at[place].get(mode="clip", wrap_negative_indices=False)

    def drives(self, member: Any) -> Any:
        """Whether a part is among the `members`."""
        return member == self.members[0] if len(self.members) == 1 else self._entry(True, False, member)

    def _entry(self, of_members, of_others, member):
        """`of_members[k]` if `member` is `members[k]`, `of_others` for other parts; larger indices are clipped."""
        entries = np.full(max(self.members) + 2, of_others)
        entries[list(self.members)] = of_members
        return jnp.asarray(entries).at[member].get(mode="clip", wrap_negative_indices=False)


def together(inputs: Sequence[Input]) -> tuple[Input, ...]:
    """Inputs of single parts, combined by kind of function."""
    kinds: dict[Any, list[Input]] = {}
    for single in inputs:
        kinds.setdefault((single.keys, single.moves), []).append(single)
    out = []
    for (keys, moves), alike in kinds.items():
        for numbers, signal in of_one_kind([single.signal for single in alike]):
            names, members = ([getattr(alike[k], field)[0] for k in numbers] for field in ("names", "members"))
            out.append(Input(signal, tuple(names), keys, tuple(members), moves))
    return tuple(out)


class Group(eqx.Module):
    """Stacked parts.

    **Fields:** `part`: the structure of one part, with a leading axis on every number; `names` and `bodies` of the
    parts; the `layout`; `inputs`, which replace numbers by functions of time; `inner`: for parts within the parts, the
    keys that lead there and the inner parts' names; `kernels` of a user's class by name, captured when the scene was
    compiled; `of_time`: names of kernels that depend on time through functions of the user; `chosen`: the indices of
    the parts, None for all parts.
    """

    part: Any
    names: tuple[str, ...] = eqx.field(static=True)
    bodies: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    layout: Layout = eqx.field(static=True)
    inputs: tuple[Input, ...] = ()
    inner: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = eqx.field(static=True, default=())
    kernels: tuple[tuple[str, Captured], ...] = eqx.field(static=True, default=())
    of_time: tuple[str, ...] = eqx.field(static=True, default=())
    chosen: Int[Array, "parts"] | None = None

    def only(self, member: Any) -> Self:
        """The group of one part, whose index may be traced. `names` and `bodies` still list all parts."""
        part = jax.tree.map(lambda leaf: leaf[member][None], self.part)
        return dataclasses.replace(self, part=part, chosen=jnp.asarray(member)[None])

    def map(self, kernel: Callable[..., Any], *per_part: Array) -> Any:
        """`kernel(at, …)` of every part, with the part's rows of the arrays; `at(t)` is the part at a time."""
        if not self.inputs:
            return jax.vmap(lambda part, *rows: kernel(lambda t: part, *rows))(self.part, *per_part)
        single = lambda member, part, *rows: kernel(lambda t: self._at(member, part, t), *rows)
        members = jnp.arange(len(self.names)) if self.chosen is None else self.chosen
        return jax.vmap(single)(members, self.part, *per_part)

    def kernel(self, name: str) -> Callable[..., Any]:
        """A kernel as a function of one part and of the arguments after `space`; without arguments it is a property."""
        space = self.layout.space
        plain = lambda part, *arguments: getattr(part, name)(space, *arguments) if arguments else getattr(part, name)
        return dict(self.kernels).get(name, plain)

    def coordinates(self, part: Any, poses: Float[Array, "k p"]) -> dict[str, Array]:
        """The coordinates of one part, from the poses of its bodies."""
        return self.kernel("coordinates")(part, part.seen_poses(self.layout.space, poses))

    def at(self, t: Scalar) -> Any:
        """All parts at a time."""
        return self.map(lambda at: at(t)) if self.inputs else self.part

    def single(self, member: int, t: Scalar) -> Any:
        """One part at a time."""
        return self._at(member, jax.tree.map(lambda leaf: leaf[member], self.part), t)

    def _at(self, member, part, t):
        """One part with the values of its inputs at a time, and with their rates as `drift`."""
        drift = jax.tree.map(lambda _: None, part)
        for driven in self.inputs:
            where = lambda part, keys=driven.keys: entry(part, keys)
            given = where(part)
            signal = lambda t, driven=driven, like=given: jnp.asarray(driven.value(member, t), like.dtype)
            if driven.moves and part.takes_drift:
                time = jnp.asarray(t, jnp.result_type(float))
                value, rate = jax.jvp(signal, (time,), (jnp.ones_like(time),))
                rate = jnp.where(driven.drives(member), rate, jnp.zeros_like(rate))
                drift = eqx.tree_at(where, drift, rate, is_leaf=lambda x: x is None)
            else:
                value = signal(t)
            part = eqx.tree_at(where, part, jnp.where(driven.drives(member), value, given))
        return part.with_fields(drift=drift) if jax.tree.leaves(drift) else part

    @property
    def body_index(self) -> np.ndarray:
        """Bodies of each part, shape (parts, k)."""
        return np.array(self.bodies, np.int32)

    @property
    def rows(self) -> int:
        return self.part.rows

    def gather(self, of_bodies: Float[Array, "b_ground _"]) -> Float[Array, "parts k _"]:
        """The rows of each part's bodies, from an array of all bodies and the ground."""
        index: Any = self.body_index if self.chosen is None else jnp.asarray(self.body_index)[self.chosen]
        return unchecked_take(of_bodies, index)


def stack(
    parts: Sequence[tuple[AbstractPart, tuple[int, ...]]],
    layout: Layout,
    check: Callable[[Any, AbstractSpace, int], None] | None = None,
) -> tuple[Group, ...]:
    """Group parts that share type, static fields and shapes, in order of first appearance.

    **Arguments:** `parts` with the indices of their bodies; `check(part, space, bodies)`: called for the first part of
    each group, since all parts of a group share their functions.
    """
    groups: dict[Any, list] = {}
    structures: dict[Any, tuple[Any, Any]] = {}
    for part, bodies in parts:
        leaves, structure = jtu.tree_flatten(anonymous(part))
        if not all(eqx.is_array_like(leaf) for leaf in leaves):
            raise ValueError(_not_numbers(part))
        key = (structure, tuple(leaf.shape for leaf in leaves), len(bodies))
        if key not in groups:
            if check is not None:
                check(part, layout.space, len(bodies) - part.modal_rows)
            part_now, kernels, of_time = captured(anonymous(part), layout.space, len(bodies) - part.modal_rows)
            structures[key] = jtu.tree_structure(part_now), {"kernels": tuple(kernels.items()), "of_time": of_time}
        groups.setdefault(key, []).append((leaves, part.name, bodies, list(inner_parts(part))))
    out = []
    for key, members in groups.items():
        # NumPy, since XLA would compile a program for thousands of operands.
        columns = zip(*(member[0] for member in members), strict=True)
        leaves = [jax.device_put(np.stack([np.asarray(leaf) for leaf in column])) for column in columns]
        names, bodies = tuple(m[1] for m in members), tuple(m[2] for m in members)
        inner = tuple((keys, tuple(m[3][k][1].name for m in members)) for k, (keys, _) in enumerate(members[0][3]))
        structure, traced = structures[key]
        out.append(Group(jtu.tree_unflatten(structure, leaves), names, bodies, layout, inner=inner, **traced))
    return tuple(out)


def _not_numbers(part: AbstractPart) -> str:
    """A message about a part with a non-static field that is not a number."""
    wrong = [(path, leaf) for path, leaf in jtu.tree_flatten_with_path(part)[0] if not eqx.is_array_like(leaf)]
    path, leaf = wrong[0]
    field = jtu.keystr(path).removeprefix(".")
    return (
        f"{part.label}: {field} is {leaf!r}, which is not a number. Declare a function with fields.function(), and "
        "a module that holds functions, such as a neural network, with fields.module()."
    )


class AbstractGroup(eqx.Module):
    """Stacked parts with the kernels of their kind."""

    group: Group

    @property
    def is_position(self) -> bool:
        """Whether all rows are plain position constraints."""
        return False

    def part(self, name: str = "") -> AbstractPart:
        """The part under a name, with a leading axis on its numbers unless the group's arrays have none."""
        return self.group.part.named(name)

    def only(self, member: Any) -> Self:
        """The group of one part, whose index may be traced."""
        rest = jax.tree.map(lambda leaf: leaf[member][None], dataclasses.replace(self, group=None))
        return dataclasses.replace(rest, group=self.group.only(member))

    def coordinates(self, t: Scalar, poses: BodyPoses) -> dict[str, Float[Array, "parts *shape"]]:
        """The coordinates of the parts, by name within the part."""
        return self._map(lambda at, x: self.group.coordinates(at(t), x), poses)

    def headings(self, t: Scalar, poses: BodyPoses) -> Float[Array, "parts d"]:
        """The vectors whose directions the parts need."""
        kernel = self.group.kernel("heading")

        def single(at, x):
            part = at(t)
            return kernel(part, part.seen_poses(self._space, x))

        return self._map(single, poses)

    def in_time(self, now: Kinematics) -> Float[Array, "parts n"]:
        """Values of the parts' functions of time, kernel by kernel."""
        return jnp.concatenate([self._raveled(self._kernel_in_time(name, now)) for name in self.group.of_time], axis=1)

    def turning(self, in_time: Float[Array, "parts n"]) -> Float[Array, "k"]:
        """The values of `in_time` at whose turns steps end.

        Many parts give a combination of their values, with random weights so that no two values cancel.
        """
        parts = in_time.shape[0]
        if parts <= _MOST_TURNING:
            return in_time.ravel()
        weights = np.random.default_rng(0).uniform(1.0, 2.0, parts).astype(in_time.dtype)
        return jnp.asarray(weights) @ in_time

    @property
    def ends_at_turns(self) -> bool:
        """Whether steps end where a function of time turns, even if they would not pass over it."""
        return self.group.part.of_time

    def _kernel_in_time(self, name, now):
        if name == "gaps":
            kernel = self.group.kernel(name)
            return self._map(lambda at, x: kernel(at(now.t), at(now.t).seen_poses(self._space, x), now.t), now.poses)
        return self._of_motion(name, now)

    def state_rates(self, now: Kinematics) -> dict[str, Float[Array, "parts *shape"]]:
        """Rates of the parts' internal states, by the name of the field."""
        return self._of_motion("state_rates", now)

    @staticmethod
    def _raveled(of_parts):
        leaves = jax.tree.leaves(of_parts)
        return jnp.concatenate([leaf.reshape(leaf.shape[0], -1) for leaf in leaves], axis=1)

    @property
    def _space(self):
        return self.group.layout.space

    def _map(self, kernel, *of_bodies, per_part=()):
        """`kernel(at, …)` of every part, with the rows of its bodies, and with the arrays `per_part`."""
        return self.group.map(kernel, *map(self.group.gather, of_bodies), *per_part)

    def _of_motion(self, name, now):
        """A kernel of every part, as a function of its pose and velocity and of time."""
        kernel = self.group.kernel(name)

        def single(at, x, v):
            part = at(now.t)
            return kernel(part, *part.seen(self._space, x, v), now.t)

        return self._map(single, now.poses, now.velocities)


class BodyGroup(AbstractGroup):
    """Stacked bodies."""

    is_flexible: ClassVar[bool] = False

    def prepared(self) -> Self:
        """The group for the steps of a motion, with values that depend on parameters alone computed once."""
        return self

    @property
    def mass(self) -> Float[Array, "parts"]:
        """Masses [kg]."""
        return jax.vmap(self.group.kernel("mass"))(self.group.part)

    @property
    def inertia(self) -> Float[Array, "parts *matrix"]:
        """Moments of inertia [kg m²] about the mass centres."""
        return jax.vmap(self.group.kernel("inertia"))(self.group.part)

    def state_rates(self, now):
        kernel = self.group.kernel("state_rates")
        return self._map(lambda at, x, v: kernel(at(now.t), x, v, now.t), now.poses, now.velocities)


class FlexibleGroup(BodyGroup):
    """Stacked flexible bodies; the bodies of each are the body and its modal coordinates.

    Source: P. C. Hughes, "Spacecraft Attitude Dynamics", Wiley, 1986, chapter 3 (momenta of a deformable body in its
    frame).
    """

    is_flexible: ClassVar[bool] = True

    def prepared(self):
        part = jax.vmap(self._numbers)(self.group.part)
        return dataclasses.replace(self, group=dataclasses.replace(self.group, part=part))

    def _numbers(self, part):
        """A body with values of its numbers alone; kernels of a user's class take the body itself."""
        return part if self.group.kernels else part.prepared(self._space)

    def _matrix(self, part, zeta):
        return self.group.kernel("mass_matrix")(part, zeta)

    def mass_matrices(self, poses: BodyPoses) -> Float[Array, "parts n n"]:
        """Mass matrices for the velocities of the bodies, in world axes, and of the modal coordinates."""
        d = self._space.dimension

        def single(at, x):
            matrix = self._matrix(self._numbers(at(0.0)), x[1:, 0])
            turned = jax.vmap(functools.partial(self._space.direction, x[0]))
            rows = jnp.concatenate([turned(matrix[:, :d]), matrix[:, d:]], axis=1)
            return jnp.concatenate([turned(rows[:d].T), rows[d:].T], axis=1)

        return self._map(single, poses)

    def wrenches(self, now: Kinematics, gravity: Float[Array, "d"] | None) -> Float[Array, "parts k v"]:
        """Wrenches of gravity, of elasticity, and of the inertia forces without accelerations."""
        return self._map(functools.partial(self._wrenches, gravity), now.poses, now.velocities)

    def _wrenches(self, gravity, at, x, v):
        space, d, size = self._space, self._space.dimension, self._space.velocity_size
        part, kernel, zeta, rates = self._numbers(at(0.0)), self.group.kernel, x[1:, 0], v[1:, 0]
        velocity, spin = space.body_direction(x[0], v[0, :d]), v[0, d:]
        w = jnp.concatenate([velocity, spin, rates])
        matrix, push = jax.linearize(functools.partial(self._matrix, part), zeta)
        along_modes = vector_products(jax.vmap(push)(jnp.eye(len(zeta), dtype=x.dtype)), w)
        momentum = vector_products(matrix, w)
        # A velocity that is constant in world axes turns in the body's; gravity is an acceleration of the frame.
        acceleration = -space.swept(spin, velocity)
        if gravity is not None:
            acceleration = acceleration - space.body_direction(x[0], gravity)
        rate = vector_products(along_modes.T, rates) + vector_products(matrix[:, :d], acceleration)
        origin = space.prepare(jnp.asarray(space.ground, x.dtype))
        turning = space.force_at(origin, velocity, momentum[:d])[d:]
        if d == 3:
            turning = turning + cross(spin, momentum[3:6])
        elastic = kernel("internal_force")(part, zeta, rates) - jax.grad(lambda z: kernel("energy")(part, z))(zeta)
        along = 0.5 * vector_products(along_modes, w) + elastic
        force = jnp.concatenate([-space.swept(spin, momentum[:d]), -turning, along]) - rate
        force = jnp.concatenate([space.direction(x[0], force[:d]), force[d:]])
        modal = jnp.pad(force[size:, None], ((0, 0), (0, size - 1)))
        return jnp.concatenate([force[None, :size], modal])

    def energy(self, poses: BodyPoses, gravity: Float[Array, "d"] | None) -> Float[Array, ""]:
        """Potential energy [J] of gravity and elasticity."""
        space, d = self._space, self._space.dimension

        def single(at, x):
            part, zeta = self._numbers(at(0.0)), x[1:, 0]
            energy = self.group.kernel("energy")(part, zeta)
            if gravity is None:
                return energy
            matrix = self._matrix(part, zeta)
            # The momentum of a rotation is ω × s, with the first moment s of the mass.
            moment = jnp.stack([matrix[1, 5], matrix[2, 3], matrix[0, 4]] if d == 3 else [matrix[1, 2], -matrix[0, 2]])
            return energy - gravity @ (matrix[0, 0] * x[0, :d] + space.direction(x[0], moment))

        return jnp.sum(self._map(single, poses))


class CoordinateGroup(AbstractGroup):
    """Stacked parts with coordinates and without rows: tendons, and joints that leave all motions free."""

    @property
    def rows(self) -> int:
        return 0


class FrameGroup(AbstractGroup):
    """Stacked frames."""

    def poses(self, t: Scalar, poses: BodyPoses) -> Float[Array, "parts p"]:
        """Prepared poses of the frames."""
        return self._map(lambda at, x: at(t).pose(self._space, x[0], *at(t).modal(x)), poses)

    def velocities(self, now: Kinematics) -> Float[Array, "parts v"]:
        """Velocities of the frames."""
        single = lambda at, x, v: at(now.t).velocity(self._space, x[0], v[0], *at(now.t).modal(x), *at(now.t).modal(v))
        return self._map(single, now.poses, now.velocities)

    @property
    def quantities(self) -> dict[str, tuple[int, ...]]:
        """The shapes of the quantities that the frames have because they move in their bodies."""
        sizes: dict[Any, Any] = {"d": self._space.dimension}
        shapes = self.group.part.quantities
        return {name: tuple(sizes.get(size, size) for size in shape) for name, shape in shapes.items()}

    def measured(self, t: Scalar, poses: BodyPoses) -> dict[str, Float[Array, "parts *shape"]]:
        """These quantities."""
        return self._map(lambda at, x: at(t).measured(self._space, *at(t).modal(x)), poses)


class AbstractConstraintGroup(AbstractGroup):
    """Kernels of stacked constraints."""

    @abc.abstractmethod
    def velocity(self, now: Kinematics) -> Float[Array, "parts rows"]:
        """Residuals of the velocity constraints, or rates of the position constraints."""

    @abc.abstractmethod
    def jacobian(self, now: Kinematics) -> Float[Array, "parts rows k v"]:
        """Derivatives by velocities, body by body."""

    @abc.abstractmethod
    def wrenches(self, now: Kinematics, multipliers: Float[Array, "parts rows"]) -> Float[Array, "parts k v"]:
        """Wrenches of the constraints on their bodies, `Aᵀ λ` body by body."""

    @abc.abstractmethod
    def wrench_derivatives(
        self, now: Kinematics, multipliers: Float[Array, "parts rows"]
    ) -> Float[Array, "parts k v k v"]:
        """Derivatives of `wrenches` by displacements along the velocities of the parts' bodies."""

    @abc.abstractmethod
    def acceleration(self, now: Kinematics, accelerations: BodyVelocities) -> Float[Array, "parts rows"]:
        """The time derivative of `velocity`."""

    def jacobian_of(self, member: Any, now: Kinematics) -> Float[Array, "rows k v"]:
        """`jacobian` of one part, whose index may be traced."""
        return self.only(member).jacobian(now)[0]

    @property
    def is_contact(self) -> bool:
        """Whether the parts are contacts."""
        return False

    @property
    def is_friction(self) -> bool:
        """Whether the parts are dry friction."""
        return False

    @property
    def of_poses(self) -> bool:
        """Whether the rows come from residuals of poses."""
        return False

    @property
    def rows(self) -> int:
        return self.group.rows

    @property
    def row_count(self) -> int:
        """The number of rows of all parts."""
        return len(self.group.names) * self.rows


class ConstraintGroup(AbstractConstraintGroup):
    """Kernels of stacked position constraints, or of the programs of servos.

    Programs have the gains `damping` and `stiffness`, and act on accelerations.
    """

    damping: Float[Array, "parts"] | None = None
    stiffness: Float[Array, "parts"] | None = None

    @property
    def of_poses(self):
        return True

    @property
    def is_position(self):
        return self.damping is None

    def part(self, name=""):
        part = super().part(name)
        return part if self.damping is None else Servo(part, self.damping, self.stiffness)

    @property
    def rheonomic(self) -> bool:
        """Whether the residuals depend on time."""
        return self.group.part.rheonomic or bool(self.group.inputs)

    def _residual(self, at, t, x):
        part = at(t)
        return self.group.kernel("residual")(part, part.seen_poses(self._space, x), t)

    def residual(self, t: Scalar, poses: BodyPoses) -> Float[Array, "parts rows"]:
        return self._map(lambda at, x: self._residual(at, t, x), poses)

    @property
    def ends_at_turns(self):
        # A servo follows its program by accelerations, so that error control sees all but its pulses.
        return super().ends_at_turns and self.is_position

    def _kernel_in_time(self, name, now):
        return self.residual(now.t, now.poses) if name == "residual" else super()._kernel_in_time(name, now)

    def along(self, t: Scalar, poses: BodyPoses, moves: Float[Array, "b_ground n p"]) -> Float[Array, "parts rows k n"]:
        """Derivatives along `n` motions of every body. One body moves, the others rest."""

        def single(at, x, moves):
            if self.rows < len(moves):
                # Fewer rows than bodies: the gradient of each row, then its products with the motions.
                value, pull = jax.vjp(lambda x: self._residual(at, t, x), x)
                (gradients,) = jax.vmap(pull)(jnp.eye(self.rows, dtype=value.dtype))
                return jax.vmap(lambda of_bodies: vector_products(moves, of_bodies))(gradients)

            def along_one(body):
                # The residual's value is the same for every body, so XLA computes it once.
                residual = lambda pose: self._residual(at, t, jnp.stack([*x[:body], pose, *x[body + 1 :]]))
                push = lambda dx: jax.jvp(residual, (x[body],), (dx,))[1]
                return jax.vmap(push, out_axes=-1)(moves[body])

            return jnp.stack([along_one(body) for body in range(len(moves))], axis=1)

        return self._map(single, poses, moves)

    def jacobian(self, now):
        return self.along(now.t, now.poses, jax.vmap(self._space.moves)(now.poses))

    def velocity(self, now):
        rates = self._rates(now.poses, now.velocities)
        return self._map(lambda at, x, xdot: self._rate(at, now.t, x, xdot), now.poses, rates)

    def wrenches(self, now, multipliers):
        return self._map(functools.partial(self._wrench, now.t), now.poses, per_part=(multipliers,))

    def _wrench(self, t, at, x, multipliers):
        _, pull = jax.vjp(lambda x: self._residual(at, t, x), x)
        return jax.vmap(self._space.pull_back)(x, *pull(multipliers))

    def wrench_derivatives(self, now, multipliers):
        single = lambda at, x, lam: along_moves(self._space, lambda x: self._wrench(now.t, at, x, lam), x)
        return self._map(single, now.poses, per_part=(multipliers,))

    def acceleration(self, now, accelerations):
        t, poses, velocities, *_ = now
        rates = self._rates(poses, velocities)
        _, second = jax.jvp(self._rates, (poses, velocities), (rates, accelerations))

        def single(at, x, xdot, xddot):
            rate = lambda t, x, xdot: self._rate(at, t, x, xdot)
            return jax.jvp(rate, (t, x, xdot), (jnp.ones_like(t), xdot, xddot))[1]

        out = self._map(single, poses, rates, second)
        if self.damping is None or self.stiffness is None:
            return out
        rate, value = self.velocity(now), self.residual(t, poses)
        return out + self.damping[:, None] * rate + self.stiffness[:, None] * value

    def _rates(self, poses, velocities):
        return jax.vmap(self._space.rates)(poses, velocities)

    def _rate(self, at, t, x, xdot):
        """The rate of the residuals of one part, from the rates of its bodies' poses."""
        if self.rheonomic:
            residual = lambda t, x: self._residual(at, t, x)
            return jax.jvp(residual, (t, x), (jnp.ones_like(t), xdot))[1]
        return jax.jvp(lambda x: self._residual(at, t, x), (x,), (xdot,))[1]


class VelocityConstraintGroup(AbstractConstraintGroup):
    """Kernels of stacked velocity constraints."""

    @property
    def homogeneous(self) -> bool:
        """Whether the residuals vanish at rest."""
        return self.group.part.homogeneous and not self.group.inputs

    def _residual(self, at, t, x, v):
        part, space = at(t), self._space
        return self.group.kernel("residual")(part, *part.seen(space, x, v), t)

    def velocity(self, now):
        return self._map(lambda at, x, v: self._residual(at, now.t, x, v), now.poses, now.velocities)

    def jacobian(self, now):
        single = lambda at, x, v: jax.jacfwd(lambda w: self._residual(at, now.t, x, w))(v)
        return self._map(single, now.poses, now.velocities)

    def wrenches(self, now, multipliers):
        return self._map(functools.partial(self._wrench, now.t), now.poses, now.velocities, per_part=(multipliers,))

    def _wrench(self, t, at, x, v, multipliers):
        return jax.vjp(lambda w: self._residual(at, t, x, w), v)[1](multipliers)[0]

    def wrench_derivatives(self, now, multipliers):
        single = lambda at, x, v, lam: along_moves(self._space, lambda x: self._wrench(now.t, at, x, v, lam), x)
        return self._map(single, now.poses, now.velocities, per_part=(multipliers,))

    def acceleration(self, now, accelerations):
        t, poses, velocities, *_ = now

        def single(at, x, xdot, v, a):
            residual = lambda t, x, v: self._residual(at, t, x, v)
            return jax.jvp(residual, (t, x, v), (jnp.ones_like(t), xdot, a))[1]

        rates = jax.vmap(self._space.rates)(poses, velocities)
        return self._map(single, poses, rates, velocities, accelerations)


def servo_group(group: Group) -> ConstraintGroup:
    """The programs of stacked servos with their gains."""
    part = group.part
    of_time = ("given_in_time",) if group.of_time and part.program.of_time else group.of_time
    program = part.program.with_fields(body_frames=part.body_frames)
    return ConstraintGroup(dataclasses.replace(group, part=program, of_time=of_time), part.damping, part.stiffness)


class ForceGroup(AbstractGroup):
    """Kernels of stacked forces."""

    def wrenches(self, now: Kinematics) -> Float[Array, "parts k v"]:
        return self._map(lambda at, x, v: self._wrenches(at, now.t, x, v), now.poses, now.velocities)

    def _wrenches(self, at, t, x, v):
        part = at(t)
        wrenches = self.group.kernel("wrenches")(part, *part.seen(self._space, x, v), t)
        return part.wrenches_on_bodies(self._space, x, wrenches)

    def gaps(
        self, now: Kinematics
    ) -> tuple[
        Float[Array, "parts gaps"], Float[Array, "parts gaps"], Float[Array, "parts gaps"], Float[Array, "parts"]
    ]:
        """Gaps, their rates, the widths over which forces set in, and the pace of each part."""
        space, t = self._space, now.t

        def single(at, x, v):
            gaps = lambda t, x: self.group.kernel("gaps")(at(t), at(t).seen_poses(space, x), t)
            gap, rate = jax.jvp(gaps, (t, x), (jnp.ones_like(t), jax.vmap(space.rates)(x, v)))
            part = at(t)
            width = jnp.broadcast_to(jnp.asarray(part.gap_width, gap.dtype), gap.shape)
            return gap, rate, width, self.group.kernel("gap_pace")(part, *part.seen(space, x, v), t)

        return self._map(single, now.poses, now.velocities)

    def derivatives(self, now: Kinematics) -> tuple[Float[Array, "parts k v k v"], Float[Array, "parts k v k v"]]:
        """Derivatives of `wrenches` by displacements along the velocities of the parts' bodies, and by velocities."""

        def single(at, x, v):
            of_positions = along_moves(self._space, lambda x: self._wrenches(at, now.t, x, v), x)
            return of_positions, jax.jacfwd(lambda v: self._wrenches(at, now.t, x, v))(v)

        return self._map(single, now.poses, now.velocities)

    def observables(self, now: Kinematics) -> dict[str, Float[Array, "parts *shape"]]:
        """Further quantities of a motion, by name within the part."""
        return self._of_motion("observables", now)

    def energy(self, t: Scalar, poses: BodyPoses) -> Float[Array, ""]:
        if not self.group.part.conservative:
            return jnp.zeros((), poses.dtype)

        def single(at, x):
            part = at(t)
            return self.group.kernel("energy")(part, part.seen_poses(self._space, x), t)

        return jnp.sum(self._map(single, poses))

    def energy_in_motion(self, now: Kinematics) -> Float[Array, ""]:
        part = self.group.part
        if part.conservative and part.stores_by_speed:
            return jnp.sum(self._of_motion("energy_in_motion", now))
        return self.energy(now.t, now.poses)


class NonIdealGroup(AbstractGroup):
    """Kernels of stacked non-ideal laws.

    **Fields:** `joints`: the name of each law's joint.
    """

    joints: tuple[str, ...] = eqx.field(static=True)

    @property
    def needs(self) -> str:
        """What the laws need of their joints: reaction `"wrenches"`, `"multipliers"` in their place, or `"nothing"`."""
        return self.group.part.needs

    def tensions(self, now: Kinematics, reactions: Float[Array, "parts rows"]) -> Float[Array, "parts spans"]:
        """Tensions of the spans of ropes."""
        return self._of_reactions("tensions", now, reactions)

    def normal_forces(self, now: Kinematics, reactions: Array) -> Float[Array, "laws d"]:
        """Vectors as long as the normal forces of dry friction are large, for each row of the laws."""
        part, d = self.group.part, self._space.dimension
        if self.needs == "nothing":
            return jnp.zeros((len(self.group.names), d), now.poses.dtype)
        if self.needs == "wrenches":
            forces = reactions[:, part.last, :d]
            return forces if part.rows == 1 else jnp.repeat(forces, part.rows, axis=0)
        limits = self._of_reactions("limits", now, reactions).reshape(-1, 1)
        return jnp.pad(limits, ((0, 0), (0, d - 1)))

    def _of_reactions(self, name, now, reactions):
        kernel = self.group.kernel(name)
        single = lambda at, x, reaction: kernel(at(now.t), at(now.t).seen_poses(self._space, x), reaction)
        return self._map(single, now.poses, per_part=(reactions,))

    def _kernel_in_time(self, name, now):
        # Any reactions show the time in a law.
        return self.wrenches(
            now, jnp.ones((*self.group.body_index.shape, now.velocities.shape[1]), now.velocities.dtype)
        )

    def wrenches(self, now: Kinematics, reactions: Array) -> Float[Array, "parts k v"]:
        """Wrenches of the laws on the bodies of their joints, from the joints' `reactions`."""
        space, kernel = self._space, self.group.kernel("wrenches")

        def single(at, x, v, reaction):
            part = at(now.t)
            seen = *part.seen(space, x, v), part.seen_wrenches(space, x, reaction)
            return part.wrenches_on_bodies(space, x, kernel(part, *seen, now.t))

        return self._map(single, now.poses, now.velocities, per_part=(reactions,))


# Paths to the groups of a system, by the sets that they belong to.
BIND_POSITIONS = "constraints.position"
BIND = (BIND_POSITIONS, "constraints.velocity", "constraints.servos")
_OTHERS = ("forces.groups", "constraints.nonideal", "frames", "bodies.tendons", "free_joints")


def groups_by_path(system: Any) -> dict[str, tuple[Any, ...]]:
    """All groups of a system's parts, by the path of their set."""
    return {path: attrgetter(path)(system) for path in ("bodies.groups", *BIND, *_OTHERS)}


def along_moves(space: AbstractSpace, function: Callable[[Array], Array], x: Float[Array, "k p"]) -> Array:
    """Derivatives of a function of poses along unit velocities of the bodies, (…, k, v)."""
    moves = jax.vmap(space.moves)(x)
    k, size, _ = moves.shape
    _, push = jax.linearize(function, x)
    along = jnp.eye(k, dtype=x.dtype)[:, None, :, None] * moves[:, :, None, :]
    columns = jax.vmap(push, out_axes=-1)(along.reshape(k * size, *x.shape))
    return columns.reshape(*columns.shape[:-1], k, size)


def joined(pieces: Sequence[Array], dtype: Any) -> Float[Array, "n"]:
    """All pieces in one vector."""
    return jnp.concatenate([piece.reshape(-1) for piece in pieces]) if pieces else jnp.zeros(0, dtype)
