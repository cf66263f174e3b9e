"""The step size controller of the multistep methods."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Float, Int, PyTree

from .evaluation import check_real, check_term, ravel
from .manifold_term import Args, Y
from .order import StepEstimate
from .scales import RunningScales
from .tolerances import MultistepNorm

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar

# The factor after a step without a usable error estimate: the field is not finite, or constraints are unsolved.
_WITHOUT_ESTIMATE = 0.25
# Upper bounds of the factor after the first, second, and every further rejection. Repeated rejections mean that errors
# do not decrease according to the order, as at a kink or a jump.
_REPEATED = (0.95, 0.5, 0.1)
# The length of the trial before the first step, in units of the interval, and the factors from it to the first step.
_TRIAL, _SHORTER, _LONGER = 1e-4, 1e-8, 100.0
# The recovery from a step shortened by a wrapper is at most this factor, unless the step's own error allows a larger
# one. Beyond this factor, differences are rounding errors.
_RECOVERY = 100.0
# After a step without an estimate, this number of steps grow by at most this factor, so that unsolvable long steps are
# not tried again and again.
_CAUTION, _CAUTIOUS = 4, 1.4


class AbstractControllerState(eqx.Module):
    """The state of a step size controller that knows its next step.

    **Fields:** `intended`: the last requested step size.
    """

    intended: AbstractVar[Float[Array, ""]]


def intended_step(controller_state: Any) -> Float[Array, ""] | None:
    """The length of the next step, from the state of a controller that knows it or wraps one that does; else None."""
    states = states_inside(controller_state, AbstractControllerState)
    return states[0].intended if states else None


def states_inside(controller_state: Any, kind: type) -> list[Any]:
    """The states of a kind in a controller's state, which may be nested."""
    is_one = lambda x: isinstance(x, kind)
    return [x for x in jax.tree.leaves(controller_state, is_leaf=is_one) if is_one(x)]


class AbstractControllerAround(diffrax.AbstractAdaptiveStepSizeController):
    """Wraps another `controller`, and has its tolerances."""

    controller: AbstractVar[Any]

    @property
    def rtol(self):  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.controller.rtol

    @property
    def atol(self):  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.controller.atol

    @property
    def norm(self):  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.controller.norm

    def wrap(self, direction):
        return eqx.tree_at(lambda c: c.controller, self, self.controller.wrap(direction))


class ControllerState(AbstractControllerState):
    """The state of `MultistepController` between steps; `diffrax.SaveAt(controller_state=True)` returns it.

    **Fields:**

    - `intended`: the last step size that was requested.
    - `counters`: see the properties.
    """

    intended: Float[Array, ""]
    counters: Int[Array, "5"]

    @property
    def rejections(self) -> Int[Array, ""]:
        """The number of rejections since the last accepted step."""
        return self.counters[0]

    @property
    def caution(self) -> Int[Array, ""]:
        """The number of next steps with limited growth."""
        return self.counters[1]

    @property
    def opening(self) -> Int[Array, ""]:
        """Two while the first step is a trial, one until a step has been accepted after it, then zero."""
        return self.counters[2]

    @property
    def wasted(self) -> Int[Array, "2"]:
        """Evaluations of the vector field, and matrices computed, in all rejected steps."""
        return self.counters[3:]


