"""Trains of 10 to 10000 vehicles: time of one evaluation of the equations of motion, and 1000 vehicles that brake.

Run it with `python tests/benchmarks/trains.py [longest train]`. Evaluations are timed inside one compiled loop, the
best of several; "build" is the time to make, compile and assemble the scene, and grows with the number of its parts.
"""

import functools
import sys
import time

import diffrax
import jax
import numpy as np
from jax import lax

import jaxmb as mb
from jaxmb import planar
from jaxmb.formulations import Multipliers, accelerations

jax.config.update("jax_enable_x64", True)

REPEATS = 7
TRAINS = {
    "draft gears": functools.partial(mb.mechanisms.train, coupler=planar.DraftGear),
    "hinges": functools.partial(mb.mechanisms.train, coupler=planar.Revolute),
    "drawbars": functools.partial(mb.mechanisms.train, coupler=planar.Distance),
    "relative coordinates": mb.mechanisms.longitudinal_train,
}


def evaluation(make, n):
    """Seconds to build and to evaluate, lines of the program, and bytes of its memory."""
    start = time.perf_counter()
    mechanism = make(n=n)
    built = time.perf_counter() - start
    times = max(5, 200000 // n)

    def several(system, q, u):
        again = lambda _, u: u + 1e-9 * accelerations(system, Multipliers(), 0.1, q, u)[0]
        return lax.fori_loop(0, times, again, u)

    arguments = mechanism.system, mechanism.state.q, mechanism.state.u
    program = jax.jit(several).lower(*arguments)
    run = program.compile()
    best = np.inf
    for _ in range(REPEATS):
        start = time.perf_counter()
        run(*arguments).block_until_ready()
        best = min(best, (time.perf_counter() - start) / times)
    return built, best, program.as_text().count("\n"), run.memory_analysis().temp_size_in_bytes


def braking(make, name, n):
    """Until the pressure wave has reached the last vehicle and its brakes are on."""
    mechanism = make(n=n)
    t1 = 13.0 * n / 250.0 + 2.0
    for what in ("with compiling", "again"):
        start = time.perf_counter()
        sol = mb.simulate(
            mechanism.system,
            mechanism.state,
            t1=t1,
            rtol=1e-6,
            max_steps=10**6,
            progress_meter=diffrax.TextProgressMeter(minimum_increase=0.1),
        )
        sol.ys.q.block_until_ready()
        seconds = time.perf_counter() - start
        counts = {key: int(sol.stats[key]) for key in ("num_steps", "num_rejected_steps", "num_evaluations")}
        print(f"{name}, {n} vehicles, {t1:g} s at rtol 1e-6, {what}: {seconds:.1f} s, {counts}", flush=True)


def main():
    longest = int(sys.argv[1]) if len(sys.argv) > 1 else 10000
    for name, make in TRAINS.items():
        print(f"{name}\n{'n':>7} {'build [s]':>10} {'µs':>9} {'exponent':>9} {'lines':>6} {'memory [kB]':>12}")
        before = None
        for n in (10, 100, 1000, 10000):
            if n > longest:
                break
            built, seconds, lines, memory = evaluation(make, n)
            exponent = "" if before is None else f"{np.log10(seconds / before):.2f}"
            print(f"{n:7} {built:10.2f} {1e6 * seconds:9.1f} {exponent:>9} {lines:6} {memory / 1e3:12.0f}", flush=True)
            before = seconds
    for name in ("draft gears", "relative coordinates", "hinges"):
        braking(TRAINS[name], name, min(longest, 1000))


if __name__ == "__main__":
    main()
