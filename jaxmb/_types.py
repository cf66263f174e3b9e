"""Names of types that many files share."""

from collections.abc import Sequence
from typing import Any, TypeAlias

import equinox as eqx
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

Scalar: TypeAlias = ArrayLike
VectorLike: TypeAlias = ArrayLike | Sequence[Any]
# The coordinates q and the velocities u of a system, with one axis.
Coordinates: TypeAlias = Float[Array, "nq"]
Velocities: TypeAlias = Float[Array, "nu"]

# States of at most this many numbers are printed with them.
_FEW = 60


class State(eqx.Module):
    """Configuration and velocity of a system, and the internal states of its parts.

    ```python
    state = jaxmb.assemble(system, fix={"bar.angle": 0.5})
    state.q, state.u  # (x, y, angle) of the bar, and their rates.
    released = jaxmb.State(q=state.q, u=jnp.zeros(3))
    ```

    **Fields:**

    - `q`: coordinates, shape `(nq,)`, listed by `system.coordinate_names()`. A planar scene has (x, y, angle)
        [m, m, rad] of each body, a spatial scene (position [m], Euler parameters). Modes of contacts and friction
        follow.
    - `u`: velocities, shape `(nu,)`. A planar scene has the rates of q, a spatial scene (velocity [m/s] in the world
        frame, angular velocity [rad/s] in the body frame).
    - `z`: internal states of first order, shape `(nz,)`, such as the torque of a motor with lag; None if no part has
        any.
    - `angles` [rad], shape `(k,)`: of joints in space, in the order of `system.wrapped_angle_names()`. Only their full
        turns have a meaning, which q does not tell; None if no angle is beyond half a turn. A motion counts them.
    """

    q: Float[Array, "... nq"]
    u: Float[Array, "... nu"]
    z: Float[Array, "... nz"] | None = None
    angles: Float[Array, "... k"] | None = None

    def __repr__(self) -> str:
        parts = {"q": self.q, "u": self.u, "z": self.z, "angles": self.angles}
        return f"State({', '.join(f'{name}={_shown(x)}' for name, x in parts.items() if x is not None)})"


def _shown(x: Any) -> str:
    """The numbers of an array if they are concrete and few, else its shape and type."""
    concrete = isinstance(x, Array | np.ndarray) and not isinstance(x, Tracer)
    return (
        np.array2string(np.asarray(x), precision=6, separator=", ")
        if concrete and x.size <= _FEW
        else eqx.tree_pformat(x)
    )
