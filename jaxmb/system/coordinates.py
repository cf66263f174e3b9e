"""Coordinates and rates by name: the entries of q and u that a name such as `"crank.angle"` denotes."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Array, Bool, Float

from .._types import VectorLike
from ..linalg.arrays import as_array, replaced
from ..parts.names import unknown
from .arguments import real_shape
from .layout import Layout


def coordinate_names(layout: Layout, bodies: tuple[str, ...]) -> dict[str, list[int]]:
    """Indices in q of every name: `x`, `y`, `angle`, `position` of planar bodies; `x`, `y`, `z`, `e0` … `e3`,
    `position`, `orientation` of spatial ones; and of scalar coordinates that move.
    """
    if layout.space.dimension == 3:
        fields = ["x", "y", "z", "e0", "e1", "e2", "e3"]
        groups = {"position": slice(0, 3), "orientation": slice(3, 7)}
        return _names(layout, bodies, layout.pose_index, fields, groups)
    return _names(layout, bodies, layout.pose_index, ["x", "y", "angle"], {"position": slice(0, 2)})


def rate_names(layout: Layout, bodies: tuple[str, ...]) -> dict[str, list[int]]:
    """Indices in u of every name: as `coordinate_names` in the plane; `x`, `y`, `z`, `wx`, `wy`, `wz`, `velocity`,
    `angular_velocity` in space; scalar coordinates have their names.
    """
    if layout.space.dimension == 3:
        fields = ["x", "y", "z", "wx", "wy", "wz"]
        groups = {"velocity": slice(0, 3), "angular_velocity": slice(3, 6)}
        return _names(layout, bodies, layout.velocity_index, fields, groups)
    return _names(layout, bodies, layout.velocity_index, ["x", "y", "angle"], {"velocity": slice(0, 2)})


def _names(layout, bodies, index, fields, groups):
    names = {}
    rows = index[:-1].tolist()
    for body, row, rotates in zip(bodies, rows[: layout.bodies], layout.rotates, strict=True):
        own = len(fields) if rotates else layout.space.dimension
        for k in range(own):
            names[f"{body}.{fields[k]}"] = [row[k]]
        for group, where in groups.items():
            if where.stop <= own:
                names[f"{body}.{group}"] = row[where]
    scalars = zip(layout.scalars, rows[layout.bodies :], strict=True)
    return names | {own.name: [row[0]] for own, row in scalars if own.moves}


def prescribe(
    what: str, names: Mapping[str, list[int]], values: Mapping[str, VectorLike], vector: Float[Array, "n"]
) -> tuple[Float[Array, "n"], Bool[np.ndarray, "n"]]:
    """Write values by name into a vector.

    **Returns:** the vector, and a static mask of the entries that were prescribed.

    **Raises:** `ValueError` for unknown names, wrong shapes, and values that are no real numbers.
    """
    if not isinstance(values, Mapping):
        raise ValueError(f"A {what} is prescribed by name, {{'crank.angle': 0.3}}; got {values!r}.")
    fixed = np.zeros(vector.shape[0], bool)
    for name, value in values.items():
        if name not in names:
            raise unknown(what, name, names)
        index = names[name]
        shape = real_shape(f"{what.capitalize()} {name!r}", value)
        if shape not in ((), (len(index),)) or (shape == () and len(index) > 1):
            raise ValueError(f"{what.capitalize()} {name!r} has {len(index)} components, got shape {shape}.")
        value = as_array(value, vector.dtype)
        vector = replaced(vector, np.array(index), value)
        fixed[index] = True
    return vector, fixed
