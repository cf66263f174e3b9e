"""The constraints of a scene in NumPy: where all its joints consist of elements, nothing is compiled to find consistent
positions and velocities.

The equations are those of `states/closest.py`. Matrices are dense and small.
"""

from typing import Any

import jax
import numpy as np
from jaxtyping import Bool

from ..linalg import rotations as rot
from ..parts.elements import on_bodies
from ..states.closest import largest_residual, tolerance
from .elementary import ElementaryRows, Listed, is_elementary, stacked

# The largest numbers of rows and coordinates whose dense matrices are cheap.
_MOST = 150
# Largest numbers of Gauss–Newton and of Newton steps; a share of the residuals that a Gauss–Newton step takes away; the
# power of the precision at which a step is the last one.
_STEPS, _REFINEMENTS, _PROGRESS, _SMALL = 60, 16, 0.999, 0.75
# Coordinates satisfy constraints exactly up to so many units of rounding; singular values below this fraction are zero.
_ROUNDING, _ZERO = 4.0, 1e-9
# The change of a coordinate, imaginary, by which derivatives are found.
_IMAGINARY = 1e-30


class HostScene:
    """The position constraints of a system of rigid bodies; made by `host_scene`."""

    def __init__(self, system: Any, rows: ElementaryRows, along: list[tuple[np.ndarray, np.ndarray, np.ndarray]]):
        self._rows, self._along, self._layout = rows, along, system.layout
        groups = [(g.group.body_index, g.rows) for g in system.constraints]
        self._sources = [self._layout.jacobian_source(groups, of_poses=own) for own in (False, True)]
        self._rotating = [k for k, rotates in enumerate(self._layout.rotates) if rotates and self._spatial]
        self.coordinate_scale, self.velocity_scale = system.known_scales()

    @property
    def _spatial(self):
        return self._layout.space.dimension == 3

    def poses(self, q) -> Any:
        """Prepared poses of the bodies and the ground."""
        layout = self._layout
        poses = np.append(q, layout.space.ground)[layout.pose_index]
        if not self._spatial:
            angle = poses[:, 2:]
            return np.concatenate([poses, np.cos(angle), np.sin(angle)], axis=1)
        turned: Any = poses[:, 3:]
        return np.concatenate([poses, [rot.rotation_matrix(p).ravel() for p in turned]], axis=1)

    def residual(self, q):
        """Φ."""
        return self._rows.residual(self.poses(q))

    def coordinate_residual(self, q):
        """Φ, and the lengths of Euler parameters."""
        p = self._euler(q)
        return np.concatenate([self.residual(q), 0.5 * (np.sum(p * p, axis=1) - 1.0)])

    def blocks(self, q):
        """A, row by row for two bodies each."""
        return self._rows.jacobian(self.poses(q))

    def jacobian(self, q):
        """A."""
        return np.append(self.blocks(q), 0.0)[self._sources[0]]

    def coordinate_jacobian(self, q):
        """The derivative of `coordinate_residual`."""
        if not self._spatial:
            return self.jacobian(q)
        rows = np.append(self._rows.jacobian_of_poses(self.poses(q)), 0.0)[self._sources[1]]
        of_lengths = np.zeros((len(self._rotating), q.size), q.dtype)
        places = self._layout.pose_index[self._rotating, 3:]
        of_lengths[np.arange(len(self._rotating))[:, None], places] = q[places]
        return np.concatenate([rows, of_lengths])

    def _euler(self, q):
        return q[self._layout.pose_index[self._rotating, 3:]] if self._rotating else np.zeros((0, 4), q.dtype)

    def normalize(self, q):
        """The coordinates with Euler parameters of length one."""
        q = q.copy()
        if self._rotating:
            p = self._euler(q)
            q[self._layout.pose_index[self._rotating, 3:]] = p / np.linalg.norm(p, axis=1, keepdims=True)
        return q

    def displaced(self, q, step):
        """The coordinates after a displacement along velocities."""
        layout = self._layout
        moved = np.append(step, 0.0)[layout.velocity_index]
        poses = np.append(q, layout.space.ground)[layout.pose_index]
        if self._spatial:
            turned: Any = zip(poses[:, 3:], moved[:, 3:], strict=True)
            moved = np.concatenate([moved[:, :3], [rot.rates(p, w) for p, w in turned]], axis=1)
        return self.normalize((poses + moved)[:-1].ravel()[layout.coordinate_place])

    def holds(self, q) -> bool:
        """Whether the constraints hold, and no joint is turned by half a turn."""
        norms: Any = np.linalg.norm(self.coordinate_jacobian(q) * self.coordinate_scale, axis=1)
        residual: Any = self.coordinate_residual(q)
        if not largest_residual(residual, norms) <= tolerance(q.dtype):
            return False
        poses, turned = self.poses(q), self._layout.space.direction
        return all(
            turned(poses[a], u) @ turned(poses[b], v) > 0
            for bodies, of_a, of_b in self._along
            for (a, b), u, v in zip(bodies, of_a, of_b, strict=True)
        )

    def met(self, q, held: Bool[np.ndarray, "nq"] | None = None):
        """Coordinates on the constraints, by Gauss–Newton steps with halving, without motion of those that are held."""
        scale = self.coordinate_scale if held is None else np.where(held, 0.0, self.coordinate_scale)
        before, small = self.coordinate_residual(q), np.finfo(float).eps ** _SMALL
        for _ in range(_STEPS if np.all(np.isfinite(before)) else 0):
            step = -scale * np.linalg.lstsq(self.coordinate_jacobian(q) * scale, before, rcond=1e-12)[0]
            longest = np.max(np.abs(step[scale > 0] / scale[scale > 0]), initial=0.0)
            step = step * min(1.0, 1.0 / longest if longest > 0 else 1.0)
            reached = [q + length * step for length in 0.5 ** np.arange(8)]
            sizes = [np.sum(self.coordinate_residual(there) ** 2) for there in reached]
            best = int(np.argmin(np.where(np.isfinite(sizes), sizes, np.inf)))
            if not sizes[best] < before @ before:
                break
            gained = sizes[best] < _PROGRESS * (before @ before)
            q, before = reached[best], self.coordinate_residual(reached[best])
            if longest <= small or not gained:
                break
        return q

    def closest_configuration(self, guess, held: Bool[np.ndarray, "nq"], rank: int):
        """The configuration closest to the guess with some coordinates held; None where it is not found.

        **Arguments:** `rank`: of the rows in the columns that are not held.
        """
        scale = np.where(held, 0.0, self.coordinate_scale)
        size = np.max(np.abs(guess), initial=0.0) + np.max(self.coordinate_scale, initial=0.0)
        exact = np.max(np.abs(self.coordinate_residual(guess))) <= _ROUNDING * np.finfo(guess.dtype).eps * size
        if exact and not held.any() and self.holds(guess):
            return guess
        q = self.met(guess, held)
        if not self.holds(q) or _rank(self.coordinate_jacobian(q) * scale) != rank:
            return None
        free, small = ~held, np.finfo(float).eps ** _SMALL
        weights = 1 / self.coordinate_scale[free] ** 2
        multipliers = np.zeros(self.coordinate_residual(q).size)
        for _ in range(_REFINEMENTS):
            jacobian = self.coordinate_jacobian(q)[:, free]
            gradient = weights * (q - guess)[free]
            if not np.any(multipliers):
                multipliers = np.linalg.lstsq(jacobian.T, -gradient, rcond=1e-12)[0]
            curvature = np.diag(weights) + self._curvature(q, multipliers, free)
            matrix = np.block([[curvature, jacobian.T], [jacobian, np.zeros((jacobian.shape[0],) * 2)]])
            right = -np.concatenate([gradient + jacobian.T @ multipliers, self.coordinate_residual(q)])
            step = np.linalg.lstsq(matrix, right, rcond=1e-13)[0]
            q = q.copy()
            q[free] += step[: free.sum()]
            multipliers = multipliers + step[free.sum() :]
            if np.max(np.abs(step[: free.sum()]) / scale[free], initial=0.0) <= small:
                return q if self.holds(q) else None
        return None

    def _curvature(self, q, multipliers, free):
        """The second derivatives of rows along multipliers, by imaginary changes of coordinates."""
        rows = []
        for k in np.flatnonzero(free):
            there = q.astype(complex)
            there[k] += 1j * _IMAGINARY
            rows.append((multipliers @ self.coordinate_jacobian(there)).imag[free] / _IMAGINARY)
        return np.array(rows).reshape(free.sum(), free.sum())

    def closest_velocities(self, q, guess, held: Bool[np.ndarray, "nu"], rank: int):
        """The velocities closest to the guess with some rates held; None where they are not found."""
        scale = np.where(held, 0.0, self.velocity_scale)
        jacobian = self.jacobian(q)
        if not held.any() and _rank(jacobian * scale) != rank:
            return None
        u = guess
        for _ in range(2):
            u = u - scale * np.linalg.lstsq(jacobian * scale, jacobian @ u, rcond=1e-10)[0]
        size = 1.0 + np.max(np.abs(jacobian) @ np.abs(u), initial=0.0)
        return u if np.max(np.abs(jacobian @ u), initial=0.0) <= 1e2 * tolerance(u.dtype) * size else None


