"""Dense output of a multistep method."""

from typing import Any

import diffrax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ._evaluation import ravel, unravel_like
from ._history import basis_means


class MultistepInterpolation(diffrax.AbstractLocalInterpolation):
    """The integral of the polynomial through the derivative at the end of a step and at `order` mesh points before it.

    The evaluation that ends a step moves this polynomial a little, so its integral no longer meets the value that the
    step began with, by `mismatch`. A cubic that is flat at both ends makes up for it: the solution is continuously
    differentiable from step to step, and its derivative at mesh points is the vector field.
    """

    t0: Any
    t1: Any
    y1: PyTree[Array]
    differences: Float[Array, "length n"]
    mesh: Float[Array, " length"]
    mismatch: Float[Array, " n"]

    def evaluate(self, t0: Any, t1: Any = None, left: bool = True) -> PyTree[Array]:
        """The solution at `t0`, or its increment from `t0` to `t1`."""
        del left
        if t1 is None:
            return unravel_like(self.y1, ravel(self.y1) + self._since_end(t0))
        return unravel_like(self.y1, self._since_end(t1) - self._since_end(t0))

    def _since_end(self, t: Any) -> Float[Array, " n"]:
        dtype = self.mismatch.dtype
        end = self.mesh[0]
        elapsed = jnp.asarray(t, end.dtype) - end
        means, _ = basis_means(self.mesh, end, end + elapsed)
        back = (elapsed / (self.mesh[1] - end)).astype(dtype)
        return (
            elapsed.astype(dtype) * (means.astype(dtype) @ self.differences) + back**2 * (3 - 2 * back) * self.mismatch
        )
