"""Derivatives of a scene's forces with respect to positions and velocities, part by part.

A part acts on its own bodies only, so its derivatives are a small matrix of blocks; parts of one type are
differentiated together.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Scalar
from .rigid_bodies import RigidBodySystem


def contributions(
    system: RigidBodySystem,
    t: Scalar,
    q: Float[Array, "nq"],
    u: Float[Array, "nu"],
    multipliers: Float[Array, "m"],
) -> tuple[Float[Array, "e v v"], Float[Array, "e v v"]]:
    """K and D: derivatives of the wrenches of forces and of constraints with given multipliers, with respect to
    displacements along velocities and to the velocities. Each part contributes a block for each pair of its bodies,
    the one that the wrench acts on first; the gyroscopic moments of bodies follow.
    """
    poses, velocities = system.prepared_poses(q), system.all_velocities(u)
    size = system.layout.space.velocity_size
    stiffness, damping = [], []
    for g in system.forces:
        both = g.derivatives(t, poses, velocities)
        for parts, blocks in zip((stiffness, damping), both, strict=True):
            parts.append(_by_pairs(blocks))
    row = 0
    for g in system.joints:
        own = multipliers[row : row + len(g.group.names) * g.rows].reshape(-1, g.rows)
        row += own.size
        stiffness.append(_by_pairs(g.wrench_derivatives(t, poses, velocities, own)))
        damping.append(jnp.zeros_like(stiffness[-1]))
    gyroscopic = system.gyroscopic_damping(u)
    stiffness.append(jnp.zeros_like(gyroscopic))
    damping.append(gyroscopic)
    join = lambda blocks: jnp.concatenate([own.reshape(-1, size, size) for own in blocks])
    return join(stiffness), join(damping)


def _by_pairs(blocks: Float[Array, "parts k v k v"]) -> Float[Array, "parts k k v v"]:
    return jnp.moveaxis(blocks, 3, 2)
