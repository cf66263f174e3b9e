"""Work against precision, orders of convergence, and the accuracy of dense output."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ode_problems import PROBLEMS, evaluations_at, kepler, work_precision

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
@pytest.mark.parametrize(
    "name", ["kepler 0.6", *(pytest.param(name, marks=pytest.mark.slow) for name in PROBLEMS if name != "kepler 0.6")]
)
def test_errors_at_equal_tolerance_are_those_of_a_runge_kutta_method(name):
    # Every half decade: a single run is lucky or unlucky.
    tolerances = 10.0 ** -np.arange(4.0, 11.1, 0.5)
    adams, dopri8 = (work_precision(PROBLEMS[name], tolerances, solver=solver)[0] for solver in ("adams", "dopri8"))
    ratios = adams / dopri8
    assert np.median(ratios) <= 3 and np.max(ratios) <= 15


def _clock(t, y, rate):
    return rate * jnp.stack([-y[1], y[0]])


@pytest.fixture(scope="module")
def clock():
    """A function that turns the hand of a clock from 0 to 6, and returns the whole solution."""

    @jax.jit
    def run(tolerance):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(_clock),
            Adams(),
            0.0,
            6.0,
            None,
            jnp.array([1.0, 0.0]),
            jnp.array(1.0),
            stepsize_controller=MultistepController(tolerance, tolerance),
            saveat=diffrax.SaveAt(t1=True, dense=True, solver_state=True),
            max_steps=512,
        )

    return run


@pytest.mark.slow
def test_high_orders_are_reached(clock):
    step_counts = np.asarray(clock(1e-10).solver_state.step_counts)
    assert step_counts[0] == 1
    assert step_counts[8:].sum() > step_counts[1:8].sum()
    assert np.argmax(step_counts) >= 8


def test_error_follows_tolerance(clock):
    exact = jnp.array([jnp.cos(6.0), jnp.sin(6.0)])
    errors = [float(jnp.max(jnp.abs(clock(tolerance).ys[0] - exact))) for tolerance in (1e-4, 1e-6, 1e-8, 1e-10)]
    assert all(error < 50 * tolerance for error, tolerance in zip(errors, (1e-4, 1e-6, 1e-8, 1e-10), strict=True))


def test_dense_output(clock):
    solution = clock(1e-9)
    ts = jnp.linspace(0.0, 6.0, 301)
    exact = jnp.stack([jnp.cos(ts), jnp.sin(ts)], axis=1)
    ys = jax.jit(jax.vmap(solution.evaluate))(ts)
    assert jnp.max(jnp.abs(ys - exact)) < 2e-8
    slopes = jax.jit(jax.vmap(solution.derivative))(ts)
    assert jnp.max(jnp.abs(slopes - jax.vmap(lambda y: _clock(0.0, y, 1.0))(exact))) < 1e-6


@pytest.mark.slow
def test_dense_output_is_continuously_differentiable(clock):
    solution = clock(1e-6)
    mesh = solution.interpolation.ts[1 : int(solution.stats["num_accepted_steps"])]
    before = lambda f: jax.jit(jax.vmap(lambda t: f(t, left=True)))(mesh)
    after = lambda f: jax.jit(jax.vmap(lambda t: f(t, left=False)))(mesh)
    np.testing.assert_allclose(before(solution.evaluate), after(solution.evaluate), rtol=0, atol=1e-14)
    np.testing.assert_allclose(before(solution.derivative), after(solution.derivative), rtol=0, atol=1e-12)


def test_dense_output_increment(clock):
    solution = clock(1e-8)
    increment = solution.evaluate(2.0, 2.01)
    np.testing.assert_allclose(increment, solution.evaluate(2.01) - solution.evaluate(2.0), rtol=0, atol=1e-15)


@pytest.mark.slow
def test_saving_at_times_uses_dense_output():
    """Interpolated values have the accuracy of the steps, on a problem whose steps vary a lot."""
    problem = PROBLEMS["kepler 0.9"]
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(kepler),
        Adams(),
        0.0,
        20.0,
        None,
        jnp.asarray(problem.y0),
        stepsize_controller=MultistepController(1e-11, 1e-11),
        saveat=diffrax.SaveAt(ts=jnp.asarray(problem.ts)),
    )
    np.testing.assert_allclose(solution.ys, problem.ys, rtol=0, atol=2e-8)


def _mesh(h, t1):
    """Equal steps of about `h`, after an opening fine enough for order one, and gentle enough for high orders."""
    first = 1e-5
    count = int(np.ceil(np.log(h / first) / np.log(1.06)))
    opening = np.cumsum(np.concatenate([[0.0, first, first], h * 1.06 ** -np.arange(count, 0, -1.0)]))
    rest = np.linspace(opening[-1], t1, int(np.ceil((t1 - opening[-1]) / h)) + 1)
    return np.concatenate([opening, rest[1:]]), rest[1] - rest[0]


@pytest.mark.slow
@pytest.mark.parametrize("order", range(1, 14))
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
