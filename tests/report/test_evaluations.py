"""Counts of evaluations of the vector field, by solver."""

import diffrax
import jax
import jax.numpy as jnp
import pytest

from jaxmb.report.evaluations import evaluations
from jaxmb.solvers import Adams, MultistepController


@pytest.mark.slow(but=("Tsit5",))
@pytest.mark.parametrize("solver", [Adams(), diffrax.Tsit5(), diffrax.Dopri8()], ids=["Adams", "Tsit5", "Dopri8"])
def test_evaluations_are_those_that_happen(solver):
    count = 0

    def field(t, y, args):
        jax.debug.callback(tick)
        return -y * (1 + jnp.sin(20 * t))

    def tick():
        nonlocal count
        count += 1

    controller = (MultistepController if isinstance(solver, Adams) else diffrax.PIDController)(rtol=1e-6, atol=1e-8)
    saveat = diffrax.SaveAt(t1=True, solver_state=True)
    term = diffrax.ODETerm(field)
    solution = diffrax.diffeqsolve(
        term, solver, 0.0, 2.0, None, jnp.ones(1), stepsize_controller=controller, saveat=saveat
    )
    jax.block_until_ready(solution.ys)
    jax.effects_barrier()
    stats = dict(solution.stats)
    if isinstance(solver, Adams):
        stats |= solver.statistics(solution.solver_state, None, stats)
    uncounted = 0 if isinstance(solver, Adams) else 2
    assert 0 <= count - evaluations(solver, stats) <= uncounted


def test_evaluations_of_implicit_methods_are_unknown():
    assert evaluations(diffrax.Kvaerno5(), {"num_steps": 3}) is None
