"""Inputs: parameters of a system that are functions of time."""

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from .._traced_functions import traced_by_jax
from .._types import Scalar, State
from ..linalg.arrays import is_traced
from ..parts.names import unknown
from ..parts.series import AbstractSignal, as_signal, of_one_kind, sample_times
from ..solvers.evaluation import freeze
from .parameters import parameters
from .pulses import between_segments_on_one_line, on_straight_lines, pulses_at_knots, pulses_of_samples, turned
from .system import AbstractSystem

System = TypeVar("System", bound=AbstractSystem)
# The largest number of coordinates, over all times, for which functions of time are computed in one batch.
_AT_ONCE = 2**17
# Looks at functions of time: the first at the state of the run, the others displaced from it by these multiples of the
# system's size. The last two see other strengths as well.
_DISPLACED, _OTHER_STRENGTHS = np.array([0.0, 1.0, 1e-3, 1.0]), np.array([False, False, True, True])
# The relative change of strengths. It shows terms that cancel, and moves no pulse by more than this fraction.
_CHANGE = 1e-4

Signals = Mapping[str, AbstractSignal | Callable[[Scalar], Array]]


def with_inputs(system: System, inputs: Signals) -> System:
    """The same system with some parameters as functions of time.

    ```python
    shaken = jaxmb.with_inputs(system, {"pin.point_a": lambda t: jnp.array([0.1 * jnp.sin(5.0 * t), 0.0])})
    start = jaxmb.assemble(shaken, fix={"bar.angle": 0.5})
    ```

    Torques, forces, coefficients, also of `DryFriction`, lengths, points and the numbers of drivers and of user
    functions may be inputs. Masses, moments of inertia, gravity, the gains of servos, restitution, the friction of a
    rope, and points of compliant contacts and of joints that rub (`Friction`) may not. Rates of inputs enter the
    velocities and accelerations that constraints prescribe, the rates of coordinates and points that forces depend on,
    and the velocities of a moving terrain. The values of a series can be differentiated like parameters.

    **Arguments:** `inputs`: a `Series`, or a function of time [s] that JAX can differentiate, by the parameter's name,
    `{"motor.torque": Series(ts, torques)}`. A function is captured with the values that it reads now.

    **Raises:** `ValueError` for an unknown name, a parameter that cannot be an input, a value of the wrong shape, and
    a jump of a parameter of a position constraint.
    """
    if not isinstance(inputs, Mapping):
        raise ValueError(f"inputs must be a dictionary of series by name, {{'motor.torque': series}}; got {inputs!r}.")
    existing, signals = parameters(system), {}
    for name, value in inputs.items():
        if name not in existing:
            raise unknown("parameter", name, existing)
        if any(name in group.values for group in system.design):
            raise ValueError(f"The design variable {name!r} must be constant; make a parameter an input instead.")
        signals[name] = as_signal(name, value)
        t: Any = np.zeros((), existing[name].dtype)
        with traced_by_jax(f"the input {name!r}", "the time"):
            shape = signals[name].shape(t)
        signals[name].keep()
        if shape != existing[name].shape:
            raise ValueError(
                f"The input {name!r} must have shape {existing[name].shape} at each time, as the parameter has; got "
                f"{shape}."
            )
    return system.parameter_table.with_signals(signals)


def input_break_times(system: AbstractSystem, t0: Scalar, t1: Scalar) -> np.ndarray:
    """Times [s] at which inputs jump, and at which rates of inputs jump that constraints depend on.

    **Raises:** `ValueError` naming an input that does not cover the times from `t0` to `t1`.
    """
    signals = system.parameter_table.signals
    for name, (signal, _) in signals.items():
        signal.check_interval(name, t0, t1)
    times = [signal.break_times(of_rates=binding) for signal, binding in signals.values()]
    return np.unique(np.concatenate([np.zeros(0), *times])) if times else np.zeros(0)


def inputs_ended(system: AbstractSystem, t0: Scalar, t1: Scalar) -> Any:
    """Whether an input does not cover the times from `t0` to `t1`, which may be traced; False without inputs."""
    ended: Any = False
    for numbers, signal in of_one_kind([signal for signal, _ in system.parameter_table.signals.values()]):
        of_signal = lambda signal: signal.is_known(t0, t1)
        covered = of_signal(signal) if len(numbers) == 1 else jnp.all(jax.vmap(of_signal)(signal))
        if covered is not True:
            ended = ended | ~covered
    return ended


def turning_times(system: AbstractSystem, state: State, t0: Scalar, t1: Scalar) -> Float[Array, "n"] | None:
    """Times [s] at which steps must end so that no pulse of an input or function of time is missed.

    A machine at rest or in free flight allows steps of any length, and a long step may skip a pulse. Each function is
    looked at by itself from `t0` to `t1`: a series at its values, and all functions at 513 times, also at other states
    and with other strengths than those of the run, which may be zero. The times are those where

    - an input, a driver, a `Force` or a constraint turns: it has made an excursion of a tenth of its range;
    - a function is at the peak of a pulse that stands out of the values beside it, however small it is;
    - a series on a straight line has a value that is traced: the motion may be differentiated by it.

    **Returns:** sorted times, padded by infinity; None if nothing depends on time.
    """
    # Inputs with break times are left out: a motion restarts at these times, so steps end there anyway.
    pairs = system.parameter_table.signals.values()
    signals = [signal for signal, binding in pairs if not signal.break_times(of_rates=binding).size]
    if not signals and not system.of_time:
        return None
    kinds = [(len(numbers) > 1, is_traced(signal), signal) for numbers, signal in of_one_kind(signals)]
    return _turning_times(kinds, system.at(state) if system.of_time else None, state, t0, t1)


