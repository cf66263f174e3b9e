"""Ropes over pulleys and drums, in the plane and in space."""

import itertools
from collections.abc import Sequence
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._compat import with_values
from .._types import VectorLike
from ..linalg.arrays import namespace
from ..linalg.elimination import solve
from ..linalg.rotations import cross, norm
from ..linalg.sums import placed_sums, unchecked_take, with_entries
from . import fields
from .base import (
    AbstractCompound,
    AbstractConstraint,
    AbstractLink,
    AbstractPotentialForce,
    AbstractTendon,
    PathKind,
    Quantities,
    ScalarCoordinate,
)
from .contact_laws import Capstan
from .coordinate_parts import shortest, turns
from .dry_friction import AbstractStickSlip
from .forces import generalized_force
from .kinks import clipped, excess
from .modes import FORWARD, kind_of
from .shapes import wheel
from .space import rate_of
from .spatial.axes import perpendiculars
from .tangents import quarter_turn, tangent_lines
from .unilateral import AbstractGeometricContact

# Neighbouring pulleys in space have axes that are parallel to this sine.
_PARALLEL = 1e-6
# In the plane angles that are not counted change by no more than this [rad], in both directions.
_FARTHEST = 0.9 * np.pi
# Angles beyond this are of a rope off its pulley [rad]; other negative ones are of more than half a turn.
_FARTHEST_OFF = 0.8 * np.pi
# Where a motion ends with a straight part shorter than this share of the radius, it ends because of it.
_AT_CIRCLE = 0.01
# Lengths that differ by no more than this share are equal.
_ROUNDING = 1e-9
# Of a point none.
_SENSES = {"left": 1, "right": -1, "": 0}


class Pulley(NamedTuple):
    """A pulley or drum in the path of a `Rope`.

    ```python
    hoist = planar.Body("hoist", mass=2.0, inertia=planar.disc(2.0, 0.1))
    drum = jaxmb.Pulley("hoist", radius=0.1, turn="right", turns=3.0)
    ```

    The rope lies on a circle about the centre, normal to the axis. A pulley at an end of the path is a drum: the rope
    is fastened to it and winds up as it turns.

    **Fields:**

    - `body`, or a frame in it, by name; `radius` [m] > 0, to the middle of the rope.
    - `turn`: whether the rope turns `"left"` (counter-clockwise) or `"right"` on it, seen along the path; in space with
        the axis towards the eye.
    - `centre` [m], body-fixed, default the origin of the frame; `axis`, in space, body-fixed.
    - `grips`: whether the rope does not slip on it, so that it turns with the rope. By default it is without friction.
    - `friction` μ ≥ 0 of a rope of constant length on a pulley that it passes: it sticks or slips, see `Rope`.
    - `turns`: full turns of rope on it at the given poses: of a drum all, of another pulley those beyond the first,
        a whole number.
    - `lifts`: whether an elastic rope in the plane may lift off it, and come back; see `Rope`.
    """

    body: str
    radius: Any
    turn: Literal["left", "right"]
    centre: VectorLike | None = None
    axis: VectorLike | None = None
    grips: bool = False
    turns: float = 0.0
    friction: Any = None
    lifts: bool = False


