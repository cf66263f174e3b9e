"""Motors and actuators on the coordinates of joints, with lag and limits.

A `Motor` regulates a force, a speed or a position, and its force lags behind the demand. An `Actuator` has a control,
which may lag, and a force that is affine in the coordinate and its rate.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from . import fields
from .base import AbstractDynamicForce
from .coordinate_parts import AbstractCoordinateForce, AbstractScalarPart
from .curves import over_arrays
from .kinks import clipped


class Motor(AbstractCoordinateForce, AbstractDynamicForce):
    """A motor on a joint's coordinate that follows a command with lag and within a limit.

    ```python
    motor = jaxmb.Motor("motor", "pin.angle", mode="speed", command=10.0, gain=2.0, lag=0.05, limit=20.0)
    system = jaxmb.Scene([bar], joints=[pin], forces=[motor]).compile()
    ```

    The demanded force is, for a coordinate x,

    - `mode="force"`: `command`;
    - `mode="speed"`: `gain (command − ẋ)`;
    - `mode="position"`: `gain (command − x) − damping ẋ`; an angle takes the shortest way to the command, up to half a
        turn, in the plane as in space;

    with a limit F it becomes `F tanh(demand / F)`. The force of the motor, an internal state, follows it as
    `lag · d(force)/dt = demand − force`.

    **Arguments:** `command` of the coordinate's shape, [N m, N], [rad/s, m/s] or [rad, m]; as an input of `simulate`,
    `"motor.command"` is a function of time; `gain` ≥ 0, force per unit of the command, needed by the modes `"speed"`
    and `"position"`; `damping` ≥ 0, force per speed; `lag` [s] > 0; `limit` [N m, N] > 0 of the demand, default none;
    `force` [N m, N], its initial value. A positive force increases the coordinate; the joint's other body bears the
    reaction. `motion["motor"].drive_force` is the force along a motion: force × rate is the power that the motor puts
    into the machine.
    """

    mode: Literal["force", "speed", "position"] = fields.choice("force", "speed", "position", default="force")
    command: fields.Number = fields.parameter(shape=None)
    lag: fields.Number = fields.parameter(unit="s", sign="positive")
    gain: fields.Number = fields.parameter(sign="non-negative", optional=True)
    damping: fields.Number = fields.parameter(unit=("N m s/rad", "N s/m"), sign="non-negative", default=0.0)
    limit: fields.Number = fields.parameter(unit=("N m", "N"), sign="positive", optional=True)
    force: fields.Number = fields.internal_state(shape=None, unit=("N m", "N"))
    drives_by: ClassVar[str | None] = "force"

    def validate(self):
        if self.mode == "force" and (np.any(self.gain) or np.any(self.damping)):
            raise ValueError(f"{self.label}: gain and damping belong to the modes 'speed' and 'position'.")
        if self.mode != "force" and self.gain is None:
            raise ValueError(
                f"{self.label}: without a gain the command does nothing in the mode {self.mode!r}; give gain."
            )
        if self.mode == "speed" and np.any(self.damping):
            raise ValueError(f"{self.label}: damping belongs to the mode 'position'; with 'speed' use gain.")

    def is_angle(self, field, unit):
        if field == "command":
            return self.mode == "position" and super().is_angle(field, ("rad", "m"))
        return super().is_angle(field, unit)

    def with_numbers(self, given):
        self._check_shape("command", given)
        part = self.filled(gain=0.0)
        return part.with_fields(force=fields.as_parameter(np.broadcast_to(self.force, given.shape)))

    def law(self, x, v):
        return self.force.reshape(-1)

    def curve(self, value: ArrayLike = 0.0, rate: ArrayLike = 0.0) -> Float[Array, "..."]:
        """The demanded force [N m, N], which the force of the motor follows, at values [rad, m] and rates [rad/s, m/s]
        of a coordinate that is a number: arrays that broadcast.
        """
        return over_arrays(self.label, _demanded, self, value=value, rate=rate)

    def _demand(self, x: Float[Array, "n"], v: Float[Array, "n"]) -> Float[Array, "n"]:
        """The demanded force at the coordinate and its rate, raveled."""
        if self.mode == "force":
            demand = self.command.reshape(-1)
        elif self.mode == "speed":
            demand = self.gain * (self.command.reshape(-1) - v)
        else:
            demand = -self.gain * self.shortest_difference(x, self.command) - self.damping * v
        if self.limit is not None:
            demand = self.limit * jnp.tanh(demand / self.limit)
        return demand

    def state_rates(self, space, poses, velocities, t):
        demand = self._demand(*self.measured_with_rate(space, poses, velocities))
        return {"force": (demand.reshape(self.force.shape) - self.force) / self.lag}

    def state_sizes(self):
        largest = jnp.max(jnp.abs(self.command)) if self.mode == "force" else self.gain
        size = largest if self.limit is None else self.limit
        return {"force": jnp.where(size > 0, size, 1.0)}


def _demanded(motor, value, rate):
    return motor._demand(value[None], rate[None])[0]


class Actuator(AbstractCoordinateForce, AbstractScalarPart, AbstractDynamicForce):
    """An actuator with a control: a motor, or a position or velocity servo, with a gear.

    ```python
    servo = jaxmb.Actuator("servo", "pin.angle", control=0.3, gain=(50.0, 0.0, 0.0), bias=(0.0, -50.0, -5.0))
    system = jaxmb.Scene([bar], joints=[pin], forces=[servo]).compile()
    ```

    With the length `l = gear x` of the coordinate x, it exerts the generalized force `gear f`,
    `f = (gain · (1, l, l̇)) control + bias · (1, l, l̇)`: a motor has gain (1, 0, 0) and no bias; a position servo has
    gain (k, 0, 0) and bias (0, −k, −d); a velocity servo gain (d, 0, 0) and bias (0, 0, −d).

    With a `lag` an internal state, the `activation`, takes the place of the control and follows it, `lag ·
    d(activation)/dt = control − activation`. In a `Motor` the force follows instead.

    **Arguments:** `control`, default zero, as an input of `simulate`, `"motor.control"`, a function of time; `gain` and
    `bias`, shape (3,); `gear`; `middle` [rad], for angles in space only, default zero: the angle is wrapped to within
    half a turn of `middle`; `control_range` and `force_range`, shape (2,), to which the control and f are clipped,
    default none; `lag` [s] > 0, default none; `activation`, its initial value, default zero.
    """

    ranges: ClassVar[Mapping[str, str]] = MappingProxyType({"control": "control_range"})
    control: fields.Number = fields.parameter(default=0.0)
    gear: fields.Number = fields.parameter(unit="1", default=1.0)
    gain: fields.Number = fields.parameter(shape=(3,), default=(1.0, 0.0, 0.0))
    bias: fields.Number = fields.parameter(shape=(3,), default=(0.0, 0.0, 0.0))
    middle: fields.Number = fields.parameter(unit=("rad", "m"), default=0.0)
    control_range: fields.Number = fields.parameter(shape=(2,), optional=True)
    force_range: fields.Number = fields.parameter(shape=(2,), optional=True)
    lag: fields.Number = fields.parameter(unit="s", sign="positive", optional=True)
    activation: fields.Number = fields.internal_state(optional=True)

    def validate(self):
        for name in ("control_range", "force_range"):
            given = getattr(self, name)
            if given is not None and not given[0] < given[1]:
                raise ValueError(f"{self.label}: {name} must be two numbers that increase, got {given.tolist()}.")
        if self.lag is None and self.activation is not None:
            raise ValueError(f"{self.label}: an activation needs a lag.")

    def with_numbers(self, given):
        part = super().with_numbers(given)
        if np.any(self.middle):
            self._check_middle()
        return part if self.lag is None else part.filled(activation=0.0)

    def force(self, length, rate):
        """f [N m, N] at a length [rad, m] and its rate."""
        terms = jnp.stack([jnp.ones_like(length), length, rate])
        control = self._clipped_control() if self.lag is None else self.activation
        force = jnp.dot(self.gain, terms) * control + jnp.dot(self.bias, terms)
        return _clipped(force, self.force_range)

    def middle_of_turn(self):
        reads_angle = (self.gain[..., 1] != 0) | (self.bias[..., 1] != 0)
        return jnp.where(reads_angle, self.middle, jnp.nan)

    def law(self, x, v):
        x = self.near(x, self.middle)
        return self.gear * self.force(self.gear * x[0], self.gear * v[0])[None]

    def _in_itself(self):
        # The activation follows the control, which takes its place.
        return self.with_fields(lag=None, activation=None)

    def state_rates(self, space, poses, velocities, t):
        return {} if self.lag is None else {"activation": (self._clipped_control() - self.activation) / self.lag}

    def state_sizes(self):
        size = jnp.abs(self.control) if self.control_range is None else jnp.max(jnp.abs(self.control_range))
        return {"activation": jnp.where(size > 0, size, 1.0)}

    def _clipped_control(self):
        return _clipped(self.control, self.control_range)


def _clipped(value, limits):
    return value if limits is None else clipped(value, limits[0], limits[1])
