"""The mechanisms among the differential-algebraic problems of SciMLBenchmarks, beside RADAU5.

They are those of the test set for initial value problem solvers (Mazzia and Magherini, 2008): Andrews' squeezer, the
car axis, Fekete's particles on a sphere and the rail wheelset. The slider-crank is elastic, not rigid: left out.

    python tests/benchmarks/sciml_dae.py [--record FILE] [andrews car_axis fekete wheelset]

Printed are scd, the number of correct digits of the worst component against the published end values; the largest
relative error against better values, where there are any; steps and processor times of warm runs; and times at equal
error, with their ratio. `--record notebooks/14_benchmarks.json` writes the curves for the notebook on benchmarks.

RADAU5 has the form of index 3, with the indices of its variables given: of all solvers that SciMLBenchmarks tries on
Andrews' squeezer (2026) it is the only one that comes through. It is Fortran (`pip install assimulo-testing`), and the
equations are compiled by JAX: nearly all of its time are calls of them. Its time less that of these calls stands
beside, so that equations in Fortran would take it to somewhere between the two.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from equal_error import ERRORS, Curve, machine, measured, record, table
from ivp_test_set import PROBLEMS, Problem, relative, scd
from radau5 import motion_of

import jaxmb as mb
from jaxmb.report.table import aligned

jax.config.update("jax_enable_x64", True)
# A call from Fortran waits for its result.
jax.config.update("jax_cpu_enable_async_dispatch", False)
REPEATS = 3
TOLERANCES = 10.0 ** -np.arange(3.0, 11.1)


class Solver(NamedTuple):
    """`run(tolerance)` has a result; `end(result)` are the components that count, `work(result)` are steps and
    evaluations, `seconds` is as in `measured`.
    """

    run: Callable[[float], Any]
    end: Callable[[Any], Any]
    work: Callable[[Any], tuple[int, int]]
    seconds: Callable[[Any], float] | None = None


def of_jaxmb(problem: Problem) -> dict[str, Solver]:
    system, state = problem.build()

    @eqx.filter_jit
    def program(system, state, rtol):
        trajectory = mb.simulate(system, state, t1=problem.t1, rtol=rtol, throw=False)
        return problem.end(trajectory), trajectory.stats

    run = lambda rtol: program(system, state, np.asarray(rtol))
    work = lambda result: tuple(int(result[1][name]) for name in ("num_steps", "num_evaluations"))
    return {"jaxmb": Solver(run, lambda result: result[0], work)}


def of_radau5(problem: Problem) -> dict[str, Solver]:
    """What it does not finish is NaN."""
    end = lambda run: problem.end_of(run) if run.ok else np.full_like(problem.exact, np.nan)
    parts = motion_of(problem.equations), end, lambda run: (run.steps, run.evaluations)
    return {"RADAU5": Solver(*parts), "RADAU5 less calls": Solver(*parts, seconds=lambda run: run.own)}


def measure(name: str) -> list[Curve]:
    problem = PROBLEMS[name]()
    solvers = of_jaxmb(problem)
    try:
        solvers |= of_radau5(problem)
    except ImportError:
        print("RADAU5 is not installed (pip install assimulo-testing): left out.")
    rows = [("", "tolerance", "scd", "error", "steps", "evaluations", "time [ms]")]
    curves = []
    for solver, (run, end, work, seconds) in solvers.items():
        error = lambda result, end=end: relative(end(result), problem.exact)
        points = measured(run, error, TOLERANCES, REPEATS, seconds)
        for point in points:
            result = run(point.setting)
            digits, counts = f"{scd(end(result), problem.published):.1f}", map(str, work(result))
            cells = digits, f"{point.error:.1e}", *counts, f"{1e3 * point.seconds:.1f}"
            rows.append((solver, f"{point.setting:.0e}", *cells))
        curves.append(Curve(problem.title, "value", solver, points))
    print("\n".join(["", f"{problem.title}, {problem.t1:g} s", *aligned(rows)]))
    print("\n" + table(curves, [error for error in ERRORS if error > problem.accuracy]), flush=True)
    return curves


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("problems", nargs="*", metavar="PROBLEM", help=", ".join(PROBLEMS))
    parser.add_argument("--record", metavar="FILE", type=Path, help="write the curves into a JSON file")
    given = parser.parse_args()
    described = machine(("jaxmb", "jax", "jaxlib", "assimulo-testing"))
    print(described)
    curves = [curve for name in given.problems or PROBLEMS for curve in measure(name)]
    print("\nThe slider-crank of the same set is elastic, not rigid: left out.")
    if given.record:
        record(given.record, "sciml_dae", described, curves)


if __name__ == "__main__":
    main()
