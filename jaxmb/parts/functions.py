"""Parts from user functions: position constraints, velocity constraints, forces and non-ideal constraint forces.

Functions see the poses and velocities of the frames of the bodies. The origin of a body's frame is its mass centre,
unless the body was given `centre=`, or the part names a `Frame` in its place.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from . import fields
from .base import AbstractConstraint, AbstractNonIdeal, AbstractPotentialForce, AbstractVelocityConstraint


def _shaped(part: Any, value: Any, shape: tuple[int, ...]) -> Array:
    """The return value of a user function in the required shape. It may lack the axis of a single row or body; a number
    may be an array of one element.
    """
    value = jnp.asarray(value)
    equivalent = shape[1:] if shape[:1] == (1,) else shape or (1,)
    if value.shape not in (shape, equivalent):
        raise ValueError(f"the function of {part.label} must return shape {shape}, got {value.shape}")
    return value.reshape(shape)


class Constraint(AbstractConstraint):
    """A holonomic constraint from a function, `function(poses, t, parameters) = 0`.

    ```python
    def on_circle(poses, t, p):
        return jnp.array([poses[0, :2] @ poses[0, :2] - p["radius"] ** 2])

    ring = jaxmb.Constraint("ring", "bar", on_circle, parameters={"radius": 0.5}, rheonomic=False)
    system = jaxmb.Scene([bar], joints=[ring]).compile()
    ```

    **Arguments:**

    - `bodies`: one name or several; `"ground"` may be among them.
    - `function(poses, t, parameters)`: returns shape `(rows,)`; `poses` has a row per body, of its frame (plane: x, y,
        angle; space: r, Euler parameters). It must be twice differentiable by JAX.
    - `rows`: the number of equations.
    - `parameters`: numbers, or modules as in `Force`, by name; they become parameters of the system, `"name.key"`.
    - `rheonomic`: whether the function depends on `t`.
    """

    name: str = fields.name()
    bodies: fields.Names = fields.body_names()
    function: Callable[..., Array] = fields.function()
    rows: int = eqx.field(static=True, default=1, kw_only=True)
    parameters: fields.Numbers = fields.numbers()
    rheonomic: bool = eqx.field(static=True, default=True, kw_only=True)

    @property
    def of_time(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.rheonomic

    def given_in_time(self, space, poses, velocities, t):
        del velocities
        return self.residual(space, poses, t)

    def residual(self, space, poses, t):
        value = self.function(poses[:, : space.pose_size], t, self.parameters)
        return _shaped(self, value, (self.rows,))


class VelocityConstraint(AbstractVelocityConstraint):
    """A nonholonomic constraint from a function, `function(poses, velocities, t, parameters) = 0`.

    ```python
    def no_side_slip(poses, velocities, t, p):
        (x_rate, y_rate, _), angle = velocities[0], poses[0, 2]
        return jnp.array([y_rate * jnp.cos(angle) - x_rate * jnp.sin(angle)])

    blade = jaxmb.VelocityConstraint("blade", "bar", no_side_slip, linear=True, homogeneous=True)
    system = jaxmb.Scene([bar], joints=[blade]).compile()
    ```

    **Arguments:** as `Constraint`; `velocities` has a row per body, of its frame (plane: ẋ, ẏ, angular rate; space: ṙ
    in the world, ω′ in the body frame). `linear`: the function is linear in the velocities up to a constant term
    (cheaper); `homogeneous`: it also vanishes at rest.
    """

    name: str = fields.name()
    bodies: fields.Names = fields.body_names()
    function: Callable[..., Array] = fields.function()
    rows: int = eqx.field(static=True, default=1, kw_only=True)
    parameters: fields.Numbers = fields.numbers()
    linear: bool = eqx.field(static=True, default=False, kw_only=True)
    homogeneous: bool = eqx.field(static=True, default=False, kw_only=True)
    of_time: ClassVar[bool] = True

    def given_in_time(self, space, poses, velocities, t):
        return self.residual(space, poses, velocities, t)

    def residual(self, space, poses, velocities, t):
        value = self.function(poses[:, : space.pose_size], velocities, t, self.parameters)
        return _shaped(self, value, (self.rows,))


class Force(AbstractPotentialForce):
    """A force law from a function, `function(poses, velocities, t, parameters) -> wrenches`.

    ```python
    def drag(poses, velocities, t, parameters):
        return -parameters["c"] * velocities  # of each body: force and moment

    jaxmb.Force("drag", ["bar"], drag, parameters={"c": 0.1})
    ```

    **Arguments:**

    - `bodies`: one name or several; `"ground"` may be among them (its wrench is dropped).
    - `function`: returns shape `(len(bodies), 3)` in the plane (force [N], moment [N m]) or `(len(bodies), 6)` in space
        (force in the world frame, moment in the body frame); of one body also shape `(3,)` or `(6,)`. Force and moment
        refer to the origin of the body's frame, whose pose and velocity the function sees: the mass centre, unless the
        body was given `centre=`. Derivatives of the motion are wrong if it jumps where a state passes a value.
    - `parameters`: numbers by name; they become parameters of the system, `"name.key"`. An equinox module, such as a
        neural network, may be among them: the function calls it as `parameters["net"](x)`, and all its weights are one
        parameter, a vector. `with_parameters` takes new weights as a vector or a module; `jaxmb.modules` returns the
        module.
    - `potential(poses, t, parameters)`: optional potential energy [J], for the energy balance; the forces are its
        negative gradient.
    - `gap(poses, t, parameters)`: optional gap [m, rad], a number or a vector, for a force such as a contact that acts
        only where the gap is negative. No step of `simulate` then passes over the force, however short it acts. The gap
        is a distance from a convex shape, or varies with a joint; other shapes need a gap for each convex part.
    """

    name: str = fields.name()
    bodies: fields.Names = fields.body_names()
    function: Callable[..., Array] = fields.function()
    parameters: fields.Numbers = fields.numbers()
    potential: Callable[..., Array] | None = fields.function(default=None, kw_only=True)
    gap: Callable[..., Array] | None = fields.function(default=None, kw_only=True)
    of_time: ClassVar[bool] = True

    @property
    def conservative(self):
        return self.potential is not None

    @property
    def has_gaps(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.gap is not None

    def gaps(self, space, poses, t):
        assert self.gap is not None
        return jnp.atleast_1d(jnp.asarray(self.gap(poses[:, : space.pose_size], t, self.parameters)))

    def given_in_time(self, space, poses, velocities, t):
        return self.wrenches(space, poses, velocities, t)

    def wrenches(self, space, poses, velocities, t):
        value = self.function(poses[:, : space.pose_size], velocities, t, self.parameters)
        shape = (len(self.bodies), space.velocity_size)
        return _shaped(self, value, shape)

    def energy(self, space, poses, t):
        assert self.potential is not None
        return _shaped(self, self.potential(poses[:, : space.pose_size], t, self.parameters), ())


class NonIdeal(AbstractNonIdeal):
    """A non-ideal constraint force, which does virtual work, from a function, `function(poses, velocities, reactions,
    t, parameters) -> wrenches`.

    ```python
    def rub(poses, velocities, reactions, t, p):
        moment = p["radius"] * jaxmb.rotations.norm(reactions[1, :2]) * jnp.tanh(velocities[1, 2] / 0.01)
        return jnp.zeros((2, 3)).at[:, 2].set(jnp.array([moment, -moment]))  # On the ground and on the bar.

    friction = jaxmb.NonIdeal("rub", "pin", rub, parameters={"radius": 0.002})
    system = jaxmb.Scene([bar], joints=[pin], forces=[friction, jaxmb.Gravity((0.0, -9.81))]).compile()
    ```

    **Arguments:**

    - `joint`: the name of a joint with a determinate reaction: no other joint may imply any of its rows.
    - `function`: as in `Force`, with a row for each of the joint's bodies. `reactions` are the joint's reaction
        wrenches on them, in the same axes, in the presence of all non-ideal forces. Returned components in directions
        that the joint blocks do not change the motion: they only reduce the reactions. Moments, given and returned, are
        about the origins of the frames.
    - `parameters`: as in `Force`.
    """

    name: str = fields.name()
    joint: str = fields.name()
    function: Callable[..., Array] = fields.function()
    parameters: fields.Numbers = fields.numbers()

    def wrenches(self, space, poses, velocities, reactions, t):
        value = self.function(poses[:, : space.pose_size], velocities, reactions, t, self.parameters)
        return _shaped(self, value, reactions.shape)
