"""A chain of slender bars in the plane, open or closed to a loop, in angles from the x axis; gravity along −y.

The equations are for programs that need them written out: `M a + h = Gᵀ λ`, `G a = −γ`.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxmb as mb

GRAVITY = 9.81


class BarChain(NamedTuple):
    """Bars one after the other from the origin; the last one ends at the ground's point `end`, unless that is None.

    `mechanism` is the same in jaxmb's library; what counts is the angle of the bar `watched` at `t1`, whose
    value is `exact`, and its derivative by the mass of the bar `varied`.
    """

    title: str
    mechanism: mb.mechanisms.Mechanism
    bodies: tuple[str, ...]
    lengths: np.ndarray
    masses: np.ndarray
    angles: np.ndarray
    rates: np.ndarray
    end: np.ndarray | None
    t1: float
    watched: int
    varied: int
    exact: float

    @property
    def inertias(self) -> np.ndarray:
        return self.masses * self.lengths**2 / 12


def four_bar() -> BarChain:
    mechanism = mb.mechanisms.get("four_bar")
    lengths, known = np.array([1.0, 3.0, 2.5]), mechanism.references
    q, u = np.asarray(mechanism.state.q).reshape(3, 3)[:, 2], np.asarray(mechanism.state.u).reshape(3, 3)[:, 2]
    # The library's rocker points from the ground to the coupler.
    angles, exact = q + np.array([0.0, 0.0, np.pi]), float(known.values[-1, known.labels.index("crank")])
    names, end = ("crank", "coupler", "rocker"), np.array([2.5, 0.0])
    return BarChain(
        "four-bar linkage", mechanism, names, lengths, lengths, angles, u, end, mechanism.t1, 0, 1, exact
    )  # fmt: skip


def pendulum(n: int = 10) -> BarChain:
    mechanism = mb.mechanisms.get("rod_chain", n=n)
    known = mechanism.references
    exact = float(known.values[-1, known.labels.index(f"th{n}")]) - np.pi / 2
    parts, still = np.full(n, 1 / n), np.zeros(n)
    names = tuple(f"link{k + 1}" for k in range(n))
    return BarChain(
        f"pendulum of {n} links", mechanism, names, parts, parts, still, still, None, mechanism.t1, n - 1, n - 1, exact
    )


def levers(lengths: np.ndarray) -> np.ndarray:
    """How far each mass centre (row) moves with each angle (column)."""
    n = len(lengths)
    return np.tril(np.broadcast_to(lengths, (n, n)), -1) + np.diag(lengths / 2)


def accelerations(chain: BarChain, angles: Array, rates: Array, mass: Any) -> Array:
    """In JAX, `mass` of the bar that varies [kg]."""
    W, n = levers(chain.lengths), len(chain.lengths)
    masses = jnp.asarray(chain.masses).at[chain.varied].set(mass)
    A = W.T @ (masses[:, None] * W)
    between = angles[:, None] - angles[None, :]
    M = A * jnp.cos(between) + jnp.diag(masses * chain.lengths**2 / 12)
    h = (A * jnp.sin(between)) @ rates**2 + GRAVITY * (masses @ W) * jnp.cos(angles)
    if chain.end is None:
        return jnp.linalg.solve(M, -h)
    x, y = chain.lengths * jnp.cos(angles), chain.lengths * jnp.sin(angles)
    G, gamma = jnp.stack([-y, x]), -jnp.stack([x, y]) @ rates**2
    kkt = jnp.block([[M, -G.T], [G, jnp.zeros((2, 2))]])
    return jnp.linalg.solve(kkt, jnp.concatenate([-h, -gamma]))[:n]
