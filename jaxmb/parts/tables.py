"""Springs, dampers and motors on the coordinates of joints, by tables of measured forces.

Between its points a table is a curve with two continuous derivatives, by `local_spline`; beyond them a straight line.
Points that never fall give a curve that never falls, and likewise for points that never rise.
"""

import jax.numpy as jnp

from . import fields, local_spline
from .base import AbstractDynamicForce, AbstractForce, AbstractPotentialForce
from .coordinate_parts import AbstractCoordinateForce, AbstractScalarPart
from .kinks import clipped


class TableSpring(AbstractCoordinateForce, AbstractScalarPart, AbstractPotentialForce):
    """A spring on a coordinate by a table: generalized force `−f(value)`, with the curve f through given points.

    ```python
    table = {"values": (0.9, 1.0, 1.1, 1.3), "forces": (-30.0, 0.0, 10.0, 60.0)}
    cord = jaxmb.Tendon("cord", [("ground", (0.0, 1.0)), ("bar", (0.5, 0.0))])
    spring = jaxmb.TableSpring("spring", "cord.length", **table)
    system = jaxmb.Scene([bar], joints=[pin, cord], forces=[spring]).compile()
    ```

    The curve has two continuous derivatives. Where the points rise it never falls, and where they fall it never rises;
    next to a highest or a lowest point it may pass that point. Beyond the first and the last point it continues as a
    straight line, through this point and its neighbour. The energy is its integral from the first point. In space an
    angle counts within half a turn of the middle of the table. `spring.curve(1.05)` is the generalized force −f(1.05),
    without a machine.

    **Arguments:** `values` [rad, m] of the coordinate, shape (n,), ascending, n ≥ 3; `forces` [N m, N], shape (n,),
    positive where the spring pulls towards smaller values.
    """

    values: fields.Number = fields.parameter(shape=(None,), unit=("rad", "m"), converter=fields.as_jax)
    forces: fields.Number = fields.parameter(shape=(None,), unit=("N m", "N"), converter=fields.as_jax)

    def validate(self):
        local_spline.check(self.label, ("values", "forces"), self.values, self.forces)

    def numbers_agree(self):
        return jnp.all(jnp.diff(self.values) > 0)

    def middle_of_turn(self):
        return 0.5 * (self.values[..., 0] + self.values[..., -1])

    def _in_table(self, value):
        return self.near(value, self.middle_of_turn())[0]

    def law(self, x, v):
        return -local_spline.value(self.values, self.forces, self._in_table(x))[None]

    def energy(self, space, poses, t):
        return local_spline.integral(self.values, self.forces, self._in_table(self.measured(space, poses)))


class TableDamper(AbstractCoordinateForce, AbstractScalarPart, AbstractForce):
    """A damper on a coordinate by a table: generalized force `−f(rate)`, with the curve f through given points.

    ```python
    table = {"rates": (-1.0, -0.1, 0.0, 0.1, 1.0), "forces": (-8.0, -3.0, 0.0, 2.0, 5.0)}
    damper = jaxmb.TableDamper("damper", "pin.angle", **table)
    system = jaxmb.Scene([bar], joints=[pin], forces=[damper]).compile()
    ```

    The curve is as in `TableSpring`, with straight lines beyond its ends.

    **Arguments:** `rates` [rad/s, m/s] of the coordinate, shape (n,), ascending, n ≥ 3; `forces` [N m, N], shape (n,),
    of the sign of the rate where the damper dissipates.
    """

    rates: fields.Number = fields.parameter(shape=(None,), unit=("rad/s", "m/s"), converter=fields.as_jax)
    forces: fields.Number = fields.parameter(shape=(None,), unit=("N m", "N"), converter=fields.as_jax)

    def validate(self):
        local_spline.check(self.label, ("rates", "forces"), self.rates, self.forces)

    def numbers_agree(self):
        return jnp.all(jnp.diff(self.rates) > 0)

    def law(self, x, v):
        return -local_spline.value(self.rates, self.forces, v[0])[None]


class TableMotor(AbstractCoordinateForce, AbstractScalarPart, AbstractDynamicForce):
    """A motor by its torque curve: torque over speed at full control, as a table.

    ```python
    curve = {"speeds": (0.0, 100.0, 200.0, 300.0), "torques": (0.8, 0.8, 0.5, 0.0)}
    motor = jaxmb.TableMotor("motor", "pin.angle", control=0.5, gear=20.0, lag=0.02, **curve)
    system = jaxmb.Scene([bar], joints=[pin], forces=[motor]).compile()
    ```

    With the speed `gear ẋ` of the coordinate x, the generalized force is `gear control f(speed)`. A negative control
    drives backwards, with the torque at `f(−speed)`. The curve f is as in `TableSpring`, with straight lines beyond its
    ends: beyond the speed of no torque the motor brakes, the faster the more, as a direct-current motor does. A last
    pair of points with one torque bounds it. `motor.curve(rate=speeds)` is the force without a machine.

    With a `lag` an internal state, the `activation`, takes the place of the control and follows it, `lag ·
    d(activation)/dt = control − activation`.

    **Arguments:** `speeds` [rad/s, m/s], shape (n,), ascending, n ≥ 3; `torques` [N m, N], shape (n,); `control`,
    default zero, clipped to −1 and 1, as an input of `simulate`, `"motor.control"`, a function of time; `gear`; `lag`
    [s] > 0, default none; `activation`, its initial value, default zero.
    """

    speeds: fields.Number = fields.parameter(shape=(None,), unit=("rad/s", "m/s"), converter=fields.as_jax)
    torques: fields.Number = fields.parameter(shape=(None,), unit=("N m", "N"), converter=fields.as_jax)
    control: fields.Number = fields.parameter(unit="1", default=0.0)
    gear: fields.Number = fields.parameter(unit="1", default=1.0)
    lag: fields.Number = fields.parameter(unit="s", sign="positive", optional=True)
    activation: fields.Number = fields.internal_state(unit="1", optional=True)

    def validate(self):
        local_spline.check(self.label, ("speeds", "torques"), self.speeds, self.torques)
        if self.lag is None and self.activation is not None:
            raise ValueError(f"{self.label}: an activation needs a lag.")

    def numbers_agree(self):
        return jnp.all(jnp.diff(self.speeds) > 0)

    def with_numbers(self, given):
        part = super().with_numbers(given)
        return part if self.lag is None else part.filled(activation=0.0)

    def law(self, x, v):
        control, speed = self._control() if self.lag is None else self.activation, self.gear * v[0]
        forwards = jnp.where(control < 0, -speed, speed)
        return (self.gear * control * local_spline.value(self.speeds, self.torques, forwards))[None]

    def _in_itself(self):
        # The activation follows the control, which takes its place.
        return self.with_fields(lag=None, activation=None)

    def state_rates(self, space, poses, velocities, t):
        return {} if self.lag is None else {"activation": (self._control() - self.activation) / self.lag}

    def _control(self):
        return clipped(self.control, -1.0, 1.0)
