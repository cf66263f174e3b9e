"""The rigid problems of the IFToMM Library of Computational Benchmark Problems, each with the library's own error.

Run it with `python tests/benchmarks/iftomm.py`, on an otherwise idle machine. It prints the error, the CPU time of the
fastest warm run and its steps, for four tolerances: of the whole motion with the table of results that the library asks
for, one line every 0.01 s (A03: every 0.001 s), and of the motion alone. Beside it stand the times that were published
for OpenSim 3.2 on an Intel Core i5-4570; what it takes jaxmb to compile is printed apart.
"""

import sys
import time
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from equal_error import machine
from iftomm_problems import CASES, EIGENVALUES, eigenvalue_error

import jaxmb as mb
from jaxmb.report.table import aligned

jax.config.update("jax_enable_x64", True)
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)
REPEATS = 5
HEADER = ("", "", "rtol", "error", "with table [ms]", "alone [ms]", "steps", "OpenSim [ms]", "compile [s]")


def cpu_time(run) -> float:
    """The least of several [s]."""
    times = []
    for _ in range(REPEATS):
        begin = time.process_time()
        jax.block_until_ready(run())
        times.append(time.process_time() - begin)
    return min(times)


def rows(number, case):
    mechanism = case.mechanism()
    start = mechanism.system, mechanism.state
    t1 = float(case.times[-1])

    def motion(system, state, rtol, saveat):
        return mb.simulate(system, state, t1=t1, saveat=saveat, rtol=rtol, solver=case.solver, throw=False)

    programs, compiling = {}, time.perf_counter()
    for name, times in (("table", case.times), ("end", case.times[-1:])):
        programs[name] = eqx.filter_jit(lambda system, state, rtol, times=times: motion(system, state, rtol, times))
        jax.block_until_ready(programs[name](*start, np.asarray(1e-4)))
    compiling = time.perf_counter() - compiling
    for rtol in TOLERANCES:
        table, end = (partial(programs[name], *start, np.asarray(rtol)) for name in ("table", "end"))
        trajectory = table()
        failed = trajectory.result != mb.RESULTS.successful
        yield (
            number,
            f"{case.title}, {t1:g} s" if rtol == TOLERANCES[0] else "",
            f"{rtol:.0e}",
            "failed" if failed else f"{case.error(mechanism, trajectory):.1e}",
            f"{1e3 * cpu_time(table):.1f}",
            f"{1e3 * cpu_time(end):.1f}",
            str(int(trajectory.stats["num_steps"])),
            "–" if case.opensim is None else f"{1e3 * case.opensim:.0f}",
            f"{compiling:.0f}",
        )


def main():
    print(machine(("jaxmb", "jax", "jaxlib")), flush=True)
    print("Errors: " + "; ".join(f"{number} {case.measure}" for number, case in CASES.items()) + ".")
    for number, case in CASES.items():
        print("\n".join(["", *aligned([HEADER, *rows(number, case)], words=2)]), flush=True)
    print("\nFour-bar with a diagonal spring, eigenvalues [1/s]")
    for damping in EIGENVALUES:
        found, error = eigenvalue_error(damping)
        print(f"damper {damping:g} N s/m: {found:.11g}, relative error {error:.0e}")


if __name__ == "__main__":
    main()
