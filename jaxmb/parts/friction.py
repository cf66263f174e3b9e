"""Joint friction, computed from the joint's reaction."""

import jax
import jax.numpy as jnp
import numpy as np

from ..linalg.rotations import norm
from . import fields
from .base import AbstractInertialConstraint, AbstractNonIdeal, rows_of
from .smooth import dry_friction


class Friction(AbstractNonIdeal):
    """Coulomb friction in a joint: `coefficient` times the joint's reaction force, opposing its slip.

    | friction of | size | at rest |
    |---|---|---|
    | `DryFriction`, in a joint or a rigid contact | `coefficient` times the reaction | sticks, with events |
    | `Pulley(friction=…)`, of a `Rope` on a pulley | by the equation of the capstan | sticks, with events |
    | `JointFriction(…, exact=True)`, on a coordinate | a given `force` or moment | sticks, with events |
    | `Friction`, in a joint | `coefficient` times the reaction | creeps, smooth |
    | `JointFriction`, on a coordinate | a given `force` or moment | creeps, smooth |
    | `JointSpring(stiffness=0.0)`, on a coordinate | `damping` times the rate | viscous |
    | `NonIdeal`, in a joint | a function of the reaction | as the function is |
    | `contact.Coulomb`, in a compliant `Contact` | `coefficient` times the load | creeps, smooth |

    ```python
    rub = planar.Friction("rub", "pin", coefficient=0.2, radius=0.01)
    system = jaxmb.Scene([bar], joints=[pin], forces=[rub, jaxmb.Gravity((0.0, -9.81))]).compile()
    ```

    The slip s combines the relative velocity of the bodies at the joint's point (a single body's: relative to the
    ground) with `radius` times their relative angular velocity. The same law thus serves pins, slides and cylinders.
    The force conjugate to s is `−μ N s/|s| tanh(|s| / transition_speed)`, which is smooth at rest. N is the magnitude
    of the reaction force that the joint exerts in the presence of all friction; reaction moments do not contribute. If
    no such N exists, or more than one (Painlevé's paradox), the simulation ends with `friction_undetermined`.

    **Arguments:**

    - `joint`: the joint's name. Its reaction must be determinate: no other joint may imply any of its rows.
    - `coefficient` μ ≥ 0.
    - `radius` [m] ≥ 0 of the pin or ball, default zero: sliding only.
    - `point` [m]: the point of sliding, fixed in the joint's last body; default the joint's point there, or the origin
        of the frame if it has none.
    - `transition_speed` [m/s] > 0, the slip at which 76 % of the friction acts.
    """

    name: str = fields.name()
    joint: str = fields.name()
    coefficient: fields.Number = fields.parameter(unit="1", sign="non-negative")
    radius: fields.Number = fields.parameter(unit="m", sign="non-negative", default=0.0)
    point: fields.Number = fields.point(body=None, optional=True)
    transition_speed: fields.Number = fields.parameter(unit="m/s", sign="positive", default=1e-4)

    def complete(self, space, joint, poses):
        if isinstance(joint, AbstractInertialConstraint):
            raise ValueError(f"{self.label}: {joint.label} is not a joint with a smooth force; use jaxmb.DryFriction.")
        k = poses.shape[0] - 1
        if k > 1:
            raise ValueError(f"{self.label}: {joint.name!r} connects more than two bodies; use NonIdeal.")
        anchor = joint.anchor(space, k)
        part = self.filled(point=np.zeros(space.dimension) if anchor is None else anchor)
        part._check_slip(space, joint, poses)
        return part

    def _check_slip(self, space, joint, poses):
        columns = poses.shape[0] * space.velocity_size
        rows = [np.asarray(rows_of(component, space, poses)).reshape(-1, columns) for component in joint.components()]
        _, sizes, directions = np.linalg.svd(np.concatenate(rows))
        allowed = directions[np.sum(sizes > 1e-9 * sizes[0]) :].reshape(-1, poses.shape[0], space.velocity_size)
        slips = jax.vmap(lambda v: self.slip(space, poses, v))(jnp.asarray(allowed))
        if not np.any(np.abs(slips) > 1e-9):
            raise ValueError(
                f"{self.label}: {joint.name!r} allows no slip at its point; give the radius of its pin or ball."
            )

    def slip(self, space, poses, velocities):
        """Velocity of slip [m/s]: at the point, world axes, then `radius` times the relative angular velocity."""
        sliding = space.point_velocity(poses[-1], velocities[-1], self.point)
        turning = space.turning(poses[-1], velocities[-1])
        if poses.shape[0] == 2:
            point_a = space.body_point(poses[0], space.point(poses[-1], self.point))
            sliding = sliding - space.point_velocity(poses[0], velocities[0], point_a)
            turning = turning - space.turning(poses[0], velocities[0])
        return jnp.concatenate([sliding, self.radius * turning])

    def wrenches(self, space, poses, velocities, reactions, t):
        slip, pull = jax.vjp(lambda v: self.slip(space, poses, v), velocities)
        normal = norm(reactions[-1, : space.dimension])
        return pull(dry_friction(self.coefficient * normal, slip, self.transition_speed))[0]
