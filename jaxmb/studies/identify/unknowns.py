"""Unknowns of several experiments, by name: parameters, shared or not, sensors, and initial states."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._arguments import check_kind
from ..._types import VectorLike
from ...parts.names import unknown
from ...states.assembly import assemble
from ...states.consistency import constraints_depend_on
from ...system import AbstractSystem, parameters, with_parameters
from ...system.design import design_bounds
from ..ranges import Bounds, FreeParameters, range_of
from .experiment import (
    Experiment,
    ExperimentModel,
    arrays,
    channels_of,
    initial_unknown,
    known_parameters,
    times_of,
    with_times,
)
from .loss import Loss
from .measurements import BY_NAME
from .sensors import SENSOR_FIELDS, Channel, Sensor

Prior = tuple[VectorLike, VectorLike]


class Priors(eqx.Module):
    """Independent normal distributions of unknowns."""

    names: tuple[str, ...] = eqx.field(static=True)
    means: tuple[Array, ...]
    deviations: tuple[Array, ...]

    def __call__(self, values: Mapping[str, Array]) -> Float[Array, "components"]:
        """Differences from the means, in standard deviations."""
        each = zip(self.names, self.means, self.deviations, strict=True)
        rows = [((values[name] - mean) / deviation).reshape(-1) for name, mean, deviation in each]
        return jnp.concatenate(rows) if rows else jnp.zeros((0,))


class Unknowns(NamedTuple):
    """All unknowns, the experiments as functions of their unknowns, the names of these among all, and the priors."""

    free: FreeParameters
    trials: tuple[ExperimentModel, ...]
    sources: tuple[tuple[str, ...], ...]
    priors: Priors


class _Unknown(NamedTuple):
    """An unknown without a range: start, an array like it, whether it is positive, a typical change, an upper bound."""

    start: Any
    like: Array
    positive: bool = False
    scale: Any = None
    below: float = np.inf


def experiments_by_name(experiments: Sequence[Experiment]) -> dict[str, Experiment]:
    """Experiments by name; missing names are generated."""
    out = {}
    for number, experiment in enumerate(experiments, 1):
        check_kind("An experiment", experiment, Experiment, "a jaxmb.Experiment", BY_NAME)
        name = f"exp{number}" if experiment.name is None else experiment.name
        if name in out or not name or "/" in name:
            raise ValueError(f"The name {name!r} of an experiment must be unique, not empty and without '/'.")
        out[name] = with_times(experiment, f" of experiment {name!r}")
    if not any(not experiment.held_out for experiment in out.values()):
        raise ValueError("There is no experiment to fit: give one or more that are not held_out.")
    return out


def sensors_by_name(system: AbstractSystem, sensors: Iterable[Sensor]) -> dict[str, Sensor]:
    """Sensors by their names, checked."""
    quantities, out = system.quantities(), {}
    for sensor in sensors:
        check_kind("A sensor", sensor, Sensor, "a jaxmb.Sensor", "jaxmb.Sensor(quantity, …)")
        if sensor.quantity not in quantities:
            raise unknown("quantity of a sensor", sensor.quantity, quantities)
        if sensor.label in out or (sensor.label in quantities and sensor.label != sensor.quantity):
            raise ValueError(f"The name of sensor {sensor.label!r} is taken; give it another.")
        out[sensor.label] = sensor
    return out


def unknowns(
    system: AbstractSystem,
    experiments: Mapping[str, Experiment],
    sensors: Mapping[str, Sensor],
    free: Mapping[str, VectorLike | None] | Sequence[str],
    bounds: Mapping[str, Bounds] | None,
    prior: Mapping[str, Prior] | None,
    sigma: Mapping[str, VectorLike] | None,
    loss: Loss,
) -> Unknowns:
    """Unknowns with their starts, ranges and priors, and the experiments that depend on them.

    **Arguments:** as in `identify`; the name of a single experiment may be empty, its unknowns then have no prefix.

    **Raises:** `ValueError` for unknown names and wrong values.
    """
    given = dict(free) if isinstance(free, Mapping) else dict.fromkeys((free,) if isinstance(free, str) else free)
    experiments = {name: _with_named(name, single, given) for name, single in experiments.items()}
    if not given and not any(single.own or single.free_initial for single in experiments.values()):
        raise ValueError("Nothing is free: give the names of the parameters, or their starting values by name.")
    _check_names(system, experiments, sensors, given)
    collected: dict[str, _Unknown] = {}
    trials, sources = [], []
    for name, experiment in experiments.items():
        trial, source_names = _trial(system, name, experiment, sensors, given, sigma, loss, collected)
        trials.append(trial)
        sources.append(source_names)
    _check_measured(system, experiments, sensors, sigma)
    for name in given:
        if name not in collected:
            raise ValueError(f"{name!r} is unknown to every experiment that is fitted; leave it out of free.")
    order = [name for name in given if name in collected] + [name for name in collected if name not in given]
    limits = _within_design(system, _for_each("bounds", bounds, order), order)
    ranges = [_range(name, collected[name], limits.get(name)) for name in order]
    return Unknowns(
        FreeParameters(tuple(order), tuple(ranges)),
        tuple(trials),
        tuple(sources),
        _priors(_for_each("a prior", prior, order), collected),
    )


def _within_design(system: AbstractSystem, limits: Mapping[str, Bounds], order: Sequence[str]) -> dict[str, Bounds]:
    """Bounds by name, including the bounds of design variables."""
    out, declared = dict(limits), design_bounds(system)
    for name in order:
        base = name.rpartition("/")[2]
        if base in declared:
            out[name] = design_bounds(system, {base: out.get(name, (None, None))})[base]
    return out


def _with_named(prefix: str, experiment: Experiment, given: Mapping[str, Any]) -> Experiment:
    """The experiment with the unknowns that `free` names with its prefix: `"exp2/A.friction"`,
    `"initial.crank.angle"`.
    """
    before = f"{prefix}/" if prefix else ""
    ours = [name.removeprefix(before) for name in given if name.startswith(before or "initial.")]
    initial = [name.removeprefix("initial.") for name in ours if name.startswith("initial.")]
    own_names = [name for name in ours if not name.startswith("initial.")]
    named = experiment.free_initial
    named = (named,) if isinstance(named, str) else named
    starts = dict.fromkeys(initial) | (dict(named) if isinstance(named, Mapping) else dict.fromkeys(named))
    own_names = tuple(dict.fromkeys((*experiment.own, *own_names)))
    if experiment.held_out and (own_names or starts):
        raise ValueError(f"Experiment {prefix!r} is held out and cannot have its own unknowns; give their values.")
    return dataclasses.replace(experiment, own=own_names, free_initial=starts)


def _check_names(system, experiments, sensors, given) -> None:
    """Refuse names that are neither parameters nor numbers of a sensor."""
    measured = dict.fromkeys(name for experiment in experiments.values() for name in (experiment.measured or {}))
    of_sensors = [f"{name}.{key}" for name in dict.fromkeys((*sensors, *measured)) for key in SENSOR_FIELDS]
    values = parameters(system)
    for name in of_sensors:
        if name in values:
            raise ValueError(f"{name!r} is a parameter of the system as well as of a sensor; rename the sensor.")
    allowed = dict.fromkeys((*values, *of_sensors))
    prefixes = tuple(f"{name}/" for name in experiments if name) or ("initial.",)
    for name in (*given, *(name for single in experiments.values() for name in single.own)):
        if not name.startswith(prefixes) and name not in allowed:
            raise unknown("parameter", name, allowed)


def _check_measured(system, experiments, sensors, sigma) -> None:
    """Refuse sensors and noise levels of quantities that are not measured, and noise levels given twice."""
    available = dict.fromkeys((*sensors, *system.quantities()))
    measured = dict.fromkeys(name for experiment in experiments.values() for name in (experiment.measured or {}))
    for name in sigma or {}:
        if name not in available:
            raise unknown("quantity", name, available)
        if name not in measured:
            raise ValueError(f"sigma is given for {name!r}, which is not measured.")
        if name in sensors and sensors[name].sigma is not None:
            raise ValueError(f"sigma of {name!r} is given twice, by sigma= and by its Sensor; leave one of them out.")
    for name in sensors:
        if name not in measured:
            listed = ", ".join(map(repr, measured)) or "nothing"
            raise ValueError(f"The data of sensor {name!r} are missing: measured by name is {listed}.")


def _assembled(experiment, system, guess, **prescribed):
    """The initial state of an experiment; an error of assembly names the experiment."""
    try:
        return assemble(system, guess, **prescribed)
    except ValueError as error:
        if not experiment:
            raise
        raise ValueError(f"Experiment {experiment!r}: {error}") from error


def _trial(
    system, prefix, experiment, sensors, given, sigma, loss, collected
) -> tuple[ExperimentModel, tuple[str, ...]]:
    """One experiment, whose unknowns are added to `collected`."""
    ts, places = times_of(experiment)
    label = lambda name: f"{prefix}/{name}" if prefix else name
    known_values = known_parameters(system, experiment)
    own_names = {*experiment.own}
    shared = [name for name in given if "/" not in name and not name.startswith("initial.")]
    local = list(dict.fromkeys((*shared, *experiment.own)))
    channels = channels_of(system, experiment, sensors, sigma, frozenset(local), ts, places)
    values, positive = parameters(system) | known_values, system.parameter_table.positive()
    by_name = {f"{channel.name}.{key}": (channel, key) for channel in channels for key in SENSOR_FIELDS}

    def start_of(name, default):
        for key in (label(name), name):
            if given.get(key) is not None:
                return given[key]
        return default

    unknown_here: dict[str, tuple[str, _Unknown]] = {}
    changed = []
    for name in local:
        source = label(name) if name in own_names else name
        if name in by_name:
            unknown_here[name] = source, _of_sensor(*by_name[name], start_of(name, None), ts, experiment.t0, sensors)
        elif name in values:
            if name in known_values and name not in own_names:
                continue
            changed.append(name)
            unknown_here[name] = source, _Unknown(start_of(name, values[name]), values[name], name in positive)
        elif name in own_names:
            raise ValueError(f"{name!r} belongs to a sensor that experiment {prefix!r} has not measured.")

    guess = system.guess if experiment.state is None else experiment.state
    known_rates = system.rate_names()
    fix = arrays(experiment.fix)
    # By the names of rates, so that an unknown rate replaces a rate given by its coordinate's name.
    rates = {
        full if (full := f"{name}_rate") in known_rates else name: x for name, x in arrays(experiment.rates).items()
    }
    initial = tuple((f"initial.{name}", initial_unknown(system, name)) for name in experiment.free_initial)
    same = with_parameters(system, known_values)
    if initial:
        state = _assembled(prefix, same, guess, fix=fix, rates=rates, t=experiment.t0)
        sizes = system.coordinate_scale(), system.velocity_scale()
        for (name, what), chosen in zip(initial, experiment.free_initial.values(), strict=True):
            index = (known_rates if what.is_rate else system.coordinate_names())[what.name]
            index = index[0] if len(index) == 1 else np.array(index)
            vector, size = (state.u, sizes[1]) if what.is_rate else (state.q, sizes[0])
            start = start_of(name, vector[index] if chosen is None else chosen)
            unknown_here[name] = label(name), _Unknown(start, vector[index], False, size[index])
    # Coordinates of joints depend on the joints' parameters.
    of_bodies = fix.keys() <= system.coordinate_names().keys() and rates.keys() <= known_rates.keys()
    assembled = not initial and of_bodies and not constraints_depend_on(same, experiment.t0, guess, changed)
    if assembled:
        # A state that is the same for all trials is computed, and differentiated, once.
        guess = _assembled(prefix, same, guess, fix=fix, rates=rates, t=experiment.t0)
    if not experiment.held_out:
        for source, what in unknown_here.values():
            first = collected.setdefault(source, what)
            collected[source] = first._replace(below=min(first.below, what.below))
    trial = ExperimentModel(
        unknowns=tuple((name, np.shape(what.like)) for name, (_, what) in unknown_here.items()),
        changed=tuple(changed),
        initial=initial,
        assembled=assembled,
        channels=channels,
        residual=experiment.residual,
        loss=loss,
        known=known_values,
        state=guess,
        fix=fix,
        rates=rates,
        t0=jnp.asarray(experiment.t0, ts.dtype),
        ts=ts,
        inputs=experiment.inputs,
    )
    return trial, tuple(source for source, _ in unknown_here.values())


def _of_sensor(channel: Channel, key: str, start, ts, t0, sensors) -> _Unknown:
    """The unknown bias, gain, delay or noise level of a sensor."""
    sensor = sensors.get(channel.name, Sensor(channel.quantity))
    width = jnp.asarray(channel.range, ts.dtype)
    if key == "sigma":
        level = width if sensor.sigma is None else jnp.asarray(sensor.sigma, ts.dtype)
        return _Unknown(
            level if start is None else start, level if start is None else jnp.asarray(start, ts.dtype), True
        )
    number = getattr(channel, key)
    if key == "delay":
        is_present = np.asarray(channel.present).reshape(ts.shape[0], -1).any(axis=1)
        below = float(ts[np.argmax(is_present)]) - float(t0)
        span = (ts[-1] - ts[0]) / 10 if ts.size > 1 else ts[-1]
        return _Unknown(number if start is None else start, number, False, span, below)
    like = number if start is None else jnp.asarray(start, ts.dtype)
    shapes = (), channel.values.shape[1:]
    if like.shape not in shapes:
        raise ValueError(f"{key} of sensor {channel.name!r} must be a number or have shape {shapes[1]}.")
    return _Unknown(like, like, False, width if key == "bias" else jnp.ones_like(width))


def _range(name: str, what: _Unknown, bounds: Bounds | None):
    if np.isfinite(what.below):
        low, high = bounds or (None, None)
        if not float(jnp.max(jnp.asarray(what.start))) < what.below:
            raise ValueError(
                f"The start of {name!r} must be smaller than {what.below:g} s, the time from t0 to the first sample: "
                "there is no motion before t0. Start t0 earlier, or leave out the first samples."
            )
        bounds = low, what.below if high is None else min(float(np.max(high)), what.below)
    return range_of(name, what.start, what.like, bounds, positive=what.positive, scale=what.scale)


def _for_each(what: str, given: Mapping[str, Any] | None, names: Sequence[str]) -> dict[str, Any]:
    """Values by full names of unknowns; a name without prefix stands for the unknowns of all experiments."""
    out = {}
    for name, value in (given or {}).items():
        full_names = [full for full in names if name in (full, full.split("/", 1)[-1])]
        if not full_names:
            raise unknown(f"free parameter with {what}", name, names)
        out |= {full: value for full in full_names if full == name or full not in (given or {})}
    return out


def _priors(given: Mapping[str, Prior], collected: Mapping[str, _Unknown]) -> Priors:
    means, deviations = [], []
    for name, pair in given.items():
        like = collected[name].like
        try:
            mean, deviation = (np.broadcast_to(np.asarray(x, like.dtype), like.shape) for x in pair)
        except (TypeError, ValueError):
            raise ValueError(
                f"The prior of {name!r} must be (mean, deviation), of numbers or of shape {like.shape}, got {pair!r}."
            ) from None
        if not (np.all(np.isfinite(mean)) and np.all(np.isfinite(deviation)) and np.all(deviation > 0)):
            raise ValueError(f"The prior of {name!r} must have a finite mean and a positive deviation, got {pair!r}.")
        means.append(jnp.asarray(mean))
        deviations.append(jnp.asarray(deviation))
    return Priors(tuple(given), tuple(means), tuple(deviations))
