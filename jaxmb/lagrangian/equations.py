"""Lagrange's equations projected on the directions of the velocities."""

import jax
import jax.numpy as jnp

from .model import AbstractEquations


class Projected(AbstractEquations):
    """Lagrange's equations in the coordinates, projected on the directions that velocities move them in.

    For any kinematics, also nonlinear ones. The cheapest way: two derivatives of L, and one of the kinematics.
    """

    def check(self, system):
        del system

    def force(self, system, t, q, u):
        v, pull = jax.vjp(lambda u: system.rates(t, q, u), u)
        momentum = lambda t, q: system.momentum(t, q, system.rates(t, q, u))
        _, rate = jax.jvp(momentum, (t, q), (jnp.ones_like(t), v))
        total = jax.grad(system.lagrangian, 1)(t, q, v, system.parameters_at(t)) - rate
        return pull(total + system.applied_force(t, q, v))[0]
