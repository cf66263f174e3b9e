"""A block on a spring and a damper, on a belt, with Coulomb's friction: events by hand."""

from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

# A force at its limit, up to this fraction, slips where it grows.
_AT_LIMIT = 1e-9


class Belt(NamedTuple):
    """**Fields:** `mass` [kg], `stiffness` [N/m], `damping` [N s/m]; the `speed` [m/s] of the belt; coefficients of
    `slip` and `stick`, and the `weight` [N]; a `push` [N] that grows at a `rate` [N/s]; friction that falls by up to
    `fall` [N] with the velocity of slip, over a `width` [m/s].
    """

    mass: float
    stiffness: float
    damping: float
    speed: float
    slip: float
    stick: float
    weight: float
    push: float
    rate: float
    fall: float
    width: float

    def other_force(self, t, x, v):
        """The force [N] along the belt without friction."""
        return self.push + self.rate * t - self.stiffness * x - self.damping * v

    def friction(self, slip):
        """The friction [N] at a velocity of slip [m/s], in its direction, as a size."""
        return self.slip * self.weight - self.fall * (1 - np.exp(-slip / self.width))


def moved(belt: Belt, x: float, v: float, end: float):
    """Displacement and velocity at the time `end`, and the events: `(time, mode)`, of a block that starts at zero."""
    t, events = 0.0, []
    mode = np.sign(v - belt.speed)
    if mode == 0:
        mode = _begins(belt, t, x)
    while t < end:
        if mode == 0:
            # The other force is linear in time.
            force, growth = belt.other_force(t, x, belt.speed), belt.rate - belt.stiffness * belt.speed
            limit = np.sign(growth) * belt.stick * belt.weight
            until = min(end - t, (limit - force) / growth) if growth != 0 else end - t
            t, x, v = t + until, x + belt.speed * until, belt.speed
            mode = np.sign(growth)
        else:
            field = lambda t, y, mode=mode: (
                y[1],
                (belt.other_force(t, *y) - mode * belt.friction(abs(y[1] - belt.speed))) / belt.mass,
            )
            stops = lambda t, y, mode=mode: mode * (y[1] - belt.speed)
            stops.terminal, stops.direction = True, -1
            run = solve_ivp(field, (t, end), (x, v), "DOP853", events=stops, rtol=1e-12, atol=1e-13, max_step=0.05)
            t, (x, v) = run.t[-1], run.y[:, -1]
            mode = _begins(belt, t, x)
        if t < end:
            events.append((t, mode))
    return x, v, events


def _begins(belt, t, x):
    """The direction of slip that begins from rest, zero where the block sticks."""
    force, limit = belt.other_force(t, x, belt.speed), belt.stick * belt.weight
    if abs(abs(force) - limit) <= _AT_LIMIT * limit:
        # The force grows beyond the limit, or falls.
        grows = np.sign(force) * (belt.rate - belt.stiffness * belt.speed) > 0
        return np.sign(force) if grows else 0.0
    return np.sign(force) if abs(force) > limit else 0.0
