"""Couplings between coordinates of joints, tendons along them, and inertias that move with them."""

from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import VectorLike
from ..linalg.rotations import norm
from . import fields
from .base import AbstractConstraint, AbstractInertialConstraint, AbstractTendon, PathKind, ScalarCoordinate
from .coordinate_parts import AbstractOfCoordinates, shortest, turns

# An angle [rad] this near to half a turn is there.
_AT_HALF_TURN = 1e-2
# Largest distance of coinciding points of a tendon, relative to its length.
_APART = 1e-9


class AbstractCombination(AbstractOfCoordinates):
    """A part that acts on several coordinates of joints or tendons, each a number."""

    def complete(self, space, poses):
        given = []
        for k, name in enumerate(self.combined):
            value = self.given_coordinate(k, name, space, poses)
            if value.size != 1:
                raise ValueError(f"{self.label}: {name!r} must be a number, it has shape {value.shape}.")
            given.append(float(value.reshape(())))
        return self.with_given(np.array(given))

    def with_given(self, given: np.ndarray) -> Any:
        """Hook: a checked copy with omitted numbers filled in, from the coordinates at the given poses."""
        del given
        return self

    def values(self, space, poses) -> list[Float[Array, ""]]:
        """The coordinates."""
        return [self.coordinates_of(k, space, poses)[name].reshape(()) for k, name in enumerate(self.within)]


class JointCoupling(AbstractCombination, AbstractConstraint):
    """A coordinate that is a polynomial of another coordinate, or a sum of polynomials of several. Rows 1: `(x − zero)
    − Σᵢ Σₖ coefficients[i, k] (yᵢ − other_zero[i])ᵏ`.

    ```python
    link = planar.Body("link", mass=1.0, inertia=planar.rod(1.0, 1.0), position=(1.5, 0.0))
    elbow = planar.Revolute("elbow", "bar", "link", point=(1.0, 0.0))
    bend = jaxmb.JointCoupling("bend", "elbow.angle", "pin.angle", coefficients=(0.0, 0.5))
    system = jaxmb.Scene([bar, link], joints=[pin, elbow, bend]).compile()
    ```

    For angles known up to full turns, as of hinges in space, the row and `yᵢ − other_zero[i]` are wrapped to [−π, π].
    Gears with integer ratios then turn without end. Other gears turn by half a turn to either side, where a run ends
    with a message; along a tendon that counts turns they go on:

    ```python
    hinge = {"axis": (0.0, 0.0, 1.0), "point": (0.0, 0.0, 0.0)}
    wheels = [spatial.Body(name, mass=1.0, inertia=(0.1, 0.1, 0.2)) for name in ("wheel", "pinion")]
    axles = [spatial.Revolute(f"{wheel.name} axle", "ground", wheel.name, **hinge) for wheel in wheels]
    turns = jaxmb.FixedTendon("turns", ("wheel axle.angle",), coefficients=(1.0,))
    gear = jaxmb.JointCoupling("gear", "pinion axle.angle", "turns.length", coefficients=(0.0, 2.5))
    gearbox = jaxmb.Scene(wheels, joints=[*axles, turns, gear]).compile()
    ```

    A gear with losses has a `DryFriction` by its name, `jaxmb.DryFriction("loss", "gear", coefficient=0.1)`.

    **Arguments:**

    - `coordinate`: the name of x, such as `"finger.angle"`; `other`: the name or names of y.
    - `coefficients` of the polynomial, the constant first; for several y a row each, `((0, 0.5), (0, 0.5))` for the
        carrier of a differential.
    - `zero` and `other_zero` [rad, m], the latter a vector for several y; default the coordinates at the given poses.
    """

    coordinate: str = fields.name()
    other: fields.Names = fields.names()
    coefficients: fields.Number = fields.parameter(shape=None)
    zero: fields.Number = fields.parameter(unit=("rad", "m"), optional=True)
    other_zero: fields.Number = fields.parameter(shape=None, unit=("rad", "m"), optional=True)
    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = False

    @property
    def combined(self):
        return (self.coordinate, *self.other)

    def validate(self):
        several = () if len(self.other) == 1 else (len(self.other),)
        shape = self.coefficients.shape
        if shape[:-1] != several or not self.coefficients.size:
            wanted = "a vector" if not several else f"{several[0]} vectors of one length, one for each of {self.other}"
            raise ValueError(f"{self.label}: coefficients must be {wanted}, got shape {shape}.")
        if self.other_zero is not None and self.other_zero.shape != several:
            raise ValueError(f"{self.label}: other_zero must have shape {several}, got {self.other_zero.shape}.")
        twice = [name for name in self.combined if self.combined.count(name) > 1]
        if twice:
            raise ValueError(f"{self.label} couples {twice[0]!r} with itself.")

    def is_of_length(self, field):
        return self.are_lengths([0] if field == "zero" else range(1, len(self.within)))

    def with_given(self, given):
        return self.filled(zero=given[0], other_zero=given[1] if len(given) == 2 else given[1:])

    def residual(self, space, poses, t):
        x, *others = self.values(space, poses)
        out = x - self.zero
        rows, zeros = self.coefficients.reshape(len(others), -1), self.other_zero.reshape(-1)
        for i, (y, powers) in enumerate(zip(others, rows, strict=True)):
            y = y - zeros[i]
            y = shortest(y) if self.is_periodic(i + 1) else y
            polynomial = jnp.zeros_like(y)
            for k in reversed(range(rows.shape[1])):
                polynomial = polynomial * y + powers[k]
            out = out - polynomial
        return shortest(out[None]) if self.is_periodic(0) else out[None]

    def jumping(self, space: Any, poses: Any) -> list[int]:
        """The numbers of the angles among the y that are half a turn from their zeros, where the row jumps."""
        _, *others = self.values(space, poses)
        rows = np.asarray(self.coefficients).reshape(len(others), -1)
        zeros, out = np.asarray(self.other_zero).reshape(-1), []
        for i, (y, (_, *powers)) in enumerate(zip(others, rows, strict=True)):
            ratio, *higher = (*powers, 0.0)
            goes_on = self.is_periodic(0) and ratio == np.round(ratio) and not np.any(higher)
            off = np.abs(np.asarray(shortest(y - zeros[i])))
            if self.is_periodic(i + 1) and np.any(powers) and not goes_on and off > np.pi - _AT_HALF_TURN:
                out.append(i)
        return out


