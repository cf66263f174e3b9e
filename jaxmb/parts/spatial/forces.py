"""Spatial forces that have no planar counterpart of the same shape."""

from typing import Literal

import jax.numpy as jnp
import numpy as np

from .. import fields
from ..base import AbstractForce, AbstractPair, AbstractPotentialForce, AbstractSpatialPart
from ..forces import generalized_force
from .axes import angle, measured_from_given_poses, offset_in_a, rotation_error, with_given_orientation


class Torque(AbstractSpatialPart, AbstractForce):
    """A constant moment on `body`, with its reaction on another one.

    ```python
    ball = spatial.Body("ball", mass=1.0, inertia=spatial.sphere(1.0, 0.1))
    twist = spatial.Torque("twist", "ball", torque=(0.0, 0.0, 0.3), frame="body")
    system = jaxmb.Scene([ball], forces=[twist]).compile()
    ```

    **Arguments:** `torque` [N m], shape (3,), in world axes or, with `frame="body"`, turning with the body; `reaction`,
    the body that bears the reaction, default ground. In `Trajectory.forces` the reaction is the first row, and the
    moment on `body` the second.
    """

    name: str = fields.name()
    reaction: str = fields.body_name(default="ground")
    body: str = fields.body_name()
    torque: fields.Number = fields.parameter(shape=(3,), unit="N m")
    frame: Literal["world", "body"] = fields.choice("world", "body", default="world")

    def wrenches(self, space, poses, velocities, t):
        torque_W = self.torque if self.frame == "world" else space.direction(poses[1], self.torque)
        moments = jnp.stack([-space.body_direction(poses[0], torque_W), space.body_direction(poses[1], torque_W)])
        return jnp.concatenate([jnp.zeros_like(moments), moments], axis=1)


class TorsionalSpringDamper(AbstractSpatialPart, AbstractPair, AbstractPotentialForce):
    """A linear spring and damper on an angle: moment `−stiffness (angle − free_angle) − damping rate` on B.

    ```python
    arm = spatial.Body("arm", mass=1.0, inertia=spatial.box(1.0, 1.0, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    hinge = spatial.Revolute("hinge", "ground", "arm", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    spring = spatial.TorsionalSpringDamper("spring", "ground", "arm", stiffness=20.0, axis=(0.0, 0.0, 1.0))
    system = jaxmb.Scene([arm], joints=[hinge], forces=[spring]).compile()
    ```

    The angle from `x_a` to `x_b` about `axis_a` is in (−π, π] and jumps half a turn away from `x_a`, so the joint
    should turn by less than that to either side. It should let B turn about the axis only; otherwise the angle is that
    of the projections perpendicular to the axis, and the moment is its gradient.

    **Arguments:** `stiffness` [N m/rad] ≥ 0; `damping` [N m s/rad] ≥ 0; `axis_a`, unit, shape (3,), fixed in `body_a`,
    or `axis` in the world; `x_a`, `x_b`, unit, shape (3,), body-fixed and perpendicular to the axis, by default with
    zero angle at the given poses; `free_angle` [rad], default that of the given poses.
    """

    stiffness: fields.Number = fields.parameter(unit="N m/rad", sign="non-negative")
    damping: fields.Number = fields.parameter(unit="N m s/rad", sign="non-negative", default=0.0)
    axis_a: fields.Number = fields.axis(body=0, optional=True)
    axis: fields.Number = fields.axis(body=None, gives=("axis_a",))
    x_a: fields.Number = fields.axis(body=0, optional=True)
    x_b: fields.Number = fields.axis(body=1, optional=True)
    free_angle: fields.Number = fields.parameter(unit="rad", optional=True)

    def complete(self, space, poses):
        part = measured_from_given_poses(self, space, poses)
        return part.filled(free_angle=angle(space, part, poses))

    def wrenches(self, space, poses, velocities, t):
        law = lambda x, v: -self.stiffness * (x - self.free_angle) - self.damping * v
        return generalized_force(space, self, lambda part, p: angle(space, part, p), poses, velocities, law)

    def energy(self, space, poses, t):
        return 0.5 * self.stiffness * (angle(space, self, poses) - self.free_angle) ** 2


