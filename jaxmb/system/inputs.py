"""Inputs: parameters of a system that are functions of time."""

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._traced_functions import traced_by_jax
from .._types import Scalar, State
from ..parts.names import unknown
from ..parts.series import AbstractSignal, as_signal, of_one_kind, sample_times
from ..solvers.evaluation import freeze
from .parameters import parameters
from .system import AbstractSystem

System = TypeVar("System", bound=AbstractSystem)
# The largest excursion of an input that may be missed between two steps, relative to its range.
_HIDDEN = 0.1
# The largest number of coordinates, over all times, for which functions of time are computed in one batch.
_AT_ONCE = 2**17

Signals = Mapping[str, AbstractSignal | Callable[[Scalar], Array]]


def with_inputs(system: System, inputs: Signals) -> System:
    """The same system with some parameters as functions of time.

    ```python
    shaken = jaxmb.with_inputs(system, {"pin.point_a": lambda t: jnp.array([0.1 * jnp.sin(5.0 * t), 0.0])})
    start = jaxmb.assemble(shaken, fix={"bar.angle": 0.5})
    ```

    Torques, forces, coefficients, lengths, points and the numbers of drivers and of user functions may be inputs.
    Masses, moments of inertia, gravity, the gains of servos, and points of compliant contacts and of joints that rub
    (`Friction`) may not. Rates of inputs enter the velocities and accelerations that constraints prescribe, the rates
    of coordinates and points that forces depend on, and the velocities of a moving terrain. The values of a series can
    be differentiated like parameters.

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

    A machine at rest or in free flight allows steps of any length, and a long step may skip a pulse. Between two of
    these times no input makes an excursion of more than a tenth of its range from `t0` to `t1`. A series is sampled at
    its values, a function at 513 times.

    **Returns:** sorted times, padded by infinity; None if nothing depends on time.
    """
    # Inputs with break times are left out: a motion restarts at these times, so steps end there anyway.
    pairs = system.parameter_table.signals.values()
    signals = [signal for signal, binding in pairs if not signal.break_times(of_rates=binding).size]
    if not signals and not system.of_time:
        return None
    return _turning_times(of_one_kind(signals), system.at(state) if system.of_time else None, state, t0, t1)


@eqx.filter_jit
def _turning_times(signals, system, state, t0, t1):
    signals, system, state, t0, t1 = freeze((signals, system, state, t0, t1))
    first, last = jnp.minimum(t0, t1), jnp.maximum(t0, t1)
    at_once = max(_AT_ONCE // state.q.size, 1)

    def turns(ts, function):
        at = lambda t: jnp.ravel(function(t))
        values = lax.map(at, jnp.clip(ts, first, last), batch_size=min(at_once, ts.size))
        turned = _has_turned(values)
        return jnp.where(turned & (ts[:-1] > first) & (ts[:-1] < last), ts[:-1], jnp.inf)

    of_kind = lambda function, numbers: function if len(numbers) == 1 else jax.vmap(function)
    sampled = lambda signal: signal.samples(t0, t1)
    kinds = [(of_kind(sampled, numbers)(signal), signal, of_kind(turns, numbers)) for numbers, signal in signals]
    if system is not None:
        kinds.append((sample_times(t0, t1), lambda t: system.given_in_time(t, state.q, state.u), turns))
    times = [jnp.ravel(turned(ts, function)) for ts, function, turned in kinds]
    return jnp.sort(jnp.concatenate(times))


def _has_turned(values):
    """At which values some column has turned since the last turn: its path is longer than the net change."""
    range_ = jnp.max(values, axis=0) - jnp.min(values, axis=0)
    rounding = 16 * jnp.finfo(values.dtype).eps * jnp.max(jnp.abs(values), axis=0)
    most = jnp.where(range_ > rounding, _HIDDEN * range_, jnp.inf)

    def passed(carry, value):
        start, before, way = carry
        step = jnp.abs(value - before)
        turned = jnp.any(way + step - jnp.abs(value - start) > most)
        return (jnp.where(turned, before, start), value, jnp.where(turned, step, way + step)), turned

    return lax.scan(passed, (values[0], values[0], jnp.zeros_like(most)), values[1:])[1]
