"""The store of a sweep: a zarr group with one array for each output, whose chunks are those of the sweep."""

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
    be killed at any moment.
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
        key = array.metadata.encode_chunk_key((index, *(0 for _ in array.shape[1:])))
        if not (Path(array.store.root) / array.path / key).exists():
            return None
        try:
            return np.asarray(array[self._members(index)])
        # What a damaged file raises is up to the codec.
        except Exception as error:
            raise ValueError(f"{name!r}: {error}") from error


def create(path: Path, described: Mapping[str, Any], attributes: Mapping[str, Any], chunk: int) -> None:
    """Make a store with all coordinates and no results, in one step: it is there as a whole or not at all."""
    zarr, codecs = packages("zarr", "zarr.codecs")
    path.parent.mkdir(parents=True, exist_ok=True)
    made = path.with_name(f"{path.name}.{uuid.uuid4().hex}.partial")
    try:
        group = zarr.create_group(made, zarr_format=3, attributes=dict(attributes))
        for name, (dims, values, shape, attrs) in described.items():
            computed = isinstance(values, np.dtype)
            dtype = values if computed else values.dtype
            array = group.create_array(
                name,
                shape=shape,
                # An axis of length zero has chunks of one.
                chunks=tuple(max(size, 1) for size in ((chunk, *shape[1:]) if computed else shape)),
                dtype=dtype,
                fill_value=np.nan if dtype.kind in "fc" else dtype.type(0),
                compressors=[codecs.ZstdCodec(level=0), codecs.Crc32cCodec()],
                dimension_names=dims,
                attributes=attrs,
            )
            if not computed:
                array[...] = values
        with warnings.catch_warnings():
            # The metadata of all arrays in one file, which xarray looks for, is an extension of format 3.
            warnings.filterwarnings("ignore", message="Consolidated metadata")
            zarr.consolidate_metadata(made)
        os.replace(made, path)
    except BaseException:
        shutil.rmtree(made, ignore_errors=True)
        raise


def study_of(path: Path) -> dict[str, Any] | None:
    """The attributes of a store; None if there is nothing at its path.

    **Raises:** `ValueError` for a file, and for a folder that is no store of a sweep.
    """
    if not path.exists():
        return None
    try:
        attributes = json.loads((path / "zarr.json").read_text())["attributes"]
        if "function" in attributes and "chunk" in attributes:
            return attributes
    except (OSError, KeyError, ValueError):
        pass
    raise ValueError(f"{path} is there and holds no sweep; give another path as store.")


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
