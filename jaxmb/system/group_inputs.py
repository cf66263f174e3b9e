"""Numbers of stacked parts as functions of time."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from ..parts.series import AbstractSignal
from .groups import Input
from .parameter_paths import stacked_numbers

# Groups whose numbers bind positions, and those whose numbers bind positions, velocities or accelerations.
_BIND_POSITIONS = ("constraints",)
_BIND = (*_BIND_POSITIONS, "velocity_constraints", "servos")


def signals_of(groups: Mapping[str, Sequence[Any]]) -> dict[str, tuple[AbstractSignal, bool]]:
    """The inputs of some groups by name, and whether constraints depend on them.

    **Arguments:** `groups`, by the name of the system's field that holds them.
    """
    return {
        own.name: (own.signal, kind in _BIND)
        for kind, of_kind in groups.items()
        for g in of_kind
        for own in g.group.inputs
    }


def with_signals(
    groups: Mapping[str, Sequence[Any]], signals: Mapping[str, AbstractSignal]
) -> dict[str, tuple[Any, ...]]:
    """Groups with some numbers as functions of time.

    **Raises:** `ValueError` for a number that must be constant, and for one that jumps where positions depend on it.
    """
    new: dict[tuple[str, int], list[Input]] = {}
    varying, of_frames = set(), {number.name for number in stacked_numbers({"frames": groups["frames"]})}
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
        varying.add(number.name)
        own = Input(signal, number.name, number.keys, number.member)
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
    names = {own.name for own in inputs}
    kept = (own for own in group.group.inputs if own.name not in names)
    return dataclasses.replace(group, group=dataclasses.replace(group.group, inputs=(*kept, *inputs)))
