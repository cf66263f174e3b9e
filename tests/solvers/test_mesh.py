"""Derivatives on the mesh of a run against closed forms."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from jaxmb._compat import WrapTerm
from jaxmb.solvers import Adams, MeshAdjoint, MultistepController
from jaxmb.solvers.adams_steps import _at_start


def decay(rate, start, **options):
    return diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, rate: -rate * y),
        Adams(),
        0.0,
        2.0,
        None,
        start[None],
        rate,
        stepsize_controller=MultistepController(1e-10, 1e-10),
        adjoint=MeshAdjoint(256),
        max_steps=256,
        **options,
    )


RATE, START = jnp.array(1.3), jnp.array(0.8)


def test_cotangents_of_all_saved_states_reach_the_start():
    saveat = diffrax.SaveAt(t0=True, ts=[0.5, 1.5], t1=True)
    weights = np.array([0.3, -1.0, 2.0, 0.7])
    loss = lambda rate, start: jnp.sum(weights * decay(rate, start, saveat=saveat).ys[:, 0])
    found = jax.jit(jax.grad(loss, (0, 1)))(RATE, START)
    ts = np.array([0.0, 0.5, 1.5, 2.0])
    decayed = np.exp(-RATE * ts)
    np.testing.assert_allclose(found, [-START * weights @ (ts * decayed), weights @ decayed], rtol=1e-7)


def test_the_time_of_an_event_has_its_derivative():
    event = diffrax.Event(lambda t, y, args, **kwargs: y[0] - 0.2, optx.Newton(rtol=1e-12, atol=1e-12))
    time = lambda rate, start: decay(rate, start, event=event).ts[-1]
    found = jax.jit(jax.grad(time, (0, 1)))(RATE, START)
    np.testing.assert_allclose(found, [-np.log(START / 0.2) / RATE**2, 1 / (START * RATE)], rtol=1e-7)


def test_the_first_row_has_the_field_at_the_start():
    field = lambda t, y, args: jnp.stack([y[1], -jnp.sin(y[0]) + t])
    solver, term, start = Adams(rtol=1e-6, atol=1e-6), WrapTerm(diffrax.ODETerm(field), 1), jnp.array([0.4, 1.2])
    step = lambda: solver.step(term, 0.1, 0.2, start, None, solver.init(term, 0.1, 0.2, start, None), False)
    np.testing.assert_allclose(_at_start(term, jax.jit(step)()[3])[0], field(0.1, start, None), rtol=1e-14)