class JointInertia(AbstractCombination, AbstractInertialConstraint):
    """An inertia that moves with a coordinate of a joint or tendon: kinetic energy `½ inertia ẋ²`, and nothing else.

    ```python
    rotor = jaxmb.JointInertia("rotor", "pin.angle", inertia=50.0**2 * 1e-5)  # 1e-5 kg m² behind a gear of 50:1.
    system = jaxmb.Scene([bar], joints=[pin, rotor]).compile()
    ```

    The rotor of a motor with inertia J behind a gear of ratio n adds `n² J` to its joint: the reflected inertia, the
    armature of MuJoCo. It adds no mass, weight or momentum. The gyroscopic moment of the rotor and the reaction of its
    acceleration on the housing are neglected, as is usual for gears of high ratio. Where they matter, model the rotor
    as a body and the gear as a `JointCoupling`.

    It adds one coordinate, one velocity and one row to the scene. The coordinate is x with full turns counted:
    `"rotor.angle"`, or `"rotor.displacement"` for a displacement or length. The reaction of the part is the generalized
    force `−inertia ẍ`, on the last body of the joint.

    **Arguments:** `coordinate`, a number, such as `"hip.angle"`; `inertia` > 0 [kg m² of an angle, kg of a
    displacement].
    """

    coordinate: str = fields.name()
    inertia: fields.Number = fields.parameter(unit=("kg m²", "kg"), sign="positive", constant=True)
    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = False

    @property
    def combined(self):
        return (self.coordinate,)

    def scalar_coordinates(self, space, parts):
        del space
        joint, _, within = self.coordinate.partition(".")
        is_length = joint in parts and bool(parts[joint].is_length(within))
        name = f"{self.name}.{'displacement' if is_length else 'angle'}"
        return (ScalarCoordinate(name, is_length=is_length, moves=True),)

    def with_given(self, given):
        del given
        self.source_is_length(0, self.within[0])
        return self

    def residual(self, space, poses, t):
        (value,) = self.values(space, poses[:-1])
        out = (poses[-1, 0] - value)[None]
        return shortest(out) if self.is_periodic(0) else out


