"""Parameters of stacked parts by name, `"part.field"` and `"part.field.field"`: their arrays, checks, and inputs."""

import dataclasses
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from ..linalg.arrays import is_traced
from ..parts.base import AbstractPart
from ..parts.fields import Declaration, entry, in_range, inner_parts, paths
from ..parts.series import AbstractSignal
from ..system.catalogue import ParameterPath
from .groups import Input, together


class StackedNumber(NamedTuple):
    """A parameter in a group of stacked parts: `keys` lead to it in group number `group` of the system's field `kind`,
    `member` is the number of its part.
    """

    name: str
    kind: str
    group: int
    keys: tuple[str, ...]
    member: int
    declared: Declaration


def stacked_numbers(groups: Mapping[str, Sequence[Any]]) -> Iterator[StackedNumber]:
    """Every parameter of some groups, which are given by the name of the system's field that holds them."""
    for kind, of_kind in groups.items():
        for g, group in enumerate(of_kind):
            # Numbers of another part that these parts hold keep the name of that part.
            stacked = group.group
            sources = [((), stacked.part, stacked.names)]
            sources += [(keys, entry(stacked.part, keys), names) for keys, names in stacked.inner]
            for prefix, part, names in sources:
                own = [((*prefix, *keys), ".".join(shown), declared) for keys, shown, declared in paths(part)]
                for k, name in enumerate(names):
                    for keys, field, declared in own:
                        yield StackedNumber(f"{name}.{field}", kind, g, keys, k, declared)


def parameter_paths(
    gravity: str | None, groups: Mapping[str, Sequence[Any]], servos: Sequence[Any]
) -> dict[str, list[ParameterPath]]:
    """Paths to every parameter of a scene.

    **Arguments:** `gravity`: its name, or None; `groups` of stacked parts, by the name of the system's field that holds
    them; `servos`: groups of servos, which also have gains.
    """
    out: dict[str, list[ParameterPath]] = {}
    for number in stacked_numbers(groups):
        where = _accessor(number.kind, number.group, number.keys)
        out.setdefault(number.name, []).append((where, number.member))
    for g, group in enumerate(servos):
        for k, name in enumerate(group.group.names):
            out.setdefault(f"{name}.damping", []).append((lambda s, g=g: s.servos[g].damping, k))
            out.setdefault(f"{name}.stiffness", []).append((lambda s, g=g: s.servos[g].stiffness, k))
    if gravity is not None:
        out[f"{gravity}.acceleration"] = [(lambda s: s.gravity, None)]
    return out


def module_structures(groups: Mapping[str, Sequence[Any]]) -> dict[str, eqx.Module]:
    """The modules whose weights are parameters, by name, with shapes in place of the weights."""
    numbers = (number for number in stacked_numbers(groups) if number.declared.kind == "module")
    part = lambda number: groups[number.kind][number.group].group.part
    return {number.name: entry(part(number), number.keys[:-1]).like for number in numbers}


def positive_parameters(groups: Mapping[str, Sequence[Any]]) -> Iterator[str]:
    """Names of the parameters that parts declare to be positive, or positive definite."""
    for number in stacked_numbers(groups):
        if number.declared.sign in ("positive", "positive definite"):
            yield number.name


def _accessor(kind: str, group: int, keys: tuple[str, ...]):
    return lambda system: entry(getattr(system, kind)[group].group.part, keys)


def check_parts(groups: Iterable[Any], names: Collection[str], dimension: int) -> None:
    """Raise a `ValueError` that names the part and the field if no scene would be compiled with these numbers.

    **Arguments:** `groups` of stacked parts; `names` of the parts to check. Parts with traced numbers are left to
    `are_in_range`.
    """
    for group in groups:
        for k, name in enumerate(group.group.names):
            if name in names and not is_traced(group):
                single = jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[k], group)
                single.part(name).check(dimension)


