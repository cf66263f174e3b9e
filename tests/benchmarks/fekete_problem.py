"""Fekete's problem of the test set for initial value problem solvers: particles on a sphere that repel each other.

Source: C. Bendtsen and P. G. Thomsen, IMM-DTU 1999, as in F. Mazzia and C. Magherini, "Test Set for Initial Value
Problem Solvers", 2008: twenty particles of unit mass on the unit sphere, forces `Σ (p_i − p_j) / |p_i − p_j|²` and
`−α q_i`, α = 0.5, from rest, for 1000 s. All quantities are without units.
"""

import jax.numpy as jnp
import numpy as np

import jaxmb as mb
from jaxmb.lagrangian import Holonomic, LagrangianSystem

DAMPING, T1 = 0.5, 1000.0
# Rings of particles: how many, their latitude, and the longitude of the first one over that of the ring's spacing.
_RINGS = (
    (3, 3 * np.pi / 8, 2 * np.pi / 3 + np.pi / 13),
    (7, np.pi / 8, 2 * np.pi / 7 + np.pi / 29),
    (6, -2 * np.pi / 15, 2 * np.pi / 6 + np.pi / 7),
    (4, -3 * np.pi / 10, np.pi / 17),
)
# The published positions at the end, by RADAU5 at a tolerance of 1e-12.
# fmt: off
POSITIONS = np.reshape([
    -0.4070263380333202, 0.3463758772791802, 0.8451942450030429, 0.07752934752521549, -0.2628662719972299,
    0.9617122871829146, 0.7100577833343567, 0.1212948055586120, 0.6936177005172217, 0.2348267744557627,
    0.7449277976923311, 0.6244509285956391, -0.4341114738782885, 0.8785430442262876, 0.1992720444237660,
    -0.9515059600312596, 0.2203508762787005, 0.2146669498274008, -0.6385191643609878, -0.4310833259390688,
    0.6375425027722121, -0.1464175087914336, -0.9380871635228862, 0.3139337298744690, 0.5666974065069942,
    -0.6739221885076542, 0.4740073135462156, 0.9843259538440293, -0.1696995357819996, -0.04800504290609090,
    0.1464175087914331, 0.9380871635228875, -0.3139337298744656, -0.7092757549979014, 0.5264062637139616,
    -0.4688542938854929, -0.8665731819284478, -0.4813878059756024, -0.1315929352982178, -0.2347897778700538,
    -0.8594340408013130, -0.4541441287957579, 0.5530976940074118, -0.7674370265615124, -0.3242273140037833,
    0.7711050969896927, 0.6357041816577034, 0.03573685519777001, 0.7103951209379591, 0.2403570431280519,
    -0.6614886725910596, -0.03038208738735660, 0.4501923293640461, -0.8924145871442046, -0.5772996158107093,
    -0.1766763414971813, -0.7971892020969544, 0.2414481766969039, -0.3416456818373135, -0.9082846503446250,
], (20, 3))
# fmt: on


def start() -> np.ndarray:
    """Positions at the start, shape (20, 3)."""
    rings = []
    for count, latitude, first in _RINGS:
        longitude = first + 2 * np.pi * np.arange(count) / count
        across = np.cos(latitude)
        ring = (across * np.cos(longitude), across * np.sin(longitude), np.full(count, np.sin(latitude)))
        rings.append(np.stack(ring, axis=1))
    return np.concatenate(rings)


PAIRS = np.triu_indices(len(POSITIONS), 1)


def lagrangian(t, q, v, parameters):
    p = q.reshape(-1, 3)
    distances = jnp.sum((p[PAIRS[0]] - p[PAIRS[1]]) ** 2, axis=1)
    return 0.5 * jnp.dot(v, v) + 0.5 * jnp.sum(jnp.log(distances))


def force(t, q, v, parameters):
    return -DAMPING * v


def sphere(t, q, parameters):
    return jnp.sum(q.reshape(-1, 3) ** 2, axis=1) - 1.0


def system() -> mb.system.AbstractSystem:
    return LagrangianSystem(lagrangian, force=force, constraints=[Holonomic("sphere", sphere)], q=start().ravel())
