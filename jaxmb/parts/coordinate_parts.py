"""Parts that act on joints and tendons by their coordinates, such as `"hip.angle"`: springs, forces, stops, friction,
prescribed motions.
"""

import abc
from collections.abc import Iterable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from ..linalg.sums import unchecked_take
from . import fields
from .base import (
    AbstractForce,
    AbstractLink,
    AbstractPart,
    AbstractPotentialForce,
    KnownParts,
    Wrenches,
)
from .curves import check_given, over_arrays
from .drivers import AbstractDriver
from .forces import generalized_force
from .names import unknown
from .smooth import ramp, without_pull
from .space import rate_of, with_drift


class AbstractOfJoints(AbstractLink):
    """A part that acts on joints and tendons, or measures them; also bodies and frames if it `takes_bodies`.

    **Fields:** a scene fills in both. `joints`: the joints, tendons and frames by the index of the source, no entry for
    a body. `places`: for each source, the indices of its bodies in the part's bodies.
    """

    name: str = fields.name()
    joints: Any = eqx.field(
        default_factory=dict, init=False, metadata={"declaration": fields.Declaration("parts", of=dict)}
    )
    places: tuple[tuple[int, ...], ...] = eqx.field(static=True, default_factory=tuple, init=False)
    stage: ClassVar[int] = 2

    @property
    def bodies(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for joint in self.joints.values() for name in joint.bodies))

    def settled(self, known: KnownParts):
        held = [known.source(name) for name in self.sources]
        numbers = tuple(dict.fromkeys(k for _, bodies in held for k in bodies))
        places = [tuple(numbers.index(k) for k in bodies) for _, bodies in held]
        part = self.of_sources([source for source, _ in held], places)
        return part.resolve(known.space, known.poses[list(numbers)]), (*numbers, *known.scalars.get(self.name, ()))

    def of_sources(self, parts: Sequence[AbstractPart | None], places: Sequence[tuple[int, ...]]) -> Any:
        """A copy that holds its sources.

        **Arguments:** `parts`: a joint, tendon or frame for each of `sources`, None for a body; `places`: for each the
        indices of its bodies in this part's bodies.
        """
        held = {str(k): part for k, part in enumerate(parts) if part is not None}
        return self.with_fields(joints=held, places=tuple(places))

    def source_is_length(self, k: int, within: str) -> bool:
        """Whether a coordinate of a source is a length, otherwise an angle.

        **Raises:** `ValueError` if its class does not say so.
        """
        joint = self.joints[str(k)]
        if (is_length := joint.is_length(within)) is None:
            raise ValueError(
                f"{self.label}: {joint.label} does not say whether its coordinate {within!r} is an angle or a length; "
                f"declare quantities = {{{within!r}: 'angle'}} or 'length' in the class {joint.kind}."
            )
        return is_length

    def coordinates_of(self, k: int, space, poses) -> dict[str, Array]:
        """The coordinates of a source, by their names within it."""
        at = self.places[k]
        return self.joints[str(k)].coordinates_at(
            space, poses if at == tuple(range(len(poses))) else poses[np.array(at)]
        )

    def rates_of(self, k: int, space, poses, velocities) -> dict[str, Array]:
        """The rates of the coordinates of a source that knows them."""
        at = np.array(self.places[k])
        return self.joints[str(k)].rates_at(space, unchecked_take(poses, at), unchecked_take(velocities, at))

    def given_coordinate(self, k: int, coordinate: str, space: Any, poses: Any) -> np.ndarray:
        """A coordinate of a source at the given poses.

        **Raises:** `ValueError` if the joint has no such coordinate; the message lists its coordinates.
        """
        values = self.coordinates_of(k, space, poses)
        name, _, within = coordinate.partition(".")
        if within not in values:
            names = [f"{name}.{key}" for key in values]
            if not names:
                raise ValueError(f"{self.label}: {self.joints[str(k)].label} has no coordinate.")
            raise unknown("coordinate", coordinate, names, self.label)
        return np.asarray(values[within])


