"""The contents of a picture of a motion: bodies, parts, shapes and paths."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float

from ..parts.base import PathKind
from ..parts.shapes import AbstractShape


class Anchors(NamedTuple):
    """The bodies of a part, and its point [m] on each in the body's frame, None for a part without points."""

    bodies: tuple[str, ...]
    points: tuple[Float[np.ndarray, "3"] | None, ...]


class Line(NamedTuple):
    """The line of a part: the `kind` of drawing, and its points [m] along a motion, shape (times, points, 3)."""

    kind: PathKind
    points: Float[np.ndarray, "times points 3"]


class Picture(NamedTuple):
    """A motion of bodies in three dimensions; planar motions are in z = 0.

    **Fields:**

    - `planar`; `up`, the unit vector that is upright in the picture; `width` [m]: the radius of a bar.
    - `positions` [m], shape (times, 3), and `orientations`, Euler parameters, shape (times, 4), by name, of the bodies,
        the ground, and frames that move in flexible bodies.
    - `bodies`: the names of the moving bodies; `owners`: by name of such a frame, its body.
    - `parts` by name; `shapes` of parts, with the names of their bodies; `paths` of parts and of flexible bodies.
    - `centres` [m]: mass centres in the bodies' frames, of bodies with their origin elsewhere.
    - `notes`: words about the picture, such as the scale of deformations.
    - `inertias`: mass [kg] and moments of inertia [kg m²], shape (3, 3), of the bodies by name, zero for point masses.
    """

    planar: bool
    up: Float[np.ndarray, "3"]
    width: float
    positions: dict[str, Float[np.ndarray, "times 3"]]
    orientations: dict[str, Float[np.ndarray, "times 4"]]
    bodies: tuple[str, ...]
    owners: dict[str, str]
    parts: dict[str, Anchors]
    shapes: list[tuple[str, AbstractShape]]
    paths: dict[str, Line]
    centres: dict[str, Float[np.ndarray, "3"]]
    inertias: dict[str, tuple[float, Float[np.ndarray, "3 3"]]]
    notes: tuple[str, ...] = ()

    @property
    def on_bars(self) -> set[str]:
        """Names of the bodies that thick lines show."""
        bars = [name for name, line in self.paths.items() if line.kind == "bar"]
        return {body for name in bars for body in (self.parts[name].bodies if name in self.parts else (name,))}


def joined_pictures(pictures: Sequence[Picture]) -> Picture:
    """The picture of a motion of several stages: poses and paths follow each other, all else is of the last stage."""
    follow = lambda values: {name: np.concatenate([own[name] for own in values]) for name in values[0]}
    points = follow([{name: line.points for name, line in own.paths.items()} for own in pictures])
    last = pictures[-1]
    return last._replace(
        positions=follow([own.positions for own in pictures]),
        orientations=follow([own.orientations for own in pictures]),
        paths={name: line._replace(points=points[name]) for name, line in last.paths.items()},
    )


def in_space(vectors: ArrayLike) -> Float[np.ndarray, "*vectors 3"]:
    """Vectors of the plane or of space with three components."""
    vectors = np.asarray(vectors)
    return np.concatenate([vectors, np.zeros((*vectors.shape[:-1], 3 - vectors.shape[-1]))], axis=-1)
