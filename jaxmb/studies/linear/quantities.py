"""Measurable quantities and parameters of a system as numbers: their components by name, at one state."""

from collections.abc import Iterable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._types import Scalar, State
from ...parts.names import unknown
from ...system import AbstractSystem
from ...system.quantities import Solved, component_names


def components(kind: str, names: Sequence[str], shapes: dict[str, tuple[int, ...]]) -> tuple[tuple[str, int], ...]:
    """The components with these names, each as the name of its array and its index in the raveled array; an array's
    name means all its components.

    **Raises:** `ValueError` for unknown or repeated names, and for a single text instead of a sequence.
    """
    out = []
    for name in checked_names(kind, names):
        if name in shapes:
            out += [(name, k) for k in range(int(np.prod(shapes[name], dtype=int)))]
            continue
        base = name.split("[")[0]
        names_of_array = component_names(base, shapes[base]) if base in shapes else []
        if name not in names_of_array:
            raise unknown(kind, name, names_of_array or shapes)
        out.append((base, names_of_array.index(name)))
    if len(set(out)) < len(out):
        raise ValueError(f"Every {kind} is named once, got {', '.join(names)}.")
    return tuple(out)


def checked_names(kind: str, names: Iterable[str]) -> tuple[str, ...]:
    """Names as a tuple.

    **Raises:** `ValueError` for a single text, for names that are not text, and for repeated names.
    """
    if isinstance(names, str) or not isinstance(names, Iterable):
        raise ValueError(f"Give names in a sequence, ({names!r},), even for a single {kind}.")
    names = tuple(names)
    for name in names:
        if not isinstance(name, str):
            raise ValueError(f"The name of a {kind} is text, got {name!r}.")
        if names.count(name) > 1:
            raise ValueError(f"The {kind} {name!r} is named twice.")
    return names


def measured(
    system: AbstractSystem, chosen: Sequence[tuple[str, int]], t: Scalar, state: State, solved: Solved | None
) -> Float[Array, "k"]:
    """Components of quantities at one state; `solved`: the solution of the equations there, for forces."""
    quantities = system.quantities()
    along = jnp.asarray(t, state.q.dtype)[None], jax.tree.map(lambda x: x[None], state)
    forces = jax.tree.map(lambda x: x[None], solved)
    values = {
        name: jnp.ravel(quantities[name].value(*along, forces)[0]) for name in dict.fromkeys(n for n, _ in chosen)
    }
    return jnp.stack([values[name][k] for name, k in chosen]) if chosen else jnp.zeros(0, state.q.dtype)
