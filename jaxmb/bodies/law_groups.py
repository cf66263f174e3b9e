"""Stacked contacts and dry friction: their rows of A at a place, and the bias of their accelerations in motion.

A law has a row `gap = 0` or `slip = 0` while it acts, and otherwise a row that keeps its mode. The rows of acting laws
are computed once at an instant, for all laws, whether they act or not. Residuals, γ, constraint forces, forces of
sliding friction, and the rates and accelerations of gaps and slips are products with them.
"""

import abc
import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._types import Scalar
from ..linalg.blocks import vector_products
from ..linalg.rotations import norm
from ..linalg.sums import unchecked_take
from ..parts.dry_friction import AbstractStickSlip
from ..parts.modes import CLOSED, STICK, kind_of
from ..parts.unilateral import AbstractSurfaceContact, AbstractUnilateralConstraint
from ..system.contact_set import StackedLaws
from .groups import (
    AbstractConstraintGroup,
    BodyPoses,
    BodyVelocities,
    ConstraintGroup,
    Group,
    Kinematics,
    NonIdealGroup,
    Placed,
    VelocityConstraintGroup,
)
from .touch import gap_gradient, gap_motion, gap_rows, slip_motion, slip_rows, touch_at


class LawPlace(NamedTuple):
    """The laws of a group as if all acted, at a place.

    **Fields:** their `rows` of A, body by body; of contacts the `gap`, otherwise None; of contacts of a ball with a
    surface the `touch`, otherwise None.
    """

    rows: Float[Array, "parts rows k v"]
    gap: Float[Array, "parts"] | None
    touch: Any


class LawMotion(NamedTuple):
    """The laws of a group as if all acted, in motion.

    **Fields:** the `rate` of gaps, or the velocities of slip; the `bias`: their derivatives without accelerations; of
    contacts of a ball with a surface, the rates of the `touch`.
    """

    rate: Float[Array, "parts rows"]
    bias: Float[Array, "parts rows"]
    touch: Any


class AbstractLawGroup(AbstractConstraintGroup):
    """Kernels of stacked laws.

    **Fields:** its `number` among the groups of laws.
    """

    number: eqx.AbstractVar[int]
    # The mode of a law that acts.
    acting: eqx.AbstractVar[float]

    @abc.abstractmethod
    def place(self, t: Scalar, poses: BodyPoses, before: Sequence[LawPlace]) -> LawPlace:
        """The rows; `before`: the places of the groups of laws before this."""

    @abc.abstractmethod
    def motion(self, now: Kinematics, before: Sequence[LawMotion]) -> LawMotion:
        """The rates and biases; `now` has the places of all laws."""

    def laws(self, t: Scalar) -> StackedLaws:
        """The contact laws of the rows."""
        part, kernels = self.group.at(t), dict(self.group.kernels)
        asked = tuple((name, kernels[name]) for name in part.contact_law.asked if name in kernels)
        laws = part if asked else part.contact_law

        def of_rows(leaf):
            # Numbers of parts count for each of their rows; those of rows are in order.
            if not asked and leaf.ndim == 2:
                return leaf.reshape(-1)
            return leaf if self.rows == 1 else jnp.repeat(leaf, self.rows, axis=0)

        return StackedLaws(jax.tree.map(of_rows, laws), asked)

    def acts(self, poses: BodyPoses) -> Bool[Array, "parts rows"]:
        """Which laws act."""
        return kind_of(self._of_modes(poses)) == self.acting

    def _of_modes(self, of_bodies):
        return self.group.gather(of_bodies)[:, -self.rows :, 0]

    def jacobian(self, now):
        return self._with_modes(now.poses, now.places[self.number].rows)

    def _with_modes(self, poses, rows):
        """Rows of laws that act, and of the modes of others."""
        *_, k, size = rows.shape
        of_modes = np.zeros((self.rows, k, size), rows.dtype)
        of_modes[np.arange(self.rows), k - self.rows + np.arange(self.rows), 0] = 1.0
        return jnp.where(self.acts(poses)[..., None, None], rows, of_modes)

    def velocity(self, now):
        return jnp.where(self.acts(now.poses), now.motions[self.number].rate, self._of_modes(now.velocities))

    def wrenches(self, now, multipliers):
        return jnp.sum(multipliers[..., None, None] * self.jacobian(now), axis=1)

    def acceleration(self, now, accelerations):
        along = jnp.sum(now.places[self.number].rows * self.group.gather(accelerations)[:, None], axis=(2, 3))
        along = along + now.motions[self.number].bias
        return jnp.where(self.acts(now.poses), along, self._of_modes(accelerations))

    def _padded(self, rows):
        """The rows with zeros for the modes, which are the last of the bodies."""
        return jnp.pad(rows, ((0, 0), (0, 0), (0, self.group.body_index.shape[1] - rows.shape[2]), (0, 0)))


