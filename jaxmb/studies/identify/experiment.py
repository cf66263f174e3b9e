"""One measured motion: its data, its initial state, and its differences from other motions."""

import contextlib
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from ..._results import RESULTS
from ..._traced_functions import traced_by_jax
from ..._types import Scalar, State, VectorLike
from ...parts.names import UnknownNameError, unknown
from ...simulate import simulate
from ...simulate.span import frozen_times
from ...states.assembly import assemble
from ...system import AbstractSystem, parameters, with_parameters
from ...trajectory import Trajectory
from .loss import Loss
from .measurements import BY_NAME, have_times
from .sensors import Channel, Rows, Sensor, readings_of

# The name of a residual function's result among the readings.
RESIDUAL = "residual"


@dataclasses.dataclass(frozen=True)
class Experiment:
    """One measured motion, for `identify`.

    ```python
    ts = np.linspace(0.1, 1.0, 10)
    swing = {"bar.angle": jaxmb.simulate(system, state, t1=1.0, saveat=ts)["bar"].angle}
    drop = jaxmb.Experiment(swing, ts=ts, fix={"bar.angle": 0.5}, name="drop")
    fit = jaxmb.identify(system, [drop], free={"bar.inertia": 0.2})
    ```

    **Arguments:**

    - `measured`, `ts`, `state`, `fix`, `rates`, `t0`, `sigma`, `residual`, `free_initial`: as in `identify`.
        `Measurements` contain their `ts`; `sigma` replaces the noise levels of `identify` and of sensors.
    - `inputs`: as in `simulate`.
    - `parameters`: known values for this experiment alone, by name; estimates from other experiments do not replace
        them.
    - `own`: names of unknowns with a value for this experiment alone: `own=("A.friction",)` makes `"exp2/A.friction"`.
    - `name`: prefix of these unknowns; default `"exp1"`, `"exp2"`, ….
    - `held_out`: whether the data are not fitted, only predicted, for `Identification.held_out`.
    """

    measured: Any = None
    _: dataclasses.KW_ONLY
    ts: ArrayLike | Mapping[str, ArrayLike] | None = None
    state: State | None = None
    fix: Mapping[str, VectorLike] | None = None
    rates: Mapping[str, VectorLike] | None = None
    t0: Scalar = 0.0
    inputs: Any = None
    parameters: Mapping[str, VectorLike | eqx.Module] | None = None
    own: Sequence[str] = ()
    free_initial: Sequence[str] | Mapping[str, VectorLike] = ()
    sigma: Mapping[str, VectorLike] | None = None
    residual: Callable[[Trajectory], Array] | None = None
    name: str | None = None
    held_out: bool = False


class Initial(NamedTuple):
    """An unknown of the initial state: the coordinate or the rate of this name."""

    name: str
    is_rate: bool


class Seen(NamedTuple):
    """The outcome of a simulation with some parameters: the misfit, infinite after a failure; the predicted readings by
    sensor, with a residual function's result as `"residual"`; the last state; and the simulation's result.
    """

    rows: Rows
    readings: dict[str, Array]
    end: State
    result: RESULTS


