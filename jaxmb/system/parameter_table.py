"""The numbers of a system by name: their ranges, and the functions of time among them."""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from ..linalg.arrays import is_traced
from ..parts.series import AbstractSignal
from .design_variables import variables_in_range
from .structures import of_structure

# An accessor of an array of the system, and the parameter's index along axis 0 of stacked parts, else None.
ParameterPath = tuple[Callable[[Any], Array], int | None]


# Not a module: methods of modules take many times as long to call.
@dataclasses.dataclass(frozen=True)
class ParameterTable:
    """The parameters of a system: their ranges, and the functions of time among them."""

    system: Any

    def modules(self) -> dict[str, eqx.Module]:
        """Modules whose weights are parameters, with shapes in place of the weights."""
        return {}

    def positive(self) -> frozenset[str]:
        """Names of parameters that must stay positive or, as matrices, positive definite."""
        return frozenset()

    def check(self, names: Collection[str]) -> None:
        """Raise a `ValueError` for parameters out of range; `in_range` checks traced values."""
        for name in self.positive() & set(names):
            value = self._value(name)
            if not is_traced(value) and not np.all(np.asarray(value) > 0):
                raise ValueError(f"Parameter {name!r} must be positive, got {np.asarray(value)}.")

    def in_range(self) -> bool | Bool[Array, ""]:
        """Whether all traced parameters are in their ranges; True without traced parameters."""
        values = [self._value(name) for name in sorted(self.positive())]
        traced = [jnp.all(value > 0) for value in values if is_traced(value)]
        return (jnp.all(jnp.stack(traced)) if traced else True) & variables_in_range(self.system.design)

    def _value(self, name):
        where, index = self.system.parameter_paths()[name][0]
        return where(self.system) if index is None else where(self.system)[index]

    def with_frames_of(self, before: Any) -> Any:
        """The system with its bodies' frames at their places in the system `before`."""
        del before
        return self.system

    def with_size(self, before: Any, names: Collection[str]) -> Any:
        """The system after a change of some parameters of the system `before`, with the scale of its lengths."""
        del before, names
        return self.system

    @property
    def signals(self) -> dict[str, tuple[AbstractSignal, bool]]:
        """The parameters that are functions of time, each with whether its rate counts."""
        return {}

    @of_structure
    def input_names(self) -> dict[str, None]:
        """Names of the parameters that are functions of time."""
        return dict.fromkeys(self.signals)

    def with_signals(self, signals: Mapping[str, AbstractSignal]) -> Any:
        """The system with some parameters as functions of time, of checked shapes.

        **Raises:** `ValueError` for parameters that must be constant.
        """
        raise ValueError(f"{type(self.system).__name__} takes no inputs; got {', '.join(signals)}.")
