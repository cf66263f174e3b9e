"""Parts of several coordinates of joints: couplings between them, and tendons along them."""

import abc
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
from .base import AbstractConstraint, AbstractTendon, ScalarCoordinate
from .joint_parts import given_coordinate, shortest, turns
from .sources import AbstractOfSources


class AbstractCombination(AbstractOfSources):
    """A part that acts on several coordinates of joints or tendons.

    **Fields:** a scene fills in the `joints`, by number, and `places`: for each of them the numbers of its bodies among
    those of the part.
    """

    name: str = fields.name()
    joints: Any = fields.parts()
    within: tuple[str, ...] = eqx.field(static=True, default=(), kw_only=True)
    places: tuple[tuple[int, ...], ...] = eqx.field(static=True, default=(), kw_only=True)

    @property
    @abc.abstractmethod
    def combined(self) -> tuple[str, ...]:
        """The names of the coordinates, `"hip.angle"`."""

    @property
    def sources(self):
        return tuple(name.split(".")[0] for name in self.combined)

    @property
    def bodies(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for joint in self.joints.values() for name in joint.bodies))

    def of_sources(self, parts, places):
        return self.with_fields(
            joints={str(k): joint for k, joint in enumerate(parts)},
            within=tuple(name.partition(".")[2] for name in self.combined),
            places=tuple(places),
        )

    def complete(self, space, poses):
        given = []
        for k, name in enumerate(self.combined):
            value = given_coordinate(self, self.joints[str(k)], name, space, poses[list(self.places[k])])
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
        own = enumerate(zip(self.within, self.places, strict=True))
        return [self.joints[str(k)].coordinates_at(space, poses[np.array(at)])[w].reshape(()) for k, (w, at) in own]

    def is_periodic(self, k: int) -> bool:
        """Whether a coordinate is an angle known up to full turns."""
        return self.within[k] in self.joints[str(k)].periodic


class JointCoupling(AbstractCombination, AbstractConstraint):
    """A coordinate that is a polynomial of another one, or a sum of polynomials of several others. Rows 1:
    `(x − zero) − Σᵢ Σₖ coefficients[i, k] (yᵢ − other_zero[i])ᵏ`.

    Of angles known up to full turns, the row and `yᵢ − other_zero[i]` are taken in [−π, π]. A gear whose ratios are
    whole numbers so turns without end, one with other ratios by half a turn to either side.

    **Arguments:** `coordinate` and `other`, the names of x and of y, such as `"finger.angle"`, or of several others;
    `coefficients`, of the polynomial, the constant first, or for several others one row each: of the carrier of a
    differential `((0, 0.5), (0, 0.5))`; `zero` and `other_zero` [rad, m], for several others one each, default the
    coordinates at the given poses.
    """

    coordinate: str = fields.name()
    other: fields.Names = fields.names()
    coefficients: fields.Number = fields.parameter(shape=None)
    zero: fields.Number = fields.parameter(unit="rad or m", optional=True)
    other_zero: fields.Number = fields.parameter(shape=None, unit="rad or m", optional=True)
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


class FixedTendon(AbstractCombination, AbstractTendon):
    """A weighted sum of coordinates of joints, `length = Σ coefficients[k] x_k`, as a tendon around pulleys has.

    Springs, forces, drivers and actuators act on its coordinate, `"tendon.length"`.

    Angles of hinges in space are in (−π, π] at the given poses, and counted from there on through full turns, like a
    cord that winds up: for each the scene has a coordinate more, which no force acts on.

    **Arguments:** `along`: the names of the coordinates, such as `("left.angle", "right.angle")`; `coefficients` [m/rad
    of an angle], one for each.
    """

    along: fields.Names = fields.names()
    coefficients: fields.Number = fields.parameter(shape=None, unit="m/rad or 1")

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

    def scalar_coordinates(self, parts):
        split = [name.partition(".") for name in self.along]
        periodic = (own in parts[joint].periodic if joint in parts else False for joint, _, own in split)
        return tuple(ScalarCoordinate(f"{self.name}.angle_{k + 1}") for k, own in enumerate(periodic) if own)

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

    Springs, forces, drivers and actuators act on its coordinate, `"tendon.length"`. Neighbouring points must not
    coincide.

    **Arguments:** `path`: pairs (body, point), at least two; points [m] are body-fixed. A body may occur several times.

    **Fields:** `bodies`, each once; `owners`, for each point the index of its body among them; `points`.
    """

    name: str = fields.name()
    bodies: fields.Names = fields.body_names()
    owners: tuple[int, ...] = eqx.field(static=True, default=())
    points: fields.Number = fields.parameter(shape=None, unit="m", kw_only=False)

    def __init__(self, name: str, path: Sequence[tuple[str, VectorLike]]):
        self.name = name
        self.bodies = tuple(dict.fromkeys(body for body, _ in path))
        self.owners = tuple(self.bodies.index(body) for body, _ in path)
        self.points = [np.asarray(point, float) for _, point in path]

    def __check_init__(self):
        if len(self.owners) < 2 or self.points.ndim != 2:
            raise ValueError(f"{self.label}: path must hold at least 2 pairs (body, point), got {len(self.owners)}.")

    def length(self, space, poses):
        points = jax.vmap(space.point)(poses[np.array(self.owners)], self.points)
        return jnp.sum(norm(points[1:] - points[:-1]))
