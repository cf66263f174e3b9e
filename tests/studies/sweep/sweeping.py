"""A small study, importable by worker processes, and what tests do with its store."""

import multiprocessing
import os
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxmb as mb

CASES = mb.cases.table(a=np.linspace(1.0, 5.0, 801), b=np.cos(np.arange(801.0)))
CHUNK = 10
CHUNKS = 81


def spring(a, b):
    """Cheap, of several shapes, and not a number in some members."""
    ts = jnp.arange(4.0)
    wave = jnp.exp(-ts / a) * jnp.cos(a * ts + b)
    return {"wave": wave, "more": {"square": jnp.sqrt(a - 1.5) * b, "count": jnp.int32(a)}}


def run(store, **options):
    jax.config.update("jax_enable_x64", True)
    return mb.sweep(spring, CASES, store, chunk=CHUNK, progress=False, **options)


def files(store: Path) -> dict[str, bytes]:
    """Every file of a store by its place in it."""
    return {str(p.relative_to(store)): p.read_bytes() for p in store.rglob("*") if p.is_file()}


def marks(store: Path) -> int:
    """The number of chunks that are done."""
    folder = store / "status" / "c"
    return sum("partial" not in name for name in os.listdir(folder)) if folder.exists() else 0


def wait_for(store: Path, count: int, seconds: float = 120.0) -> None:
    """Wait until so many chunks are done."""
    end = time.monotonic() + seconds
    while marks(store) < count:
        assert time.monotonic() < end, "the sweep does not go on"
        time.sleep(0.001)


def forked():
    """Quick new processes, of which none has inherited anything from this one."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["sweeping"])
    return context