class AbstractRope(AbstractLink):
    """The path of a rope: points and pulleys in order, joined by straight parts.

    The rope consists of spans, which end at its ends and at pulleys that grip it.

    **Fields:**

    - `bodies`, each once. For each place of the path: `owners`, the index of its body among them; `points` [m], the
        centre of a pulley; `senses`, 1 for a pulley on which the rope turns left, -1 right, 0 for a point; `grips`;
        `lifts`.
    - For each pulley: `radii` [m]; `axes`, in space.
    - `counts`: whether full turns are counted; `bearings` [rad]: the `_angles` at the given poses.
    - `marks` [rad]: of pulleys that hold the rope (drums, and those that grip), the bearing without rope on a drum, and
        at the given poses.
    """

    name: str = fields.name()
    bodies: fields.Names = fields.body_names()
    owners: tuple[int, ...] = eqx.field(static=True, default=())
    senses: tuple[int, ...] = eqx.field(static=True, default=())
    grips: tuple[bool, ...] = eqx.field(static=True, default=())
    lifts: tuple[bool, ...] = eqx.field(static=True, default=())
    counts: bool = eqx.field(static=True, default=False)
    points: fields.Number = fields.parameter(shape=(None, "d"), unit="m")
    radii: fields.Number = fields.length(shape=(None,), sign="positive", optional=True)
    axes: fields.Number = fields.axis(body=None, shape=(None, 3), optional=True, dimension=3)
    bearings: fields.Number = fields.parameter(shape=(None,), unit="rad", optional=True)
    marks: fields.Number = fields.parameter(shape=(None,), unit="rad", optional=True)
    quantities: ClassVar[Quantities] = {"length": "length", "wrap": "angle"}
    path_kind: ClassVar[PathKind] = "cord"
    has_limits: ClassVar[bool] = True

    @property
    def kind(self):
        return "Rope"

    # Places of the path

    @property
    def _pulleys(self) -> np.ndarray:
        """The places of pulleys."""
        return np.flatnonzero(self.senses)

    @property
    def passed_places(self) -> np.ndarray:
        """The places of pulleys that the rope passes, all but drums at its ends."""
        return np.array([k for k in self._pulleys if 0 < k < len(self.senses) - 1], int)

    @property
    def passed_pulleys(self) -> np.ndarray:
        """The numbers of these pulleys among all pulleys."""
        return np.searchsorted(self._pulleys, self.passed_places)

    @property
    def _holding(self) -> np.ndarray:
        """The places of pulleys that hold the rope."""
        return np.array([k for k in self._pulleys if self.grips[k] or k in (0, len(self.senses) - 1)], int)

    @property
    def size(self) -> int:
        """The number of angles of the rope."""
        return len(self.passed_places) + len(self._holding)

    def _span(self, part: Any) -> np.ndarray:
        """The span to which a straight part belongs, numbered by the place before it."""
        inner = [k for k in self.passed_places if self.grips[k]]
        return np.sum(np.asarray(part)[..., None] >= np.array(inner, int), axis=-1)

    @property
    def spans(self) -> int:
        """The number of spans."""
        return int(self._span(len(self.senses) - 2)) + 1

    @property
    def sides(self) -> int:
        """The number of tensions."""
        return self.spans

    def _of_pulleys(self, places: np.ndarray, values: Any) -> Any:
        """Values of pulleys, one for each of some places."""
        return unchecked_take(values, np.searchsorted(self._pulleys, places))

    def _signed(self, places: np.ndarray, values: Any) -> Any:
        """Values of some places, positive where the rope turns left."""
        return np.array(self.senses)[places].astype(values.dtype) * values

    # Geometry

    def _at(self, poses, places: Any = slice(None)) -> Any:
        """The poses of the bodies at some places of the path."""
        return unchecked_take(poses, np.array(self.owners)[places])

    def _straight(self, space, poses) -> tuple[Any, Any]:
        """Of the straight parts: lengths [m], and unit vectors along them in the planes of their pulleys. The part
        before a pulley off which the rope has lifted leads to the place behind it, and the next part has no length.
        """
        k, (lengths, along) = np.flatnonzero(self.lifts), self._touching(space, poses)
        if not k.size:
            return lengths, along
        past, along_past = self._between(space, poses, k - 1, k + 1)
        xp: Any = namespace(lengths)
        number, first = np.full(len(lengths), k.size), np.zeros(len(lengths))
        number[k - 1] = number[k] = np.arange(k.size)
        first[k - 1] = 1.0
        of_parts = lambda values: unchecked_take(xp.concatenate([values, xp.ones_like(values[:1])]), number)
        past = first.astype(lengths.dtype) * of_parts(past)
        off = of_parts(self._lifted(space, poses, along)) <= 0
        return xp.where(off, past, lengths), xp.where(off[:, None], of_parts(along_past), along)

    def _lifted(self, space, poses, along) -> Any:
        """The angles [rad] on pulleys that the rope may leave, from parts that touch them; negative where it is off."""
        numbers = np.searchsorted(self.passed_places, np.flatnonzero(self.lifts))
        angles: Any = unchecked_take(self._angles(space, poses, along), numbers)
        if not self.counts or self.bearings is None:
            return namespace(angles).where(angles > -_FARTHEST_OFF, angles, angles + 2 * np.pi)
        known = unchecked_take(self._counted(poses) + self.bearings, numbers)
        return angles + turns(known - angles)

    def _touching(self, space, poses) -> tuple[Any, Any]:
        """The straight parts of a rope that touches all its pulleys."""
        places = np.arange(len(self.senses))
        return self._between(space, poses, places[:-1], places[1:])

    def _between(self, space, poses, before: np.ndarray, after: np.ndarray) -> tuple[Any, Any]:
        """Lengths and directions of the straight parts between some places."""
        centres: Any = _each(space.point, self._at(poses), self.points)
        xp = namespace(centres)
        d: Any = unchecked_take(centres, after) - unchecked_take(centres, before)
        if not len(self._pulleys):
            return _between_points(d)
        places = np.arange(len(self.senses))
        number = np.where(np.isin(places, self._pulleys), np.searchsorted(self._pulleys, places), len(self._pulleys))
        at = lambda values, index: unchecked_take(xp.concatenate([values, xp.zeros_like(values[:1])]), index)
        # The rope is to the right of the centre of a pulley on which it turns left.
        offset = self._signed(places, at(self.radii, number))
        axes, nearest = None, np.minimum(number[before], number[after])
        if space.dimension == 3:
            axes = at(self._axes(space, poses), nearest)
        lengths, along = tangent_lines(d, unchecked_take(offset, after) - unchecked_take(offset, before), axes)
        if axes is not None and len(self._pulleys) in nearest:
            # Between two points there is no axis.
            plain, (length, direction) = nearest == len(self._pulleys), _between_points(d)
            return xp.where(plain, length, lengths), xp.where(plain[:, None], direction, along)
        return lengths, along

    def _axes(self, space, poses) -> Any:
        """Axes of the pulleys, in the world."""
        return _each(space.direction, self._at(poses, self._pulleys), self.axes)

    def _angles(self, space, poses, along) -> Any:
        """Angles [rad] up to full turns, shape (size,), positive as the rope turns: those by which it turns on pulleys
        that it passes, and the bearings at pulleys that hold it.
        """
        k, xp = self.passed_places, namespace(along)
        before, after = unchecked_take(along, k - 1), unchecked_take(along, k)
        if space.dimension == 2:
            sine = xp.sum(quarter_turn(before) * after, axis=1)
        else:
            axes = self._of_pulleys(k, self._axes(space, poses))
            sine = xp.sum(axes * cross(before, after), axis=1)
        turned = self._signed(k, xp.arctan2(sine, xp.sum(before * after, axis=1)))
        if not len(self._holding):
            return turned
        return xp.concatenate([turned, self._bearings(space, poses, along)])

    def _bearings(self, space, poses, along) -> Any:
        """Angles [rad], positive as the rope turns, of the straight parts before the pulleys that hold it, of a drum at
        the start after it: in the plane from the x axis of the world, in space from an axis of the pulley's body.
        """
        k, xp = self._holding, namespace(along)
        lines = unchecked_take(along, np.maximum(k - 1, 0))
        x, y = lines[:, 0], lines[:, 1]
        if space.dimension == 3:
            lines = _each(space.body_direction, self._at(poses, k), lines)
            across = _each(perpendiculars, self._of_pulleys(k, self.axes))
            x, y = (xp.sum(across[:, i] * lines, axis=1) for i in (0, 1))
        return self._signed(k, xp.arctan2(y, x))

    def _continued(self, space, poses, along) -> Float[Array, "size"]:
        """The angles with their full turns."""
        if not self.size:
            return jnp.zeros(0, along.dtype)
        angles = self._angles(space, poses, along)
        if self.counts:
            known = self._counted(poses) + self.bearings
            off = np.isin(np.arange(self.size), np.searchsorted(self.passed_places, np.flatnonzero(self.lifts)))
            known = jnp.where(off & (known < 0), 0.0, known) if np.any(off) else known
            return angles + turns(known - angles)
        away = shortest(angles - self.bearings)
        # No step passes from here to the other side, where the angle would jump by a turn.
        return self.bearings + jnp.where(jnp.abs(away) < _FARTHEST, away, jnp.nan)

    def _counted(self, poses):
        first = len(self.bodies)
        return poses[first : first + self.size, 0]

    def _wound(self, space, poses, angles) -> tuple[Any, Any]:
        """Angles [rad] of rope, from those of `_angles`: on pulleys that it passes; and from the mark of each
        pulley that holds it to the straight part.
        """
        holding, passed = self._holding, len(self.passed_places)
        bearings = angles[passed:]
        if space.dimension == 2 and len(holding):
            # Angles of bodies count full turns.
            bearings = bearings - self._signed(holding, self._at(poses, holding)[:, 2])
        return angles[:passed], bearings if self.marks is None else bearings - self.marks

    def lengths(self, space, poses) -> Float[Array, "spans"]:
        """Lengths of the spans [m], with the rope on drums."""
        straight, along = self._straight(space, poses)
        return self._measured(space, poses, straight, self._continued(space, poses, along))

    def _measured(self, space, poses, straight, angles) -> Any:
        """Lengths of the spans, from those of the straight parts and the angles of `_angles`."""
        parts, spans = [straight], [self._span(np.arange(len(straight)))]
        xp = namespace(straight, angles)
        if self.size:
            wraps, held = self._wound(space, poses, angles)
            holding = self._holding
            after, before = np.flatnonzero(holding < len(straight)), np.flatnonzero(holding > 0)
            held = held * self._of_pulleys(holding, self.radii)
            parts += [
                wraps * self._of_pulleys(self.passed_places, self.radii),
                unchecked_take(held, after),
                -unchecked_take(held, before),
            ]
            spans += [self._span(self.passed_places), self._span(holding[after]), self._span(holding[before] - 1)]
        values, span = xp.concatenate(parts), np.concatenate(spans)
        if xp is np:
            return np.bincount(span, values, self.spans)
        return jnp.sum(values)[None] if self.spans == 1 else placed_sums(span, self.spans)(values)

    def coordinates(self, space, poses):
        out = {"length": jnp.sum(self.lengths(space, poses))}
        return out | ({"wrap": self._wraps(space, poses)} if self.size else {})

    def _wraps(self, space, poses) -> Float[Array, "pulleys"]:
        """Angles [rad] of rope on the pulleys."""
        _, along = self._straight(space, poses)
        wraps, held = self._wound(space, poses, self._continued(space, poses, along))
        holding, last = self._holding.tolist(), len(self.senses) - 1
        ends = [(k, k == 0, holding.index(k)) for k in self._pulleys if k in (0, last)]
        out = [wraps, *((held[h] if first else -held[h])[None] for _, first, h in ends)]
        order = np.argsort([*self.passed_places, *(k for k, _, _ in ends)])
        return unchecked_take(jnp.concatenate(out), order)

    # Limits

    def limit_reached(self, space, poses):
        lengths, along = map(np.asarray, self._straight(space, poses))
        radii = np.zeros(len(self.senses))
        radii[self._pulleys] = [] if self.radii is None else self.radii
        largest = np.maximum(radii[:-1], radii[1:])
        # A rope that has lifted off its pulley lacks a part.
        gone = np.isin(np.arange(len(lengths)), np.flatnonzero(self.lifts)) & (lengths == 0)
        for k in np.flatnonzero((largest > 0) & ~gone & ~(lengths > _AT_CIRCLE * largest)):
            if self.senses[k] and self.senses[k + 1]:
                return f"the pulleys path[{k}] and path[{k + 1}] touch each other, where it has no tangent"
            point, pulley = (k, k + 1) if self.senses[k + 1] else (k + 1, k)
            return f"the point path[{point}] is at the circle of the pulley path[{pulley}], where it has no tangent"
        if not self.size or self.counts:
            return ""
        away = np.abs(shortest(jnp.asarray(self._angles(space, poses, along) - self.bearings)))
        if not np.any(away > _FARTHEST * (1 - _AT_CIRCLE)):
            return ""
        return (
            f"its angle on a pulley, or the direction of a straight part at one that holds it, has changed by "
            f"{_FARTHEST / np.pi:g} half turns since the given poses; with count_turns=True there is no limit"
        )

    # Pictures

    def path(self, space, poses):
        _, along = self._straight(space, poses)
        centres = _each(space.point, self._at(poses), self.points)
        angles = iter(self._wraps(space, poses)) if self.size else iter(())
        axes = iter(self._axes(space, poses)) if self.axes is not None else itertools.repeat(None)
        radii, out = iter(() if self.radii is None else self.radii), []
        for k, sense in enumerate(self.senses):
            if not sense:
                out.append(centres[k][None])
                continue
            axis, angle = next(axes), next(angles)
            turned = sense * angle * jnp.linspace(0.0, 1.0, 17)
            e = along[max(k - 1, 0)][None]
            turned = turned[:, None] - (turned[-1] if k == 0 else 0.0)
            side = quarter_turn(e) if axis is None else cross(axis[None], e)
            arc = centres[k][None] - sense * next(radii) * (jnp.cos(turned) * side - jnp.sin(turned) * e)
            out.append(jnp.where(angle > 0, arc, out[-1][-1:]) if self.lifts[k] else arc)
        return jnp.concatenate(out)

    def shapes(self, space, size):
        if self.radii is None:
            return ()
        axes = itertools.repeat((0.0, 0.0, 1.0)) if self.axes is None else self.axes
        # Several ropes may run on one pulley.
        return tuple(
            (self.owners[k], shape)
            for k, radius, axis in zip(self._pulleys, self.radii, axes, strict=False)
            for shape in wheel(radius, None, space.in_space(self.points[k]), axis)
        )


