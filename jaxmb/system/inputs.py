"""Parameters of a system that are functions of time."""

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import equinox as eqx
import numpy as np
from jaxtyping import Array

from .._traced_functions import traced_by_jax
from .._types import Scalar
from ..parts.names import unknown
from ..parts.series import AbstractSignal, as_signal
from .catalogue import AbstractSystem
from .parameters import parameters

System = TypeVar("System", bound=AbstractSystem)
Signals = Mapping[str, AbstractSignal | Callable[[Scalar], Array]]


def with_inputs(system: System, inputs: Signals) -> System:
    """The same system with some parameters as functions of time.

    ```python
    shaken = jaxmb.with_inputs(system, {"pin.point_a": lambda t: jnp.array([0.1 * jnp.sin(5.0 * t), 0.0])})
    start = jaxmb.assemble(shaken, fix={"bar.angle": 0.5})
    ```

    Torques, forces, coefficients, lengths, points and the numbers of drivers and of user functions may be inputs. Their
    rates take part in the velocities and accelerations that constraints prescribe, and in the rates of coordinates and
    of points that forces act against; those of a terrain are velocities of the ground. Masses, moments of inertia,
    gravity, the gains of servos, and points of compliant contacts and of joints that rub (`Friction`) may not.
    Derivatives with respect to the values of a series work as those with respect to parameters.

    **Arguments:** `inputs`: a `Series`, or a function of time [s] that JAX can differentiate, by the name of the
    parameter that it replaces, `{"motor.torque": Series(ts, torques)}`.

    **Raises:** `ValueError` for an unknown name, a parameter that cannot be an input, a value of the wrong shape, and
    a value that jumps where a position constraint depends on it.
    """
    if not isinstance(inputs, Mapping):
        raise ValueError(f"inputs must be a dictionary of series by name, {{'motor.torque': series}}; got {inputs!r}.")
    known, signals = parameters(system), {}
    for name, value in inputs.items():
        if name not in known:
            raise unknown("parameter", name, known)
        if any(name in own.values for own in system.design):
            raise ValueError(f"The design variable {name!r} must be constant; make a parameter an input instead.")
        signals[name] = as_signal(name, value)
        t: Any = np.zeros((), known[name].dtype)
        with traced_by_jax(f"the input {name!r}", "the time"):
            found = eqx.filter_eval_shape(signals[name], t)
        if not hasattr(found, "shape") or found.shape != known[name].shape:
            raise ValueError(
                f"The input {name!r} must have shape {known[name].shape} at each time, as the parameter has; got "
                f"{getattr(found, 'shape', found)}."
            )
    return system.with_signals(signals)


def input_break_times(system: AbstractSystem, t0: Scalar, t1: Scalar) -> np.ndarray:
    """Times [s] at which inputs jump, or their rates where these count.

    **Raises:** `ValueError` that names an input which is not known from `t0` to `t1`.
    """
    signals = system.signals
    for name, (signal, _) in signals.items():
        signal.check_interval(name, t0, t1)
    own = [signal.break_times(of_rates=binding) for signal, binding in signals.values()]
    return np.unique(np.concatenate([np.zeros(0), *own])) if own else np.zeros(0)
