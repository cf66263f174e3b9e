"""Names of types that many files share."""

from collections.abc import Sequence
from typing import Any, TypeAlias

import equinox as eqx
from jaxtyping import Array, ArrayLike, Float

Scalar: TypeAlias = ArrayLike
VectorLike: TypeAlias = ArrayLike | Sequence[Any]


class State(eqx.Module):
    """Configuration and velocity of a system.

    **Fields:** `q`: coordinates, shape `(nq,)`; `u`: velocities, shape `(nu,)`. What they hold is the system's
    affair: for a planar scene (x, y, angle) [m, m, rad] a body and their rates, for a spatial one (position [m],
    Euler parameters) and (velocity [m/s] in the world frame, angular velocity [rad/s] in the body frame).
    """

    q: Float[Array, "... nq"]
    u: Float[Array, "... nu"]
