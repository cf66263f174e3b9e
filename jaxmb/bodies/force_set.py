"""The forces of a scene: gravity and stacked force elements, with their internal states.

Kernels of a part read an internal state from the field that declares it. Between evaluations the field is NaN, so a
forgotten state shows.
"""

from typing import Any, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar
from ..parts.fields import entry, internal_states
from ..parts.forces import Gravity
from ..system.quantities import Measure, entries_along
from .groups import Acting, BodyPoses, ForceGroup, Kinematics, joined


class StateField(NamedTuple):
    """An internal state of stacked parts.

    **Fields:** `group`: the index of the group; the field's `name`, and the `keys` that lead to it; `members`: names of
    the parts; the state's `shape` in one part; `start`: the index in z of the first part's state.
    """

    group: int
    name: str
    keys: tuple[str, ...]
    members: tuple[str, ...]
    shape: tuple[int, ...]
    start: int

    @property
    def size(self) -> int:
        """The number of entries of one part."""
        return int(np.prod(self.shape))

    @property
    def stop(self) -> int:
        return self.start + len(self.members) * self.size

    def of_parts(self) -> dict[str, int]:
        """The first index in z of each part's state, by name, `"motor.torque"`."""
        return {f"{part}.{self.name}": self.start + k * self.size for k, part in enumerate(self.members)}


class ForceSet(eqx.Module):
    """Gravity and groups of force elements.

    **Fields:** `groups`; the acceleration of `gravity` [m/s²], or None; its name.
    """

    groups: tuple[ForceGroup, ...]
    gravity: Float[Array, "d"] | None
    gravity_name: str = eqx.field(static=True)

    @property
    def gravity_part(self) -> tuple[Gravity, ...]:
        """Gravity as a part; empty without gravity."""
        return () if self.gravity is None else (Gravity(self.gravity, name=self.gravity_name),)

    @property
    def with_gaps(self) -> tuple[ForceGroup, ...]:
        """The groups of forces that act only at closed gaps."""
        return tuple(g for g in self.groups if g.group.part.has_gaps)

    def wrenches(self, now: Kinematics) -> list[Acting]:
        """Wrenches of the force elements."""
        return [(g.wrenches(now), g.group.body_index) for g in self.groups]

    def energy(self, t: Scalar, poses: BodyPoses) -> Float[Array, ""]:
        """Potential energy [J] of conservative force elements."""
        return sum((g.energy(t, poses) for g in self.groups), start=jnp.zeros((), poses.dtype))

    def energy_in_motion(self, now: Kinematics) -> Float[Array, ""]:
        """The energy [J] that conservative force elements store, which may depend on velocities."""
        return sum((g.energy_in_motion(now) for g in self.groups), start=jnp.zeros((), now.poses.dtype))

    # Internal states

    @property
    def states(self) -> tuple[StateField, ...]:
        """The internal states, in the order of z."""
        out, start = [], 0
        for g, force in enumerate(self.groups):
            for name, keys in internal_states(force.group.part).items():
                shape = entry(force.group.part, keys).shape[1:]
                out.append(StateField(g, name, keys, force.group.names, shape, start))
                start = out[-1].stop
        return tuple(out)

    def _in_parts(self, states) -> list[Array]:
        return [entry(self.groups[state.group].group.part, state.keys) for state in states]

    def initial_states(self) -> Float[Array, "nz"] | None:
        """Initial values of the parts' internal states; None without internal states.

        **Raises:** `ValueError` naming the states with values that are not finite.
        """
        if not self.states:
            return None
        z = np.concatenate([np.ravel(values) for values in self._in_parts(self.states)])
        wrong = [name for name, index in self.state_names().items() if not np.all(np.isfinite(z[index]))]
        if wrong:
            raise ValueError(f"The initial values of the internal states {', '.join(wrong)} must be finite.")
        return jax.device_put(z)

    def with_states(self, z: Float[Array, "nz"] | None) -> Self:
        """The same set with internal states `z` in its parts; NaN if `z` is None."""
        states = self.states
        if not states:
            return self
        before = self._in_parts(states)
        if z is None:
            values = [jax.device_put(np.full_like(x, np.nan)) for x in before]
        else:
            values = [z[state.start : state.stop].reshape(x.shape) for state, x in zip(states, before, strict=True)]
        return eqx.tree_at(lambda forces: forces._in_parts(states), self, values)

    def state_rates(self, now: Kinematics) -> Float[Array, "nz"]:
        """ż; the parts must hold their internal states."""
        rates = {g: self.groups[g].state_rates(now) for g in dict.fromkeys(state.group for state in self.states)}
        return joined([rates[state.group][state.name] for state in self.states], now.poses.dtype)

    def state_scale(self, dtype: Any) -> Float[Array, "nz"]:
        """Typical size of every internal state."""
        out = []
        for state in self.states:
            sizes = self.groups[state.group].group.map(lambda at: at(0.0).state_sizes()).get(state.name)
            size = jnp.ones(len(state.members), dtype) if sizes is None else jnp.asarray(sizes, dtype)
            out.append(jnp.repeat(size, state.size))
        return joined(out, dtype)

    def state_names(self) -> dict[str, list[int]]:
        """Indices in z by name, `"motor.torque"`."""
        starts = ((name, first, state.size) for state in self.states for name, first in state.of_parts().items())
        return {name: list(range(first, first + size)) for name, first, size in starts}

    def state_measures(self) -> dict[str, Measure]:
        """The internal states as quantities, by name."""
        starts = ((name, first, state.shape) for state in self.states for name, first in state.of_parts().items())
        return {name: Measure(shape, entries_along, ("z", np.array(first), shape)) for name, first, shape in starts}
