"""The loop over steps does what diffrax's own does."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from jaxmb.solvers import integrate


def falling(t, y, args, **_):
    del t, args
    return y[0] + 0.4


EVENT = {"root_finder": optx.Newton(1e-10, 1e-10)}
CASES = {
    "start, times and end": {"saveat": diffrax.SaveAt(t0=True, ts=jnp.linspace(0.0, 3.0, 7), t1=True)},
    "each third step": {"saveat": diffrax.SaveAt(t0=True, steps=3, t1=True)},
    "two series": {
        "saveat": diffrax.SaveAt(
            subs=[diffrax.SubSaveAt(ts=jnp.array([0.5, 2.5])), diffrax.SubSaveAt(t1=True, fn=lambda t, y, _: y[0] + t)]
        )
    },
    "dense": {"saveat": diffrax.SaveAt(dense=True, t1=True)},
    "event upwards": {"event": diffrax.Event(falling, **EVENT, direction=True)},
    "event among times": {
        "event": diffrax.Event(falling, **EVENT),
        "saveat": diffrax.SaveAt(ts=jnp.linspace(0.0, 3.0, 7), t1=True),
    },
    "event among steps": {"event": diffrax.Event(falling, **EVENT), "saveat": diffrax.SaveAt(steps=2, t1=True)},
    "event without a search": {"event": diffrax.Event(falling)},
    "event that ends its function": {"event": diffrax.Event(lambda t, y, args, **_: jnp.sqrt(y[0] + 0.4) + 1.0)},
    "truth": {"event": diffrax.Event(lambda t, y, args, **_: t > 1.0)},
    "two events": {"event": diffrax.Event([lambda t, *_, **__: t > 1.5, falling], **EVENT)},
    "too few steps": {"max_steps": 4, "throw": False},
    "no time": {"t1": 0.0, "saveat": diffrax.SaveAt(t0=True, ts=jnp.zeros(2), t1=True)},
    "backwards": {"t1": -3.0, "saveat": diffrax.SaveAt(ts=jnp.linspace(0.0, -3.0, 7))},
    "given steps": {"stepsize_controller": diffrax.StepTo(jnp.linspace(0.0, 3.0, 31)), "dt0": None},
    "jump": {
        "stepsize_controller": diffrax.ClipStepSizeController(
            diffrax.PIDController(rtol=1e-6, atol=1e-8), jump_ts=jnp.array([1.0])
        )
    },
}


SWING = diffrax.ODETerm(lambda t, y, args: jnp.stack([y[1], -4.0 * y[0]]))


def solve(integrate=diffrax.diffeqsolve, **given):
    options = {"t0": 0.0, "t1": 3.0, "dt0": None, "stepsize_controller": diffrax.PIDController(rtol=1e-6, atol=1e-8)}
    options["terms"] = diffrax.ODETerm(lambda t, y, args: jnp.stack([y[1], -4.0 * y[0] + jnp.where(t > 1.0, 1.0, 0.0)]))
    return integrate(**{"solver": diffrax.Tsit5(), "y0": jnp.array([1.0, 0.0]), **options, **given})


@pytest.mark.slow(but=("jump",))
@pytest.mark.parametrize("name", CASES)
def test_solve_is_that_of_diffrax(name):
    own, other = solve(integrate, **CASES[name]), solve(**CASES[name])
    assert own.result == other.result and own.stats == other.stats
    for a, b in zip(*(jax.tree.leaves((x.ts, x.ys, x.event_mask)) for x in (own, other)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
    if name == "dense":
        np.testing.assert_allclose(own.evaluate(1.3), other.evaluate(1.3), rtol=1e-12)


@pytest.mark.slow
def test_event_in_a_batch_beside_members_without_one():
    """A member that fails stops no other, and one without an event ends where it ends alone."""

    def at_event(start, **options):
        start = jnp.stack([start, 0.0 * start])
        event = diffrax.Event(falling, **EVENT)
        return solve(**{"integrate": integrate} | options, y0=start, event=event, throw=False)

    swings = jax.vmap(jax.value_and_grad(lambda start: at_event(start, terms=SWING).ts[0]))
    times, rates = swings(jnp.array([1.0, jnp.nan, 0.5]))
    exact = lambda start: np.arccos(-0.4 / start) / 2
    slope = lambda start: -0.2 / start**2 / np.sqrt(1 - (0.4 / start) ** 2)
    np.testing.assert_allclose(times[::2], [exact(1.0), exact(0.5)], rtol=1e-5)
    np.testing.assert_allclose(rates[::2], [slope(1.0), slope(0.5)], rtol=1e-4)
    # Some members end with their last step, before an event. Steps of a batch are not quite those of one member.

    def in_steps(integrate):
        ends = lambda found: (found.ts[0], found.ys[0])
        run = lambda start: ends(at_event(start, integrate=integrate, max_steps=12))
        return jax.vmap(run)(jnp.array([1.0, 0.5, 0.3]))

    own, other = in_steps(integrate), in_steps(diffrax.diffeqsolve)
    for one, known in zip(own, other, strict=True):
        np.testing.assert_allclose(one, known, rtol=1e-12)


@pytest.mark.slow
def test_time_of_an_event_beside_one_without_a_derivative():
    def at_event(rate):
        norm = lambda t, y, args, **_: jnp.sqrt(y[2] ** 2 + y[3] ** 2) - 1.0
        term = diffrax.ODETerm(lambda t, y, args: jnp.stack([y[1], -rate * y[0], 0.0 * y[0], 0.0 * y[0]]))
        start, event = jnp.array([1.0, 0.0, 0.0, 0.0]), diffrax.Event([norm, falling], **EVENT)
        return solve(integrate, terms=term, y0=start, event=event).ts[0]

    exact = -np.arccos(-0.4) / 16
    np.testing.assert_allclose([jax.grad(at_event)(4.0), jax.jacfwd(at_event)(4.0)], exact, rtol=1e-4)
