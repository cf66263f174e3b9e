"""The names, values and units that a user gives to the dimensions of a sweep's outputs."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ...parts.names import unknown
from .cases import MEMBER, Cases
from .dataset import variables
from .outputs import Outputs


def described(cases: Cases, outputs: Outputs, dims: Any, coords: Any, units: Any) -> dict[str, Any]:
    """The variables of the result, after a check of the names that the user gives to dimensions."""
    for what, given in (("dims", dims), ("coords", coords), ("units", units)):
        if not isinstance(given, Mapping):
            raise ValueError(f"{what} must be a dictionary by name, got {given!r}.")
    sizes: dict[str, int] = {}
    for name, own in dims.items():
        if name not in outputs.shapes:
            raise unknown("output in dims", name, outputs.shapes)
        shape = outputs.shapes[name][0]
        if isinstance(own, str) or len(own) != len(shape):
            raise ValueError(
                f"dims[{name!r}] must be a list of {len(shape)} names, for the shape {shape}; got {own!r}."
            )
        for dim, size in zip(own, shape, strict=True):
            if dim in (MEMBER, *cases.columns, *outputs.shapes, *(axis for axis, _ in cases.grid)):
                raise ValueError(f"The dimension {dim!r} of {name!r} has the name of something else; rename it.")
            if sizes.setdefault(dim, size) != size:
                raise ValueError(f"The dimension {dim!r} has the length {sizes[dim]}, but in {name!r} {size}.")
        if len(set(own)) < len(own):
            raise ValueError(f"dims[{name!r}] names a dimension twice, got {own!r}.")
    values = {}
    for name, given in coords.items():
        if name not in sizes:
            raise unknown("dimension in coords", name, sizes)
        values[name] = np.asarray(given)
        if values[name].shape != (sizes[name],) or values[name].dtype.kind not in "biuf":
            raise ValueError(
                f"coords[{name!r}] must be {sizes[name]} numbers, got shape {values[name].shape} of "
                f"{values[name].dtype}."
            )
    for name in units:
        known = (*cases.columns, *outputs.shapes, *sizes, *cases.labels)
        if name not in known:
            raise unknown("name in units", name, known)
    return variables(cases, outputs, {name: tuple(own) for name, own in dims.items()}, values, units)
