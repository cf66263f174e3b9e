"""Poses at which the direction that a part needs vanishes, such as of a disc that lies flat."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from .._types import Coordinates, Scalar
from ..linalg.jitted import on_host
from ..system import AbstractSystem

# Headings below this vanish, as a power of eps: 1e-6 in double precision.
_ZERO = 3 / 8
# A motion that ends where a heading is shorter than this ends because of it.
_SHORT = 1e-3


def are_short(system: AbstractSystem, t: Scalar, q: Coordinates) -> Bool[Array, "headings"]:
    """Which headings are so short at the end of a motion that it ended because of them."""
    return jnp.sum(system.headings(t, q) ** 2, axis=1) < _SHORT**2


def about_headings(system: AbstractSystem, are_lost: Any) -> str:
    """What is told of the parts whose headings are lost; empty without any."""
    return " and ".join(
        text for text, lost in zip(system.catalogue.lost_headings, np.asarray(are_lost), strict=True) if lost
    )


@on_host
def _found(system, t, q):
    return system.headings(t, q)


def check_headings(system: AbstractSystem, t: Scalar, q: Coordinates, pose: str) -> None:
    """Raise a `ValueError` naming the parts whose headings vanish at a configuration, which messages call `pose`."""
    if not system.catalogue.lost_headings:
        return
    headings = _found(system, np.asarray(t, q.dtype), q)
    lost = np.linalg.norm(headings, axis=1) <= float(np.finfo(headings.dtype).eps) ** _ZERO
    if np.any(lost):
        raise ValueError(f"At {pose} {about_headings(system, lost)}. Tilt the body, or give another axis or plane.")
