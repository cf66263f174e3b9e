"""Whether closed contacts of a scene imply each other, so that they share forces."""

from typing import Any

import numpy as np
from jaxtyping import Float

# Unit rows whose singular values are below this imply each other.
_INDEPENDENT = 1e-6
# Gaps below this fraction of the scene's size are closed.
_CLOSED = 1e-6


def imply_each_other(system: Any, q: Float[np.ndarray, "nq"]) -> bool:
    """Whether contacts between the same bodies, or contacts that are closed at q, imply each other if all are closed.

    Others that could be closed together are not looked for: of many balls most pairs never are. Nor are large scenes.
    """
    contacts, on_host = system.contacts, system.on_host(0.0)
    if on_host is None:
        return False
    bound = np.asarray(contacts.bound(q))
    rows = on_host.jacobian(bound) * system.known_scales()[1]
    rows = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), np.finfo(rows.dtype).tiny)
    of_contacts, others = np.array(contacts.rows[: contacts.n]), np.delete(rows, contacts.rows, axis=0)
    closed = np.abs(on_host.residual(bound)[of_contacts]) <= _CLOSED * float(system.length)
    # A disc inside a box has no normal.
    normals, has_normal = rows[of_contacts], np.all(np.isfinite(rows[of_contacts]), axis=1)
    candidates = (np.array(numbers)[has_normal[numbers]] for numbers in [np.flatnonzero(closed), *_pairs(system)])
    return any(_dependent(normals[numbers], others) for numbers in candidates)


def _pairs(system) -> list[list[int]]:
    """The numbers of the contacts between the same bodies."""
    # The last body of a contact is its mode.
    parts = [frozenset(bodies[:-1]) for g in system.constraints.contacts for bodies in g.group.bodies]
    of_pairs = {pair: [k for k, other in enumerate(parts) if other == pair] for pair in parts}
    return list(of_pairs.values())


def _dependent(normals, others) -> bool:
    """Whether contacts with these rows imply each other, beside the other rows."""
    # Of two that push against each other only one is closed.
    back = [np.any(np.linalg.norm(normals[:k] + normals[k], axis=1) < _INDEPENDENT) for k in range(len(normals))]
    normals = normals[~np.array(back, bool)]
    return len(normals) > 1 and _rank(np.concatenate([others, normals])) < _rank(others) + len(normals)


def _rank(rows) -> int:
    return int(np.linalg.matrix_rank(rows, tol=_INDEPENDENT)) if len(rows) else 0
