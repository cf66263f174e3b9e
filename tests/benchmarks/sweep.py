"""Sweeps: cost over a bare `jax.vmap`, the cores of one process, and whole studies from the command line.

Run it with `NPROC=1 python tests/benchmarks/sweep.py overhead`; with `cores`, without `NPROC`, to compare the cores of
one process; and the studies with
`MEMBERS=100000 jaxmb sweep tests/benchmarks/sweep_four_bar.py --out four_bar.zarr --processes 2` and
`MEMBERS=2000 jaxmb sweep tests/benchmarks/sweep_vehicle.py --out vehicle.zarr --processes 2`.
"""

import functools
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

# Before the four-bar is made, also in worker processes.
os.environ["JAX_ENABLE_X64"] = "1"

import jax
import numpy as np
from sweep_four_bar import four_bar

import jaxmb as mb
from jaxmb.studies.sweep.chunk import Job, Task, Work
from jaxmb.studies.sweep.outputs import declared

# Members of a chunk, and how often a time is taken.
CHUNK, REPEATS = 512, 8


def fastest(*runs, repeats=REPEATS, clock=time.process_time):
    """The shortest time of each of several runs, which take turns; of the processor, which others may use as well."""
    best = np.full(len(runs), np.inf)
    for _ in range(repeats):
        for k, run in enumerate(runs):
            start = clock()
            jax.block_until_ready(run())
            best[k] = min(best[k], clock() - start)
    return best


def timed(run):
    start = time.perf_counter()
    jax.block_until_ready(run())
    return time.perf_counter() - start


def work_of(function, columns, store=None):
    """Chunks of members, as a sweep computes and keeps them."""
    outputs, _ = declared(function, {name: column[0] for name, column in columns.items()})
    return Work(Job(function, outputs, CHUNK, store), Task(0, columns))


def overhead(chunks=4):
    """Chunks of a sweep, computed and written, against a bare `jax.vmap` of the function, and against a single run."""
    folder = tempfile.mkdtemp()
    store = Path(folder) / "runs.zarr"
    cases = mb.cases.table(length=np.linspace(0.8, 1.1, chunks * CHUNK), t1=np.full(chunks * CHUNK, 0.5))
    bare = jax.jit(jax.vmap(lambda length, t1: {"angle": four_bar(length, t1)["angle"]}))
    parts = [cases[slice(k * CHUNK, (k + 1) * CHUNK)] for k in range(chunks)]
    begin = time.perf_counter()
    mb.sweep(four_bar, cases, store, chunk=CHUNK, progress=False)
    print(f"the whole sweep with compiling: {time.perf_counter() - begin:.1f} s")
    work = work_of(four_bar, parts[0], store)
    swept = lambda: [work(Task(k, part)) for k, part in enumerate(parts)] and None
    plain = lambda: [np.asarray(bare(**part)["angle"]) for part in parts]
    swept(), plain()
    times = fastest(swept, plain)
    print(f"{chunks} chunks: sweep {times[0]:.3f} s, bare vmap {times[1]:.3f} s, ratio {times[0] / times[1]:.3f}")
    single = jax.jit(lambda length, t1: four_bar(length, t1)["angle"])
    first = {k: v[0] for k, v in cases.columns.items()}
    single(**first)
    (alone,) = fastest(lambda: [single(**first) for _ in range(20)])
    shutil.rmtree(folder)
    print(f"a member {1e3 * times[0] / len(cases):.3f} ms, a single run {1e3 * alone / 20:.3f} ms")


def cores():
    """A chunk in one thread and in as many as there are cores, and the loop of single runs, in wall time."""
    cases = {
        "four_bar": ({}, 2.0),
        "andrews": ({}, 0.02),
        "rod_chain": ({"n": 10}, 0.3),
        "bricard": ({}, 0.3),
        "tracked_vehicle": ({}, 0.05),
    }
    print("wall seconds of 512 members: one thread, all cores, ratio; a loop of single runs")
    for name, (given, t1) in cases.items():
        machine = mb.mechanisms.get(name, **given)
        mass = next(key for key in mb.parameters(machine.system) if key.endswith(".mass"))
        whole = mb.parameters(machine.system)[mass]

        def of_mass(x, machine=machine, mass=mass, whole=whole, t1=t1):
            changed = mb.with_parameters(machine.system, {mass: whole * x})
            motion = mb.simulate(changed, machine.state, t1=t1, rtol=1e-8, max_steps=100_000, throw=False)
            return {"q": motion.ys.q[-1], "result": motion}

        columns = {"x": np.linspace(0.9, 1.1, CHUNK)}
        run = work_of(of_mass, columns)
        single = jax.jit(lambda x, own=of_mass: own(x)["q"])
        some = [single(x) for x in columns["x"][:1]] and columns["x"][:: CHUNK // 32]

        def in_threads(count, run=run, columns=columns):
            os.environ["NPROC"] = str(count)
            return run(Task(0, columns))["q"]

        forms = [
            (in_threads, 1),
            (in_threads, os.cpu_count()),
            (lambda some, single=single: list(map(single, some)), some),
        ]
        times = [min(timed(functools.partial(*form)) for _ in range(4)) for form in forms]
        loop = times[2] * CHUNK / len(some)
        print(f"{name:16} {times[0]:7.3f} {times[1]:7.3f} {times[0] / times[1]:6.2f} {loop:9.3f}", flush=True)


if __name__ == "__main__":
    {"overhead": overhead, "cores": cores}[sys.argv[1]]()
