"""Derivatives of the discrete solution: forward equals reverse equals differences of a more accurate solution."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.solvers import Adams, MultistepController


def _pendulum(t, y, args):
    return jnp.stack([y[1], -args * jnp.sin(y[0]) - 0.1 * y[1] + 0.3 * jnp.cos(t)])


def _solve(parameters, adjoint, tolerance=1e-8, max_steps=256, **kwargs):
    stiffness, angle, t0, t1 = parameters
    return diffrax.diffeqsolve(
        diffrax.ODETerm(_pendulum),
        Adams(),
        t0,
        t1,
        None,
        jnp.stack([angle, jnp.zeros_like(angle)]),
        stiffness,
        stepsize_controller=MultistepController(tolerance, tolerance),
        adjoint=adjoint,
        max_steps=max_steps,
        **kwargs,
    )


def _loss(parameters, adjoint, tolerance=1e-8, **kwargs):
    return jnp.sum(_solve(parameters, adjoint, tolerance, **kwargs).ys[-1] * jnp.array([1.0, 0.5]))


PARAMETERS = jnp.array([4.0, 0.7, 0.1, 3.0])


@pytest.fixture(scope="module")
def forward():
    return jax.jit(jax.jacfwd(lambda p: _loss(p, diffrax.ForwardMode())))(PARAMETERS)


@pytest.fixture(scope="module")
def differences():
    loss = jax.jit(lambda p: _loss(p, diffrax.ForwardMode(), tolerance=1e-12, max_steps=1024))
    step = 1e-4
    return np.array([(loss(PARAMETERS + step * e) - loss(PARAMETERS - step * e)) / (2 * step) for e in np.eye(4)])


def test_forward_equals_reverse():
    """On one and the same mesh: at a tolerance so coarse that rounding errors have no say in the size of steps."""
    loss = lambda adjoint: lambda p: _loss(p, adjoint, 1e-4)
    forward = jax.jit(jax.jacfwd(loss(diffrax.ForwardMode())))(PARAMETERS)
    reverse = jax.jit(jax.grad(loss(diffrax.RecursiveCheckpointAdjoint())))(PARAMETERS)
    np.testing.assert_allclose(forward, reverse, rtol=1e-12)


@pytest.mark.slow
def test_gradient_equals_central_differences(forward, differences):
    """For a parameter, an initial value, and both ends of the interval."""
    np.testing.assert_allclose(forward, differences, rtol=0, atol=3e-7)


@pytest.mark.slow
def test_direct_adjoint():
    gradient = lambda adjoint: jax.jit(jax.grad(lambda p: _loss(p, adjoint, 1e-3, max_steps=64)))(PARAMETERS)
    direct, checkpointed = gradient(diffrax.DirectAdjoint()), gradient(diffrax.RecursiveCheckpointAdjoint())
    np.testing.assert_allclose(direct, checkpointed, rtol=1e-10)


@pytest.mark.slow
def test_backsolve_adjoint(forward):
    solution = lambda stiffness: diffrax.diffeqsolve(
        diffrax.ODETerm(_pendulum),
        Adams(),
        0.1,
        3.0,
        None,
        jnp.array([0.7, 0.0]),
        stiffness,
        stepsize_controller=MultistepController(1e-8, 1e-8),
        adjoint=diffrax.BacksolveAdjoint(),
        saveat=diffrax.SaveAt(ts=jnp.array([1.0, 2.0, 3.0])),
    )
    gradient = jax.jit(jax.grad(lambda k: jnp.sum(solution(k).ys[-1] * jnp.array([1.0, 0.5]))))(PARAMETERS[0])
    np.testing.assert_allclose(gradient, forward[0], rtol=0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "adjoint, derivative", [(diffrax.ForwardMode(), jax.jacfwd), (diffrax.RecursiveCheckpointAdjoint(), jax.grad)]
)
def test_what_a_vector_field_closes_over_is_differentiated(adjoint, derivative):
    def end(rate):
        controller = MultistepController(1e-9, 1e-12)
        term = diffrax.ODETerm(lambda t, y, args: -rate * y)
        options = {"stepsize_controller": controller, "adjoint": adjoint, "max_steps": 512}
        return diffrax.diffeqsolve(term, Adams(), 0.0, 1.0, None, jnp.ones(1), **options).ys[-1][0]

    rates = jnp.array([2.0, 3.0])
    np.testing.assert_allclose(jax.jit(jax.vmap(derivative(end)))(rates), -np.exp(-rates), rtol=1e-8)


@pytest.mark.slow
def test_gradient_of_dense_output_and_saved_times():
    ts = jnp.array([0.5, 1.3, 2.9])

    def saved(angle):
        p = PARAMETERS.at[1].set(angle)
        return _solve(p, diffrax.ForwardMode(), saveat=diffrax.SaveAt(ts=ts)).ys[:, 0]

    def interpolated(angle, tolerance=1e-8):
        p = PARAMETERS.at[1].set(angle)
        solution = _solve(p, diffrax.ForwardMode(), tolerance, 512, saveat=diffrax.SaveAt(dense=True))
        return jax.vmap(solution.evaluate)(ts)[:, 0]

    angle, step = PARAMETERS[1], 1e-4
    slope = jax.jit(jax.jacfwd(saved))(angle)
    np.testing.assert_allclose(slope, jax.jit(jax.jacfwd(interpolated))(angle), rtol=1e-10)
    tight = jax.jit(lambda a: interpolated(a, 1e-12))
    np.testing.assert_allclose(slope, (tight(angle + step) - tight(angle - step)) / (2 * step), rtol=0, atol=3e-7)


@pytest.mark.slow
def test_gradients_in_a_batch(forward):
    gradient = jax.jit(jax.vmap(jax.grad(lambda p: _loss(p, diffrax.RecursiveCheckpointAdjoint()))))
    batch = gradient(jnp.stack([PARAMETERS, PARAMETERS.at[0].set(9.0)]))
    np.testing.assert_allclose(batch[0], forward, rtol=0, atol=1e-7)
    assert np.all(np.isfinite(batch))
