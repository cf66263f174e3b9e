"""Cost of a member of a batch, values and gradients, beside a single run, by each way to compile.

    python tests/benchmarks/batches.py [mechanism ...] [--members 64 256] [--json FILE]

prints a table of members × mechanism × (value, gradient). On a processor each way of `jaxmb.setup(compile=)` has a
process of its own, on one core and with one thread; times are those of the processor, the shortest of several, in turns
with the single run. On an accelerator all members run at once, as `jaxmb.batch` does there, and times are of the clock.
The masses of members differ by up to a tenth; a gradient is that of the sum of the last coordinates by all masses.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from pathlib import Path

# One core, and one thread of XLA, before JAX starts.
os.environ["NPROC"] = "1"
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})

import jax
import jax.numpy as jnp
import numpy as np

import jaxmb as mb

WAYS = ("for speed", "for batches")
REPEATS, RTOL = 3, 1e-8
# Parameters, and the end of the motion, long enough for some hundred steps.
CASES = {
    "four_bar": ({}, 2.0),
    "rod_chain2": ({"n": 2}, 1.0),
    "rod_chain3": ({"n": 3}, 1.0),
    "heavy_top": ({}, 1.0),
    "andrews": ({}, 0.03),
    "rod_chain10": ({"n": 10}, 0.3),
    "bricard": ({}, 1.0),
    "tracked_vehicle": ({}, 0.1),
}


def machine() -> str:
    """The device, and the versions that compile for it."""
    device = jax.devices()[0]
    name = device.device_kind
    if device.platform == "cpu":
        info = Path("/proc/cpuinfo")
        lines = info.read_text().splitlines() if info.exists() else []
        names = (line.split(":")[1].strip() for line in lines if line.startswith("model name"))
        name = f"{next(names, platform.processor())}, one core"
    return f"{name}; jax {jax.__version__}, jaxlib {jax.lib.__version__}"


def member_of(name):
    """The run of a member, from a factor of each mass to its last coordinates and number of steps; the number of
    masses.
    """
    parameters, t1 = CASES[name]
    mechanism = mb.mechanisms.get(name.rstrip("0123456789"), **parameters)
    masses = {key: value for key, value in mb.parameters(mechanism.system).items() if key.endswith(".mass")}

    def member(factors):
        changed = {key: value * factor for (key, value), factor in zip(masses.items(), factors, strict=True)}
        system = mb.with_parameters(mechanism.system, changed)
        motion = mb.simulate(system, mechanism.state, t1=t1, rtol=RTOL, throw=False)
        return motion.ys.q[-1], motion.stats["num_steps"]

    return member, len(masses)


def timed(function, *args):
    """The result, and the time that it took [s]: of the processor, on an accelerator of the clock."""
    clock = time.process_time if jax.default_backend() == "cpu" else time.perf_counter
    start = clock()
    out = jax.block_until_ready(function(*args))
    return out, clock() - start


def measured(name, members):
    """Microseconds of a step of the single run and of a member-step, milliseconds of a member's gradient, the same of
    a single run, and seconds to compile.
    """
    member, masses = member_of(name)
    slope = jax.grad(lambda factors: jnp.sum(member(factors)[0]))
    factors = np.random.default_rng(0).uniform(0.9, 1.1, (members, masses))
    single = {"value": jax.jit(member), "gradient": jax.jit(slope)}
    batch = {"value": mb.batch(member), "gradient": mb.batch(slope)}
    row, few = {}, min(8, members)
    for kind in single:
        alone = lambda kind=kind: [single[kind](x) for x in factors[:few]]
        together = lambda kind=kind: batch[kind](factors)
        timed(single[kind], factors[0])
        (out, first), best = timed(together), {"single": np.inf, "batch": np.inf}
        if kind == "value":
            steps = np.asarray(out[1])
        for _ in range(REPEATS):
            best["single"] = min(best["single"], timed(alone)[1] / few)
            best["batch"] = min(best["batch"], timed(together)[1] / members)
        row[kind] = {"compiled in": first - best["batch"] * members, **best}
    return row | {"steps": float(np.mean(steps)), "steps of few": float(np.mean(steps[:few]))}


def report(name, way, members, row):
    value, gradient = row["value"], row["gradient"]
    single, of_member = 1e6 * value["single"] / row["steps of few"], 1e6 * value["batch"] / row["steps"]
    print(
        f"{name:16}{way:12}{members:8}{row['steps']:7.0f}{single:9.2f}{of_member:9.2f}{of_member / single:7.2f}"
        f"{1e3 * gradient['single']:10.2f}{1e3 * gradient['batch']:10.2f}{gradient['batch'] / value['batch']:7.1f}"
        f"{value['compiled in']:9.0f}{gradient['compiled in']:6.0f}",
        flush=True,
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(CASES))
    parser.add_argument("--members", nargs="*", type=int, default=[64, 256])
    parser.add_argument("--json")
    parser.add_argument("--way", choices=WAYS, help="measure in this process")
    options = parser.parse_args()
    on_processor = jax.default_backend() == "cpu" if options.way is None else True
    if options.way is None:
        print(machine())
        print(
            f"{'':28}{'':8}{'':7}{'value, µs a step':>18}{'':7}{'gradient, ms':>20}{'over':>7}{'compiled in, s':>15}\n"
            f"{'':28}{'members':>8}{'steps':>7}{'single':>9}{'batch':>9}{'ratio':>7}{'single':>10}{'batch':>10}"
            f"{'value':>7}{'value':>9}{'grad.':>6}",
            flush=True,
        )
    if options.way is None and on_processor:
        for way in WAYS:
            subprocess.run([sys.executable, __file__, *sys.argv[1:], "--way", way], check=True)
        return
    mb.setup(compile=options.way, keep=False)
    for name in options.names:
        for members in options.members:
            row = measured(name, members)
            report(name, options.way or "", members, row)
            if options.json:
                with open(options.json, "a") as file:
                    file.write(json.dumps({"name": name, "way": options.way, "members": members, **row}) + "\n")


if __name__ == "__main__":
    main()
