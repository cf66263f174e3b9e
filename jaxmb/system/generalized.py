"""Systems in generalized coordinates, without bodies: views of a motion by coordinate name."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from ..linalg.arrays import is_traced
from ..linalg.jacobian import DenseJacobian
from .design_variables import in_range
from .equation import AbstractSystem
from .quantities import Quantity


class AbstractGeneralizedSystem(AbstractSystem):
    """A system whose motion is that of its coordinates. Measurable quantities are the coordinates, their rates q̇, and
    generalized constraint forces: `"theta"`, `"theta.rate"`, `"A.force"`.
    """

    elimination: ClassVar[None] = None

    @property
    def has_bodies(self) -> bool:
        return False

    # There are no parts that could have internal states.

    @property
    def state_ends(self) -> tuple[int, ...]:
        return ()

    def state_names(self):
        return {}

    def with_states(self, z):
        del z
        return self

    def state_rates(self, t, q, u):
        return jnp.zeros(0, q.dtype)

    def state_scale(self):
        return jnp.zeros(0)

    def held_velocities(self, held):
        return held if self.rates_are_velocities else None

    def structured_jacobian(self, t, q, u):
        return DenseJacobian(self.jacobian(t, q, u))

    def motion_names(self):
        return tuple(self.coordinate_names())

    def motion(self, name, ys):
        return ys.q[:, self.coordinate_names()[name][0]]

    def quantities(self):
        out = {name: Quantity((), lambda ts, ys, _, name=name: self.motion(name, ys)) for name in self.motion_names()}
        for name, (index,) in self.coordinate_names().items():
            rate = lambda ts, ys, _, index=index: self.rates_along(ts, ys)[:, index]
            out[f"{name}.rate"] = Quantity((), rate)
        for name in self.constraint_names():
            force = lambda ts, ys, solved, name=name: self.generalized_constraint_force(
                name, ts, ys, solved.multipliers
            )
            out[f"{name}.force"] = Quantity((self.nu,), force, of_forces=True)
        return out

    def joint_coordinates(self):
        return {}

    def joint_coordinate(self, coordinate, t, q):
        raise ValueError("This system has no joints between bodies, and so no coordinates of joints.")

    def holding(self, values, rates, t):
        return self

    def position_quantities(self):
        return self.motion_names()

    def normalize_fixed(self, q, fixed):
        return q, 0

    def picture(self, ts, ys):
        raise ValueError(
            f"A picture shows bodies, and a {type(self).__name__} has none; viz.plot_motion shows its coordinates."
        )

    def check_parameters(self, names):
        for name in self.positive_parameters() & set(names):
            value = self._parameter(name)
            if not is_traced(value) and not np.all(np.asarray(value) > 0):
                raise ValueError(f"Parameter {name!r} must be positive, got {np.asarray(value)}.")

    def parameters_in_range(self):
        values = [self._parameter(name) for name in sorted(self.positive_parameters())]
        traced = [jnp.all(value > 0) for value in values if is_traced(value)]
        return (jnp.all(jnp.stack(traced)) if traced else True) & in_range(self.design)

    def _parameter(self, name):
        where, index = self.parameter_paths()[name][0]
        return where(self) if index is None else where(self)[index]

    def not_finite(self, t, q, u):
        t, rows = jnp.asarray(t, q.dtype), self.rows
        residuals = (self.position_residual(t, q), self.acceleration_residual(t, q, u, jnp.zeros_like(u)))
        wrong = [rows[k][0] for residual in residuals for k in np.flatnonzero(~np.isfinite(np.asarray(residual)))]
        forces = () if np.all(np.isfinite(self.force(t, q, u))) else ("the force on the coordinates",)
        return (*forces, *dict.fromkeys(f"the residual of {name!r}" for name in wrong))

    # There are no bodies to act on.

    def with_frames_of(self, before):
        del before
        return self

    def joint_names(self):
        raise ValueError("reactions are defined for joints between bodies; this system has constraint_forces.")

    def reaction(self, name, ts, ys, multipliers):
        raise ValueError("reactions are defined for joints between bodies; this system has constraint_forces.")

    def force_names(self):
        raise ValueError("forces are defined for parts that act on bodies; this system has none.")

    def applied_wrenches(self, name, ts, ys, multipliers):
        raise ValueError("forces are defined for parts that act on bodies; this system has none.")

    def linear_momentum(self, q, u):
        raise ValueError("Momentum is that of bodies; this system has none. Compute it from the coordinates.")

    def angular_momentum(self, q, u):
        raise ValueError("Momentum is that of bodies; this system has none. Compute it from the coordinates.")
