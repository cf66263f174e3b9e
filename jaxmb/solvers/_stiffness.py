"""Whether stability, instead of accuracy, limits the steps of Adams' method.

A step is counted as stiff under two conditions. First, the Jacobian, estimated from the corrector, is so large that the
step is near the stability bound. Second, relative to the state, the vector field changes much less along the solution
than by the corrector; or the change of the state is less than three times the corrector's change. So stability errors,
not the motion, keep the step short. By measurement, fewer than one in ten steps of non-stiff motions count as stiff. If
stability limits the steps, four in ten to all do (the library's mechanisms; van der Pol, Robertson, HIRES; tolerances
1e-4 to 1e-9).

Source of the first condition: E. Hairer, S. P. Nørsett and G. Wanner, Solving Ordinary Differential Equations I,
Springer, 1993, for Runge-Kutta methods (DOPRI5's test).
"""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from ._history import HIGHEST_ORDER
from .stability import formula, spectral_radius

# The factors of the conditions: for the stability bound, for the changes of the field, for the change of the state.
_NEAR, _FASTER, _SMALLER = 0.3, 10.0, 3.0
# The increment for a stiff step, the decrement for any other, and the sum from which the motion counts as stiff.
_UP, _DOWN, _STIFF = 3, 1, 150


class Stiffness(eqx.Module):
    """**Fields:** `steps`: the number of stiff steps; `level`: the evidence, which non-stiff steps decrease."""

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
    """The evidence after one more step, from the changes of y and f by the corrector and by the step.

    Sizes that are zero or not finite do not count as evidence.
    """
    # |df| / |dy| of the corrector, compared with the ratio along the solution, without division.
    near = h * correction[1] > _NEAR * jnp.asarray(_bounds(), h.dtype)[order] * correction[0]
    faster = correction[1] * change[0] > _FASTER * change[1] * correction[0]
    smaller = change[0] < _SMALLER * correction[0]
    stiff = (near & (faster | smaller)).astype(jnp.int32)
    # Once found, stiffness remains found.
    level = jnp.where(stiff > 0, before.level + _UP, before.level - _DOWN)
    level = jnp.where(before.found, before.level, jnp.maximum(level, 0))
    return Stiffness(before.steps + stiff, level.astype(jnp.int32))


@functools.cache
def _bounds() -> NDArray[np.float64]:
    """For each order, the size of `h λ` on the negative real axis up to which predictor and corrector are stable."""
    out = [0.0]
    sizes = np.geomspace(0.01, 4.0, 400)
    for order in range(1, HIGHEST_ORDER + 1):
        unstable = spectral_radius(formula("Adams", order), -sizes) > 1 + 1e-6
        out.append(float(sizes[np.argmax(unstable)]))
    return np.array(out)
