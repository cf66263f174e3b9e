"""Parts written by the user as a function: constraints between positions, between velocities, forces, and what joints
do beyond d'Alembert's principle.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .base import AbstractConstraint, AbstractForce, AbstractNonIdeal, AbstractVelocityConstraint, array


def names(bodies: Any) -> tuple[str, ...]:
    return (bodies,) if isinstance(bodies, str) else tuple(bodies)


def numbers(parameters: dict[str, Any]) -> dict[str, Array]:
    return {key: array(value) for key, value in parameters.items()}


class Constraint(AbstractConstraint):
    """A holonomic constraint from a function, `function(poses, t, parameters) = 0`.

    **Arguments:**

    - `bodies`: one name or several; `"ground"` may be among them.
    - `function(poses, t, parameters)`: returns shape `(rows,)`; `poses` has a row per body (plane: x, y, angle;
        space: r, Euler parameters). It must be twice differentiable by JAX.
    - `rows`: the number of equations.
    - `parameters`: numbers by name; they become parameters of the system, `"name.key"`.
    - `rheonomic`: whether the function depends on `t`.
    """

    name: str = eqx.field(static=True)
    bodies: tuple[str, ...] = eqx.field(static=True, converter=names)
    function: Callable[..., Array] = eqx.field(static=True)
    rows: int = eqx.field(static=True, default=1, kw_only=True)
    parameters: dict[str, Array] = eqx.field(converter=numbers, default_factory=dict, kw_only=True)
    rheonomic: bool = eqx.field(static=True, default=True, kw_only=True)

    def residual(self, space, poses, t):
        return jnp.reshape(self.function(poses[:, : space.pose_size], t, self.parameters), (self.rows,))


class VelocityConstraint(AbstractVelocityConstraint):
    """A nonholonomic constraint from a function, `function(poses, velocities, t, parameters) = 0`.

    **Arguments:** as `Constraint`; `velocities` has a row per body (plane: ẋ, ẏ, angular rate; space: ṙ in the world,
    ω′ in the body frame). `linear` says that the function is linear in the velocities up to a constant term
    (cheaper); `homogeneous` that it also vanishes at rest.
    """

    name: str = eqx.field(static=True)
    bodies: tuple[str, ...] = eqx.field(static=True, converter=names)
    function: Callable[..., Array] = eqx.field(static=True)
    rows: int = eqx.field(static=True, default=1, kw_only=True)
    parameters: dict[str, Array] = eqx.field(converter=numbers, default_factory=dict, kw_only=True)
    linear: bool = eqx.field(static=True, default=False, kw_only=True)
    homogeneous: bool = eqx.field(static=True, default=False, kw_only=True)

    def residual(self, space, poses, velocities, t):
        return jnp.reshape(self.function(poses[:, : space.pose_size], velocities, t, self.parameters), (self.rows,))


class Force(AbstractForce):
    """A force law from a function, `function(poses, velocities, t, parameters) -> wrenches`.

    **Arguments:**

    - `bodies`: one name or several; `"ground"` may be among them (its wrench is dropped).
    - `function`: returns shape `(len(bodies), 3)` in the plane (force [N], moment about the mass centre [N m]) or
        `(len(bodies), 6)` in space (force in the world frame, moment in the body frame).
    - `parameters`: numbers by name; they become parameters of the system, `"name.key"`.
    - `potential(poses, t, parameters)`: optional potential energy [J] of which these forces are the gradient, for the
        energy balance.
    """

    name: str = eqx.field(static=True)
    bodies: tuple[str, ...] = eqx.field(static=True, converter=names)
    function: Callable[..., Array] = eqx.field(static=True)
    parameters: dict[str, Array] = eqx.field(converter=numbers, default_factory=dict, kw_only=True)
    potential: Callable[..., Array] | None = eqx.field(static=True, default=None, kw_only=True)

    @property
    def conservative(self):
        return self.potential is not None

    def wrenches(self, space, poses, velocities, t):
        value = self.function(poses[:, : space.pose_size], velocities, t, self.parameters)
        return jnp.reshape(value, (len(self.bodies), space.velocity_size))

    def energy(self, space, poses, t):
        assert self.potential is not None
        return jnp.reshape(self.potential(poses[:, : space.pose_size], t, self.parameters), ())


class NonIdeal(AbstractNonIdeal):
    """What a joint does beyond d'Alembert's principle, from a function,
    `function(poses, velocities, reactions, t, parameters) -> wrenches`.

    **Arguments:**

    - `joint`: the name of a joint whose force is determined: no other joint may imply any of its rows.
    - `function`: takes and returns what that of a `Force` does, with a row for each of the joint's bodies, and
        `reactions`: the wrenches that the joint would exert on them if all joints were ideal, in the same axes. What
        its wrenches do in motions that the joints do not allow has no effect.
    - `parameters`: numbers by name; they become parameters of the system, `"name.key"`.

    Source: F. E. Udwadia and P. Phohomsiri, "Explicit Poincaré equations of motion for general constrained systems",
    Proc. R. Soc. A 463, 2007.
    """

    name: str = eqx.field(static=True)
    joint: str = eqx.field(static=True)
    function: Callable[..., Array] = eqx.field(static=True)
    parameters: dict[str, Array] = eqx.field(converter=numbers, default_factory=dict, kw_only=True)

    def wrenches(self, space, poses, velocities, reactions, t):
        value = self.function(poses[:, : space.pose_size], velocities, reactions, t, self.parameters)
        return jnp.reshape(value, reactions.shape)
