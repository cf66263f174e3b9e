"""The estimate of the global error that a simulation gives beside its result."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb

MACHINES = {"four_bar": 2.0, "heavy_top": 1.0, "roller_racer": 2.0, "slider_crank": 0.2, "bricard": 2.0}


@pytest.mark.slow
@pytest.mark.parametrize("name", MACHINES)
def test_estimates_are_of_the_size_of_errors(name):
    mechanism, end = mb.mechanisms.get(name), MACHINES[name]
    times = np.linspace(0, end, 9)[1:]
    run = lambda rtol, **options: mb.simulate(
        mechanism.system, mechanism.state, t1=end, saveat=times, rtol=rtol, max_steps=20000, **options
    )
    exact = run(1e-13)
    size = lambda ys: np.maximum(np.max(np.abs(ys), axis=0), 1.0)[None]
    ratios = []
    for rtol in (1e-4, 1e-6, 1e-8, 1e-10):
        found = run(rtol, error=True)
        for part in (lambda ys: np.asarray(ys.q), lambda ys: np.asarray(ys.u)):
            # The largest relative error of the coordinates, and of the velocities, at each time.
            unit = size(part(exact.ys))
            true = np.max(np.abs(part(found.ys) - part(exact.ys)) / unit, axis=1)
            ratios.append(true / np.max(part(found.error.ys) / unit, axis=1))
    ratios = np.concatenate(ratios)
    assert np.mean((ratios > 0.1) & (ratios < 10)) >= 0.95 and np.max(ratios) < 100, np.sort(ratios)[[0, 1, -2, -1]]


@pytest.mark.slow
@pytest.mark.parametrize("solver, rtol", [(mb.solvers.Adams(), 1e-12), (mb.solvers.Hermite(), 2e-10)])
def test_estimates_where_a_tighter_tolerance_has_the_same_steps(solver, rtol):
    """Near rounding tolerances of a range mean the same error of a step."""
    mechanism = mb.mechanisms.get("pendulum")
    run = lambda rtol, **options: mb.simulate(mechanism.system, mechanism.state, t1=3.0, rtol=rtol, **options)
    found, exact = run(rtol, solver=solver, error=True), run(2e-14, solver=diffrax.Dopri8())
    true = np.max(np.abs(found.ys.u - exact.ys.u))
    assert true / 5 < np.max(found.error.ys.u) < 5 * true


def test_tolerances_without_room_for_a_second_run_are_refused():
    mechanism = mb.mechanisms.get("pendulum")
    with pytest.raises(ValueError, match=r"leaves no room for .* give at least 2\.3e-14"):
        mb.simulate(mechanism.system, mechanism.state, t1=0.1, rtol=1e-14, error=True)
    with pytest.raises(ValueError, match=r"below what double precision can do; use at least 2\.3e-15"):
        mb.simulate(mechanism.system, mechanism.state, t1=0.1, rtol=1e-15)


@pytest.mark.slow("2.3e-14-True")
@pytest.mark.parametrize("rtol, error", [(2.3e-14, True), (2.3e-15, False)])
def test_the_least_tolerances_that_messages_name_are_accepted(rtol, error):
    mechanism = mb.mechanisms.get("pendulum")
    mb.simulate(mechanism.system, mechanism.state, t1=0.1, rtol=rtol, error=error)


@pytest.mark.slow
def test_quantities_batches_and_derivatives():
    mechanism = mb.mechanisms.get("pendulum")
    system, name = mechanism.system, next(iter(mechanism.system.quantities()))

    @jax.jit
    @jax.vmap
    def run(rtol):
        sol = mb.simulate(system, mechanism.state, t1=1.0, rtol=rtol, error=True)
        return sol.error.ys, sol.error.quantity(name), sol.error.of(lambda trajectory: trajectory.energy)

    of_states, of_quantity, of_energy = run(jnp.array([1e-5, 1e-9]))
    assert np.all(of_energy[0] > 10 * of_energy[1])
    assert np.all(np.max(of_states.u[0], axis=-1) > 10 * np.max(of_states.u[1], axis=-1))
    assert of_quantity.shape[0] == 2

    # The estimate has no derivatives, and those of the motion stay as they are.
    angle = lambda u, **options: mb.simulate(
        system, mb.State(mechanism.state.q, mechanism.state.u + u), t1=0.2, **options
    )
    at, along = jnp.zeros_like(system.guess.u), mechanism.state.u + system.guess.u + 1.0

    def estimated(u):
        motion = angle(u, error=True, throw=False)
        return motion.ys.q, motion.error.ys, motion.error.largest, motion.error.quantity(name)

    (with_estimate, *of_estimate) = jax.jvp(estimated, (at,), (along,))[1]
    plain = jax.jvp(lambda u: angle(u, throw=False).ys.q, (at,), (along,))[1]
    assert np.any(plain != 0)
    np.testing.assert_array_equal(with_estimate, plain)
    assert not any(np.any(tangent) for tangent in jax.tree.leaves(of_estimate))


@pytest.mark.slow
def test_without_an_estimate_errors_say_what_to_do():
    mechanism = mb.mechanisms.get("pendulum")
    run = lambda **options: mb.simulate(mechanism.system, mechanism.state, t1=0.1, **options)
    with pytest.raises(ValueError, match="error=True"):
        _ = run().error
    with pytest.raises(ValueError, match="at the same times"):
        run(error=True, event=diffrax.Event(lambda t, y, args, **kw: y.q[0] - 10))
    with pytest.raises(ValueError, match="at the same times"):
        run(error=True, saveat=diffrax.SaveAt(steps=True))
    with pytest.raises(ValueError, match="give rtol and atol"):
        run(error=True, stepsize_controller=mb.solvers.MultistepController(1e-6, 1e-8))
