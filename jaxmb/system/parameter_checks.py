"""Checks of the parameters of a compiled scene against the declarations of its parts."""

from collections.abc import Collection, Iterable
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Bool

from ..linalg.arrays import is_traced
from ..parts.checks import in_range
from ..parts.contents import entry, inner_parts, paths
from ..parts.servo import Servo


def check_parts(groups: Iterable[Any], names: Collection[str], dimension: int) -> None:
    """Raise a `ValueError` that names the part and the field if no scene would be compiled with these numbers.

    **Arguments:** `groups` of stacked parts; `names` of the parts to check. Parts with traced numbers are left to
    `are_in_range`.
    """
    for group in groups:
        for k, name in enumerate(group.group.names):
            if name in names and not is_traced(group):
                single = jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[k], group)
                stacked_part(single, name).check(dimension)


def stacked_part(group: Any, name: str = "") -> Any:
    """The part of a group, with a leading axis on every number unless it is a group of one without the axis."""
    part = group.group.part.named(name)
    return Servo(part, group.damping, group.stiffness) if hasattr(group, "damping") else part


def are_in_range(parts: Iterable[Any]) -> bool | Bool[Array, ""]:
    """Whether all numbers of some parts that are traced are as the parts declare them; True if none are traced."""
    ok: Any = True
    for own in (own for part in parts for own in (part, *(inner for _, inner in inner_parts(part)))):
        for keys, _, declared in paths(own):
            value = entry(own, keys)
            if is_traced(value):
                ok = ok & in_range(declared, value)
    return ok
