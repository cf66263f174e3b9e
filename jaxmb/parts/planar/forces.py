"""Forces of the plane that have no counterpart of the same shape in space."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..base import AbstractForce, number, optional_number
from ..forces import generalized_force
from ..resolve import fill, label, point_pair, positive, vector
from ..smooth import ramp


class Torque(AbstractForce):
    """A constant moment on `body`, with its reaction on another one.

    **Arguments:** `torque` [N m]; `reaction`, the body that bears the reaction, default ground.
    """

    name: str = eqx.field(static=True)
    body: str = eqx.field(static=True)
    torque: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    reaction: str = eqx.field(static=True, default="ground", kw_only=True)
    conservative: ClassVar[bool] = False

    @property
    def bodies(self):
        return (self.reaction, self.body)

    def resolve(self, space, poses):
        vector(self, "torque", self.torque[None], 1)
        return self

    def wrenches(self, space, poses, velocities, t):
        wrench = jnp.concatenate([jnp.zeros(2, poses.dtype), self.torque[None]])
        return jnp.stack([-wrench, wrench])


class TorsionalSpringDamper(AbstractForce):
    """A linear spring and damper on the relative angle: moment `−stiffness (angle − free_angle) − damping rate` on B.

    **Arguments:** `stiffness` [N m/rad] ≥ 0; `damping` [N m s/rad] ≥ 0; `free_angle` [rad] of `angle_b − angle_a`,
    default that of the given poses.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    stiffness: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    damping: Float[Array, ""] = eqx.field(converter=number, default=0.0, kw_only=True)
    free_angle: Float[Array, ""] = eqx.field(converter=optional_number, default=None, kw_only=True)
    conservative: ClassVar[bool] = True

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        positive(self, "stiffness", self.stiffness, zero=True)
        positive(self, "damping", self.damping, zero=True)
        return fill(self, "free_angle", poses[1, 2] - poses[0, 2])

    def wrenches(self, space, poses, velocities, t):
        angle = poses[1, 2] - poses[0, 2] - self.free_angle
        moment = -self.stiffness * angle - self.damping * (velocities[1, 2] - velocities[0, 2])
        wrench = jnp.concatenate([jnp.zeros(2, poses.dtype), moment[None]])
        return jnp.stack([-wrench, wrench])

    def energy(self, space, poses, t):
        return 0.5 * self.stiffness * (poses[1, 2] - poses[0, 2] - self.free_angle) ** 2


class BumpStop(AbstractForce):
    """Progressive stops of a relative angle on both sides, `angle = angle_b − angle_a`.

    Beyond a limit the potential is `stiffness δ^(exponent + 1) / (exponent + 1)` of a smoothed depth
    `δ = ½ (d + √(d² + smoothing²))`, d = lower − angle or angle − upper: a moment on B of nearly `stiffness d^exponent`
    back.

    **Arguments:** `stiffness` [N m/rad^exponent] ≥ 0; `lower` < `upper` [rad], the limits; `exponent` > 0; `smoothing`
    [rad] > 0.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    stiffness: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    lower: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    upper: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    exponent: Float[Array, ""] = eqx.field(converter=number, default=3.0, kw_only=True)
    smoothing: Float[Array, ""] = eqx.field(converter=number, default=1e-3, kw_only=True)
    conservative: ClassVar[bool] = True

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        positive(self, "stiffness", self.stiffness, zero=True)
        positive(self, "exponent", self.exponent)
        positive(self, "smoothing", self.smoothing)
        if not self.lower < self.upper:
            raise ValueError(f"{label(self)}: lower must be less than upper, got {self.lower} and {self.upper}.")
        return self

    def _energy(self, angle):
        depth = ramp(jnp.stack([self.lower - angle, angle - self.upper]), self.smoothing)
        return self.stiffness * jnp.sum(depth ** (self.exponent + 1)) / (self.exponent + 1)

    def wrenches(self, space, poses, velocities, t):
        moment = -jax.grad(self._energy)(poses[1, 2] - poses[0, 2])
        wrench = jnp.concatenate([jnp.zeros(2, poses.dtype), moment[None]])
        return jnp.stack([-wrench, wrench])

    def energy(self, space, poses, t):
        return self._energy(poses[1, 2] - poses[0, 2])


class Bushing(AbstractForce):
    """A compliant joint: springs and dampers on the three relative motions of a frame in B with respect to one in A.

    The motions are the position of B's point in the axes of `body_a` relative to A's point (2) [m] and the relative
    angle less that of the given poses [rad].

    **Arguments:** `stiffness`, shape (3,) [N/m, N/m, N m/rad]; `damping`, shape (3,) [N s/m, N s/m, N m s/rad];
    points as in `Revolute`; `free_angle` [rad], default that of the given poses.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    stiffness: Float[Array, "3"] = eqx.field(converter=number, kw_only=True)
    damping: Float[Array, "3"] = eqx.field(converter=number, default=(0.0, 0.0, 0.0), kw_only=True)
    point_a: Float[Array, "2"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point_b: Float[Array, "2"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point: Float[Array, "2"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    free_angle: Float[Array, ""] = eqx.field(converter=optional_number, default=None, kw_only=True)
    conservative: ClassVar[bool] = True

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        for field in ("stiffness", "damping"):
            vector(self, field, getattr(self, field), 3)
            positive(self, field, getattr(self, field), zero=True)
        return fill(point_pair(self, space, poses), "free_angle", poses[1, 2] - poses[0, 2])

    def _motions(self, space, poses):
        shift = space.body_point(poses[0], space.point(poses[1], self.point_b)) - self.point_a
        return jnp.concatenate([shift, (poses[1, 2] - poses[0, 2] - self.free_angle)[None]])

    def wrenches(self, space, poses, velocities, t):
        law = lambda x, v: -self.stiffness * x - self.damping * v
        return generalized_force(space, lambda p: self._motions(space, p), poses, velocities, law)

    def energy(self, space, poses, t):
        return 0.5 * jnp.sum(self.stiffness * self._motions(space, poses) ** 2)
