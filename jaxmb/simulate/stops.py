"""Times at which the steps of a run end, and times at which it restarts."""

from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._arguments import real_array
from .._types import State
from ..linalg.arrays import is_traced
from ..linalg.recent import Recent
from ..solvers.directed import next_number
from ..solvers.events import EventController
from ..system import AbstractSystem
from ..system.inputs import input_break_times, turning_times
from .method import adapts

# The turns and the jumps of inputs of the last few runs: a loop of simulations searches for them once.
_turns, _breaks = Recent(8), Recent(8)


class Stops(NamedTuple):
    """Where a run, or its steps, must stop.

    **Fields:** times of `restarts`, or None; times of `turns`, which no step passes, or None; the user's `event`, or
    None; `max_events` of contacts.
    """

    restarts: Any
    turns: Any
    event: diffrax.Event | None
    max_events: int

    def around(self, controller: Any, contacts: bool) -> Any:
        """A controller that steps to these times and restarts there, and at events of `contacts`."""
        controller = EventController(controller, self.max_events, self.restarts) if contacts else controller
        if self.restarts is None and self.turns is None:
            return controller
        return diffrax.ClipStepSizeController(controller, step_ts=self.turns, jump_ts=self.restarts)

    def moving(self, times: Float[Array, "events"]) -> Float[Array, "events"]:
        """Times of events, of which those at jumps have the derivatives of the jumps."""
        if self.restarts is None:
            return times
        jumps = jnp.asarray(self.restarts)
        fixed = lax.stop_gradient(jumps)
        at = times[:, None] == next_number(fixed, 1)[None, :]
        moves = jnp.where(at, (jumps - fixed)[None, :], 0.0)
        return times + jnp.sum(moves, axis=1)


def turns_of(system: AbstractSystem, state: State, t0: Any, t1: Any, controller: Any) -> Any:
    """Times that no step of a run may pass, or None."""
    # Steps of a user's controller of jumps must not be cut at times unknown to it.
    if not adapts(controller) or isinstance(controller, diffrax.ClipStepSizeController):
        return None
    return _turns.found((system, state, t0, t1), lambda: turning_times(system, state, t0, t1))


def breaks_of(system: AbstractSystem, t0: Any, t1: Any) -> np.ndarray:
    """Times [s] at which inputs of a run jump, or their rates where these count; see `input_break_times`."""
    return _breaks.found((system, t0, t1), lambda: input_break_times(system, t0, t1))


def checked_jumps(jumps: Any, of_inputs: np.ndarray) -> Any:
    """Times at which to restart: the announced jumps and the jumps of inputs; None if there are none."""
    if jumps is None:
        return jnp.asarray(of_inputs) if of_inputs.size else None
    times = real_array("jumps", jumps, jnp.result_type(float), None)
    if times.ndim != 1 or times.shape[0] == 0 or not (is_traced(times) or np.all(np.isfinite(times))):
        raise ValueError(f"jumps must be a vector of finite times, got {jumps!r}; leave it out if there are none.")
    return jnp.sort(jnp.concatenate([jnp.asarray(times), jnp.asarray(of_inputs, times.dtype)]))
