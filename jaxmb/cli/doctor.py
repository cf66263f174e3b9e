"""`jaxmb doctor`: the machine, its installed packages, and, with `--measure`, the times of first calls and steps."""

import argparse
import functools
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
import tempfile
import textwrap
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from .. import mechanisms
from .._faulty_versions import fault_of
from .._kept_traces import TRACE
from .._machine import cores, limit_of_threads
from .._results import RESULTS
from .._setup import VARIABLE, kept_in
from .._version import __version__
from ..report.table import aligned
from ..report.timing import interleaved
from ..simulate import simulate

_NEEDED = ("jax", "jaxlib", "diffrax", "equinox", "optimistix", "numpy")
# The packages of each extra.
_OPTIONAL = {
    "docs": ("furo", "myst-nb", "sphinx"),
    "plot": ("matplotlib",),
    "view": ("viser",),
    "import": ("mujoco",),
    "studies": ("cloudpickle", "xarray", "zarr"),
}
_STEPPED = ("four_bar", "andrews", "rod_chain", "tracked_vehicle")
_RTOL, _REPEATS = 1e-8, 5
# Waiting times in a new process [s]: imports, and for some machines the first value with its scene, the first gradient,
# and the second call of each.
_FIRST_CALLS = """
import time
times = [time.perf_counter()]
done = lambda: times.append(time.perf_counter())
import diffrax, jax
done()
import jaxmb as mb
mb.simulate, mb.Scene
done()
mb.setup()
stop = mb.Stop("stop", "slide.displacement", lower=0.3, restitution=0.5)
machines = [
    ("four_bar", "coupler", [], None),
    ("spatial_slider_crank", "slider", [], None),
    ("slider_crank", "slider", [stop], None),
    ("stiff_four_bar", "coupler", [], mb.solvers.Hermite()),
]
spans = []
for name, body, joints, solver in machines:
    done()
    machine = mb.mechanisms.get(name)
    system = machine.scene.extended(joints=joints).compile() if joints else machine.system
    start = mb.assemble(system, fix=machine.fix, rates=machine.rates) if joints else machine.state
    t1 = 0.02 if solver else machine.t1 / 10

    def end(mass):
        own = mb.with_parameters(system, {body + ".mass": mass})
        state = mb.assemble(own, start)
        return mb.simulate(own, state, t1=t1, rtol=1e-8, solver=solver, throw=False).ys.u[-1, 0]

    mass = float(mb.parameters(system)[body + ".mass"])
    for call in (end, jax.grad(end)):
        for _ in range(2):
            call(mass).block_until_ready()
            done()
import json
print(json.dumps([after - before for before, after in zip(times, times[1:])]))
"""
# The indices of the table's rows among the printed durations.
_SHOWN = {"import jax, diffrax": 0, "import jaxmb": 1} | {
    f"{name}: {call}": 3 + 5 * k + place
    for k, name in enumerate(("four_bar", "spatial_slider_crank", "slider_crank with a stop", "stiff_four_bar"))
    for call, place in {"first value": 0, "first gradient": 2, "another value": 1, "another gradient": 3}.items()
}
# The format of facts. Names and paths are not broken, so that they can be copied.
_INDENT = 18
_FILLED = textwrap.TextWrapper(80, subsequent_indent=" " * _INDENT, break_long_words=False, break_on_hyphens=False)


def add_to(commands: Any) -> None:
    """Add the command to a parser's commands."""
    command = commands.add_parser(
        "doctor",
        help="show installed packages, the cache of compiled programs, and, with --measure, waiting times here",
    )
    command.add_argument("--measure", action="store_true", help="measure first calls and steps, some minutes")
    command.add_argument("--quick", action="store_true", help=argparse.SUPPRESS)
    command.set_defaults(command=_doctor)


def _doctor(arguments: argparse.Namespace) -> None:
    if arguments.quick:
        raise ValueError("`jaxmb doctor` is quick without --quick; --measure measures.")
    for name, text in _facts():
        print(_FILLED.fill(f"{name:{_INDENT}}{text}"))
    if not arguments.measure:
        return
    print(
        "\nCalls in a new process [s], values with their scenes; the second process finds the first one's programs in "
        "the cache:\n"
    )
    print("\n".join(aligned(_first_calls())))
    print(f"\nWarm steps under jit at rtol {_RTOL:g}, the shortest of {_REPEATS} runs:\n")
    print("\n".join(aligned(_steps())))


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
    sizes = {path.name: path.stat().st_size for path in folder.glob("*-cache")}
    bound = jax.config.jax_compilation_cache_max_size  # pyright: ignore[reportAttributeAccessIssue]
    used = f"{sum(sizes.values()) / 2**20:.1f}" + (f" of {bound / 2**20:.0f}" if bound > 0 else "")
    home = os.path.expanduser("~")
    shown = Path("~") / folder.relative_to(home) if folder.is_relative_to(home) else folder
    count = sum(not name.startswith(f"{TRACE}-") for name in sizes)
    return f"{count} in {shown}, {used} MiB"


def _first_calls() -> list[list[str]]:
    """The waiting times of two processes; the second finds the programs of the first in the cache."""
    with tempfile.TemporaryDirectory() as folder:
        kept = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
        environment = kept | {VARIABLE: folder}
        both = [_durations(environment) for _ in range(2)]
    rows = [[name, *(f"{durations[place]:.3f}" for durations in both)] for name, place in _SHOWN.items()]
    return [["", "first", "second"], *rows]


def _durations(environment: dict[str, str]) -> list[float]:
    run = subprocess.run([sys.executable, "-c", _FIRST_CALLS], env=environment, capture_output=True, text=True)
    if run.returncode:
        raise RuntimeError(f"A new process failed: {run.stderr.strip().splitlines()[-1]}")
    return json.loads(run.stdout)


def _steps() -> list[list[str]]:
    """The number of steps of some motions, and the time of a step."""
    motions = [mechanisms.get(name) for name in _STEPPED]
    runs = [functools.partial(_motion, single.system, single.state, single.t1) for single in motions]
    rows = [["", "bodies", "t1 [s]", "steps", "run [ms]", "step [µs]"]]
    for single, run, times in zip(motions, runs, interleaved(runs, _REPEATS), strict=True):
        stats, result, _ = run()
        if result != RESULTS.successful:
            raise RuntimeError(f"{single.name}: {RESULTS[result]}")
        steps, seconds = int(stats["num_steps"]), min(times)
        bodies = str(len(single.system.body_names))
        rows.append(
            [single.name, bodies, f"{single.t1:g}", str(steps), f"{1e3 * seconds:.1f}", f"{1e6 * seconds / steps:.1f}"]
        )
    return rows


@eqx.filter_jit
def _motion(system: Any, state: Any, t1: Any) -> Any:
    motion = simulate(system, state, t1=t1, rtol=_RTOL, throw=False)
    return motion.stats, motion.result, motion.ys
