"""Angles that are counted through full turns along a run.

Positions tell an angle up to full turns. A step is too short for its rate to vary by half a turn per step, so rates at
both ends of a step tell the turns of its end. Saved states take the angles with them, to within less than half a turn.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PyTree


class Counted(NamedTuple):
    """The saved states of a series, and the counted `angles` [rad] there, shape (times, k)."""

    states: PyTree
    angles: Any


class Turning(eqx.Module):
    """The full turns of angles, counted along accepted steps.

    **Fields:** the `times` of the ends of the last accepted step, with the counted `angles` and their `rates` there,
    shape (2, k), before the first step the given angles; the `reach` of the angles so far: at the start, and the least
    and the largest at the ends of steps.
    """

    times: Float[Array, "2"]
    angles: Float[Array, "2 k"]
    rates: Float[Array, "2 k"]
    reach: Float[Array, "3 k"]

    @classmethod
    def of(cls, t0: Any, given: Float[Array, "k"]) -> "Turning":
        """The start of a count from `given` angles, to within half a turn."""
        twice = lambda x: jnp.stack([x, x])
        reach = jnp.stack([given, jnp.full_like(given, jnp.inf), jnp.full_like(given, -jnp.inf)])
        return cls(twice(t0), twice(given), twice(jnp.zeros_like(given)), reach)

    def at(self, t: Any) -> Float[Array, "k"]:
        """The angles at a time in the last step, by the cubic polynomial through both ends."""
        (start, end), (before, after), (leaving, arriving) = self.times, self.angles, self.rates
        length = end - start
        x = jnp.where(length > 0, (t - start) / jnp.where(length > 0, length, 1.0), 1.0)
        leaving, arriving = length * leaving, length * arriving
        bend = (1.0 - x) * (leaving - (after - before)) + x * ((after - before) - arriving)
        return before + x * (after - before) + x * (1.0 - x) * bend

    def after(
        self,
        seen: Callable[[Any, PyTree], tuple[Array, Array]],
        direction: Any,
        times: tuple[Any, Any],
        ends: tuple[PyTree, PyTree],
        keep: Any,
    ) -> "Turning":
        """The count after a step, if it is kept.

        **Arguments:** `seen(t, y)`: angles up to full turns, and their rates, in the user's time; `times` and states at
        the `ends` of the step, in the solver's time, which has this `direction` in the user's.
        """
        # Both ends together are one copy of the angles in the program.
        between = jnp.stack(times)
        along = jnp.asarray(direction, between.dtype)
        of_user = lambda t, y: lax.stop_gradient(seen(t * along, y))
        angles, rates = jax.vmap(of_user)(between, jax.tree.map(lambda *x: jnp.stack(x), *ends))
        rates = rates * along
        before = nearest_turn(angles[0], self.angles[1])
        after = nearest_turn(angles[1], before + (between[1] - between[0]) * (rates[0] + rates[1]) / 2)
        least, largest = jnp.minimum(before, after), jnp.maximum(before, after)
        at_start = jnp.where(self.reach[1] > self.reach[2], before, self.reach[0])
        reach = jnp.stack([at_start, jnp.minimum(self.reach[1], least), jnp.maximum(self.reach[2], largest)])
        new = Turning(between, jnp.stack([before, after]), rates, reach)
        return jax.tree.map(lambda new, old: jnp.where(keep, new, old), new, self)


def nearest_turn(angles: Float[Array, "*k"], near: Float[Array, "*k"]) -> Float[Array, "*k"]:
    """The angles [rad] plus the full turns that bring them nearest to others; unchanged beside numbers that are not
    finite.
    """
    turns = lax.stop_gradient(jnp.round((near - angles) / (2 * np.pi)))
    return angles + 2 * np.pi * jnp.where(jnp.isfinite(turns), turns, 0.0)
