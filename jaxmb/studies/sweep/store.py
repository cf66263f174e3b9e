"""The store of a sweep: a zarr group with one array for each output, whose chunks are those of the sweep."""

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
from .dataset import packages
from .outputs import PENDING


class Store:
    """A folder that any number of processes write to, each chunk by one of them.

    A chunk of an output is one file, which zarr writes beside its place and then moves there; it ends with a checksum.
    The file of `status` is written last and is the mark of a chunk: a chunk without it is not there. So a process may
    be killed at any moment. Two sweeps do not write one store at once: see `alone`.
    """

    def __init__(self, path: Path, chunk: int):
        (zarr,) = packages("zarr")
        self._chunk = chunk
        # A chunk that consists of fill values must be there as well, or it could not be told from one that is lost.
        with zarr.config.set({"array.write_empty_chunks": True}):
            group = zarr.open_group(path, mode="r+", use_consolidated=False)
            self._arrays = {
                name: array for name, array in group.arrays() if (array.metadata.dimension_names or ("",))[0] == MEMBER
            }
        coordinates = group.attrs["coordinates"].split()
        self._outputs = [name for name in self._arrays if name not in (*coordinates, "status")]

    def write(self, index: int, values: Mapping[str, np.ndarray]) -> None:
        """Write a chunk: all outputs, then the status of its members."""
        own = self._members(index)
        for name in (*self._outputs, "status"):
            self._arrays[name][own] = values[name]

    def read(self, index: int) -> dict[str, np.ndarray] | None:
        """A chunk's outputs and status; None if it is not done. Raises a `ValueError` if it is damaged."""
        status = self._block("status", index)
        if status is None or np.all(status == PENDING):
            return None
        found = {name: self._block(name, index) for name in self._outputs}
        missing = [name for name, values in found.items() if values is None]
        if missing:
            raise ValueError(f"the file of {missing[0]!r} is missing")
        return {**found, "status": status}  # pyright: ignore[reportReturnType]

    def _members(self, index: int) -> slice:
        return slice(index * self._chunk, min((index + 1) * self._chunk, self._arrays["status"].shape[0]))

    def _count(self, index: int) -> int:
        own = self._members(index)
        return own.stop - own.start

    def _block(self, name: str, index: int) -> np.ndarray | None:
        array = self._arrays[name]
        if array.size == 0:
            return np.zeros((self._count(index), *array.shape[1:]), array.dtype)
        if not _file(Path(array.store.root), array, index).exists():
            return None
        try:
            return np.asarray(array[self._members(index)])
        # What a damaged file raises is up to the codec.
        except Exception as error:
            raise ValueError(f"{name!r}: {error}") from error


def create(path: Path, described: Mapping[str, Any], attributes: Mapping[str, Any], chunk: int) -> None:
    """Make a store with all coordinates and no results, in one step: it is there as a whole or not at all.

    **Raises:** `RuntimeError` if another process has made it in the meantime.
    """
    (zarr,) = packages("zarr")
    path.parent.mkdir(parents=True, exist_ok=True)
    made = _beside(path)
    try:
        group = zarr.create_group(made, zarr_format=3, attributes=dict(attributes))
        for name, one in described.items():
            _add(group, name, one, chunk)
        with warnings.catch_warnings():
            # The metadata of all arrays in one file, which xarray looks for, is an extension of format 3.
            warnings.filterwarnings("ignore", message="Consolidated metadata")
            zarr.consolidate_metadata(made)
        try:
            os.replace(made, path)
        except OSError as error:
            # A folder takes the place of nothing, or of an empty folder.
            raise _in_use(path) if (path / "zarr.json").exists() else error from None
    except BaseException:
        shutil.rmtree(made, ignore_errors=True)
        raise


def mend(path: Path, described: Mapping[str, Any], chunk: int) -> None:
    """Write again what a store has lost besides results: the metadata of variables, and coordinates.

    **Raises:** `ValueError` for metadata that cannot be read or are those of other variables.
    """
    (zarr,) = packages("zarr")
    name = ""
    try:
        group = zarr.open_group(path, mode="r+", use_consolidated=False)
        for name, one in described.items():
            array = group[name] if name in group else _add(group, name, one, chunk)
            if _layout(array) != _layout(_add(zarr.create_group({}, zarr_format=3), name, one, chunk)):
                raise ValueError("they are those of another variable")
            if not isinstance(one[1], np.dtype) and not _holds(array, one[1]):
                array[...] = one[1]
    except OSError:
        raise
    # What other metadata raise is up to zarr.
    except Exception as error:
        raise damaged(path, f"the metadata of {name or 'its group'!r} cannot be used: {error}") from error


