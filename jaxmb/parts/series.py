"""Values as functions of time: measured or planned series, and functions."""

import abc
from collections.abc import Sequence
from typing import Any, ClassVar, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from .._captured import CapturedModule
from .._types import Scalar, VectorLike
from ..linalg.arrays import is_traced
from .fields import as_jax, as_parameter
from .smooth import step

Interpolation = Literal["linear", "cubic", "clamped", "held"]
# The number of times at which a function is sampled.
_SAMPLES = 513


def sample_times(t0: Scalar, t1: Scalar) -> Float[Array, "n"]:
    """The times [s] between two times at which functions of time are sampled, ascending."""
    return jnp.linspace(jnp.minimum(t0, t1), jnp.maximum(t0, t1), _SAMPLES)


class AbstractSignal(eqx.Module):
    """A value as a function of time.

    `of_arrays`: whether signals of one structure differ in their arrays alone; `given_at_samples`: whether the value is
    given at its samples.
    """

    of_arrays: ClassVar[bool] = False
    given_at_samples: ClassVar[bool] = False

    @abc.abstractmethod
    def __call__(self, t: Scalar) -> Array:
        """The value at a time [s]."""

    def shape(self, t: Scalar) -> Any:
        """The shape of the value at a time [s], or the value itself if it is not an array."""
        result = eqx.filter_eval_shape(self, t)
        return getattr(result, "shape", result)

    def keep(self) -> None:
        """Hook: keep the trace of a call; see `Captured`."""

    def break_times(self, *, of_rates: bool) -> np.ndarray:
        """Times [s] at which the value jumps; with `of_rates` also times at which its rate jumps. Default none: jumps
        of a function are unknown here, and `simulate(..., jumps=)` gives them.
        """
        return np.zeros(0)

    @abc.abstractmethod
    def samples(self, t0: Scalar, t1: Scalar) -> Array:
        """Times [s], ascending, between which the value is assumed monotonic."""

    def check_interval(self, label: str, t0: Scalar, t1: Scalar) -> None:
        """Hook: raise a `ValueError` if the value is not known from `t0` to `t1`, unless these are traced."""

    def is_known(self, t0: Scalar, t1: Scalar) -> Any:
        """Whether the value is known from `t0` to `t1`, up to rounding errors; by default at all times."""
        return True

    @property
    @abc.abstractmethod
    def continuous(self) -> bool:
        """Whether the value never jumps."""