class AbstractOfCoordinates(AbstractOfJoints):
    """A part that acts on coordinates of joints or tendons.

    **Fields:** `within`: the names of the coordinates within their joints, which a scene fills in.
    """

    within: tuple[str, ...] = eqx.field(static=True, default_factory=tuple, init=False)

    @property
    @abc.abstractmethod
    def combined(self) -> tuple[str, ...]:
        """The names of the coordinates, `"hip.angle"`."""

    @property
    def sources(self):
        return tuple(name.split(".")[0] for name in self.combined)

    def of_sources(self, parts, places):
        within = tuple(name.partition(".")[2] for name in self.combined)
        return super().of_sources(parts, places).with_fields(within=within)

    def is_of_length(self, field):
        return self.are_lengths(range(len(self.within)))

    def are_lengths(self, numbers: Iterable[int]) -> Any:
        """Whether each of the coordinates at these indices is a length; None if unknown."""
        lengths = [self.joints[str(k)].is_length(self.within[k]) for k in numbers]
        return None if None in lengths else np.array(lengths if len(lengths) > 1 else lengths[0])

    def is_periodic(self, k: int = 0) -> bool:
        """Whether a coordinate is an angle known up to full turns."""
        # A part outside of a scene does not know its joint.
        return bool(self.joints) and self.within[k] in self.joints[str(k)].periodic


class AbstractCoordinatePart(AbstractOfCoordinates):
    """A part that acts on a coordinate of a joint or tendon, in the plane or in space.

    **Arguments:**

    - `name`, of the part; `coordinate` of a joint or tendon, which its class documents, such as `"hip.angle"` or
        `"cord.length"`.
    """

    coordinate: str = fields.name()
    # The internal state that is the force of a drive along the coordinate; None for other parts.
    drives_by: ClassVar[str | None] = None

    @property
    def combined(self):
        return (self.coordinate,)

    @property
    def joint(self) -> AbstractLink:
        """The joint or tendon."""
        return self.joints["0"]

    def complete(self, space, poses):
        return self.with_numbers(self.given_coordinate(0, self.coordinate, space, poses))

    @abc.abstractmethod
    def with_numbers(self, given: np.ndarray) -> Any:
        """A checked copy with omitted numbers filled in, from the coordinate at the given poses."""

    def measured(self, space, poses) -> Float[Array, "n"]:
        """The coordinate, raveled."""
        return self.coordinates_of(0, space, poses)[self.within[0]].reshape(-1)

    def measured_with_rate(self, space, poses, velocities) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
        """The coordinate and its rate, raveled."""
        if self.drift is None and self.joint.knows_rates:
            return self.measured(space, poses), self.rate(space, poses, velocities)
        return rate_of(space, self, lambda part, x: part.measured(space, x), poses, velocities)

    def rate(self, space, poses, velocities) -> Float[Array, "n"]:
        """The rate of the coordinate, raveled, of a joint that knows it."""
        return self.rates_of(0, space, poses, velocities)[self.within[0]].reshape(-1)

    def force_along(self, space, poses, velocities, law) -> Wrenches:
        """Wrenches of a force along the coordinate, `law(value, rate)`, raveled."""
        return generalized_force(space, self, lambda part, x: part.measured(space, x), poses, velocities, law)

    def difference(self, value: Float[Array, "n"], target: Float[Array, "*shape"]) -> Float[Array, "n"]:
        """`value − target`, wrapped to [−π, π] for angles known up to full turns."""
        out = value - target.reshape(-1)
        return shortest(out) if self.is_periodic() else out

    def shortest_difference(self, value: Float[Array, "n"], target: Float[Array, "*shape"]) -> Float[Array, "n"]:
        """`value − target`, wrapped to [−π, π] for any angle."""
        out = value - target.reshape(-1)
        return shortest(out) if self.joints and self.within[0] in self.joint.angles else out

    def near(self, value: Float[Array, "n"], middle: Float[Array, "*shape"]) -> Float[Array, "n"]:
        """The value; an angle known up to full turns is wrapped to within half a turn of `middle`."""
        return middle.reshape(-1) + self.difference(value, middle) if self.is_periodic() else value

    def middle_of_turn(self) -> Float[Array, "*n"] | None:
        """Hook: the angle [rad] half a turn away from which the part's force jumps; None if it does not jump, NaN for
        a member of stacked parts that does not.
        """
        return None

    def _check_shape(self, field: str, given: np.ndarray) -> None:
        shape = np.shape(getattr(self, field))
        if shape != given.shape:
            raise ValueError(
                f"{self.label}: {field} must have the shape of {self.coordinate!r}, {given.shape}, got {shape}."
            )

    def _check_middle(self) -> None:
        if not self.is_periodic():
            raise ValueError(
                f"{self.label}: middle belongs to an angle in space, which {self.coordinate!r} is not; leave it out."
            )


