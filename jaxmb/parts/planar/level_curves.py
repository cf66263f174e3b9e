"""Points along the curve on which a function of the plane is zero, for pictures."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..._types import Scalar
from ...linalg.jitted import jitted

# The largest number of points to either side, and the steps beyond the visited part of an open curve.
_MOST, _BEYOND = 1500, 20


def level_curve(
    curve: Callable[[Float[Array, "2"], Any], Scalar], numbers: Any, visited: Float[np.ndarray, "times 2"], step: float
) -> tuple[Float[np.ndarray, "points 2"], bool]:
    """Points [m] at a distance `step` along the curve `curve(point, numbers) = 0`, and whether it is closed.

    **Arguments:** `visited`: points of the curve; of an open curve only this part and some steps beyond are followed.
    """
    ahead = _finite(_points(curve, numbers, visited[0], np.asarray(step)))
    back_at_start = np.flatnonzero(np.linalg.norm(ahead[3:] - ahead[0], axis=1) < 0.75 * step)
    if back_at_start.size:
        return ahead[: back_at_start[0] + 3], True
    line = np.concatenate([_finite(_points(curve, numbers, visited[0], np.asarray(-step)))[:0:-1], ahead])
    near = [np.argmin(np.linalg.norm(line - point, axis=1)) for point in visited]
    return line[max(0, min(near) - _BEYOND) : max(near) + _BEYOND + 1], False


def _finite(points):
    """The points before the first at which the curve has no direction."""
    points = np.asarray(points)
    bad = ~np.all(np.isfinite(points), axis=1)
    return points[: int(np.argmax(bad))] if bad.any() else points


@jitted
def _points(curve, numbers, start, step):
    """Steps along the tangent, each brought back to the curve by Newton's method along the normal."""
    value = jax.value_and_grad(curve)

    def back(_, point):
        size, slope = value(point, numbers)
        return point - size * slope / (slope @ slope)

    def ahead(point, _):
        _, slope = value(point, numbers)
        along = jnp.stack([slope[1], -slope[0]]) / jnp.linalg.norm(slope)
        return lax.fori_loop(0, 3, back, point + step * along), point

    return lax.scan(ahead, jnp.asarray(start), length=_MOST)[1]