class RotationalDamper(AbstractSpatialPart, AbstractPair, AbstractForce):
    """A linear damper on the relative angular velocity, about every axis: moment `−damping (ω_B − ω_A)` on B.

    ```python
    ball = spatial.Body("ball", mass=1.0, inertia=spatial.sphere(1.0, 0.1), angular_velocity=(0.0, 0.0, 10.0))
    oil = spatial.RotationalDamper("oil", "ground", "ball", damping=0.01)
    socket = spatial.Spherical("socket", "ground", "ball", point=(0.0, 0.0, 0.0))
    system = jaxmb.Scene([ball], joints=[socket], forces=[oil]).compile()
    ```

    **Arguments:** `damping` [N m s/rad] ≥ 0.
    """

    damping: fields.Number = fields.parameter(unit="N m s/rad", sign="non-negative")

    def wrenches(self, space, poses, velocities, t):
        omega_a, omega_b = (space.direction(x, v[3:]) for x, v in zip(poses, velocities, strict=True))
        moment_W = -self.damping * (omega_b - omega_a)
        moments = jnp.stack([-space.body_direction(poses[0], moment_W), space.body_direction(poses[1], moment_W)])
        return jnp.concatenate([jnp.zeros_like(moments), moments], axis=1)


class Bushing(AbstractSpatialPart, AbstractPair, AbstractPotentialForce):
    """A compliant joint: springs and dampers on the six relative motions of a frame in B with respect to one in A.

    ```python
    crate = spatial.Body("crate", mass=3.0, inertia=spatial.box(3.0, 0.4, 0.2, 0.1))
    softness = {"stiffness": (1e4, 1e4, 1e4, 10.0, 10.0, 10.0), "damping": (50.0, 50.0, 50.0, 0.1, 0.1, 0.1)}
    bush = spatial.Bushing("bush", "ground", "crate", point=(0.0, 0.0, -0.05), **softness)
    system = jaxmb.Scene([crate], forces=[bush]).compile()
    ```

    The motions are the position of B's point relative to A's point in the axes of `body_a` (3) [m], and twice the
    vector part of the Euler parameters from `orientation` to the relative attitude, in the axes of `body_b` (3): the
    rotation vector [rad] when small, `2 sin(angle/2)` along the axis of rotation in general, so the moment of an
    isotropic spring is `stiffness sin(angle)`. Both signs of the bodies' Euler parameters give the same wrench and
    energy.

    **Arguments:** `stiffness`, shape (6,) [N/m (3), N m/rad (3)] ≥ 0; `damping`, shape (6,) [N s/m (3), N m s/rad (3)]
    ≥ 0; points as in `Spherical`; `orientation`, shape (4,), unit Euler parameters of B relative to A, default those of
    the given poses.
    """

    stiffness: fields.Number = fields.parameter(shape=(6,), unit=("N m/rad", "N/m"), sign="non-negative")
    damping: fields.Number = fields.parameter(
        shape=(6,), unit=("N m s/rad", "N s/m"), sign="non-negative", default=(0.0,) * 6
    )
    point_a: fields.Number = fields.point(body=0, optional=True)
    point_b: fields.Number = fields.point(body=1, optional=True)
    point: fields.Number = fields.point(body=None, gives=("point_a", "point_b"))
    orientation: fields.Number = fields.attitude(optional=True)

    def complete(self, space, poses):
        return with_given_orientation(self, poses)

    def is_of_length(self, field):
        return np.arange(len(self.stiffness)) < self.dimensions[0]

    def _motions(self, space, poses):
        return jnp.concatenate([offset_in_a(space, self, poses), rotation_error(self, poses)])

    def wrenches(self, space, poses, velocities, t):
        law = lambda x, v: -self.stiffness * x - self.damping * v
        return generalized_force(space, self, lambda part, p: part._motions(space, p), poses, velocities, law)

    def energy(self, space, poses, t):
        return 0.5 * jnp.sum(self.stiffness * self._motions(space, poses) ** 2)
