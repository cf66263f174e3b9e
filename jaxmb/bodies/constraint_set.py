"""The rows of the constraints of a scene, group by group, or of all elementary joints together."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar
from ..linalg.sums import unchecked_take
from .elementary import ElementaryRows, is_elementary
from .groups import AbstractConstraintGroup, BodyPoses, BodyVelocities, NonIdealGroup


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
        wrenches, bodies = [], []
        if self.elements is not None:
            known = np.concatenate([np.full(count, is_elementary(g)) for g, count in self._counts])
            own = multipliers if known.all() else unchecked_take(multipliers, np.flatnonzero(known))
            wrenches.append(self.elements.wrenches(poses, own)[:, None])
            bodies.append(np.arange(self.elements.places.ground)[:, None])
        for g, own in self._of_groups(multipliers):
            if self.elements is None or not is_elementary(g):
                wrenches.append(g.wrenches(t, poses, velocities, own))
                bodies.append(g.group.body_index)
        return wrenches, bodies

    def reactions(
        self,
        laws: Sequence[NonIdealGroup],
        t: Scalar,
        poses: BodyPoses,
        velocities: BodyVelocities,
        multipliers: Float[Array, "rows"],
    ) -> list[Float[Array, "parts k v"]]:
        """The wrenches of the joints of non-ideal laws on the bodies of these, law group by law group."""
        named, wrenches, bodies = {name for g in laws for name in g.joints}, [], []
        known = None if self.elements is None else self.elements.jacobian(poses)
        first = 0
        for g, own in self._of_groups(multipliers):
            # From the matrix A, which the equation needs as well.
            if known is not None and is_elementary(g):
                blocks = lambda known=known, at=first, n=own.size: known[at : at + n]
                first += own.size
            else:
                blocks = lambda g=g: g.jacobian(t, poses, velocities)
            if named.isdisjoint(g.group.names):
                continue
            of_parts = blocks().reshape(*own.shape, len(g.group.bodies[0]), -1)
            wrenches.append(jnp.sum(own[..., None, None] * of_parts, axis=1).reshape(-1))
            bodies.append((g.group.names, g.group.bodies))
        reactions = jnp.concatenate([*wrenches, jnp.zeros(1, poses.dtype)])
        # A joint may be made of several constraints, all between the same bodies.
        take = lambda g: unchecked_take(reactions, g.group.layout.reaction_source(bodies, g.joints))
        of_joints = [jnp.sum(take(g), axis=1) for g in laws]
        # Scalar coordinates that a law has beyond those of its joint take no reaction.
        more = [len(g.group.bodies[0]) - own.shape[1] for g, own in zip(laws, of_joints, strict=True)]
        return [jnp.pad(own, ((0, 0), (0, k), (0, 0))) for own, k in zip(of_joints, more, strict=True)]

    def nonideal_wrenches(
        self,
        laws: Sequence[NonIdealGroup],
        t: Scalar,
        poses: BodyPoses,
        velocities: BodyVelocities,
        multipliers: Float[Array, "rows"],
    ) -> list[Float[Array, "parts k v"]]:
        """Wrenches of non-ideal laws on the bodies of their joints, group by group."""
        reactions = self.reactions(laws, t, poses, velocities, multipliers)
        return [g.wrenches(t, poses, velocities, own) for g, own in zip(laws, reactions, strict=True)]

    @property
    def _counts(self):
        """The groups with the numbers of their rows."""
        return [(g, len(g.group.names) * g.rows) for g in self.groups]

    def _of_groups(self, multipliers: Float[Array, "rows"]) -> list[tuple[Any, Float[Array, "parts rows"]]]:
        """The groups with the multipliers of their parts."""
        ends = np.cumsum([count for _, count in self._counts])
        pieces = jnp.split(multipliers, ends[:-1]) if self.groups else []
        return [(g, own.reshape(-1, g.rows)) for g, own in zip(self.groups, pieces, strict=True)]

    def _rows(self, of_elements: Callable[[ElementaryRows], Array], of_group: Callable[[Any], Array]) -> list[Array]:
        if self.elements is None:
            return [of_group(g) for g in self.groups]
        known, out, first = of_elements(self.elements), [], 0
        if all(map(is_elementary, self.groups)):
            return [known]
        for g, count in self._counts:
            if is_elementary(g):
                out.append(known[first : first + count])
                first += count
            else:
                out.append(of_group(g))
        return out
