"""The cost of methods of integrating a constrained motion at equal error: evaluations, linear algebra, and time.

python tests/benchmarks/method_costs.py four_bar andrews
"""

import dataclasses
import sys
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import numpy as np
from stabilised_dae import applies_to, stabilised_dae

import jaxmb as mb
from jaxmb import RESULTS, State, Trajectory, simulate
from jaxmb.bodies.motion_graph import motion_order
from jaxmb.formulations import Multipliers
from jaxmb.manifold import AbstractManifold, Baumgarte, Partition
from jaxmb.manifold.default import default_manifold
from jaxmb.mechanisms import Mechanism, References
from jaxmb.report import Table
from jaxmb.report.evaluations import evaluations
from jaxmb.report.reference import reference
from jaxmb.report.timing import interleaved
from jaxmb.solvers import Adams, Hermite
from jaxmb.system import AbstractSystem

ERRORS = (1e-3, 1e-5, 1e-7)

# Tolerances, tried in this order until the error is small enough.
_TOLERANCES = 10.0 ** -np.arange(2.5, 12.0, 0.5)
# Rate of Baumgarte's stabilisation [1/s].
_RATE = 10.0


COLUMNS = {
    "method": "",
    "bound": ".0e",
    "error": ".1e",
    "rtol": ".0e",
    "evaluations": "d",
    "matrices": "d",
    "Mflop": ".1f",
    "run [ms]": ".2f",
    "ratio": ".2f",
}


class _Run(NamedTuple):
    """The outcome of a run: its error, infinite if it failed; evaluations and matrices."""

    error: float
    evaluations: int
    matrices: int


class _Method(NamedTuple):
    """`run(rtol)` is timed, `judge` counts and measures its result; floating point operations of an evaluation and of
    a matrix.
    """

    run: Callable[[float], Any]
    judge: Callable[[Any], _Run]
    evaluation: float
    matrix: float


def method_costs(mechanism: Mechanism, errors: Sequence[float] = ERRORS, *, repeats: int = 5) -> Table:
    """Compare coordinate partitioning with integrating all coordinates, at equal error.

    The methods are partitioning with `Adams` and with `Hermite`; all coordinates with multipliers and Baumgarte's
    stabilisation, with `Adams` and with `Dopri8` of diffrax; all coordinates with projection and sparse elimination,
    with `Adams` and with `Hermite`, where `simulate` chooses that; and, if scikit-sundae is installed and the joints
    are holonomic, planar and not redundant, implicit BDF (SUNDIALS' IDA) on the stabilised equations of index 2. IDA
    calls Python for every evaluation, which its time includes. The first method is the one that `simulate` chooses,
    and times are also given in units of its time.

    Operations of linear algebra are counted for full matrices: elimination of the constraints and the Cholesky factor
    of the reduced mass matrix; that of A M⁻¹ Aᵀ; and LU of the whole system for the implicit methods. Where A M⁻¹ Aᵀ
    is eliminated sparsely, as multipliers and projections do in large scenes, those of its blocks are counted.

    **Returns:** a row for each method and bound: the error and `rtol` of the coarsest tolerance that meets the bound,
    "not met" if none does; evaluations of the accelerations, or of the residual of implicit equations; matrices
    factored for Newton's method; millions of operations of linear algebra; the time of a warm run, and its ratio to
    that of the first method at the same bound.

    **Arguments:** `errors`: bounds on the largest relative error at the end of the quantities that the mechanism
    observes; `repeats`: timed runs of each, in turns, of which the shortest counts.

    **Raises:** `ValueError` for a mechanism without constraints.
    """
    system, state = mechanism.system, mechanism.state
    if system.acceleration_rows == 0:
        raise ValueError(f"{mechanism.name!r} has no constraints, so there are no coordinates to choose.")
    known = reference(mechanism, min(errors) / 100)
    t1, remarks = float(known.times[-1]), []
    methods = _simulations(mechanism, known)
    if not applies_to(system):
        remarks.append("IDA is skipped: its equations are for planar, holonomic joints without redundant rows.")
    else:
        try:
            methods["stabilised index 2, IDA"] = _implicit(mechanism, known, stabilised_dae(system, state, t1))
        except ImportError as error:
            remarks.append(f"{error}.")
    found, runs = [], []
    for name, method in methods.items():
        tried = {}
        for bound in errors:
            for rtol in _TOLERANCES:
                if rtol not in tried:
                    tried[rtol] = method.judge(method.run(rtol))
                if tried[rtol].error <= bound:
                    found.append((name, bound, rtol, tried[rtol]))
                    runs.append(lambda method=method, rtol=rtol: method.run(rtol))
                    break
            else:
                found.append((name, bound, float("nan"), None))
    times = iter(interleaved(runs, repeats))
    rows, unit = [], {}
    for name, bound, rtol, run in found:
        if run is None:
            rows.append((name, bound, "not met", *[None] * 6))
            continue
        flops = run.evaluations * methods[name].evaluation + run.matrices * methods[name].matrix
        time = min(next(times))
        if name == found[0][0]:
            unit[bound] = time
        counts = run.evaluations, run.matrices, flops / 1e6
        ratio = time / unit[bound] if bound in unit else None
        rows.append((name, bound, run.error, rtol, *counts, 1e3 * time, ratio))
    return Table(f"{mechanism.name}, {t1:g} s: cost of an error at the end below each bound", COLUMNS, rows, remarks)


