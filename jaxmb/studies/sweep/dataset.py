"""Results of a sweep as an xarray Dataset, with a dimension for each parameter of a grid."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from .cases import MEMBER, Cases
from .outputs import Outputs


def packages(*names: str) -> list[Any]:
    """Optional packages, imported at first use."""
    import importlib

    try:
        return [importlib.import_module(name) for name in names]
    except ImportError as error:
        raise ImportError(f"A sweep needs the package {error.name!r}: pip install jaxmb[studies]") from None


def variables(
    cases: Cases,
    outputs: Outputs,
    dims: Mapping[str, tuple[str, ...]],
    coords: Mapping[str, np.ndarray],
    units: Mapping[str, str],
) -> dict[str, tuple[tuple[str, ...], np.ndarray | np.dtype, tuple[int, ...], dict[str, Any]]]:
    """Every variable of the result by name: its dimensions, its values, or the type of those to compute, its shape and
    its attributes.
    """
    units = {**cases.units, **units}
    attributes = lambda name: {"units": units[name]} if name in units else {}
    of_column = lambda name, column: (MEMBER, *(f"{name}_{k}" for k in range(column.ndim - 1)))
    found: dict[str, Any] = {}
    for name, column in cases.columns.items():
        found[name] = (of_column(name, column), column, column.shape, attributes(name))
    for name, values in (cases.labels | dict(coords)).items():
        found[name] = ((name,), values, values.shape, attributes(name))
    for name, (shape, dtype) in outputs.shapes.items():
        own = dims.get(name, tuple(f"{name}_{k}" for k in range(len(shape))))
        found[name] = ((MEMBER, *own), dtype, (len(cases), *shape), attributes(name))
    if outputs.steps:
        found["num_steps"] = ((MEMBER,), np.dtype(np.int64), (len(cases),), {"long_name": "steps of the integration"})
    # The words that the conventions for climate and forecast metadata have for a status.
    status = {
        "flag_values": list(range(len(outputs.statuses))),
        "flag_meanings": " ".join(name for name, _ in outputs.statuses),
        "messages": json.dumps([message for _, message in outputs.statuses]),
    }
    found["status"] = ((MEMBER,), np.dtype(np.int16), (len(cases),), status)
    return found


def attributes(cases: Cases, study: Mapping[str, Any]) -> dict[str, Any]:
    """The attributes of a result: those of the study, its grid, and which variables are coordinates."""
    return {**study, "grid": json.dumps(cases.grid), "coordinates": " ".join(cases.columns)}


def in_memory(described: Mapping[str, Any], attrs: Mapping[str, Any], computed: Mapping[str, np.ndarray]) -> Any:
    """The result, from arrays in memory."""
    (xarray,) = packages("xarray")
    made = {name: (dims, computed.get(name, values), attrs) for name, (dims, values, _, attrs) in described.items()}
    return unstacked(xarray.Dataset(made, attrs=dict(attrs)).set_coords(attrs["coordinates"].split()))


def unstacked(dataset: Any) -> Any:
    """A result with the messages of its members, and with the dimensions of its grid instead of that of members."""
    (xarray,) = packages("xarray")
    messages = json.loads(dataset["status"].attrs.pop("messages"))
    # As long as the longest message that occurs, not the longest one there is.
    dataset["message"] = (MEMBER, np.array([messages[code] for code in dataset["status"].to_numpy()]))
    dataset.attrs.pop("coordinates", None)
    grid = json.loads(dataset.attrs.pop("grid"))
    if not grid:
        return dataset
    axes, sizes = [name for name, _ in grid], [size for _, size in grid]
    # A coordinate of more than one dimension cannot have the name of one of them.
    several = {name for name in axes if name in dataset.coords and dataset[name].ndim > 1}
    names = [f"{name}_index" if name in several else name for name in axes]
    made, coords = {}, {}
    for name, variable in dataset.variables.items():
        dims, values = variable.dims, variable.to_numpy()
        if MEMBER in dims:
            dims, values = (*names, *dims[1:]), values.reshape(*sizes, *values.shape[1:])
            if name in axes and name in dataset.coords:
                # A parameter of the grid varies along its own dimension only.
                place = axes.index(name)
                values = values[tuple(slice(None) if k == place else 0 for k in range(len(axes)))]
                dims = (names[place], *dims[len(axes) :])
        (coords if name in dataset.coords else made)[name] = xarray.Variable(dims, values, variable.attrs)
    return xarray.Dataset(made, coords, dataset.attrs)
