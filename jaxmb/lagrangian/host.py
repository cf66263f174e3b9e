"""The constraints of a Lagrangian system in NumPy, by one program of their rows."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..linalg.jitted import on_host
from ..states.on_host import AbstractHost
from .model import AbstractLagrangian, Unanalysed


@on_host
def _rows(system: AbstractLagrangian, t: Any, q: Any, u: Any) -> tuple[Array, Array, Array, Array]:
    """Φ and its derivative, ψ, and A."""
    v = system.rates(t, q, u)
    residual = system.position_residual(t, q)
    drift, jacobian = jax.jacfwd(system.position_residual, (0, 1))(t, q)
    unmet, rows = [drift + jacobian @ v], [jacobian]
    for c in system.constraints:
        if c.level > 0:
            rows.append(jax.jacfwd(system.value, 2 + c.level)(c, t, q, v, v))
        if c.level == 1:
            unmet.append(system.value(c, t, q, v, v))
    slopes = jnp.concatenate(rows)
    if not system.kinematics.identity:
        slopes = slopes @ jax.jacfwd(lambda u: system.rates(t, q, u))(u)
    return residual, jacobian, jnp.concatenate(unmet), slopes


class HostLagrangian(AbstractHost):
    """The constraints of a Lagrangian system, whose structure may be unknown."""

    def __init__(self, system: AbstractLagrangian, t: Any):
        self._system, self._given = Unanalysed.of(system), np.asarray(system.guess.u)
        self._t, self._last = np.asarray(t, system.guess.q.dtype), None
        self.linear, self.velocity_rows = system.linear, system.velocity_rows
        self.coordinate_scale, self.velocity_scale = (np.ones(x.size, x.dtype) for x in (system.guess.q, self._given))

    def _at(self, q, u=None) -> tuple[Any, Any, Any, Any]:
        u = self._given if u is None else u
        key = q.tobytes(), u.tobytes()
        if self._last is None or self._last[0] != key:
            self._last = key, _rows(self._system, self._t, q, u)
        return self._last[1]

    def coordinate_residual(self, q):
        return self._at(q)[0]

    def coordinate_jacobian(self, q):
        return self._at(q)[1]

    def velocity_rows_at(self, q, u):
        _, _, unmet, rows = self._at(q, u)
        return unmet, rows[: self.velocity_rows]

    def jacobian(self, q: Float[np.ndarray, "nq"]) -> Float[np.ndarray, "acceleration_rows nu"]:
        """A at the given velocities."""
        return self._at(q)[3]
