"""The constraints of a scene in NumPy.

Joints of elements need no compiled program. The other joints share a program of their rows alone.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..linalg import rotations as rot
from ..linalg.jitted import on_host
from ..parts.elements import on_bodies
from ..states.on_host import MOST, AbstractHost
from .elementary import HostRows, Listed, is_elementary, stacked
from .groups import Kinematics
from .law_groups import motions_of, places_of


class _Rows(NamedTuple):
    """Rows of a group.

    **Fields:** `values`: Φ, or ψ of a group that binds velocities; `drift`: the rate of Φ while nothing moves, empty
    without time; `blocks`: derivatives along the poses of the parts' bodies, or along their velocities.
    """

    values: Float[Array, "parts rows"]
    drift: Float[Array, "parts rows"]
    blocks: Float[Array, "parts rows k n"]


@on_host
def _rows(groups: tuple[Any, ...], now: Kinematics, moves: Any) -> list[_Rows]:
    out, t, poses = [], now.t, now.poses
    now = motions_of(groups, places_of(groups, t, poses), now.velocities)
    for g in groups:
        if not g.of_poses:
            values = g.velocity(now)
            out.append(_Rows(values, values, g.jacobian(now)))
            continue
        values, drift = g.residual(t, poses), jnp.zeros(0, poses.dtype)
        if g.rheonomic:
            drift = jax.jvp(lambda t, g=g: g.residual(t, poses), (t,), (jnp.ones_like(t),))[1]
        out.append(_Rows(values, drift, g.along(t, poses, moves)))
    return out


class HostScene(AbstractHost):
    """The constraints of a system of rigid bodies; made by `host_scene`."""

    def __init__(self, system: Any, t: Any):
        self._layout, self._groups, self._u = system.layout, system.constraints.groups, np.asarray(system.guess.u)
        self._t, self._positions = np.asarray(t, system.guess.q.dtype), len(system.constraints.position)
        self._elements, self._directions = _elements(system)
        self._listed = [_in_numpy(g) for g in self._groups]
        self._compiled = tuple(g for g, listed in zip(self._groups, self._listed, strict=True) if not listed)
        self._cached = None
        places = [(g.group.body_index, g.rows) for g in self._groups]
        self._of_poses = self._layout.jacobian_source(places[: self._positions], of_poses=True)
        self._of_velocities = self._layout.jacobian_source(places, of_poses=False)
        self.analytic = not self._compiled
        self.linear, self.velocity_rows = system.linear, system.velocity_rows
        self.coordinate_scale, self.velocity_scale = system.known_scales()

    def _poses(self, q) -> Any:
        """Poses of the bodies, of scalar coordinates and the ground."""
        return np.append(q, self._layout.space.ground)[self._layout.pose_index]

    def _prepared(self, q) -> Any:
        return self._prepare(self._poses(q))

    def _prepare(self, poses):
        if not self._layout.spatial:
            angle = poses[:, 2:]
            return np.concatenate([poses, np.cos(angle), np.sin(angle)], axis=1)
        euler: Any = poses[:, 3:]
        return np.concatenate([poses, [rot.rotation_matrix(p).ravel() for p in euler]], axis=1)

    def _moves(self, q):
        """Rates of prepared poses along unit rates of poses."""
        poses = self._poses(q)
        size = poses.shape[1]
        if self._layout.spatial:
            # Rotation matrices are quadratic in Euler parameters, so these differences are exact.
            return np.stack([0.5 * (self._prepare(poses + x) - self._prepare(poses - x)) for x in np.eye(size)], axis=1)
        moves = np.tile(np.eye(size, size + 2), (len(poses), 1, 1))
        moves[:, 2, size:] = np.stack([-np.sin(poses[:, 2]), np.cos(poses[:, 2])], axis=1)
        return moves

    def _rates(self, q, of_bodies):
        """The rates of poses, from the velocities of all bodies."""
        if not self._layout.spatial:
            return of_bodies
        poses = self._poses(q)
        rotating: Any = zip(poses[:, 3:], of_bodies[:, 3:], strict=True)
        return np.concatenate([of_bodies[:, :3], [rot.rates(p, w) for p, w in rotating]], axis=1)

    def _evaluated(self, q, u=None) -> list[_Rows]:
        """Rows of the compiled groups, by default at the guess's velocities."""
        if not self._compiled:
            return []
        u = self._u if u is None else u
        key = q.tobytes(), u.tobytes()
        if self._cached is None or self._cached[0] != key:
            of_bodies: Any = np.append(u, 0.0)[self._layout.velocity_index]
            now = Kinematics(self._t, self._prepared(q), of_bodies)
            self._cached = key, _rows(self._compiled, now, self._moves(q))
        return self._cached[1]

    def _joined(self, groups, of_elements: Any, of_compiled: Iterable[Any]) -> list[Any]:
        """Values of elements and of the compiled groups, in the order of `groups`."""
        compiled, out, first = iter(of_compiled), [], 0
        for g, listed in zip(groups, self._listed, strict=False):
            if not listed:
                out.append(next(compiled))
                continue
            out.append(of_elements[first : first + g.row_count])
            first += g.row_count
        return out

    def residual(self, q):
        """Φ."""
        values = None if self._elements is None else self._elements.residual(self._prepared(q))
        return _flat(self._joined(self._groups[: self._positions], values, (x.values for x in self._evaluated(q))))

    def coordinate_residual(self, q):
        p = self._euler(q)
        return np.concatenate([self.residual(q), 0.5 * (np.sum(p * p, axis=1) - 1.0)])

    def blocks(self, q, u=None) -> list[Float[np.ndarray, "parts rows k v"]]:
        """Blocks of A, group by group, for the bodies of each part; by default at the guess's velocities."""
        values = None if self._elements is None else self._elements.jacobian(self._prepared(q))
        compiled = zip(self._compiled, self._evaluated(q, u), strict=True)
        joined = self._joined(self._groups, values, (self._along_velocities(q, g, x.blocks) for g, x in compiled))
        pairs = zip(self._groups, joined, strict=True)
        return [x.reshape(len(g.group.names), g.rows, *x.shape[-2:]) for g, x in pairs]

    def jacobian(self, q):
        """A at the guess's velocities."""
        return np.append(_flat(self.blocks(q)), 0.0)[self._of_velocities]

    def _along_velocities(self, q, group, blocks):
        """Derivatives along velocities, from derivatives along poses."""
        if not (self._layout.spatial and group.of_poses):
            return blocks
        units = np.eye(self._layout.space.velocity_size)
        rates = [self._rates(q, np.tile(unit, (self._layout.ground + 1, 1))) for unit in units]
        moves: Any = np.stack(rates, axis=-1)[group.group.body_index]
        return np.einsum("prkn,pknv->prkv", blocks, moves)

    def coordinate_jacobian(self, q):
        values = None
        if self._elements is not None:
            derivative = self._elements.jacobian_of_poses if self._layout.spatial else self._elements.jacobian
            values = derivative(self._prepared(q))
        blocks = self._joined(self._groups[: self._positions], values, (x.blocks for x in self._evaluated(q)))
        rows = np.append(_flat(blocks), 0.0)[self._of_poses]
        of_lengths = np.zeros((len(self._layout.turning), q.size), q.dtype)
        places = self._layout.pose_index[self._layout.turning, 3:]
        of_lengths[np.arange(len(self._layout.turning))[:, None], places] = q[places]
        return np.concatenate([rows, of_lengths])

    def velocity_rows_at(self, q, u):
        blocks, of_bodies = self.blocks(q, u), np.append(u, 0.0)[self._layout.velocity_index]
        compiled, unmet = dict(zip(map(id, self._compiled), self._evaluated(q, u), strict=True)), []
        for g, group_blocks in zip(self._groups, blocks, strict=True):
            rows = compiled.get(id(g))
            if rows is not None and not g.of_poses:
                unmet.append(rows.values)
                continue
            rates = np.einsum("prkv,pkv->pr", group_blocks, of_bodies[g.group.body_index])
            unmet.append(rates if rows is None or not rows.drift.size else rates + rows.drift)
        jacobian = np.append(_flat(blocks), 0.0)[self._of_velocities]
        return _flat(unmet)[: self.velocity_rows], jacobian[: self.velocity_rows]

    def _euler(self, q):
        return q[self._layout.pose_index[self._layout.turning, 3:]] if self._layout.turning else np.zeros((0, 4))

    def normalize(self, q):
        """The coordinates with Euler parameters of length one."""
        q = q.copy()
        if self._layout.turning:
            p = self._euler(q)
            q[self._layout.pose_index[self._layout.turning, 3:]] = p / np.linalg.norm(p, axis=1, keepdims=True)
        return q

    def along(self, q, step):
        """The rates of coordinates with the velocities `step`."""
        rates = self._rates(q, np.append(step, 0.0)[self._layout.velocity_index])
        return rates[:-1].ravel()[self._layout.coordinate_place]

    def displaced(self, q, step):
        """The coordinates after a displacement along velocities."""
        return self.normalize(q + self.along(q, step))

    def holds(self, q):
        """Whether the constraints hold, and no joint is half a turn away from closing."""
        if not super().holds(q):
            return False
        poses, direction = self._prepared(q), self._layout.space.direction
        return all(
            direction(poses[a], u) @ direction(poses[b], v) > 0
            for bodies, of_a, of_b in self._directions
            for (a, b), u, v in zip(bodies, of_a, of_b, strict=True)
        )


