"""Variants of a system whose exact motion is known."""

import dataclasses
import re
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
from ..parts.fields import field_names, paths
from ..system import AbstractSystem, parameters, with_parameters

# Powers of the length in the units of parameters.
_LENGTH = {"m": 1, "N": 1, "Pa": -1, "kg": 0, "s": 0, "1": 0}


def units(system: Any) -> dict[str, str | None]:
    """The units of all parameters by name; None where it is not declared, or a user's function gives it."""
    out: dict[str, str | None] = dict.fromkeys(parameters(system))
    for g in _groups(system):
        for _, shown, declared in paths(g.group.part):
            known, field = declared.unit, ".".join(shown)
            if " or " in known:
                known = g.group.part.unit(field, known)
            out |= {f"{name}.{field}": known or None for name in g.group.names}
    weights = system.forces.gravity_part if system.body_names else ()
    return out | {f"{weight.name}.acceleration": "m/s²" for weight in weights}


def scaled_lengths(system: Any, state: State, factor: float) -> tuple[Any, State]:
    """All lengths of a system times a factor, with masses and times as they are.

    Every parameter is scaled by its unit, so the motion is the same in units of the system's size.

    **Raises:** `ValueError` where a length may hide in a function, or a unit is not known.
    """
    if system.nz:
        raise ValueError(f"the internal states {', '.join(system.state_names())} are of no known power of a length.")
    functions = [name for g in _groups(system) if _has_function(g.group.part) for name in g.group.names]
    powers = {name: _powers(unit) for name, unit in units(system).items()}
    unknown = [*functions, *(name for name, own in powers.items() if own is None)]
    if unknown or not system.body_names:
        raise ValueError(f"the units of {', '.join(unknown[:3]) or 'a Lagrangian'} are not known")
    values = {}
    for name, value in parameters(system).items():
        own = np.array(powers[name])
        # With two units, that of translations and that of rotations.
        repeats = (1,) if own.size == 1 else (value.size - value.size // 2, value.size // 2)
        exponents = np.repeat(own, repeats) if own.size > 1 else own[0]
        values[name] = np.asarray(value) * float(factor) ** exponents
    scaled = with_parameters(system, values)
    scaled = eqx.tree_at(lambda s: s.length, scaled, system.length * factor)
    natural = lambda s: (s.coordinate_scale(), s.velocity_scale())
    own = [new / old for new, old in zip(natural(scaled), natural(system), strict=True)]
    return scaled, State(state.q * own[0], state.u * own[1])


def _powers(unit: str | None) -> tuple[float, ...] | None:
    """The power of the length in a unit, or in two of them; None where it is not known."""
    if unit is None:
        return None
    out = []
    for one in unit.replace(" (3)", "").split(", "):
        power = 0.0
        for sign, side in zip((1, -1), one.split("/"), strict=False):
            for word in side.split():
                base, _, exponent = word.replace("²", "^2").partition("^")
                if base == "rad":
                    continue
                if base not in _LENGTH or re.fullmatch(r"[\d.]*", exponent) is None:
                    return None
                power += sign * _LENGTH[base] * float(exponent or 1)
        out.append(power)
    return tuple(out)


def _has_function(part: Any) -> bool:
    values = [getattr(part, name) for name in field_names(type(part))]
    return any(_has_function(value) if isinstance(value, eqx.Module) else callable(value) for value in values)


def _groups(system: Any) -> Iterator[Any]:
    if system.body_names:
        yield from (*system.bodies.groups, *system.constraints.groups, *system.constraints.nonideal)
        yield from system.forces.groups


def doubled(system: Any, state: State, shift: float | None = None) -> AbstractSystem:
    """A scene with its first joint twice; with `shift` [m] the second has its first point off by that along each axis.

    **Raises:** `ValueError` for a scene without joints, and where the scene with both does not compile.
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
    """The first group of joints of a scene; `ValueError` where there is none."""
    if not (system.body_names and system.velocity_rows):
        raise ValueError("there are no joints of bodies")
    return system.constraints.groups[0].group


def with_constraints(system: Any, state: State, constraints: ConstraintSet) -> AbstractSystem:
    """A scene with other constraints, which starts from a state."""
    return with_structure(dataclasses.replace(system, guess=state, constraints=constraints))
