"""A torsional spring between planar bodies."""

from jaxtyping import Array, ArrayLike, Float

from .. import fields
from ..base import AbstractPair, AbstractPlanarPart, AbstractPotentialForce
from ..curves import check_given, over_arrays
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
    default from the given poses.
    """

    stiffness: fields.Number = fields.parameter(unit="N m/rad", sign="non-negative")
    damping: fields.Number = fields.parameter(unit="N m s/rad", sign="non-negative", default=0.0)
    free_angle: fields.Number = fields.parameter(unit="rad", optional=True)

    def complete(self, space, poses):
        return self.filled(free_angle=relative_angle(poses))

    def wrenches(self, space, poses, velocities, t):
        moment = _moment(self, relative_angle(poses), velocities[1, 2] - velocities[0, 2])
        return moment_pair(space, poses, moment[None])

    def curve(self, angle: ArrayLike, rate: ArrayLike = 0.0) -> Float[Array, "..."]:
        """The moment [N m] on B at angles `angle_b − angle_a` [rad] and rates [rad/s], arrays that broadcast: the law
        of a motion, without a machine.
        """
        return over_arrays(self.label, _moment, check_given(self, "free_angle"), angle=angle, rate=rate)

    def energy(self, space, poses, t):
        return 0.5 * self.stiffness * (relative_angle(poses) - self.free_angle) ** 2


def _moment(spring, angle, rate):
    return -spring.stiffness * (angle - spring.free_angle) - spring.damping * rate
