"""Whether two states are on one branch of the constraints, which charts do not tell."""

import numpy as np
from jaxtyping import ArrayLike, Float

from ..system import AbstractSystem

# States are on different branches beyond this distance.
APART = 1e-3


def signs_like(system: AbstractSystem, q: Float[ArrayLike, "nq"], other: Float[ArrayLike, "nq"]) -> np.ndarray:
    """The signs by which Euler parameters of `q` are near those of another state; both signs are one orientation."""
    q, other, signs = np.asarray(q), np.asarray(other), np.ones(system.nq)
    for name, where in system.coordinate_names().items():
        if name.endswith(".orientation") and np.dot(q[where], other[where]) < 0:
            signs[where] = -1.0
    return signs


def distance(system: AbstractSystem, q: Float[ArrayLike, "nq"], other: Float[ArrayLike, "nq"]) -> float:
    """The largest difference of coordinates, relative to typical ones, up to full turns of bodies."""
    difference = signs_like(system, q, other) * np.asarray(q) - np.asarray(other)
    for name, where in system.coordinate_names().items():
        if system.body_names and name.endswith(".angle"):
            difference[where] -= 2 * np.pi * np.round(difference[where] / (2 * np.pi))
    return float(np.max(np.abs(difference) / np.asarray(system.coordinate_scale()), initial=0.0))