class MultistepController(diffrax.AbstractAdaptiveStepSizeController[ControllerState, Any]):
    """Takes the longest steps that the error estimates of a multistep method allow, at the order that allows them.

    ```python
    control = jaxmb.solvers.MultistepController(rtol=1e-6, atol=1e-8, dtmax=0.05)
    motion = jaxmb.simulate(system, state, t1=1.0, solver=jaxmb.solvers.Adams(), stepsize_controller=control)
    ```

    The local error of a step, weighted by `atol + rtol * |y|`, is kept below one twentieth in the given norm. The error
    of the result is then of the size of the tolerance. For tolerances near rounding errors the bound is larger, up to
    one. The controller is for `Adams` and `Hermite`; to step exactly to some times, or over jumps, wrap it in
    `diffrax.ClipStepSizeController`.

    Without a given `dt0` a trial step of one ten-thousandth of the interval tells how long the first step may be. The
    trial is rejected, and counted as rejected, unless its length is about right.

    If no acceptable step is found down to `dtmin`, or to the resolution of the floating-point time, the solve ends with
    `diffrax.RESULTS.dt_min_reached`.
    """

    rtol: Any
    atol: Any
    norm: MultistepNorm
    dtmin: Any
    dtmax: Any
    force_dtmin: bool = eqx.field(static=True)
    safety: Any
    factormin: Any
    factormax: Any

    def __init__(
        self,
        rtol: Any,
        atol: Any,
        *,
        norm: Callable[[PyTree], Any] = optx.rms_norm,
        scales: RunningScales | None = None,
        dtmin: Any = None,
        dtmax: Any = None,
        force_dtmin: bool = False,
        safety: Any = 0.92,
        factormin: Any = 0.01,
        factormax: Any = 4.0,
    ):
        """**Arguments:**

        - `rtol`, `atol`: relative and absolute tolerance: scalars, or vectors with one entry for each component of the
            raveled state.
        - `norm`: the norm of the weighted error.
        - `scales`: sizes of coordinates and velocities that `atol` is relative to, whatever their units.
        - `dtmin`, `dtmax`: bounds of the step.
        - `force_dtmin`: if true, steps of size `dtmin` are accepted with any error, and the solve continues.
        - `safety`: multiplies every step that the error estimates allow.
        - `factormin`: the smallest factor after a rejection, except before the first step.
        - `factormax`: the largest factor after an accepted step that no wrapper shortened.

        **Raises:** `ValueError` for tolerances that are not positive and finite, for an `rtol` finer than the
        floating-point state can resolve, and for inconsistent bounds.
        """
        self.rtol = rtol
        self.atol = atol
        self.norm = MultistepNorm(norm, scales)  # pyright: ignore[reportIncompatibleMethodOverride]
        self.dtmin = dtmin
        self.dtmax = dtmax
        self.force_dtmin = force_dtmin
        self.safety = safety
        self.factormin = factormin
        self.factormax = factormax

    def __check_init__(self):
        numbers = {"rtol": self.rtol, "atol": self.atol, "dtmin": self.dtmin, "dtmax": self.dtmax}
        for name, value in numbers.items():
            if _is_known(value) and not np.all(np.isfinite(value) & (np.asarray(value) > 0)):
                raise ValueError(
                    f"`MultistepController` needs a positive and finite `{name}`, but got `{name}={value}`."
                )
        if _is_known(self.dtmin) and _is_known(self.dtmax) and self.dtmin > self.dtmax:
            raise ValueError(f"`dtmin={self.dtmin}` is larger than `dtmax={self.dtmax}`.")
        if self.force_dtmin and self.dtmin is None:
            raise ValueError("`force_dtmin=True` needs a `dtmin`.")
        factors = (
            ("safety", self.safety, 0, 1),
            ("factormin", self.factormin, 0, 1),
            ("factormax", self.factormax, 1, np.inf),
        )
        for name, value, low, high in factors:
            if _is_known(value) and not low < value <= high:
                raise ValueError(f"`{name}` lies between {low} and {high}, but got `{name}={value}`.")

    def wrap(self, direction: Any) -> "MultistepController":
        del direction
        return self

    def init(
        self,
        terms: PyTree[diffrax.AbstractTerm],
        t0: Any,
        t1: Any,
        y0: Y,
        dt0: Any,
        args: Args,
        func: Callable[..., Y],
        error_order: Any,
    ) -> tuple[Any, ControllerState]:
        del args, func, error_order
        check_term(terms)
        check_real(y0)
        self._check_resolution(y0)
        opening = 2 if dt0 is None else 0
        if dt0 is None:
            dt0 = lax.stop_gradient(jnp.where(jnp.isfinite(t1), t1 - t0, jnp.ones_like(t0)) * _TRIAL)
        dt0 = self._bound(dt0, t0.dtype)
        return t0 + dt0, ControllerState(lax.stop_gradient(dt0), jnp.array([0, 0, opening, 0, 0], np.int32))

    @eqx.filter_jit
    def adapt_step_size(
        self,
        t0: Any,
        t1: Any,
        y0: Y,
        y1_candidate: Y,
        args: Args,
        y_error: StepEstimate | None,  # pyright: ignore[reportIncompatibleMethodOverride]
        error_order: Any,
        controller_state: ControllerState,
    ) -> tuple[Any, Any, Any, bool, ControllerState, diffrax.RESULTS]:
        del y0, y1_candidate, args, error_order
        # A concrete class, since other solvers return an error that this controller cannot read.
        if not isinstance(y_error, StepEstimate):
            raise ValueError(
                "`MultistepController` needs the estimates of a multistep method. Use it with `Adams` or "
                "`Hermite`, without `rtol` and `atol` in the solver: it takes those of the controller."
            )
        dt = t1 - t0
        dtype = dt.dtype
        intended, rejections = controller_state.intended, controller_state.rejections
        opening, caution = controller_state.opening, controller_state.caution
        trial = opening == 2

        scalar = lambda x: jnp.asarray(x, y_error.error.dtype)
        safety = scalar(self.safety)
        keep = (y_error.error < 1) & ~(trial & (safety * y_error.retry > scalar(self.factormax)))
        if self.force_dtmin:
            keep = keep | (intended <= jnp.asarray(self.dtmin, dtype))
        # No steps precede the first one.
        response = jnp.where(opening > 0, scalar(1.0), y_error.response)
        allowed = (safety * jnp.where(keep, y_error.growth, y_error.retry)) ** response
        growth = jnp.clip(allowed, scalar(0.5), jnp.minimum(scalar(self.factormax), y_error.limit))
        growth = jnp.where(caution > 0, jnp.minimum(growth, scalar(_CAUTIOUS)), growth)
        # The last step before a stop may be short only because of the stop.
        most = jnp.maximum(scalar(_RECOVERY), y_error.retry)
        recovered = jnp.minimum(jnp.minimum(allowed, most), (intended / dt).astype(allowed.dtype))
        repeated = jnp.where(rejections == 0, _REPEATED[0], jnp.where(rejections == 1, _REPEATED[1], _REPEATED[2]))
        repeated = jnp.where(trial, _LONGER, repeated)
        smallest = jnp.where(opening > 0, scalar(_SHORTER), scalar(self.factormin))
        shrink = jnp.clip(allowed, smallest, repeated.astype(allowed.dtype))
        shrink = jnp.where(y_error.retry > 0, shrink, scalar(_WITHOUT_ESTIMATE))
        shrink = jnp.where(y_error.retry < 0, scalar(0.0), shrink)
        factor = jnp.where(keep, jnp.maximum(growth, recovered), shrink)
        next_dt = self._bound(dt * lax.stop_gradient(factor).astype(dtype), dtype)

        next_t0 = jnp.where(keep, t1, t0)
        smallest = 16 * jnp.finfo(dtype).eps * jnp.abs(next_t0)
        if self.dtmin is not None and not self.force_dtmin:
            smallest = jnp.maximum(smallest, jnp.asarray(self.dtmin, dtype))
        result = diffrax.RESULTS.where(
            ~keep & (next_dt <= smallest), diffrax.RESULTS.dt_min_reached, diffrax.RESULTS.successful
        )
        counters = [
            jnp.where(keep | trial, 0, rejections + 1),
            jnp.where(keep, jnp.maximum(caution - 1, 0), jnp.where(y_error.retry > 0, caution, _CAUTION)),
            jnp.where(keep, 0, jnp.minimum(opening, 1)),
        ]
        wasted = controller_state.wasted + jnp.where(keep, 0, y_error.work).astype(np.int32)
        counters = jnp.concatenate([jnp.stack(counters).astype(np.int32), wasted])
        state = ControllerState(lax.stop_gradient(next_dt), counters)
        return keep, next_t0, next_t0 + next_dt, False, state, result

    def _bound(self, dt: Any, dtype: Any) -> Any:
        if self.dtmax is not None:
            dt = jnp.minimum(dt, jnp.asarray(self.dtmax, dtype))
        if self.force_dtmin:
            dt = jnp.maximum(dt, jnp.asarray(self.dtmin, dtype))
        return dt

    def _check_resolution(self, y0: Y) -> None:
        finest = 4 * float(jnp.finfo(ravel(y0).dtype).eps)
        if _is_known(self.rtol) and np.any(np.asarray(self.rtol) < finest):
            raise ValueError(
                f"`rtol={self.rtol}` is finer than a state of type {ravel(y0).dtype} can resolve; the least is "
                f"{finest:.1e}. For finer tolerances switch on `jax_enable_x64`."
            )


def _is_known(x: Any) -> bool:
    return x is not None and not isinstance(x, Tracer)
