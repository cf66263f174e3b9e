"""Parameters of a Lagrangian system that are functions of time."""

from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp

from ..parts.series import AbstractSignal
from .dataflow import depends
from .model import AbstractLagrangian, DrivenParameter


def inputs_of(system: AbstractLagrangian, signals: Mapping[str, AbstractSignal]) -> dict[str, DrivenParameter]:
    """Signals as inputs of a system, by name.

    **Raises:** `ValueError` for a value that jumps and that position constraints or rates of the coordinates depend on.
    """
    q, u = system.guess.q, system.guess.u
    t = jnp.zeros((), q.dtype)
    with_number = lambda name, x: eqx.tree_at(lambda s: s.parameters[name], system, x)
    out = {}
    for name, signal in signals.items():
        number = (system.parameters[name],)
        reaches = lambda kernel, name=name, number=number: depends(lambda x: kernel(with_number(name, x)), number, 0)
        of_rates = reaches(lambda s: s.rates(t, q, u))
        if not signal.continuous and (of_rates or reaches(lambda s: s.position_residual(t, q))):
            raise ValueError(
                f"A position constraint or the rates of coordinates depend on {name!r}, so it must not jump: use "
                "interpolation='linear' or 'cubic' instead of 'held'."
            )
        out[name] = DrivenParameter(signal, of_rates or reaches(lambda s: s.acceleration_residual(t, q, u, u)))
    return out
