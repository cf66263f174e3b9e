"""A joint of hinges and slides in succession, with no mass in between."""

import functools
import itertools
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from ...linalg import rotations as rot
from ...linalg.arrays import namespace
from .. import fields
from ..base import AbstractJoint, AbstractSpatialPart
from ..coordinate_parts import shortest
from ..shapes import ball, pin, sleeve
from ..space import both_points
from .axes import (
    ElementaryJoint,
    Vector3,
    across,
    direction_in_a,
    perpendiculars,
    relative_orientation,
    rotation_vector,
    with_given_orientation,
)

_COORDINATES = {"hinge": "angle", "slide": "displacement", "ball": "rotation"}
_SYMBOLS = {"hinge": pin, "slide": sleeve, "ball": lambda point, size, axis: ball(point, size)}
# Least sine of the angle between independent axes, and least volume of three independent directions.
_INDEPENDENT = 1e-6


class Composite(AbstractSpatialPart, AbstractJoint):
    """Hinges and slides in succession, with no mass in between. Rows: 6 less its degrees of freedom.

    ```python
    arm = spatial.Body("arm", mass=1.0, inertia=spatial.box(1.0, 1.0, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    way = {"sequence": ("hinge", "slide"), "axes": [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0)]}
    joint = spatial.Composite("joint", "ground", "arm", point=(0.0, 0.0, 0.0), **way)
    system = jaxmb.Scene([arm], joints=[joint]).compile()
    ```

    From `body_a` to `body_b` there are, in any order, up to three hinges, or a ball, and up to three slides. The
    coordinates are `angle_1`, … [rad] of the hinges and `displacement_1`, … [m] of the slides, each kind numbered in
    this order; a ball has `rotation` [rad], shape (3,), as in `Spherical`. The placement of B in A is the product of
    all turns and shifts. The coordinates follow from the placement in closed form: the angles from the relative
    attitude, then the displacements from the relative position, which is linear in them.

    If all coordinates are zero, the two points coincide, the relative attitude is `orientation`, and the joints have
    the directions `axes`. This holds at the given poses if `point` is given and `orientation` is not. Consecutive
    hinges must not be parallel. The second of three hinges turns by less than half a turn, between the two angles at
    which the three axes lie in a plane; there the angles are not smooth.

    **Arguments:**

    - `sequence`: the words `"hinge"`, `"slide"` and `"ball"` from A to B.
    - `axes`, shape (n, 3), unit, one for each word (a ball's has no effect), in the axes of `body_a`; or in the world
        at the given poses, `axes_W`.
    - `points` [m], shape (hinges, 3), one on each hinge, in the frame of `body_a`; or in the world, `points_W`; default
        point A for each hinge.
    - `orientation`, shape (4,), unit Euler parameters: the attitude of `body_b` relative to `body_a` with all
        coordinates zero, default from the given poses.
    - `middle` [rad], default zero: the second of three angles is taken in the half turn that contains `middle`.

    Source: R. W. Brockett, "Robotic manipulators and the product of exponentials formula", Mathematical Theory of
    Networks and Systems, 1984; of three axes in any directions, P. B. Davenport, "Rotations about nonorthogonal axes",
    AIAA Journal 11(6), 1973.
    """

    sequence: tuple[str, ...] = eqx.field(static=True, converter=tuple, kw_only=True)
    axes: fields.Number = fields.axis(body=0, shape=(None, "d"), optional=True)
    axes_W: fields.Number = fields.axis(body=None, shape=(None, "d"), gives=("axes",))
    points: fields.Number = fields.point(body=0, shape=(None, "d"), optional=True)
    points_W: fields.Number = fields.point(body=None, shape=(None, "d"), gives=("points",), needed=False)
    orientation: fields.Number = fields.attitude(optional=True)
    middle: fields.Number = fields.parameter(unit="rad", optional=True)

    @property
    def quantities(self):
        """The kind of each coordinate, by its name."""
        kinds = {"hinge": "angle", "slide": "length", "ball": "rotation"}
        return {name: kinds[word] for name, word in zip(coordinate_names(self.sequence), self.sequence, strict=True)}

    @property
    def rows(self):
        return 6 - len(self.sequence) - 2 * self.sequence.count("ball")

    def validate(self):
        if not self.sequence or set(self.sequence) - set(_COORDINATES):
            raise ValueError(f"{self.label}: sequence must hold words of {[*_COORDINATES]}, got {self.sequence}.")
        axes, hinges = self.axes_W if self.axes is None else self.axes, self.sequence.count("hinge")
        points = self.points_W if self.points is None else self.points
        for name, given, needed in (("axes", axes, len(self.sequence)), ("points", points, hinges)):
            if given is not None and len(given) != needed:
                raise ValueError(f"{self.label}: {name} must have {needed} rows for {self.sequence}, got {len(given)}.")
        if axes is None:
            return  # Missing world axes have another message.
        why = degenerate(self.sequence, axes, [f"{word} {k}" for k, word in enumerate(self.sequence, 1)])
        if why:
            raise ValueError(f"{self.label}: {why}.")
        if self.middle is None:
            return
        if hinges != 3:
            raise ValueError(f"{self.label}: middle is an angle of the second of three hinges; leave it out.")
        if abs(np.sin(self.middle - flat_angle(*self._of("hinge", axes)))) < _INDEPENDENT:
            raise ValueError(
                f"{self.label}: at the second angle {float(self.middle):g}, the three axes lie in one plane; give "
                "another middle, within the range of this angle."
            )

    def complete(self, space, poses):
        part = self.filled(middle=0.0) if self.sequence.count("hinge") == 3 else self
        return with_given_orientation(part, poses)

    def residual(self, space, poses, t):
        start, ways = self._place(space, poses)
        offset = space.point(poses[1], self.point_b) - space.point(poses[0], start)
        if ways:
            offset = _components(ways, space.body_direction(poses[0], offset))[self.sequence.count("slide") :]
        return jnp.concatenate([offset, self._held_turn(space, poses)])

    def coordinates(self, space, poses):
        values = {"hinge": iter(self._angles(space, poses)), "slide": iter(()), "ball": iter(())}
        if "slide" in self.sequence:
            start, ways = self._place(space, poses)
            at = space.body_point(poses[0], space.point(poses[1], self.point_b))
            values["slide"] = iter(_components(ways, at - start))
        if "ball" in self.sequence:
            values["ball"] = iter([rotation_vector(self, poses)])
        named = zip(coordinate_names(self.sequence), self.sequence, strict=True)
        return {name: next(values[word]) for name, word in named}

    def elementary_joints(self, space, poses):
        """The first is fixed in A; the coordinates of the previous joints place the others."""
        values, out = self.coordinates(space, jnp.asarray(poses)), []
        points = itertools.repeat(self.point_a) if self.points is None else iter(self.points)
        place, turn = poses[0][:3], rot.normalize(poses[0][3:7])
        for word, axis, name in zip(self.sequence, self.axes, values, strict=True):
            value, point = values[name], next(points) if word == "hinge" else self.point_a
            at = place + rot.rotate(turn, point)
            out.append(ElementaryJoint(word, name, at, rot.rotate(turn, axis), value))
            if word == "slide":
                place = place + rot.rotate(turn, value * axis)
                continue
            if word == "ball":
                angle = rot.norm(value)
                axis, value = value / np.where(angle > 0, angle, 1.0), angle
            turn = rot.multiply(turn, rot.from_axis_angle(axis, value))
            place = at - rot.rotate(turn, point)
        return out

    def path(self, space, poses):
        return both_points(space, self, poses) if "slide" in self.sequence else None

    def shapes(self, space, size):
        first, last = (_SYMBOLS[self.sequence[k]] for k in (0, -1))
        of_a = (0, first(self.point_a, size, self.axes[0]))
        of_b = (1, last(self.point_b, size, rot.unrotate(self.orientation, self.axes[-1])))
        return (of_a,) if len(self.sequence) == 1 else (of_a, of_b)

    def _of(self, word, rows):
        """The rows that belong to the joints of one kind."""
        return [row for kind, row in zip(self.sequence, rows, strict=True) if kind == word]

    # Below, the turn is the rotation of B in A from zero coordinates.

    def _turn(self, poses):
        """Euler parameters of the turn."""
        return rot.multiply(relative_orientation(poses), rot.conjugate(self.orientation))

    def _after_turn(self, space, poses, v):
        """A direction after the turn."""
        return direction_in_a(space, poses, rot.unrotate(self.orientation, v))

    def _before_turn(self, space, poses, v):
        """A direction before the turn."""
        return rot.rotate(self.orientation, direction_in_a(space, poses[::-1], v))

    def _held_turn(self, space, poses):
        """The components of the turn that the joints hold [rad, if small]."""
        hinges = self._of("hinge", self.axes)
        if "ball" in self.sequence or len(hinges) == 3:
            return jnp.zeros(0, poses.dtype)
        if len(hinges) == 2:
            # Turns about either axis do not change the angle between them.
            first, last = hinges
            change = rot.dot(first, self._after_turn(space, poses, last) - last)
            return (change / rot.norm(rot.cross(first, last)))[None]
        vector = 2.0 * self._turn(poses)[1:]
        return across(hinges[0], vector) if hinges else vector

    def _angles(self, space, poses):
        """The angles [rad] of the hinges that make up the turn."""
        hinges = self._of("hinge", self.axes)
        if len(hinges) < 2:
            return [_angle_about(axis, self._turn(poses)) for axis in hinges]
        first, *between, last = hinges
        end, start = self._after_turn(space, poses, last), self._before_turn(space, poses, first)
        if not between:
            return [_angle_between(first, last, end), _angle_between(last, start, first)]
        (second,) = between
        angle = self._second_angle(first, second, last, end)
        forth, back = _turned(second, angle, last), _turned(second, -angle, first)
        return [_angle_between(first, forth, end), angle, _angle_between(last, start, back)]

    def _second_angle(self, first, second, last, end):
        """The second of three angles, which alone changes the angle between the first and the last axis."""
        aside, flat = rot.dot(first, second) * rot.dot(second, last), flat_angle(first, second, last)
        cosine = rot.dot(first, end) - aside
        square = (1 - rot.dot(first, second) ** 2) * (1 - rot.dot(second, last) ** 2) - cosine**2
        side = lax.stop_gradient(jnp.where(jnp.sin(self.middle - flat) > 0, 1.0, -1.0))
        return self.middle + shortest(flat + side * jnp.arctan2(jnp.sqrt(square), cosine) - self.middle)

    def _place(self, space, poses):
        """In A: the position of point B without the displacements [m], and three directions, first those of the slides;
        no directions without slides.
        """
        slides = self.sequence.count("slide")
        angles = functools.cache(lambda: self._angles(space, poses))
        start, ways, k = self.point_a, [], self.sequence.count("hinge")
        for word, axis in zip(reversed(self.sequence), reversed([*self.axes]), strict=True):
            if word == "slide":
                ways = [axis, *perpendiculars(axis)] if slides == 1 else [axis, *ways]
            elif word == "ball":
                ways = [self._after_turn(space, poses, way) for way in ways]
            else:
                k -= 1
                ways = [_turned(axis, angles()[k], way) for way in ways]
                if self.points is not None:
                    start = self.points[k] + _turned(axis, angles()[k], start - self.points[k])
        if slides == 2:
            normal = rot.cross(*ways)
            ways = [*ways, normal / rot.norm(normal)]
        return start, ways


