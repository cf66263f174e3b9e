"""Everything diffrax offers works with the multistep solver: saving, events, jumps, batches, backward time, pytrees."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from compiling import jit_as_users_do

from jaxmb.solvers import Adams, MultistepController

CONTROLLER = MultistepController(1e-8, 1e-8)


def _oscillator(t, y, omega):
    return {"x": y["v"], "v": -(omega**2) * y["x"]}


def _exact(t, omega=1.0):
    return {"x": jnp.cos(omega * t), "v": -omega * jnp.sin(omega * t)}


def _solve(t0=0.0, t1=4.0, *, y0=None, omega=1.0, vector_field=_oscillator, controller=CONTROLLER, dt0=None, **kwargs):
    y0 = _exact(jnp.asarray(t0)) if y0 is None else y0
    term = diffrax.ODETerm(vector_field)
    kwargs = {"adjoint": diffrax.ForwardMode(), **kwargs}
    return diffrax.diffeqsolve(term, Adams(), t0, t1, dt0, y0, omega, stepsize_controller=controller, **kwargs)


def _assert_close(a, b, atol=2e-7):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=atol, rtol=0), a, b)


@pytest.mark.slow
def test_every_form_of_saving():
    ts = jnp.linspace(0.0, 4.0, 9)
    subs = {
        "ends": diffrax.SubSaveAt(t0=True, t1=True),
        "ts": diffrax.SubSaveAt(ts=ts),
        "steps": diffrax.SubSaveAt(steps=3, fn=lambda t, y, args: y["x"]),
    }
    saveat = diffrax.SaveAt(subs=subs, dense=True, solver_state=True, controller_state=True, made_jump=True)
    solution = _solve(saveat=saveat, max_steps=256)
    np.testing.assert_allclose(solution.ts["ends"], [0.0, 4.0])
    _assert_close(solution.ys["ts"], _exact(ts))
    saved = np.isfinite(solution.ts["steps"])
    assert saved.sum() == solution.stats["num_accepted_steps"] // 3
    _assert_close(solution.ys["steps"][saved], jnp.cos(solution.ts["steps"][saved]))
    _assert_close(jax.vmap(solution.evaluate)(ts), _exact(ts))
    assert solution.made_jump is False or not solution.made_jump


@pytest.mark.slow
def test_backward_in_time_mirrors_forward():
    ts = jnp.linspace(4.0, 0.0, 9)
    solution = _solve(4.0, 0.0, saveat=diffrax.SaveAt(ts=ts, dense=True), max_steps=256)
    _assert_close(solution.ys, _exact(ts))
    _assert_close(jax.vmap(solution.evaluate)(ts), _exact(ts))
    mirrored = lambda t, y, omega: jax.tree.map(jnp.negative, _oscillator(-t, y, omega))
    forward = _solve(0.0, 4.0, saveat=diffrax.SaveAt(steps=True), max_steps=128)
    backward = _solve(0.0, -4.0, vector_field=mirrored, saveat=diffrax.SaveAt(steps=True), max_steps=128)
    n = int(forward.stats["num_accepted_steps"])
    np.testing.assert_allclose(forward.ts[:n], -backward.ts[:n], rtol=0, atol=1e-12)
    _assert_close(jax.tree.map(lambda x: x[:n], forward.ys), jax.tree.map(lambda x: x[:n], backward.ys), atol=1e-12)


@pytest.mark.slow
def test_event_is_located():
    event = diffrax.Event(lambda t, y, args, **kwargs: y["x"], optx.Newton(1e-12, 1e-12))
    solution = _solve(event=event)
    assert solution.result == diffrax.RESULTS.event_occurred
    np.testing.assert_allclose(solution.ts, [np.pi / 2], rtol=0, atol=1e-7)

    def time_of_event(omega):
        return _solve(omega=omega, event=event, y0={"x": jnp.array(1.0), "v": jnp.array(0.0)}).ts[0]

    np.testing.assert_allclose(jax.jit(jax.jacfwd(time_of_event))(jnp.array(1.0)), -np.pi / 2, rtol=0, atol=1e-5)


@pytest.mark.slow
def test_batch_equals_loop():
    omegas = jnp.array([0.5, 1.0, 7.0, 20.0])
    # A step may err by 1e-8, a twentieth of this: shorter steps gather more rounding errors than the bound allows.
    controller = MultistepController(2e-7, 2e-7)
    saved = diffrax.SaveAt(ts=jnp.linspace(0.0, 4.0, 5), solver_state=True)

    def run(omega):
        solution = _solve(omega=omega, dt0=0.5, saveat=saved, controller=controller)
        return solution.ys, solution.stats["num_rejected_steps"], solution.solver_state.step_counts

    batch = jit_as_users_do(jax.vmap(run))(omegas)
    single = jit_as_users_do(run)
    loop = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[single(omega) for omega in omegas])
    assert np.all(batch[1] > 0) and len(set(np.sum(batch[2], axis=1).tolist())) > 1
    np.testing.assert_array_equal(batch[1], loop[1])
    np.testing.assert_array_equal(batch[2], loop[2])
    _assert_close(batch[0], loop[0], atol=1e-12)


@pytest.mark.slow
def test_continuation_repeats_the_unbroken_solve():
    """With solver and controller state a solve in two parts has no second start."""
    keep = diffrax.SaveAt(t1=True, solver_state=True, controller_state=True, made_jump=True)
    first = _solve(0.0, 2.0, saveat=keep)
    y = jax.tree.map(lambda x: x[-1], first.ys)
    second = _solve(
        2.0, 4.0, y0=y, saveat=keep, solver_state=first.solver_state, controller_state=first.controller_state, dt0=0.02
    )
    _assert_close(jax.tree.map(lambda x: x[-1], second.ys), _exact(4.0))
    assert second.solver_state.step_counts[0] == 1
    whole = _solve(0.0, 4.0, saveat=keep)
    assert second.solver_state.step_counts.sum() < whole.solver_state.step_counts.sum() + 10
    jumped = _solve(2.0, 4.0, y0=y, saveat=keep, solver_state=first.solver_state, made_jump=True)
    _assert_close(jax.tree.map(lambda x: x[-1], jumped.ys), _exact(4.0))
    assert jumped.solver_state.step_counts[0] == 2


def _pulse(t, y, args):
    return jnp.where(t < 1.0, -y, -y + 3.0 * jnp.cos(t))


def test_unannounced_jump_is_found():
    """With few steps rejected; with too few steps in all, the result says so."""
    solve = jax.jit(lambda t1: _solve(0.0, t1, y0=jnp.array([2.0]), vector_field=_pulse, max_steps=200, throw=False))
    found = solve(3.0)
    a, forced = 2.0 * np.exp(-1.0), lambda t: 1.5 * (np.cos(t) + np.sin(t))
    np.testing.assert_allclose(found.ys[-1], [forced(3.0) + (a - forced(1.0)) * np.exp(-2.0)], rtol=0, atol=1e-6)
    assert found.stats["num_rejected_steps"] < 40
    assert solve(1e3).result == diffrax.RESULTS.max_steps_reached


@pytest.mark.slow
def test_stepping_to_times_costs_little():
    """Also after a very short step."""
    options = {"saveat": diffrax.SaveAt(steps=True), "max_steps": 512}
    to = lambda stops, tolerance: diffrax.ClipStepSizeController(
        MultistepController(tolerance, tolerance), step_ts=jnp.asarray(stops)
    )
    stops = np.linspace(0.05, 3.95, 40)
    solution = _solve(controller=to(stops, 1e-6), **options)
    n = int(solution.stats["num_accepted_steps"])
    assert all(np.min(np.abs(np.asarray(solution.ts[:n]) - stop)) == 0 for stop in stops)
    assert solution.stats["num_rejected_steps"] < 20
    _assert_close(jax.tree.map(lambda x: x[n - 1], solution.ys), _exact(4.0), atol=1e-4)
    plain, clipped = _solve(**options), _solve(controller=to([2.0, 2.0 + 1e-5], 1e-8), **options)
    assert clipped.stats["num_steps"] < plain.stats["num_steps"] + 12
    n = int(clipped.stats["num_accepted_steps"])
    _assert_close(jax.tree.map(lambda x: x[n - 1], clipped.ys), _exact(4.0))