class ExperimentModel(eqx.Module):
    """An experiment as a function of its unknowns, named without the experiment's prefix.

    **Fields:** `unknowns`: their names and shapes; `changed`: the unknown parameters of the system; `initial`: the
    unknowns of the initial state; `assembled`: whether the initial state is `state` for all unknowns.
    """

    unknowns: tuple[tuple[str, tuple[int, ...]], ...] = eqx.field(static=True)
    changed: tuple[str, ...] = eqx.field(static=True)
    initial: tuple[tuple[str, Initial], ...] = eqx.field(static=True)
    assembled: bool = eqx.field(static=True)
    channels: tuple[Channel, ...]
    residual: Callable[[Trajectory], Array] | None
    loss: Loss = eqx.field(static=True)
    known: dict[str, Array]
    state: State
    fix: dict[str, Array]
    rates: dict[str, Array]
    t0: Array
    ts: Float[Array, "times"]
    inputs: Any

    @property
    def size(self) -> float:
        """One plus the largest reading, in units of the noise."""
        return 1 + max((channel.size for channel in self.channels), default=0.0)

    def named(self, flat: Float[Array, "values"]) -> dict[str, Array]:
        """Unknowns by name, from a vector of all their values."""
        ends = np.cumsum([int(np.prod(shape)) for _, shape in self.unknowns])
        parts = jnp.split(flat, ends)[:-1]
        return {name: part.reshape(shape) for (name, shape), part in zip(self.unknowns, parts, strict=True)}

    def changed_system(self, system: AbstractSystem, theta: Mapping[str, Array]) -> AbstractSystem:
        """The system with these unknowns."""
        return with_parameters(system, self.known | {name: theta[name] for name in self.changed})

    def start(
        self, system: AbstractSystem, theta: Mapping[str, Array], throw: bool | None = False
    ) -> tuple[AbstractSystem, State]:
        """The system with these unknowns, and its initial state; NaN if it cannot be assembled, unless `throw`, as in
        `assemble`.
        """
        system = self.changed_system(system, theta)
        if self.assembled:
            return system, self.state
        fix = self.fix | {entry.name: theta[label] for label, entry in self.initial if not entry.is_rate}
        rates = self.rates | {entry.name: theta[label] for label, entry in self.initial if entry.is_rate}
        return system, assemble(system, self.state, fix=fix, rates=rates, t=self.t0, throw=throw)

    def simulated(
        self,
        system: AbstractSystem,
        state: State,
        ts: Float[Array, "saved"],
        options: Mapping[str, Any],
    ) -> Trajectory:
        """The motion from an initial state."""
        inputs = {} if self.inputs is None else {"inputs": self.inputs}
        moves = any(channel.delayed for channel in self.channels)
        with contextlib.nullcontext() if moves else frozen_times():
            return simulate(system, state, t0=self.t0, t1=ts[-1], saveat=ts, throw=False, **(dict(options) | inputs))

    def seen(
        self,
        system: AbstractSystem,
        state: State,
        theta: Mapping[str, Array],
        options: Mapping[str, Any],
    ) -> Seen:
        """The outcome of the motion from an initial state."""
        late = [channel for channel in self.channels if channel.delayed]
        series = [self.ts, *(channel.times(self.ts, self.t0, theta) for channel in late)]
        saved = jnp.concatenate(series) if late else self.ts
        # Sensors with a delay see the motion at other times: all times are saved in order.
        order = jnp.argsort(saved) if late else np.arange(saved.size)
        trajectory = self.simulated(system, state, saved[order] if late else saved, options)
        places = jnp.argsort(order).reshape(len(series), -1) if late else np.arange(saved.size)[None]
        readings, rows = {}, []
        for channel in self.channels:
            places_of_sensor = places[1 + late.index(channel) if channel.delayed else 0]
            quantity = trajectory.quantity(channel.quantity)
            readings[channel.name] = channel.read(quantity[places_of_sensor] if late else quantity, theta)
            rows.append(channel.rows(readings[channel.name], theta, self.loss))
        if self.residual is not None:
            with traced_by_jax("the residual function", "the motion"):
                readings[RESIDUAL] = jnp.asarray(self.residual(trajectory))
            rows.append(_of_user(readings[RESIDUAL], self.loss))
        joined = Rows(
            jnp.concatenate([part.residuals for part in rows]),
            jnp.concatenate([part.present for part in rows]),
            jnp.concatenate([part.scores for part in rows]),
            jnp.sum(jnp.stack([part.objective for part in rows])),
        )
        ok = (trajectory.result == RESULTS.successful) & jnp.isfinite(joined.objective)
        fails = lambda x: jnp.where(ok, x, jnp.inf)
        joined = Rows(fails(joined.residuals), joined.present, fails(joined.scores), fails(joined.objective))
        end = jax.tree.map(lambda y: y[-1], trajectory.ys)
        return Seen(joined, readings, end, trajectory.result)


