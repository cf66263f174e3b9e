"""Work against precision, orders of convergence, and the accuracy of dense output."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ode_problems import PROBLEMS, evaluations_at, solve, work_precision

from jaxmb.solvers import Adams, MultistepController

TOLERANCES = 10.0 ** -np.arange(4.5, 12.01, 0.125)
ERRORS = np.array([1e-6, 1e-7, 1e-8, 1e-9])


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_evaluations_at_equal_error(name):
    adams = evaluations_at(ERRORS, *work_precision(PROBLEMS[name], TOLERANCES))
    dopri8 = evaluations_at(ERRORS, *work_precision(PROBLEMS[name], TOLERANCES, solver="dopri8"))
    ratios = adams / dopri8
    assert np.all(ratios < 0.65)
    assert np.exp(np.mean(np.log(ratios))) < 0.6


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_errors_at_equal_tolerance_are_those_of_a_runge_kutta_method(name):
    # Every half decade: a single run is lucky or unlucky.
    tolerances = 10.0 ** -np.arange(4.0, 11.1, 0.5)
    adams, dopri8 = (work_precision(PROBLEMS[name], tolerances, solver=solver)[0] for solver in ("adams", "dopri8"))
    ratios = adams / dopri8
    assert np.median(ratios) <= 3 and np.max(ratios) <= 15


def test_errors_and_dense_output_follow_the_tolerance():
    """Of the hand of a clock, which turns from 0 to 6."""
    times = np.linspace(0.0, 6.0, 301)
    hand = lambda t: np.stack([np.cos(t), np.sin(t)], axis=-1)
    field = lambda t, y, rate: rate * jnp.stack([-y[1], y[0]])

    @jax.jit
    def run(tolerance):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            Adams(),
            0.0,
            6.0,
            None,
            np.array([1.0, 0.0]),
            1.0,
            stepsize_controller=MultistepController(tolerance, tolerance),
            saveat=diffrax.SaveAt(t1=True, dense=True, solver_state=True),
            max_steps=512,
            adjoint=diffrax.ForwardMode(),
        )
        mesh = solution.interpolation.ts[1:120]
        sides = [
            [jax.vmap(lambda t, f=f, left=left: f(t, left=left))(mesh) for left in (True, False)]
            for f in (solution.evaluate, solution.derivative)
        ]
        between = jax.vmap(solution.evaluate)(times), jax.vmap(solution.derivative)(times)
        increment = solution.evaluate(2.0, 2.01) - (solution.evaluate(2.01) - solution.evaluate(2.0))
        return solution.ys[0], between, increment, sides, solution.stats, solution.solver_state.step_counts

    for tolerance in (1e-4, 1e-6, 1e-8, 1e-10):
        end, (states, slopes), increment, sides, stats, step_counts = run(tolerance)
        assert np.max(np.abs(end - hand(6.0))) < 50 * tolerance
        assert np.max(np.abs(states - hand(times))) < 50 * tolerance
        assert np.max(np.abs(slopes - hand(times + np.pi / 2))) < 1e3 * tolerance
        np.testing.assert_allclose(increment, 0.0, atol=1e-15)
        # States and slopes are continuous.
        inner = int(stats["num_accepted_steps"]) - 1
        for (before, after), most in zip(sides, (1e-14, 1e-12), strict=True):
            np.testing.assert_allclose(before[:inner], after[:inner], rtol=0, atol=most)
    # High orders are reached.
    step_counts = np.asarray(step_counts)
    assert step_counts[0] == 1
    assert step_counts[8:].sum() > step_counts[1:8].sum()
    assert np.argmax(step_counts) >= 8


@pytest.mark.slow
def test_saving_at_times_uses_dense_output():
    """Interpolated values have the accuracy of the steps, on a problem whose steps vary a lot."""
    problem = PROBLEMS["kepler 0.9"]
    solution = solve(problem, 1e-11, Adams(), MultistepController, diffrax.SaveAt(ts=jnp.asarray(problem.ts)))
    np.testing.assert_allclose(solution.ys, problem.ys, rtol=0, atol=2e-8)


def _mesh(h, t1):
    """Equal steps of about `h`, after an opening fine enough for order one, and gentle enough for high orders."""
    first = 1e-5
    count = int(np.ceil(np.log(h / first) / np.log(1.06)))
    opening = np.cumsum(np.concatenate([[0.0, first, first], h * 1.06 ** -np.arange(count, 0, -1.0)]))
    rest = np.linspace(opening[-1], t1, int(np.ceil((t1 - opening[-1]) / h)) + 1)
    return np.concatenate([opening, rest[1:]]), rest[1] - rest[0]


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2, 3, 5, 8, 11, 13])
def test_order_of_convergence(order):
    """Local extrapolation gives one order more than the error estimate."""
    # Many phases of one problem, for its error passes through zero.
    phases = np.linspace(0.0, 2 * np.pi, 16, endpoint=False)
    exact = np.exp(np.sin(4.0 + phases) - np.sin(phases))

    def error(h):
        ts, h = _mesh(h, 4.0)
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, args: y * jnp.cos(t + phases)),
            Adams(min_order=order, max_order=order, rtol=1e-6, atol=1e-6),
            0.0,
            4.0,
            None,
            jnp.ones(16),
            stepsize_controller=diffrax.StepTo(ts),
            saveat=diffrax.SaveAt(t1=True, solver_state=True),
            adjoint=diffrax.ForwardMode(),
        )
        assert solution.solver_state.step_counts[order] > len(ts) - 20
        return h, np.linalg.norm(solution.ys[0] / exact - 1)

    (h1, e1), (h2, e2) = map(error, (0.06, 0.04) if order < 9 else (0.1, 0.06))
    assert np.log(e1 / e2) / np.log(h1 / h2) == pytest.approx(order + 1, abs=0.5)
