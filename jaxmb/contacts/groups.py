"""Groups of contacts and dry friction that act on each other in an event.

Contacts act on each other by the influence matrix, `A M⁻¹ Aᵀ` under the other constraints, and not by a common moment.
Each group has its own energy balance, and its own time.

Contacts that stay closed, and friction that stays stuck, hold bodies as joints do: they are constraints for the others.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..linalg.complementarity import independent_components, reduced
from ..system.contact_set import ContactSet
from .tolerance import REST

# The group of laws that hold bodies throughout an event.
HOLDS = -1


def groups_of(
    contacts: ContactSet, influence: Float[Array, "laws laws"], acting: Bool[Array, "laws"], stays: Bool[Array, "laws"]
) -> Int[Array, "laws"] | None:
    """The group of each law: the number of its first law. None if there can be one group only.

    **Arguments:** laws that are `acting` in the event; those of them that `stays` closed, or stuck, throughout.
    """
    if not contacts.in_groups:
        return None
    influence, acting = lax.stop_gradient((influence, acting))
    linked = contacts.linked
    # A contact with friction that slips is no joint.
    holds = acting & stays & ~jnp.any(linked & ~stays[None, :], axis=1)
    between = reduced(influence, independent_components(influence, holds))
    size, sizes = jnp.diag(between), jnp.diag(influence)
    acts = acting & ~holds & (size > REST * sizes)
    size = jnp.sqrt(jnp.where(acts, size, 0.0))
    near = (jnp.abs(between) > REST * size[:, None] * size[None, :]) & acts[:, None] & acts[None, :]
    near = near | linked
    for _ in range(int(size.size - 1).bit_length()):
        near = near.astype(influence.dtype) @ near.astype(influence.dtype) > 0
    return jnp.where(holds, HOLDS, jnp.argmax(near, axis=1))


def least_in_group(
    group: Int[Array, "laws"] | None, which: Bool[Array, "laws"], values: Float[Array, "laws"]
) -> tuple[Int[Array, "*laws"], Bool[Array, "*laws"]]:
    """The law with the least value in each law's group, among those `which` have one, and whether there is one."""
    values = jnp.where(which, values, jnp.inf)
    if group is None:
        return jnp.argmin(values), jnp.any(which)
    same = _same(group)
    return jnp.argmin(jnp.where(same, values[None, :], jnp.inf), axis=1), jnp.any(same & which[None, :], axis=1)


def group_sums(group: Int[Array, "laws"] | None, values: Float[Array, "laws"]) -> Float[Array, "*laws"]:
    """The sum over each law's group."""
    return jnp.sum(values) if group is None else jnp.sum(jnp.where(_same(group), values[None, :], 0.0), axis=1)


def _same(group):
    return group[:, None] == group[None, :]


def of_contacts(values: Float[Array, "*laws"], n: int) -> Float[Array, "*contacts"]:
    """Values of groups for the first `n` laws, the contacts; the value if there is one group."""
    return values[:n] if jnp.ndim(values) else values
