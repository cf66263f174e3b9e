"""Sensors of a motion: gain, bias, delay and noise."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..._types import Scalar, VectorLike
from .loss import Loss

# The possible unknowns of a sensor.
SENSOR_FIELDS = ("bias", "gain", "delay", "sigma")


@dataclasses.dataclass(frozen=True)
class Sensor:
    """An instrument that shows `gain · x(t − delay) + bias` and noise of standard deviation `sigma`.

    ```python
    encoder = jaxmb.Sensor("pin.angle", name="encoder", bias=0.01, sigma=1e-3)
    ```

    **Arguments:**

    - `quantity`: the name of x for `Trajectory.quantity`: `"rod.angle"`, `"A.force"`.
    - `name` of the sensor, in measured data and as prefix of its unknowns, `"encoder.bias"`; default `quantity`.
    - `bias`, in the unit of the readings, and `gain`: numbers, or one for each component of the quantity.
    - `delay` [s] of the reading.
    - `sigma`: standard deviation of the noise in the unit of the readings, a number or one for each component; None if
        unknown. `sigma` of an `Experiment` replaces it there.
    """

    quantity: str
    name: str | None = None
    bias: VectorLike = 0.0
    gain: VectorLike = 1.0
    delay: Scalar = 0.0
    sigma: VectorLike | None = None

    @property
    def label(self) -> str:
        """The name in measured data."""
        return self.quantity if self.name is None else self.name


class Rows(eqx.Module):
    """The misfit of readings.

    **Fields:** `residuals`, weighted, zero for missing samples; `present` marks the others; `scores`, one for every
    unknown noise level: a score times its derivative is the gradient of the objective, and its squared derivative the
    expected second derivative; `objective`: minus the logarithm of the likelihood, up to a constant.
    """

    residuals: Float[Array, "rows"]
    present: Bool[Array, "rows"]
    scores: Float[Array, "levels"]
    objective: Float[Array, ""]


class Channel(eqx.Module):
    """The readings of one sensor in one experiment, with its known numbers.

    **Fields:** `values` and `present`, shape (times, …), at the times of all sensors of the experiment; samples are
    absent at times of other sensors only; `sigma` broadcasts to `values`; `places`: the indices of the sensor's times;
    `delayed`: whether the sensor shows the motion at other times.
    """

    name: str = eqx.field(static=True)
    quantity: str = eqx.field(static=True)
    delayed: bool = eqx.field(static=True)
    values: Float[Array, "times *shape"]
    present: Bool[Array, "times *shape"]
    places: Int[Array, "own"]
    bias: Array
    gain: Array
    delay: Array
    sigma: Array

    def times(self, ts: Float[Array, "times"], t0: Array, theta: Mapping[str, Array]) -> Float[Array, "times"]:
        """The times of the motion that the readings at `ts` show; not before `t0`."""
        return jnp.maximum(ts - theta.get(f"{self.name}.delay", self.delay), t0)

    def read(self, quantity: Float[Array, "times *shape"], theta: Mapping[str, Array]) -> Float[Array, "times *shape"]:
        """The readings of a motion, without noise."""
        gain, bias = (self._each(theta.get(f"{self.name}.{key}", getattr(self, key))) for key in ("gain", "bias"))
        return gain * quantity + bias

    def rows(self, predicted: Float[Array, "times *shape"], theta: Mapping[str, Array], loss: Loss) -> Rows:
        """The misfit of predicted readings; a loss other than the linear needs a known `sigma`."""
        difference = jnp.where(self.present, predicted - self.values, jnp.zeros_like(predicted))
        level = theta.get(f"{self.name}.sigma")
        if level is None:
            residuals = difference / self.sigma
            none = jnp.zeros((0,), residuals.dtype)
            objective = 0.5 * jnp.sum(loss.rho(residuals**2))
            return Rows(residuals.reshape(-1), self.present.reshape(-1), none, objective)
        # The expected second derivatives do not couple noise levels with other unknowns.
        residuals = difference / self._each(lax.stop_gradient(level))
        spread = tuple(range(difference.ndim - level.ndim)) if level.ndim else None
        count = jnp.sum(self.present, axis=spread).astype(residuals.dtype).reshape(-1)
        squares = jnp.sum(residuals**2, axis=spread).reshape(-1)
        size = jnp.sqrt(2 * count)
        log = jnp.log(level).reshape(-1)
        scores = size * (log - lax.stop_gradient(log))
        scores = scores + lax.stop_gradient(jnp.where(count > 0, (count - squares) / jnp.maximum(size, 1.0), 0.0))
        objective = 0.5 * jnp.sum((difference / self._each(level)) ** 2) + jnp.sum(count * log)
        return Rows(residuals.reshape(-1), self.present.reshape(-1), scores, objective)

    def level(self, predicted: np.ndarray, like: Any) -> np.ndarray:
        """The most likely noise level for predicted readings; `like`: an array of its shape."""
        difference = np.where(self.present, np.asarray(predicted) - np.asarray(self.values), 0.0)
        spread = tuple(range(difference.ndim - like.ndim)) if like.ndim else None
        return np.sqrt(np.sum(difference**2, axis=spread) / np.maximum(np.sum(self.present, axis=spread), 1))

    def _each(self, number: Array) -> Array:
        """Numbers of the components for readings at all times."""
        return jnp.broadcast_to(number, self.values.shape[1:])[None] if number.ndim else number

    @property
    def size(self) -> float:
        """The largest magnitude of the readings, in units of the noise."""
        return float(np.max(np.abs(np.where(self.present, self.values / self.sigma, 0.0))))

    @property
    def range(self) -> np.ndarray:
        """The difference between the largest and the smallest reading of all components; 1 if they are the same."""
        data = np.where(self.present, self.values, np.nan)
        width = np.nanmax(data) - np.nanmin(data)
        return np.asarray(width if width > 0 else 1.0)


def readings_of(
    sensor: Sensor,
    data: Any,
    sigma: Any,
    shape: tuple[int, ...],
    places: Int[np.ndarray, "own"],
    times: int,
    dtype: Any,
    unknown_delay: bool,
) -> Channel:
    """The readings of a sensor, checked.

    **Arguments:** `sigma`: standard deviation of the noise; None if unknown, readings are then weighted by their range;
    `shape` of the quantity at one time; `places`: indices of the sensor's times among all times; `times`: the number of
    all times.
    """
    name = sensor.label
    try:
        data = np.asarray(data, dtype=dtype)
    except (TypeError, ValueError):
        raise ValueError(f"Measured {name!r} must be an array of numbers, NaN where a sample is missing.") from None
    count = places.size
    if data.shape != (count, *shape):
        raise ValueError(f"Measured {name!r} must have shape {(count, *shape)} for {count} times, got {data.shape}.")
    if np.any(np.isinf(data)):
        raise ValueError(f"Measured {name!r} is infinite at sample {np.argwhere(np.isinf(data))[0][0]}.")
    present = ~np.isnan(data)
    if not present.any():
        raise ValueError(f"Measured {name!r} holds no number.")
    numbers = {}
    for key in ("bias", "gain", "delay"):
        value = np.asarray(getattr(sensor, key), dtype)
        if value.shape not in ((), () if key == "delay" else shape) or not np.all(np.isfinite(value)):
            raise ValueError(f"{key} of sensor {name!r} must be a finite number or have shape {shape}, got {value}.")
        numbers[key] = jnp.asarray(value)
    return Channel(
        name=name,
        quantity=sensor.quantity,
        delayed=unknown_delay or float(numbers["delay"]) != 0.0,
        values=jnp.asarray(_among_all(np.where(present, data, 0.0), places, times, 0.0)),
        present=jnp.asarray(_among_all(present, places, times, False)),
        places=jnp.asarray(places),
        sigma=jnp.asarray(_among_all(_deviations(name, data, sigma), places, times, 1.0)),
        **numbers,
    )


def _among_all(values: np.ndarray, places: np.ndarray, times: int, otherwise: Any) -> np.ndarray:
    """Values at a sensor's times, expanded to the times of all sensors."""
    out = np.full((times, *values.shape[1:]), otherwise, values.dtype)
    out[places] = values
    return out


def _deviations(name: str, data: np.ndarray, sigma: Any) -> np.ndarray:
    if sigma is None:
        size = np.nanmax(data) - np.nanmin(data)
        return np.full(data.shape, size if size > 0 else 1.0, data.dtype)
    deviation = np.asarray(sigma, data.dtype)
    if not np.all(deviation > 0) or not np.all(np.isfinite(deviation)):
        raise ValueError(f"sigma of {name!r} must be positive.")
    try:
        return np.broadcast_to(deviation, data.shape)
    except ValueError:
        raise ValueError(f"sigma of {name!r} has shape {deviation.shape}, which does not fit {data.shape}.") from None
