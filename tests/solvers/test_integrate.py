"""`integrate`: the loop for any term and any solver of diffrax; see `test_stepping.py` for what it saves."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import jaxmb as mb
from jaxmb.solvers import Adams, integrate

MOST_PROGRAMS = 25
DECAY = diffrax.ODETerm(lambda t, y, rate: -rate * y)
SWING = (diffrax.ODETerm(lambda t, p, args: p), diffrax.ODETerm(lambda t, q, args: -q))
CONTROL = diffrax.PIDController(rtol=1e-8, atol=1e-10)


@pytest.mark.slow
def test_event_of_a_run_backwards_sees_the_time_of_the_user():
    event = diffrax.Event(lambda t, y, args, *, t0, t1, **_: t - (t0 + 0.4 * (t1 - t0)), optx.Newton(1e-10, 1e-10))
    out = integrate(DECAY, diffrax.Tsit5(), 0.0, -1.0, None, 1.0, 1.5, stepsize_controller=CONTROL, event=event)
    np.testing.assert_allclose([out.ts[-1], out.ys[-1]], [-0.4, np.exp(0.6)], rtol=1e-7)
    machine = mb.mechanisms.pendulum()
    at = lambda t, y, args, **_: t + 0.2
    found = mb.simulate(machine.system, machine.state, t1=-1.0, event=diffrax.Event(at, optx.Newton(1e-10, 1e-10)))
    np.testing.assert_allclose(found.ts, [-0.2], rtol=1e-9)
    assert found.event_mask


def test_function_of_saved_states_sees_the_time_of_the_user():
    saveat = diffrax.SaveAt(ts=[-0.5, -1.0], fn=lambda t, y, args: t)
    steps = diffrax.ConstantStepSize()
    out = integrate(DECAY, diffrax.Euler(), 0.0, -1.0, -0.25, 1.0, 1.5, saveat=saveat, stepsize_controller=steps)
    np.testing.assert_allclose(out.ys, [-0.5, -1.0])


@pytest.mark.slow
def test_symplectic_method_takes_two_terms():
    options = {"dt0": 0.01, "y0": (jnp.array(1.0), jnp.array(0.0)), "max_steps": 200}
    solver = diffrax.SemiImplicitEuler()
    own, other = (run(SWING, solver, 0.0, 1.0, **options) for run in (integrate, diffrax.diffeqsolve))
    np.testing.assert_allclose(own.ys, other.ys, rtol=1e-14)
    end = lambda q, run: run(SWING, solver, 0.0, 1.0, **options | {"y0": (q, 0.0 * q)}).ys[0][-1]
    own, other = (jax.grad(end)(1.0, run) for run in (integrate, diffrax.diffeqsolve))
    np.testing.assert_allclose(own, other, rtol=1e-12)


REFUSED = {
    "solver of two terms": (DECAY, diffrax.SemiImplicitEuler(), "SemiImplicitEuler integrates terms of the form"),
    "two terms": (SWING, diffrax.Tsit5(), r"Tsit5 integrates terms of the form .*got \('ODETerm', 'ODETerm'\)"),
    "implicit method of given steps": (DECAY, diffrax.Kvaerno5(), "Kvaerno5 takes its tolerances from the step size"),
    "multistep method of given steps": (DECAY, Adams(), "Adams takes its tolerances from the step size controller"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_solver_that_cannot_be_driven_is_named(name):
    terms, solver, message = REFUSED[name]
    with pytest.raises(ValueError, match=message):
        integrate(terms, solver, 0.0, 1.0, 0.1, jnp.ones(1), 1.5)
    machine = mb.mechanisms.pendulum()
    if name == "solver of two terms":
        with pytest.raises(ValueError, match=message):
            mb.simulate(machine.system, machine.state, t1=0.1, solver=solver)
