"""Angles that are counted through full turns along a run.

Positions tell an angle up to full turns. A step is too short for its rate to vary by half a turn per step, so rates at
both ends of a step tell the turns of its end. Saved states take the angles with them, to within less than half a turn.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PyTree

from .controller import AbstractControllerAround, states_inside

# The fields of `Turning` that change with accepted steps only.
_COUNTED = ("times", "angles", "rates", "reach")


class Counted(NamedTuple):
    """The saved states of a series, and the counted `angles` [rad] there, shape (times, k)."""

    states: PyTree
    angles: Any


class Turning(eqx.Module):
    """The state of an `AbstractTurningController`.

    **Fields:** `inner`: the state of the controller inside; the `times` of the ends of the last accepted step, with
    the counted `angles` and their `rates` there, shape (2, k), before the first step the given angles; the `reach` of
    the angles so far: at the start, and the least and the largest at the ends of steps.
    """

    inner: Any
    times: Float[Array, "2"]
    angles: Float[Array, "2 k"]
    rates: Float[Array, "2 k"]
    reach: Float[Array, "3 k"]

    def at(self, t: Any) -> Float[Array, "k"]:
        """The angles at a time in the last step, by the cubic polynomial through both ends."""
        (start, end), (before, after), (leaving, arriving) = self.times, self.angles, self.rates
        length = end - start
        x = jnp.where(length > 0, (t - start) / jnp.where(length > 0, length, 1.0), 1.0)
        leaving, arriving = length * leaving, length * arriving
        bend = (1.0 - x) * (leaving - (after - before)) + x * ((after - before) - arriving)
        return before + x * (after - before) + x * (1.0 - x) * bend


class AbstractTurningController(diffrax.AbstractStepSizeController):
    """Counts the full turns of angles along the accepted steps of the `controller` inside.

    **Fields:** `angles(t, y)`: angles up to full turns, and their rates, in the user's time; `given`: counted angles at
    the start, to within half a turn; the `direction` of the user's time.
    """

    controller: Any
    angles: Callable[[Any, PyTree], tuple[Array, Array]]
    given: Float[Array, "k"]
    direction: Any = 1.0

    def wrap(self, direction):
        inner = self.controller.wrap(direction)
        return eqx.tree_at(lambda c: (c.controller, c.direction), self, (inner, direction))

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        end, inner = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        twice = lambda x: jnp.stack([x, x])
        reach = jnp.stack([self.given, jnp.full_like(self.given, jnp.inf), jnp.full_like(self.given, -jnp.inf)])
        return end, Turning(inner, twice(t0), twice(self.given), twice(jnp.zeros_like(self.given)), reach)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        last: Turning = controller_state
        out = self.controller.adapt_step_size(t0, t1, y0, y1_candidate, args, y_error, error_order, last.inner)
        keep, start, end, made_jump, inner, result = out
        # Both ends together are one copy of the angles in the program.
        times = jnp.stack([t0, t1])
        angles, rates = jax.vmap(self._seen)(times, jax.tree.map(lambda *ends: jnp.stack(ends), y0, y1_candidate))
        before = nearest_turn(angles[0], last.angles[1])
        after = nearest_turn(angles[1], before + (t1 - t0) * (rates[0] + rates[1]) / 2)
        least, largest = jnp.minimum(before, after), jnp.maximum(before, after)
        at_start = jnp.where(last.reach[1] > last.reach[2], before, last.reach[0])
        reach = jnp.stack([at_start, jnp.minimum(last.reach[1], least), jnp.maximum(last.reach[2], largest)])
        new = Turning(inner, times, jnp.stack([before, after]), rates, reach)
        kept = lambda new, old: jnp.where(keep, new, old)
        new = Turning(inner, *(kept(getattr(new, x), getattr(last, x)) for x in _COUNTED))
        return keep, start, end, made_jump, new, result

    def _seen(self, t, y):
        direction = jnp.asarray(self.direction, t.dtype)
        angles, rates = lax.stop_gradient(self.angles(t * direction, y))
        return angles, rates * direction


class TurningController(AbstractTurningController, AbstractControllerAround):
    """Around a controller with tolerances."""


class FixedTurningController(AbstractTurningController):
    """Around a controller without tolerances, such as `diffrax.ConstantStepSize`."""


def with_turning(controller: Any, angles: Callable[[Any, PyTree], tuple[Array, Array]], given: Any) -> Any:
    """A controller that counts turns around another one; see `AbstractTurningController`."""
    if isinstance(controller, diffrax.AbstractAdaptiveStepSizeController):
        # Its tolerances are properties.
        return TurningController(controller, angles, given)  # pyright: ignore[reportCallIssue]
    return FixedTurningController(controller, angles, given)


def nearest_turn(angles: Float[Array, "*k"], near: Float[Array, "*k"]) -> Float[Array, "*k"]:
    """The angles [rad] plus the full turns that bring them nearest to others; unchanged beside numbers that are not
    finite.
    """
    turns = lax.stop_gradient(jnp.round((near - angles) / (2 * np.pi)))
    return angles + 2 * np.pi * jnp.where(jnp.isfinite(turns), turns, 0.0)


def turning_of(controller_state: Any) -> Turning | None:
    """The counted angles of the last accepted step, from the state of a controller; None if they are not counted."""
    states = states_inside(controller_state, Turning)
    return states[0] if states else None


def without_turning(controller: Any) -> Any:
    """The controller inside, which alone decides on steps."""
    return controller.controller if isinstance(controller, AbstractTurningController) else controller