def coordinate_names(sequence: Sequence[str]) -> list[str]:
    """The names of the coordinates of joints in succession, in their order."""
    out = []
    for k, word in enumerate(sequence):
        name = _COORDINATES[word]
        out.append(name if word == "ball" else f"{name}_{sequence[: k + 1].count(word)}")
    return out


def degenerate(sequence: Sequence[str], axes: Float[ArrayLike, "n 3"], names: Sequence[str]) -> str | None:
    """The reason why the placement of the bodies does not determine the coordinates of joints in succession; None if it
    does.

    **Arguments:** `axes` at zero coordinates; `names` of the joints.
    """
    axes = np.asarray(axes)
    kinds = {word: [k for k, kind in enumerate(sequence) if kind == word] for word in _COORDINATES}
    listed = lambda which: ", ".join(str(names[k]) for k in which)
    hinges, slides, balls = kinds["hinge"], kinds["slide"], kinds["ball"]
    if len(hinges) + 3 * len(balls) > 3:
        return f"{listed(sorted(hinges + balls))} have more than three rotations"
    for a, b in itertools.pairwise(hinges):
        if not np.linalg.norm(np.cross(axes[a], axes[b])) > _INDEPENDENT:
            return f"{listed([a, b])} are parallel hinges in succession"
    directions = axes[slides].reshape(-1, 3)
    if len(slides) > 3 or not np.linalg.det(directions @ directions.T) > _INDEPENDENT**2:
        return f"{listed(slides)} slide in linearly dependent directions"
    return None


