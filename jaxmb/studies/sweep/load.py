"""The result of a sweep from its store."""

from pathlib import Path
from typing import Any

from . import store as stores
from .dataset import packages, unstacked


def load_sweep(store: str | Path) -> Any:
    """Read the result of a sweep, also while it runs.

    ```python
    runs = jaxmb.load_sweep("runs.zarr")
    int((runs["status"] == 1).sum())  # How many members are computed.
    ```

    **Arguments:** `store`, the folder that `sweep` was given.

    **Returns:** an `xarray.Dataset` like the result of `sweep`. Members that are not computed yet have status 0 and are
    NaN, or zero in an output of integers. A sweep over a grid has a dimension for each parameter and is read as a
    whole. A list of members is read on access. `xarray.open_zarr(store)` gives the same variables along the one
    dimension `member`.

    **Raises:** `ValueError` for a folder that holds no sweep, and for a store that cannot be read or has lost files of
    computed members; `ImportError` without the packages of `jaxmb[studies]`.
    """
    packages("xarray", "zarr")
    path = Path(store)
    if stores.study_of(path) is None:
        raise ValueError(f"{store} holds no sweep; the folder is not there.")
    with stores.readable(path):
        return unstacked(opened(path))


def opened(path: Path, read: bool = False) -> Any:
    """A store as a dataset along the dimension `member`, after a check of its files; `read`: whether the check reads
    them.
    """
    (xarray,) = packages("xarray")
    dataset = xarray.open_zarr(path, chunks=None)
    stores.check_files(path, dataset["status"].to_numpy(), read)
    return dataset
