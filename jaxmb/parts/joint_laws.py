"""Stops, dry friction and actuators of a joint's own coordinate, such as `"hip.angle"`."""

import jax
import jax.numpy as jnp
import numpy as np

from . import fields
from .base import AbstractDynamicForce, AbstractForce, AbstractPotentialForce
from .forces import generalized_force
from .joint_parts import AbstractCoordinatePart
from .smooth import ramp


class AbstractScalarPart(AbstractCoordinatePart):
    """A part of a coordinate that is a number."""

    def with_numbers(self, given):
        if given.size != 1:
            raise ValueError(f"{self.label}: {self.coordinate!r} must be a number, it has shape {given.shape}.")
        return self


class JointStop(AbstractScalarPart, AbstractPotentialForce):
    """Compliant stops at the ends of a coordinate's range: a spring and a damper where it is outside.

    The depth δ beyond a stop is that of a smooth ramp, `δ = ½ (d + √(d² + smoothing²))` with d = lower − value or
    value − upper. The stop has the potential `½ stiffness δ²` and the dissipation `damping δ̇²`.

    **Arguments:** `coordinate`, such as `"hip.angle"`; `lower` < `upper` [rad, m]; `stiffness` [N m/rad, N/m] ≥ 0;
    `damping` [N m s/rad, N s/m] ≥ 0; `smoothing` [rad, m] > 0, in which the ramp bends. The range of an angle must be
    less than a full turn.
    """

    lower: fields.Number = fields.parameter(unit="rad or m")
    upper: fields.Number = fields.parameter(unit="rad or m")
    stiffness: fields.Number = fields.parameter(unit="N m/rad or N/m", sign="non-negative")
    damping: fields.Number = fields.parameter(unit="N m s/rad or N s/m", sign="non-negative", default=0.0)
    smoothing: fields.Number = fields.parameter(unit="rad or m", sign="positive", default=1e-3)

    def validate(self):
        if not self.lower < self.upper:
            raise ValueError(f"{self.label}: lower must be less than upper, got {self.lower} and {self.upper}.")

    def with_numbers(self, given):
        if self.within in self.joint.periodic and self.upper - self.lower >= 2 * np.pi:
            raise ValueError(
                f"{self.label}: the range of an angle must be less than a full turn, got {self.lower} to {self.upper}."
            )
        return super().with_numbers(given)

    def _depths(self, value):
        value = self.near(value, 0.5 * (self.lower + self.upper))
        return ramp(jnp.concatenate([self.lower - value, value - self.upper]), self.smoothing)

    def wrenches(self, space, poses, velocities, t):
        def law(x, v):
            depth, rate = jax.jvp(self._depths, (x,), (v,))
            (force,) = jax.vjp(self._depths, x)[1](self.stiffness * depth + self.damping * rate)
            return -force

        return generalized_force(space, lambda x: self.measured(space, x), poses, velocities, law)

    def energy(self, space, poses, t):
        return 0.5 * self.stiffness * jnp.sum(self._depths(self.measured(space, poses)) ** 2)


class JointFriction(AbstractScalarPart, AbstractForce):
    """Dry friction of constant size on a coordinate: generalized force `−force tanh(rate / transition_speed)`.

    Unlike `Friction` it does not depend on the reaction of the joint.

    **Arguments:** `coordinate`, such as `"hip.angle"`; `force` [N m, N] ≥ 0; `transition_speed` [rad/s, m/s] > 0,
    below which friction is viscous.
    """

    force: fields.Number = fields.parameter(unit="N m or N", sign="non-negative")
    transition_speed: fields.Number = fields.parameter(unit="rad/s or m/s", sign="positive", default=1e-2)

    def wrenches(self, space, poses, velocities, t):
        law = lambda x, v: -self.force * jnp.tanh(v / self.transition_speed)
        return generalized_force(space, lambda x: self.measured(space, x), poses, velocities, law)


class JointActuator(AbstractScalarPart, AbstractDynamicForce):
    """An actuator with a control: a motor, or a position or velocity servo, with a gear.

    With the length `l = gear x` of the coordinate x, it exerts the generalized force `gear f`,
    `f = (gain · (1, l, l̇)) control + bias · (1, l, l̇)`: a motor has gain (1, 0, 0) and no bias; a position servo has
    gain (k, 0, 0) and bias (0, −k, −d); a velocity servo gain (d, 0, 0) and bias (0, 0, −d).

    With a `lag` an internal state, the `activation`, takes the place of the control and follows it,
    `lag · d(activation)/dt = control − activation`. Of an `Actuator` it is the force that follows.

    **Arguments:** `coordinate`, such as `"hip.angle"`, of which x counts in (−π, π] about `middle`; `control`, default
    zero, as an input of `simulate`, `"motor.control"`, a function of time; `gain` and `bias`, shape (3,); `gear`;
    `control_range` and `force_range`, shape (2,): the control and f are clipped to them, by default they are not;
    `lag` [s] > 0, default none; `activation`, its initial value, default zero.
    """

    control: fields.Number = fields.parameter(default=0.0)
    gear: fields.Number = fields.parameter(default=1.0)
    gain: fields.Number = fields.parameter(shape=(3,), default=(1.0, 0.0, 0.0))
    bias: fields.Number = fields.parameter(shape=(3,), default=(0.0, 0.0, 0.0))
    middle: fields.Number = fields.parameter(unit="rad or m", default=0.0)
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
        return part if self.lag is None else part.filled(activation=0.0)

    def force(self, length, rate):
        """f [N m, N] at a length [rad, m] and its rate."""
        terms = jnp.stack([jnp.ones_like(length), length, rate])
        control = self._clipped_control() if self.lag is None else self.activation
        force = jnp.dot(self.gain, terms) * control + jnp.dot(self.bias, terms)
        return _clipped(force, self.force_range)

    def wrenches(self, space, poses, velocities, t):
        def law(x, v):
            x = self.near(x, self.middle)
            return self.gear * self.force(self.gear * x[0], self.gear * v[0])[None]

        return generalized_force(space, lambda x: self.measured(space, x), poses, velocities, law)

    def state_rates(self, space, poses, velocities, t):
        return {} if self.lag is None else {"activation": (self._clipped_control() - self.activation) / self.lag}

    def state_sizes(self):
        size = jnp.abs(self.control) if self.control_range is None else jnp.max(jnp.abs(self.control_range))
        return {"activation": jnp.where(size > 0, size, 1.0)}

    def _clipped_control(self):
        return _clipped(self.control, self.control_range)


def _clipped(value, limits):
    return value if limits is None else jnp.clip(value, limits[0], limits[1])
