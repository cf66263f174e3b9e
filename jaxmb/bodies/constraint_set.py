"""The rows of the constraints of a scene, group by group, or of all elementary joints together."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar
from ..linalg.sums import unchecked_take
from .elementary import ElementaryRows, is_elementary
from .groups import AbstractConstraintGroup, BodyPoses, BodyVelocities, reaction_wrenches


class ConstraintSet(eqx.Module):
    """Groups of constraints, one after the other, whose rows are numbered through.

    **Fields:** `elements`: the rows of the groups that consist of elementary joints, None where all rows are computed
    group by group.
    """

    groups: tuple[AbstractConstraintGroup, ...]
    elements: ElementaryRows | None

    def residual(self, t: Scalar, poses: BodyPoses) -> list[Array]:
        """Position residuals, in pieces that follow each other."""
        return self._rows(lambda own: own.residual(poses), lambda g: g.residual(t, poses))

    def velocity(self, t: Scalar, poses: BodyPoses, velocities: BodyVelocities) -> list[Array]:
        """Velocity residuals, and rates of position residuals."""
        return self._rows(lambda own: own.velocity(poses, velocities), lambda g: g.velocity(t, poses, velocities))

    def acceleration(
        self, t: Scalar, poses: BodyPoses, velocities: BodyVelocities, accelerations: BodyVelocities
    ) -> list[Array]:
        """The time derivatives of `velocity`."""
        return self._rows(
            lambda own: own.acceleration(poses, velocities, accelerations),
            lambda g: g.acceleration(t, poses, velocities, accelerations),
        )

    def jacobian(self, t: Scalar, poses: BodyPoses, velocities: BodyVelocities) -> list[Array]:
        """Derivatives with respect to the velocities of the bodies of each row."""
        return self._rows(lambda own: own.jacobian(poses), lambda g: g.jacobian(t, poses, velocities))

    def jacobian_of_poses(
        self, t: Scalar, poses: BodyPoses, moves: Callable[[], Float[Array, "b_ground n p"]]
    ) -> list[Array]:
        """Derivatives with respect to the poses of the bodies of each row; `moves`: the rates of prepared poses along
        unit rates of poses.
        """
        return self._rows(lambda own: own.jacobian_of_poses(poses), lambda g: g.along(t, poses, moves()))

    def wrenches(
        self, t: Scalar, poses: BodyPoses, velocities: BodyVelocities, multipliers: Float[Array, "rows"]
    ) -> tuple[list[Float[Array, "_ k v"]], list[np.ndarray]]:
        """Wrenches of all rows, `Aᵀ λ`, and the bodies that they act on, (_, k)."""
        groups, wrenches, bodies = self.groups, [], []
        if self.elements is not None:
            ground = self.elements.places.ground
            known = np.concatenate([np.full(len(g.group.names) * g.rows, is_elementary(g)) for g in groups])
            own = multipliers if known.all() else unchecked_take(multipliers, np.flatnonzero(known))
            wrenches.append(self.elements.wrenches(poses, own)[:, None])
            bodies.append(np.arange(ground)[:, None])
            if known.all():
                return wrenches, bodies
            multipliers = unchecked_take(multipliers, np.flatnonzero(~known))
            groups = [g for g in groups if not is_elementary(g)]
        wrenches += reaction_wrenches(groups, t, poses, velocities, multipliers)
        return wrenches, bodies + [g.group.body_index for g in groups]

    def _rows(self, of_elements: Callable[[ElementaryRows], Array], of_group: Callable[[Any], Array]) -> list[Array]:
        if self.elements is None:
            return [of_group(g) for g in self.groups]
        known, out, first = of_elements(self.elements), [], 0
        if all(map(is_elementary, self.groups)):
            return [known]
        for g in self.groups:
            if is_elementary(g):
                count = len(g.group.names) * g.rows
                out.append(known[first : first + count])
                first += count
            else:
                out.append(of_group(g))
        return out