def _between_points(d):
    """The lengths of vectors, and unit vectors along them; zero of a zero vector."""
    length = norm(d)
    return length, d / namespace(d).where(length > 0, length, 1.0)[:, None]


def _each(function, *rows):
    """A function of each row of some arrays."""
    if namespace(*rows) is np:
        return np.stack([function(*row) for row in zip(*rows, strict=True)])
    return jax.vmap(function)(*rows)


class RopePath(AbstractRope, AbstractTendon):
    """The path of a rope, with scalar coordinates that count the turns on its pulleys."""

    @property
    def rows(self):
        return self.size if self.counts else 0

    def residual(self, space, poses, t):
        if not self.rows:
            return super().residual(space, poses, t)
        # The rates of other angles jump where the rope lifts off.
        angles = self._angles(space, poses, self._touching(space, poses)[1])
        return shortest(self._counted(poses) + self.bearings - angles)

    def length(self, space, poses):
        return jnp.sum(self.lengths(space, poses))


class TautRope(AbstractRope, AbstractConstraint):
    """A rope of constant length. Rows: `length` less the length of the path, of each span."""

    length: fields.Number = fields.parameter(shape=None, unit="m", sign="positive")
    rheonomic: ClassVar[bool] = False
    has_tension: ClassVar[bool] = True

    @property
    def rows(self):
        return self.spans

    def residual(self, space, poses, t):
        return self.length.reshape(-1) - self.lengths(space, poses)