def _simulations(mechanism: Mechanism, known: References) -> dict[str, _Method]:
    system = mechanism.system
    n, m = system.nu, system.acceleration_rank
    free = n - m
    # Gauss–Jordan on m × n at predicted states only; the reduced mass matrix and its Cholesky factor at all states.
    reduced = 2 * free * free * n + free**3 / 3
    eliminated = 2 * m * m * n
    sparse = system.elimination
    multipliers = m * m * n + m**3 / 3 if sparse is None else sparse.nodes.factor_flops
    # One complex matrix of the free coordinates and velocities is inverted.
    newton = 8 * (2 * free) ** 3
    stabilised = Baumgarte(_RATE)
    methods = {
        **_sparse_methods(system),
        "partitioning, Adams": (Adams(), Partition(), eliminated / 2 + reduced, 0.0),
        "partitioning, Hermite": (Hermite(), Partition(), eliminated + reduced, newton),
        "multipliers, Baumgarte, Adams": (Adams(), stabilised, multipliers, 0.0),
        "multipliers, Baumgarte, Dopri8": (diffrax.Dopri8(), stabilised, multipliers, 0.0),
    }
    return {name: _simulation(mechanism, known, *method) for name, method in methods.items()}


def _sparse_methods(system: AbstractSystem) -> dict[str, tuple[Any, ...]]:
    """Methods with sparse elimination, where `simulate` chooses them, with the operations of each."""
    methods = {}
    for solver in (Adams(), Hermite()):
        manifold = default_manifold(system, solver, None)
        if manifold == Partition():
            continue
        # Constrained systems are projected by multistep methods only with sparse elimination, which scenes have.
        scene: Any = system
        factor, newton = scene.elimination.nodes.factor_flops, 0.0
        if solver.solves_implicitly:
            # An elimination of a complex matrix that is not symmetric.
            newton = 8 * motion_order(scene).nodes.factor_flops
        else:
            # `Adams` eliminates at predicted states only.
            factor /= 2
        methods[f"projection, sparse elimination, {type(solver).__name__}"] = (solver, manifold, factor, newton)
    return methods


def _simulation(
    mechanism: Mechanism,
    known: References,
    solver: diffrax.AbstractSolver,
    manifold: AbstractManifold,
    evaluation: float,
    matrix: float,
) -> _Method:
    t1 = float(known.times[-1])
    formulation = manifold.default_formulation(mechanism.system)

    @eqx.filter_jit
    def compiled(system: AbstractSystem, state: State, rtol: Any) -> Trajectory:
        options: dict[str, Any] = {"solver": solver, "manifold": manifold, "formulation": formulation}
        return simulate(system, state, t1=t1, rtol=rtol, throw=False, max_steps=1_000_000, **options)

    def judge(trajectory: Trajectory) -> _Run:
        if not bool(trajectory.result == RESULTS.successful):
            return _Run(float("inf"), 0, 0)
        count = evaluations(solver, trajectory.stats)
        assert count is not None
        matrices = int(trajectory.stats.get("num_matrices", 0))
        return _Run(_error(mechanism, known, trajectory.ts, trajectory.ys), count, matrices)

    return _Method(lambda rtol: compiled(mechanism.system, mechanism.state, rtol), judge, evaluation, matrix)


def _implicit(mechanism: Mechanism, known: References, run: Callable[[float], Any]) -> _Method:
    size = 2 * mechanism.system.nu + 2 * mechanism.system.position_rows

    def judge(found: Any) -> _Run:
        if found.end is None:
            return _Run(float("inf"), 0, 0)
        ys = jax.tree.map(lambda x: x[None], found.end)
        return _Run(_error(mechanism, known, known.times[-1:], ys), found.evaluations, found.matrices)

    return _Method(run, judge, 2.0 * size**2, 2 * size**3 / 3)


def _error(mechanism: Mechanism, known: References, ts: Any, ys: Any) -> float:
    trajectory = Trajectory(
        system=mechanism.system,
        formulation=Multipliers(),
        ts=jax.numpy.asarray(ts),
        ys=ys,
        stats={},
        result=RESULTS.successful,  # pyright: ignore[reportArgumentType]
        interpolation=None,
        event_mask=None,
    )
    errors = dataclasses.replace(mechanism, references=known).errors(trajectory)
    return max(float(error[-1]) for error in errors.values())


if __name__ == "__main__":
    mb.setup(keep=False)
    for own in sys.argv[1:] or ("four_bar",):
        print(method_costs(mb.mechanisms.get(own)))