def flat_angle(first: Vector3, second: Vector3, last: Vector3) -> Float[Array, ""]:
    """The angle [rad] about the second of three axes that brings the last into a plane with the others, on the side of
    the first.
    """
    away = rot.dot(first, last) - rot.dot(first, second) * rot.dot(second, last)
    return namespace(first, second, last).arctan2(rot.dot(first, rot.cross(second, last)), away)


def _turned(axis, angle, v):
    """A vector turned about a unit axis."""
    aside = rot.cross(axis, v)
    return v + jnp.sin(angle) * aside + (1 - jnp.cos(angle)) * rot.cross(axis, aside)


def _angle_about(axis, turn):
    """The angle [rad] of a turn about an axis, in (−π, π]."""
    cosine, sine = turn[0], rot.dot(axis, turn[1:])
    return jnp.arctan2(2 * cosine * sine, cosine**2 - sine**2)


def _angle_between(axis, start, end):
    """The angle [rad] about an axis from one direction to another that makes the same angle with it, in (−π, π]."""
    aside = rot.cross(axis, start)
    return jnp.arctan2(rot.dot(aside, end), rot.dot(aside, rot.cross(axis, end)))


def _components(ways, vector):
    """The components of a vector along three directions."""
    a, b, c = ways
    normals = [rot.cross(b, c), rot.cross(c, a), rot.cross(a, b)]
    return jnp.stack([rot.dot(normal, vector) for normal in normals]) / rot.dot(a, normals[0])