class Series(AbstractSignal):
    """A value given at some times, such as a measured or a planned input.

    ```python
    torque = jaxmb.Series([0.0, 0.5, 1.0], [0.0, 2.0, 0.0], interpolation="held")
    ```

    **Arguments:**

    - `ts` [s], shape (n,), ascending, n ≥ 2; `values`, shape (n, …): numbers, vectors or matrices, in SI units.
    - `interpolation`: `"linear"`; `"cubic"`, the not-a-knot spline, whose first two derivatives are continuous;
        `"clamped"`, the spline that starts and ends at rest, with the rate zero at the first and the last time;
        `"held"`, each value until the next time. Both splines may pass their values, `"linear"` and `"held"` do not.

    A call before the first or after the last time returns the first or the last value; as an input of a motion a series
    must last as long as the motion. `ts` and `values` may be traced: motions can be differentiated with respect to
    values.

    **Raises:** `ValueError` for times that do not ascend, and for numbers that are not finite or of the wrong shape.

    Source of the spline: C. de Boor, "A Practical Guide to Splines", Springer, 1978.
    """

    ts: Float[Array, "n"]
    values: Float[Array, "n *shape"]
    slopes: Float[Array, "n *shape"] | None
    interpolation: str = eqx.field(static=True)
    of_arrays: ClassVar[bool] = True
    given_at_samples: ClassVar[bool] = True

    def __init__(self, ts: VectorLike, values: VectorLike, interpolation: Interpolation = "linear"):
        if interpolation not in get_args(Interpolation):
            raise ValueError(
                f"Series: interpolation must be 'linear', 'cubic', 'clamped' or 'held', got {interpolation!r}."
            )
        try:
            # Times stay numbers in a function that JAX traces: a motion is restarted at each jump.
            self.ts, self.values = as_parameter(ts), as_jax(values)
        except (ValueError, TypeError) as error:
            raise ValueError(f"Series: {error}.") from error
        if self.ts.ndim != 1 or self.ts.shape[0] < 2 or self.values.shape[:1] != self.ts.shape:
            raise ValueError(
                "Series: ts must be a vector of at least two times, and values must have one entry for each along axis "
                f"0, got shapes {self.ts.shape} and {self.values.shape}."
            )
        if not is_traced(self.ts):
            times = np.asarray(self.ts)
            if not np.all(np.isfinite(times)):
                raise ValueError(f"Series: ts must be finite, got {times[~np.isfinite(times)][0]}.")
            if np.any(np.diff(times) <= 0):
                k = int(np.argmax(np.diff(times) <= 0))
                raise ValueError(
                    f"Series: ts must ascend, got {times[k]:g} before {times[k + 1]:g}; sort the samples and remove "
                    "repeated times."
                )
        if not is_traced(self.values) and not np.all(np.isfinite(np.asarray(self.values))):
            missing = np.asarray(self.ts)[~np.isfinite(np.asarray(self.values).reshape(len(self.ts), -1)).all(axis=1)]
            raise ValueError(
                f"Series: values must be finite, got a non-finite value at t = {missing[0]:g}; leave such samples out."
            )
        self.interpolation = interpolation
        slopes = {"cubic": _spline_slopes, "clamped": _clamped_slopes}.get(interpolation)
        self.slopes = None if slopes is None else slopes(jnp.asarray(self.ts), self.values)

    def __call__(self, t):
        ts, values = jnp.asarray(self.ts), self.values
        k = jnp.clip(jnp.searchsorted(ts, t, side="right") - 1, 0, ts.shape[0] - 2)
        if self.interpolation == "held":
            # At a time of the series the new value holds.
            return jnp.where(t >= ts[-1], values[-1], values[k])
        h = ts[k + 1] - ts[k]
        s = (t - ts[k]) / h
        inside = values[k] + (values[k + 1] - values[k]) * s
        if self.slopes is not None:
            chord = (values[k + 1] - values[k]) / h
            before, after = self.slopes[k] - chord, chord - self.slopes[k + 1]
            inside = inside + h * s * (1 - s) * (before * (1 - s) + after * s)
        # The time is not clipped: clipping would halve the derivative at the first and the last time.
        return jnp.where(t < ts[0], values[0], jnp.where(t > ts[-1], values[-1], inside))

    def shape(self, t):
        return self.values.shape[1:]

    def break_times(self, *, of_rates):
        if self.slopes is not None or (self.interpolation == "linear" and not of_rates):
            return np.zeros(0)
        if is_traced(self.ts):
            raise ValueError(
                "Series: times at which a value or its rate jumps must not be traced; give them as numbers."
            )
        if self.interpolation == "linear" or is_traced(self.values):
            return np.asarray(self.ts)
        values = np.asarray(self.values).reshape(len(self.ts), -1)
        return np.asarray(self.ts)[1:][np.any(np.diff(values, axis=0) != 0, axis=1)]

    @property
    def is_piecewise_linear(self) -> bool:
        """Whether the values are on straight lines between the times of the series."""
        return self.interpolation == "linear"

    def samples(self, t0, t1):
        return jnp.asarray(self.ts)

    def check_interval(self, label, t0: Any, t1: Any):
        if is_traced((self.ts, t0, t1)):
            return
        first, last = float(self.ts[0]), float(self.ts[-1])
        if min(t0, t1) < first or max(t0, t1) > last:
            raise ValueError(
                f"The series of {label!r} is known from {first:g} to {last:g} s, the motion runs from {float(t0):g} to "
                f"{float(t1):g} s; give a longer series or a shorter motion."
            )

    def is_known(self, t0, t1):
        first, last = jnp.minimum(t0, t1), jnp.maximum(t0, t1)
        rounding = 8 * jnp.finfo(self.ts.dtype).eps * jnp.maximum(jnp.abs(first), jnp.abs(last))
        return (first >= self.ts[0] - rounding) & (last <= self.ts[-1] + rounding)

    @property
    def continuous(self):
        return self.interpolation != "held"


class Signal(AbstractSignal):
    """A value from a function of time, differentiable by the arrays of an equinox module, and by traced values that a
    function closes over.
    """

    function: CapturedModule = eqx.field(converter=CapturedModule)

    def __call__(self, t):
        return jnp.asarray(self.function(t))

    def keep(self):
        self.function.known.keep()

    def samples(self, t0, t1):
        return sample_times(t0, t1)

    @property
    def continuous(self):
        return True


def as_signal(label: str, value: Any) -> AbstractSignal:
    """A series, or a function of time as a signal."""
    if isinstance(value, AbstractSignal):
        return value
    if callable(value):
        return Signal(value)
    raise ValueError(f"The input {label!r} must be a jaxmb.Series or a function of time, got {value!r}.")


def of_one_kind(signals: Sequence[AbstractSignal]) -> list[tuple[tuple[int, ...], AbstractSignal]]:
    """Signals grouped by kind: their indices, and one signal whose first axis runs over the group.

    Series with the same interpolation and shapes are of one kind; a group of one signal has no such axis.
    """
    kinds: dict[Any, list[int]] = {}
    for k, signal in enumerate(signals):
        leaves, structure = jax.tree.flatten(signal)
        kind = (structure, *((x.shape, x.dtype) for x in leaves)) if signal.of_arrays else k
        kinds.setdefault(kind, []).append(k)
    # Times that are numbers stay numbers.
    joined = lambda *leaves: jnp.stack(leaves) if is_traced(leaves) else np.stack(list(map(np.asarray, leaves)))
    together = lambda same: signals[same[0]] if len(same) == 1 else jax.tree.map(joined, *(signals[k] for k in same))
    return [(tuple(same), together(same)) for same in kinds.values()]