def _flat(pieces):
    return np.concatenate([np.zeros(0), *(x.ravel() for x in pieces)])


def host_scene(system: Any, t: Any) -> HostScene | None:
    """The constraints of a system in NumPy; None without constraints or with many, with counts of turns, and in single
    precision.
    """
    small = 0 < system.acceleration_rows <= MOST and system.nq <= MOST and system.guess.q.dtype == np.float64
    return HostScene(system, t) if small and not system.bodies.turn_counts else None


def _in_numpy(group):
    return is_elementary(group) and not group.group.kernels


def _elements(system) -> tuple[HostRows | None, list[tuple[np.ndarray, Any, Any]]]:
    """The rows of joints that consist of elements.

    Also, for elements with directions that are parallel in a closed joint, the joints' bodies and these directions.
    """
    space, listed, along, first = system.layout.space, [], [], 0
    for g in filter(_in_numpy, system.constraints.position):
        group = g.group
        numbers, structure = jax.tree.flatten(group.part)
        numbers = [np.asarray(x) for x in numbers]
        parts = [jax.tree.unflatten(structure, [x[k] for x in numbers]) for k in range(len(group.names))]
        elements = [on_bodies(part, space, part.elements) for part in parts]
        places = first + g.rows * np.arange(len(group.names))
        for of_parts in zip(*elements, strict=True):
            element = jax.tree.map(lambda *x: np.stack(x), *of_parts)
            listed.append(Listed(element, group.body_index, places))
            if getattr(element, "along_a", None) is not None:
                along.append((group.body_index, element.along_a, element.along_b))
            places = places + element.rows(space.dimension)
        first += g.rows * len(group.names)
    return HostRows.of(stacked(listed, system.layout.ground, space.dimension)) if listed else None, along
