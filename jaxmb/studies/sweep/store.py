"""The store of a sweep: a zarr group with one array for each output, whose chunks are the chunks of the sweep."""

import contextlib
import json
import os
import shutil
import uuid
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .cases import MEMBER
from .dataset import Variable, packages
from .outputs import PENDING


class Store:
    """A folder that any number of processes write to, each chunk by one of them.

    A chunk of an output is one file with a checksum. zarr writes it beside its place and then moves it there. The file
    of `status` is written last: a chunk without it is not done. So a process may be killed at any moment. Two sweeps do
    not write one store at once: see `alone`.
    """

    def __init__(self, path: Path, chunk: int):
        (zarr,) = packages("zarr")
        self._chunk = chunk
        # A chunk of fill values is written as well, or it could not be told from a chunk that is lost.
        with zarr.config.set({"array.write_empty_chunks": True}):
            self._arrays = dict(zarr.open_group(path, mode="r+").arrays())

    def write(self, index: int, values: Mapping[str, np.ndarray]) -> None:
        """Write a chunk: its values by name, of which the `status` comes last."""
        members = slice(index * self._chunk, index * self._chunk + values["status"].size)
        for name, own in values.items():
            self._arrays[name][members] = own


def create(path: Path, described: Mapping[str, Variable], attributes: Mapping[str, Any], chunk: int) -> None:
    """Make a store with all coordinates and no results, in one step: it is there as a whole or not at all.

    **Raises:** `RuntimeError` if another process has made it in the meantime.
    """
    (zarr,) = packages("zarr")
    path.parent.mkdir(parents=True, exist_ok=True)
    made = _beside(path)
    try:
        group = zarr.create_group(made, zarr_format=3, attributes=dict(attributes))
        # Coordinates of fill values are written as well, or they could not be told from lost ones.
        with zarr.config.set({"array.write_empty_chunks": True}):
            for name, variable in described.items():
                _add(group, name, variable, chunk)
        with warnings.catch_warnings():
            # The metadata of all arrays in one file, which readers look for, is an extension of format 3.
            warnings.filterwarnings("ignore", message="Consolidated metadata")
            zarr.consolidate_metadata(made)
        try:
            os.replace(made, path)
        except OSError as error:
            # A folder can only be moved to where there is nothing, or an empty folder.
            raise _in_use(path) if (path / "zarr.json").exists() else error from None
    except BaseException:
        shutil.rmtree(made, ignore_errors=True)
        raise


def _add(group: Any, name: str, variable: Variable, chunk: int) -> None:
    """Add the array of a variable to a group, with its values if they are known."""
    (codecs,) = packages("zarr.codecs")
    dims, values, shape, attributes = variable
    dtype = values if isinstance(values, np.dtype) else values.dtype
    array = group.create_array(
        name,
        shape=shape,
        # An axis of length zero has chunks of one.
        chunks=tuple(max(size, 1) for size in ((chunk, *shape[1:]) if variable.is_output else shape)),
        dtype=dtype,
        fill_value=np.nan if dtype.kind in "fc" else dtype.type(0),
        compressors=[codecs.ZstdCodec(level=0), codecs.Crc32cCodec()],
        dimension_names=dims,
        attributes=attributes,
    )
    if not variable.is_output:
        array[...] = values


def check_files(path: Path, status: np.ndarray, read: bool) -> None:
    """Raise an error for files of coordinates and computed members that are lost, or, if they are `read`, damaged."""
    (zarr,) = packages("zarr")
    group = zarr.open_group(path, mode="r")
    computed = np.flatnonzero(status != PENDING)
    for name, array in group.arrays():
        is_output = array.metadata.dimension_names[0] == MEMBER and name not in group.attrs["coordinates"].split()
        size = array.chunks[0]
        # Outputs are not there before they are computed.
        places = np.unique(computed // size) if is_output else range(-(-array.shape[0] // size))
        for place in map(int, places if array.size else ()):
            members = slice(place * size, min((place + 1) * size, array.shape[0]))
            what, file = repr(name), array.metadata.encode_chunk_key((place, *(0 for _ in array.shape[1:])))
            if is_output:
                cure = f"without the file status/c/{place} these alone are computed again"
                what = f"{name!r} of the members {members.start} to {members.stop - 1} ({cure})"
            if not (path / array.path / file).exists():
                raise FileNotFoundError(f"there is no {what}")
            try:
                array[members] if read else None
            except Exception as error:  # What a damaged file raises is up to the codec.
                raise ValueError(f"{what}: {error}") from error


@contextlib.contextmanager
def readable(path: Path) -> Iterator[None]:
    """Raise a `ValueError` that says that a store is damaged, for any error in reading it."""
    try:
        yield
    except Exception as error:  # What files that were changed raise is up to zarr and xarray.
        reason = f"{type(error).__name__}: {next(iter(str(error).splitlines()), '')}".rstrip(". ")
        raise ValueError(
            f"The store {path} is damaged: {reason}. The same sweep with overwrite=True computes all of it again."
        ) from error


@contextlib.contextmanager
def alone(path: Path) -> Iterator[None]:
    """Keep other processes from writing a store, by a lock that ends with this process at the latest.

    **Raises:** `RuntimeError` if another process writes it.
    """
    metadata = path / "zarr.json"
    # A store that is only read again may be on a disk that cannot be written.
    with open(metadata, "r+b" if os.access(metadata, os.W_OK) else "rb") as file:
        try:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise _in_use(path) from None
        except (ImportError, OSError):
            pass  # Some systems and file systems have no locks.
        yield


def study_of(path: Path) -> dict[str, Any] | None:
    """The attributes of a store; None if there is nothing at its path.

    **Raises:** `ValueError` for a file, for a folder that is not the store of a sweep, and for attributes that were
    changed.
    """
    if not path.exists():
        return None
    try:
        attributes = json.loads((path / "zarr.json").read_text())["attributes"]
        is_sweep = "function" in attributes
        if is_sweep and not (isinstance(attributes["chunk"], int) and attributes["chunk"] > 0):
            raise TypeError(f"chunk is {attributes['chunk']!r}")
    except OSError:
        is_sweep, attributes = False, {}
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        reason = f"zarr.json cannot be used ({type(error).__name__}: {error})"
        raise ValueError(f"The store {path} is damaged: {reason}. Remove the folder, or give another path.") from error
    if not is_sweep:
        raise ValueError(f"{path} is there and holds no sweep; give another path as store.")
    return attributes


def remove(path: Path) -> None:
    """Remove a store that no other process writes."""
    with alone(path):
        removed = _beside(path)
        os.replace(path, removed)
    shutil.rmtree(removed)


def remove_leftovers(path: Path) -> None:
    """Remove the files that killed processes were about to move to their places."""
    for left in path.rglob("*.partial"):
        left.unlink(missing_ok=True)


def _beside(path: Path) -> Path:
    return path.with_name(f"{path.name}.{uuid.uuid4().hex}.partial")


def _in_use(path: Path) -> RuntimeError:
    return RuntimeError(
        f"Another process is writing the store {path}. When it has ended, the same call goes on with what is left; "
        "load_sweep reads what is done. To compute at the same time, give another path."
    )