def _of_user(residuals: Array, loss: Loss) -> Rows:
    residuals = residuals.reshape(-1)
    present = jnp.ones(residuals.shape, bool)
    return Rows(residuals, present, jnp.zeros((0,), residuals.dtype), 0.5 * jnp.sum(loss.rho(residuals**2)))


def with_times(experiment: Experiment, where: str = "") -> Experiment:
    """An experiment with measured data by name, and with times."""
    measured: Any = experiment.measured
    if have_times(measured):
        if experiment.ts is not None:
            raise ValueError(f"Measurements{where} have their own times; leave out ts.")
        experiment = dataclasses.replace(experiment, measured=measured.values, ts=measured.ts)
    elif measured is not None and not isinstance(measured, Mapping):
        raise ValueError(f"identify: {BY_NAME}; got an object of type {type(measured).__name__}{where}.")
    if experiment.ts is None:
        raise ValueError(f"ts{where} is missing: the times of the data.")
    return experiment


def times_of(experiment: Experiment) -> tuple[Float[Array, "times"], dict[str, np.ndarray]]:
    """All times of an experiment in order, and for each measured name the indices of its times."""
    names: tuple[str, ...] = tuple(experiment.measured or ())
    given: Any = experiment.ts
    if not isinstance(given, Mapping):
        ts = measured_times(given, experiment.t0)
        return ts, dict.fromkeys(names, np.arange(ts.size))
    if not names:
        raise ValueError("Times by name belong to measured quantities; a residual function needs one vector ts.")
    for name in given:
        if name not in names:
            raise unknown("measured name with times", name, names)
    missing = [name for name in names if name not in given]
    if missing:
        raise ValueError(f"ts is given by name but not for {missing[0]!r}; give the times of all measured quantities.")
    each = {name: np.asarray(measured_times(given[name], experiment.t0, name)) for name in names}
    ts = np.unique(np.concatenate(list(each.values())))
    return jnp.asarray(ts), {name: np.searchsorted(ts, times) for name, times in each.items()}


def measured_times(ts: ArrayLike, t0: Scalar, name: str = "") -> Float[Array, "times"]:
    """The times of all data, or of the quantity `name`, as an array; `ValueError` unless they increase from `t0` on."""
    label = f"ts[{name!r}]" if name else "ts"
    times = np.asarray(ts, dtype=float)
    if times.ndim != 1 or times.size == 0:
        raise ValueError(f"{label} must be a vector of increasing times, got shape {times.shape}.")
    if not np.all(np.isfinite(times)):
        place = int(np.flatnonzero(~np.isfinite(times))[0])
        raise ValueError(
            f"{label} must be a vector of increasing times, but {label}[{place}] is {times[place]}; leave it out."
        )
    if np.any(np.diff(times) <= 0):
        place = int(np.flatnonzero(np.diff(times) <= 0)[0])
        raise ValueError(
            f"{label} must be a vector of increasing times, but {label}[{place + 1}] = {times[place + 1]:g} follows "
            f"{times[place]:g}; sort the samples, one at each time."
        )
    if times[0] < t0 or times[-1] <= t0:
        raise ValueError(
            f"{label} must begin at or after t0 = {t0} and end after it, got {times[0]:g} to {times[-1]:g}."
        )
    return jnp.asarray(times, dtype=jnp.result_type(float))


