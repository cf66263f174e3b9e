"""Finite element models, whose nodes have displacements alone, as arrays of an elastic body, in NumPy and SciPy."""

from collections.abc import Mapping
from os import PathLike
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse
from jaxtyping import Float

# Errors of symmetry and of rigid motions in given matrices, relative to their largest entries.
_SAME = 1e-6
# The stiffness of a combination of modes, relative to the largest, below which it is a rigid motion.
_RIGID = 1e-12


class Model(NamedTuple):
    """A checked model: a `label` for messages, `nodes` (n, d), `mass` (n, n), `stiffness` (n d, n d); `modes`, perhaps
    None.
    """

    label: str
    nodes: Float[np.ndarray, "n d"]
    mass: Any
    stiffness: Any
    modes: np.ndarray | None


def reduced(
    label: str,
    dimension: int,
    source: Mapping[str, Any] | str | PathLike[str],
    interfaces: Mapping[str, Any],
    fixed: int,
) -> tuple[dict[str, np.ndarray], dict[str, dict[str, np.ndarray]]]:
    """The arrays of an elastic body, and those of a frame at each interface, by name."""
    model = _model(label, dimension, source)
    ends = {name: _interface(model, name, nodes) for name, nodes in interfaces.items()}
    means = [mean for _, mean in ends.values()]
    modes = _craig_bampton(model, means, fixed) if model.modes is None else model.modes
    stiffness = modes.T @ (model.stiffness @ modes)
    stiffness = 0.5 * (stiffness + stiffness.T)
    _check_stiffness(model, modes, stiffness)
    d = dimension
    frames = {
        name: {"position": centre, "shapes": mean[:d] @ modes, "turning": mean[d:] @ modes}
        for name, (centre, mean) in ends.items()
    }
    return _integrals(model, modes) | {"stiffness": stiffness}, frames


def _check_stiffness(model, modes, stiffness):
    """Refuse modes with combinations that have no stiffness."""
    own = np.diag(stiffness)
    soft = own < _RIGID * abs(model.stiffness).max() * np.sum(modes**2, axis=0)
    if not np.any(soft):
        values, vectors = np.linalg.eigh(stiffness / np.sqrt(np.outer(own, own)))
        soft = np.abs(vectors[:, 0]) > 1e-3 if values[0] < _RIGID else soft
    if np.any(soft):
        named = ", ".join(f"mode_{k + 1}" for k in np.flatnonzero(soft))
        raise ValueError(
            f"{model.label}: {named} contain a rigid motion, or depend on each other; leave out such modes."
        )


def _model(label, d, source):
    arrays = source if isinstance(source, Mapping) else dict(np.load(source))
    for key in ("nodes", "mass", "stiffness"):
        if key not in arrays:
            raise ValueError(f"{label}: the model needs {key!r}, and has {', '.join(map(repr, arrays))}.")
    nodes = np.asarray(arrays["nodes"], float)
    if nodes.ndim != 2 or nodes.shape[1] != d:
        raise ValueError(f"{label}: nodes must have shape (n, {d}), got {nodes.shape}.")
    n, mass = len(nodes), arrays["mass"]
    mass = scipy.sparse.csr_array(np.diag(mass) if np.ndim(mass) == 1 else mass)
    stiffness = scipy.sparse.csr_array(arrays["stiffness"])
    for key, matrix, size in (("mass", mass, n), ("stiffness", stiffness, n * d)):
        if matrix.shape != (size, size):
            raise ValueError(f"{label}: {key} must have shape {(size, size)}, got {matrix.shape}.")
        if abs(matrix - matrix.T).max() > _SAME * abs(matrix).max():
            raise ValueError(f"{label}: {key} must be symmetric; use (A + A.T) / 2.")
    if np.min(mass.diagonal()) <= 0 or np.min(stiffness.diagonal()) <= 0:
        raise ValueError(f"{label}: mass and stiffness must be positive, and have entries ≤ 0 on their diagonals.")
    rigid = _rigid(nodes, nodes.mean(axis=0))
    if abs(stiffness @ rigid).max() > _SAME * abs(stiffness).max() * abs(rigid).max():
        raise ValueError(
            f"{label}: stiffness resists rigid motions; give the matrix of the free body, and clamp frames."
        )
    modes = arrays.get("modes")
    if modes is not None:
        modes = np.asarray(modes, float).reshape(n * d, -1)
        _check_count(label, modes.shape[1], n * d)
    return Model(label, nodes, mass, stiffness, modes)


