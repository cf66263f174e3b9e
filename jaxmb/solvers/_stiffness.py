"""Whether stability, instead of accuracy, limits the steps of Adams' method.

A step is counted as stiff when two things come together. The Jacobian, as the corrector shows it, is so large that the
step is near the bound of stability; and along the solution the vector field changes much less than that, in proportion
to the state, or the state by less than the corrector does: errors of stability, not the motion, keep the step short.
Measured on steps of motions that are not stiff it is so in less than one of ten, where stability limits the steps in
four of ten to all (the library's mechanisms; van der Pol, Robertson, HIRES; tolerances 1e-4 to 1e-9).

Source of the first: E. Hairer, S. P. Nørsett and G. Wanner, Solving Ordinary Differential Equations I, Springer, 1993,
for Runge-Kutta methods (DOPRI5's test).
"""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from ._history import HIGHEST_ORDER
from .stability import adams, spectral_radius

# Parts of the bound of stability, and of the changes along the solution, from where on a step is stiff.
_NEAR, _FASTER, _SMALLER = 0.3, 10.0, 3.0
# What a stiff step adds, and another takes away, and the sum from where on the motion is.
_UP, _DOWN, _STIFF = 3, 1, 150


class Stiffness(eqx.Module):
    """**Fields:** `steps`: stiff steps so far; `level`: of the evidence, which fades with steps that are not."""

    steps: Int[Array, ""]
    level: Int[Array, ""]

    @property
    def found(self) -> Bool[Array, ""]:
        return self.level >= _STIFF


def none_found() -> Stiffness:
    zero = jnp.zeros((), jnp.int32)
    return Stiffness(zero, zero)


def observed(
    before: Stiffness,
    order: Int[Array, ""],
    h: Float[Array, ""],
    correction: tuple[Float[Array, ""], Float[Array, ""]],
    change: tuple[Float[Array, ""], Float[Array, ""]],
) -> Stiffness:
    """What one more step shows, from the sizes of what the corrector changes, in y and in f, and of what the step does.

    Sizes that are zero, or not finite, show nothing.
    """
    # |df| / |dy| of the corrector, against the same along the solution, without division.
    near = h * correction[1] > _NEAR * jnp.asarray(_bounds(), h.dtype)[order] * correction[0]
    faster = correction[1] * change[0] > _FASTER * change[1] * correction[0]
    smaller = change[0] < _SMALLER * correction[0]
    stiff = (near & (faster | smaller)).astype(jnp.int32)
    # Once found it stays.
    level = jnp.where(stiff > 0, before.level + _UP, before.level - _DOWN)
    level = jnp.where(before.found, before.level, jnp.maximum(level, 0))
    return Stiffness(before.steps + stiff, level.astype(jnp.int32))


@functools.cache
def _bounds() -> NDArray[np.float64]:
    """For each order the negative `h λ` up to which predictor and corrector are stable."""
    out = [0.0]
    sizes = np.geomspace(0.01, 4.0, 400)
    for order in range(1, HIGHEST_ORDER + 1):
        unstable = spectral_radius(adams(order), -sizes) > 1 + 1e-6
        out.append(float(sizes[np.argmax(unstable)]))
    return np.array(out)
