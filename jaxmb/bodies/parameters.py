"""Parameters of stacked parts by name, `"part.field"` or `"part.field.key"`: their arrays, checks and inputs."""

import dataclasses
import functools
import itertools
from collections.abc import Iterator, Mapping, Sequence
from operator import attrgetter
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..linalg.arrays import is_traced
from ..parts.base import AbstractPart
from ..parts.fields import Declaration, entry, in_range, inner_parts, paths, warn_of_angles
from ..parts.series import AbstractSignal
from ..system.design_variables import variables_in_range
from ..system.parameter_table import ParameterTable
from ..system.structures import of_structure
from .groups import BIND, BIND_POSITIONS, Input, groups_by_path, together

# The factor by which the size of a scene must change to count as another size.
_OTHER_SIZE = 10.0


class StackedNumber(NamedTuple):
    """A parameter in a group of stacked parts.

    **Fields:** `name`; the `path` of the groups in the system; `group`: the index of the group; `keys` that lead to the
    parameter in a part; `member`: the index of the part; the field as `declared`.
    """

    name: str
    path: str
    group: int
    keys: tuple[str, ...]
    member: int
    declared: Declaration


def stacked_numbers(groups: Mapping[str, Sequence[Any]]) -> Iterator[StackedNumber]:
    """Every parameter of groups, given by their paths."""
    for path, of_path in groups.items():
        for g, group in enumerate(of_path):
            # Numbers of an inner part have the inner part's name.
            stacked = group.group
            sources = [((), stacked.part, stacked.names)]
            sources += [(keys, entry(stacked.part, keys), names) for keys, names in stacked.inner]
            for prefix, part, names in sources:
                numbers = [((*prefix, *keys), ".".join(shown), declared) for keys, shown, declared in paths(part)]
                for k, name in enumerate(names):
                    for keys, field, declared in numbers:
                        yield StackedNumber(f"{name}.{field}", path, g, keys, k, declared)


class SceneParameters(ParameterTable):
    """The parameters of a compiled scene, `"part.field"`."""

    @property
    def _groups(self) -> dict[str, tuple[Any, ...]]:
        return groups_by_path(self.system)

    @property
    def _all_groups(self) -> Iterator[Any]:
        return itertools.chain(*self._groups.values())

    @of_structure
    def paths(self):
        forces, out = self.system.forces, {}
        for number in stacked_numbers(self._groups):
            where = _accessor(number.path, number.group, number.keys)
            out.setdefault(number.name, []).append((where, number.member))
        for g, group in enumerate(self.system.constraints.servos):
            for k, name in enumerate(group.group.names):
                for gain in ("damping", "stiffness"):
                    where = lambda s, g=g, gain=gain: getattr(s.constraints.servos[g], gain)
                    out.setdefault(f"{name}.{gain}", []).append((where, k))
        if forces.gravity is not None:
            out[f"{forces.gravity_name}.acceleration"] = [(lambda s: s.forces.gravity, None)]
        return out

    def modules(self):
        groups = self._groups
        numbers = (number for number in stacked_numbers(groups) if number.declared.kind == "module")
        part = lambda number: groups[number.path][number.group].group.part
        return {number.name: entry(part(number), number.keys[:-1]).like for number in numbers}

    def positive(self):
        signs = ("positive", "positive definite")
        return frozenset(number.name for number in stacked_numbers(self._groups) if number.declared.sign in signs)

    def check(self, names):
        parts, dimension = {name.split(".")[0] for name in names}, self.system.layout.space.dimension
        for gravity in self.system.forces.gravity_part:
            if gravity.name in parts and not is_traced(gravity):
                gravity.check(dimension)
        for group in self._all_groups:
            for k, name in enumerate(group.group.names):
                if name in parts and not is_traced(group):
                    single = jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[k], group)
                    part = single.part(name)
                    part.check(dimension)
                    fields = {other.partition(".")[2] for other in names if other.split(".")[0] == name}
                    warn_of_angles(part, part, fields, stacklevel=3)

    def in_range(self):
        ok: Any = True
        outer = [*self.system.forces.gravity_part, *(group.part() for group in self._all_groups)]
        inner = [part for part_of in outer for _, part in inner_parts(part_of)]
        for part in (*outer, *inner):
            for keys, _, declared in paths(part):
                value = entry(part, keys)
                if is_traced(value):
                    ok = ok & in_range(declared, value)
            agree = part.numbers_agree() if isinstance(part, AbstractPart) else True
            if is_traced(agree):
                ok = ok & jnp.all(agree)
        return ok & variables_in_range(self.system.design)

    def with_frames_of(self, before):
        pairs = zip(self.system.bodies.groups, before.bodies.groups, strict=True)
        moved = [(group, group.group.part.mass_centre, old.group.part.mass_centre) for group, old in pairs]
        changed = [(group, new - old) for group, new, old in moved if new is not None and new is not old]
        if not changed:
            return self.system
        return dataclasses.replace(self.system, guess=self.system.bodies.shifted(self.system.guess, changed))

    @of_structure
    def _sized(self):
        """The places of the lengths that determine the scene's size, by name."""
        numbers = (number for number in stacked_numbers(self._groups) if number.declared.sizes)
        return {number.name: (number.path, number.group, number.keys) for number in numbers}

    def with_size(self, before, names):
        system, sized = self.system, self._sized()
        if not any(name in sized for name in names):
            return system
        places = tuple(dict.fromkeys(sized.values()))
        of = lambda system: [x for place in places if (x := _accessor(*place)(system)) is not None]
        length, old, new = lax.stop_gradient((system.length, of(before), of(system)))
        xp = jnp if is_traced((length, old, new)) else np
        largest = lambda values: functools.reduce(
            xp.maximum, (xp.max(xp.abs(xp.asarray(x)), initial=0.0) for x in values)
        )
        length = xp.asarray(length)
        old, new = largest(old).astype(length.dtype), largest(new).astype(length.dtype)
        # A size that stays about the same keeps the tolerances of a family of designs. Lengths that are much smaller
        # than the scene, or zero, have not determined its size.
        smaller = (new > 0) & (_OTHER_SIZE * new < length) & (_OTHER_SIZE * old >= length)
        length = xp.where((new > _OTHER_SIZE * length) | smaller, new, length)
        return eqx.tree_at(lambda s: s.length, system, length if xp is jnp else jax.device_put(length))

    @property
    def signals(self):
        # Rates of inputs count in constraints, and in velocities that forces depend on.
        out: dict[str, tuple[AbstractSignal, bool]] = {}
        for path, groups in self._groups.items():
            for single in (single for g in groups for driven in g.group.inputs for single in driven.alone()):
                (name,) = single.names
                _, counts = out.get(name, (single.signal, False))
                out[name] = single.signal, counts or path in BIND or single.moves
        return out

    def with_signals(self, signals):
        system, groups = self.system, self._groups
        inputs = _inputs(groups, signals)
        new = {
            path: tuple(_with_inputs(g, inputs.get((path, k), ())) for k, g in enumerate(of_path))
            for path, of_path in groups.items()
            if of_path
        }
        return eqx.tree_at(lambda s: [attrgetter(path)(s) for path in new], system, list(new.values()))


