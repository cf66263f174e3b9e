"""Bad input is refused in words; hopeless problems end with a result."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.solvers import Adams, MultistepController
from jaxmb.solvers.order import StepEstimate

_DECAY = diffrax.ODETerm(lambda t, y, args: -y)


def _solve(term=_DECAY, solver=None, controller=None, dt0=None, y0=1.0, t0=0.0, t1=1.0, **kwargs):
    solver = Adams() if solver is None else solver
    controller = MultistepController(1e-6, 1e-6) if controller is None else controller
    y0 = jnp.asarray(y0)
    kwargs = {"adjoint": diffrax.ForwardMode(), **kwargs}
    return diffrax.diffeqsolve(term, solver, t0, t1, dt0, y0, stepsize_controller=controller, **kwargs)


PID = diffrax.PIDController(1e-6, 1e-6)
CONTROL = diffrax.LinearInterpolation(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
SINGLE = {"t0": jnp.float32(0), "t1": jnp.float32(1), "y0": np.float32(1)}
controller = lambda **arguments: lambda: MultistepController(**({"rtol": 1e-6, "atol": 1e-6} | arguments))
REFUSED = [
    (controller(rtol=0.0), "rtol=0.0"),
    (controller(atol=-1.0), "atol=-1.0"),
    (controller(rtol=float("nan")), "rtol=nan"),
    (controller(atol=float("inf")), "atol=inf"),
    (controller(atol=np.array([1e-6, 0.0])), "atol"),
    (controller(dtmin=-1.0), "dtmin"),
    (controller(dtmin=1.0, dtmax=0.1), "larger than"),
    (controller(force_dtmin=True), "needs a `dtmin`"),
    (controller(safety=1.5), "safety"),
    (controller(factormax=0.5), "factormax"),
    (lambda: Adams(min_order=0), "orders 1 to 13"),
    (lambda: Adams(max_order=14), "orders 1 to 13"),
    (lambda: Adams(min_order=5, max_order=4), "at most `max_order`"),
    (lambda: Adams(rtol=1e-6), "both"),
    (lambda: _solve(controller=MultistepController(1e-9, 1e-9), **SINGLE), "float32"),
    (lambda: _solve(controller=PID), "MultistepController"),
    (lambda: _solve(controller=diffrax.ClipStepSizeController(PID, step_ts=np.array([0.5]))), "MultistepController"),
    (lambda: _solve(solver=Adams(rtol=1e-3, atol=1e-3)), "without `rtol` and `atol`"),
    (lambda: _solve(solver=diffrax.Tsit5()), "multistep"),
    (lambda: _solve(diffrax.ControlTerm(lambda t, y, args: y, CONTROL)), "to_ode"),
    (lambda: _solve(diffrax.MultiTerm(_DECAY, _DECAY)), "MultiTerm"),
    (lambda: _solve(y0=1.0 + 1.0j), "real and imaginary"),
]


@pytest.mark.filterwarnings("ignore:Complex dtype support")
def test_refused():
    for call, message in REFUSED:
        with pytest.raises(ValueError, match=message):
            call()


def test_next_step_answers_to_the_error_by_a_power():
    """A step that is good grows, one that is not is repeated shorter; without earlier steps all of them change."""
    controller = MultistepController(1e-6, 1e-6, safety=0.5)

    @jax.jit
    def factor(error, opening, response):
        one = jnp.ones(())
        estimate = StepEstimate(error, 1.28 * one, 0.32 * one, response, 2.0 * one, jnp.zeros(2))
        start = controller.init(_DECAY, one, 2 * one, one, 0.1 * one, None, None, None)[1]
        start = start.__class__(start.intended, start.counters.at[2].set(opening))
        keep, begins, ends, *_ = controller.adapt_step_size(one, 1.1 * one, one, one, None, estimate, None, start)
        return keep, (ends - begins) / 0.1

    # Half of 1.28 and half of 0.32, to the power.
    for error, opening, response, expected in ((0.5, 0, 0.5, 0.8), (0.5, 1, 0.5, 0.64), (2.0, 0, 0.5, 0.4)):
        keep, found = factor(error, opening, response)
        assert keep == (error < 1)
        np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_tolerances_under_a_trace():
    """By component; a state at rest takes few steps, and a field that is never finite ends with the smallest one."""

    @jax.jit
    def run(rtol, atol, factor):
        term = diffrax.ODETerm(lambda t, y, args: factor * jnp.stack([-y[0], 1e3 * jnp.cos(10 * t)]))
        return _solve(term, controller=MultistepController(rtol, atol), y0=np.array([1.0, 0.0]), throw=False)

    found, tight = run(1e-7, np.array([1e-7, 1e-2]), 1.0), run(1e-7, np.array([1e-7, 1e-7]), 1.0)
    assert found.stats["num_steps"] < tight.stats["num_steps"]
    np.testing.assert_allclose(tight.ys[0], [np.exp(-1.0), 100 * np.sin(10.0)], rtol=0, atol=1e-4)
    rest = run(1e-6, np.full(2, 1e-6), 0.0)
    np.testing.assert_array_equal(rest.ys[0], [1.0, 0.0])
    assert rest.stats["num_steps"] < 20
    assert run(1e-6, np.full(2, 1e-6), np.nan).result == diffrax.RESULTS.dt_min_reached


@pytest.mark.slow
def test_blow_up_ends_with_the_smallest_step():
    """`y' = y^2` from one is infinite at one."""
    term = diffrax.ODETerm(lambda t, y, args: y**2)
    solution = _solve(term, t1=2.0, throw=False, max_steps=2000)
    assert solution.result == diffrax.RESULTS.dt_min_reached
    with pytest.raises(Exception, match="minimum step size"):
        _solve(term, t1=2.0, max_steps=2000)


@pytest.mark.slow
def test_undefined_region_is_left_at_once():
    """A first step into where the square root is undefined is retried smaller."""
    term = diffrax.ODETerm(lambda t, y, args: -jnp.sqrt(y))
    solution = _solve(term, dt0=5.0, t1=1.0)
    np.testing.assert_allclose(solution.ys[-1], 0.25, rtol=0, atol=1e-5)
    solution = _solve(term, dt0=5.0, t1=3.0, throw=False)
    assert solution.result == diffrax.RESULTS.dt_min_reached


@pytest.mark.slow
def test_bounds_of_the_step():
    saveat = diffrax.SaveAt(t0=True, steps=True)
    steps = lambda s: np.diff(np.asarray(s.ts[: int(s.stats["num_accepted_steps"]) + 1]))
    rough = diffrax.ODETerm(lambda t, y, args: 50 * jnp.cos(50 * t) * y)
    solution = _solve(controller=MultistepController(1e-6, 1e-6, dtmax=0.02), saveat=saveat, max_steps=128)
    assert np.max(steps(solution)) < 0.02 * (1 + 1e-12)
    solution = _solve(rough, controller=MultistepController(1e-9, 1e-9, dtmin=0.01), throw=False)
    assert solution.result == diffrax.RESULTS.dt_min_reached
    forced = MultistepController(1e-9, 1e-9, dtmin=0.01, force_dtmin=True)
    solution = _solve(rough, controller=forced, saveat=saveat, max_steps=128)
    assert np.min(steps(solution)[:-1]) > 0.01 * (1 - 1e-12)


@pytest.mark.slow
def test_tolerances_beyond_rounding_have_the_same_steps():
    """All that ask for more than rounding errors allow."""
    swing = diffrax.ODETerm(lambda t, y, args: jnp.array([y[1], -jnp.sin(y[0])]))
    run = lambda tol: _solve(swing, None, MultistepController(tol, tol), y0=np.array([1.0, 0.0]), t1=10.0)
    first, second = run(1e-12), run(1e-13)
    assert first.stats["num_steps"] == second.stats["num_steps"]
    np.testing.assert_array_equal(first.ys, second.ys)
