"""The constraints of a scene: the rows of position constraints, velocity constraints and servos, in this order."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._types import Scalar
from ..linalg.sums import unchecked_take
from ..parts.base import AbstractInertialConstraint
from ..system.contact_set import ContactMotion, ContactPlace
from .elementary import ElementaryRows, elementary_rows, half_turned, is_elementary
from .groups import (
    AbstractConstraintGroup,
    Acting,
    BodyPoses,
    BodyVelocities,
    ConstraintGroup,
    Kinematics,
    NonIdealGroup,
    Placed,
    VelocityConstraintGroup,
    joined,
)
from .law_groups import laws_among, motions_of, places_of
from .layout import Layout


class ConstraintSet(eqx.Module):
    """Groups of constraints with consecutive row numbers, and the laws of their joints.

    **Fields:** groups of `position` constraints, of `velocity` constraints, which include dry friction, and of
    `servos`; groups of `nonideal` laws; the `layout` of the bodies; `elements`: the rows of elementary joints in the
    position groups, None where all rows are computed group by group.
    """

    position: tuple[ConstraintGroup, ...]
    velocity: tuple[VelocityConstraintGroup, ...]
    servos: tuple[ConstraintGroup, ...]
    nonideal: tuple[NonIdealGroup, ...]
    layout: Layout = eqx.field(static=True)
    elements: ElementaryRows | None = None

    # Groups and their rows

    @property
    def groups(self) -> tuple[AbstractConstraintGroup, ...]:
        """All groups, in the order of the rows of A."""
        return (*self.position, *self.velocity, *self.servos)

    @property
    def contacts(self) -> tuple[Any, ...]:
        """The groups of contacts."""
        return tuple(g for g in self.position if g.is_contact)

    @property
    def frictions(self) -> tuple[Any, ...]:
        """The groups of dry friction."""
        return tuple(g for g in self.velocity if g.is_friction)

    @property
    def laws(self) -> tuple[NonIdealGroup, ...]:
        """The groups of non-ideal laws, then the laws of dry friction that slips."""
        return (*self.nonideal, *(g.law for g in self.frictions))

    @property
    def inertial(self) -> tuple[ConstraintGroup, ...]:
        """The groups of parts that have scalar coordinates."""
        return tuple(g for g in self.position if isinstance(g.group.part, AbstractInertialConstraint))

    @property
    def scalar_inertias(self) -> list[tuple[np.ndarray, Array]]:
        """Pairs for each group with moving scalar coordinates: the coordinates' indices, and their inertias."""
        # No force changes the velocity of a friction mode, so any inertia will do.
        modes = [
            (g.group.body_index[:, k], jnp.ones(len(g.group.names), jax.tree.leaves(g.group.part)[0].dtype))
            for g in self.frictions
            for k in range(-g.rows, 0)
        ]
        return [*((g.group.body_index[:, -1], g.group.part.inertia) for g in self.inertial), *modes]

    def prepared(self) -> "ConstraintSet":
        """The same set, with the rows of all elementary joints computed together."""
        elements = elementary_rows(self.position, self.layout.ground)
        return ConstraintSet(self.position, self.velocity, self.servos, self.nonideal, self.layout, elements)

    # The laws of contacts and dry friction at an instant, as if all acted

    def placed(self, t: Scalar, poses: BodyPoses) -> Placed:
        """The scene at rest, with the rows of the laws."""
        placed, laws = places_of(self.groups, t, poses), laws_among(self.groups)
        if not laws:
            return placed
        blocks = joined([*(place.rows for place in placed.places), jnp.zeros(1, poses.dtype)], poses.dtype)
        gaps = [place.gap for g, place in zip(laws, placed.places, strict=True) if g.is_contact]
        sizes = [jnp.repeat(g.law.sizes(placed.places), g.rows) for g in self.frictions]
        gradients = self._assembled(blocks, laws, of_poses=False)
        return placed._replace(contacts=ContactPlace(joined(gaps, poses.dtype), gradients, joined(sizes, poses.dtype)))

    def moving(self, placed: Placed, velocities: BodyVelocities) -> Kinematics:
        """The scene in motion, with the rates of the laws."""
        now = motions_of(self.groups, placed, velocities)
        if not now.motions:
            return now
        rates, biases = ([getattr(law, name) for law in now.motions] for name in ("rate", "bias"))
        return now._replace(contacts=ContactMotion(joined(rates, velocities.dtype), joined(biases, velocities.dtype)))

    # Residuals

    def residual(self, t: Scalar, poses: BodyPoses) -> Float[Array, "position_rows"]:
        """Position residuals."""
        pieces = self._pieces(self.position, lambda elements: elements.residual(poses), lambda g: g.residual(t, poses))
        return joined(pieces, poses.dtype)

    def velocity_residual(self, now: Kinematics) -> Float[Array, "velocity_rows"]:
        """Rates of position residuals, and velocity residuals."""
        groups = (*self.position, *self.velocity)
        of_elements = lambda elements: elements.velocity(now.poses, now.velocities)
        return joined(self._pieces(groups, of_elements, lambda g: g.velocity(now)), now.poses.dtype)

    def acceleration_residual(
        self, now: Kinematics, accelerations: BodyVelocities
    ) -> Float[Array, "acceleration_rows"]:
        """Time derivatives of `velocity_residual`, and residuals of servos."""
        of_elements = lambda elements: elements.acceleration(now.poses, now.velocities, accelerations)
        of_group = lambda g: g.acceleration(now, accelerations)
        return joined(self._pieces(self.groups, of_elements, of_group), now.poses.dtype)

    def half_turned(self, poses: BodyPoses) -> Bool[Array, "position_rows"]:
        """Which rows of elementary joints vanish at these poses although the joint is turned away from closing."""
        mask, turned = self._is_elementary(self.position), half_turned(self.position, poses)
        return turned if mask.all() else jnp.zeros(mask.size, bool).at[np.flatnonzero(mask)].set(turned)

    def _is_elementary(self, groups):
        """A mask of the rows of elementary joints among the rows of `groups`."""
        return np.concatenate([np.full(g.row_count, is_elementary(g)) for g in groups])

    # Jacobians

    def blocks(self, now: Kinematics, groups: Sequence[AbstractConstraintGroup]) -> Float[Array, "entries"]:
        """Derivatives of each row by the velocities of its bodies, group by group; a zero follows."""
        pieces = self._pieces(groups, lambda elements: elements.jacobian(now.poses), lambda g: g.jacobian(now))
        return joined([*pieces, jnp.zeros(1, now.poses.dtype)], now.poses.dtype)

    def jacobian(self, now: Kinematics, groups: Sequence[AbstractConstraintGroup]) -> Float[Array, "rows nu"]:
        """The rows of A of some groups."""
        return self._assembled(self.blocks(now, groups), groups, of_poses=False)

    def jacobian_of_poses(
        self, t: Scalar, poses: BodyPoses, counts: Sequence[ConstraintGroup]
    ) -> Float[Array, "rows nq"]:
        """Derivatives of position residuals and of the `counts` of turns by the coordinates."""
        space, moves = self.layout.space, None
        groups = (*self.position, *counts)
        if self.elements is None or not all(map(is_elementary, groups)):
            moves = jax.vmap(space.coordinate_moves)(poses)
        of_group: Any = lambda g: g.along(t, poses, moves)
        # In the plane rates of poses are velocities.
        of_rows = lambda elements: (
            elements.jacobian_of_poses(poses) if space.dimension == 3 else elements.jacobian(poses)
        )
        blocks = self._pieces(groups, of_rows, of_group)
        return self._assembled(joined([*blocks, jnp.zeros(1, poses.dtype)], poses.dtype), groups, of_poses=True)

    def _assembled(self, blocks, groups, *, of_poses):
        source = self.layout.jacobian_source([(g.group.body_index, g.rows) for g in groups], of_poses=of_poses)
        return unchecked_take(blocks, source)

    # Forces

    def wrenches(self, now: Kinematics, multipliers: Float[Array, "rows"]) -> list[Acting]:
        """Wrenches of all rows, `Aᵀ λ`."""
        out: list[Acting] = []
        if self.elements is not None:
            elementary = self._is_elementary(self.groups)
            of_elements = multipliers if elementary.all() else unchecked_take(multipliers, np.flatnonzero(elementary))
            wrenches = self.elements.wrenches(now.poses, of_elements)
            out.append((wrenches[:, None], np.arange(self.elements.places.ground)[:, None]))
        rest = [pair for pair in self.of_groups(multipliers) if self.elements is None or not is_elementary(pair[0])]
        return [*out, *((g.wrenches(now, of_group), g.group.body_index) for g, of_group in rest)]

    def reactions(
        self, laws: Sequence[NonIdealGroup], now: Kinematics, multipliers: Float[Array, "rows"]
    ) -> list[Float[Array, "parts k v"]]:
        """Reaction wrenches of the joints of non-ideal laws on the joints' bodies, one array for each law group. Laws
        that need multipliers get those, shape (parts, rows); laws that need nothing get zeros.
        """
        named, wrenches, bodies = {name for g in laws if g.needs == "wrenches" for name in g.joints}, [], []
        jacobian = None if self.elements is None else self.elements.jacobian(now.poses)
        first = 0
        for g, of_group in self.of_groups(multipliers):
            # A is computed already: the equation needs it too.
            if jacobian is not None and is_elementary(g):
                blocks = lambda jacobian=jacobian, at=first, n=of_group.size: jacobian[at : at + n]
                first += of_group.size
            else:
                blocks = lambda g=g: g.jacobian(now)
            if named.isdisjoint(g.group.names):
                continue
            of_parts = blocks().reshape(*of_group.shape, len(g.group.bodies[0]), -1)
            wrenches.append(jnp.sum(of_group[..., None, None] * of_parts, axis=1).reshape(-1))
            bodies.append((g.group.names, g.group.bodies))
        reactions = jnp.concatenate([*wrenches, jnp.zeros(1, now.poses.dtype)])

        def of_law(g):
            if g.needs == "nothing":
                return jnp.zeros((*g.group.body_index.shape, now.velocities.shape[1]), now.velocities.dtype)
            if g.needs in ("multipliers", "normal"):
                own = unchecked_take(multipliers, self._rows_of(g.joints))
                return own if g.needs == "multipliers" else own * g.sizes(now.places)[:, None]
            # A joint may be made of several constraints, all between the same bodies.
            of_joint = jnp.sum(unchecked_take(reactions, self.layout.reaction_source(bodies, g.joints)), axis=1)
            # A law may have more scalar coordinates than its joint; these take no reaction.
            return jnp.pad(of_joint, ((0, 0), (0, len(g.group.bodies[0]) - of_joint.shape[1]), (0, 0)))

        return [of_law(g) for g in laws]

    def _rows_of(self, names: Sequence[str]) -> np.ndarray:
        """The numbers of the rows of parts with these names, which have equally many."""
        rows = np.array([name for g in self.groups for name in g.group.names for _ in range(g.rows)])
        return np.stack([np.flatnonzero(rows == name) for name in names])

    def nonideal_wrenches(
        self, laws: Sequence[NonIdealGroup], now: Kinematics, multipliers: Float[Array, "rows"]
    ) -> list[Acting]:
        """Wrenches of non-ideal laws on the bodies of their joints, group by group."""
        reactions = self.reactions(laws, now, multipliers)
        return [(g.wrenches(now, reaction), g.group.body_index) for g, reaction in zip(laws, reactions, strict=True)]

    def of_groups(self, multipliers: Float[Array, "rows"]) -> list[tuple[Any, Float[Array, "parts rows"]]]:
        """Each group with the multipliers of its parts."""
        ends = np.cumsum([g.row_count for g in self.groups])
        pieces = jnp.split(multipliers, ends[:-1]) if self.groups else []
        return [(g, piece.reshape(-1, g.rows)) for g, piece in zip(self.groups, pieces, strict=True)]

    def _pieces(
        self,
        groups: Sequence[AbstractConstraintGroup],
        of_elements: Callable[[ElementaryRows], Array],
        of_group: Callable[[Any], Array],
    ) -> list[Array]:
        """Values of the rows of `groups`, as consecutive pieces."""
        if self.elements is None:
            return [of_group(g) for g in groups]
        of_rows, out, first = of_elements(self.elements), [], 0
        if all(map(is_elementary, groups)):
            return [of_rows]
        for g in groups:
            if is_elementary(g):
                out.append(of_rows[first : first + g.row_count])
                first += g.row_count
            else:
                out.append(of_group(g))
        return out