def _check_count(label, count, most):
    if not 0 < count <= most:
        raise ValueError(f"{label}: {count} modes, and there must be from 1 to {most}.")


def _rigid(nodes, centre):
    """Displacements of the nodes by unit motions of a frame at a centre, (n d, 3 or 6)."""
    arms, d = nodes - centre, nodes.shape[1]
    if d == 2:
        turns = np.stack([-arms[:, 1], arms[:, 0]], axis=1)[:, :, None]
    else:
        turns = np.stack([np.cross(axis, arms) for axis in np.eye(3)], axis=2)
    shifts = np.broadcast_to(np.eye(d), (len(nodes), d, d))
    return np.concatenate([shifts, turns], axis=2).reshape(nodes.size, -1)


def _interface(model, name, index):
    """The centre of an interface, and its mean displacement and rotation by the displacements of all nodes."""
    index, (n, d) = np.unique(np.asarray(index)), model.nodes.shape
    if index.dtype.kind not in "iu" or not index.size or np.min(index) < 0 or np.max(index) >= n:
        raise ValueError(f"{model.label}: the interface {name!r} must have indices of nodes, from 0 to {n - 1}.")
    own = model.nodes[index]
    centre = own.mean(axis=0)
    motions = _rigid(own, centre)
    if np.linalg.matrix_rank(motions, tol=1e-9 * np.ptp(model.nodes)) < motions.shape[1]:
        raise ValueError(
            f"{model.label}: the nodes of the interface {name!r} lie in a line or a point, and cannot turn."
        )
    out = np.zeros((motions.shape[1], n, d))
    out[:, index] = np.linalg.pinv(motions).reshape(-1, len(index), d)
    return centre, out.reshape(-1, n * d)


def _craig_bampton(model, means, fixed):
    """Constraint modes of all interfaces but the first, and vibrations with fixed interfaces, made orthogonal."""
    label, stiffness, d = model.label, model.stiffness.toarray(), model.nodes.shape[1]
    mass = scipy.sparse.kron(model.mass, np.eye(d)).toarray()
    if not means:
        raise ValueError(f"{label}: name an interface, with which the frame of the body moves, or give modes.")
    held, first = np.concatenate(means), len(means[0])
    free = len(stiffness) - len(held)
    if not 0 <= fixed <= free:
        raise ValueError(
            f"{label}: fixed must be from 0 to {free}, the displacements that interfaces leave, got {fixed}."
        )
    _check_count(label, len(held) - first + fixed, len(stiffness))
    size = np.max(np.abs(stiffness))
    system = np.block([[stiffness / size, held.T], [held, np.zeros((len(held),) * 2)]])
    moved = np.concatenate([np.zeros_like(stiffness[:, : len(held)]), np.eye(len(held))])[:, first:]
    modes = np.linalg.solve(system, moved)[: len(stiffness)]
    if fixed:
        kept = scipy.linalg.null_space(held)
        matrices = [kept.T @ matrix @ kept for matrix in (stiffness, mass)]
        modes = np.concatenate([modes, kept @ scipy.linalg.eigh(*matrices, subset_by_index=[0, fixed - 1])[1]], axis=1)
    modes = modes @ scipy.linalg.eigh(*(modes.T @ matrix @ modes for matrix in (stiffness, mass)))[1]
    largest = np.take_along_axis(modes, np.argmax(np.abs(modes), axis=0)[None], axis=0)
    reach = np.max(np.linalg.norm(modes.reshape(-1, d, modes.shape[1]), axis=1), axis=0)
    return modes * np.sign(largest) / reach


def _integrals(model, modes):
    nodes, mass, (n, d) = model.nodes, model.mass, model.nodes.shape
    shapes, weighted = modes.reshape(n, d, -1), mass @ nodes
    products = np.einsum("nak,nbl->klab", shapes, (mass @ modes.reshape(n, -1)).reshape(shapes.shape))
    return {
        "mass": mass.sum(),
        "first_moment": weighted.sum(axis=0),
        "second_moment": nodes.T @ weighted,
        "modal_moments": np.einsum("n,nak->ka", mass.sum(axis=0), shapes),
        "mixed_moments": np.einsum("na,nbk->kab", weighted, shapes),
        "modal_products": 0.5 * (products + products.transpose(1, 0, 3, 2)),
    }