@eqx.filter_jit
def _turning_times(kinds, system, state, t0, t1):
    kinds, system, state, t0, t1 = freeze((kinds, system, state, t0, t1))
    ts = sample_times(t0, t1)
    turns, columns, of_knots = jnp.zeros(ts.shape, bool), [], []
    for several, traced, signal in kinds:
        each = jax.vmap if several else lambda function: function
        if signal.given_at_samples:
            times, sampled = each(lambda signal, traced=traced: _at_knots(signal, traced, ts))(signal)
            of_knots.append(jnp.ravel(times))
            values = [jnp.moveaxis(sampled.reshape(-1, ts.size, sampled.shape[-1]), 1, 0).reshape(ts.size, -1)]
        else:
            values = [_at(_changed(signal, number) if number else signal, ts) for number in _numbers_of(signal)]
            turns = turns | turned(values[0])
        columns.extend(values)
    if system is not None:
        turning, in_looks = _looks(system, state, ts)
        turns = turns | turned(turning)
        columns.append(in_looks)
    times = jnp.concatenate([ts[:1], ts[-1:], *of_knots])
    shown = turns.at[jnp.searchsorted(ts, times - 0.5 * (ts[1] - ts[0]))].set(True, mode="drop")
    pulses = pulses_of_samples(ts, jnp.concatenate(columns, axis=1), shown) & ~shown
    inside = (turns | pulses) & (ts > ts[0]) & (ts < ts[-1])
    return jnp.sort(jnp.concatenate([*of_knots, jnp.where(inside, ts, jnp.inf)]))


def _at(function, ts):
    """The values of a function at some times, one row for each time."""
    return jax.vmap(lambda t: jnp.ravel(function(t)))(ts)


def _at_knots(series, traced, ts):
    """Times at which a series turns or has the peak of a pulse, other times are infinite; its values at times `ts`."""
    knots, (first, last) = series.samples(ts[0], ts[-1]), (ts[0], ts[-1])
    values = _at(series, jnp.concatenate([jnp.clip(knots, first, last), ts]))
    known, sampled = values[: knots.size], values[knots.size :]
    ended = pulses_at_knots(knots, known, (ts, sampled), lambda times: _at(series, times), turned(known))
    if series.is_piecewise_linear:
        ended = ended | between_segments_on_one_line(knots, known, first, last)
    ended = ended | on_straight_lines(knots, known) if traced else ended
    return jnp.where(ended & (knots > first) & (knots < last), knots, jnp.inf), sampled


def _looks(system, state, ts):
    """The functions of time of a system at some times: those that may turn, and each of them in several looks."""
    in_q, in_u = system.coordinate_scale(), system.velocity_scale()

    def look(number, t):
        by = jnp.asarray(_DISPLACED, state.q.dtype)[number]
        other = jnp.asarray(_OTHER_STRENGTHS)[number]
        strengths = lambda parts: jax.tree.map(lambda a, b: jnp.where(other, a, b), _changed(parts, number), parts)
        q = system.normalize(t, state.q + by * in_q * _random(state.q.size, number, state.q.dtype))
        u = state.u + by * in_u * _random(state.u.size, number + 1, state.u.dtype)
        return jnp.concatenate(system.with_strengths(strengths).given_in_time(t, q, u))

    first = jax.eval_shape(system.given_in_time, ts[0], state.q, state.u).turning.size
    looks = jnp.arange(_DISPLACED.size)
    at_once = min(max(_AT_ONCE // (looks.size * state.q.size), 1), ts.size)
    given = lax.map(lambda t: jax.vmap(lambda number: look(number, t))(looks), ts, batch_size=at_once)
    return given[:, 0, :first], given[:, :, first:].reshape(ts.size, -1)


def _numbers_of(signal):
    """The looks at a function of time: with its own strengths, and with other ones if it has any."""
    return (0, 1) if jax.tree.leaves(eqx.filter(signal, eqx.is_inexact_array)) else (0,)


def _changed(tree, number):
    """Other strengths: random numbers in place of zeros, and small changes of other numbers."""
    numbers, rest = eqx.partition(tree, eqx.is_inexact_array)
    with jax.numpy_dtype_promotion("standard"):
        flat, unravel = ravel_pytree(numbers)
        random = _random(flat.size, number, flat.dtype)
        changed = unravel(jnp.where(flat == 0, random, flat * (1 + _CHANGE * random)))
    return eqx.combine(changed, rest)


def _random(size, number, dtype):
    """Positive numbers around one without a pattern, always the same."""
    places = jnp.arange(1, size + 1, dtype=dtype) * jnp.asarray(number + 1, dtype)
    return 1.5 + jnp.cos(places * places)
