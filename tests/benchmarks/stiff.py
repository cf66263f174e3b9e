"""Stiff problems: error against run time of `Hermite`, `diffrax.Kvaerno5` and, if installed, SUNDIALS CVODE.

On mechanisms also of `Adams`, whose steps stability limits.

Run it with `python tests/benchmarks/stiff.py`, or with the names of some problems: `vdpol`, `robertson`, `hires`,
`flyball`, `stiff_four_bar`. It prints work–precision tables, and the warm run times of the others over that of Hermite
at equal error, read off straight lines through the log–log curves; all in one process, the runs of a problem in turns.

The error is the largest relative error of a component at the end; with mechanisms that of an observed quantity,
relative to its largest reference value. All solvers have the same right-hand side, compiled by JAX. That of CVODE
(`pip install scikit-sundae`: BDF, dense Jacobian, also compiled by JAX) is called back from Python, some microseconds
each. On mechanisms Hermite and Adams integrate the independent coordinates of a partition, Kvaerno5 all of them with a
projection after every step, and CVODE all of them without.

Counts: of Hermite, evaluations of f with its derivative along the solution; of Adams and Kvaerno5, calls of f (of the
latter on mechanisms there is nothing to count them with); of CVODE, calls of f, while it does not tell rejected steps.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from stiff_problems import PROBLEMS

import jaxmb as mb
from jaxmb.manifold.manifold import VectorField
from jaxmb.solvers import Adams, Hermite, MultistepController

MAX_STEPS = 200_000
ERROR = 1e-8
REPEATS = 7
# Some of their runs take a minute.
MECHANISM_REPEATS = 1

ODES = {"vdpol": "van der Pol 1e3", "robertson": "Robertson", "hires": "HIRES"}
MECHANISMS = ("flyball", "stiff_four_bar")
# The coefficients that diffrax's documentation advises for stiff problems, and its defaults.
CONTROLLERS = {
    "Kvaerno5": {"pcoeff": 0.3, "icoeff": 0.4},
    "Kvaerno5, I control": {},
}
# Powers of ten: the first and last tolerance, and how many to a decade.
TOLERANCES = {
    "vdpol": {"Hermite": (-5, -12, 2), "Kvaerno5": (-5, -12, 2), "CVODE": (-5, -13, 2)},
    "robertson": {"Hermite": (-4, -9, 2), "Kvaerno5": (-4, -10, 2), "CVODE": (-4, -12, 2)},
    "hires": {"Hermite": (-5, -12, 2), "Kvaerno5": (-2, -8, 2), "CVODE": (-5, -13, 2)},
    "flyball": {"Hermite": (-4, -12, 1), "Adams": (-4, -8, 1), "Kvaerno5": (-2, -3, 1), "CVODE": (-4, -9, 1)},
    "stiff_four_bar": {"Hermite": (-3, -10, 1), "Adams": (-3, -10, 1), "Kvaerno5": (-2, -4, 1), "CVODE": (-3, -6, 1)},
}


class Outcome(NamedTuple):
    """`counts`: accepted steps, rejected steps, evaluations; None where they are not known."""

    error: float
    failed: bool
    counts: tuple[int | None, int | None, int | None]


class Solver(NamedTuple):
    """`run(rtol)` is what is timed; `judge(rtol, its result)` an `Outcome`."""

    run: Callable[[Any], Any]
    judge: Callable[[Any, Any], Outcome]


def ode_solvers(key: str) -> dict[str, Solver]:
    problem = PROBLEMS[ODES[key]]
    args = jax.tree.map(jnp.asarray, problem.args)
    y0 = jnp.asarray(problem.y0)
    error = lambda y: float(np.max(np.abs((np.asarray(y) - problem.y1) / problem.y1)))
    calls = [0]

    def counted(t, y, args):
        def count():
            calls[0] += 1

        jax.debug.callback(count)
        return problem.vector_field(t, y, args)

    def diffrax_solver(solver, controller):
        def solve(field, rtol):
            solution = diffrax.diffeqsolve(
                diffrax.ODETerm(field),
                solver,
                0.0,
                problem.t1,
                None,
                y0,
                args,
                stepsize_controller=controller(rtol, rtol * problem.relative),
                adjoint=diffrax.ForwardMode(),
                saveat=diffrax.SaveAt(t1=True, solver_state=True, controller_state=True),
                max_steps=MAX_STEPS,
                throw=False,
            )
            work = None
            if isinstance(solver, Hermite):
                state, controller_state = solution.solver_state, solution.controller_state
                work = state.step_counts[0] + state.work[0] + controller_state.wasted[0]
            return solution.ys[-1], solution.stats, solution.result == diffrax.RESULTS.successful, work

        run = jax.jit(lambda rtol: solve(problem.vector_field, rtol))
        counting = jax.jit(lambda rtol: solve(counted, rtol))

        def judge(rtol, result):
            y, stats, successful, work = result
            if work is None and successful:
                calls[0] = 0
                jax.block_until_ready(counting(rtol))
                jax.effects_barrier()
                work = calls[0]
            counts = stats["num_accepted_steps"], stats["num_rejected_steps"], work
            return Outcome(error(y), not successful, tuple(None if n is None else int(n) for n in counts))

        return Solver(run, judge)

    solvers = {"Hermite": diffrax_solver(Hermite(), MultistepController)}
    for name in CONTROLLERS:
        solvers[name] = diffrax_solver(diffrax.Kvaerno5(), pid_controller(name))
    field = lambda t, y: problem.vector_field(t, y, args)
    return solvers | cvode_solver(field, problem.y0, problem.t1, problem.relative, error)


def mechanism_solvers(key: str) -> dict[str, Solver]:
    mechanism = mb.mechanisms.get(key)
    system, references = mechanism.system, mechanism.references
    formulation = mb.formulations.Multipliers()
    # Of the linkage in its bushing the positions: its rates are a matter of the oscillations.
    chosen = [k for k, label in enumerate(references.labels) if key == "flyball" or not label.endswith("_rate")]

    def error(states):
        """Of the last of several states."""
        ts = jnp.full(states.q.shape[0], mechanism.t1)
        trajectory = mb.Trajectory(system, formulation, ts, states, {}, mb.RESULTS.successful, None, None)
        observed = mechanism.observe(trajectory)
        values = np.array([float(observed[references.labels[k]][-1]) for k in chosen])
        return float(np.max(np.abs(values - references.values[-1, chosen]) / references.scales[chosen]))

    def simulation(solver, controller):
        @jax.jit
        def run(rtol):
            trajectory = mb.simulate(
                system,
                mechanism.state,
                t1=mechanism.t1,
                rtol=rtol,
                solver=solver,
                stepsize_controller=controller(rtol, rtol / 100),
                adjoint=diffrax.ForwardMode(),
                max_steps=MAX_STEPS,
                throw=False,
            )
            return trajectory.ys, trajectory.stats, trajectory.result == mb.RESULTS.successful

        def judge(rtol, result):
            states, stats, successful = result
            counts = (stats.get(name) for name in ("num_accepted_steps", "num_rejected_steps", "num_evaluations"))
            return Outcome(error(states), not successful, tuple(None if n is None else int(n) for n in counts))

        return Solver(run, judge)

    flat, unravel = ravel_pytree(mechanism.state)
    vector_field = VectorField(system, formulation)
    field = lambda t, y: ravel_pytree(vector_field(t, unravel(y), None))[0]
    solvers = {
        "Hermite": simulation(Hermite(), MultistepController),
        "Adams": simulation(Adams(), MultistepController),
        "Kvaerno5": simulation(diffrax.Kvaerno5(), pid_controller("Kvaerno5")),
    }
    end_error = lambda y: error(jax.tree.map(lambda x: x[None], unravel(jnp.asarray(y))))
    return solvers | cvode_solver(field, flat, mechanism.t1, 0.01, end_error)


def pid_controller(name: str) -> Callable[..., diffrax.PIDController]:
    return lambda rtol, atol: diffrax.PIDController(rtol=rtol, atol=atol, **CONTROLLERS[name])


def cvode_solver(field, y0, t1, relative, error) -> dict[str, Solver]:
    """`relative` is the absolute tolerance over the relative one; empty if SUNDIALS is not installed."""
    try:
        from sksundae.cvode import CVODE
    except ImportError:
        print("scikit-sundae is not installed (pip install scikit-sundae): CVODE is left out.")
        return {}
    compiled, jacobian = jax.jit(field), jax.jit(jax.jacfwd(field, argnums=1))
    y0 = np.asarray(y0)

    def rhs(t, y, out):
        out[:] = compiled(t, y)

    def jac(t, y, f, out):
        out[:] = jacobian(t, y)

    def solve(rtol, times):
        solver = CVODE(
            rhs,
            method="BDF",
            jacfn=jac,
            rtol=float(rtol),
            atol=float(rtol) * np.broadcast_to(relative, y0.shape),
            max_num_steps=MAX_STEPS,
        )
        return solver.solve(np.asarray(times), y0)

    def judge(rtol, result):
        # With two times it returns every step.
        steps = len(solve(rtol, (0.0, t1)).t) - 1
        return Outcome(error(result.y[-1]), not result.success, (steps, None, result.nfev))

    # With three it does not stop to hand over steps.
    return {"CVODE": Solver(lambda rtol: solve(rtol, (0.0, t1 / 2, t1)), judge)}


def measure(key: str) -> None:
    solvers = ode_solvers(key) if key in ODES else mechanism_solvers(key)
    cases = [(name, rtol) for name in solvers for rtol in tolerances(key, name)]
    runs = [lambda name=name, rtol=rtol: solvers[name].run(jnp.asarray(rtol)) for name, rtol in cases]
    outcomes = [solvers[name].judge(jnp.asarray(rtol), run()) for (name, rtol), run in zip(cases, runs, strict=True)]
    milliseconds = np.full(len(cases), np.inf)
    for _ in range(REPEATS if key in ODES else MECHANISM_REPEATS):
        for k, run in enumerate(runs):
            begin = time.perf_counter()
            jax.block_until_ready(run())
            milliseconds[k] = min(milliseconds[k], 1e3 * (time.perf_counter() - begin))
    print(
        f"\n{key}\n{'':19}  {'rtol':>7}  {'error':>7}  {'accepted':>8}  {'rejected':>8}  {'evaluations':>11}  {'ms':>9}"
    )
    curves = {name: [] for name in solvers}
    for (name, rtol), outcome, took in zip(cases, outcomes, milliseconds, strict=True):
        if not outcome.failed and outcome.error > 0:
            curves[name].append((outcome.error, took))
        shown = "failed" if outcome.failed else f"{outcome.error:.1e}"
        accepted, rejected, evaluations = ("–" if count is None else count for count in outcome.counts)
        print(f"{name:19}  {rtol:7.1e}  {shown:>7}  {accepted:>8}  {rejected:>8}  {evaluations:>11}  {took:9.2f}")
    own = np.array(curves.pop("Hermite"))
    for name, curve in curves.items():
        curve = np.array(curve)
        if len(curve) < 2:
            print(f"{name}: too few successful runs")
            continue
        error = max(ERROR, np.min(own[:, 0]), np.min(curve[:, 0]))
        print(f"{name}, against Hermite at error {error:.0e}: {at(curve, error) / at(own, error):.2f} times as long")


def tolerances(key: str, name: str) -> np.ndarray:
    first, last, per_decade = TOLERANCES[key][name.split(",")[0]]
    return 10.0 ** -np.linspace(-first, -last, (first - last) * per_decade + 1)


def at(curve: np.ndarray, error: float) -> float:
    """Time at an error, from a straight line through the log–log curve around it (errors of single runs scatter)."""
    x, y = np.log10(curve).T
    distance = np.abs(x - np.log10(error))
    near = distance <= max(1.0, np.sort(distance)[1])
    slope, level = np.polyfit(x[near], y[near], 1)
    return 10.0 ** (slope * np.log10(error) + level)


def main():
    jax.config.update("jax_enable_x64", True)
    for key in sys.argv[1:] or (*ODES, *MECHANISMS):
        measure(key)


if __name__ == "__main__":
    main()