def of_each(signals: AbstractSignal, count: int) -> list[AbstractSignal]:
    """The signals that `of_one_kind` has put together."""
    take = lambda x, k: x[k] if is_traced(x) else np.asarray(x)[k]
    return [signals] if count == 1 else [jax.tree.map(lambda x, k=k: take(x, k), signals) for k in range(count)]


def _spline_slopes(ts, values):
    """Slopes at the knots of the spline with a continuous third derivative at the second and the last but one knot."""
    n, flat = ts.shape[0], values.reshape(ts.shape[0], -1)
    h = jnp.diff(ts)[:, None]
    chords = jnp.diff(flat, axis=0) / h
    if n == 2:
        return jnp.broadcast_to(chords, flat.shape).reshape(values.shape)
    if n == 3:
        # One parabola.
        middle = (chords[0] * h[1] + chords[1] * h[0]) / (h[0] + h[1])
        return jnp.stack([2 * chords[0] - middle, middle, 2 * chords[1] - middle]).reshape(values.shape)
    first, last = h[0] + h[1], h[-1] + h[-2]
    right_first = ((h[0] + 2 * first) * h[1] * chords[0] + h[0] ** 2 * chords[1]) / first
    right_last = (h[-1] ** 2 * chords[-2] + (2 * last + h[-1]) * h[-2] * chords[-1]) / last
    slopes = _solved_slopes(h, chords, (h[1], first, right_first), (last, h[-2], right_last))
    return slopes.reshape(values.shape)


def _clamped_slopes(ts, values):
    """Slopes at the knots of the spline whose slope is zero at the first and the last time."""
    if ts.shape[0] == 2:
        return jnp.zeros_like(values)
    h = jnp.diff(ts)[:, None]
    chords = jnp.diff(values.reshape(ts.shape[0], -1), axis=0) / h
    one, zero, none = jnp.ones(1, ts.dtype), jnp.zeros(1, ts.dtype), jnp.zeros_like(chords[0])
    return _solved_slopes(h, chords, (one, zero, none), (zero, one, none)).reshape(values.shape)


def _solved_slopes(h, chords, first, last):
    """Slopes at which the second derivative is continuous at the inner knots.

    **Arguments:** `h`, shape (n − 1, 1), and `chords`, shape (n − 1, m), of the intervals; `first` and `last`: the
    equation at either end, its two coefficients in the order of the knots, and its right-hand side.
    """
    diagonal = jnp.concatenate([first[0], 2 * (h[:-1] + h[1:])[:, 0], last[1]])
    upper = jnp.concatenate([first[1], h[:-1, 0], jnp.zeros(1)])
    lower = jnp.concatenate([jnp.zeros(1), h[1:, 0], last[0]])
    inner = 3 * (h[1:] * chords[:-1] + h[:-1] * chords[1:])
    right = jnp.concatenate([first[2][None], inner, last[2][None]])
    return lax.linalg.tridiagonal_solve(lower, diagonal, upper, right)


def smooth_step(t: Scalar, start: ArrayLike, end: ArrayLike, duration: Any) -> Array:
    """A move from rest to rest: `start` for t ≤ 0, `end` for t ≥ duration, a polynomial of degree five in between.

    ```python
    ramp = lambda t: jaxmb.smooth_step(t - 0.5, 0.0, 1.2, 2.0)  # From 0.5 to 2.5 s.
    lift = {"motion": lambda t, p: jaxmb.smooth_step(t, 0.0, p["rise"], 2.0), "parameters": {"rise": 1.2}}
    turn = planar.Driver("turn", "ground", "bar", quantity="angle", **lift)
    system = jaxmb.Scene([bar], joints=[pin, turn]).compile()
    ```

    Rate and acceleration are continuous, and zero at both ends. With the `distance` from start to end the largest rate
    is `1.875 distance / duration`, and the largest acceleration nearly `5.774 distance / duration²`. For a move through
    further values see `Series` with `"clamped"`.

    **Arguments:** `t` [s], since the start of the move; `start` and `end`, numbers or arrays of one shape; `duration`
    [s] > 0.

    **Raises:** `ValueError` for a duration that is not positive, unless it is traced.
    """
    if not is_traced(duration) and not (np.ndim(duration) == 0 and duration > 0):
        raise ValueError(f"smooth_step: duration must be a positive number, got {duration!r}.")
    start, end = jnp.asarray(start), jnp.asarray(end)
    return start + (end - start) * step(jnp.asarray(t) / duration)
