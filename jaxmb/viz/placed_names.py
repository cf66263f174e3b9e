"""Names of points in a figure, pushed apart where they would overlap."""

from typing import Any, NamedTuple

import numpy as np

# The distances [points] at which a name is tried, and the directions, for a name above its point.
_DISTANCES = (11.0, 24.0, 38.0, 54.0)
_DIRECTIONS = np.array([(0, 1), (0, -1), (1, 0), (-1, 0), (0.7, 0.7), (-0.7, 0.7), (0.7, -0.7), (-0.7, -0.7)])


class Name(NamedTuple):
    """A `text` for a point `place` of the axes in the plane; `side`: 1 above it, -1 below; `style` of the text."""

    text: str
    place: Any
    side: int
    style: dict[str, Any]


def place_names(figure: Any, axes: Any, names: list[Name]) -> None:
    """Write names next to their points, at the first place where they overlap neither others nor the figure's edge; a
    name that had to move away has a line to its point.
    """
    figure.draw_without_rendering()
    pixels = figure.dpi / 72
    taken: list[np.ndarray] = []
    for text, place, side, style in names:
        box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.75}
        line = {"arrowstyle": "-", "linewidth": 0.6, "color": "0.5", "shrinkA": 0, "shrinkB": 0}
        options: Any = {"fontsize": "small", "zorder": 7, "ha": "center", "va": "center", "annotation_clip": False}
        written = axes.annotate(
            text, place, xytext=(0, 0), textcoords="offset points", bbox=box, arrowprops=line, **options, **style
        )
        extent = written.get_window_extent()
        half, at = 0.5 * np.array([extent.width, extent.height]) + pixels, axes.transData.transform(place)
        tried = []
        for distance in _DISTANCES:
            for direction in _DIRECTIONS * (1, side):
                # To the left and right of a point, the text and not its middle has the distance.
                away = direction * (distance * pixels + (half - (0.0, half[1])))
                middle = at + away
                spot = np.array([middle - half, middle + half])
                tried.append((_overlap(spot, taken, figure.bbox.max), len(tried), away, spot))
        _, _, away, spot = min(tried, key=lambda x: x[:2])
        written.xyann = away / pixels
        taken.append(spot)


def _overlap(spot, taken, size):
    """The area [pixels²] of a rectangle outside a figure of a size, and under other rectangles."""
    common = lambda other: np.prod(np.maximum(np.minimum(spot[1], other[1]) - np.maximum(spot[0], other[0]), 0.0))
    outside = np.prod(spot[1] - spot[0]) - common(np.array([(0.0, 0.0), size]))
    return round(float(outside + sum(map(common, taken))), 3)