class RopeFriction(AbstractRope, AbstractStickSlip):
    """Friction of a rope of constant length on pulleys, a row for each of them.

    A pulley divides its span into sides with the tensions T₁ before and T₂ after it. Its normal force is their mean N,
    as far as the law needs one: the rise D = T₂ − T₁ has the limit 2 N tanh(μ φ / 2) on an angle φ of rope. In slip
    that is Euler's and Eytelwein's `T₂ = T₁ e^(μ φ)`. The multiplier in stick is −D. The multiplier of the span's
    length is the mean of the tensions at its ends: then no rise enters the mean at its own pulley.

    **Fields:** `rubs`: for each place of the path whether it is such a pulley; the `friction` μ of each.
    """

    rubs: tuple[bool, ...] = eqx.field(static=True, default=())
    length: fields.Number = fields.parameter(shape=None, unit="m", sign="positive")
    friction: fields.Number = fields.parameter(shape=(None,), unit="1", sign="non-negative", constant=True)
    moving: ClassVar[tuple[str, ...]] = ("length", "points", "radii", "axes", "marks")
    has_tension: ClassVar[bool] = True
    directions: ClassVar[int] = 1
    needs: ClassVar[Literal["multipliers"]] = "multipliers"

    @property
    def contact_law(self):
        return Capstan(self.friction)

    @property
    def rows(self):
        return sum(self.rubs)

    @property
    def joint_name(self):
        return self.name

    @property
    def coupled(self):
        return bool(np.any(self._shares_of_means))

    def seen_wrenches(self, space, poses, wrenches):
        # They are multipliers.
        return wrenches

    # Sides

    @property
    def _divided(self) -> "RopeFriction":
        """The rope as if it were held where it rubs: its spans are the sides."""
        view = self.with_fields(grips=tuple(a or b for a, b in zip(self.grips, self.rubs, strict=True)), marks=None)
        if not len(self._holding):
            return view
        every = view._holding
        none = jnp.zeros(len(every), self.marks.dtype)
        return view.with_fields(marks=with_entries(none, np.searchsorted(every, self._holding), self.marks))

    @property
    def _places(self) -> np.ndarray:
        """The places at which the rope rubs."""
        return np.flatnonzero(self.rubs)

    def _side(self, part: Any) -> np.ndarray:
        """The side to which a straight part belongs, numbered by the place before it."""
        dividers = [k for k in self.passed_places if self.grips[k] or self.rubs[k]]
        return np.sum(np.asarray(part)[..., None] >= np.array(dividers, int), axis=-1)

    @property
    def sides(self):
        return int(self._side(len(self.senses) - 2)) + 1

    @property
    def _span_of_side(self) -> np.ndarray:
        parts = np.arange(len(self.senses) - 1)
        return self._span(parts[np.unique(self._side(parts), return_index=True)[1]])

    @property
    def _halves(self) -> Float[np.ndarray, "rows sides"]:
        """1/2 for the sides of a pulley's span after it, −1/2 before it."""
        after = np.arange(self.sides) >= self._side(self._places)[:, None]
        return (self._span_of_side == self._span(self._places)[:, None]) * np.where(after, 0.5, -0.5)

    @property
    def _shares_of_means(self) -> Float[np.ndarray, "rows rows"]:
        """The shares of the rises at the pulleys in the mean tension at each of them."""
        after = self._side(self._places)
        return 0.5 * (self._halves.T[after] + self._halves.T[after - 1])

    # Slip and tensions

    def slips(self, space, poses, velocities):
        return rate_of(space, self, lambda part, x: part._passed_by(space, x), poses, velocities)[1]

    def _passed_by(self, space, poses):
        """The lengths [m] of rope that have passed the pulleys, but for constants. Rope is paid out at the start."""
        straight, along = self._straight(space, poses)
        view = self._divided
        # Full turns are constant.
        lengths = view._measured(space, poses, straight, view._angles(space, poses, along))
        return self._halves @ lengths + 0.5 * self.length.reshape(-1)[self._span(self._places)]

    def _wraps_of_places(self, space, poses):
        """The angles [rad] of rope where it rubs."""
        _, along = self._straight(space, poses)
        angles = self._continued(space, poses, along)[: len(self.passed_places)]
        return excess(unchecked_take(angles, np.searchsorted(self.passed_places, self._places)))

    def _loads(self, space, poses, multipliers):
        """Of each pulley the direction of slip, zero in stick; the limit of the rise of the tension, and the rise."""
        mean, stuck = unchecked_take(multipliers, self._span(self._places)), -multipliers[self.spans :]
        share = self.contact_law.share(self._wraps_of_places(space, poses))
        modes, shares = kind_of(self._modes(poses)), self._shares_of_means
        slips = jnp.where(jnp.abs(modes) == FORWARD, modes, 0.0)
        # A rope that pushes rubs as much.
        factor = jnp.where(mean < 0, -slips, slips) * share
        rise = jnp.where(slips == 0, stuck, factor * mean)
        if self.coupled:
            rise = solve(jnp.eye(self.rows, dtype=rise.dtype) - factor[:, None] * shares, rise)
            mean = mean + shares @ rise
        return slips, share * mean, rise

    def normal_force(self, space, poses, reactions):
        """The largest rises of the tension [N], negative where the rope pushes."""
        return self._loads(space, poses, reactions)[1]

    def tensions(self, space, poses, multipliers):
        """The tension of each side [N], from the multipliers of the spans and of this friction."""
        _, _, rise = self._loads(space, poses, multipliers)
        return unchecked_take(multipliers, self._span_of_side) + self._halves.T @ rise

    def slip_forces(self, space, poses, slips, reactions):
        direction, _, rise = self._loads(space, poses, reactions)
        return jnp.where(direction == 0, 0.0, -rise)


