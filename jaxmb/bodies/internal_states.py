"""Internal states of parts: where they stand in `State.z`, and the parts with their current values.

The kernels of a part find the current value of a state in the field that declares it. Between evaluations the field
holds no number, so that a state that was forgotten shows.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar
from ..parts.fields import entry, internal_states
from ..system.quantities import Measure, entries_along
from .groups import BodyPoses, BodyVelocities, ForceGroup


class StateField(NamedTuple):
    """An internal state of stacked parts: field `name`, which `keys` lead to in group number `group`; `shape` of one
    part, and the `start` of all of them in z.
    """

    group: int
    name: str
    keys: tuple[str, ...]
    members: tuple[str, ...]
    shape: tuple[int, ...]
    start: int

    @property
    def size(self) -> int:
        """Of one part."""
        return int(np.prod(self.shape))

    @property
    def stop(self) -> int:
        return self.start + len(self.members) * self.size


def state_fields(forces: Sequence[ForceGroup]) -> tuple[StateField, ...]:
    """The internal states of groups of forces, in the order of z."""
    out, start = [], 0
    for g, force in enumerate(forces):
        for name, keys in internal_states(force.group.part).items():
            shape = entry(force.group.part, keys).shape[1:]
            out.append(StateField(g, name, keys, force.group.names, shape, start))
            start = out[-1].stop
    return tuple(out)


def initial_states(forces: Sequence[ForceGroup], fields: Sequence[StateField]) -> Float[np.ndarray, "nz"]:
    """The values that the parts were given.

    **Raises:** `ValueError` naming those that are not finite.
    """
    z = np.concatenate([np.ravel(entry(forces[own.group].group.part, own.keys)) for own in fields])
    wrong = [name for name, index in state_names(fields).items() if not np.all(np.isfinite(z[index]))]
    if wrong:
        raise ValueError(f"The initial values of the internal states {', '.join(wrong)} must be finite.")
    return z


def with_states(
    forces: tuple[ForceGroup, ...], fields: Sequence[StateField], z: Float[Array, "nz"] | None
) -> tuple[ForceGroup, ...]:
    """Groups of forces whose parts have these internal states; not numbers where `z` is None."""

    def place(own, before):
        if z is None:
            return np.full_like(before, np.nan)
        return z[own.start : own.stop].reshape(before.shape)

    where = lambda forces: [entry(forces[own.group].group.part, own.keys) for own in fields]
    return eqx.tree_at(where, forces, [place(own, before) for own, before in zip(fields, where(forces), strict=True)])


def state_rates(
    forces: Sequence[ForceGroup], fields: Sequence[StateField], t: Scalar, poses: BodyPoses, velocities: BodyVelocities
) -> Float[Array, "nz"]:
    """ż of parts that have their internal states."""
    rates = {g: forces[g].state_rates(t, poses, velocities) for g in dict.fromkeys(own.group for own in fields)}
    return jnp.concatenate([rates[own.group][own.name].reshape(-1) for own in fields])


def state_names(fields: Sequence[StateField]) -> dict[str, list[int]]:
    """Indices in z by name, `"motor.torque"`."""
    return {
        f"{part}.{own.name}": list(range(own.start + k * own.size, own.start + (k + 1) * own.size))
        for own in fields
        for k, part in enumerate(own.members)
    }


def state_scale(forces: Sequence[ForceGroup], fields: Sequence[StateField], dtype: Any) -> Float[Array, "nz"]:
    """The typical size of every internal state."""
    out = []
    for own in fields:
        sizes = forces[own.group].group.map(lambda at: at(0.0).state_sizes()).get(own.name)
        size = jnp.ones(len(own.members), dtype) if sizes is None else jnp.asarray(sizes, dtype)
        out.append(jnp.repeat(size, own.size))
    return jnp.concatenate(out) if out else jnp.zeros(0, dtype)


def state_measures(fields: Sequence[StateField]) -> dict[str, Measure]:
    """The internal states as quantities, by name."""
    return {
        f"{part}.{own.name}": Measure(own.shape, entries_along, ("z", np.array(own.start + k * own.size), own.shape))
        for own in fields
        for k, part in enumerate(own.members)
    }
