"""Adams' method finds out that stability limits its steps."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ode_problems import PROBLEMS as SMOOTH
from stiff_problems import PROBLEMS

from jaxmb.solvers import Adams, MultistepController
from jaxmb.solvers._stiffness import none_found, observed


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


def counted(field, t1, y0, args, rtol, word="count"):
    """The result, whether stiffness is found, the shares of stiff steps in all accepted ones, and the steps."""
    out = run(field, t1, y0, args, rtol, Adams(stiffness=word))
    found = out.solver_state.stiffness
    return out.result, found.found, found.steps / out.stats["num_accepted_steps"], out.stats["num_steps"]


@pytest.mark.slow
def test_stiffness_is_each_members_own():
    """Found where a fast transient has died away, and not where the motion is as fast, or slow."""
    field = lambda t, y, a: -a[0] * (y - jnp.cos(a[1] * t))
    members = np.array([[1.0, 1.0], [1e3, 1.0], [30.0, 30.0]])
    solve = jax.jit(jax.vmap(lambda args: counted(field, 20.0, [1.0], args, 1e-6)[1:3]))
    found, shares = solve(members)
    np.testing.assert_array_equal(found, [False, True, False])
    assert shares[1] > 0.5 and np.all(shares[::2] < 0.15)
    with pytest.raises(ValueError, match="'count'"):
        Adams(stiffness="maybe")  # pyright: ignore


def test_evidence_of_stiffness_grows_faster_than_it_fades():
    """By steps near the bound of stability along which the field changes little, until it is found."""

    @jax.jit
    def run(steps):
        def step(before, is_stiff):
            # The changes of y and f by the corrector, and by the step.
            one = jnp.ones(())
            after = observed(before, 4, one, (one, 2.0 * one), (10.0 * one, jnp.where(is_stiff, 0.1, 10.0)))
            after = observed(after, 4, one, (one, 0.0 * one), (10.0 * one, 0.1 * one))
            return after, (after.steps, after.level, after.found)

        return jax.lax.scan(step, none_found(), steps)[1]

    steps, level, found = run(np.arange(100) % 4 != 3)
    np.testing.assert_array_equal(steps[:5], [1, 2, 3, 3, 4])
    np.testing.assert_array_equal(level[:5], [2, 4, 6, 4, 6])
    assert not found[-1] and steps[-1] == 75
    # What is found stays so.
    np.testing.assert_array_equal(run(np.arange(100) < 80)[2], np.arange(100) >= 74)


@pytest.mark.slow
@pytest.mark.parametrize("name, t1", [("van der Pol 1e3", 2.0), ("Robertson", 40.0), ("HIRES", 100.0)])
def test_stiffness_is_found_and_ends_a_solve(name, t1):
    problem = PROBLEMS[name]
    solve = jax.jit(
        lambda rtol, word: counted(problem.vector_field, t1, problem.y0, problem.args, rtol, word), static_argnums=1
    )
    for rtol in (1e-5, 1e-9):
        _, found, share, _ = solve(rtol, "count")
        assert found and share > 0.5
        result, _, _, steps = solve(rtol, "stop")
        assert result == diffrax.RESULTS.nonlinear_divergence and steps < 400


@pytest.mark.slow
@pytest.mark.parametrize("name", SMOOTH)
def test_stiffness_is_not_found_in_smooth_motions(name):
    """And to count it changes nothing."""
    problem = SMOOTH[name]
    solve = jax.jit(lambda rtol: counted(problem.vector_field, problem.ts[-1], problem.y0, None, rtol, "stop"))
    for rtol in (1e-3, 1e-6, 1e-9, 1e-12):
        result, _, share, _ = solve(rtol)
        assert result == diffrax.RESULTS.successful and share < 0.15
    if name == "arenstorf":
        plain = run(problem.vector_field, problem.ts[-1], problem.y0, None, 1e-9, Adams(stiffness="ignore"))
        assert plain.solver_state.stiffness is None and plain.stats["num_steps"] == solve(1e-9)[3]