def lost(path: Path, status: np.ndarray) -> list[tuple[str, slice]]:
    """The chunks that are not there although they were written: the name of the variable, and the members."""
    (zarr,) = packages("zarr")
    group, found = zarr.open_group(path, mode="r"), []
    computed = np.flatnonzero(status != PENDING)
    for name, array in group.arrays():
        is_output = array.metadata.dimension_names[0] == MEMBER and name not in group.attrs["coordinates"].split()
        size = array.chunks[0]
        # Outputs are not there before they are computed.
        places = np.unique(computed // size) if is_output else range(-(-array.shape[0] // size))
        for place in places if array.size else ():
            if not _file(path, array, int(place)).exists():
                found.append((name, slice(int(place) * size, min((int(place) + 1) * size, array.shape[0]))))
    return found


@contextlib.contextmanager
def alone(path: Path) -> Iterator[None]:
    """Keep other processes from writing a store; the death of this process ends that as well.

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
            pass  # A system, or a file system, that has no locks.
        yield


def study_of(path: Path) -> dict[str, Any] | None:
    """The attributes of a store; None if there is nothing at its path.

    **Raises:** `ValueError` for a file, for a folder that is no store of a sweep, and for attributes that were changed.
    """
    if not path.exists():
        return None
    try:
        text = (path / "zarr.json").read_text()
    except OSError:
        raise ValueError(f"{path} is there and holds no sweep; give another path as store.") from None
    try:
        attributes = json.loads(text)["attributes"]
        if "function" not in attributes and "chunk" not in attributes:
            raise ValueError(f"{path} is there and holds no sweep, but another zarr store; give another path.")
        for name, kind in (("chunk", int), ("budget", int | None), ("grid", str), ("coordinates", str)):
            if not isinstance(attributes[name], kind) or (name == "chunk" and attributes[name] < 1):
                raise TypeError(f"{name} is {attributes[name]!r}")
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        reason = f"zarr.json cannot be used ({type(error).__name__}: {error})"
        raise ValueError(f"The store {path} is damaged: {reason}. Remove the folder, or give another path.") from error
    return attributes


def damaged(path: Path, reason: str) -> ValueError:
    """The error of a store whose files were changed or cannot be read."""
    return ValueError(
        f"The store {path} is damaged: {reason}. The same sweep with overwrite=True computes all of it again."
    )


def remove(path: Path) -> None:
    """Remove a store that no other process writes."""
    with alone(path):
        removed = _beside(path)
        os.replace(path, removed)
    shutil.rmtree(removed)


def chunks(store: Store, count: int) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """The chunks that are done, with a warning for each that is damaged, which is as one that is not done."""
    for index in range(count):
        try:
            found = store.read(index)
        except ValueError as error:
            warnings.warn(f"Chunk {index} of the store is damaged and is computed again: {error}.", stacklevel=4)
            continue
        if found is not None:
            yield index, found


def remove_leftovers(path: Path) -> None:
    """Remove the files that killed processes were about to move to their places."""
    for left in path.rglob("*.partial"):
        left.unlink(missing_ok=True)


def _add(group: Any, name: str, variable: tuple[Any, Any, Any, Any], chunk: int) -> Any:
    """Add the array of a variable to a group, with its values if they are known."""
    zarr, codecs = packages("zarr", "zarr.codecs")
    dims, values, shape, attributes = variable
    computed = isinstance(values, np.dtype)
    dtype = values if computed else values.dtype
    # Values that are those of an empty array are written as well, or they could not be told from values that are lost.
    with zarr.config.set({"array.write_empty_chunks": True}):
        array = group.create_array(
            name,
            shape=shape,
            # An axis of length zero has chunks of one.
            chunks=tuple(max(size, 1) for size in ((chunk, *shape[1:]) if computed else shape)),
            dtype=dtype,
            fill_value=np.nan if dtype.kind in "fc" else dtype.type(0),
            compressors=[codecs.ZstdCodec(level=0), codecs.Crc32cCodec()],
            dimension_names=dims,
            attributes=attributes,
        )
        if not computed:
            array[...] = values
    return array


def _layout(array: Any) -> tuple[Any, ...]:
    return array.shape, array.chunks, array.dtype, array.metadata.dimension_names


def _holds(array: Any, values: np.ndarray) -> bool:
    """Whether an array can be read and has these values."""
    try:
        return np.array_equal(array[...], values)
    except Exception:  # What a damaged file raises is up to the codec.
        return False


def _file(path: Path, array: Any, place: int) -> Path:
    """The file of a chunk of members."""
    return path / array.path / array.metadata.encode_chunk_key((place, *(0 for _ in array.shape[1:])))


def _beside(path: Path) -> Path:
    return path.with_name(f"{path.name}.{uuid.uuid4().hex}.partial")


def _in_use(path: Path) -> RuntimeError:
    return RuntimeError(
        f"Another process is writing the store {path}. When it has ended, the same call goes on with what is left; "
        "load_sweep reads what is done. To compute at the same time, give another path."
    )
