"""Volume, centre and second moments of the solid that a closed surface of triangles encloses."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

# The largest coordinate of a centre that counts as zero, relative to the size of the solid.
_ROUNDING = 1e-12


class MeshSolid(NamedTuple):
    """A homogeneous solid of density one: its volume [m³], its centre [m], and its inertia about the centre [m⁵]."""

    volume: float
    centre: Float[np.ndarray, "3"]
    inertia: Float[np.ndarray, "3 3"]

    @classmethod
    def of(cls, vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"], label: str) -> "MeshSolid":
        """The solid within triangles, as a sum of tetrahedra with a common corner.

        **Raises:** `ValueError` for a surface that is not closed, or whose triangles do not all face outwards or all
        inwards.
        """
        places, same = np.unique(vertices, axis=0, return_inverse=True)
        corners = same.reshape(-1)[faces]
        edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
        both = np.unique(edges, axis=0)
        # Each edge belongs to two triangles, which pass it in opposite directions.
        if len(both) < len(edges) or not np.array_equal(both, np.unique(edges[:, ::-1], axis=0)):
            raise ValueError(f"{label}: the surface is not closed, or its triangles face both ways; repair it.")
        # About a corner near the solid, so that little is lost by rounding.
        origin = places.mean(axis=0)
        a, b, c = (places[corners[:, k]] - origin for k in range(3))
        six = np.einsum("ij,ij->i", a, np.cross(b, c))
        six = six * np.sign(six.sum())
        volume, total = six.sum() / 6, a + b + c
        centre = six @ total / (24 * volume)
        squares = sum(np.einsum("n,ni,nj->ij", six, x, x) for x in (a, b, c, total)) / 120
        squares = squares - volume * np.outer(centre, centre)
        place = origin + centre
        # Rounding errors in place of zero would count as lengths of a machine.
        place[np.abs(place) < _ROUNDING * np.max(np.ptp(places, axis=0))] = 0.0
        return cls(float(volume), place, np.trace(squares) * np.eye(3) - squares)
