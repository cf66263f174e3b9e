"""A folder of compiled programs that many processes share, in the format of JAX's persistent compilation cache."""

import contextlib
import os
import threading
import time
import warnings
from pathlib import Path

from ._compat import CacheInterface

# The store and the hash of the `program` that JAX asked for last, in each thread.
asked = threading.local()
# The endings that JAX appends to the hash of a program: for the program, and for a file written at each use.
_PROGRAM, _USED = "-cache", "-atime"
# The ending of a file that is being written; at this age [s] its process has died.
_NEW, _DEAD = ".new", 3600.0
# A process measures the folder when it has written this share of the bound.
_SHARE = 1 / 32


class KeptPrograms(CacheInterface):
    """Programs by their hashes, of at most `max_size` bytes together; no process waits for another one.

    JAX's class locks the folder, and reads the times of all programs whenever it writes one. A dozen processes that
    compile small programs then wait for longer than it allows, and warn each time. Here a complete program is renamed
    to its place, so it is read as a whole, without a lock. The programs unused for longest are dropped at times; until
    then each process that writes may exceed the bound of the folder by a 32nd.
    """

    def __init__(self, path: str, *, max_size: int):
        self._path, self._max_size = Path(path), max_size
        self._path.mkdir(parents=True, exist_ok=True)
        self._unseen: float = max_size
        self._can_write = True

    def get(self, key: str) -> bytes | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The program of this hash, None if there is none."""
        asked.program = self, key
        try:
            value = self._file(key, _PROGRAM).read_bytes()
        except FileNotFoundError:
            return None
        with contextlib.suppress(OSError):
            self._use(key)
        return value

    def put(self, key: str, value: bytes) -> None:
        """Keep a program, in place of an unreadable one. A folder that cannot be written to gives one warning."""
        if not self._can_write or len(value) > self._max_size >= 0:
            return
        self._unseen += len(value)
        try:
            if self._unseen > _SHARE * self._max_size >= 0:
                self._make_room(len(value))
                self._unseen = 0.0
            new = self._file(key, f"-{os.getpid()}-{threading.get_ident()}{_NEW}")
            new.write_bytes(value)
            self._use(key)
            new.replace(self._file(key, _PROGRAM))
        except OSError as error:
            self._can_write = False
            warnings.warn(f"compiled programs are not kept from now on: {error}.", stacklevel=2)

    def _file(self, key, ending):
        return self._path / f"{key}{ending}"

    def _use(self, key):
        self._file(key, _USED).write_bytes(time.time_ns().to_bytes(8, "little"))

    def _make_room(self, size):
        """Drop programs until there is room for one of this size."""
        files = {}
        with os.scandir(self._path) as entries:
            for file in entries:
                with contextlib.suppress(FileNotFoundError):
                    files[file.name] = file.stat()
        sizes = {name.removesuffix(_PROGRAM): file.st_size for name, file in files.items() if name.endswith(_PROGRAM)}
        used = {key: files.get(f"{key}{_USED}", files[f"{key}{_PROGRAM}"]).st_mtime for key in sizes}
        dropped = [name for name, file in files.items() if name.endswith(_NEW) and file.st_mtime < time.time() - _DEAD]
        total = sum(sizes.values()) + size
        for key in sorted(sizes, key=used.__getitem__):
            if total <= self._max_size:
                break
            total -= sizes[key]
            dropped += [f"{key}{_PROGRAM}", f"{key}{_USED}"]
        for name in dropped:
            # A file that another process reads stays on some systems.
            with contextlib.suppress(OSError):
                (self._path / name).unlink()
