"""Forces of space that have no counterpart of the same shape in the plane."""

from typing import ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..base import AbstractForce, number, optional_number
from ..forces import generalized_force
from ..resolve import fill, label, point_pair, positive, vector
from .axes import angle, resolve_axis, resolve_orientation, resolve_references, shift_in_a, turn_vector


class Torque(AbstractForce):
    """A constant moment on `body`, with its reaction on another one.

    **Arguments:** `torque` [N m], shape (3,), in world axes or, with `frame="body"`, turning with the body; `reaction`,
    the body that bears the reaction, default ground.
    """

    name: str = eqx.field(static=True)
    body: str = eqx.field(static=True)
    torque: Float[Array, "3"] = eqx.field(converter=number, kw_only=True)
    reaction: str = eqx.field(static=True, default="ground", kw_only=True)
    frame: Literal["world", "body"] = eqx.field(static=True, default="world", kw_only=True)
    conservative: ClassVar[bool] = False

    def __check_init__(self):
        if self.frame not in ("world", "body"):
            raise ValueError(f"{label(self)}: frame must be 'world' or 'body', got {self.frame!r}.")

    @property
    def bodies(self):
        return (self.reaction, self.body)

    def resolve(self, space, poses):
        vector(self, "torque", self.torque, 3)
        return self

    def wrenches(self, space, poses, velocities, t):
        torque_W = self.torque if self.frame == "world" else space.direction(poses[1], self.torque)
        moments = jnp.stack([-space.body_direction(poses[0], torque_W), space.body_direction(poses[1], torque_W)])
        return jnp.concatenate([jnp.zeros_like(moments), moments], axis=1)


class TorsionalSpringDamper(AbstractForce):
    """A linear spring and damper on an angle: moment `−stiffness (angle − free_angle) − damping rate` on B.

    The angle is that from `x_a` to `x_b` about `axis_a`, in (−π, π]: it jumps half a turn away from `x_a`, so it suits
    joints that turn less than that to either side. It should be that of a joint which lets B turn about the axis only;
    otherwise it is the angle of the projections across the axis, and the moment its gradient.

    **Arguments:** `stiffness` [N m/rad] ≥ 0; `damping` [N m s/rad] ≥ 0; `axis_a`, unit, shape (3,), fixed in `body_a`,
    or `axis` in the world; `x_a`, `x_b`, unit, shape (3,), body-fixed and across the axis, default such that the angle
    is zero at the given poses; `free_angle` [rad], default that of the given poses.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    stiffness: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    damping: Float[Array, ""] = eqx.field(converter=number, default=0.0, kw_only=True)
    axis_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    x_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    x_b: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    free_angle: Float[Array, ""] = eqx.field(converter=optional_number, default=None, kw_only=True)
    conservative: ClassVar[bool] = True

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        positive(self, "stiffness", self.stiffness, zero=True)
        positive(self, "damping", self.damping, zero=True)
        part = resolve_references(resolve_axis(self, space, poses), space, poses)
        return fill(part, "free_angle", angle(space, part, poses))

    def wrenches(self, space, poses, velocities, t):
        law = lambda x, v: -self.stiffness * (x - self.free_angle) - self.damping * v
        return generalized_force(space, lambda p: angle(space, self, p), poses, velocities, law)

    def energy(self, space, poses, t):
        return 0.5 * self.stiffness * (angle(space, self, poses) - self.free_angle) ** 2


class Bushing(AbstractForce):
    """A compliant joint: springs and dampers on the six relative motions of a frame in B with respect to one in A.

    The motions are the position of B's point relative to A's point in the axes of `body_a` (3) [m], and twice the
    vector part of the Euler parameters from `orientation` to the relative attitude, in the axes of `body_b` (3): the
    rotation vector [rad] when small, `2 sin(angle/2)` along the axis of the turn in general, so the moment of an
    isotropic spring is `stiffness sin(angle)`. Both signs of the bodies' Euler parameters give the same wrench and
    energy.

    **Arguments:** `stiffness`, shape (6,) [N/m (3), N m/rad (3)] ≥ 0; `damping`, shape (6,) [N s/m (3), N m s/rad (3)]
    ≥ 0; points as in `Spherical`; `orientation`, shape (4,), unit Euler parameters of B relative to A, default those of
    the given poses.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    stiffness: Float[Array, "6"] = eqx.field(converter=number, kw_only=True)
    damping: Float[Array, "6"] = eqx.field(converter=number, default=(0.0,) * 6, kw_only=True)
    point_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point_b: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    orientation: Float[Array, "4"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    conservative: ClassVar[bool] = True

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        for field in ("stiffness", "damping"):
            vector(self, field, getattr(self, field), 6)
            positive(self, field, getattr(self, field), zero=True)
        return resolve_orientation(point_pair(self, space, poses), poses)

    def _motions(self, space, poses):
        return jnp.concatenate([shift_in_a(space, self, poses), turn_vector(self, poses)])

    def wrenches(self, space, poses, velocities, t):
        law = lambda x, v: -self.stiffness * x - self.damping * v
        return generalized_force(space, lambda p: self._motions(space, p), poses, velocities, law)

    def energy(self, space, poses, t):
        return 0.5 * jnp.sum(self.stiffness * self._motions(space, poses) ** 2)
