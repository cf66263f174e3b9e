"""Results of a sweep as an xarray Dataset, with a dimension for each parameter of a grid."""

import importlib
import json
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ...parts.names import unknown
from .cases import MEMBER, Cases
from .outputs import Outputs


class Variable(NamedTuple):
    """A variable of the result; `values`: the values of a coordinate, or the type of an output, which is computed."""

    dims: tuple[str, ...]
    values: np.ndarray | np.dtype
    shape: tuple[int, ...]
    attributes: dict[str, Any]

    @property
    def is_output(self) -> bool:
        return isinstance(self.values, np.dtype)


def packages(*names: str) -> list[Any]:
    """Optional packages, imported at first use."""
    try:
        return [importlib.import_module(name) for name in names]
    except ImportError as error:
        raise ImportError(f"A sweep needs the package {error.name!r}: pip install jaxmb[studies]") from None


def variables(cases: Cases, outputs: Outputs, dims: Any, coords: Any, units: Any) -> dict[str, Variable]:
    """Every variable of the result by name.

    **Raises:** `ValueError` for names of dimensions, values along them and units that do not fit.
    """
    for what, given in (("dims", dims), ("coords", coords), ("units", units)):
        if not isinstance(given, Mapping):
            raise ValueError(f"{what} must be a dictionary by name, got {given!r}.")
    sizes = _sizes(cases, outputs, dims)
    values = {name: _along(name, given, sizes) for name, given in coords.items()}
    for name in units:
        known = (*cases.columns, *outputs.shapes, *sizes, *cases.labels)
        if name not in known:
            raise unknown("name in units", name, known)
    units = {**cases.units, **units}
    attributes = lambda name: {"units": units[name]} if name in units else {}
    own_dims = lambda name, shape: tuple(f"{name}_{k}" for k in range(len(shape)))
    found: dict[str, Variable] = {}
    for name, column in cases.columns.items():
        found[name] = Variable((MEMBER, *own_dims(name, column.shape[1:])), column, column.shape, attributes(name))
    for name, along in (cases.labels | values).items():
        found[name] = Variable((name,), along, along.shape, attributes(name))
    for name, (shape, dtype) in outputs.shapes.items():
        own = (MEMBER, *dims.get(name, own_dims(name, shape)))
        found[name] = Variable(own, dtype, (len(cases), *shape), attributes(name))
    if outputs.steps:
        steps = {"long_name": "steps of the integration"}
        found["num_steps"] = Variable((MEMBER,), np.dtype(np.int64), (len(cases),), steps)
    # The attributes of a status by the conventions for climate and forecast metadata (CF).
    status = {
        "flag_values": list(range(len(outputs.statuses))),
        "flag_meanings": " ".join(name for name, _ in outputs.statuses),
        "messages": json.dumps([message for _, message in outputs.statuses]),
    }
    found["status"] = Variable((MEMBER,), np.dtype(np.int16), (len(cases),), status)
    return found


def _sizes(cases: Cases, outputs: Outputs, dims: Mapping[str, Any]) -> dict[str, int]:
    """The lengths of the dimensions that the user names."""
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
    return sizes


def _along(name: str, given: Any, sizes: Mapping[str, int]) -> np.ndarray:
    """The values along a dimension."""
    if name not in sizes:
        raise unknown("dimension in coords", name, sizes)
    values = np.asarray(given)
    if values.shape != (sizes[name],) or values.dtype.kind not in "biuf":
        raise ValueError(f"coords[{name!r}] must be {sizes[name]} numbers, got shape {values.shape} of {values.dtype}.")
    return values


def in_memory(described: Mapping[str, Variable], attrs: Mapping[str, Any], computed: Mapping[str, np.ndarray]) -> Any:
    """The result, from arrays in memory."""
    (xarray,) = packages("xarray")
    made = {name: (own.dims, computed.get(name, own.values), own.attributes) for name, own in described.items()}
    return unstacked(xarray.Dataset(made, attrs=dict(attrs)).set_coords(attrs["coordinates"].split()))


def unstacked(dataset: Any) -> Any:
    """A result with the messages of its members, and with the dimensions of its grid instead of `member`."""
    (xarray,) = packages("xarray")
    messages = json.loads(dataset["status"].attrs.pop("messages"))
    # The type has the length of the longest message that occurs, not of the longest possible message.
    dataset["message"] = (MEMBER, np.array([messages[code] for code in dataset["status"].to_numpy()]))
    dataset.attrs.pop("coordinates", None)
    grid = dict(json.loads(dataset.attrs.pop("grid")))
    if not grid:
        return dataset
    # A coordinate of more than one dimension cannot have the name of one of its dimensions.
    several = {name for name in grid if name in dataset.coords and dataset[name].ndim > 1}
    axes = {name: f"{name}_index" if name in several else name for name in grid}
    sizes = {axes[name]: size for name, size in grid.items()}
    made = {}
    for name, variable in dataset.variables.items():
        if MEMBER in variable.dims:
            variable = variable.unstack({MEMBER: sizes}).transpose(*sizes, ...)
            if name in axes and name in dataset.coords:
                # A parameter of the grid varies along its own dimension only.
                variable = variable.isel({axis: 0 for axis in sizes if axis != axes[name]})
        made[name] = variable
    return xarray.Dataset(made, attrs=dataset.attrs).set_coords(list(dataset.coords))