def channels_of(
    system: AbstractSystem,
    experiment: Experiment,
    sensors: Mapping[str, Sensor],
    sigma: Mapping[str, VectorLike] | None,
    free: frozenset[str],
    ts: Float[Array, "times"],
    places: Mapping[str, np.ndarray],
) -> tuple[Channel, ...]:
    """The readings of an experiment, checked.

    **Arguments:** `free`: names of unknowns, without the experiment's prefix; `places`: for each name its indices in
    `ts`.
    """
    measured: Any = experiment.measured
    if (measured is None) == (experiment.residual is None):
        raise ValueError("Give either measured quantities by name or a residual function.")
    if measured is None:
        if experiment.sigma is not None:
            raise ValueError("sigma belongs to measured quantities; a residual function does its own weighting.")
        return ()
    if not measured:
        raise ValueError("measured is empty: give at least one quantity by name.")
    shapes = {name: quantity.shape for name, quantity in system.quantities().items()}
    available = dict.fromkeys((*sensors, *shapes))
    for name in (*measured, *(experiment.sigma or {})):
        if name not in available:
            raise unknown("quantity", name, available)
    for name in experiment.sigma or {}:
        if name not in measured:
            raise ValueError(f"sigma is given for {name!r}, which is not measured.")
    deviations = dict(sigma or {}) | dict(experiment.sigma or {})
    out, levels = [], {}
    for name, data in measured.items():
        sensor = sensors.get(name, Sensor(name))
        deviation = deviations.get(name, sensor.sigma)
        levels[name] = deviation is not None or f"{name}.sigma" in free
        shape = shapes[sensor.quantity]
        late = f"{name}.delay" in free
        channel = readings_of(sensor, data, deviation, shape, places[name], ts.shape[0], ts.dtype, late)
        if not late:
            _check_delay(channel, np.asarray(ts), float(np.asarray(experiment.t0)))
        out.append(channel)
    if any(levels.values()) and not all(levels.values()):
        missing = next(name for name, is_given in levels.items() if not is_given)
        raise ValueError(f"sigma is given for other quantities but not for {missing!r}; give all or none.")
    return tuple(out)


def _check_delay(channel, ts, t0):
    """Raise a `ValueError` for readings of the motion before it begins."""
    is_present = np.asarray(channel.present).reshape(ts.size, -1).any(axis=1)
    # Computed times differ by rounding errors.
    rounding = 8 * np.finfo(ts.dtype).eps * np.max(np.abs([t0, *ts]))
    early = ts[is_present & (ts - float(channel.delay) < t0 - rounding)]
    if early.size:
        raise ValueError(
            f"Sensor {channel.name!r} has a delay of {float(channel.delay):g} s, so its reading at {early[0]:g} s "
            f"shows the motion before t0 = {t0:g}. Start t0 earlier, or leave out samples before "
            f"{t0 + float(channel.delay):g} s, or put NaN in their place."
        )


def initial_unknown(system: AbstractSystem, name: str) -> Initial:
    """The coordinate or the rate, `"crank.angle"` or `"crank.angle_rate"`, of an initial state."""
    coordinates, rates = system.coordinate_names(), system.rate_names()
    if name in coordinates:
        fixed = np.zeros(system.nq, bool)
        fixed[coordinates[name]] = True
        if system.normalize_fixed(system.guess.q, fixed)[1]:
            raise ValueError(
                f"{name!r} cannot be free: its components are not independent of each other. Free a joint's coordinate."
            )
        return Initial(name, False)
    if name in rates:
        return Initial(name, True)
    if name in (joints := system.joint_coordinates()) or name.removesuffix("_rate") in joints:
        raise UnknownNameError(
            f"free_initial takes coordinates of bodies, not of joints, and {name!r} is of a joint; there are "
            f"{', '.join(map(repr, [*coordinates, *rates]))}."
        )
    raise unknown("initial coordinate or rate", name, [*coordinates, *rates])


def known_parameters(system: AbstractSystem, experiment: Experiment) -> dict[str, Array]:
    """The known parameters of one experiment."""
    given = experiment.parameters or {}
    values = parameters(with_parameters(system, given))
    return {name: values[name] for name in given}


def arrays(values: Mapping[str, VectorLike] | None) -> dict[str, Bool[Array, "..."]]:
    """Numbers by name as arrays."""
    return {name: jnp.asarray(value, jnp.result_type(float)) for name, value in (values or {}).items()}
