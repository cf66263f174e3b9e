"""A compliant joint."""

import jax.numpy as jnp
import numpy as np

from . import fields
from .base import AbstractPair, AbstractPotentialForce
from .forces import generalized_force
from .planar.joints import relative_angle
from .spatial.axes import offset_in_a, rotation_error, with_given_orientation


class Bushing(AbstractPair, AbstractPotentialForce):
    """A compliant joint: springs and dampers on the motions of a frame in B relative to a frame in A, three in the
    plane and six in space.

    ```python
    stiffness, damping = (1e5, 1e5, 10.0), (100.0, 100.0, 0.1)
    bush = planar.Bushing("bush", "ground", "bar", stiffness=stiffness, damping=damping, point=(0.0, 0.0))
    system = jaxmb.Scene([bar], forces=[bush]).compile()
    ```

    The first motions are the position of B's point relative to A's point in the axes of `body_a` [m]. In the plane the
    last is the relative angle minus `free_angle` [rad]. In space the last three are twice the vector part of the Euler
    parameters from `orientation` to the relative attitude, in the axes of `body_b`: the rotation vector [rad] if small,
    in general `2 sin(angle/2)` along the axis of rotation. The moment of an isotropic spring is `stiffness sin(angle)`.
    Both signs of the bodies' Euler parameters give the same wrench and energy.

    **Arguments:**

    - `stiffness` ≥ 0 [N/m, then N m/rad] and `damping` ≥ 0 [N s/m, then N m s/rad], default zero, one for each motion.
    - `point_a`, `point_b` [m]: A fixed in `body_a`, B fixed in `body_b`; or `point` [m]: both, at this place of the
        world at the given poses.
    - `free_angle` [rad], in the plane, and `orientation`, in space, shape (4,), unit Euler parameters: the angle or
        attitude of `body_b` relative to `body_a` without a moment, default from the given poses.
    """

    stiffness: fields.Number = fields.parameter(shape=("v",), unit=("N m/rad", "N/m"), sign="non-negative")
    damping: fields.Number = fields.parameter(
        shape=("v",), unit=("N m s/rad", "N s/m"), sign="non-negative", optional=True
    )
    point_a: fields.Number = fields.point(body=0, optional=True)
    point_b: fields.Number = fields.point(body=1, optional=True)
    point: fields.Number = fields.point(body=None, gives=("point_a", "point_b"))
    free_angle: fields.Number = fields.parameter(unit="rad", optional=True, dimension=2)
    orientation: fields.Number = fields.attitude(optional=True)

    def complete(self, space, poses):
        part = self.filled(damping=np.zeros(self.stiffness.shape))
        if space.dimension == 2:
            return part.filled(free_angle=relative_angle(poses))
        return with_given_orientation(part, poses)

    def is_of_length(self, field):
        # Two of three motions are displacements, or three of six.
        return np.arange(n := len(self.stiffness)) < (n + 1) // 2

    def _motions(self, space, poses):
        in_plane = space.dimension == 2
        turn = (relative_angle(poses) - self.free_angle)[None] if in_plane else rotation_error(self, poses)
        return jnp.concatenate([offset_in_a(space, self, poses), turn])

    def wrenches(self, space, poses, velocities, t):
        law = lambda x, v: -self.stiffness * x - self.damping * v
        return generalized_force(space, self, lambda part, p: part._motions(space, p), poses, velocities, law)

    def energy(self, space, poses, t):
        return 0.5 * jnp.sum(self.stiffness * self._motions(space, poses) ** 2)
