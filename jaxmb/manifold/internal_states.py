"""The blocks of a raveled state, the components that count, and their natural sizes."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..solvers.scales import Block
from ..system import AbstractSystem


def state_blocks(system: AbstractSystem, rate: Any) -> tuple[Block, ...]:
    """The blocks of a raveled state.

    **Arguments:** `rate`: the expected size of velocities at rest, in their natural units [1/s].
    """
    kinds = np.diff([0, *system.state_ends])
    return (
        Block("coordinates", system.nq, 1.0),
        Block("velocities", system.nu, rate, rate_of="coordinates"),
        *(Block(f"states {k}", int(size)) for k, size in enumerate(kinds)),
    )


def counted_components(system: AbstractSystem) -> tuple[int, ...] | None:
    """The indices of the components of a raveled state whose sizes and errors count, None for all. The modes of
    contacts and dry friction have no sizes or errors.
    """
    if not system.contacts:
        return None
    modes = np.isin(np.arange(system.nq), system.contacts.places)
    along = system.held_velocities(modes)
    assert along is not None, "a mode is not part of a rotation"
    uncounted = np.concatenate([modes, along, np.zeros(system.nz, bool)])
    return tuple(np.flatnonzero(~uncounted).tolist())


def natural_units(system: AbstractSystem, velocities: Float[Array, " nu"], dtype: Any) -> Float[Array, " n"]:
    """The natural sizes of the components of a raveled state, with the given sizes of velocities."""
    units = [system.coordinate_scale(), velocities, *([system.state_scale()] if system.nz else [])]
    return jnp.concatenate(units).astype(dtype)
