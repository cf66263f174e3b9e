"""Dense output of a multistep method."""

from typing import Any

import diffrax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from ._evaluation import ravel, unravel_like
from ._history import basis_means, INDEX


class MultistepInterpolation(diffrax.AbstractLocalInterpolation):
    """The polynomial of degree `order + 1` whose derivative interpolates `f` at the end of a step and before it.

    The last evaluation of a step moves that polynomial a little away from the value the step began with; a cubic that is
    flat at both ends takes up the difference, so the solution is continuously differentiable over all steps.
    """

    t0: Any
    t1: Any
    y1: PyTree[Array]
    differences: Float[Array, "length n"]
    mesh: Float[Array, " length"]
    order: Int[Array, ""]
    mismatch: Float[Array, " n"]

    def evaluate(self, t0: Any, t1: Any = None, left: bool = True) -> PyTree[Array]:
        """The solution at `t0`, or its increment from `t0` to `t1`."""
        del left
        if t1 is None:
            return unravel_like(self.y1, ravel(self.y1) + self._since_end(t0))
        return unravel_like(self.y1, self._since_end(t1) - self._since_end(t0))

    def _since_end(self, t: Any) -> Float[Array, " n"]:
        dtype = self.mismatch.dtype
        t = jnp.asarray(t, self.mesh.dtype)
        means, _ = basis_means(self.mesh, self.mesh[0], t)
        means = jnp.where(INDEX <= self.order, means, jnp.zeros((), means.dtype)).astype(dtype)
        elapsed = t - self.mesh[0]
        back = (-elapsed / (self.mesh[0] - self.mesh[1])).astype(dtype)
        return elapsed.astype(dtype) * (means @ self.differences) + back**2 * (3 - 2 * back) * self.mismatch