class ContactGroup(AbstractLawGroup, ConstraintGroup):
    """Kernels of stacked contacts. Contacts of a ball with a surface have their rows in closed form, stops of joints
    that know their rates by these, others by automatic differentiation of their gap.
    """

    number: int = eqx.field(static=True, default=-1)
    acting: ClassVar[float] = CLOSED

    @property
    def is_contact(self):
        return True

    @property
    def of_surfaces(self) -> bool:
        """Whether the rows have a closed form."""
        return self._plain and not self.group.part.body_frames and isinstance(self.group.part, AbstractSurfaceContact)

    @property
    def _of_rates(self) -> bool:
        """Whether the rates of gaps are known."""
        return self._plain and self.group.part.knows_gap_rate

    @property
    def _plain(self) -> bool:
        """Whether the parts are constant, and none of their kernels is a user's."""
        return not self.group.inputs and not self.group.kernels

    def _gap(self, at, t, x):
        part = at(t)
        return self.group.kernel("gap")(part, part.seen_poses(self._space, x))[None]

    def place(self, t, poses, before):
        space, n = self._space, self.rows

        def of_surface(at, x):
            part, x = at(t), x[:-n]
            touch = touch_at(space, part, x)
            return gap_rows(space, part, x, touch), part.clearance(touch.seen), touch

        def by_gap(at, x):
            x = x[:-n]
            value, pull = jax.vjp(lambda x: self._gap(at, t, x), x)
            return jax.vmap(space.pull_back)(x, *pull(jnp.ones_like(value)))[None], value[0], None

        def by_rate(at, x):
            x, part = x[:-n], at(t)
            _, pull = jax.vjp(lambda v: part.gap_rate(space, x, v), _at_rest(space, x))
            return pull(jnp.ones((), x.dtype))[0][None], part.gap(space, x), None

        rows, *others = self._map(of_surface if self.of_surfaces else by_rate if self._of_rates else by_gap, poses)
        return LawPlace(self._padded(rows), *others)

    def along(self, t, poses, moves):
        space, n = self._space, self.rows

        def single(at, x, moves):
            if self.of_surfaces:
                gradient = gap_gradient(space, at(t), x[:-n])
            else:
                gradient = jax.grad(lambda x: self._gap(at, t, x)[0])(x[:-n])
            return vector_products(moves[:-n], gradient)

        return self._with_modes(poses, self._padded(self._map(single, poses, moves)[:, None]))

    def motion(self, now, before):
        space, n, t, touch = self._space, self.rows, now.t, now.places[self.number].touch

        def of_surface(at, x, v, touch):
            rate, bias, rates = gap_motion(space, at(t), x[:-n], v[:-n], touch)
            return LawMotion(rate[None], bias[None], rates)

        def by_gap(at, x, v):
            x, v = x[:-n], v[:-n]
            rates = lambda x: jax.vmap(space.rates)(x, v)
            along = rates(x), jax.jvp(rates, (x,), (rates(x),))[1]

            def rate(t, x, xdot):
                gap = lambda t, x: self._gap(at, t, x)
                return jax.jvp(gap, (t, x), (jnp.ones_like(t), xdot))[1]

            value, bias = jax.jvp(rate, (t, x, along[0]), (jnp.ones_like(t), *along))
            return LawMotion(value, bias, None)

        def by_rate(at, x, v):
            part, x, v = at(t), x[:-n], v[:-n]
            rate, bias = jax.jvp(lambda x: part.gap_rate(space, x, v), (x,), (jax.vmap(space.rates)(x, v),))
            return LawMotion(rate[None], bias[None], None)

        if touch is None:
            return self._map(by_rate if self._of_rates else by_gap, now.poses, now.velocities)
        return self._map(of_surface, now.poses, now.velocities, per_part=(touch,))


class FrictionGroup(AbstractLawGroup, VelocityConstraintGroup):
    """Kernels of stacked dry friction. In contacts of a ball with a surface its rows follow from the contacts' touch,
    in others and in joints by automatic differentiation of its slip.

    **Fields:** `joints`: the name of each part's joint or contact; `against`: the number of the group of its contacts
    and their places there, None in joints.
    """

    joints: tuple[str, ...] = eqx.field(static=True, default=())
    number: int = eqx.field(static=True, default=-1)
    against: tuple[int, tuple[int, ...]] | None = eqx.field(static=True, default=None)
    acting: ClassVar[float] = STICK

    @property
    def is_friction(self):
        return True

    @property
    def law(self) -> "SlipLaws":
        """The laws of friction that slips."""
        return SlipLaws(self.group, self.joints, self.number, self.against)

    def _touch(self, laws):
        """The touch of its contacts, or its rates, if its rows follow from them: slip that a user defines does not."""
        return None if self.group.kernels else touch_of(self.against, laws)

    def _slips(self, at, t, x, v):
        part = at(t)
        return self.group.kernel("slips")(part, *part.seen(self._space, x, v))

    def place(self, t, poses, before):
        space, touch = self._space, self._touch(before)
        if touch is None:
            single = lambda at, x: jax.jacfwd(lambda v: self._slips(at, t, x, v))(_at_rest(space, x))
            return LawPlace(self._map(single, poses), None, None)
        n, pole = self._bodies, self.group.part.pole
        rows = self._map(lambda at, x, touch: slip_rows(space, pole, x[:n], touch), poses, per_part=(touch,))
        return LawPlace(self._padded(rows), None, touch)

    def motion(self, now, before):
        space, t, touch = self._space, now.t, now.places[self.number].touch
        if touch is None:

            def by_slip(at, x, v):
                slips = lambda t, x: self._slips(at, t, x, v)
                along = jnp.ones_like(t), jax.vmap(space.rates)(x, v)
                slip, bias = jax.jvp(slips, (t, x), along)
                return LawMotion(slip, bias, None)

            return self._map(by_slip, now.poses, now.velocities)
        n = self._bodies

        def of_touch(at, x, v, touch, rates):
            part = at(t)
            slips, bias = slip_motion(space, part.pole, x[:n], v[:n], touch, rates)
            return LawMotion(part.over_belt(slips), bias, None)

        return self._map(of_touch, now.poses, now.velocities, per_part=(touch, self._touch(before)))

    @property
    def _bodies(self) -> int:
        """The number of the contact's bodies, which are the first of the friction's."""
        return len(self.group.part.joints["0"].bodies)


