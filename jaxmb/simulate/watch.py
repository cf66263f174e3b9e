"""The tangents whose errors the steps of a run control."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .._arguments import real_array
from .._types import State, VectorLike
from ..manifold.internal_states import counted_components, natural_units, state_blocks
from ..parts.names import unknown
from ..solvers.tangent import TangentControl
from ..system import AbstractSystem
from ..system.parameters import parameters, with_parameters

# The least change of a watched parameter next to zero, in its unit.
_LEAST_CHANGE = 1e-4


class Watch(NamedTuple):
    """The watched parameters of a run that is differentiated.

    **Fields:** `changes`: values of parameters with their changes, by name, whose tangent is watched; None for all
    differentiated parameters, and empty for no tangent; `differentiated`: for each leaf of the system and the state,
    whether derivatives are taken by it; empty if unknown.
    """

    changes: dict[str, tuple[Any, Any]] | None
    differentiated: tuple[bool, ...]

    def direction(self, system: AbstractSystem, term_of: Callable[[AbstractSystem], Any]) -> Any:
        """The tangent of the term along the changes; None if they are not known yet, or there are none."""
        if self.changes:
            moved = lambda step: {name: at + step * x for name, (at, x) in (self.changes or {}).items()}
            term = lambda step: term_of(with_parameters(system, moved(step)))
            return eqx.filter_jvp(term, (0.0,), (1.0,))[1]
        if self.differentiated and self.changes is None:
            leaves, structure = jax.tree.flatten(system)
            used = jax.tree.unflatten(structure, self.differentiated[: len(leaves)])
            return pushed(term_of, system, used)
        return None

    def control(self, system: AbstractSystem, start: State, duration: Any, direction: Any) -> TangentControl | None:
        """The control of tangents, in natural units, for velocities at the rate of the `start` or one unit per
        `duration` [s], whichever is larger; None if no tangent is watched.
        """
        if self.changes == {}:
            return None
        velocities = system.velocity_scale()
        rate = jnp.maximum(
            jnp.max(jnp.abs(start.u) / velocities, initial=0.0), 1 / jnp.where(duration > 0, duration, 1.0)
        )
        units = natural_units(system, velocities * rate, start.q.dtype)
        sizes = tuple(block.size for block in state_blocks(system, rate))
        control = TangentControl(units, sizes, direction, counted=counted_components(system))
        control = lax.stop_gradient(control)
        if self.differentiated and self.changes is None:
            excites = any(self.differentiated[len(jax.tree.leaves(system)) :])
            control = dataclasses.replace(control, excites=excites)
        return control


def parameter_changes(
    system: AbstractSystem, direction: Mapping[str, VectorLike] | None
) -> dict[str, tuple[Any, Any]] | None:
    """Values of parameters and their changes, by name; None for all."""
    if direction is None:
        return None
    values = parameters(system)
    if not isinstance(direction, Mapping):
        raise ValueError(f"direction must be a dictionary of parameters by name, got {direction!r}.")
    for name in direction:
        if name not in values:
            raise unknown("parameter", name, values)
    array = lambda name, x: real_array(f"direction[{name!r}]", x, values[name].dtype, (values[name].shape,))
    return {name: (values[name], array(name, x)) for name, x in direction.items()}


def pushed(function: Callable[..., Any], at: Any, used: Any) -> Any:
    """The tangent of a function along a change of all leaves that are `used`; None if none is.

    Each leaf changes by about its size, or about one if it is zero, with random signs that are the same in every call.
    """
    random = np.random.default_rng(0)

    def change(x, is_used):
        if not (is_used and eqx.is_inexact_array(x)):
            return None
        signs = random.choice([-1.0, 1.0], x.shape) * random.uniform(0.5, 1.0, x.shape)
        # A bound may be infinite.
        finite = jnp.isfinite(x)
        size = jnp.max(jnp.where(finite, jnp.abs(x), 0.0), initial=0.0)
        size = jnp.where(size > 0, jnp.maximum(size, _LEAST_CHANGE), 1.0)
        return jnp.where(finite, size * jnp.asarray(signs, x.dtype), 0.0)

    along = jax.tree.map(change, at, used, is_leaf=lambda x: x is None)
    if not jax.tree.leaves(along):
        return None
    return lax.stop_gradient(eqx.filter_jvp(function, (at,), (along,))[1])
