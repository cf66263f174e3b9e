"""The second-derivative formulas, for steps of any size, from Newton's form of Hermite's interpolation polynomial.

A formula advances `y' = f`, with the second derivative `g`. It interpolates a quantity z and its slope at the end of
the step, and z at points of the past. One condition on the polynomial determines the end:

    family   z   points of the past     the polynomial                                order
    E        f   k                      integrated over the step gives the change     k + 2
    H        f   k, with their slopes   the same                                      2k + 2
    B        y   k                      has the second derivative g at the end        k + 1
    Y        y   k, with their slopes   the same                                      2k + 1

A point with its slope is a double node. So all families are one formula on `m` nodes of the past, `m = k` or `2k`, and
follow from one table of divided differences. With the Newton basis of these nodes and `s = (t - t_{n+1}) / h`,

    p(t) = sum_{i<m} differences[i] basis_i(t) + (a + b s) basis_m(t) / basis_m(t_{n+1}),

and exactness of the formula for every term determines its coefficients.

Sources: W. H. Enright, SIAM J. Numer. Anal. 11(2), 1974 (E); E. Hairer and G. Wanner, Solving Ordinary Differential
Equations II, Springer, 1996, section V.3 (E and B).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._history import NODES, WEIGHTS, History, basis, before_each, spans


class Family(NamedTuple):
    """**Fields:**

    - `integrated`: whether z is f, and the polynomial is integrated; otherwise z is y.
    - `multiplicity`: conditions at each point of the past, 2 if the slope is used.
    - `highest`: the largest useful number k of points.
    - `stable`: the largest k of an A-stable formula.
    - `growth`: for 1, 2, ... points the largest constant ratio of successive steps that keeps zero-stability; see
        `largest_growth` of `jaxmb.solvers.stability`.
    """

    integrated: bool
    multiplicity: int
    highest: int
    stable: int
    growth: tuple[float, ...]

    @property
    def length(self) -> int:
        """The number of differences that are kept: enough for the error of the formula with the most points."""
        return self.multiplicity * (self.highest + 1) + 1

    def order(self, k: Any) -> Any:
        """Order of the formula with k points of the past."""
        return k * self.multiplicity + (2 if self.integrated else 1)


_ANY = float("inf")
# With more points than these, E and B are stable in no useful sector (A(α) below 13 degrees), and Y in none. H is
# A-stable with one point only; its others are for comparison.
FAMILIES = {
    "E": Family(True, 1, 7, 2, (_ANY,) * 7),
    "B": Family(False, 1, 8, 3, (_ANY, 3.84, 2.14, 1.57, 1.32, 1.19, 1.11, 1.06)),
    "H": Family(True, 2, 3, 1, (_ANY,) * 3),
    "Y": Family(False, 2, 3, 1, (_ANY, 1.49, 1.06)),
}


class Formulas(NamedTuple):
    """The coefficients of one step, for every number m of nodes of the past.

    With `z = f`: `y_{n+1} = y_n + h (past[m] @ differences + slope[m] f_{n+1} + curvature[m] h g_{n+1})`, with
    `z = y`: `y_{n+1} = past[m] @ differences + slope[m] h f_{n+1} + curvature[m] h² g_{n+1}`. Row 0 is unused.
    """

    past: Float[Array, "length length"]
    slope: Float[Array, " length"]
    curvature: Float[Array, " length"]


def formulas(family: Family, mesh: Float[Array, " length"], t: Any, dtype: Any) -> Formulas:
    """The coefficients of a step from the latest point of a mesh to `t`, for values of a type."""
    length = mesh.shape[0]
    constant = lambda x: jnp.asarray(x, mesh.dtype)
    h = t - mesh[0]
    table = basis(mesh, mesh[0] + h * constant(np.append(NODES, 1.0)))
    values = table[:, -1]
    # Logarithmic derivatives at the end of the step, where no basis polynomial vanishes.
    before = before_each(length)
    inverse = h / (t - mesh)
    first, squares = constant(before) @ inverse, constant(before) @ inverse**2
    if family.integrated:
        means = table[:, :-1] @ constant(WEIGHTS)
        curvature = table[:, :-1] @ constant(WEIGHTS * (NODES - 1)) / values
        slope = means / values - curvature * first
        asked, once, twice = means, values, values * first
    else:
        curvature = -1 / jnp.where(constant(np.arange(length)) > 0, first**2 + squares, constant(1.0))
        slope = -2 * first * curvature
        asked, once, twice = values, values * first, values * (first**2 - squares)
    past = constant(before) * (asked[None] - slope[:, None] * once[None] - curvature[:, None] * twice[None])
    return Formulas(past.astype(dtype), slope.astype(dtype), curvature.astype(dtype))


def start(family: Family, t: Any, z: Float[Array, " n"], slope: Float[Array, " n"], spacing: Any) -> History:
    """A history of one point with its slope."""
    spacing = jnp.where(spacing > 0, spacing, jnp.ones_like(spacing))
    before = np.maximum(np.arange(family.length) - 1, 0)
    rest = jnp.zeros((family.length - 2, z.size), z.dtype)
    differences = jnp.concatenate([z[None], spacing.astype(z.dtype) * slope[None], rest])
    return History(differences, t - spacing * before.astype(spacing.dtype), jnp.asarray(2, np.int32))


def is_start(history: History) -> Bool[Array, ""]:
    """Whether a history has one point only."""
    return history.known == 2


def spacing_of(history: History) -> tuple[Any, Any]:
    """The latest time of a history, and the spacing with which it was started there."""
    return history.mesh[0], spans(history.mesh)[0]


def double(history: History, slope: Float[Array, " n"]) -> History:
    """The history with its latest point doubled by the slope of z there; unchanged if that point is double already."""
    mesh, dtype = history.mesh, history.differences.dtype
    length = mesh.shape[0]
    step = spans(mesh)[0]
    gaps = jnp.where(mesh[0] > mesh, mesh[0] - mesh, step)
    # The slopes of the basis polynomials at the latest point, where all but the first vanish.
    slopes = jnp.asarray(np.arange(length) > 0, dtype) * (step / gaps).astype(dtype)
    before = jnp.asarray(before_each(length), dtype)
    added = step.astype(dtype) * slope[None] - (before * slopes[None]) @ history.differences
    added = jnp.where((np.arange(length, dtype=np.int32) <= history.known)[:, None], added, jnp.zeros((), dtype))
    added = jnp.concatenate([history.differences[:1], added[1:]])
    doubled = History(added, jnp.append(mesh[:1], mesh[:-1]), jnp.minimum(history.known + 1, length).astype(np.int32))
    already = mesh[0] == mesh[1]
    return jax.tree.map(lambda old, added: jnp.where(already, old, added), history, doubled)
