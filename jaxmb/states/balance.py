"""The equilibrium equations of a system, in scaled velocities.

Rows are rows of the constraints, then rows of held coordinates.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..linalg.jitted import on_host
from ..system import AbstractSystem
from ..system.instant import Instant
from .on_host import IMAGINARY


class Balance(eqx.Module):
    """The equations in JAX.

    **Fields:** the `system`, the time `t` [s], and the `values` of the `held` coordinates.
    """

    system: AbstractSystem
    t: Array
    values: Float[Array, "held"]
    held: tuple[int, ...] = eqx.field(static=True)

    @property
    def rank(self) -> int:
        """The largest possible rank of the rows, without implied rows."""
        return self.system.velocity_rank + len(self.held)

    @property
    def rest(self) -> Float[Array, "nu"]:
        return jnp.zeros(self.system.nu, self.system.guess.q.dtype)

    def at(self, q: Array) -> Instant:
        """The system at rest."""
        return Instant(self.system, self.t, q, self.rest)

    def moved(self, q, z):
        """The configuration after a small displacement."""
        return self.system.normalize(self.t, q + self.at(q).with_(u=self.system.velocity_scale() * z).rates)

    def applied(self, q):
        """The applied forces."""
        return self.system.velocity_scale() * self.at(q).force

    def of_rows(self, q, multipliers):
        """The forces of the rows."""
        rows = self.system.velocity_rows
        force = self.at(q).constraint_force(multipliers[:rows])
        if self.held:
            force += jax.vjp(lambda u: self._held_rates(q, u), self.rest)[1](multipliers[rows:])[0]
        return self.system.velocity_scale() * force

    def forces(self, q, multipliers):
        """The sum of applied forces and forces of the rows."""
        return self.applied(q) + self.of_rows(q, multipliers)

    def applied_along(self, q: Array) -> tuple[Array, Array]:
        """The derivative of the applied forces by displacements, and the forces."""
        return self._along(q, self.applied)

    def of_rows_along(self, q: Array, multipliers: Array) -> tuple[Array, Array]:
        """The derivative of the forces of the rows by displacements, and the forces."""
        return self._along(q, lambda q: self.of_rows(q, multipliers))

    def _along(self, q, force: Callable[[Array], Array]):
        return jax.jacfwd(lambda z: (force(self.moved(q, z)),) * 2, has_aux=True)(jnp.zeros(self.system.nu, q.dtype))

    def jacobian(self, q):
        """Derivatives of the rows by displacements."""
        held = jax.jacfwd(lambda u: self._held_rates(q, u))(self.rest)
        rows = jnp.concatenate([self.at(q).velocity_jacobian, held])
        return rows * self.system.velocity_scale()[None, :]

    def residual(self, q, jacobian, z):
        """Residuals of the rows; residuals of velocity constraints depend on the displacement z alone."""
        constraints = slice(self.system.position_rows, self.system.velocity_rows)
        rolled = jacobian[constraints] @ z
        held = q[np.array(self.held, int)] - self.values
        return jnp.concatenate([self.at(q).position_residual, rolled, held])

    def _held_rates(self, q, u):
        return self.at(q).with_(u=u).rates[np.array(self.held, int)]


@on_host
def _applied_along(balance: Balance, q: Any) -> Any:
    return balance.applied_along(q)


class HostBalance:
    """The equations in NumPy, except a compiled program of the applied forces."""

    def __init__(self, balance: Balance, host: Any):
        self._balance, self._host, self.rank = balance, host, balance.rank
        self._scale, self._held = host.velocity_scale, np.array(balance.held, int)

    def moved(self, q, z):
        """As of `Balance`."""
        return self._host.displaced(q, self._scale * z)

    def applied_along(self, q):
        """As of `Balance`."""
        return _applied_along(self._balance, q)

    def of_rows_along(self, q, multipliers):
        """As of `Balance`."""
        pull = lambda q: (self.jacobian(q)).T @ multipliers
        displacements = [self._host.along(q, x) for x in np.diag(self._scale)]
        return np.stack([pull(q + 1j * IMAGINARY * x).imag / IMAGINARY for x in displacements], axis=1), pull(q)

    def jacobian(self, q):
        """As of `Balance`."""
        # The rates of held coordinates are velocities.
        held = np.eye(self._scale.size)[self._held]
        return np.concatenate([self._host.jacobian(q), held]) * self._scale

    def residual(self, q, jacobian, z):
        """As of `Balance`."""
        del jacobian, z
        return np.concatenate([self._host.residual(q), q[self._held] - self._balance.values])


def balance_on_host(balance: Balance) -> HostBalance | None:
    """The equations in NumPy; None for systems with rows that NumPy does not compute."""
    system = balance.system
    host = system.on_host(balance.t)
    suits = host is not None and host.analytic and (system.rates_are_velocities or not balance.held)
    return HostBalance(balance, host) if suits else None