def _rank(matrix):
    sizes = np.linalg.svd(matrix, compute_uv=False)
    return int(np.sum(sizes > _ZERO * np.max(sizes, initial=0.0)))


def host_scene(system: Any) -> HostScene | None:
    """The constraints of a system in NumPy; None where some are no elements, or there are many."""
    plain = not (system.velocity_constraints or system.servos or system.layout.scalars)
    small = 0 < system.position_rows <= _MOST and system.nq <= _MOST and system.guess.q.dtype == np.float64
    if not (plain and small and all(is_elementary(g) and not g.group.kernels for g in system.constraints)):
        return None
    space, listed, along, first = system.layout.space, [], [], 0
    for g in system.constraints:
        own = g.group
        numbers, structure = jax.tree.flatten(own.part)
        numbers = [np.asarray(x) for x in numbers]
        parts = [jax.tree.unflatten(structure, [x[k] for x in numbers]) for k in range(len(own.names))]
        elements = [on_bodies(part, space, part.elements) for part in parts]
        places = first + g.rows * np.arange(len(own.names))
        for same in zip(*elements, strict=True):
            element = jax.tree.map(lambda *x: np.stack(x), *same)
            listed.append(Listed(element, own.body_index, places))
            if getattr(element, "along_a", None) is not None:
                along.append((own.body_index, element.along_a, element.along_b))
            places = places + element.rows(space.dimension)
        first += g.rows * len(own.names)
    return HostScene(system, stacked(listed, system.layout.ground, space.dimension), along)
