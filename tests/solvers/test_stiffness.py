"""Adams' method finds out that stability limits its steps."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ode_problems import PROBLEMS as SMOOTH
from stiff_problems import PROBLEMS

from jaxmb.solvers import Adams, MultistepController


def run(vector_field, t1, y0, args, rtol, solver):
    return diffrax.diffeqsolve(
        diffrax.ODETerm(vector_field),
        solver,
        0.0,
        t1,
        None,
        jnp.asarray(y0),
        args,
        stepsize_controller=MultistepController(rtol, rtol / 100),
        saveat=diffrax.SaveAt(t1=True, solver_state=True),
        adjoint=diffrax.ForwardMode(),
        max_steps=4000,
        throw=False,
    )


@pytest.mark.slow
@pytest.mark.parametrize("name, t1", [("van der Pol 1e3", 2.0), ("Robertson", 40.0), ("HIRES", 100.0)])
@pytest.mark.parametrize("rtol", [1e-5, 1e-9])
def test_stiff_problems_are_found(name, t1, rtol):
    problem = PROBLEMS[name]
    counted = run(problem.vector_field, t1, problem.y0, problem.args, rtol, Adams(stiffness="count"))
    assert counted.solver_state.stiffness.found
    assert int(counted.solver_state.stiffness.steps) > 0.5 * int(counted.stats["num_accepted_steps"])
    stopped = run(problem.vector_field, t1, problem.y0, problem.args, rtol, Adams(stiffness="stop"))
    assert stopped.result == diffrax.RESULTS.nonlinear_divergence
    assert stopped.stats["num_steps"] < 400


@pytest.mark.slow("1e-06-kepler 0.6", "1e-12-pleiades", "1e-12-arenstorf")
@pytest.mark.parametrize("name", SMOOTH)
@pytest.mark.parametrize("rtol", [1e-3, 1e-6, 1e-9, 1e-12])
def test_others_are_not(name, rtol):
    problem = SMOOTH[name]
    solution = run(problem.vector_field, problem.ts[-1], problem.y0, None, rtol, Adams(stiffness="stop"))
    assert solution.result == diffrax.RESULTS.successful
    assert int(solution.solver_state.stiffness.steps) < 0.15 * int(solution.stats["num_accepted_steps"])


@pytest.mark.slow
def test_counting_changes_nothing():
    problem = SMOOTH["arenstorf"]
    plain, counted = (
        run(problem.vector_field, 5.0, problem.y0, None, 1e-9, Adams(stiffness=word)) for word in ("ignore", "count")
    )
    assert plain.stats["num_steps"] == counted.stats["num_steps"]
    np.testing.assert_allclose(plain.ys, counted.ys, rtol=1e-10)
    assert plain.solver_state.stiffness is None


@pytest.mark.slow
def test_in_a_batch():
    """Stiffness is each member's own."""
    solve = lambda rate: run(
        lambda t, y, a: -rate * (y - jnp.cos(t)), 20.0, [1.0], None, 1e-6, Adams(stiffness="count")
    )
    found = jax.jit(jax.vmap(lambda rate: solve(rate).solver_state.stiffness.found))(jnp.array([1.0, 1e3]))
    np.testing.assert_array_equal(found, [False, True])


def test_unknown_word():
    with pytest.raises(ValueError, match="'count'"):
        Adams(stiffness="maybe")  # pyright: ignore