class AbstractCoordinateForce(AbstractCoordinatePart):
    """A part that exerts a force along a coordinate, which its value and its rate determine."""

    @abc.abstractmethod
    def law(self, x: Float[Array, "n"], v: Float[Array, "n"]) -> Float[Array, "n"]:
        """The generalized force along the coordinate, from its value and its rate, raveled."""

    def wrenches(self, space, poses, velocities, t):
        return self.force_along(space, poses, velocities, self.law)

    def curve(self, value: ArrayLike = 0.0, rate: ArrayLike = 0.0) -> Float[Array, "..."]:
        """The generalized force [N m, N] along the coordinate, positive where it increases the coordinate: the law of a
        motion, without a machine.

        ```python
        spring = jaxmb.JointSpring("spring", "pin.angle", stiffness=20.0, damping=0.5, free=0.0)
        forces = spring.curve(np.linspace(-1.0, 1.0, 101), rate=0.3)
        ```

        **Arguments:** `value` [rad, m] and `rate` [rad/s, m/s] of the coordinate, numbers or arrays that broadcast. An
        angle counts as it is, without the turns that a joint in space takes off. The control of an actuator with a lag
        acts at once.

        **Raises:** `ValueError` for other arguments, and for a number that the part gets from a scene only.
        """
        return over_arrays(self.label, _force_at, self._in_itself(), value=value, rate=rate)

    def _in_itself(self):
        """The part with all numbers that the law needs."""
        return self


def _force_at(part, value, rate):
    return part.law(value[None], rate[None])[0]