class FixedTendon(AbstractCombination, AbstractTendon):
    """A weighted sum of coordinates of joints, `length = Σ coefficients[k] x_k`: the length of a tendon around pulleys.

    ```python
    link = planar.Body("link", mass=1.0, inertia=planar.rod(1.0, 1.0), position=(1.5, 0.0))
    elbow = planar.Revolute("elbow", "bar", "link", point=(1.0, 0.0))
    cord = jaxmb.FixedTendon("cord", ("pin.angle", "elbow.angle"), coefficients=(0.03, -0.02))
    pull = jaxmb.JointForce("pull", "cord.length", force=-50.0)
    system = jaxmb.Scene([bar, link], joints=[pin, elbow, cord], forces=[pull]).compile()
    ```

    Springs, forces, drivers and actuators act on its coordinate, `"tendon.length"`.

    Angles of hinges in space are in (−π, π] at the given poses. Later full turns are counted, as for a cord that winds
    up; for each such angle the scene has a further coordinate, on which no force acts.

    **Arguments:** `along`: the names of the coordinates, such as `("left.angle", "right.angle")`; `coefficients` [m/rad
    for an angle], one for each coordinate.
    """

    along: fields.Names = fields.names()
    stage: ClassVar[int] = 1
    coefficients: fields.Number = fields.parameter(shape=None, unit=("m/rad", "1"))

    @property
    def combined(self):
        return self.along

    def validate(self):
        if self.coefficients.shape != (len(self.along),):
            raise ValueError(
                f"{self.label}: coefficients must have shape ({len(self.along)},), one per coordinate, got "
                f"{self.coefficients.shape}."
            )

    @property
    def _periodic(self):
        return [k for k in range(len(self.along)) if self.is_periodic(k)]

    @property
    def rows(self):
        return len(self._periodic)

    def scalar_coordinates(self, space, parts):
        del space
        split = [name.partition(".") for name in self.along]
        periodic = (within in parts[joint].periodic if joint in parts else False for joint, _, within in split)
        return tuple(
            ScalarCoordinate(f"{self.name}.angle_{k + 1}") for k, is_periodic in enumerate(periodic) if is_periodic
        )

    def residual(self, space, poses, t):
        values = self.values(space, poses)
        counts = poses[poses.shape[0] - self.rows :, 0]
        return shortest(counts - jnp.stack([values[k] for k in self._periodic]))

    def length(self, space, poses):
        values = self.values(space, poses)
        for count, k in enumerate(self._periodic, poses.shape[0] - self.rows):
            values[k] = values[k] + turns(poses[count, 0] - values[k])
        return jnp.dot(self.coefficients, jnp.stack(values))


class Tendon(AbstractTendon):
    """A tendon that runs straight from point to point: its length is the sum of their distances.

    ```python
    cord = jaxmb.Tendon("cord", [("ground", (0.0, 1.0)), ("bar", (0.5, 0.0))])
    spring = jaxmb.JointSpring("spring", "cord.length", stiffness=100.0, free=1.2)
    system = jaxmb.Scene([bar], joints=[pin, cord], forces=[spring]).compile()
    ```

    Springs, forces, drivers and actuators act on its coordinate, `"tendon.length"`. Neighbouring points must not
    coincide, neither at the given poses nor later.

    **Arguments:** `path`: pairs (body, point), at least two; points [m] are body-fixed. A body may occur several times.

    **Fields:** `bodies`, each once; `owners`, for each point the index of its body in `bodies`; `points`.
    """

    name: str = fields.name()
    bodies: fields.Names = fields.body_names()
    owners: tuple[int, ...] = eqx.field(static=True, default=())
    points: fields.Number = fields.parameter(shape=None, unit="m", kw_only=False)
    path_kind: ClassVar[PathKind] = "cord"

    def __init__(self, name: str, path: Sequence[tuple[str, VectorLike]]):
        self.name = name
        self.bodies = tuple(dict.fromkeys(body for body, _ in path))
        self.owners = tuple(self.bodies.index(body) for body, _ in path)
        self.points = [np.asarray(point, float) for _, point in path]

    def __check_init__(self):
        if len(self.owners) < 2 or self.points.ndim != 2:
            raise ValueError(f"{self.label}: path must hold at least 2 pairs (body, point), got {len(self.owners)}.")

    def complete(self, space, poses):
        distances = self._distances(space, poses)
        k = int(jnp.argmin(distances))
        if distances[k] <= _APART * jnp.sum(distances):
            raise ValueError(
                f"{self.label}: the neighbours path[{k}] and path[{k + 1}] coincide at the given poses; move one or "
                "leave it out."
            )
        return self

    def length(self, space, poses):
        return jnp.sum(self._distances(space, poses))

    def path(self, space, poses):
        return jax.vmap(space.point)(poses[np.array(self.owners)], self.points)

    def _distances(self, space, poses):
        points = self.path(space, poses)
        return norm(points[1:] - points[:-1])
