"""Consistent positions and velocities of a system in NumPy, with small dense matrices.

The equations are the same as in `states/closest.py`. At most the rows of the constraints and their derivatives are
compiled.
"""

import abc
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from .closest import independent_above, largest_residual, next_reach, rounding_of, tolerance

# The largest numbers of rows and coordinates whose dense matrices are cheap.
MOST = 150
# Largest numbers of Gauss–Newton steps (`_STEPS`), of Newton steps, and of steps to velocities of constraints that are
# not linear. `_PROGRESS`: the least share by which a useful step reduces squared residuals; a part of a step needs this
# part of the share. `_SMALL`: the size of the last step, as a power of eps.
_STEPS, _REFINEMENTS, _VELOCITIES, _PROGRESS, _SMALL = 60, 16, 8, 0.001, 0.75
# A full step is not shortened if it reduces the squared residuals below this share.
_WHOLE = 0.01
# Each Newton step must be below this part of the one before, or the curvature is found anew.
_FAST = 0.1
# The imaginary part of coordinates whose analytic functions give derivatives.
IMAGINARY = 1e-30
# Largest rounding error of residuals, in units of eps.
_ROUNDING = 4.0


class AbstractHost(abc.ABC):
    """The constraints of a system at a time, in NumPy.

    **Fields:** scales of the system; whether ψ is `linear` in velocities; the number of `velocity_rows`; whether the
    constraints are `analytic`: only position constraints, whose residuals and Jacobians accept complex coordinates.
    """

    analytic: bool = False

    coordinate_scale: Float[np.ndarray, "nq"]
    velocity_scale: Float[np.ndarray, "nu"]
    linear: bool
    velocity_rows: int

    @abc.abstractmethod
    def coordinate_residual(self, q: Float[np.ndarray, "nq"]) -> Float[np.ndarray, "m"]:
        """Φ, and the coordinates' invariants."""

    @abc.abstractmethod
    def coordinate_jacobian(self, q: Float[np.ndarray, "nq"]) -> Float[np.ndarray, "m nq"]:
        """The derivative of `coordinate_residual`."""

    @abc.abstractmethod
    def velocity_rows_at(
        self, q: Float[np.ndarray, "nq"], u: Float[np.ndarray, "nu"]
    ) -> tuple[Float[np.ndarray, "velocity_rows"], Float[np.ndarray, "velocity_rows nu"]]:
        """ψ and its derivative."""

    def holds(self, q: Float[np.ndarray, "nq"]) -> bool:
        """Whether the constraints hold."""
        jacobian: Any = self.coordinate_jacobian(q)
        norms: Any = np.linalg.norm(jacobian * self.coordinate_scale, axis=1)
        residual: Any = self.coordinate_residual(q)
        return bool(largest_residual(residual, norms, rounding_of(jacobian, q)) <= tolerance(q.dtype))

    def met(self, q: Float[np.ndarray, "nq"], held: Bool[np.ndarray, "nq"] | None = None) -> Float[np.ndarray, "nq"]:
        """Coordinates on the constraints, by Gauss–Newton steps with halving, without motion of `held` coordinates."""
        scale = self.coordinate_scale if held is None else np.where(held, 0.0, self.coordinate_scale)
        before, small, reach = self.coordinate_residual(q), float(np.finfo(q.dtype).eps) ** _SMALL, 1.0
        for _ in range(_STEPS if before.size and np.all(np.isfinite(before)) else 0):
            jacobian = self.coordinate_jacobian(q) * scale
            if not np.all(np.isfinite(jacobian)):
                break
            step = -scale * np.linalg.lstsq(jacobian, before, rcond=small)[0]
            longest = np.max(np.abs(step[scale > 0] / scale[scale > 0]), initial=0.0)
            share = min(1.0, reach / longest if longest > 0 else 1.0)
            step, size = step * share, before @ before
            reached = [(q + step, self.coordinate_residual(q + step))]
            # Shorter steps are not better than a full step that removes nearly all of the residuals.
            if not np.sum(reached[0][1] ** 2) < _WHOLE * size:
                reached += [
                    (moved, self.coordinate_residual(moved)) for moved in (q + 0.5**k * step for k in range(1, 8))
                ]
            sizes = [np.sum(residual**2) for _, residual in reached]
            best = int(np.argmin(np.where(np.isfinite(sizes), sizes, np.inf)))
            if not sizes[best] < size:
                break
            gained = sizes[best] < (1 - _PROGRESS * share) * size
            reach = next_reach(reach, before, reached[0][1], share)
            q, before = reached[best]
            if longest <= small or not gained:
                break
        return q

    def closest_configuration(
        self, guess: Float[np.ndarray, "nq"], held: Bool[np.ndarray, "nq"], rank: int
    ) -> Float[np.ndarray, "nq"] | None:
        """The configuration closest to the guess with some coordinates held; None if the search fails.

        **Arguments:** `rank` of the rows in the columns that are not held.
        """
        scale = np.where(held, 0.0, self.coordinate_scale)
        size = np.max(np.abs(guess), initial=0.0) + np.max(self.coordinate_scale, initial=0.0)
        unmet = np.max(np.abs(self.coordinate_residual(guess)), initial=0.0)
        if unmet <= _ROUNDING * np.finfo(guess.dtype).eps * size and not held.any() and self.holds(guess):
            return guess
        q = self.met(guess, held)
        if not self.holds(q) or _rank(self.coordinate_jacobian(q) * scale) != rank:
            return None
        free, small = ~held, np.finfo(float).eps ** _SMALL
        weights = 1 / self.coordinate_scale[free] ** 2
        multipliers, curvature = np.zeros(self.coordinate_residual(q).size), np.diag(weights)
        last, size = 0.0, np.inf
        for _ in range(_REFINEMENTS):
            jacobian = self.coordinate_jacobian(q)[:, free]
            gradient = weights * (q - guess)[free]
            if not np.any(multipliers):
                multipliers = np.linalg.lstsq(jacobian.T, -gradient, rcond=1e-12)[0]
            # Steps converge fast with the curvature of an earlier one.
            if not size <= _FAST * last:
                curvature = np.diag(weights) + self.curvature(q, multipliers)[np.ix_(free, free)]
            matrix = np.block([[curvature, jacobian.T], [jacobian, np.zeros((jacobian.shape[0],) * 2)]])
            right = -np.concatenate([gradient + jacobian.T @ multipliers, self.coordinate_residual(q)])
            if not (np.all(np.isfinite(matrix)) and np.all(np.isfinite(right))):
                return None
            step = np.linalg.lstsq(matrix, right, rcond=1e-13)[0]
            q = q.copy()
            q[free] += step[: free.sum()]
            multipliers = multipliers + step[free.sum() :]
            last, size = size, np.max(np.abs(step[: free.sum()]) / scale[free], initial=0.0)
            if size <= small:
                return q if self.holds(q) else None
        return None

    def curvature(self, q: Float[np.ndarray, "nq"], multipliers: Float[np.ndarray, "m"]) -> Float[np.ndarray, "nq nq"]:
        """Second derivatives of the rows times multipliers."""
        pull: Any = lambda q: multipliers @ self.coordinate_jacobian(q)
        rows = []
        for unit, scale in zip(np.eye(q.size), self.coordinate_scale, strict=True):
            if self.analytic:
                rows.append(pull(q + 1j * IMAGINARY * unit).imag / IMAGINARY)
                continue
            # Differences of fourth order.
            size = np.finfo(float).eps ** 0.2 * scale
            near, far = ((pull(q + n * size * unit) - pull(q - n * size * unit)) / (2 * n * size) for n in (1, 2))
            rows.append((4 * near - far) / 3)
        out = np.array(rows).reshape(q.size, q.size)
        return 0.5 * (out + out.T)

    def closest_velocities(
        self, q: Float[np.ndarray, "nq"], guess: Float[np.ndarray, "nu"], held: Bool[np.ndarray, "nu"], rank: int
    ) -> Float[np.ndarray, "nu"] | None:
        """The velocities closest to the guess with some rates held; None if the search fails."""
        if not self.velocity_rows:
            return guess
        # Implied nonlinear rows need a choice of independent rows, which this search does not make.
        if not self.linear and rank < self.velocity_rows:
            return None
        scale, u = np.where(held, 0.0, self.velocity_scale), guess
        for _ in range(2 if self.linear else _VELOCITIES):
            unmet, jacobian = self.velocity_rows_at(q, u)
            if not (np.all(np.isfinite(jacobian)) and np.all(np.isfinite(unmet))):
                return None
            if not held.any() and _rank(jacobian * scale) != rank:
                return None
            u = u - scale * np.linalg.lstsq(jacobian * scale, unmet, rcond=1e-10)[0]
        unmet, jacobian = self.velocity_rows_at(q, u)
        size = 1.0 + np.max(np.abs(jacobian) @ np.abs(u), initial=0.0)
        return u if np.max(np.abs(unmet), initial=0.0) <= 1e2 * tolerance(u.dtype) * size else None


def _rank(matrix):
    sizes = np.linalg.svd(matrix, compute_uv=False)
    return int(np.sum(sizes > independent_above(matrix.dtype) * np.max(sizes, initial=0.0)))
