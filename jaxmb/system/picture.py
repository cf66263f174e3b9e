"""Contents of a picture of a motion."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..parts.base import PathKind
from ..parts.shapes import AbstractShape


class Anchors(NamedTuple):
    """Where a part acts: its bodies, and its point [m] on each, in that body's frame, None if it has none."""

    bodies: tuple[str, ...]
    points: tuple[Float[np.ndarray, "3"] | None, ...]


class Line(NamedTuple):
    """The line of a part: how it is drawn, and its points [m] along a motion, shape (times, points, 3)."""

    kind: PathKind
    points: Float[np.ndarray, "times points 3"]


class Picture(NamedTuple):
    """A motion of bodies, everything in three dimensions; the plane is z = 0.

    **Fields:**

    - `planar`; `up`, the unit vector that is upright in the picture; `width` [m]: the radius of a bar.
    - `positions` [m], shape (times, 3), and `orientations`, Euler parameters, shape (times, 4), of the bodies by name,
        those of the ground last.
    - `parts` by name; `shapes` of parts, with the names of the bodies that they are fixed in; `paths` of parts by name.
    - `centres` [m]: the mass centres of bodies whose frame has its origin elsewhere, in that frame.
    - `inertias`: mass [kg] and moments of inertia [kg m²], shape (3, 3), of the bodies by name, zero for point masses.
    """

    planar: bool
    up: Float[np.ndarray, "3"]
    width: float
    positions: dict[str, Float[np.ndarray, "times 3"]]
    orientations: dict[str, Float[np.ndarray, "times 4"]]
    parts: dict[str, Anchors]
    shapes: list[tuple[str, AbstractShape]]
    paths: dict[str, Line]
    centres: dict[str, Float[np.ndarray, "3"]]
    inertias: dict[str, tuple[float, Float[np.ndarray, "3 3"]]]