class SlackRope(AbstractRope, AbstractGeometricContact):
    """A rope of constant length that may go slack."""

    length: fields.Number = fields.parameter(shape=None, unit="m", sign="positive")
    quantities: ClassVar[Quantities] = {"length": "length", "wrap": "angle", "gap": "length"}
    has_tension: ClassVar[bool] = True

    def gap(self, space, poses):
        return self.length - self.lengths(space, poses)[0]

    def coordinates(self, space, poses):
        return AbstractRope.coordinates(self, space, poses) | {"gap": self.gap(space, poses)}


class ElasticRope(AbstractRope, AbstractPotentialForce):
    """An elastic rope."""

    length: fields.Number = fields.parameter(shape=None, unit="m", sign="positive")
    stiffness: fields.Number = fields.parameter(unit="N/m", sign="positive")
    damping: fields.Number = fields.parameter(unit="N s/m", sign="non-negative")
    moving: ClassVar[tuple[str, ...]] = ("length", "points", "radii", "axes", "marks")
    has_gaps: ClassVar[bool] = True
    has_tension: ClassVar[bool] = True

    def _stretch(self, space, poses):
        return self.lengths(space, poses) - self.length.reshape(-1)

    def _tension(self, stretch, rate):
        # A force that jumps where the rope tightens would have wrong derivatives.
        pull = self.stiffness * stretch
        pull = pull + clipped(self.damping * rate, -pull, pull)
        # Not the other way round: a path without tangents is not slack.
        return jnp.where(stretch < 0, 0.0, pull)

    def observables(self, space, poses, velocities, t):
        stretch = lambda part, x: part._stretch(space, x)
        tensions = self._tension(*rate_of(space, self, stretch, poses, velocities))
        return {"tension": tensions[0] if self.spans == 1 else tensions}

    def wrenches(self, space, poses, velocities, t):
        stretch = lambda part, x: part._stretch(space, x)
        return generalized_force(space, self, stretch, poses, velocities, lambda x, v: -self._tension(x, v))

    def energy(self, space, poses, t):
        return 0.5 * self.stiffness * jnp.sum(excess(self._stretch(space, poses)) ** 2)

    def gaps(self, space, poses, t):
        if not any(self.lifts):
            return -self._stretch(space, poses)
        _, along = self._touching(space, poses)
        return jnp.concatenate([-self._stretch(space, poses), -self._lifted(space, poses, along)])


