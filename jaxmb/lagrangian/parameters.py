"""The parameters of a Lagrangian system by name, constant or functions of time."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._compat import with_values
from .._dataflow import depends
from .._types import Scalar
from ..parts.series import AbstractSignal, of_each, of_one_kind
from ..system.parameter_table import ParameterTable


class DrivenParameters(eqx.Module):
    """Parameters that are functions of time, grouped by kind, and whether constraints or the kinematics depend on
    them.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    signal: AbstractSignal
    binds: bool = eqx.field(static=True)

    def at(self, t: Scalar) -> Sequence[Array]:
        """The values at a time."""
        if len(self.names) == 1:
            return [self.signal(t)]
        values = jax.vmap(lambda signal: signal(t))(self.signal)
        return [values[k] for k in range(len(self.names))]


class LagrangianParameters(ParameterTable):
    """The parameters of a Lagrangian system."""

    def modules(self):
        is_module = lambda value: isinstance(value, eqx.Module)
        return {name: value.like for name, value in self.system.parameters.items() if is_module(value)}

    @property
    def signals(self):
        each = ((driven, of_each(driven.signal, len(driven.names))) for driven in self.system.inputs)
        return {name: (x, driven.binds) for driven, alone in each for name, x in zip(driven.names, alone, strict=True)}

    def with_signals(self, signals):
        system = self.system
        inputs = _together(self.signals | _inputs_of(system, signals))
        drift_free = system.drift_free and not any(driven.binds for driven in inputs)
        same = {field.name: getattr(system, field.name) for field in dataclasses.fields(system)}
        return with_values(type(system), same | {"inputs": inputs, "drift_free": drift_free})


def _together(inputs: Mapping[str, tuple[AbstractSignal, bool]]) -> tuple[DrivenParameters, ...]:
    """Inputs by name, grouped by kind."""
    out = []
    for binds in (True, False):
        names = [name for name, signal in inputs.items() if signal[1] == binds]
        kinds = of_one_kind([inputs[name][0] for name in names])
        out += [DrivenParameters(tuple(names[k] for k in numbers), signal, binds) for numbers, signal in kinds]
    return tuple(out)


def _inputs_of(system: Any, signals: Mapping[str, AbstractSignal]) -> dict[str, tuple[AbstractSignal, bool]]:
    """Signals as inputs of a system, by name, and whether constraints depend on them.

    **Raises:** `ValueError` for a jumping value on which position constraints or rates of the coordinates depend.
    """
    q, u = system.guess.q, system.guess.u
    t = jnp.zeros((), q.dtype)
    with_number = lambda name, x: eqx.tree_at(lambda s: s.parameters[name], system, x)
    out = {}
    modules = system.parameter_table.modules()
    for name, signal in signals.items():
        if name in modules:
            raise ValueError(f"{name!r} is a module, whose weights are not a function of time.")
        number = (system.parameters[name],)
        reaches = lambda kernel, name=name, number=number: depends(lambda x: kernel(with_number(name, x)), number, 0)
        of_rates = reaches(lambda s: s.rates(t, q, u))
        if not signal.continuous and (of_rates or reaches(lambda s: s.position_residual(t, q))):
            raise ValueError(
                f"A position constraint or the rates of coordinates depend on {name!r}, so it must not jump: use "
                "interpolation='linear' or 'cubic' instead of 'held'."
            )
        out[name] = signal, of_rates or reaches(lambda s: s.acceleration_residual(t, q, u, u))
    return out
