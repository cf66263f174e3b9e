"""Planar forces that have no spatial counterpart of the same shape."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from .. import fields
from ..base import AbstractForce, AbstractPair, AbstractPlanarPart, AbstractPotentialForce
from ..forces import generalized_force
from ..smooth import ramp
from .joints import relative_angle


def _moment_pair(moment):
    """Wrenches of a moment on the second body and of its reaction on the first."""
    wrench = jnp.concatenate([jnp.zeros(2, moment.dtype), moment[None]])
    return jnp.stack([-wrench, wrench])


class Torque(AbstractPlanarPart, AbstractForce):
    """A constant moment on `body`, with its reaction on another one.

    ```python
    motor = planar.Torque("motor", "bar", torque=2.0)
    system = jaxmb.Scene([bar], joints=[pin], forces=[motor]).compile()
    ```

    **Arguments:** `torque` [N m]; `reaction`, the body that bears the reaction, default ground. In
    `Trajectory.forces` the reaction is the first row, and the moment on `body` the second.
    """

    name: str = fields.name()
    reaction: str = fields.body_name(default="ground")
    body: str = fields.body_name()
    torque: fields.Number = fields.parameter(unit="N m")

    def wrenches(self, space, poses, velocities, t):
        return _moment_pair(self.torque)


class TorsionalSpringDamper(AbstractPlanarPart, AbstractPair, AbstractPotentialForce):
    """A linear spring and damper on the relative angle: moment `−stiffness (angle − free_angle) − damping rate` on B.

    ```python
    spring = planar.TorsionalSpringDamper("spring", "ground", "bar", stiffness=20.0, damping=0.5, free_angle=0.0)
    system = jaxmb.Scene([bar], joints=[pin], forces=[spring]).compile()
    ```

    **Arguments:** `stiffness` [N m/rad] ≥ 0; `damping` [N m s/rad] ≥ 0; `free_angle` [rad] of `angle_b − angle_a`,
    default that of the given poses.
    """

    stiffness: fields.Number = fields.parameter(unit="N m/rad", sign="non-negative")
    damping: fields.Number = fields.parameter(unit="N m s/rad", sign="non-negative", default=0.0)
    free_angle: fields.Number = fields.parameter(unit="rad", optional=True)

    def complete(self, space, poses):
        return self.filled(free_angle=relative_angle(poses))

    def wrenches(self, space, poses, velocities, t):
        angle = relative_angle(poses) - self.free_angle
        return _moment_pair(-self.stiffness * angle - self.damping * (velocities[1, 2] - velocities[0, 2]))

    def energy(self, space, poses, t):
        return 0.5 * self.stiffness * (relative_angle(poses) - self.free_angle) ** 2


class BumpStop(AbstractPlanarPart, AbstractPair, AbstractPotentialForce):
    """Progressive stops of a relative angle on both sides, `angle = angle_b − angle_a`.

    ```python
    stop = planar.BumpStop("stop", "ground", "bar", stiffness=1e3, lower=-0.5, upper=1.0)
    system = jaxmb.Scene([bar], joints=[pin], forces=[stop]).compile()
    ```

    Beyond a limit the potential is `stiffness δ^(exponent + 1) / (exponent + 1)` of a smoothed depth
    `δ = ½ (d + √(d² + smoothing²))`, d = lower − angle or angle − upper: the restoring moment on B is nearly
    `stiffness d^exponent`.

    **Arguments:** `stiffness` [N m/rad^exponent] ≥ 0; `lower` < `upper` [rad], the limits; `exponent` > 0; `smoothing`
    [rad] > 0.
    """

    stiffness: fields.Number = fields.parameter(sign="non-negative")
    lower: fields.Number = fields.parameter(unit="rad")
    upper: fields.Number = fields.parameter(unit="rad")
    exponent: fields.Number = fields.parameter(unit="1", sign="positive", default=3.0)
    smoothing: fields.Number = fields.parameter(unit="rad", sign="positive", default=1e-3)
    has_gaps: ClassVar[bool] = True

    def validate(self):
        if not self.lower < self.upper:
            raise ValueError(f"{self.label}: lower must be less than upper, got {self.lower} and {self.upper}.")

    def numbers_agree(self):
        return self.lower < self.upper

    def gaps(self, space, poses, t):
        return self._gaps(relative_angle(poses))

    @property
    def gap_width(self):
        return self.smoothing

    def _gaps(self, angle):
        return jnp.stack([angle - self.lower, self.upper - angle])

    def _energy(self, angle):
        depth = ramp(-self._gaps(angle), self.smoothing)
        return self.stiffness * jnp.sum(depth ** (self.exponent + 1)) / (self.exponent + 1)

    def wrenches(self, space, poses, velocities, t):
        return _moment_pair(-jax.grad(self._energy)(relative_angle(poses)))

    def energy(self, space, poses, t):
        return self._energy(relative_angle(poses))


class Bushing(AbstractPlanarPart, AbstractPair, AbstractPotentialForce):
    """A compliant joint: springs and dampers on the three relative motions of a frame in B with respect to one in A.

    ```python
    stiffness, damping = (1e5, 1e5, 10.0), (100.0, 100.0, 0.1)
    bush = planar.Bushing("bush", "ground", "bar", stiffness=stiffness, damping=damping, point=(0.0, 0.0))
    system = jaxmb.Scene([bar], forces=[bush]).compile()
    ```

    The motions are the position of B's point in the axes of `body_a` relative to A's point (2) [m] and the relative
    angle less that of the given poses [rad].

    **Arguments:** `stiffness`, shape (3,) [N/m, N/m, N m/rad]; `damping`, shape (3,) [N s/m, N s/m, N m s/rad];
    points as in `Revolute`; `free_angle` [rad], default that of the given poses.
    """

    stiffness: fields.Number = fields.parameter(shape=(3,), unit=("N m/rad", "N/m"), sign="non-negative")
    damping: fields.Number = fields.parameter(
        shape=(3,), unit=("N m s/rad", "N s/m"), sign="non-negative", default=(0.0, 0.0, 0.0)
    )
    point_a: fields.Number = fields.point(body=0, optional=True)
    point_b: fields.Number = fields.point(body=1, optional=True)
    point: fields.Number = fields.point(body=None, gives=("point_a", "point_b"))
    free_angle: fields.Number = fields.parameter(unit="rad", optional=True)

    def complete(self, space, poses):
        return self.filled(free_angle=relative_angle(poses))

    def is_of_length(self, field):
        return np.arange(len(self.stiffness)) < self.dimensions[0]

    def _motions(self, space, poses):
        shift = space.body_point(poses[0], space.point(poses[1], self.point_b)) - self.point_a
        return jnp.concatenate([shift, (relative_angle(poses) - self.free_angle)[None]])

    def wrenches(self, space, poses, velocities, t):
        law = lambda x, v: -self.stiffness * x - self.damping * v
        return generalized_force(space, self, lambda part, p: part._motions(space, p), poses, velocities, law)

    def energy(self, space, poses, t):
        return 0.5 * jnp.sum(self.stiffness * self._motions(space, poses) ** 2)