def _accessor(path: str, group: int, keys: tuple[str, ...]):
    return lambda system: entry(attrgetter(path)(system)[group].group.part, keys)


def _inputs(
    groups: Mapping[str, Sequence[Any]], signals: Mapping[str, AbstractSignal]
) -> dict[tuple[str, int], list[Input]]:
    """Parameters that are functions of time, by the path and the index of their group.

    **Raises:** `ValueError` for a parameter that must be constant, and for a jump in a position constraint.
    """
    new: dict[tuple[str, int], list[Input]] = {}
    varying, of_frames = set(), {number.name for number in stacked_numbers({"frames": groups["frames"]})}
    nonideal = groups["constraints.nonideal"]
    laws = {joint: name for g in nonideal for joint, name in zip(g.joints, g.group.names, strict=True)}
    for number in stacked_numbers(groups):
        signal = signals.get(number.name)
        constant = number.declared.constant or number.path in ("bodies.groups", "frames") or number.name in of_frames
        if signal is None or constant:
            continue
        if number.path == BIND_POSITIONS and not signal.continuous:
            raise ValueError(
                f"A position constraint depends on {number.name!r}, so it must not jump: use interpolation='linear' or "
                "'cubic' instead of 'held'."
            )
        part, declared = groups[number.path][number.group].group.part, number.declared
        places = declared.is_point or declared.is_direction or declared.is_attitude
        law = laws.get(number.name.split(".")[0]) if places and number.path == BIND_POSITIONS else None
        if law is not None or not part.may_vary(number.keys):
            raise ValueError(
                f"{number.name!r} cannot be an input: {repr(law) if law else f'a {part.kind}'} takes velocities of "
                "points that are fixed in their bodies. Put the part on a body that a JointDriver moves."
            )
        varying.add(number.name)
        # Every number of a joint moves the coordinate that other parts measure.
        moves = places or number.keys[0] == "joints" or number.keys[0] in part.moving
        driven = Input(signal, (number.name,), number.keys, (number.member,), moves)
        new.setdefault((number.path, number.group), []).append(driven)
    for name in signals:
        if name not in varying:
            raise ValueError(
                f"{name!r} must be constant: masses, moments of inertia, frames, gravity, the gains of servos, "
                "restitution, speeds of belts and friction of ropes cannot be inputs. For a change at a time, end the "
                "run there, change the number by with_parameters, and simulate on from the end."
            )
    return new


def _with_inputs(group, inputs):
    names = {single.names for single in inputs}
    kept = (single for driven in group.group.inputs for single in driven.alone() if single.names not in names)
    return dataclasses.replace(group, group=dataclasses.replace(group.group, inputs=together([*kept, *inputs])))
