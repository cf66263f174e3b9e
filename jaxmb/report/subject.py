"""Subjects of reports: a mechanism of the library, or a user's system and state."""

import dataclasses
from typing import Any

import equinox as eqx

from .._types import State
from ..mechanisms import Mechanism
from ..mechanisms.observe import Observation, columns
from ..system import AbstractSystem
from ..trajectory import Trajectory


def subject(system: AbstractSystem | Mechanism, state: State | None = None, t1: float | None = None) -> Mechanism:
    """The motion of a report. Every parameter counts separately, so a system loses its design variables.

    **Arguments:** a compiled system, a state of it and the end `t1` [s] of the motion; or a mechanism, perhaps with
    another end `t1`.

    **Raises:** `ValueError` for a missing or superfluous argument.
    """
    if isinstance(system, AbstractSystem):
        if state is None or t1 is None:
            raise ValueError(
                "A report on a system needs a state, from jaxmb.assemble, and t1=, the end of the motion [s]."
            )
        return Mechanism("scene", None, _alone(system), state, 0.0, None, natural_coordinates, "").until(t1)
    mechanism: Any = system
    if not hasattr(mechanism, "references") or state is not None:
        raise ValueError(
            "A report needs a compiled system and a state, from scene.compile() and jaxmb.assemble, or a mechanism of "
            f"the library alone; got {type(system).__name__}{'' if state is None else ' and a state'}."
        )
    mechanism = dataclasses.replace(mechanism, system=_alone(mechanism.system))
    return mechanism if t1 is None else mechanism.until(t1)


def _alone(system: Any) -> Any:
    return eqx.tree_at(lambda s: s.design, system, ()) if system.design else system


def natural_coordinates(trajectory: Trajectory) -> Observation:
    """All coordinates and velocities in units of the system's size, or radians, and seconds."""
    system, ys = trajectory.system, trajectory.ys
    q, u = ys.q / system.coordinate_scale()[None], ys.u / system.velocity_scale()[None]
    names = lambda letter, values: (f"{letter}{k}" for k in range(values.shape[1]))
    return columns(names("q", q), q) | columns(names("u", u), u)
