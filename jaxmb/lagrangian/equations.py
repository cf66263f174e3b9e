"""How the equations of motion of a Lagrangian system are written: the generalized force on its velocities."""

import abc
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Scalar

if TYPE_CHECKING:
    from .system import LagrangianSystem


class AbstractEquations(eqx.Module):
    """A way to write `M u̇ = F + Aᵀ λ`; all ways give the same F."""

    @abc.abstractmethod
    def check(self, system: "LagrangianSystem") -> None:
        """Raise a `ValueError` for a system that the equations cannot be written for."""

    @abc.abstractmethod
    def force(
        self, system: "LagrangianSystem", t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"]
    ) -> Float[Array, "nu"]:
        """`F(t, q, u)`."""


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
        total = jax.grad(system.lagrangian, 1)(t, q, v, system.parameters) - rate
        return pull(total + system.applied_force(t, q, v))[0]