def shortest(angle: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The angle [rad] wrapped to [−π, π]."""
    return angle - turns(angle)


def turns(angle: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The full turns [rad] that are nearest to an angle."""
    return 2 * np.pi * lax.stop_gradient(jnp.round(angle / (2 * np.pi)))


class JointSpring(AbstractCoordinateForce, AbstractPotentialForce):
    """A linear spring and damper on a coordinate: generalized force `−stiffness (value − free) − damping rate`.

    ```python
    spring = jaxmb.JointSpring("spring", "pin.angle", stiffness=20.0, damping=0.5, free=0.0)
    system = jaxmb.Scene([bar], joints=[pin], forces=[spring]).compile()
    ```

    **Arguments:** `stiffness` [N m/rad, N/m] ≥ 0; `damping` [N m s/rad, N s/m] ≥ 0; `free` [rad, m], where the spring
    exerts no force, default the coordinate at the given poses. In space the spring of an angle takes the shortest way
    to `free`, up to half a turn. With `middle` [rad], the middle of its range, the angle is instead wrapped to within
    half a turn of `middle`. A run that goes beyond, where the force jumps, warns. On the length of a `FixedTendon`
    along the angle, a spring winds up through any number of turns. `spring.curve(0.1, rate=0.3)` is the force without a
    machine.
    """

    stiffness: fields.Number = fields.parameter(unit=("N m/rad", "N/m"), sign="non-negative")
    damping: fields.Number = fields.parameter(unit=("N m s/rad", "N s/m"), sign="non-negative", default=0.0)
    free: fields.Number = fields.parameter(shape=None, unit=("rad", "m"), optional=True)
    middle: fields.Number = fields.parameter(shape=None, unit=("rad", "m"), optional=True)

    def with_numbers(self, given):
        part = self.filled(free=given)
        for field in ("free",) if part.middle is None else ("free", "middle"):
            part._check_shape(field, given)
        if part.middle is not None:
            part._check_middle()
        return part

    def _stretch(self, value):
        if self.middle is None:
            return self.difference(value, self.free)
        return self.near(value, self.middle) - self.free.reshape(-1)

    def middle_of_turn(self):
        middle, stiffness = self.free if self.middle is None else self.middle, jnp.asarray(self.stiffness)
        # A damper alone does not jump.
        acts = jnp.reshape(stiffness != 0, stiffness.shape + (1,) * (jnp.ndim(middle) - stiffness.ndim))
        return jnp.where(acts, middle, jnp.nan)

    def law(self, x, v):
        return -self.stiffness * self._stretch(x) - self.damping * v

    def _in_itself(self):
        return check_given(self, "free")

    def energy(self, space, poses, t):
        return 0.5 * self.stiffness * jnp.sum(self._stretch(self.measured(space, poses)) ** 2)


class JointForce(AbstractCoordinateForce, AbstractForce):
    """A force along a coordinate, or a moment about it, with its reaction on the other body: a motor on a hinge.

    ```python
    motor = jaxmb.JointForce("motor", "pin.angle", force=2.0)
    system = jaxmb.Scene([bar], joints=[pin], forces=[motor]).compile()
    ```

    **Arguments:** `force` [N m, N], of the coordinate's shape, positive where it increases the coordinate. As an input
    of `simulate`, `"motor.force"` is a function of time.
    """

    force: fields.Number = fields.parameter(shape=None, unit=("N m", "N"))

    def with_numbers(self, given):
        self._check_shape("force", given)
        return self

    def law(self, x, v):
        return self.force.reshape(-1)


class JointDriver(AbstractCoordinatePart, AbstractDriver):
    """A coordinate that is prescribed, `value + rate t`. Rows: one for each of its components.

    ```python
    turn = jaxmb.JointDriver("turn", "pin.angle", value=0.0, rate=2.0)
    system = jaxmb.Scene([bar], joints=[pin, turn]).compile()
    ```

    **Arguments:** `value` [rad, m], default from the given poses; `rate` [rad/s, m/s], default zero; both of the
    coordinate's shape. As an input of `simulate`, `"drive.value"` is any function of time.

    `motion["turn"].drive_force` is the force along the coordinate [N, of an angle N m], a number at each time, or a
    vector of its components. It is positive where it increases the coordinate: force × rate is the power that the
    driver puts into the machine.
    """

    value: fields.Number = fields.parameter(shape=None, unit=("rad", "m"), optional=True)
    rate: fields.Number = fields.parameter(shape=None, unit=("rad/s", "m/s"), optional=True)
    rows: int = eqx.field(static=True, default_factory=lambda: 1, init=False)

    def with_numbers(self, given):
        part = self.filled(value=given, rate=np.zeros_like(given))
        part._check_shape("value", given)
        part._check_shape("rate", given)
        return part.with_fields(rows=given.size)

    def prescribed(self, t):
        return self.value + self.rate * t

    def unmet(self, space, poses, value):
        return self.difference(self.measured(space, poses), value)


class AbstractScalarPart(AbstractCoordinatePart):
    """A part of a coordinate that is a number."""

    def with_numbers(self, given):
        if given.size != 1:
            raise ValueError(f"{self.label}: {self.coordinate!r} must be a number, it has shape {given.shape}.")
        return self


class JointStop(AbstractCoordinateForce, AbstractScalarPart, AbstractPotentialForce):
    """Compliant stops at the ends of a coordinate's range: a spring and a damper where it is outside.

    ```python
    stop = jaxmb.JointStop("stop", "pin.angle", lower=-0.5, upper=1.0, stiffness=1e4, damping=10.0)
    system = jaxmb.Scene([bar], joints=[pin], forces=[stop]).compile()
    ```

    The depth δ beyond a stop is a smooth ramp, `δ = ½ (d + √(d² + smoothing²))` with d = lower − value or value −
    upper. The potential is `½ stiffness δ²`, and the dissipated power `damping δ̇²`; while the coordinate leaves a
    stop, damping is at most as large as the elastic force, so that a stop never pulls. With an `exponent` it is
    progressive: the potential is `stiffness δ^(exponent + 1) / (exponent + 1)`. Beyond the bend the elastic force is
    nearly `stiffness d`, or `stiffness d^exponent`.

    **Arguments:** `lower` < `upper` [rad, m]; `stiffness` ≥ 0 [N m/rad, N/m; N m/rad^exponent, N/m^exponent];
    `exponent` > 0 and `damping` [N m s/rad, N s/m] ≥ 0, default none; `smoothing` [rad, m] > 0, the width of the ramp's
    bend. In space the range of an angle must be less than a full turn.
    """

    lower: fields.Number = fields.parameter(unit=("rad", "m"))
    upper: fields.Number = fields.parameter(unit=("rad", "m"))
    stiffness: fields.Number = fields.parameter(unit=("N m/rad", "N/m"), sign="non-negative")
    exponent: fields.Number = fields.parameter(unit="1", sign="positive", optional=True)
    damping: fields.Number = fields.parameter(unit=("N m s/rad", "N s/m"), sign="non-negative", optional=True)
    smoothing: fields.Number = fields.parameter(unit=("rad", "m"), sign="positive", default=1e-3)
    moving: ClassVar[tuple[str, ...]] = ("lower", "upper")
    has_gaps: ClassVar[bool] = True

    def validate(self):
        if not self.lower < self.upper:
            raise ValueError(f"{self.label}: lower must be less than upper, got {self.lower} and {self.upper}.")

    def numbers_agree(self):
        return self.lower < self.upper

    def with_numbers(self, given):
        if self.is_periodic() and self.upper - self.lower >= 2 * np.pi:
            raise ValueError(
                f"{self.label}: the range of an angle in space must be less than a full turn, got {self.lower} to "
                f"{self.upper}."
            )
        return super().with_numbers(given)

    def is_of_length(self, field):
        return None if field == "stiffness" and self.exponent is not None else super().is_of_length(field)

    def gaps(self, space, poses, t):
        return self._gaps(self.measured(space, poses))

    def middle_of_turn(self):
        return 0.5 * (self.lower + self.upper)

    @property
    def gap_width(self):
        return self.smoothing

    def _gaps(self, value):
        value = self.near(value, 0.5 * (self.lower + self.upper))
        return jnp.concatenate([value - self.lower, self.upper - value])

    def _depths(self, value):
        return ramp(-self._gaps(value), self.smoothing)

    def law(self, x, v):
        depth, pull = jax.vjp(self._depths, x)
        push = self.stiffness * (depth if self.exponent is None else depth**self.exponent)
        if self.damping is not None:
            _, rate = jax.jvp(self._depths, (x,), (v,))
            push += without_pull(push, self.damping * with_drift(self, rate, lambda part: part._depths(x)))
        return -pull(push)[0]

    def energy(self, space, poses, t):
        depths = self._depths(self.measured(space, poses))
        if self.exponent is None:
            return 0.5 * self.stiffness * jnp.sum(depths**2)
        return self.stiffness * jnp.sum(depths ** (self.exponent + 1)) / (self.exponent + 1)