class Rope(AbstractRope, AbstractCompound):
    """A rope without mass over pulleys and drums, of constant length or elastic. Rows: one for each span of a rope of
    constant length.

    ```python
    places = {"left": (-0.1, -1.0), "right": (0.1, -1.0)}
    loads = [planar.Body(name, mass=1.0, inertia=0.1, position=at) for name, at in places.items()]
    wheel = planar.Body("wheel", mass=0.5, inertia=planar.disc(0.5, 0.1))
    axle = planar.Revolute("axle", "ground", "wheel", point=(0.0, 0.0))
    over = jaxmb.Pulley("wheel", radius=0.1, turn="right", grips=True)
    rope = jaxmb.Rope("rope", [("left", (0.0, 0.0)), over, ("right", (0.0, 0.0))])
    system = jaxmb.Scene([wheel, *loads], joints=[axle, rope], forces=[jaxmb.Gravity((0.0, -9.81))]).compile()
    motion = jaxmb.simulate(system, jaxmb.assemble(system), t1=0.5)
    motion["rope"].tension, motion["rope"].wrap  # Of each span 9.81 N, and on the pulley half a turn.
    ```

    It stands among the joints of a scene. Its places are points, to which it is guided without friction, and pulleys.
    Its two ends are points or drums. A pulley that grips it divides it into spans, each with a tension of its own;
    without such a pulley there is one span and one tension. The length of a span contains the rope on its pulleys and
    drums. A winch is a drum that a motor, `JointDriver` or `Driver` turns, or a `length` that is an input of
    `simulate`.

    The tension `"rope.tension"` [N], of several spans one each, is positive where the rope pulls. Its coordinates are
    `length` [m], of all spans, and `wrap` [rad], the angles of rope on the pulleys.

    In the plane drums wind up any number of turns, since angles of bodies count them. Straight parts turn about drums,
    and angles on other pulleys change, by less than 0.9 half turns from the given poses; a run that goes on fails. In
    space, and with `count_turns=True`, there is no limit: for each angle the scene has a coordinate more, which no
    force acts on and which is next to zero at the given poses.

    A rope of constant length pulls and pushes, so that its tension may be negative. With `slack=True` it only pulls: it
    goes slack and tightens with an impact, both at times that `simulate` finds, and its coordinate `gap` [m] is how
    much longer it is than its path. An elastic rope, with a `stiffness`, only pulls: the tension of a span is
    `stiffness (l − length) + damping l̇`, and zero where it is not stretched. The part of the damping is at most as
    large as that of the stiffness, so that the tension neither jumps nor pushes.

    A pulley with `friction` μ holds the rope while neither tension exceeds the other by more than `e^(μ φ)` times, with
    the angle φ of rope on it. Beyond, the rope slips: `T₂ = T₁ e^(μ φ)`, the equation of the capstan. Stick is exact,
    and `simulate` finds the times of the changes, as for `DryFriction`: `Trajectory.events` has the kinds `"stick"` and
    `"slip"` under the name of the rope, and the coordinate `"rope.mode"` is 2, 1 or -1; 1 is slip along the path. With
    several such pulleys their names are `"rope.mode_1"`, `"rope.mode_2"` and so on. Each side of a pulley has a tension
    of its own in `"rope.tension"`. If several pulleys at rest hold a rope at rest, the tension between them is
    undetermined, and the run finds a possible value. A rope that pushes has friction too, by the size of its tensions.
    In an impact friction has no impulse. If the `length` is an input, the rope is paid out at the start of its path.

    A rope touches all its pulleys, also where it would lift off: there its angle on the pulley is negative. `simulate`
    warns of such saved states; `diffrax.Event` on the coordinate `wrap` ends a run there. An elastic rope in the plane
    lifts off pulleys with `lifts=True`, where its angle is then zero, and comes back. Neighbours on the path are points
    or pulleys without `lifts`. In the plane without `count_turns`, such a rope turns by less than 1.1 half turns.

    In space the rope lies in the plane of a pulley, through its centre, and leaves it where its projection on this
    plane is a tangent. That is exact for a rope in the plane; a straight part at an angle α to it, of length l in it,
    has a force that differs from its line by the share (1 − cos α) R / l. Neighbouring pulleys need parallel axes, also
    as they move; otherwise put a point between them.

    **Arguments:**

    - `path`: at least two places in order, pairs (body, point) with a body-fixed point [m], and of type `Pulley`.
    - `length` [m] > 0, of an elastic rope without tension, default that of the given poses; of several spans one each.
    - `stiffness` [N/m] > 0 and `damping` [N s/m] ≥ 0, default none, of each span of an elastic rope.
    - `slack`: whether a rope of constant length may go slack; it has one span. `restitution`, as of a `Slack`, default
        0: the rate after an impact over that before.
    - `count_turns`: whether in the plane, too, full turns are counted about pulleys, as of a ball on a rope that winds
        up around a pole.
    """

    length: fields.Number = fields.parameter(shape=None, unit="m", sign="positive", optional=True)
    stiffness: fields.Number = fields.parameter(unit="N/m", sign="positive", optional=True)
    damping: fields.Number = fields.parameter(unit="N s/m", sign="non-negative", optional=True)
    slack: bool = eqx.field(static=True, default=False)
    restitution: fields.Number = fields.parameter(unit="1", sign="non-negative", optional=True)
    friction: fields.Number = fields.parameter(
        shape=(None,), unit="1", sign="non-negative", optional=True, constant=True
    )
    turns: tuple[float, ...] = eqx.field(static=True, default=())
    rubs: tuple[bool, ...] = eqx.field(static=True, default=())

    def __init__(
        self,
        name: str,
        path: Sequence[tuple[str, VectorLike] | Pulley],
        *,
        length: Any = None,
        stiffness: Any = None,
        damping: Any = None,
        slack: bool = False,
        restitution: Any = None,
        count_turns: bool = False,
    ):
        places = [_place(f"Rope {name!r}: path[{k}]", place) for k, place in enumerate(path)]
        pulleys = [place for place in places if place.radius is not None]
        sizes = [np.size(place.centre) for place in places if place.centre is not None]
        dimension = max([2, *sizes, *(3 for pulley in pulleys if pulley.axis is not None)])
        self.name = name
        self.bodies = tuple(dict.fromkeys(place.body for place in places))
        self.owners = tuple(self.bodies.index(place.body) for place in places)
        self.points = [np.zeros(dimension) if place.centre is None else place.centre for place in places]
        self.senses = tuple(_SENSES[place.turn] for place in places)
        self.grips = tuple(place.grips for place in places)
        self.lifts = tuple(place.lifts for place in places)
        self.turns = tuple(float(place.turns) for place in places)
        self.rubs = tuple(place.friction is not None for place in places)
        self.friction = [place.friction for place in places if place.friction is not None] or None
        self.radii = [pulley.radius for pulley in pulleys] or None
        axes = [pulley.axis for pulley in pulleys]
        self.axes = None if all(axis is None for axis in axes) else axes
        self.bearings = self.marks = None
        self.length, self.stiffness, self.damping = length, stiffness, damping
        self.slack, self.restitution, self.counts = slack, restitution, count_turns

    def __check_init__(self):
        if isinstance(self.axes, list):
            raise ValueError(f"{self.label}: give the axis of every pulley, shape (3,), or in the plane of none.")
        if len(self.owners) < 2:
            raise ValueError(f"{self.label}: path must hold at least two places, got {len(self.owners)}.")
        if self.slack and self.spans > 1:
            raise ValueError(
                f"{self.label}: with slack it has one span; make it several ropes that end on the pulley that grips."
            )
        if self.slack and self.stiffness is not None:
            raise ValueError(f"{self.label}: an elastic rope goes slack by itself; leave slack out.")
        if self.damping is not None and self.stiffness is None:
            raise ValueError(f"{self.label}: damping belongs to an elastic rope; give its stiffness.")
        if self.restitution is not None and not self.slack:
            raise ValueError(f"{self.label}: restitution belongs to a rope with slack=True.")
        self._check_friction()
        self._check_lifts()
        for k in self.passed_places:
            if self.turns[k] % 1:
                raise ValueError(
                    f"{self.label}: turns of path[{k}], which is no drum, must be a whole number, got {self.turns[k]}."
                )

    def _check_friction(self) -> None:
        for k in np.flatnonzero(self.rubs):
            if k not in self.passed_places:
                raise ValueError(
                    f"{self.label}: path[{k}] is a drum, to which the rope is fastened; leave its friction out, or let "
                    "the rope go on to a point."
                )
            if self.grips[k]:
                raise ValueError(
                    f"{self.label}: path[{k}] grips, so that the rope never slips on it; leave grips or friction out."
                )
        if any(self.rubs) and self.stiffness is not None:
            raise ValueError(
                f"{self.label}: friction of pulleys needs a rope of constant length; leave stiffness out, or put "
                "springs at the ends of the rope."
            )
        if any(self.rubs) and self.slack:
            raise ValueError(
                f"{self.label}: with slack it has no friction of pulleys; leave slack out, or hang the loads on the "
                "rope by a Slack."
            )

    def _check_lifts(self) -> None:
        for k in np.flatnonzero(self.lifts):
            if k not in self.passed_places or self.grips[k]:
                raise ValueError(
                    f"{self.label}: path[{k}] holds the rope, which cannot lift off it; leave lifts out, or let the "
                    "rope pass it without grips."
                )
            if self.stiffness is None:
                raise ValueError(
                    f"{self.label}: the force of a rope of constant length would jump where it lifts off path[{k}]; "
                    "give its stiffness, or leave lifts out."
                )
            if self.lifts[k + 1]:
                raise ValueError(
                    f"{self.label}: it may lift off path[{k}] and path[{k + 1}], which are neighbours; leave lifts out "
                    "at every second pulley."
                )
            if self.turns[k]:
                raise ValueError(f"{self.label}: path[{k}] has full turns of rope; leave lifts or turns out.")

    def validate(self):
        shape = () if self.spans == 1 else (self.spans,)
        if self.length is not None and self.length.shape != shape:
            raise ValueError(
                f"{self.label}: length must have shape {shape}, one for each of its spans, got {self.length.shape}."
            )

    def scalar_coordinates(self, space, parts):
        counts = self.size if self._is_counted(space) else 0
        out = [ScalarCoordinate(f"{self.name}.angle_{k + 1}") for k in range(counts)]
        laws = self.slack + sum(self.rubs)
        modes = [f"{self.name}.mode"] if laws == 1 else [f"{self.name}.mode_{k + 1}" for k in range(laws)]
        return (*out, *(ScalarCoordinate(mode, moves=True) for mode in modes))

    def _is_counted(self, space):
        # In space the angles of drums are known up to full turns.
        return self.counts or space.dimension == 3

    def complete(self, space, poses):
        if space.dimension == 3:
            self._check_axes(space, poses)
            if any(self.lifts):
                raise ValueError(
                    f"{self.label}: in space the length of a rope would jump where it lifts off a pulley; leave lifts "
                    "out."
                )
        straight, along = self._straight(space, poses)
        self._check_tangents(self._touching(space, poses)[0])
        part, angles = self.with_fields(counts=self._is_counted(space)), np.zeros(0)
        if self.size:
            passed, number = len(self.passed_places), np.array(self.turns)
            angles = np.array(self._angles(space, poses, along))
            # A rope that passes a pulley turns back by less than a quarter of a turn.
            angles[:passed] += 2 * np.pi * ((angles[:passed] < -0.5 * np.pi) + number[self.passed_places])
            _, marks = self._wound(space, poses, angles)
            # The rope leaves the mark of a drum at the start, and goes to that of one at the end.
            sides = np.where(self._holding == 0, -1, self._holding == len(straight))
            bearings = angles
            if not part.counts:
                # Angles up to a turn more than those off the pulley.
                free = np.searchsorted(self.passed_places, np.flatnonzero(self.lifts))
                bearings = angles.copy()
                bearings[free] = np.pi - _FARTHEST_OFF
            part = part.filled(bearings=bearings, marks=marks + 2 * np.pi * sides * number[self._holding])
        lengths = part._measured(space, poses, straight, angles)
        self._check_length(lengths, part._measured(space, poses, 0 * straight, angles))
        return part.filled(length=lengths[0] if self.spans == 1 else lengths)

    def _check_axes(self, space, poses) -> None:
        if len(self._pulleys) and (self.axes is None):
            raise ValueError(f"{self.label}: in space give the axis of every pulley.")
        for i, j in itertools.pairwise(range(len(self.senses))):
            if self.senses[i] and self.senses[j]:
                a, b = self._of_pulleys(np.array([i, j]), np.asarray(self._axes(space, poses)))
                if np.linalg.norm(np.cross(a, b)) > _PARALLEL or a @ b < 0:
                    raise ValueError(
                        f"{self.label}: the axes of the neighbours path[{i}] and path[{j}] must be parallel and point "
                        "to one side; turn them, or put a point between."
                    )

    def _check_tangents(self, straight) -> None:
        for k in np.flatnonzero(~(np.asarray(straight) > 0)):
            senses = self.senses[k], self.senses[k + 1]
            both = f"path[{k}] and path[{k + 1}]"
            if not any(senses):
                raise ValueError(f"{self.label}: the neighbours {both} coincide; move one or leave it out.")
            if not all(senses):
                point, pulley = (k, k + 1) if senses[1] else (k + 1, k)
                raise ValueError(
                    f"{self.label}: the point path[{point}] lies in the circle of the pulley path[{pulley}], and there "
                    "is no tangent; move the point out, or make the radius smaller."
                )
            if senses[0] != senses[1]:
                raise ValueError(
                    f"{self.label}: the pulleys {both} overlap, and the rope crosses between them; move them apart, "
                    "make them smaller, or let the rope turn to the same side on both."
                )
            raise ValueError(f"{self.label}: of the pulleys {both} one lies in the other one; move them apart.")

    def _check_length(self, needed, on_pulleys) -> None:
        if self.length is None:
            return
        given = np.ravel(self.length)
        least, what = (needed, "its path") if self.slack else (on_pulleys, "the rope on its pulleys")
        if np.any(given < least * (1 - _ROUNDING)):
            raise ValueError(
                f"{self.label}: length {given.tolist()} m is less than that of {what} at the given poses, "
                f"{least.tolist()} m; give a longer rope, or move the bodies."
            )

    def components(self):
        law = TautRope if self.stiffness is None else ElasticRope
        law = SlackRope if self.slack else law
        given = self.filled(damping=0.0, restitution=0.0)
        own = fields.values_of(given) | {"impact_law": "newton"}
        kinds = (RopePath, law, RopeFriction) if any(self.rubs) else (RopePath, law)
        return tuple(with_values(kind, {name: own[name] for name in fields.field_names(kind)}) for kind in kinds)


def _place(label: str, place: Any) -> Pulley:
    """A place of a path as a pulley, a point as one without a radius."""
    # A concrete class: a pulley is a tuple too, and a place of its own kind.
    if not isinstance(place, Pulley):
        if not isinstance(place, Sequence) or len(place) != 2 or not isinstance(place[0], str):
            raise ValueError(f"{label} must be a pair (body, point) or a Pulley, got {place!r}.")
        return Pulley(place[0], None, "", place[1])  # pyright: ignore[reportArgumentType]
    if place.turn not in _SENSES or not place.turn:
        raise ValueError(f"{label}: turn must be 'left' or 'right', got {place.turn!r}.")
    return place
