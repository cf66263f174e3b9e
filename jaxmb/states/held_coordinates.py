"""Prescribed coordinates by name: entries of q and u, and the own coordinates of joints."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar, VectorLike
from ..linalg.arrays import is_traced
from ..parts.names import unknown
from ..system import AbstractSystem
from ..system.arguments import real_array
from ..system.coordinates import prescribe
from ..system.joint_graph import joint_order_with_more
from .closest import eliminates_by_blocks


def split_names(
    what: str, system: AbstractSystem, own: Mapping[str, Any], values: Mapping[str, VectorLike] | None
) -> tuple[dict[str, VectorLike], dict[str, Any]]:
    """Prescribed values of the system's own coordinates or rates, and of coordinates of joints, which become arrays.

    **Raises:** `ValueError` for names of neither kind and for values of the wrong shape.
    """
    if values is None or not isinstance(values, Mapping) or all(name in own for name in values):
        return ({} if values is None else values), {}  # pyright: ignore[reportReturnType]
    known, dtype = system.joint_coordinates(), jnp.result_type(float)
    of_joints = {}
    for name, value in values.items():
        if name not in own:
            if name not in known:
                raise unknown(what, name, (*own, *known, *system.state_names()))
            of_joints[name] = jnp.asarray(
                real_array(f"{what.capitalize()} {name!r}", value, dtype, (known[name].shape,))
            )
    return {name: value for name, value in values.items() if name in own}, of_joints


def internal_states(
    system: AbstractSystem, z: Float[Array, "nz"] | None, values: Mapping[str, VectorLike] | None
) -> tuple[Float[Array, "nz"] | None, Mapping[str, VectorLike] | None]:
    """Internal states with some of them prescribed by name, and the prescribed values of all else.

    **Raises:** `ValueError` for values of the wrong shape and for those that are not finite.
    """
    names = system.state_names()
    if z is None or not isinstance(values, Mapping):
        return z, values
    own = {name: value for name, value in values.items() if name in names}
    z, _ = prescribe("internal state", names, own, z)
    if not is_traced(z) and not np.all(np.isfinite(z)):
        raise ValueError(f"The guess or the fixed internal states are not finite: {np.asarray(z)}.")
    return z, {name: value for name, value in values.items() if name not in own}


def holding(system: Any, values: Mapping[str, Any], rates: Mapping[str, Any], t: Scalar) -> AbstractSystem:
    """The system with coordinates of joints held at values from t on, which change at rates, zero by default."""
    if not values:
        return system
    rates = {name: rates.get(name, jnp.zeros_like(value)) for name, value in values.items()}
    held: Any = system.holding(values, rates, t)
    if not eliminates_by_blocks(system):
        return held
    return dataclasses.replace(held, elimination=joint_order_with_more(held, system, system.elimination))
