"""Predictions of the estimates, their uncertainty, and their comparison with held-out data."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtri
from jaxtyping import ArrayLike

from ..._arguments import probability
from ...parts.names import unknown
from ...system.quantities import with_shapes
from .experiment import measured_times
from .fit import Fit
from .problem import jacobian_and_value


@dataclasses.dataclass(frozen=True)
class Prediction:
    """Quantities of a motion with their uncertainty.

    **Fields:** `ts` [s]; by name of the quantity `values`, their standard `deviations`, and the ends `low` and `high`
    of the band that contains the true value with probability `level`; times are axis 0. A deviation is infinite if the
    quantity depends on undetermined unknowns, and NaN if the fit did not converge, or does not explain its data.
    """

    ts: np.ndarray
    values: dict[str, np.ndarray]
    deviations: dict[str, np.ndarray]
    low: dict[str, np.ndarray]
    high: dict[str, np.ndarray]
    level: float

    def __repr__(self) -> str:
        return f"Prediction: {with_shapes(self.values, {})}, with bands of {self.level:.0%}"


def predict(
    fit: Fit,
    quantities: str | Sequence[str],
    *,
    ts: ArrayLike | None = None,
    experiment: str | None = None,
    level: float = 0.95,
    trusted: bool = True,
) -> Prediction:
    """As `Identification.predict`; bands are NaN if the fit is not `trusted`."""
    level = probability("level", level)
    fit.whole_motions("A prediction")
    problem = fit.problem
    if experiment is not None and experiment not in problem.names:
        raise unknown("experiment", experiment, problem.names)
    number = 0 if experiment is None else problem.names.index(experiment)
    trial = problem.trials[number]
    names = (quantities,) if isinstance(quantities, str) else tuple(quantities)
    for name in names:
        if name not in problem.system.quantities():
            raise unknown("quantity", name, problem.system.quantities())
    ts = trial.ts if ts is None else measured_times(ts, float(trial.t0))
    columns = problem.columns(number)
    flat = jnp.asarray(np.asarray(problem.free.flat(fit.z))[columns])
    jacobians, values = _predicted(problem.system, trial, problem.options, names, ts, flat)
    uncertainty = fit.uncertainty
    width = float(ndtri((1 + level) / 2))
    out, deviations = {}, {}
    for name in names:
        jacobian = np.asarray(jacobians[name])
        out[name] = np.asarray(values[name])
        deviation = np.linalg.norm(jacobian @ uncertainty.root[columns], axis=-1)
        if uncertainty.lost.shape[1]:
            along = np.max(np.abs(jacobian @ uncertainty.lost[columns]), axis=-1)
            size = np.max(np.abs(jacobian)[..., None] * np.abs(uncertainty.lost[columns]), initial=0.0)
            deviation = np.where(along > 1e-6 * size, np.inf, deviation)
        deviations[name] = deviation if trusted else np.full_like(deviation, np.nan)
    low = {name: out[name] - width * deviations[name] for name in names}
    high = {name: out[name] + width * deviations[name] for name in names}
    return Prediction(np.asarray(ts), out, deviations, low, high, level)


@eqx.filter_jit
def _predicted(system, trial, options, names, ts, flat) -> Any:
    def fn(flat):
        changed, state = trial.start(system, trial.named(flat))
        trajectory = trial.simulated(changed, state, ts, options)
        values = {name: trajectory.quantity(name) for name in names}
        return values, values

    return jacobian_and_value(fn, flat)


@dataclasses.dataclass(frozen=True)
class HeldOut:
    """The quality of prediction of data that were not fitted.

    **Fields:** `residuals` of the samples, predicted minus measured, in units of the noise level (of the readings'
    range if the noise is unknown); `rms`: their root mean square; `readings`: predicted, by sensor, at its times.
    """

    residuals: np.ndarray
    rms: float
    readings: dict[str, np.ndarray]


def held_out(fit: Fit) -> dict[str, HeldOut]:
    """The prediction of every held-out experiment, by its name."""
    problem = fit.problem
    values, out = problem.free(fit.z), {}
    for number, (name, fitted) in enumerate(zip(problem.names, problem.fitted, strict=True)):
        if fitted:
            continue
        seen = _seen(problem.system, problem.trials[number], problem.options, problem.own(number, values))
        residuals = np.asarray(seen.rows.residuals)[np.asarray(seen.rows.present)]
        places = {channel.name: np.asarray(channel.places) for channel in problem.trials[number].channels}
        readings = {sensor: np.asarray(reading)[places.get(sensor, ...)] for sensor, reading in seen.readings.items()}
        out[name] = HeldOut(residuals, float(np.sqrt(np.mean(residuals**2))), readings)
    return out


@eqx.filter_jit
def _seen(system, trial, options, theta):
    return trial.seen(*trial.start(system, theta), theta, options)
