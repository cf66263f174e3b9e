"""Derivatives of the discrete solution: forward equals reverse equals differences of a more accurate solution."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.solvers import Adams, MultistepController

pytestmark = pytest.mark.slow

FORWARD, REVERSE = diffrax.ForwardMode(), diffrax.RecursiveCheckpointAdjoint()
# A parameter, an initial value, and both ends of the interval.
PARAMETERS = jnp.array([4.0, 0.7, 0.1, 3.0])
OTHER = jnp.array([9.0, 0.7, 0.1, 3.0])


def _solve(parameters, adjoint, tolerance=1e-8, max_steps=256, **kwargs):
    stiffness, angle, t0, t1 = parameters
    return diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, args: jnp.stack([y[1], -args * jnp.sin(y[0]) - 0.1 * y[1] + 0.3 * jnp.cos(t)])),
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


@pytest.fixture(scope="module")
def forward():
    """Derivatives by forward mode as a function of parameters and the tolerance, with the value."""
    both = lambda p, tolerance: (_loss(p, FORWARD, tolerance, max_steps=1024),) * 2
    return jax.jit(jax.jacfwd(both, has_aux=True))


def test_derivatives_of_a_solve(forward):
    """Forward equals reverse, alone and in a batch, and central differences."""
    reverse = jax.jit(jax.vmap(jax.grad(lambda p, tolerance: _loss(p, REVERSE, tolerance)), in_axes=(0, None)))
    # On one mesh: at a tolerance so coarse that rounding errors have no say in the size of steps.
    members = jnp.stack([PARAMETERS, OTHER])
    for found, p in zip(reverse(members, 1e-4), members, strict=True):
        np.testing.assert_allclose(found, forward(p, 1e-4)[0], rtol=1e-12)
    step, derivative = 1e-4, forward(PARAMETERS, 1e-8)[0]
    value = lambda e: forward(PARAMETERS + step * e, 1e-12)[1]
    differences = [(value(e) - value(-e)) / (2 * step) for e in np.eye(4)]
    np.testing.assert_allclose(derivative, differences, rtol=0, atol=3e-7)
    np.testing.assert_allclose(reverse(members, 1e-8)[0], derivative, rtol=0, atol=1e-7)


def test_other_adjoints_of_diffrax(forward):
    direct = jax.jit(jax.grad(lambda p: _loss(p, diffrax.DirectAdjoint(), 1e-3, max_steps=64)))(PARAMETERS)
    np.testing.assert_allclose(direct, forward(PARAMETERS, 1e-3)[0], rtol=1e-10)

    def backwards(stiffness):
        ts = diffrax.SaveAt(ts=jnp.array([1.0, 2.0, 3.0]))
        p = (stiffness, jnp.array(0.7), 0.1, 3.0)
        return _solve(p, diffrax.BacksolveAdjoint(), max_steps=4096, saveat=ts).ys[-1] @ jnp.array([1.0, 0.5])

    found = jax.jit(jax.grad(backwards))(PARAMETERS[0])
    np.testing.assert_allclose(found, forward(PARAMETERS, 1e-8)[0][0], rtol=0, atol=1e-6)


@pytest.mark.parametrize("adjoint, derivative", [(FORWARD, jax.jacfwd), (REVERSE, jax.grad)])
def test_what_a_vector_field_closes_over_is_differentiated(adjoint, derivative):
    def end(rate):
        controller = MultistepController(1e-9, 1e-12)
        term = diffrax.ODETerm(lambda t, y, args: -rate * y)
        options = {"stepsize_controller": controller, "adjoint": adjoint, "max_steps": 512}
        return diffrax.diffeqsolve(term, Adams(), 0.0, 1.0, None, jnp.ones(1), **options).ys[-1][0]

    rates = jnp.array([2.0, 3.0])
    np.testing.assert_allclose(jax.jit(jax.vmap(derivative(end)))(rates), -np.exp(-rates), rtol=1e-8)


def test_gradient_of_dense_output_and_saved_times():
    ts = jnp.array([0.5, 1.3, 2.9])

    def saved(angle):
        return _solve(PARAMETERS.at[1].set(angle), FORWARD, saveat=diffrax.SaveAt(ts=ts)).ys[:, 0]

    def interpolated(angle, tolerance=1e-8):
        solution = _solve(PARAMETERS.at[1].set(angle), FORWARD, tolerance, 512, saveat=diffrax.SaveAt(dense=True))
        return jax.vmap(solution.evaluate)(ts)[:, 0]

    angle, step = PARAMETERS[1], 1e-4
    slope = jax.jit(jax.jacfwd(saved))(angle)
    np.testing.assert_allclose(slope, jax.jit(jax.jacfwd(interpolated))(angle), rtol=1e-10)
    tight = jax.jit(lambda a: interpolated(a, 1e-12))
    np.testing.assert_allclose(slope, (tight(angle + step) - tight(angle - step)) / (2 * step), rtol=0, atol=3e-7)
