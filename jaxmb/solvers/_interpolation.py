"""Dense output of a multistep method."""

import abc
from typing import Any

import diffrax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ._history import basis, basis_means, spans
from .evaluation import ravel, unravel_like


class MultistepInterpolation(diffrax.AbstractLocalInterpolation):
    """The polynomial through a method's history, in Newton's form on its mesh, of the `order` used in a step."""

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

    @abc.abstractmethod
    def _since_end(self, t: Any) -> Float[Array, " n"]:
        """The solution at `t` minus the solution at the end of the step."""


class RateInterpolation(MultistepInterpolation):
    """The integral of a polynomial through the derivatives at the end of a step and before.

    The evaluation at the end of a step changes this polynomial slightly, so its integral misses the initial value of
    the step by `mismatch`. A cubic that is flat at both ends compensates for it. So the solution is continuously
    differentiable from step to step, and its derivative at mesh points is the vector field.
    """

    def _since_end(self, t: Any) -> Float[Array, " n"]:
        dtype = self.mismatch.dtype
        end = self.mesh[0]
        elapsed = jnp.asarray(t, end.dtype) - end
        means, _ = basis_means(self.mesh, end, end + elapsed)
        back = -(elapsed / spans(self.mesh)[0]).astype(dtype)
        return (
            elapsed.astype(dtype) * (means.astype(dtype) @ self.differences) + back**2 * (3 - 2 * back) * self.mismatch
        )


class StateInterpolation(MultistepInterpolation):
    """A polynomial through the states at the end of a step and before, with its slope at the end."""

    def _since_end(self, t: Any) -> Float[Array, " n"]:
        values = basis(self.mesh, jnp.asarray(t, self.mesh.dtype)[None])[:, 0]
        return values[1:].astype(self.mismatch.dtype) @ self.differences[1:]
