"""The internal states of the parts of a scene: their places in z, and their rates.

Kernels of a part read an internal state from the field that declares it. Between evaluations the field is NaN, so a
forgotten state shows.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..parts.fields import entry, internal_states
from ..system.quantities import Measure, entries_along
from .groups import AbstractGroup, Kinematics, groups_by_path, joined


class StateField(NamedTuple):
    """An internal state of stacked parts.

    **Fields:** the `path` of the groups in the system, and the index of the `group`; the field's `name`, and the `keys`
    that lead to it; `members`: names of the parts; the state's `shape` in one part; `start`: the index in z of the
    first part's state.
    """

    path: str
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


class StateTable(NamedTuple):
    """The internal states of all parts of a `system`."""

    system: Any

    @property
    def fields(self) -> tuple[StateField, ...]:
        """The internal states, in the order of z."""
        out, start = [], 0
        for path, groups in groups_by_path(self.system).items():
            for g, group in enumerate(groups):
                part = group.group.part
                for name, keys in internal_states(part).items():
                    shape = entry(part, keys).shape[1:]
                    out.append(StateField(path, g, name, keys, group.group.names, shape, start))
                    start = out[-1].stop
        return tuple(out)

    def group(self, state: StateField) -> AbstractGroup:
        """The group of an internal state."""
        return groups_by_path(self.system)[state.path][state.group]

    def _in_parts(self, fields: tuple[StateField, ...]) -> list[Array]:
        return [entry(self.group(state).group.part, state.keys) for state in fields]

    def initial(self) -> Float[Array, "nz"] | None:
        """Initial values of the parts' internal states; None without internal states.

        **Raises:** `ValueError` naming the states with values that are not finite.
        """
        if not self.fields:
            return None
        z = np.concatenate([np.ravel(values) for values in self._in_parts(self.fields)])
        wrong = [name for name, index in self.names().items() if not np.all(np.isfinite(z[index]))]
        if wrong:
            raise ValueError(f"The initial values of the internal states {', '.join(wrong)} must be finite.")
        return jax.device_put(z)

    def held(self, z: Float[Array, "nz"] | None) -> Any:
        """The system with internal states `z` in its parts; NaN if `z` is None."""
        fields = self.fields
        if not fields:
            return self.system
        before = self._in_parts(fields)
        if z is None:
            values = [jax.device_put(np.full_like(x, np.nan)) for x in before]
        else:
            values = [z[state.start : state.stop].reshape(x.shape) for state, x in zip(fields, before, strict=True)]
        return eqx.tree_at(lambda system: StateTable(system)._in_parts(fields), self.system, values)

    def rates(self, now: Kinematics) -> Float[Array, "nz"]:
        """ż; the parts must hold their internal states."""
        fields = self.fields
        rates = {(s.path, s.group): self.group(s) for s in fields}
        rates = {place: group.state_rates(now) for place, group in rates.items()}
        return joined([rates[state.path, state.group][state.name] for state in fields], now.poses.dtype)

    def scale(self, dtype: Any) -> Float[Array, "nz"]:
        """Typical size of every internal state."""
        out = []
        for state in self.fields:
            sizes = self.group(state).group.map(lambda at: at(0.0).state_sizes()).get(state.name)
            size = jnp.ones(len(state.members), dtype) if sizes is None else jnp.asarray(sizes, dtype)
            out.append(jnp.repeat(size, state.size))
        return joined(out, dtype)

    def names(self) -> dict[str, list[int]]:
        """Indices in z by name, `"motor.torque"`."""
        starts = ((name, first, state.size) for state in self.fields for name, first in state.of_parts().items())
        return {name: list(range(first, first + size)) for name, first, size in starts}

    def measures(self) -> dict[str, Measure]:
        """The internal states as quantities, by name."""
        starts = ((name, first, state.shape) for state in self.fields for name, first in state.of_parts().items())
        return {name: Measure(shape, entries_along, ("z", np.array(first), shape)) for name, first, shape in starts}
