"""Cost of a member-step in blocks of a batch, over that of a step of a single run, on one core.

Run it with `python tests/benchmarks/batches.py [mechanism ...]`, by default all; `--sizes 1 8 256` of blocks. The
masses of members differ by up to a fifth. Each program computes the same members; times are those of the processor,
the shortest of several, in turns. `--json FILE` adds a line for each mechanism.
"""

import argparse
import json
import os
import platform
import time
from pathlib import Path

# One core, and one thread of XLA, before JAX starts.
os.environ["NPROC"] = "1"
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})

import jax
import numpy as np

import jaxmb as mb

jax.config.update("jax_enable_x64", True)

SIZES = (1, 4, 8, 16, 32, 64, 256)
MEMBERS, REPEATS, SECONDS, RTOL = 256, 3, 12.0, 1e-8
# The end of the motion, long enough for some hundred steps, and the largest ratio in blocks as chosen.
CASES = {
    "four_bar": ({}, 1.0, 0.35),
    "andrews": ({}, 0.01, 0.6),
    "heavy_top": ({}, 0.3, 0.8),
    "rod_chain10": ({"n": 10}, 0.3, 0.8),
    "bricard": ({}, 1.0, 0.8),
    "tracked_vehicle": ({}, 0.1, 0.8),
    "cable20": ({"n": 20}, 0.05, 1.0),
    "rod_chain100": ({"n": 100}, 0.1, 1.0),
    "tree127": ({"n": 127}, 0.1, 1.0),
}


def machine():
    """The processor's name, its caches and the versions that compile for it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    name = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.processor())
    return f"{name}, {os.cpu_count()} cores, one used; jax {jax.__version__}, jaxlib {jax.lib.__version__}"


def member_of(name):
    """The run of a member, from factors of the masses to its end and number of steps; and the factors of all."""
    parameters, t1, _ = CASES[name]
    mechanism = mb.mechanisms.get(name.rstrip("0123456789"), **parameters)
    masses = {key: value for key, value in mb.parameters(mechanism.system).items() if key.endswith(".mass")}

    def member(factors):
        changed = {key: value * factor for (key, value), factor in zip(masses.items(), factors, strict=True)}
        system = mb.with_parameters(mechanism.system, changed)
        sol = mb.simulate(system, mechanism.state, t1=t1, rtol=RTOL, throw=False)
        return sol.ys, sol.stats["num_steps"]

    return member, np.random.default_rng(0).uniform(0.8, 1.2, (MEMBERS, len(masses)))


def measured(name, sizes):
    """Seconds of a member-step of the single run and of each block size, and seconds to compile."""
    member, factors = member_of(name)
    single, first = jax.jit(member), np.asarray(factors[0])
    programs, seconds = {}, {}
    for size in (None, *sizes):
        start = time.perf_counter()
        function, like = (single, first) if size is None else (jax.jit(jax.vmap(member)), factors[:size])
        programs[size] = function.lower(like).compile()
        seconds[size] = time.perf_counter() - start

    def run(size):
        """The steps of all members, and the time for them."""
        if size is None:
            start = time.process_time()
            found = [programs[None](own) for own in factors[:8]]
        else:
            groups = max(16 // size, 1)
            parts = [factors[k * size : (k + 1) * size] for k in range(groups)]
            start = time.process_time()
            found = [programs[size](own) for own in parts]
        jax.block_until_ready(found)
        return time.process_time() - start, sum(int(np.sum(steps)) for _, steps in found)

    best, begin, rounds = dict.fromkeys(programs, np.inf), time.perf_counter(), 0
    while rounds < REPEATS or time.perf_counter() - begin < SECONDS:
        for size in programs:
            spent, steps = run(size)
            best[size] = min(best[size], spent / steps)
        rounds += 1
    return best, seconds, steps / max(sizes)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(CASES))
    parser.add_argument("--sizes", nargs="*", type=int, default=SIZES)
    parser.add_argument("--json")
    options = parser.parse_args()
    print(machine())
    print(f"{'':16}{'steps':>6}{'µs a step':>11}" + "".join(f"{size:>8}" for size in options.sizes) + "   compiled in")
    for name in options.names:
        best, seconds, steps = measured(name, options.sizes)
        ratios = [best[size] / best[None] for size in options.sizes]
        times = f"{seconds[None]:.0f} s, {seconds[max(options.sizes)]:.0f} s"
        row = "".join(f"{ratio:8.2f}" for ratio in ratios)
        print(f"{name:16}{steps:6.0f}{1e6 * best[None]:11.2f}{row}   {times}", flush=True)
        if options.json:
            with open(options.json, "a") as file:
                found = {"single": best[None], "steps": steps, "ratios": dict(zip(options.sizes, ratios, strict=True))}
                file.write(json.dumps({"name": name, "seconds": list(seconds.values()), **found}) + "\n")


if __name__ == "__main__":
    main()
