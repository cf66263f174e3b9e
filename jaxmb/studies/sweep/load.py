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

    **Returns:** an `xarray.Dataset` like that of `sweep`. A sweep over a grid has a dimension for each parameter of it
    and is read as a whole; of a list of members only what is looked at is read. `xarray.open_zarr(store)` gives the
    same variables along the one dimension `member`. Members that are not computed yet have status 0 and are NaN, or
    zero where an output is of integers.

    **Raises:** `ValueError` for a folder that holds no sweep, for a store that has lost files of members that were
    computed, with their names, and for one that cannot be read; `ImportError` without the packages of
    `jaxmb[studies]`.
    """
    (xarray,) = packages("xarray", "zarr")[:1]
    path = Path(store)
    if stores.study_of(path) is None:
        raise ValueError(f"{store} holds no sweep; the folder is not there.")
    try:
        dataset = xarray.open_zarr(path, chunks=None)
        lost = stores.lost(path, dataset["status"].to_numpy())
        read = None if lost else unstacked(dataset)
    # What files that were changed raise is up to zarr and xarray.
    except Exception as error:
        reason = f"it cannot be read ({type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''})"
        raise stores.damaged(path, reason) from error
    if lost:
        name, members = lost[0]
        more = f" and {len(lost) - 1} other chunks" if len(lost) > 1 else ""
        raise ValueError(
            f"The store {path} has lost {name!r} of the members {members.start} to {members.stop - 1}{more}, which "
            "were computed. The same call of sweep with this store computes what is lost, and only that."
        )
    return read
