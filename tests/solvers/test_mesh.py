"""Derivatives on the mesh of a run against closed forms."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from jaxmb.solvers import Adams, MultistepController, integrate
from jaxmb.solvers.adams_steps import _at_start
from jaxmb.solvers.directed import Directed
from jaxmb.solvers.mesh import Saved, _saved, _unsaved
from jaxmb.solvers.segments import AtEvent, Row


def decay(rate, start, **options):
    return integrate(
        diffrax.ODETerm(lambda t, y, rate: -rate * y),
        Adams(),
        0.0,
        2.0,
        None,
        start[None],
        rate,
        stepsize_controller=MultistepController(1e-10, 1e-10),
        max_steps=256,
        **options,
    )


def test_cotangents_of_saved_states_and_of_the_time_of_an_event():
    saveat, weights = diffrax.SaveAt(t0=True, ts=[0.5, 1.5], t1=True), np.array([0.3, -1.0, 2.0, 0.7])
    event = diffrax.Event(lambda t, y, args, **kwargs: y[0] - 0.1, optx.Newton(rtol=1e-12, atol=1e-12))
    rate, start = 1.3, 0.8

    @jax.jit
    def run(rate, start):
        def seen(rate, start):
            out = decay(rate, start, saveat=saveat, event=event)
            return jnp.stack([weights @ out.ys[:, 0], out.ts[-1]])

        found, pull = jax.vjp(seen, rate, start)
        return found, jnp.stack(jax.vmap(pull)(jnp.eye(2)), axis=1)

    (total, end), found = run(rate, start)
    np.testing.assert_allclose(end, np.log(start / 0.1) / rate, rtol=1e-8)
    # The state at the event does not change.
    ts, inner = np.array([0.0, 0.5, 1.5]), weights[:3]
    decayed = np.exp(-rate * ts)
    np.testing.assert_allclose(total, start * inner @ decayed + 0.07, rtol=1e-8)
    np.testing.assert_allclose(found[0], [-start * inner @ (ts * decayed), inner @ decayed], rtol=1e-7)
    np.testing.assert_allclose(found[1], [-np.log(start / 0.1) / rate**2, 1 / (start * rate)], rtol=1e-7)


def test_the_first_row_has_the_field_at_the_start():
    field = lambda t, y, args: jnp.stack([y[1], -jnp.sin(y[0]) + t])
    solver, term, start = Adams(rtol=1e-6, atol=1e-6), Directed(diffrax.ODETerm(field), 1), np.array([0.4, 1.2])
    step = lambda: solver.step(term, 0.1, 0.2, start, None, solver.init(term, 0.1, 0.2, start, None), False)
    found = jax.jit(lambda: _at_start(term, step()[3])[0])()
    np.testing.assert_allclose(found, [start[1], -np.sin(start[0]) + 0.1], rtol=1e-14)


def test_cotangents_of_events_go_to_their_steps():
    """The transpose of the table of events, in which the next event takes the place of a void one: an event may end the
    very step that finds the one before it void.
    """
    here = np.array([1, 1, 0, 1, 0, 1, 1, 1], bool)
    void = np.array([0, 1, 0, 0, 1, 0, 1, 0], bool)
    rows = Row(0.0, 0.0, AtEvent(jnp.asarray(here), jnp.asarray(void)), None)
    series = Saved(False, None, 0, True, here.size, jnp.zeros(2, int))
    at_step = lambda k: jax.tree.map(lambda x: x[k], rows.at_event)

    @jax.jit
    def tables(w, cotangents):
        table, place = jnp.zeros(here.size), jnp.zeros(2, int)
        for k in range(here.size):
            table, place = _saved(series, table, place, k, rows._replace(at_event=at_step(k)), w[k], None, None)
        back, of_place = [], place
        for k in reversed(range(here.size)):
            row = rows._replace(at_event=at_step(k))
            lw, _, of_place = _unsaved(series, cotangents, of_place, k, row, jnp.zeros(()), None, None)
            back.append(lw)
        return table, place, jnp.stack(back[::-1])

    w, cotangents = np.random.default_rng(0).normal(size=(2, here.size))
    table, place, back = tables(w, cotangents)
    kept = here & ~np.append(void[1:], False)
    np.testing.assert_allclose(table[: place[0]], w[kept])
    np.testing.assert_array_equal(back != 0, kept)
    np.testing.assert_allclose(back[kept], cotangents[: place[0]])
