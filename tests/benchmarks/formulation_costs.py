"""The cost of the formulations, side by side on one mechanism, with derivatives.

    python tests/benchmarks/formulation_costs.py four_bar andrews

Source of the question: P. E. Nikravesh and I. S. Chung, "Application of Euler Parameters to the Dynamic Analysis of
Three-Dimensional Constrained Mechanical Systems", J. Mech. Design 104(4), 1982, compares what formulations cost.
"""

import functools
import sys
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import jaxmb as mb
from jaxmb import State
from jaxmb.formulations import AbstractFormulation, Multipliers, NullSpace, Partitioned, Poincare, UdwadiaKalaba
from jaxmb.formulations.formulation import row_levels
from jaxmb.formulations.laws import laws_of
from jaxmb.linalg.elimination import PivotOrder, full_pivot
from jaxmb.linalg.jacobian import DenseJacobian
from jaxmb.mechanisms import Mechanism
from jaxmb.report import Table
from jaxmb.report.timing import interleaved
from jaxmb.system import AbstractSystem
from jaxmb.system.instant import Instant

# Consecutive evaluations in one timed run.
_LENGTH = 200


def every_formulation() -> dict[str, AbstractFormulation]:
    """All formulations and their options, by name."""
    return {
        "Partitioned": Partitioned(),
        "Multipliers": Multipliers(),
        "NullSpace": NullSpace(),
        "Poincare": Poincare(),
        "UdwadiaKalaba": UdwadiaKalaba(),
        "UdwadiaKalaba, inverses": UdwadiaKalaba("inverses"),
        "UdwadiaKalaba, singular mass": UdwadiaKalaba("singular_mass"),
    }


COLUMNS = {
    "formulation": "",
    "evaluation [µs]": ".2f",
    "forward": ".2f",
    "reverse": ".2f",
    "lines of HLO": "d",
    "lines, forward": "d",
    "lines, reverse": "d",
    "deviation": ".0e",
}


def formulation_costs(
    mechanism: Mechanism, formulations: Mapping[str, AbstractFormulation] | None = None, *, repeats: int = 5
) -> Table:
    """Time the accelerations by several formulations, and their derivatives with respect to the state.

    Each evaluation depends on the previous one, as in a motion, and eliminates in the pivot order of one chart. The
    formulations are timed in turns.

    **Arguments:** `formulations` by name, default all that the mechanism's mass matrix allows; `repeats`: timed runs of
    each, of which the shortest counts.

    **Returns:** a row for each: times [µs] of one evaluation of all accelerations, including the Jacobian and its
    elimination in a given pivot order, with the derivative along one direction, and with the gradient; lines of HLO of
    the three, before XLA optimises; the largest deviation of the accelerations from those of the first formulation,
    relative to the largest acceleration.

    **Raises:** `ValueError` for a mechanism without constraints, where all formulations are the same.
    """
    system, state = mechanism.system, mechanism.state
    if system.acceleration_rows == 0:
        raise ValueError(f"{mechanism.name!r} has no constraints: its accelerations are M⁻¹F by any formulation.")
    every = every_formulation() if formulations is None else dict(formulations)
    chosen = {name: f for name, f in every.items() if system.positive_definite_mass or not f.inverts_mass}
    if not chosen:
        raise ValueError(
            f"The mass matrix of {mechanism.name!r} is singular; give a formulation for it, such as NullSpace()."
        )
    pivots = full_pivot(system.jacobian(0.0, state.q, state.u), scale=system.velocity_scale(), level=row_levels(system))

    modes = (_evaluated, _forward, _reverse)
    lines: dict[str, tuple[int, int, int]] = {}
    runs, accelerations = [], {}
    for name, formulation in chosen.items():
        solve = lambda y, formulation=formulation: _accelerations(system, formulation, y, pivots.order)
        accelerations[name] = np.asarray(eqx.filter_jit(solve)(state))
        programs = [mode(solve) for mode in modes]
        value, forward, reverse = (len(jax.jit(p).lower(state).as_text().splitlines()) for p in programs)
        lines[name] = value, forward, reverse
        runs += [functools.partial(jax.jit(_repeated(p)), state) for p in programs]
    times = [min(own) / _LENGTH for own in interleaved(runs, repeats)]
    first = next(iter(accelerations.values()))
    size = max(float(np.max(np.abs(first))), float(np.finfo(first.dtype).tiny))
    rows = []
    for k, name in enumerate(chosen):
        deviation = float(np.max(np.abs(accelerations[name] - first))) / size
        rows.append((name, *(1e6 * time for time in times[3 * k : 3 * k + 3]), *lines[name], deviation))
    return Table(f"{mechanism.name}: accelerations at the start, by formulation", COLUMNS, rows)


def _accelerations(system: AbstractSystem, formulation: AbstractFormulation, y: State, order: PivotOrder):
    at = Instant.of(system, jnp.zeros((), y.q.dtype), y)
    jacobian = at.structured_jacobian
    if formulation.partitions or system.acceleration_rank < system.acceleration_rows:
        matrix = jacobian.dense().matrix
        jacobian = DenseJacobian(matrix).eliminated(order, system.acceleration_rank)
    return laws_of(at.system).solve(at, formulation, jacobian, at.gamma)[0]


def _evaluated(solve: Callable[[State], Any]):
    return solve


def _forward(solve: Callable[[State], Any]):
    return lambda y: jax.jvp(solve, (y,), (jax.tree.map(jnp.ones_like, y),))


def _reverse(solve: Callable[[State], Any]):
    return jax.grad(lambda y: jnp.sum(solve(y)))


def _repeated(program: Callable[[State], Any]):
    """Consecutive runs, each from a state that depends on the previous result by less than round-off."""

    def step(_, y):
        moved = sum(jnp.sum(x) for x in jax.tree.leaves(program(y)))
        return jax.tree.map(lambda x: x + jnp.finfo(x.dtype).tiny * moved, y)

    return lambda y: lax.fori_loop(0, _LENGTH, step, y)


if __name__ == "__main__":
    mb.setup(keep=False)
    for own in sys.argv[1:] or ("four_bar",):
        print(formulation_costs(mb.mechanisms.get(own)))
