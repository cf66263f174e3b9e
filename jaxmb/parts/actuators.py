"""Motors on the coordinates of joints, with lag and limits."""

from typing import Literal

import jax.numpy as jnp
import numpy as np

from . import fields
from .base import AbstractDynamicForce
from .forces import generalized_force
from .joint_parts import AbstractCoordinatePart


class Actuator(AbstractCoordinatePart, AbstractDynamicForce):
    """A motor on a joint's coordinate, which follows a command with lag, and within a limit.

    The demanded force is, for a coordinate x,

    - `mode="force"`: `command`;
    - `mode="speed"`: `gain (command − ẋ)`;
    - `mode="position"`: `gain (command − x) − damping ẋ`; of an angle the shortest way to the command, up to half a
        turn, in the plane as in space;

    with a limit F it becomes `F tanh(demand / F)`. The force of the motor, an internal state, follows it as
    `lag · d(force)/dt = demand − force`.

    **Arguments:** `coordinate`, such as `"hip.angle"`; `command` of the coordinate's shape, [N m, N], [rad/s, m/s] or
    [rad, m]; as an input of `simulate`, `"motor.command"` is a function of time; `gain` and `damping` ≥ 0, of a force
    over the command's unit and over a speed; `lag` [s] > 0; `limit` [N m, N] > 0 of the demand, default none; `force`
    [N m, N], its initial value. Positive forces increase the coordinate, with the reaction on the joint's other body.
    """

    mode: Literal["force", "speed", "position"] = fields.choice("force", "speed", "position", default="force")
    command: fields.Number = fields.parameter(shape=None, unit="N m, rad/s, rad or N, m/s, m")
    lag: fields.Number = fields.parameter(unit="s", sign="positive")
    gain: fields.Number = fields.parameter(sign="non-negative", default=0.0)
    damping: fields.Number = fields.parameter(unit="N m s/rad or N s/m", sign="non-negative", default=0.0)
    limit: fields.Number = fields.parameter(unit="N m or N", sign="positive", optional=True)
    force: fields.Number = fields.internal_state(shape=None, unit="N m or N")

    def validate(self):
        if self.mode == "force" and (np.any(self.gain) or np.any(self.damping)):
            raise ValueError(f"{self.label}: gain and damping belong to the modes 'speed' and 'position'.")
        if self.mode == "speed" and np.any(self.damping):
            raise ValueError(f"{self.label}: damping belongs to the mode 'position'; with 'speed' use gain.")

    def with_numbers(self, given):
        self._check_shape("command", given)
        part = self.with_fields(force=fields.as_parameter(np.broadcast_to(self.force, given.shape)))
        return part

    def wrenches(self, space, poses, velocities, t):
        law = lambda x, v: self.force.reshape(-1)
        return generalized_force(space, lambda x: self.measured(space, x), poses, velocities, law)

    def state_rates(self, space, poses, velocities, t):
        x, v = self.measured_with_rate(space, poses, velocities)
        if self.mode == "force":
            demand = self.command.reshape(-1)
        elif self.mode == "speed":
            demand = self.gain * (self.command.reshape(-1) - v)
        else:
            demand = -self.gain * self.shortest_difference(x, self.command) - self.damping * v
        if self.limit is not None:
            demand = self.limit * jnp.tanh(demand / self.limit)
        return {"force": (demand.reshape(self.force.shape) - self.force) / self.lag}

    def state_sizes(self):
        largest = jnp.max(jnp.abs(self.command)) if self.mode == "force" else self.gain
        size = largest if self.limit is None else self.limit
        return {"force": jnp.where(size > 0, size, 1.0)}
