"""The step size controller of the multistep methods."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import optimistix as optx
from jax import lax
from jaxtyping import Array, Float, Int, PyTree

from ._base import Args, Y
from ._evaluation import ravel, unravel_like
from ._order import StepEstimate
from ._tolerances import MultistepNorm


_SHRINK = 0.5


class ControllerState(eqx.Module):
    intended: Float[Array, ""]
    rejections: Int[Array, ""]


class MultistepController(diffrax.AbstractAdaptiveStepSizeController[ControllerState, Any]):
    """doc"""

    rtol: Any
    atol: Any
    norm: MultistepNorm = eqx.field(converter=MultistepNorm)
    dtmin: Any
    dtmax: Any
    force_dtmin: bool = eqx.field(static=True)
    safety: Any
    factormin: Any
    factormax: Any
    deadband: Any

    def __init__(
        self,
        rtol: Any,
        atol: Any,
        *,
        norm: Callable[[PyTree], Any] = optx.rms_norm,
        dtmin: Any = None,
        dtmax: Any = None,
        force_dtmin: bool = False,
        safety: Any = 1.0,
        factormin: Any = 0.1,
        factormax: Any = 2.0,
        deadband: Any = (0.9, 1.2),
    ):
        self.rtol = rtol
        self.atol = atol
        self.norm = MultistepNorm(norm)
        self.dtmin = dtmin
        self.dtmax = dtmax
        self.force_dtmin = force_dtmin
        self.safety = safety
        self.factormin = factormin
        self.factormax = factormax
        self.deadband = deadband

    def wrap(self, direction: Any) -> "MultistepController":
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order) -> tuple[Any, ControllerState]:
        if dt0 is None:
            dt0 = self._first_step(terms, t0, t1, y0, args, func)
        if self.dtmax is not None:
            dt0 = jnp.minimum(dt0, self.dtmax)
        if self.dtmin is not None:
            dt0 = jnp.maximum(dt0, self.dtmin)
        return t0 + dt0, ControllerState(dt0, jnp.asarray(0, jnp.int32))

    def _first_step(self, terms, t0, t1, y0, args, func):
        dtype = t0.dtype
        flat = ravel(y0)
        with jax.numpy_dtype_promotion("standard"):
            scale = self.atol + self.rtol * jnp.abs(flat)
        size = lambda x: self.norm(unravel_like(y0, (x / scale).astype(flat.dtype)))
        f0 = ravel(func(terms, t0, y0, args), flat.dtype)
        span = jnp.where(jnp.isfinite(t1), t1 - t0, jnp.ones((), dtype)).astype(flat.dtype)
        reach = jnp.minimum(jnp.maximum(size(flat), 1) / size(f0), span)
        probe = 0.01 * reach
        f1 = ravel(func(terms, t0 + probe.astype(dtype), unravel_like(y0, flat + probe * f0), args), flat.dtype)
        bend = size(f1 - f0) / probe
        h = jnp.where(bend > 0, jnp.sqrt(1 / bend), reach)
        h = jnp.where(jnp.isfinite(h), jnp.minimum(h, reach), probe)
        return lax.stop_gradient(h.astype(dtype))

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        del y0, y1_candidate, args, error_order
        estimate = y_error
        dt = t1 - t0
        dtype = dt.dtype
        keep = estimate.error < 1
        low, high = self.deadband
        growth = self.safety * estimate.growth
        growth = jnp.where((growth > low) & (growth < high), jnp.ones_like(growth), growth)
        # Errors that do not fall as the order promises are those of a kink or a jump
        retry = jnp.clip(self.safety * estimate.retry, self.factormin, 0.9)
        retry = jnp.where(controller_state.rejections > 0, jnp.minimum(retry, 0.5), retry)
        kept = jnp.clip(growth, _SHRINK, self.factormax)
        factor = lax.stop_gradient(jnp.where(keep, kept, retry)).astype(dtype)
        next_dt = dt * factor
        if self.dtmax is not None:
            next_dt = jnp.minimum(next_dt, self.dtmax)
        next_t0 = jnp.where(keep, t1, t0)
        smallest = 10 * jnp.finfo(dtype).eps * jnp.abs(next_t0)
        result = diffrax.RESULTS.where(
            ~keep & (next_dt <= smallest), diffrax.RESULTS.dt_min_reached, diffrax.RESULTS.successful
        )
        state = ControllerState(lax.stop_gradient(next_dt), jnp.where(keep, 0, controller_state.rejections + 1))
        return keep, next_t0, next_t0 + next_dt, False, state, result
