"""Derivatives of the discrete solution: forward equals reverse equals differences of a more accurate solution."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.solvers import Adams, MultistepController

FORWARD, REVERSE = diffrax.ForwardMode(), diffrax.RecursiveCheckpointAdjoint()
# A parameter, an initial value, and both ends of the interval.
PARAMETERS = jnp.array([4.0, 0.7, 0.1, 3.0])
OTHER = jnp.array([9.0, 0.7, 0.1, 3.0])


def _loss(parameters, adjoint, tolerance, max_steps=256):
    stiffness, angle, t0, t1 = parameters
    field = lambda t, y, args: jnp.stack([y[1], -args * jnp.sin(y[0]) - 0.1 * y[1] + 0.3 * jnp.cos(t)])
    options = {"stepsize_controller": MultistepController(tolerance, tolerance), "adjoint": adjoint}
    start = jnp.stack([angle, jnp.zeros_like(angle)])
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field), Adams(), t0, t1, None, start, stiffness, max_steps=max_steps, **options
    )
    return jnp.sum(solution.ys[-1] * jnp.array([1.0, 0.5]))


@pytest.mark.slow
def test_derivatives_of_a_solve():
    """Forward equals reverse, alone and in a batch, and central differences."""
    both = lambda p, tolerance: (_loss(p, FORWARD, tolerance, max_steps=1024),) * 2
    forward = jax.jit(jax.jacfwd(both, has_aux=True))
    gradient = jax.grad(lambda p, tolerance: _loss(p, REVERSE, tolerance))
    reverse, batch = jax.jit(gradient), jax.jit(jax.vmap(gradient, in_axes=(0, None)))
    # On one mesh: at a tolerance so coarse that rounding errors have no say in the size of steps.
    np.testing.assert_allclose(reverse(PARAMETERS, 1e-4), forward(PARAMETERS, 1e-4)[0], rtol=1e-12)
    step, derivative = 1e-4, forward(PARAMETERS, 1e-8)[0]
    value = lambda e: forward(PARAMETERS + step * e, 1e-12)[1]
    differences = [(value(e) - value(-e)) / (2 * step) for e in np.eye(4)]
    np.testing.assert_allclose(derivative, differences, rtol=0, atol=3e-7)
    members = batch(jnp.stack([PARAMETERS, OTHER]), 1e-8)
    np.testing.assert_allclose(members[0], derivative, rtol=0, atol=1e-7)
    np.testing.assert_allclose(members[1], forward(OTHER, 1e-8)[0], rtol=0, atol=1e-6)
