"""Tolerances and norms of solvers that choose their own order."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from .evaluation import unravel_like
from .scales import RunningScales, ends_of

# The part of the tolerance for the error of one step. A method of variable order settles where the estimates of
# neighbouring orders are equal. The extrapolated step is hardly better than its estimate, and the errors of a hundred
# steps add up. A Runge–Kutta method of high order takes fewer steps, much better than their estimates. With one
# twentieth a tolerance means the same error of the result for both.
_SHARE = 1 / 20


def closer_tolerance(rtol: Any, finest: float, dtype: Any) -> Any:
    """A tighter `rtol`, for the second run of an error estimate.

    It allows a hundredth of the error of a step; near rounding, a tenth.

    **Arguments:** `finest`: as in `Tolerances.of_step`.
    """
    with jax.numpy_dtype_promotion("standard"):
        whole, least = _part_of_step(rtol, finest, dtype), finest * float(jnp.finfo(dtype).eps)
        part = jnp.minimum(jnp.maximum(whole / 100, least / 10), whole / 10)
        # The tolerance of which a step may use this part; below the finest, a step may use all of it.
        return jnp.where(part < least, part, part / _SHARE)


def _part_of_step(rtol, finest, dtype):
    return jnp.clip(finest * float(jnp.finfo(dtype).eps), _SHARE * rtol, rtol)


def norm_of(norm: Callable[[PyTree], Any], flat: Array, like: PyTree[Array]) -> Any:
    """The norm of a raveled quantity, evaluated in the structure of `like` but in one precision."""
    return norm(unravel_like(jax.tree.map(lambda leaf: leaf.astype(flat.dtype), like), flat))


def absolute_tolerance(atol: Any, scales: RunningScales | None, sizes: Array | None) -> Any:
    """The absolute tolerance of the components of a state."""
    return atol if scales is None or sizes is None else atol * scales.of_components(sizes)


class NormOfCounted(eqx.Module):
    """The norm of some components of a state alone, with the indices `counted` in the raveled state.

    A mean over all components would shrink with the number of components without error.
    """

    norm: Callable[[PyTree], Any]
    counted: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, x: PyTree) -> Any:
        leaves, structure = jax.tree.flatten(x)
        ends = ends_of(leaf.size for leaf in leaves)
        indices = [[k - first for k in self.counted if first <= k < end] for first, end in ends]
        taken = [leaf[np.array(k, int)] for leaf, k in zip(leaves, indices, strict=True)]
        return self.norm(structure.unflatten(taken))


class MultistepNorm(eqx.Module):
    """The norm of a `MultistepController`; its type tells a solver which controller it runs under. With `scales`, the
    absolute tolerance is relative to them.
    """

    norm: Callable[[PyTree], Any]
    scales: RunningScales | None = None

    def __call__(self, x: PyTree) -> Any:
        return self.norm(x)


class Tolerances(eqx.Module):
    """Tolerances and norm of a multistep method, from `tolerances_of`.

    They are filled in from the step size controller (see `from_controller` of `jaxmb._compat`: diffrax has no other way
    to tell a solver its controller); otherwise they are `fixed`, for steps that no error estimate controls.
    """

    rtol: Any
    atol: Any
    norm: MultistepNorm
    fixed: bool = eqx.field(static=True, default=False)

    def check(self, solver: str) -> None:
        """Raise a `ValueError` for a controller that cannot read the estimates of a multistep method."""
        # A concrete class, since only `MultistepController` has a norm of this class.
        if not self.fixed and not isinstance(self.norm, MultistepNorm):
            raise ValueError(
                f"`{solver}` chooses its order together with its step, which only `MultistepController` understands. "
                f"Use `stepsize_controller=jaxmb.solvers.MultistepController(rtol=..., atol=...)` instead of "
                f"`diffrax.PIDController` and its like. (It may be wrapped in `diffrax.ClipStepSizeController`.)"
            )

    @property
    def scales(self) -> RunningScales | None:
        """The scales that the absolute tolerance is relative to."""
        return self.norm.scales

    def scale(self, y0: Array, y1: Array, h: Any, sizes: Array | None) -> Array:
        """The tolerance of each component over a step of length h from `y0` to `y1`; `sizes`: the running scales so
        far. With them, the rounding errors of a machine at rest are not resolved.
        """
        return self._scale(1.0, self.rtol, self.atol, y0, y1, h, sizes)

    def of_step(self, y0: Array, y1: Array, h: Any, sizes: Array | None, finest: float = 0.0) -> Array:
        """The error tolerated in each component in one step of a multistep method, from `y0` to `y1` in a time h.

        **Arguments:** `finest`: the smallest relative tolerance of a step, in units of the machine precision; below it
        rounding dominates the estimates. Every `rtol` of one to twenty times `finest` has the same steps, to the last
        bit, for equal `atol / rtol`.
        """
        with jax.numpy_dtype_promotion("standard"):
            whole = jnp.maximum(self.rtol, float(jnp.finfo(y0.dtype).eps))
            rtol = _part_of_step(whole, finest, y0.dtype)
            share, atol = rtol / whole, rtol * (self.atol / whole)
        return self._scale(share, rtol, atol, y0, y1, h, sizes)

    def _scale(self, share, rtol, atol, y0, y1, h, sizes):
        # A step that ends where the vector field is undefined is measured at its start.
        y1 = jnp.where(jnp.isnan(y1), y0, y1)
        with jax.numpy_dtype_promotion("standard"):
            scale = absolute_tolerance(atol, self.scales, sizes) + rtol * jnp.maximum(jnp.abs(y0), jnp.abs(y1))
            if self.scales is not None and sizes is not None:
                scale = jnp.maximum(scale, share * self.scales.at_rest(sizes, y1, h))
        return jax.lax.stop_gradient(scale.astype(y0.dtype))
