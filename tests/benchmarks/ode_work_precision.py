"""Error, evaluations and run time of `Adams`, against `diffrax.Dopri8`, on non-stiff problems.

Run as `python tests/benchmarks/ode_work_precision.py`.
"""

import sys
import time
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from ode_problems import PROBLEMS, evaluations_at, solve, work_precision

from jaxmb.solvers import Adams, MultistepController

TOLERANCES = 10.0 ** -np.arange(4.5, 12.01, 0.125)
ERRORS = np.array([1e-6, 1e-7, 1e-8, 1e-9])


def microseconds_per_step(problem, solver, controller, tolerance=1e-9, repeats=10):
    """`(seconds to compile, microseconds a step when warm)`."""

    @jax.jit
    def run(y0):
        solution = solve(problem._replace(y0=y0), tolerance, solver, controller, diffrax.SaveAt(t1=True))
        return solution.ys, solution.stats["num_steps"]

    y0 = jnp.asarray(problem.y0)
    begin = time.perf_counter()
    compiled = run.lower(y0).compile()
    compile_time = time.perf_counter() - begin
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        _, steps = jax.block_until_ready(compiled(y0))
        times.append(time.perf_counter() - begin)
    return compile_time, min(times) / int(steps) * 1e6


def main():
    jax.config.update("jax_enable_x64", True)
    for name, problem in PROBLEMS.items():
        curves = {solver: work_precision(problem, TOLERANCES, solver=solver) for solver in ("adams", "dopri8")}
        print(f"\n{name}")
        print("   tolerance    Adams: error  evaluations    Dopri8: error  evaluations")
        for i in range(0, len(TOLERANCES), 4):
            (error_a, work_a), (error_d, work_d) = ((e[i], w[i]) for e, w in curves.values())
            print(f"   {TOLERANCES[i]:9.1e}    {error_a:12.1e}  {work_a:11.0f}    {error_d:13.1e}  {work_d:11.0f}")
        adams, dopri8 = (evaluations_at(ERRORS, *curve) for curve in curves.values())
        for error, a, d in zip(ERRORS, adams, dopri8, strict=True):
            print(f"   at error {error:.0e}: {a:6.0f} against {d:6.0f} evaluations, ratio {a / d:.2f}")
        print(f"   mean ratio {np.exp(np.mean(np.log(adams / dopri8))):.2f}")
        for solver, controller in ((Adams(), MultistepController), (diffrax.Dopri8(), diffrax.PIDController)):
            compile_time, step_time = microseconds_per_step(problem, solver, controller)
            label = type(solver).__name__
            print(f"   {label:6s}: {compile_time:.2f} s to trace and compile, {step_time:.1f} microseconds a step")


if __name__ == "__main__":
    main()
