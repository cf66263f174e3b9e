"""The residuals of each sensor in order of time, in units of its noise."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from .experiment import RESIDUAL, ExperimentModel
from .problem import Problem
from .sensors import Channel

# Negligible residuals, in standard deviations of known noise, and for unknown noise relative to the data's range: about
# the errors of simulations and instruments.
_SMALL, _SMALL_OF_RANGE = 0.5, 1e-3
# Outliers are residuals beyond this number of standard deviations: one in two million of normal noise.
_FAR = 5.0
# With at least this number of samples, their median, which outliers do not change, estimates the noise.
_MANY = 20


class Bias(NamedTuple):
    """Whether a sensor's offset is `free`, and whether `components` of the sensor or `experiments` share it."""

    free: bool
    components: bool = False
    experiments: bool = False


class Series(NamedTuple):
    """The residuals of one component of a sensor in order of time, predicted minus measured.

    **Fields:** `label`; `experiment`, `sensor` and `component`, an index; `residuals` in units of `sigma`, an array
    like them, for unknown noise the range; `known`: whether the noise was known before the fit; `small`: the size of
    residuals that do not matter; `predicted`: readings; `ts` [s] and `samples`: indices in the data; `bias` of the
    sensor. With a residual function, `predicted` and `ts` are empty.
    """

    label: str
    experiment: str
    sensor: str
    component: tuple[int, ...]
    residuals: np.ndarray
    sigma: np.ndarray
    known: bool
    small: float
    predicted: np.ndarray
    ts: np.ndarray
    samples: np.ndarray
    bias: Bias

    @property
    def square(self) -> float:
        """The mean square of the residuals."""
        return float(np.mean(self.residuals**2))


class Outlier(NamedTuple):
    """A residual beyond five standard deviations of the noise.

    **Fields:** `experiment`, `sensor`; `sample`: the index in the data; `t` [s], NaN for a residual function;
    `residual`: predicted minus measured, in standard deviations.
    """

    experiment: str
    sensor: str
    sample: tuple[int, ...]
    t: float
    residual: float


def series(
    problem: Problem,
    values: Mapping[str, np.ndarray],
    readings: Mapping[str, Mapping[str, Any]],
) -> tuple[Series, ...]:
    """The residuals of all fitted data, from the unknowns by name and their readings."""
    out = []
    for number, (name, trial, fitted) in enumerate(zip(problem.names, problem.trials, problem.fitted, strict=True)):
        if fitted and trial.residual is not None:
            out += _of_user(name, trial, np.asarray(readings[name][RESIDUAL]))
        elif fitted:
            theta = problem.own(number, values)
            for channel in trial.channels:
                level, bias = theta.get(f"{channel.name}.sigma"), _bias(problem, number, channel)
                predicted = np.asarray(readings[name][channel.name])
                out += _of_channel(name, trial, channel, predicted, level, bias, problem.known_noise)
    return tuple(out)


def _bias(problem: Problem, number: int, channel: Channel) -> Bias:
    shapes, name = dict(problem.trials[number].unknowns), f"{channel.name}.bias"
    if name not in shapes:
        return Bias(free=False)
    source = problem.sources[number][list(shapes).index(name)]
    fitted = [names for names, fitted in zip(problem.sources, problem.fitted, strict=True) if fitted]
    shared = sum(source in names for names in fitted) > 1
    return Bias(free=True, components=not shapes[name] and channel.values.ndim > 1, experiments=shared)


def _of_channel(
    experiment: str, trial: ExperimentModel, channel: Channel, predicted, level, bias, known_noise
) -> Iterator[Series]:
    ts, measured, present = (np.asarray(x) for x in (trial.ts, channel.values, channel.present))
    sigma = np.broadcast_to(np.asarray(channel.sigma if level is None else level), measured.shape)
    sample_index = np.full(ts.size, -1)
    sample_index[np.asarray(channel.places)] = np.arange(channel.places.size)
    is_known = known_noise and level is None
    for component in np.ndindex(measured.shape[1:]):
        is_present = present[(slice(None), *component)]
        at = (is_present, *component)
        if not is_present.any():
            continue
        label = " ".join(filter(None, (experiment, channel.name + _indices(component))))
        unit = sigma[at]
        small = _SMALL if is_known else _SMALL_OF_RANGE * float(channel.range) / float(np.max(unit))
        yield Series(
            label=label,
            experiment=experiment,
            sensor=channel.name,
            component=component,
            residuals=(predicted[at] - measured[at]) / unit,
            sigma=unit,
            known=is_known,
            small=small,
            predicted=predicted[at],
            ts=ts[is_present],
            samples=sample_index[is_present],
            bias=bias,
        )


def _of_user(experiment: str, trial: ExperimentModel, residuals: np.ndarray) -> Iterator[Series]:
    """One series for each column if there is a row for each time; otherwise one series."""
    rows = trial.ts.size if residuals.ndim and residuals.shape[0] == trial.ts.size else residuals.size
    label = " ".join(filter(None, (experiment, "what residual returns")))
    columns = residuals.reshape(rows, -1).T
    components = list(np.ndindex(residuals.shape[1:])) if residuals.ndim > 1 and rows == len(residuals) else []
    for k, column in enumerate(columns):
        yield Series(
            label=label,
            experiment=experiment,
            sensor=RESIDUAL,
            component=components[k] if len(components) == columns.shape[0] else (),
            residuals=column,
            sigma=np.ones_like(column),
            known=True,
            small=_SMALL,
            predicted=np.zeros(0),
            ts=np.zeros(0),
            samples=np.arange(column.size),
            bias=Bias(free=False),
        )


def outliers(all_series: tuple[Series, ...]) -> tuple[Outlier, ...]:
    """The residuals beyond five standard deviations, in order of experiments, sensors and times."""
    out = []
    for single in all_series:
        sizes = np.abs(single.residuals)
        level = 1.0
        if not single.known:
            middle = np.median(sizes) / 0.6745 if sizes.size >= _MANY else np.sqrt(single.square)
            level = max(float(middle), single.small)
        for k in np.flatnonzero(sizes > _FAR * level):
            t = float(single.ts[k]) if single.ts.size else np.nan
            sample = (int(single.samples[k]), *map(int, single.component))
            out.append(Outlier(single.experiment, single.sensor, sample, t, float(single.residuals[k] / level)))
    return tuple(out)


def _indices(component: tuple[int, ...]) -> str:
    return f"[{', '.join(map(str, component))}]" if component else ""