class SlipLaws(NonIdealGroup):
    """Kernels of the laws of stacked dry friction that slips."""

    number: int = eqx.field(static=True, default=-1)
    against: tuple[int, tuple[int, ...]] | None = eqx.field(static=True, default=None)

    def sizes(self, places: Sequence[LawPlace]) -> Float[Array, "parts"]:
        """The normal forces of contacts by unit multipliers of their gaps; 1 in joints."""
        if self.against is None:
            return jnp.ones(len(self.group.names), places[self.number].rows.dtype)
        number, members = self.against
        rows, _, touch = places[number]
        if touch is not None and touch.size is None:
            return jnp.ones(len(members), rows.dtype)
        forces = rows[:, 0, self.group.part.last, : self._space.dimension]
        return unchecked_take(norm(forces), np.array(members))

    def wrenches(self, now, reactions):
        space = self._space

        def forces(at, x, slips, reaction):
            part = at(now.t)
            return part.slip_forces(space, part.seen_poses(space, x), slips, part.seen_wrenches(space, x, reaction))

        along = self._map(forces, now.poses, per_part=(now.motions[self.number].rate, reactions))
        return jnp.sum(along[..., None, None] * now.places[self.number].rows, axis=1)


def places_of(groups: Sequence[Any], t: Scalar, poses: BodyPoses) -> Placed:
    """A scene at rest, with the places of the laws among some groups, which are in the order of their numbers."""
    places: tuple[LawPlace, ...] = ()
    for g in laws_among(groups):
        places = (*places, g.place(t, poses, places))
    return Placed(t, poses, places)


def motions_of(groups: Sequence[Any], placed: Placed, velocities: BodyVelocities) -> Kinematics:
    """The scene in motion, with the motions of the laws."""
    now = Kinematics(placed.t, placed.poses, velocities, placed.places)
    for g in laws_among(groups):
        now = now._replace(motions=(*now.motions, g.motion(now, now.motions)))
    return now


def laws_among(groups: Sequence[Any]) -> tuple[AbstractLawGroup, ...]:
    """The groups of contacts and of dry friction."""
    return tuple(g for g in groups if isinstance(g, AbstractLawGroup))


def touch_of(against: tuple[int, tuple[int, ...]] | None, laws: Sequence[Any]) -> Any:
    """What some contacts have as `touch` at their places in a group, one for each friction; None in joints."""
    if against is None or laws[against[0]].touch is None:
        return None
    number, places = against
    return jax.tree.map(lambda values: unchecked_take(values, np.array(places)), laws[number].touch)


def constraint_group(group: Group) -> ConstraintGroup:
    """The kernels of stacked contacts or other constraints."""
    return (ContactGroup if isinstance(group.part, AbstractUnilateralConstraint) else ConstraintGroup)(group)


def velocity_group(group: Group, of_joint: Mapping[str, str]) -> VelocityConstraintGroup:
    """The kernels of stacked dry friction, whose joints have these names, or of other velocity constraints."""
    if not isinstance(group.part, AbstractStickSlip):
        return VelocityConstraintGroup(group)
    return FrictionGroup(group, joints=tuple(of_joint[name] for name in group.names))


def numbered(
    position: Sequence[Any], velocity: Sequence[Any]
) -> tuple[tuple[ConstraintGroup, ...], tuple[VelocityConstraintGroup, ...]]:
    """The same groups of constraints, of which those of contacts and dry friction have their numbers."""
    contacts, numbers = [g for g in position if g.is_contact], itertools.count()

    def of_contacts(joints):
        groups = [k for k, g in enumerate(contacts) if joints[0] in g.group.names]
        return (groups[0], tuple(contacts[groups[0]].group.names.index(name) for name in joints)) if groups else None

    first = tuple(dataclasses.replace(g, number=next(numbers)) if g.is_contact else g for g in position)
    last = (
        dataclasses.replace(g, number=next(numbers), against=of_contacts(g.joints)) if g.is_friction else g
        for g in velocity
    )
    return first, tuple(last)


def _at_rest(space, x):
    return jnp.zeros((len(x), space.velocity_size), x.dtype)
