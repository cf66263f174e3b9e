"""How a solver that chooses its own order learns the tolerances, and what it measures errors with."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from ._evaluation import unravel_like


def norm_of(norm: Callable[[PyTree], Any], flat: Array, like: PyTree[Array]) -> Any:
    """The norm of a raveled quantity, given to it in the structure of `like`, but in one precision."""
    return norm(unravel_like(jax.tree.map(lambda leaf: leaf.astype(flat.dtype), like), flat))


class MultistepNorm(eqx.Module):
    """The norm of a `MultistepController`; its type tells a solver which controller it runs under."""

    norm: Callable[[PyTree], Any]

    def __call__(self, x: PyTree) -> Any:
        return self.norm(x)


class Tolerances(eqx.Module):
    """Tolerances and norm, in the place and under the names where diffrax looks for those of a root finder.

    Made by `diffrax.with_stepsize_controller_tols(Tolerances)()`, they are filled in from the step size controller;
    otherwise they are `fixed`, for steps that no error estimate controls.
    """

    rtol: Any
    atol: Any
    norm: Callable[[PyTree], Any]
    fixed: bool = eqx.field(static=True, default=False)

    def check(self, solver: str) -> None:
        """Raise a `ValueError` if they come from a controller that cannot read the estimates of a multistep method."""
        # A concrete class: the norm comes from the controller, and only that of `MultistepController` is of it.
        if not self.fixed and not isinstance(self.norm, MultistepNorm):
            raise ValueError(
                f"`{solver}` chooses its order together with its step, which only `MultistepController` understands. "
                f"Use `stepsize_controller=jaxmb.solvers.MultistepController(rtol=..., atol=...)` instead of "
                f"`diffrax.PIDController` and its like. (It may be wrapped in `diffrax.ClipStepSizeController`.)"
            )

    def scale(self, y0: Array, y1: Array) -> Array:
        """The error tolerated in each component over a step from `y0` to `y1`."""
        # A step to where the vector field is undefined is judged by where it came from.
        y1 = jnp.where(jnp.isnan(y1), y0, y1)
        with jax.numpy_dtype_promotion("standard"):
            scale = self.atol + self.rtol * jnp.maximum(jnp.abs(y0), jnp.abs(y1))
        return jax.lax.stop_gradient(scale.astype(y0.dtype))
