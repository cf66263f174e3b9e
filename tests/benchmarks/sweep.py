"""Sweeps: cost over a bare `jax.vmap`, a batch with members that fail and that take long, devices against processes,
and whole studies from the command line.

Run it with `NPROC=1 python tests/benchmarks/sweep.py overhead | long | devices`, with `cores` and without `NPROC` to
compare the cores of one process, and the studies with
`MEMBERS=100000 jaxmb sweep tests/benchmarks/sweep_four_bar.py --out four_bar.zarr --processes 2` and
`MEMBERS=2000 jaxmb sweep tests/benchmarks/sweep_vehicle.py --out vehicle.zarr --processes 2`.
"""

import dataclasses
import functools
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

# Before the four-bar is made, also in worker processes.
os.environ["JAX_ENABLE_X64"] = "1"
if sys.argv[1:] == ["devices"]:
    os.environ["XLA_FLAGS"] = "--xla_force_host_platform_device_count=2"
    os.environ["NPROC"] = "4"

import jax
import numpy as np
from sweep_four_bar import four_bar

import jaxmb as mb
from jaxmb.studies.sweep import engine
from jaxmb.studies.sweep.batch import Batch, cheapest_budget
from jaxmb.studies.sweep.outputs import declared, statuses

# Members of the batch with some that take long, of a chunk as sweeps have it, and of a block.
CHUNK, DEFAULT, SIZE, REPEATS = 256, 512, 64, 8
LONG, FAILED = [17, 101, 202], [40, 90, 250]


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


def batch_of(cases, **options):
    outputs, _ = declared(four_bar, {k: v[0] for k, v in cases.columns.items()}, max_steps=65536)
    return Batch(four_bar, outputs, **options)


def overhead(chunks=4):
    """Chunks of a sweep, computed and written, against a bare `jax.vmap` of the function, and against a single run."""
    folder = tempfile.mkdtemp()
    store = Path(folder) / "runs.zarr"
    cases = mb.cases.table(length=np.linspace(0.8, 1.1, chunks * DEFAULT), t1=np.full(chunks * DEFAULT, 0.5))
    bare = jax.jit(jax.vmap(lambda length, t1: {"angle": four_bar(length, t1)["angle"]}))
    parts = [cases[slice(k * DEFAULT, (k + 1) * DEFAULT)] for k in range(chunks)]
    begin = time.perf_counter()
    mb.sweep(four_bar, cases, store, chunk=DEFAULT, budget=None, progress=False)
    print(f"the whole sweep with compiling: {time.perf_counter() - begin:.1f} s")
    work = engine.Work(batch_of(cases, chunk=DEFAULT, max_steps=65536), store)
    swept = lambda: [work(engine.Task(k, part, 0)) for k, part in enumerate(parts)] and None
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


def long():
    """256 members, 3 of which fail and 3 of which take ten times the steps, against the good ones alone."""
    length, t1 = np.linspace(0.8, 1.1, CHUNK), np.full(CHUNK, 2.0)
    good = {"length": length, "t1": t1}
    length, t1 = length.copy(), t1.copy()
    t1[LONG], length[FAILED] = 20.0, 9.0
    mixed = mb.cases.table(length=length, t1=t1)
    full = batch_of(mixed, chunk=CHUNK, max_steps=65536)
    alone = full.compiled()
    steps = np.asarray(alone(good).steps)
    budget, _ = cheapest_budget(np.asarray(alone(mixed.columns).steps), SIZE)
    run = dataclasses.replace(full, budget=budget).compiled()
    found = run(mixed.columns)
    words = [full.outputs.statuses[code][0] for code in statuses(found)]
    own = np.asarray(found.steps)
    print(f"budget {budget}, steps of the good {steps.min()} to {steps.max()}, of the long {own[LONG]}")
    print(f"failed: {sorted({words[k] for k in FAILED})}, steps {own[FAILED]}")
    times = fastest(lambda: run(mixed.columns), lambda: alone(good), lambda: alone(mixed.columns))
    print(f"with a budget {times[0]:.3f} s, the good alone {times[1]:.3f} s, mixed without a budget {times[2]:.3f} s")
    print(f"ratio {times[0] / times[1]:.2f}, without a budget {times[2] / times[1]:.2f}")


def devices(chunks=8):
    """Two devices against two processes, each with its compiled programs, and against one device."""
    import concurrent.futures as futures
    import multiprocessing

    size = 2 * CHUNK
    cases = mb.cases.table(length=np.linspace(0.8, 1.1, chunks * size), t1=np.full(chunks * size, 0.5))
    parts = [cases[slice(k * size, (k + 1) * size)] for k in range(chunks)]
    two = batch_of(cases, chunk=size, max_steps=65536, devices=tuple(jax.devices()[:2])).compiled()
    on_devices = lambda: [two(part) for part in parts] and None
    print(f"first run on devices {timed(on_devices):.1f} s")
    context = multiprocessing.get_context("spawn")
    os.environ.pop("XLA_FLAGS")
    os.environ["NPROC"] = "1"
    with futures.ProcessPoolExecutor(2, mp_context=context) as pool:
        halves = [{k: v[j * CHUNK : (j + 1) * CHUNK] for k, v in part.items()} for part in parts for j in (0, 1)]
        on_processes = lambda: list(pool.map(in_process, halves)) and None
        print(f"first run on processes {timed(on_processes):.1f} s")
        times = fastest(on_devices, on_processes, clock=time.perf_counter)
    print(f"devices {times[0]:.3f} s, processes {times[1]:.3f} s, ratio {times[0] / times[1]:.2f}")


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

        columns = {"x": np.linspace(0.9, 1.1, DEFAULT)}
        run = Batch(of_mass, declared(of_mass, {"x": columns["x"][0]})[0], DEFAULT).compiled()
        single = jax.jit(lambda x, own=of_mass: own(x)["q"])
        some = [single(x) for x in columns["x"][:1]] and columns["x"][:: DEFAULT // 32]

        def in_threads(count, run=run, columns=columns):
            os.environ["NPROC"] = str(count)
            return run(columns).values["q"]

        forms = [
            (in_threads, 1),
            (in_threads, os.cpu_count()),
            (lambda some, single=single: list(map(single, some)), some),
        ]
        times = [min(timed(functools.partial(*form)) for _ in range(4)) for form in forms]
        loop = times[2] * DEFAULT / len(some)
        print(f"{name:16} {times[0]:7.3f} {times[1]:7.3f} {times[0] / times[1]:6.2f} {loop:9.3f}", flush=True)


_run = []


def in_process(columns):
    """A chunk in a worker, whose program is compiled once."""
    if not _run:
        _run.append(batch_of(mb.cases.table(columns), chunk=CHUNK, max_steps=65536).compiled())
    return np.asarray(_run[0](columns).values["angle"])


if __name__ == "__main__":
    {"overhead": overhead, "long": long, "devices": devices, "cores": cores}[sys.argv[1]]()
