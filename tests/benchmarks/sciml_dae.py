"""The mechanisms among the differential-algebraic problems of SciMLBenchmarks, which are those of the test set for initial
value problem solvers (Mazzia and Magherini, 2008): Andrews' squeezer, the car axis, Fekete's particles on a sphere and
the rail wheelset. Its slider-crank is elastic and not rigid, so it is left out.

Run it with `python tests/benchmarks/sciml_dae.py [andrews car_axis fekete wheelset]`, on an otherwise idle machine. Printed
are scd, the number of correct digits of the worst component against the published end values; the largest relative error
against better values, where there are any; steps and times of warm runs; and times at equal error, with their ratio.

Beside jaxmb stands RADAU5 in the form of index 3, with the indices of its variables given: of all solvers that
SciMLBenchmarks tries on Andrews' squeezer (2026) it is the only one that comes through. RADAU5 is Fortran (`pip install
assimulo-testing`); each of its evaluations is a call of a function compiled by JAX, about ten microseconds.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from equal_error import Point, machine, measured, seconds_at
from ivp_test_set import PROBLEMS, Problem, relative, scd
from radau5 import motion_of

import jaxmb as mb
from jaxmb.report.table import aligned

jax.config.update("jax_enable_x64", True)
REPEATS = 1
ERRORS = (1e-4, 1e-6, 1e-8)
TOLERANCES = 10.0 ** -np.arange(3.0, 11.1)


def jaxmb_run(problem: Problem) -> tuple[Callable[[float], Any], Callable[[Any], tuple[np.ndarray, int]]]:
    """A run at a tolerance, and its end with its steps."""
    system, state = problem.build()

    @eqx.filter_jit
    def program(system, state, rtol):
        trajectory = mb.simulate(system, state, t1=problem.t1, rtol=rtol, throw=False)
        return problem.end(trajectory), trajectory.stats["num_steps"]

    return lambda rtol: program(system, state, np.asarray(rtol)), lambda result: (result[0], int(result[1]))


def radau_run(problem: Problem):
    """The same of RADAU5; what it does not finish is NaN."""
    end = lambda run: problem.end_of(run) if run.ok else np.full_like(problem.exact, np.nan)
    return motion_of(problem.equations), lambda run: (end(run), run.steps)


def measure(name: str) -> None:
    problem = PROBLEMS[name]()
    print(f"\n{problem.title}, {problem.t1:g} s")
    solvers = {"jaxmb": jaxmb_run(problem)}
    try:
        solvers["RADAU5"] = radau_run(problem)
    except ImportError:
        print("RADAU5 is not installed (pip install assimulo-testing): left out.")
    rows = [("", "tolerance", "scd", "error", "steps", "time [ms]")]
    curves: dict[str, list[Point]] = {}
    for solver, (run, end) in solvers.items():
        error = lambda result, end=end: relative(end(result)[0], problem.exact)
        curves[solver] = measured(run, error, TOLERANCES, REPEATS)
        for point in curves[solver]:
            found, steps = end(run(point.setting))
            digits, took = f"{scd(found, problem.published):.1f}", f"{1e3 * point.seconds:.1f}"
            rows.append((solver, f"{point.setting:.0e}", digits, f"{point.error:.1e}", str(steps), took))
    print("\n".join(aligned(rows)))
    if "RADAU5" in curves:
        for target in (error for error in ERRORS if error > problem.accuracy):
            own, other = (1e3 * seconds_at(curves[solver], target) for solver in ("jaxmb", "RADAU5"))
            print(f"at error {target:.0e}: jaxmb {own:.1f} ms, RADAU5 {other:.1f} ms, ratio {own / other:.2f}")


def main():
    print(machine(("jaxmb", "jax", "jaxlib", "assimulo-testing")))
    for name in sys.argv[1:] or PROBLEMS:
        measure(name)
    print("\nThe slider-crank of the same set is elastic, not rigid: left out.")


if __name__ == "__main__":
    main()
