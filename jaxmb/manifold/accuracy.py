"""The tolerances of a motion on its constraints."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Scalar
from ..contacts.tolerance import ContactTolerance
from ..linalg.arrays import as_array, namespace

# The part of the tolerance of integration for corrections that a step omits, and for gaps that count as zero.
_SHARE = 1e-3
# Bounds of this part: the least in units of the machine precision.
_LEAST, _MOST = 64, 1e-6


class Accuracy(eqx.Module):
    """The tolerances of a motion on its constraints, all relative to the system's size.

    **Fields:** `rtol`: the tolerance of integration; `newton`: the size of the last Newton correction of positions,
    which is omitted; `touch`: gaps of contacts down to `-touch` count as zero.
    """

    rtol: Float[Array, ""]
    newton: Float[Array, ""]
    touch: Float[Array, ""]

    @classmethod
    def of(cls, rtol: Scalar, newton_tol: float | None, most: float = _MOST) -> "Accuracy":
        """The tolerances by that of integration.

        **Arguments:** `newton_tol`: in place of a thousandth of `rtol`, of which Newton's corrections are at most
        `most`.
        """
        dtype = jnp.result_type(float)
        xp, least = namespace(rtol), _LEAST * float(jnp.finfo(dtype).eps)
        touch = xp.clip(_SHARE * rtol, least, _MOST)
        if newton_tol is None:
            return cls(as_array(rtol, dtype), xp.minimum(touch, most), touch)
        return cls(as_array(rtol, dtype), as_array(newton_tol, dtype), xp.maximum(touch, newton_tol))

    @property
    def at_contacts(self) -> ContactTolerance:
        """The sizes that count as zero at contacts."""
        return ContactTolerance(self.touch)
