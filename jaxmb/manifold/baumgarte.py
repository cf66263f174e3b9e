"""Baumgarte's stabilisation: accelerations that bring the state back to its constraints.

Source: J. Baumgarte, "Stabilization of constraints and integrals of motion in dynamical systems", Comput. Methods Appl.
Mech. Eng. 1, 1972.
"""

from typing import ClassVar

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..formulations import AbstractFormulation
from ..formulations.formulation import check_mass
from ..formulations.laws import accelerations_at
from ..solvers.manifold_term import AbstractVectorField
from ..system.equation import AbstractEquation
from ..system.instant import Instant
from .compliant_gaps import compliant_gaps
from .implied import check_watched, violated
from .manifold import AbstractManifold, normalize_state


class Baumgarte(AbstractManifold):
    """Integrate all coordinates and velocities, with constraints on accelerations that decay, for any solver.

    ```python
    motion = jaxmb.simulate(system, state, t1=1.0, manifold=jaxmb.manifold.Baumgarte(rate=20.0))
    ```

    Constraints between positions satisfy `Φ̈ + 2 rate Φ̇ + rate² Φ = 0`, constraints between velocities `ψ̇ + rate ψ =
    0`. The state is near the constraints, not on them, and a rate much faster than the motion makes the equations
    stiff. It is for comparison with `Partition`, which needs no rate.

    **Arguments:** `rate` [1/s] > 0.
    """

    rate: float = eqx.field(static=True, default=10.0)
    restores: ClassVar[bool] = False

    def __check_init__(self):
        if not (np.isfinite(self.rate) and self.rate > 0):
            raise ValueError(f"Baumgarte: rate must be positive and finite, got {self.rate}.")

    takes_impulses: ClassVar[bool] = False

    def prepare(self, system, formulation, solver, accuracy):
        check_mass(system, formulation)
        check_watched(system, "Baumgarte")
        return diffrax.ODETerm(StabilisedField(system, formulation, self.rate)), solver

    def correction(self, interpolated):
        # The distance from the constraints is of interest, and stays.
        return normalize_state

    def violated(self, system, t, y, accuracy):
        return violated(Instant.of(system, t, y), accuracy.rtol, project=True)


class StabilisedField(AbstractVectorField):
    """The rate of a state, with accelerations that stabilise the constraints."""

    system: AbstractEquation
    formulation: AbstractFormulation
    rate: float = eqx.field(static=True)

    @property
    def gaps(self):
        return compliant_gaps(self.system)

    def __call__(self, t, y, args):
        del args
        system, at = self.system, Instant.of(self.system, t, y).normalized()
        position, velocity = at.position_residual, at.velocity_residual
        holonomic = np.arange(system.velocity_rows) < system.position_rows
        shift = self.rate * jnp.where(holonomic, 2.0, 1.0).astype(velocity.dtype) * velocity
        shift = shift + self.rate**2 * jnp.pad(position, (0, velocity.size - position.size))
        shift = jnp.pad(shift, (0, system.acceleration_rows - shift.size))
        udot, _ = accelerations_at(at, self.formulation, shift)
        return at.motion(udot)
