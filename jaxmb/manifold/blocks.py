"""Blocks of a mechanical state that are measured together: coordinates, velocities, and each kind of internal state."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..solvers import Block
from ..system import AbstractSystem


def state_blocks(system: AbstractSystem, rate: Any) -> tuple[Block, ...]:
    """The blocks of a raveled state.

    **Arguments:** `rate`: that of velocities where nothing is known of them, in their natural units [1/s].
    """
    kinds = np.diff([0, *system.state_ends])
    return (
        Block("coordinates", system.nq, 1.0),
        Block("velocities", system.nu, rate, rate_of="coordinates"),
        *(Block(f"states {k}", int(size)) for k, size in enumerate(kinds)),
    )


def natural_units(system: AbstractSystem, velocities: Float[Array, " nu"], dtype: Any) -> Float[Array, " n"]:
    """The natural sizes of the components of a raveled state, with given ones of velocities."""
    units = [system.coordinate_scale(), velocities, *([system.state_scale()] if system.nz else [])]
    return jnp.concatenate(units).astype(dtype)
