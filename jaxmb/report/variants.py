"""Variants of a system whose exact motion is known."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._types import State
from ..bodies.constraint_set import ConstraintSet
from ..bodies.groups import Group
from ..bodies.structure import with_structure
from ..parts.base import AbstractConstraint
from ..parts.fields import Declaration, field_names, paths
from ..parts.units import power_of_length
from ..system import AbstractSystem, parameters, with_parameters


def units(system: Any) -> dict[str, str | None]:
    """The units of all parameters by name, `"N/m, N m/rad"` for components with different units; None for a unit that
    is undeclared, or defined by a user's function.
    """
    out: dict[str, str | None] = dict.fromkeys(parameters(system))
    for g in _groups(system):
        for _, shown, declared in paths(g.group.part):
            field = ".".join(shown)
            out |= dict.fromkeys((f"{name}.{field}" for name in g.group.names), _unit(g.group.part, field, declared))
    weights = system.forces.gravity_part if system.body_names else ()
    return out | {f"{weight.name}.acceleration": "m/s²" for weight in weights}


def _unit(part: Any, field: str, declared: Declaration) -> str | None:
    if not isinstance(declared.unit, tuple):
        return declared.unit
    (of_angle, of_length), which = declared.unit, part.is_of_length(field)
    return None if which is None else ", ".join(np.ravel(np.where(which, of_length, of_angle)))


def scaled_lengths(system: Any, state: State, factor: float) -> tuple[Any, State]:
    """All lengths of a system times a factor, with unchanged masses and times.

    Every parameter is scaled by its unit, so the motion is the same in units of the system's size.

    **Raises:** `ValueError` if a length may hide in a function, or a unit is unknown.
    """
    if system.nz:
        raise ValueError(f"the internal states {', '.join(system.state_names())} have an unknown power of length.")
    functions = [name for g in _groups(system) if _has_function(g.group.part) for name in g.group.names]
    declared = units(system)
    unknown = [*functions, *(name for name, unit in declared.items() if unit is None)]
    if unknown or not system.body_names:
        raise ValueError(f"the units of {', '.join(unknown[:3]) or 'a Lagrangian'} are not known")
    values = {}
    for name, value in parameters(system).items():
        exponents = np.array([power_of_length(unit) for unit in (declared[name] or "").split(", ")])
        values[name] = np.asarray(value) * float(factor) ** np.squeeze(exponents)
    scaled = with_parameters(system, values)
    scaled = eqx.tree_at(lambda s: s.length, scaled, system.length * factor)
    natural = lambda s: (s.coordinate_scale(), s.velocity_scale())
    factors = [new / old for new, old in zip(natural(scaled), natural(system), strict=True)]
    return scaled, State(state.q * factors[0], state.u * factors[1])


def _has_function(part: Any) -> bool:
    values = [getattr(part, name) for name in field_names(type(part))]
    return any(_has_function(value) if isinstance(value, eqx.Module) else callable(value) for value in values)


def _groups(system: Any) -> Iterator[Any]:
    if system.body_names:
        yield from (*system.bodies.groups, *system.constraints.groups, *system.constraints.nonideal)
        yield from system.forces.groups


def doubled(system: Any, state: State, shift: float | None = None) -> AbstractSystem:
    """A scene with its first joint twice; `shift` [m] moves the second joint's first point along each axis.

    **Raises:** `ValueError` for a scene without joints, and if the scene with both joints does not compile.
    """
    joint = first_joint(system)
    kind = "position" if isinstance(joint.part, AbstractConstraint) else "velocity"
    part = jax.tree.map(lambda x: x[:1], joint.part)
    if shift is not None:
        part = eqx.tree_at(lambda p: p.point_a, part, part.point_a + shift)
    both = jax.tree.map(lambda x, y: jnp.concatenate([x, y]), joint.part, part)
    names, bodies = (*joint.names, f"{joint.names[0]} again"), (*joint.bodies, joint.bodies[0])
    groups = getattr(system.constraints, kind)
    first = dataclasses.replace(groups[0], group=Group(both, names, bodies, joint.layout))
    return with_constraints(system, state, dataclasses.replace(system.constraints, **{kind: (first, *groups[1:])}))


def first_joint(system: Any) -> Group:
    """The first group of joints of a scene; `ValueError` without one."""
    if not (system.body_names and system.velocity_rows):
        raise ValueError("there are no joints of bodies")
    return system.constraints.groups[0].group


def with_constraints(system: Any, state: State, constraints: ConstraintSet) -> AbstractSystem:
    """A scene with other constraints, which starts from a state."""
    return with_structure(dataclasses.replace(system, guess=state, constraints=constraints))
