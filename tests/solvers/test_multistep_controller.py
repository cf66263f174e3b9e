"""Bad input is refused in words; hopeless problems end with a result."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.solvers import Adams, MultistepController

_DECAY = diffrax.ODETerm(lambda t, y, args: -y)


def _solve(term=_DECAY, solver=None, controller=None, dt0=None, y0=1.0, t1=1.0, **kwargs):
    solver = Adams() if solver is None else solver
    controller = MultistepController(1e-6, 1e-6) if controller is None else controller
    y0 = jnp.asarray(y0)
    kwargs = {"adjoint": diffrax.ForwardMode(), **kwargs}
    return diffrax.diffeqsolve(term, solver, 0.0, t1, dt0, y0, stepsize_controller=controller, **kwargs)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"rtol": 0.0, "atol": 1e-6}, "rtol=0.0"),
        ({"rtol": 1e-6, "atol": -1.0}, "atol=-1.0"),
        ({"rtol": float("nan"), "atol": 1e-6}, "rtol=nan"),
        ({"rtol": 1e-6, "atol": float("inf")}, "atol=inf"),
        ({"rtol": 1e-6, "atol": np.array([1e-6, 0.0])}, "atol"),
        ({"rtol": 1e-6, "atol": 1e-6, "dtmin": -1.0}, "dtmin"),
        ({"rtol": 1e-6, "atol": 1e-6, "dtmin": 1.0, "dtmax": 0.1}, "larger than"),
        ({"rtol": 1e-6, "atol": 1e-6, "force_dtmin": True}, "needs a `dtmin`"),
        ({"rtol": 1e-6, "atol": 1e-6, "safety": 1.5}, "safety"),
        ({"rtol": 1e-6, "atol": 1e-6, "factormax": 0.5}, "factormax"),
    ],
)
def test_bad_controllers(arguments, message):
    with pytest.raises(ValueError, match=message):
        MultistepController(**arguments)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"min_order": 0}, "orders 1 to 13"),
        ({"max_order": 14}, "orders 1 to 13"),
        ({"min_order": 5, "max_order": 4}, "at most `max_order`"),
        ({"rtol": 1e-6}, "both"),
    ],
)
def test_bad_solvers(arguments, message):
    with pytest.raises(ValueError, match=message):
        Adams(**arguments)


def test_tolerance_finer_than_the_precision():
    with pytest.raises(ValueError, match="float32"):
        diffrax.diffeqsolve(
            _DECAY,
            Adams(),
            jnp.float32(0),
            jnp.float32(1),
            None,
            jnp.float32(1),
            stepsize_controller=MultistepController(1e-9, 1e-9),
        )


@pytest.mark.parametrize(
    "controller",
    [
        diffrax.PIDController(1e-6, 1e-6),
        diffrax.ClipStepSizeController(diffrax.PIDController(1e-6, 1e-6), step_ts=jnp.array([0.5])),
    ],
)
def test_other_controllers_are_refused(controller):
    with pytest.raises(ValueError, match="MultistepController"):
        _solve(controller=controller)


def test_tolerances_given_twice_are_refused():
    with pytest.raises(ValueError, match="without `rtol` and `atol`"):
        _solve(solver=Adams(rtol=1e-3, atol=1e-3))


def test_other_solvers_are_refused():
    with pytest.raises(ValueError, match="multistep"):
        _solve(solver=diffrax.Tsit5())


def test_other_equations_are_refused():
    control = diffrax.LinearInterpolation(jnp.array([0.0, 1.0]), jnp.array([0.0, 1.0]))
    term = diffrax.ControlTerm(lambda t, y, args: y, control)
    with pytest.raises(ValueError, match="to_ode"):
        _solve(term)
    with pytest.raises(ValueError, match="MultiTerm"):
        _solve(diffrax.MultiTerm(_DECAY, _DECAY))


@pytest.mark.filterwarnings("ignore:Complex dtype support")
def test_complex_states_are_refused():
    with pytest.raises(ValueError, match="real and imaginary"):
        _solve(y0=1.0 + 1.0j)


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


def test_vector_field_that_is_never_finite():
    solution = _solve(diffrax.ODETerm(lambda t, y, args: y * jnp.nan), throw=False)
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


def test_states_at_rest():
    solution = _solve(diffrax.ODETerm(lambda t, y, args: 0.0 * y), y0=np.zeros(3))
    np.testing.assert_array_equal(solution.ys[-1], 0.0)
    assert solution.stats["num_steps"] < 20


def test_tolerances_by_component_and_under_a_trace():
    term = diffrax.ODETerm(lambda t, y, args: jnp.stack([-y[0], 1e3 * jnp.cos(10 * t)]))

    @jax.jit
    def steps(rtol, atol):
        solution = _solve(term, controller=MultistepController(rtol, atol), y0=[1.0, 0.0])
        return solution.stats["num_steps"]

    loose = steps(jnp.array(1e-7), jnp.array([1e-7, 1e-2]))
    assert loose < steps(jnp.array(1e-7), jnp.array([1e-7, 1e-7]))
