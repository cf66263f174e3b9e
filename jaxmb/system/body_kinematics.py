"""Bodies of a system: their masses, poses and velocities among the coordinates."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..linalg.arrays import unchecked_take
from ..linalg.rotations import normalize
from .constraint_groups import ConstraintGroup
from .coordinates import coordinate_names, rate_names
from .equation import AbstractSystem
from .groups import BodyGroup
from .layout import Layout

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class AbstractBodies(AbstractSystem):
    """The coordinates and velocities of stacked bodies.

    **Fields:** the groups of `bodies`, their names, where their coordinates and velocities stand, `layout`, and the
    groups of parts that have `turn_counts`.
    """

    bodies: AbstractVar[tuple[BodyGroup, ...]]
    turn_counts: AbstractVar[tuple[ConstraintGroup, ...]]
    layout: AbstractVar[Layout]
    body_names: AbstractVar[tuple[str, ...]]

    # Sizes and names

    @property
    def nq(self) -> int:
        return self.layout.nq

    @property
    def nu(self) -> int:
        return self.layout.nu

    @property
    def spatial(self) -> bool:
        return self.layout.space.dimension == 3

    @property
    def rates_are_velocities(self) -> bool:
        return not self.spatial

    def coordinate_names(self):
        return coordinate_names(self.layout, self.body_names)

    def rate_names(self):
        return rate_names(self.layout, self.body_names)

    # Bodies

    @property
    def mass(self) -> Float[Array, "b"]:
        """Masses [kg] of the bodies."""
        return self._in_order([g.mass for g in self.bodies])

    @property
    def moments_of_inertia(self) -> Float[Array, "b *matrix"]:
        """Moments of inertia [kg m²] about the mass centres: a number in the plane, a matrix in body axes in space."""
        return self._in_order([g.inertia for g in self.bodies])

    def _in_order(self, of_groups):
        """Per-body values of all groups, in the order of the bodies."""
        if len(of_groups) == 1:
            return of_groups[0]
        order = np.argsort(np.concatenate([g.group.body_index[:, 0] for g in self.bodies]))
        return unchecked_take(jnp.concatenate(of_groups), order)

    # Kinematics

    def prepared_poses(self, q: Float[Array, "nq"]) -> Float[Array, "b_ground p"]:
        """Prepared poses of the bodies, of scalar coordinates and of the ground, the arguments of kernels."""
        prepare = self.layout.space.prepare
        ground = prepare(jnp.asarray(self.layout.space.ground, q.dtype))
        return jnp.concatenate([jax.vmap(prepare)(self._poses(q)), ground[None]])

    def all_velocities(self, u: Float[Array, "nu"]) -> Float[Array, "b_ground v"]:
        """Velocities of the bodies, of scalar coordinates and of the ground."""
        return jnp.pad(self._velocities(u), ((0, 1), (0, 0)))

    def poses(self, q: Float[Array, "nq"]) -> Float[Array, "b p"]:
        """Poses of the bodies."""
        return self._poses(q)[: self.layout.bodies]

    def velocities(self, u: Float[Array, "nu"]) -> Float[Array, "b v"]:
        """Velocities of the bodies."""
        return self._velocities(u)[: self.layout.bodies]

    def _poses(self, q):
        """Poses of the bodies and of scalar coordinates."""
        if self.layout.uniform:
            return q.reshape(self.layout.bodies, -1)
        ground = jnp.asarray(self.layout.space.ground, q.dtype)
        return unchecked_take(jnp.concatenate([q, ground]), self.layout.pose_index[:-1])

    def _velocities(self, u):
        """Velocities of the bodies and of scalar coordinates."""
        if self.layout.uniform:
            return u.reshape(self.layout.bodies, -1)
        return unchecked_take(jnp.concatenate([u, jnp.zeros(1, u.dtype)]), self.layout.velocity_index[:-1])

    def rates(self, t, q, u):
        if self.rates_are_velocities:
            return u
        rates = self._pack(jax.vmap(self.layout.space.rates)(self._poses(q), self._velocities(u)))
        for g in self.turn_counts:
            own = g.velocity(jnp.asarray(t, q.dtype), self.prepared_poses(q), self.all_velocities(u))
            rates = rates.at[self._counts(g)].set(-own)
        return rates

    def normalize(self, q):
        if self.rates_are_velocities:
            return q
        q = self._pack(jax.vmap(self.layout.space.normalize)(self._poses(q)))
        for g in self.turn_counts:
            # A count of turns does not depend on the time.
            own = g.residual(jnp.zeros((), q.dtype), self.prepared_poses(q))
            q = q.at[self._counts(g)].add(-own)
        return q

    def _counts(self, group):
        """Where the counts of turns of stacked tendons stand in q, shape (parts, rows)."""
        return self.layout.pose_index[group.group.body_index[:, -group.rows :], 0]

    def normalize_fixed(self, q, fixed):
        rotating = np.flatnonzero(np.array(self.layout.rotates) & self.spatial)
        turns = self.layout.pose_index[:-1][rotating, 3:]
        whole = turns[np.all(fixed[turns], axis=1)]
        for index in whole:
            q = q.at[index].set(normalize(q[index]))
        return q, len(whole)

    def held_velocities(self, held):
        if self.rates_are_velocities:
            return held
        d = self.layout.space.dimension
        of_pose = np.append(held, np.ones(self.layout.space.pose_size, bool))[self.layout.pose_index[:-1]]
        turns = of_pose[:, d:]
        if np.any(np.any(turns, axis=1) & ~np.all(turns, axis=1)):
            return None
        of_bodies = np.concatenate([of_pose[:, :d], np.repeat(turns[:, :1], d, axis=1)], axis=1)
        return of_bodies.reshape(-1)[self.layout.velocity_place]

    def _pack(self, poses):
        raveled = poses.reshape(-1)
        return raveled if self.layout.uniform else unchecked_take(raveled, self.layout.coordinate_place)
