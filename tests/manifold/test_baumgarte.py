"""Baumgarte's stabilisation against its equation."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxmb as mb
from jaxmb import planar
from jaxmb.formulations import Multipliers
from jaxmb.manifold.baumgarte import StabilisedField


def test_a_violated_constraint_decays_as_a_critically_damped_oscillator():
    bob = planar.PointMass("bob", mass=2.0, position=(1.0, 0.0))
    rod = planar.Distance("rod", "ground", "bob", length=1.0)
    system, rate = mb.Scene([bob], joints=[rod], forces=[mb.Gravity((0.0, -9.81))]).compile(), 20.0
    q, u = np.array([1.1, 0.2]), np.array([0.3, -0.7])
    field = StabilisedField(system, Multipliers(), rate)

    @jax.jit
    def run(q, u):
        motion = field(jnp.zeros(()), mb.State(q, u), None)
        residual = lambda q: system.position_residual(0.0, q)
        first = lambda q, u: jax.jvp(residual, (q,), (u,))[1]
        second = jax.jvp(first, (q, u), (u, motion.u))[1]
        return motion.q, second + 2 * rate * first(q, u) + rate**2 * residual(q)

    velocities, left = run(q, u)
    np.testing.assert_allclose(velocities, u, rtol=1e-15)
    np.testing.assert_allclose(left, 0.0, atol=1e-11)
