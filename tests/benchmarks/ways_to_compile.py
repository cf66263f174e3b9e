"""A step and a gradient with each way to compile: as JAX does, quickly and for speed.

Run it with `python tests/benchmarks/ways_to_compile.py [mechanism ...]` on an otherwise idle machine, by default for
all of CASES. Each way has a process of its own on one core. Times of a step are the median of some warm runs under
`jit` over the number of steps; seconds in brackets are those to compile. The last row is of impacts: a mass between two
stops, with nearly elastic impacts, the time of one with the motion up to the next, and beside it that of this motion
alone, as a run of its own without stops.
"""

import argparse
import dataclasses
import os
import subprocess
import sys
import time

WAYS = ("none", "quickly", "for speed")
RTOL, REPEATS = 1e-8, 9
# What the mechanism is made with, and the end of the motion.
CASES = {
    "four_bar": ({}, 10.0),
    "andrews": ({}, 0.05),
    "rod_chain10": ({"n": 10}, 2.0),
    "heavy_top": ({}, 1.0),
    "rolling_disc": ({}, 2.0),
    "bricard": ({}, 1.0),
    "tracked_vehicle": ({}, 0.5),
    "cable20": ({"n": 20}, 0.5),
    "rod_chain100": ({"n": 100}, 0.2),
    "tree300": ({"n": 300}, 0.1),
}
# At 10 m/s a mass goes 10 mm between two impacts.
RATTLE, RATTLES = "rattling mass", 1000


def motion(name):
    """A function of initial velocities to a number and to how many steps or impacts there were, and the velocities."""
    import jax.numpy as jnp

    import jaxmb as mb

    if name == RATTLE:
        system = rattling(True)
        state, options = mb.assemble(system), {"t1": 1.0, "rtol": 1e-6, "max_steps": 100_000, "max_events": RATTLES}
    else:
        parameters, t1 = CASES[name]
        machine = mb.mechanisms.get(name.rstrip("0123456789"), **parameters)
        system, state, options = machine.system, machine.state, {"t1": t1, "rtol": RTOL}

    def run(u):
        found = mb.simulate(system, dataclasses.replace(state, u=u), **options)
        count = jnp.sum(jnp.isfinite(found.events.times)) if name == RATTLE else found.stats["num_steps"]
        return jnp.sum(found.ys.q), count

    return run, state.u


def rattling(stops):
    import jaxmb as mb
    from jaxmb import planar

    rail = planar.Prismatic("rail", "ground", "mass", axis=(1.0, 0.0), point=(0.0, 0.0))
    stop = mb.Stop("stop", "rail.displacement", lower=-0.005, upper=0.005, restitution=0.9999)
    spring = mb.JointSpring("spring", "rail.displacement", stiffness=3.0)
    mass = planar.Body("mass", mass=1.0, inertia=1.0, velocity=(10.0, 0.0))
    return mb.Scene([mass], joints=[rail, *[stop] * stops], forces=[spring]).compile()


def between_impacts():
    """A function of initial velocities that simulates the motions between impacts, one after the other."""
    import jax

    import jaxmb as mb

    system = rattling(False)
    state = mb.assemble(system)

    def run(u):
        def one(u, _):
            found = mb.simulate(system, dataclasses.replace(state, u=u), t1=1 / RATTLES, rtol=1e-6, max_steps=1000)
            # As fast as the last one.
            return found.ys.u[-1], None

        return jax.lax.scan(one, u, None, length=RATTLES)[0], RATTLES

    return run, state.u


def measured(name):
    """The row of a mechanism in this process."""
    import jax

    run, u = motion(name)
    functions = [(run, u), between_impacts() if name == RATTLE else (jax.value_and_grad(run, has_aux=True), u)]
    columns, value = [], None
    for function, u in functions:
        lowered, start = jax.jit(function).lower(u), time.perf_counter()
        program = lowered.compile()
        seconds, times = time.perf_counter() - start, []
        found = jax.block_until_ready(program(u))
        for _ in range(REPEATS):
            start = time.perf_counter()
            jax.block_until_ready(program(u))
            times.append(time.perf_counter() - start)
        count = int(found[1] if value is None or name == RATTLE else found[0][1])
        each, ratio = sorted(times)[REPEATS // 2] / count, ""
        if value is not None:
            ratio = f" between, {value / each:.1f} x" if name == RATTLE else f", {each / value:.1f} x"
        value = value or each
        columns.append(f"{1e6 * each:8.2f} µs{ratio} [{seconds:.1f} s]")
    return "  ".join(columns)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=[*CASES, RATTLE])
    parser.add_argument("--way", choices=WAYS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.way is None:
        for name in options.names:
            for way in WAYS:
                subprocess.run([sys.executable, __file__, name, "--way", way], check=True)
        return
    os.environ["NPROC"] = "1"
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    import jaxmb as mb

    if options.way != "none":
        mb.setup(compile=options.way, keep=False)
    import jax

    jax.config.update("jax_enable_x64", True)
    for name in options.names:
        print(f"{name:16}{options.way:16}{measured(name)}", flush=True)


if __name__ == "__main__":
    main()
