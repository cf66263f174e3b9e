"""The solver on a term with a manifold: a point on the unit circle, one coordinate free and the other solved for."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_as_users_do

from jaxmb.solvers import Adams, MultistepController
from jaxmb.solvers.manifold_term import AbstractManifoldTerm, ManifoldEvaluation

_AXES = np.arange(2, dtype=np.int32)


class Circle(AbstractManifoldTerm):
    """`angle' = rate (1 + sin(t) / 2)`. Charts change where the free coordinate is not the smaller one by far.

    With `fail`, evaluations within a step longer than `fail` after a time of one go wrong.
    """

    rate: jax.Array
    fail: Any = None

    def vf(self, t, y, args):
        return self.rate * (1 + 0.5 * jnp.sin(t)) * jnp.stack([-y[1], y[0]])

    def contr(self, t0, t1, **kwargs):
        return t1 - t0

    def prod(self, vf, control):
        return vf * control

    def init_chart(self, t, y, args):
        return {
            "free": jnp.argmin(jnp.abs(y)).astype(jnp.int32),
            "changes": jnp.array(0, jnp.int32),
            "at": jnp.asarray(t, y.dtype),
        }

    def evaluate(self, t, y, chart, args):
        return ManifoldEvaluation(y, self.vf(t, y, args), chart, jnp.array(False))

    def project_near(self, t, y, linearized_at, args):
        chart = linearized_at.chart
        kept = y[chart["free"]]
        room = 1 - kept**2
        failed = room < 0.01
        other = y[1 - chart["free"]]
        solved = jnp.sign(other) * jnp.sqrt(jnp.where(failed, 1.0, room))
        y = jnp.where(self._is_free(chart), y, solved)
        if self.fail is not None:
            failed = failed | ((t > 1.0) & (t - chart["at"] > self.fail))
        return ManifoldEvaluation(y, self.vf(t, y, args), chart, failed)

    def controlled(self, chart):
        return self._is_free(chart)

    def free(self, chart):
        return chart["free"][None]

    def update_chart(self, t, y, chart, args):
        worse = jnp.abs(y[chart["free"]]) > 0.8
        free = jnp.where(worse, 1 - chart["free"], chart["free"])
        return {"free": free, "changes": chart["changes"] + worse.astype(jnp.int32), "at": jnp.asarray(t, y.dtype)}

    def _is_free(self, chart):
        return chart["free"] == _AXES


def _exact(t, rate=1.0):
    angle = rate * (t + 0.5 * (1 - np.cos(t)))
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _solve(term, t1=12.0, tolerance=1e-8, **kwargs):
    kwargs = {"saveat": diffrax.SaveAt(t1=True, solver_state=True), "adjoint": diffrax.ForwardMode(), **kwargs}
    kwargs = {"stepsize_controller": MultistepController(tolerance, tolerance), **kwargs}
    return diffrax.diffeqsolve(term, Adams(), 0.0, t1, None, np.array([1.0, 0.0]), **kwargs)


@pytest.mark.slow
def test_charts_and_failed_evaluations():
    """Changes of charts leave states on the manifold and orders high; failed evaluations retry a step, or end all."""

    @jax.jit
    def run(fail, t1):
        saveat = diffrax.SaveAt(steps=True, solver_state=True)
        return _solve(Circle(jnp.array(1.0), fail), t1, saveat=saveat, max_steps=512, throw=False)

    accepted = lambda solution: int(solution.stats["num_accepted_steps"])
    for t1 in (12.0, -12.0):
        whole = run(np.inf, t1)
        n, state = accepted(whole), whole.solver_state
        np.testing.assert_allclose(np.sum(np.square(whole.ys[:n]), axis=1), 1.0, rtol=0, atol=1e-15)
        np.testing.assert_allclose(whole.ys[:n], _exact(np.asarray(whole.ts[:n])), rtol=0, atol=1e-6)
        assert state.chart["changes"] > 5
        # Neither restarts nor low orders after the start.
        assert state.step_counts[0] == 1 and sum(state.step_counts.tolist()[1:6]) < 16
    assert accepted(whole) < 150
    retried = run(0.02, 3.0)
    assert retried.result == diffrax.RESULTS.successful
    assert retried.stats["num_rejected_steps"] > run(np.inf, 3.0).stats["num_rejected_steps"]
    assert accepted(retried) > 2.0 / 0.02
    np.testing.assert_allclose(retried.ys[accepted(retried) - 1], _exact(3.0), rtol=0, atol=1e-6)
    assert run(0.0, 3.0).result == diffrax.RESULTS.dt_min_reached


def test_failed_evaluation_under_fixed_steps_is_an_error():
    solver, start = Adams(rtol=1e-6, atol=1e-6), np.array([1.0, 0.0])
    term, options = Circle(jnp.array(1.0), fail=0.001), {"throw": False, "adjoint": diffrax.ForwardMode()}
    solution = diffrax.diffeqsolve(term, solver, 0.0, 3.0, 0.01, start, **options)
    assert solution.result == diffrax.RESULTS.nonlinear_divergence


@pytest.mark.slow
def test_solvers_without_charts_and_terms_without_manifold():
    """Charts take no more steps than none."""
    term, options = Circle(jnp.array(1.0)), {"stepsize_controller": diffrax.PIDController(1e-9, 1e-9)}
    solution = diffrax.diffeqsolve(term, diffrax.Dopri8(), 0.0, 12.0, None, jnp.array([1.0, 0.0]), **options)
    np.testing.assert_allclose(solution.ys[-1], _exact(12.0), rtol=0, atol=1e-6)
    charted, plain = _solve(term), _solve(diffrax.ODETerm(term.vf))
    assert charted.stats["num_steps"] < 1.3 * plain.stats["num_steps"]


@pytest.mark.slow
def test_batch_with_charts_and_failures_equals_loop():
    rates = jnp.array([0.6, 1.0, 2.3])

    def run(rate):
        solution = _solve(Circle(rate, fail=0.1), 4.0)
        return solution.ys[-1], solution.stats["num_steps"], solution.solver_state.chart["changes"]

    batch = jit_as_users_do(jax.vmap(run))(rates)
    single = jit_as_users_do(run)
    loop = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[single(rate) for rate in rates])
    # Estimates of high orders are made of few digits, so that rounding makes steps a little longer or shorter: both are
    # solutions to the tolerance.
    np.testing.assert_allclose(batch[0], loop[0], rtol=0, atol=1e-8)
    np.testing.assert_allclose(batch[1], loop[1], rtol=0.1)
    np.testing.assert_array_equal(batch[2], loop[2])


@pytest.mark.slow
def test_jump_on_the_manifold():
    controller = diffrax.ClipStepSizeController(MultistepController(1e-8, 1e-8), jump_ts=jnp.array([2.0]))
    solution = _solve(Circle(jnp.array(1.0)), 4.0, stepsize_controller=controller)
    assert solution.solver_state.step_counts[0] == 2
    assert solution.solver_state.chart["changes"] > 1
    np.testing.assert_allclose(solution.ys[-1], _exact(4.0), rtol=0, atol=1e-7)


@pytest.mark.slow
def test_gradients_through_charts():
    end = lambda rate, adjoint: _solve(Circle(rate), 4.0, 1e-10, adjoint=adjoint).ys[-1]
    loss = lambda rate, adjoint: jnp.sum(end(rate, adjoint) * jnp.array([1.0, 0.5]))
    rate = jnp.array(1.0)
    forward = jax.jit(jax.jacfwd(lambda r: loss(r, diffrax.ForwardMode())))(rate)
    reverse = jax.jit(jax.grad(lambda r: loss(r, diffrax.RecursiveCheckpointAdjoint())))(rate)
    angle_rate = 4.0 + 0.5 * (1 - np.cos(4.0))
    x, y = _exact(4.0)
    np.testing.assert_allclose(forward, reverse, rtol=1e-10)
    np.testing.assert_allclose(forward, angle_rate * (-y + 0.5 * x), rtol=0, atol=1e-7)
