"""Measured data from files and tables."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...parts.names import unknown

_MISSING = {"", "nan", "na", "n/a", "null", "none", "-"}


class Measurements(NamedTuple):
    """Measured data: `ts` [s], shape (times,), and `values` by name with time as axis 0, for `identify(system, data,
    …)` and `Experiment`.

    ```python
    data = jaxmb.Measurements(ts=np.array([0.1, 0.2, 0.3]), values={"bar.angle": np.array([0.44, 0.25, -0.05])})
    ```
    """

    ts: np.ndarray
    values: dict[str, np.ndarray]


# The accepted forms of data.
BY_NAME = (
    "measured is given by name, such as {'crank.angle': array}, or by jaxmb.Experiment(measured, ts=…), and "
    "jaxmb.read_measurements reads files and tables"
)


def have_times(measured: Any) -> bool:
    """Whether measured data have values by name and times, like `Measurements`."""
    return hasattr(measured, "ts") and isinstance(getattr(measured, "values", None), Mapping)


def read_measurements(
    source: str | Path | Any, columns: Mapping[str, str | Sequence[str]] | None = None, *, time: str = "t"
) -> Measurements:
    """Read measured data from a CSV file with a header line, a DataFrame, or an xarray Dataset.

    ```python
    data = jaxmb.read_measurements("run.csv", {"bar.angle": "phi"}, time="t")
    data.ts, data.values["bar.angle"]
    ```

    **Arguments:**

    - `source`: the path of a file; a table with `columns` and columns by name, such as in pandas and polars; or a
        Dataset, such as from `Trajectory.to_xarray`, whose variables have the dimension of time and at most one more.
    - `columns`: for each quantity or sensor the name of its column, or a list of columns, one for each component:
        `{"rod.angle": "phi", "rod.position": ["x", "y"]}`; default all columns except time, by their names.
    - `time`: the column of times [s], which must increase.

    **Returns:** `Measurements`; NaN marks missing samples, from empty cells or `nan`, `NA` and `null`.

    **Raises:** `ValueError` that names missing and repeated columns, the line and column of a cell that is not a
    number, missing or unordered times; and for tables with fewer than two rows. `FileNotFoundError` if the file is
    missing.
    """
    if isinstance(source, str | Path):
        named = _of_file(Path(source))
    else:
        named = _of_dataset(source, time) if hasattr(source, "data_vars") else _of_frame(source)
    label = str(source) if isinstance(source, str | Path) else "The table"
    if time not in named:
        raise unknown("column of time", time, named)
    columns = {name: name for name in named if name != time} if columns is None else columns
    if not columns:
        raise ValueError(f"{label} has no column except time.")
    values = {}
    for name, column_names in columns.items():
        for column in (column_names,) if isinstance(column_names, str) else column_names:
            if column not in named:
                raise unknown("column", column, named)
        values[name] = (
            named[column_names]
            if isinstance(column_names, str)
            else np.stack([named[column] for column in column_names], axis=1)
        )
    ts = named[time]
    if ts.size < 2:
        raise ValueError(f"{label} has {ts.size} rows; there are too few data.")
    if not np.all(np.isfinite(ts)):
        raise ValueError(f"Column {time!r} has no number in row {int(np.flatnonzero(~np.isfinite(ts))[0]) + 1}.")
    if np.any(np.diff(ts) <= 0):
        row = int(np.flatnonzero(np.diff(ts) <= 0)[0]) + 1
        raise ValueError(
            f"Column {time!r} must increase, but {ts[row]:g} in row {row + 1} follows {ts[row - 1]:g}; "
            "sort the rows, one at each time."
        )
    return Measurements(ts, values)


def _of_file(path: Path) -> dict[str, np.ndarray]:
    with path.open(newline="", encoding="utf-8-sig") as file:
        text = file.read()
    delimiter = max(",;\t", key=text.partition("\n")[0].count)
    reader = csv.reader(text.splitlines(), delimiter=delimiter)
    lines = [(reader.line_num, cells) for cells in reader if any(cell.strip() for cell in cells)]
    if not lines:
        raise ValueError(f"{path} is empty.")
    header = [cell.strip() for cell in lines[0][1]]
    repeated = sorted({name for name in header if header.count(name) > 1})
    if repeated:
        raise ValueError(f"{path} has more than one column {repeated[0]!r}.")
    for number, cells in lines[1:]:
        if len(cells) != len(header):
            raise ValueError(f"{path} has {len(cells)} cells in line {number}, and {len(header)} columns.")
    return {
        name: np.array([_number(path, name, number, cells[k]) for number, cells in lines[1:]], float)
        for k, name in enumerate(header)
    }


def _number(path, column, line, cell) -> float:
    cell = cell.strip()
    if cell.lower() in _MISSING:
        return np.nan
    try:
        return float(cell)
    except ValueError:
        raise ValueError(f"{path} has no number in line {line} of column {column!r}, but {cell!r}.") from None


def _of_frame(frame: Any) -> dict[str, np.ndarray]:
    names = [str(name) for name in getattr(frame, "columns", ())]
    if not names:
        raise ValueError(f"Measurements must be the path of a CSV file or a table with columns, got {frame!r}.")
    if len(set(names)) < len(names):
        raise ValueError("The table has columns of the same name.")
    out = {}
    for name, column in zip(names, frame.columns, strict=True):
        try:
            out[name] = np.asarray(frame[column].to_numpy(), float)
        except (TypeError, ValueError):
            raise ValueError(f"Column {name!r} of the table contains a value that is not a number.") from None
    return out


def _of_dataset(dataset: Any, time: str) -> dict[str, np.ndarray]:
    if time not in dataset.coords:
        raise unknown("coordinate of time", time, map(str, dataset.coords))
    out = {time: np.asarray(dataset[time].to_numpy(), float)}
    for name, variable in dataset.data_vars.items():
        if time not in variable.dims or variable.ndim > 2:
            raise ValueError(
                f"The variable {name!r} of the Dataset must have the dimension {time!r} and at most one more, got "
                f"{', '.join(map(str, variable.dims)) or 'none'}; dataset[[name, …]] chooses variables."
            )
        out[str(name)] = np.asarray(variable.transpose(time, ...).to_numpy(), float)
    return out
