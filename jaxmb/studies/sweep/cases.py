"""The cases of a sweep: grids, tables and samples of named parameters.

```python
from jaxmb import cases
every = cases.grid(speed=[1.0, 2.0], height=np.linspace(0.0, 0.2, 5))  # Ten members.
listed = cases.table(speed=[1.0, 2.0, 4.0], height=0.1)
spread = cases.sobol(64, speed=(1.0, 5.0), height=(0.01, 1.0), log=["height"], seed=1)
```
"""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from jaxtyping import ArrayLike

from ..._arguments import whole_number
from ...parts.names import unknown
from ..sobol import sobol_points

__all__ = ["Cases", "grid", "sobol", "table"]

MEMBER = "member"


@dataclasses.dataclass(frozen=True)
class Cases:
    """The parameters of all members of a sweep; `grid`, `table` and `sobol` make one.

    **Fields:**

    - `columns`: parameters by name, each an array with the members along axis 0.
    - `grid`: names and lengths of the dimensions whose product the members are, the last one running fastest; empty for
        a plain list of members.
    - `labels`: values along dimensions of the grid that are not parameters, by the dimension's name.
    - `units`: units by the name of a parameter or dimension.
    """

    columns: dict[str, np.ndarray]
    grid: tuple[tuple[str, int], ...] = ()
    labels: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    units: dict[str, str] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        for name, column in self.columns.items():
            good = np.isfinite(column).reshape(column.shape[0], -1).all(axis=1)
            if not good.all():
                raise ValueError(f"The parameter {name!r} is not finite in member {int(np.argmin(good))}.")
        if len(self) == 0:
            raise ValueError("A sweep needs at least one member; the cases are empty.")

    def __repr__(self) -> str:
        lengths = " × ".join(f"{name} ({length})" for name, length in self.grid)
        return f"Cases: {len(self)} members, {f'a grid of {lengths}' if self.grid else ', '.join(self.columns)}"

    def __len__(self) -> int:
        return next(iter(self.columns.values())).shape[0]

    def __getitem__(self, members: Any) -> dict[str, np.ndarray]:
        """The parameters of some members, by name."""
        return {name: column[members] for name, column in self.columns.items()}


def grid(axes: Mapping[str, ArrayLike] | None = None, /, **more: ArrayLike) -> Cases:
    """All combinations of the values of each parameter, the last parameter running fastest.

    **Arguments:** values by the parameter's name, as a dictionary or as keyword arguments. Axis 0 runs along the
    values: shape (k,) gives k numbers, and (k, 2) gives k points.
    `grid(speed=[1.0, 2.0], height=np.linspace(0, 0.2, 5))` has ten members, and the result of its sweep has the
    dimensions `speed` and `height`.

    **Raises:** `ValueError` for values that are not finite real numbers, and for no values at all.
    """
    values = {name: _numbers(name, given) for name, given in _named(axes, more).items()}
    sizes = tuple(column.shape[0] for column in values.values())
    places = np.indices(sizes).reshape(len(sizes), -1)
    columns = {name: column[place] for (name, column), place in zip(values.items(), places, strict=True)}
    return Cases(columns, tuple(zip(values, sizes, strict=True)))


def table(columns: Any = None, /, **more: ArrayLike) -> Cases:
    """Members that are listed one by one.

    **Arguments:** columns of equal length by the parameter's name, as a dictionary or as keyword arguments: shape
    (members,) for numbers, (members, 2) for points; a single number is the same for all members. Also accepted are a
    pandas `DataFrame`, whose columns are the parameters, and an xarray `Dataset` or named `DataArray`. The parameters
    are the data variables of a `Dataset`, or without any its dimension coordinates. They are broadcast over all
    dimensions, which the result of the sweep has again.

    **Raises:** `ValueError` that names the column, for lengths that differ, repeated names, and values that are not
    finite real numbers.
    """
    if isinstance(columns, Cases):  # A concrete class: cases that are made already.
        return columns
    if hasattr(columns, "to_dataset") and not hasattr(columns, "data_vars"):
        if columns.name is None:
            raise ValueError("The DataArray of cases has no name; array.rename(name) gives it the parameter's name.")
        columns = columns.to_dataset()
    if hasattr(columns, "data_vars"):
        return _of_dataset(columns)
    if hasattr(columns, "columns") and hasattr(columns, "index"):
        columns = _of_frame(columns)
    return _of_columns(_named(columns, more))


