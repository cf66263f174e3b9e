"""`jaxmb doctor`: the machine, its installed packages, and the cache of compiled programs."""

import argparse
import importlib.metadata
import os
import platform
import textwrap
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from .._faulty_versions import fault_of
from .._machine import cores, limit_of_threads
from .._setup import VARIABLE, kept_in
from .._version import __version__

_NEEDED = ("jax", "jaxlib", "diffrax", "equinox", "optimistix", "numpy")
# The packages of each extra.
_OPTIONAL = {
    "docs": ("furo", "myst-nb", "sphinx"),
    "plot": ("matplotlib",),
    "view": ("viser",),
    "import": ("mujoco",),
    "studies": ("cloudpickle", "xarray", "zarr"),
}
# The format of facts. Names and paths are not broken, so that they can be copied.
_INDENT = 18
_FILLED = textwrap.TextWrapper(80, subsequent_indent=" " * _INDENT, break_long_words=False, break_on_hyphens=False)


def add_to(commands: Any) -> None:
    """Add the command to a parser's commands."""
    command = commands.add_parser("doctor", help="show the machine, installed packages, and the cache of programs")
    command.set_defaults(command=_doctor)


def _doctor(arguments: argparse.Namespace) -> None:
    del arguments
    for name, text in _facts():
        print(_FILLED.fill(f"{name:{_INDENT}}{text}"))


def _facts() -> Iterable[tuple[str, str]]:
    """The machine and its installed packages."""
    yield "jaxmb", f"{__version__}, Python {platform.python_version()}"
    yield "needed", ", ".join(f"{name} {_version(name)}" for name in _NEEDED)
    for extra, names in _OPTIONAL.items():
        versions = {name: _version(name) for name in names}
        text = ", ".join(f"{name} {version or 'missing'}" for name, version in versions.items())
        yield f"for {extra}", text if all(versions.values()) else f'{text}; pip install "jaxmb[{extra}]"'
    yield "machine", f"{platform.system()} {platform.machine()}, {_processor()}, {_cores()}"
    faults = [fault for name in (*_NEEDED, *sum(_OPTIONAL.values(), ())) if (fault := fault_of(name))]
    if faults:
        yield "wrong numbers", "; ".join(faults)
    yield "shifted arrays", _shifts()
    devices = Counter((device.platform, device.device_kind) for device in jax.devices())
    yield "devices", ", ".join(f"{count} {name} ({kind})" for (name, kind), count in devices.items())
    yield "double precision", "on in commands; in Python by jaxmb.setup()"
    yield "kept programs", _kept()


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _shifts() -> str:
    """What XLA makes of an array that is shifted in place and then gets a new axis."""
    idiom = "b.at[1:].set(b[:-1]) with a new axis"
    if shifts_rightly():
        return f"{idiom} is right here"
    return f"{idiom} is wrong here, a fault of XLA: write jnp.concatenate([b[:1], b[:-1]])"


def shifts_rightly() -> bool:
    """Whether XLA shifts an array in place rightly if the result gets a new axis, alone and under `vmap`."""

    def shifted(x):
        b = x + 1
        return b.at[1:].set(b[:-1])[None]

    one, several = np.arange(8.0), np.arange(64.0).reshape(8, 8)
    right = lambda x: np.concatenate([x[..., :1], x[..., :-1]], axis=-1) + 1
    results = (jax.jit(shifted)(one)[0], right(one)), (jax.jit(jax.vmap(shifted))(several)[:, 0], right(several))
    return all(np.array_equal(found, expected) for found, expected in results)


def _processor() -> str:
    """The processor's name, on Linux from a file."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return next(iter(names), platform.processor() or "unknown processor")


def _cores() -> str:
    """The cores that this process may use."""
    count, limit, given = cores(), limit_of_threads(), os.environ.get("NPROC", "").strip()
    told = f", NPROC={given}, which is not a number: all of them" if given else ""
    return f"{count} core{'s' * (count > 1)}" + (told if limit is None else f"; computations take {limit}")


def _kept() -> str:
    folder = kept_in()
    if folder is None:
        told = os.environ.get(VARIABLE)
        return "none" + (f", {VARIABLE}={told}" if told else "")
    sizes = [path.stat().st_size for path in folder.glob("*-cache")]
    bound = jax.config.jax_compilation_cache_max_size  # pyright: ignore[reportAttributeAccessIssue]
    used = f"{sum(sizes) / 2**20:.1f}" + (f" of {bound / 2**20:.0f}" if bound > 0 else "")
    home = os.path.expanduser("~")
    shown = Path("~") / folder.relative_to(home) if folder.is_relative_to(home) else folder
    return f"{len(sizes)} in {shown}, {used} MiB"