def are_in_range(parts: Iterable[Any]) -> bool | Bool[Array, ""]:
    """Whether all numbers of some parts that are traced are as the parts declare them; True if none are traced."""
    ok: Any = True
    for own in (own for part in parts for own in (part, *(inner for _, inner in inner_parts(part)))):
        for keys, _, declared in paths(own):
            value = entry(own, keys)
            if is_traced(value):
                ok = ok & in_range(declared, value)
        agree = own.numbers_agree() if isinstance(own, AbstractPart) else True
        if is_traced(agree):
            ok = ok & jnp.all(agree)
    return ok


# Groups whose numbers bind positions, and those whose numbers bind positions, velocities or accelerations.
_BIND_POSITIONS = ("constraints",)
_BIND = (*_BIND_POSITIONS, "velocity_constraints", "servos")


def signals_of(groups: Mapping[str, Sequence[Any]]) -> dict[str, tuple[AbstractSignal, bool]]:
    """The inputs of some groups by name, and whether their rates count: in constraints, or in velocities that forces
    depend on.

    **Arguments:** `groups`, by the name of the system's field that holds them.
    """
    out: dict[str, tuple[AbstractSignal, bool]] = {}
    for kind, of_kind in groups.items():
        for own in (own for g in of_kind for each in g.group.inputs for own in each.alone()):
            (name,) = own.names
            _, counts = out.get(name, (own.signal, False))
            out[name] = own.signal, counts or kind in _BIND or own.moves
    return out


def with_signals(
    groups: Mapping[str, Sequence[Any]], signals: Mapping[str, AbstractSignal]
) -> dict[str, tuple[Any, ...]]:
    """Groups with some numbers as functions of time.

    **Raises:** `ValueError` for a number that must be constant, and for one that jumps where positions depend on it.
    """
    new: dict[tuple[str, int], list[Input]] = {}
    varying, of_frames = set(), {number.name for number in stacked_numbers({"frames": groups["frames"]})}
    laws = {joint: name for g in groups["nonideal"] for joint, name in zip(g.joints, g.group.names, strict=True)}
    for number in stacked_numbers(groups):
        signal = signals.get(number.name)
        constant = number.declared.constant or number.kind in ("bodies", "frames") or number.name in of_frames
        if signal is None or constant:
            continue
        if number.kind in _BIND_POSITIONS and not signal.continuous:
            raise ValueError(
                f"A position constraint depends on {number.name!r}, so it must not jump: use interpolation='linear' or "
                "'cubic' instead of 'held'."
            )
        part, declared = groups[number.kind][number.group].group.part, number.declared
        places = declared.is_point or declared.is_direction or declared.is_attitude
        law = laws.get(number.name.split(".")[0]) if places and number.kind == "constraints" else None
        if law is not None or not part.may_vary(number.keys):
            raise ValueError(
                f"{number.name!r} cannot be an input: {repr(law) if law else f'a {part.kind}'} takes velocities of "
                "points that are fixed in their bodies. Put the part on a body that a JointDriver moves."
            )
        varying.add(number.name)
        # All numbers of a joint place the coordinate that other parts measure.
        moves = places or number.keys[0] == "joints" or number.keys[0] in part.moving
        own = Input(signal, (number.name,), number.keys, (number.member,), moves)
        new.setdefault((number.kind, number.group), []).append(own)
    for name in signals:
        if name not in varying:
            raise ValueError(
                f"{name!r} must be constant: masses, moments of inertia, frames, gravity and the gains of servos "
                "cannot be inputs."
            )
    return {
        kind: tuple(_with_inputs(g, new.get((kind, k), ())) for k, g in enumerate(of_kind))
        for kind, of_kind in groups.items()
    }


def _with_inputs(group, inputs):
    names = {own.names for own in inputs}
    kept = (own for each in group.group.inputs for own in each.alone() if own.names not in names)
    return dataclasses.replace(group, group=dataclasses.replace(group.group, inputs=together([*kept, *inputs])))