def sobol(
    members: int,
    ranges: Mapping[str, tuple[ArrayLike, ArrayLike]] | None = None,
    /,
    *,
    log: Iterable[str] = (),
    seed: int = 0,
    **more: tuple[ArrayLike, ArrayLike],
) -> Cases:
    """A scrambled Sobol sample, which fills a box more evenly than random numbers; from `scipy.stats.qmc`.

    **Arguments:** `members`: best a power of two, which fills the box most evenly; `ranges`: the lowest and the highest
    value of each parameter by its name, as a dictionary or as keyword arguments, numbers or arrays of one shape; `log`:
    the names of parameters whose logarithm is sampled evenly; `seed` of the scrambling.

    **Raises:** `ValueError` that names the parameter, for ranges that are empty or not finite.
    """
    members = whole_number("members", members)
    box, log = {name: _range(name, given) for name, given in _named(ranges, more).items()}, tuple(log)
    for name in log:
        if name not in box:
            raise unknown("parameter in log", name, box)
        if np.any(box[name] <= 0):
            raise ValueError(f"The range of {name!r} must be positive, since its logarithm is sampled.")
    points, columns = sobol_points(members, sum(ends[0].size for ends in box.values()), seed), {}
    for name, ends in box.items():
        own, points = points[:, : ends[0].size].reshape(members, *ends[0].shape), points[:, ends[0].size :]
        low, high = np.log(ends) if name in log else ends
        value = low + (high - low) * own
        columns[name] = np.exp(value) if name in log else value
    return Cases(columns)


def _named(given: Any, more: Mapping[str, Any]) -> dict[str, Any]:
    given = {} if given is None else given
    if isinstance(given, Mapping) and not (given or more):
        raise ValueError("A sweep needs at least one parameter with its values.")
    if not isinstance(given, Mapping):
        raise ValueError(f"Cases are values by the parameter's name, or a DataFrame or Dataset; got {given!r}.")
    for name in given:
        if not isinstance(name, str):
            raise ValueError(f"The name of a parameter must be a string, got {name!r}.")
        if name in more:
            raise ValueError(f"The parameter {name!r} is given twice.")
    return {**given, **more}


def _numbers(name: str, given: Any) -> np.ndarray:
    try:
        values = np.asarray(given)
    except ValueError as error:
        raise ValueError(f"The values of {name!r} are not an array of numbers: {error}") from None
    if values.dtype.kind not in "biuf":
        raise ValueError(f"The values of {name!r} must be real numbers, got {values.dtype}.")
    if values.ndim == 0 or values.shape[0] == 0:
        raise ValueError(f"The values of {name!r} must be a list of at least one, got {given!r}.")
    return values


def _range(name: str, given: Any) -> np.ndarray:
    try:
        low, high = np.broadcast_arrays(*(np.asarray(end, float) for end in given))
    except (TypeError, ValueError):
        raise ValueError(f"The range of {name!r} must be the lowest and the highest value, got {given!r}.") from None
    if not (np.all(np.isfinite(low)) and np.all(np.isfinite(high)) and np.all(low < high)):
        raise ValueError(f"The range of {name!r} must be finite, the lowest value first, got {given!r}.")
    return np.stack([low, high])


def _of_columns(given: Mapping[str, Any]) -> Cases:
    single = {name for name, column in given.items() if np.isscalar(column) or getattr(column, "shape", None) == ()}
    columns = {name: _numbers(name, [column] if name in single else column) for name, column in given.items()}
    lengths = {name: column.shape[0] for name, column in columns.items() if name not in single}
    if len(set(lengths.values())) > 1:
        raise ValueError(
            "The columns of cases must have one length, got "
            + ", ".join(f"{length} of {name!r}" for name, length in lengths.items())
            + "; jaxmb.cases.grid(...) makes all combinations."
        )
    members = next(iter(lengths.values()), 1)
    return Cases({name: np.repeat(c, members, axis=0) if name in single else c for name, c in columns.items()})


def _of_frame(frame: Any) -> dict[str, np.ndarray]:
    if not frame.columns.is_unique:
        repeated = frame.columns[frame.columns.duplicated()][0]
        raise ValueError(f"The column {repeated!r} of the cases is there more than once.")
    if list(frame.index) != list(range(len(frame))):
        raise ValueError(
            "The DataFrame of cases has an index other than 0, 1, …: frame.reset_index() makes it a parameter, and "
            "frame.reset_index(drop=True) drops it."
        )
    return {name: frame[name].to_numpy() for name in frame.columns}


def _of_dataset(dataset: Any) -> Cases:
    import xarray

    for name in dataset.coords:
        if name not in dataset.dims and dataset.data_vars:
            raise ValueError(
                f"The coordinate {name!r} of the cases is neither a parameter nor a dimension: "
                f"dataset.reset_coords({name!r}) makes it a parameter, and with drop=True drops it."
            )
    if not dataset.variables:
        raise ValueError("The Dataset of cases is empty.")
    own = dict(dataset.data_vars) or {name: dataset[name] for name in dataset.dims if name in dataset.coords}
    sizes = {str(dim): size for dim, size in dataset.sizes.items()}
    full = {name: xarray.broadcast(variable, dataset)[0].transpose(*sizes) for name, variable in own.items()}
    columns = {str(name): _numbers(name, variable.to_numpy().reshape(-1)) for name, variable in full.items()}
    labels = {dim: dataset[dim].to_numpy() for dim in sizes if dim in dataset.coords and dim not in columns}
    labels = {dim: _numbers(dim, values) for dim, values in labels.items()}
    units = {str(name): v.attrs["units"] for name, v in dataset.variables.items() if "units" in v.attrs}
    return Cases(columns, tuple(sizes.items()), labels, units)
