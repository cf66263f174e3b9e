"""Planar forces that act on the relative angle."""

import jax.numpy as jnp

from .. import fields
from ..base import AbstractPair, AbstractPlanarPart, AbstractPotentialForce
from ..forces import AbstractBushing
from ..space import moment_pair
from .joints import relative_angle


class TorsionalSpringDamper(AbstractPlanarPart, AbstractPair, AbstractPotentialForce):
    """A linear spring and damper on the relative angle: moment `−stiffness (angle − free_angle) − damping rate` on B.

    ```python
    spring = planar.TorsionalSpringDamper("spring", "ground", "bar", stiffness=20.0, damping=0.5, free_angle=0.0)
    system = jaxmb.Scene([bar], joints=[pin], forces=[spring]).compile()
    ```

    The bodies need no hinge; in space, and on a hinge, use `JointSpring`.

    **Arguments:** `stiffness` [N m/rad] ≥ 0; `damping` [N m s/rad] ≥ 0; `free_angle` [rad] of `angle_b − angle_a`,
    default that of the given poses.
    """

    stiffness: fields.Number = fields.parameter(unit="N m/rad", sign="non-negative")
    damping: fields.Number = fields.parameter(unit="N m s/rad", sign="non-negative", default=0.0)
    free_angle: fields.Number = fields.parameter(unit="rad", optional=True)

    def complete(self, space, poses):
        return self.filled(free_angle=relative_angle(poses))

    def wrenches(self, space, poses, velocities, t):
        angle, rate = relative_angle(poses) - self.free_angle, velocities[1, 2] - velocities[0, 2]
        return moment_pair(space, poses, (-self.stiffness * angle - self.damping * rate)[None])

    def energy(self, space, poses, t):
        return 0.5 * self.stiffness * (relative_angle(poses) - self.free_angle) ** 2


class Bushing(AbstractPlanarPart, AbstractBushing):
    """A compliant joint: springs and dampers on the three relative motions of a frame in B with respect to one in A.

    ```python
    stiffness, damping = (1e5, 1e5, 10.0), (100.0, 100.0, 0.1)
    bush = planar.Bushing("bush", "ground", "bar", stiffness=stiffness, damping=damping, point=(0.0, 0.0))
    system = jaxmb.Scene([bar], forces=[bush]).compile()
    ```

    The motions are the position of B's point in the axes of `body_a` relative to A's point (2) [m] and the relative
    angle less that of the given poses [rad].

    **Arguments:** `free_angle` [rad], default that of the given poses.
    """

    free_angle: fields.Number = fields.parameter(unit="rad", optional=True)

    def complete(self, space, poses):
        return super().complete(space, poses).filled(free_angle=relative_angle(poses))

    def motions(self, space, poses):
        shift = space.body_point(poses[0], space.point(poses[1], self.point_b)) - self.point_a
        return jnp.concatenate([shift, (relative_angle(poses) - self.free_angle)[None]])
