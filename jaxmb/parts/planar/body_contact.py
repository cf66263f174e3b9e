"""Compliant contact between bodies in the plane: a disc of one body on plates or discs of others.

The laws are the same as for contact with terrain. The force is a function of the penetration depth, so contact adds no
constraint or event.
"""

import abc
import itertools
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...linalg.rotations import from_axis_angle, norm
from .. import fields
from ..base import AbstractPlanarPart, AbstractPotentialForce
from ..contact import AbstractFrictionLaw, AbstractNormalLaw
from ..shapes import Box
from ..smooth import ramp, step, without_pull
from ..space import round_shapes

Number = Float[Array, ""]
Vector = Float[Array, "2"]
# The numbers that describe a surface.
Surface = tuple[Array, ...]


class _Disc:
    """A disc whose centre is fixed in a body; `middle` is its centre in the world."""

    def __init__(self, pose, velocity, centre, space):
        self.pose, self.velocity, self.space = pose, velocity, space
        self.middle = space.point(pose, centre)

    def velocity_at(self, x):
        """The velocity of the body's point at a place of the world."""
        return self.space.point_velocity(self.pose, self.velocity, self.space.body_point(self.pose, x))

    def wrench(self, x, force):
        """The wrench on the body of a force at a place of the world."""
        return self.space.point_force(self.pose, self.space.body_point(self.pose, x), force)


class AbstractBodyContact(AbstractPlanarPart, AbstractPotentialForce):
    """Base class of contacts of one disc with other bodies. Subclasses define numbers for each other body (`surfaces`),
    the distance from its surface (`distance`) and the fraction of the force that acts (`share`). `distance` and `share`
    are functions of these numbers and of the disc's centre in the other body's frame.

    The depth is smoothed, and damping and friction act, as in `Contact`; a force and its reaction act along one line.

    **Arguments:**

    - `name`, of the contact; `bodies`: names, first the disc's body, then the others; a body touched at several places
        is repeated.
    - `normal`: `Linear`, `Hertz` or `Bekker`; `friction`: `Coulomb`, `Janosi` or None; all from `jaxmb.contact`.
    - `radius` [m] > 0 of the disc, and its `centre` [m], fixed in its body, default the origin of the frame.
    - `damping` [N s/m] ≥ 0, which acts fully from the depth `damping_depth` [m] > 0 on.
    - `smoothing` [m] > 0. At a distance d a depth of `smoothing² / (4 d)` remains.
    """

    name: str = fields.name()
    bodies: fields.Names = fields.body_names()
    normal: AbstractNormalLaw = fields.law(AbstractNormalLaw, what="a law from jaxmb.contact")
    friction: AbstractFrictionLaw | None = fields.law(
        AbstractFrictionLaw | None, what="a law from jaxmb.contact", default=None
    )
    radius: fields.Number = fields.length(sign="positive")
    centre: fields.Number = fields.point(body=0, default="origin")
    damping: fields.Number = fields.parameter(unit="N s/m", sign="non-negative", default=0.0)
    damping_depth: fields.Number = fields.parameter(unit="m", sign="positive", default=0.01)
    smoothing: fields.Number = fields.parameter(unit="m", sign="positive", default=1e-3)
    has_gaps: ClassVar[bool] = True
    touches: ClassVar[bool] = True

    several_from = 1

    @abc.abstractmethod
    def surfaces(self) -> Surface:
        """Numbers that describe the surfaces, with a row for each of the other bodies."""

    @abc.abstractmethod
    def distance(self, place: Vector, surface: Surface) -> Number:
        """Distance [m] of a point from the surface, both in the frame of the other body."""

    @abc.abstractmethod
    def share(self, place: Vector, surface: Surface) -> Number:
        """Fraction of the force, from 0 to 1, with the disc's centre at a point of the other body's frame."""

    def may_vary(self, keys):
        return keys[0] in ("normal", "friction", "damping", "damping_depth", "smoothing")

    def wrenches(self, space, poses, velocities, t):
        disc = _Disc(poses[0], velocities[0], self.centre, space)
        pair = lambda *other: self._pair(space, disc, *other)
        on_disc, on_others = jax.vmap(pair)(poses[1:], velocities[1:], self.surfaces())
        return jnp.concatenate([jnp.sum(on_disc, axis=0, keepdims=True), on_others])

    def energy(self, space, poses, t):
        centre = space.point(poses[0], self.centre)
        energy_of = lambda pose, surface: self._energy(space.body_point(pose, centre), surface)
        return jnp.sum(jax.vmap(energy_of)(poses[1:], self.surfaces()))

    def gaps(self, space, poses, t):
        centre = space.point(poses[0], self.centre)
        clearance_of = lambda pose, surface: self.clearance(space.body_point(pose, centre), surface)
        return jax.vmap(clearance_of)(poses[1:], self.surfaces())

    @property
    def gap_width(self):
        return self.smoothing

    def clearance(self, place: Vector, surface: Surface) -> Number:
        """Distance [m] of the disc from the region of force, negative inside it."""
        return self.distance(place, surface) - self.radius

    def shapes(self, space, size):
        return round_shapes(space, 0, self.radius, self.centre)

    def _depth(self, place, surface):
        """Depth of the disc's deepest point, smoothed."""
        return ramp(self.radius - self.distance(place, surface), self.smoothing)

    def _energy(self, place, surface):
        return self.share(place, surface) * self.normal.energy(self._depth(place, surface))

    def _pair(self, space, disc, pose, velocity, surface):
        """Wrenches on the disc's body and on another body."""
        place = space.body_point(pose, disc.middle)
        elastic = -space.direction(pose, jax.grad(self._energy)(place, surface))
        normal = space.direction(pose, jax.grad(self.distance)(place, surface))
        share, depth = self.share(place, surface), self._depth(place, surface)
        engaged, spring = share * step(depth / self.damping_depth), jnp.dot(elastic, normal)
        on_disc, on_others = self._losses(space, disc, pose[None], velocity[None], normal, engaged, spring)
        on_disc = on_disc + space.point_force(disc.pose, self.centre, elastic)
        return on_disc, on_others[0] + space.point_force(pose, place, -elastic)

    def _losses(self, space, disc, poses, velocities, normal, engaged, spring):
        """Wrenches of damping and friction on the disc's body, and, in equal parts, on the bodies that form the
        surface.

        **Arguments:** the fraction `engaged` of the damping; the force of the `spring` along the normal [N].
        """
        equal = 1.0 / len(poses)

        def surface_velocity(x):
            at = lambda pose, velocity: space.point_velocity(pose, velocity, space.body_point(pose, x))
            return equal * jnp.sum(jax.vmap(at)(poses, velocities), axis=0)

        def reactions(x, force):
            return jax.vmap(lambda pose: space.point_force(pose, space.body_point(pose, x), -equal * force))(poses)

        relative = disc.velocity_at(disc.middle) - surface_velocity(disc.middle)
        # Normal forces pass through the centre: their wrench is the same there as at the deepest point.
        damping = without_pull(spring, -self.damping * engaged * jnp.dot(relative, normal))
        push = damping * normal
        on_disc, on_others = disc.wrench(disc.middle, push), reactions(disc.middle, push)
        if self.friction is None:
            return on_disc, on_others
        touching = disc.middle - self.radius * normal
        along = lambda v: v - jnp.dot(v, normal) * normal
        slip = disc.velocity_at(touching) - surface_velocity(touching)
        rub = self.friction.force(spring + damping, engaged, along(slip), along(relative))
        return on_disc + disc.wrench(touching, rub), on_others + reactions(touching, rub)

    def _rows(self, value, shape):
        """A value for each other body, from one value for all or from one for each."""
        return jnp.broadcast_to(value, (len(self.bodies) - 1, *shape))

    def _check_rows(self, **shapes):
        n = len(self.bodies) - 1
        if n < 1:
            raise ValueError(
                f"{self.label}: bodies must name the disc's body and then at least one other body, got {n + 1}."
            )
        for field, shape in shapes.items():
            given = getattr(self, field).shape
            if given not in (shape, (n, *shape)):
                raise ValueError(f"{self.label}: {field} must have shape {shape} or {(n, *shape)}, got {given}.")


class PlateContact(AbstractBodyContact):
    """Contact of a disc with plates of other bodies, each a straight line between two points of its body.

    ```python
    ball = planar.Body("ball", mass=1.0, inertia=planar.disc(1.0, 0.1), position=(0.5, 0.3))
    plate = {"start": (-0.5, 0.0), "end": (0.5, 0.0)}
    on = planar.PlateContact("on", ("ball", "bar"), normal=jaxmb.contact.Linear(1e5), radius=0.1, **plate)
    system = jaxmb.Scene([bar, ball], joints=[pin], forces=[on]).compile()
    ```

    A plate bears on both sides: it pushes a disc to the side of the disc's centre. A disc whose centre is driven across
    the line leaves on the other side. Near the ends the force fades. The depth is measured from the plate's line; the
    potential is the energy of `normal` times a C² step, from one at the distance `edge` before the end to zero at the
    same distance behind the end. Two plates in line thus bear a disc like a single plate, at any depth.

    In a chain that bends away from the disc, neither plate bears at a corner. With `chain=True` the plates form a
    closed chain, each beginning at the end of the previous plate, and the corners bear as well. The depth at a corner
    is measured from the midpoint of the two ends; the potential is the energy of `normal` times the fraction left by
    both plates, and each plate takes half of the force.

    **Arguments:**

    - `start`, `end` [m] of the plates, fixed in their bodies, shape (2,) or (plates, 2).
    - `edge` [m] > 0, at most half as long as a plate.
    - `chain`: whether the plates, in the order of `bodies`, form a closed chain of at least three. Their ends meet at
        the given poses, within `edge`.
    """

    start: fields.Number = fields.parameter(shape=None, unit="m")
    end: fields.Number = fields.parameter(shape=None, unit="m")
    edge: fields.Number = fields.parameter(unit="m", sign="positive", default=0.01)
    chain: bool = eqx.field(static=True, default=False, kw_only=True)

    def validate(self):
        self._check_rows(start=(2,), end=(2,))
        if self.chain and len(self.bodies) < 4:
            raise ValueError(f"{self.label}: a closed chain has at least three plates, got {len(self.bodies) - 1}.")
        start, end = self.surfaces()
        shortest = float(jnp.min(norm(end - start)))
        if not 0 < 2 * self.edge <= shortest:
            raise ValueError(
                f"{self.label}: edge must be at most half as long as a plate, got {float(self.edge):g} m, with "
                f"{shortest:g} m from start to end."
            )

    def complete(self, space, poses):
        if self.chain:
            starts, ends = (jax.vmap(space.point)(poses[1:], end_points) for end_points in self.surfaces())
            apart = norm(jnp.roll(starts, -1, axis=0) - ends)
            k = int(jnp.argmax(apart))
            if apart[k] > self.edge:
                before, after = self.bodies[1 + k], [*self.bodies[1:], self.bodies[1]][k + 1]
                raise ValueError(
                    f"{self.label}: in a chain each plate must begin at the end of the previous plate, within edge, "
                    f"but the plate of {after!r} begins {float(apart[k]):g} m from the end of the plate of {before!r}; "
                    "join them, or leave chain out."
                )
        return self

    def surfaces(self):
        return self._rows(self.start, (2,)), self._rows(self.end, (2,))

    def shapes(self, space, size):
        # The bodies of a chain are plates themselves.
        plates = [] if self.chain else zip(*map(np.asarray, self.surfaces()), strict=True)
        return super().shapes(space, size) + tuple(
            (1 + k, _drawn(space, start, end, size)) for k, (start, end) in enumerate(plates)
        )

    def distance(self, place, surface):
        (_, across), _ = _along(place, *surface)
        return jnp.abs(across)

    def share(self, place, surface):
        (past, _), length = _along(place, *surface)
        return self._fade(past) * self._fade(length - past)

    def clearance(self, place, surface):
        # A corner of a chain bears a disc whose centre is beyond both plates.
        reach = jnp.maximum(self.edge, self.radius) if self.chain else self.edge
        (past, _), length = _along(place, *surface)
        outside = jnp.maximum(-past, past - length) - reach
        return jnp.maximum(super().clearance(place, surface), outside)

    def wrenches(self, space, poses, velocities, t):
        out = super().wrenches(space, poses, velocities, t)
        if not self.chain:
            return out
        disc = _Disc(poses[0], velocities[0], self.centre, space)
        corner = lambda *arguments: self._corner(space, disc, *arguments)
        on_disc, on_ends, on_starts = jax.vmap(corner)(*_corners(poses[1:], velocities[1:], *self.surfaces()))
        return out + jnp.concatenate(
            [jnp.sum(on_disc, axis=0, keepdims=True), on_ends + jnp.roll(on_starts, 1, axis=0)]
        )

    def energy(self, space, poses, t):
        out = super().energy(space, poses, t)
        if not self.chain:
            return out
        middle = space.point(poses[0], self.centre)

        def corner_energy(poses, _, starts, ends):
            first, second = (space.body_point(pose, middle) for pose in poses)
            return self._corner_energy(first, second, middle - _between(space, poses, starts, ends), starts, ends)

        return out + jnp.sum(jax.vmap(corner_energy)(*_corners(poses[1:], poses[1:], *self.surfaces())))

    def _fade(self, inside):
        return step(0.5 * (inside / self.edge + 1.0))

    def _corner_share(self, first, second, starts, ends):
        """The fraction left by both plates near the end of the first and the start of the second, without a kink."""
        (past, _), length = _along(first, starts[0], ends[0])
        (ahead, _), _ = _along(second, starts[1], ends[1])
        return step(1.0 - self._fade(length - past) - self._fade(ahead))

    def _corner_depth(self, way):
        return ramp(self.radius - norm(way), self.smoothing)

    def _corner_energy(self, first, second, way, starts, ends):
        return self._corner_share(first, second, starts, ends) * self.normal.energy(self._corner_depth(way))

    def _corner(self, space, disc, poses, velocities, starts, ends):
        """Wrenches at a corner on the disc's body, on the body of the plate that ends there, and on the body of the
        next plate.
        """
        first, second = (space.body_point(pose, disc.middle) for pose in poses)
        way = disc.middle - _between(space, poses, starts, ends)
        slopes = jax.grad(self._corner_energy, (0, 1, 2))(first, second, way, starts, ends)
        on_first, on_second = (space.direction(pose, slope) for pose, slope in zip(poses, slopes[:2], strict=True))
        share, depth = self._corner_share(first, second, starts, ends), self._corner_depth(way)
        engaged, normal = share * step(depth / self.damping_depth), way / norm(way)
        elastic = -(on_first + on_second + slopes[2])
        spring = jnp.dot(elastic, normal)
        on_disc, losses = self._losses(space, disc, poses, velocities, normal, engaged, spring)
        on_disc = on_disc + disc.wrench(disc.middle, elastic)

        def on_plate(pose, place, push, tip):
            return space.point_force(pose, place, push) + space.point_force(pose, tip, 0.5 * slopes[2])

        on_first = losses[0] + on_plate(poses[0], first, on_first, ends[0])
        return on_disc, on_first, losses[1] + on_plate(poses[1], second, on_second, starts[1])


def _drawn(space, start, end, size):
    """A plate as a picture shows it, as thick as half a bar."""
    length, angle = np.linalg.norm(end - start), np.arctan2(*(end - start)[::-1])
    turn = from_axis_angle((0.0, 0.0, 1.0), angle)
    return Box((length, size, size), position=space.in_space((start + end) / 2), orientation=turn)


def _along(place, start, end):
    """A point's coordinates along and across the line from start to end, and the length of the line."""
    way, d = end - start, place - start
    length = norm(way)
    return (jnp.dot(d, way) / length, (way[0] * d[1] - way[1] * d[0]) / length), length


def _corners(poses, velocities, starts, ends):
    """Pairs of consecutive plates of a closed chain, shapes (plates, 2, …)."""
    return tuple(jnp.stack([x, jnp.roll(x, -1, axis=0)], axis=1) for x in (poses, velocities, starts, ends))


def _between(space, poses, starts, ends):
    """The midpoint between the end of a plate and the start of the next."""
    return 0.5 * (space.point(poses[0], ends[0]) + space.point(poses[1], starts[1]))


class DiscContact(AbstractBodyContact):
    """Contact of a disc with discs of other bodies, from outside.

    ```python
    disc = {"mass": 1.0, "inertia": planar.disc(1.0, 0.1)}
    discs = [planar.Body("a", **disc), planar.Body("b", position=(0.5, 0.0), velocity=(-1.0, 0.0), **disc)]
    meet = planar.DiscContact("meet", ("a", "b"), normal=jaxmb.contact.Linear(1e5), radius=0.1, radii=0.1)
    system = jaxmb.Scene(discs, forces=[meet]).compile()
    ```

    **Arguments:**

    - `radii` [m] ≥ 0 of the other discs, shape () or (others,), 0 for points.
    - `centres` [m] of the other discs, fixed in their bodies, shape (2,) or (others, 2), default the
        origins of the frames.
    """

    radii: fields.Number = fields.length(shape=None, sign="non-negative")
    centres: fields.Number = fields.parameter(shape=None, unit="m", default=(0.0, 0.0))

    def validate(self):
        self._check_rows(radii=(), centres=(2,))

    def shapes(self, space, size):
        n = len(self.bodies) - 1
        centres, radii = np.broadcast_to(self.centres, (n, 2)), np.broadcast_to(self.radii, n)
        others = (round_shapes(space, k + 1, radii[k], centres[k]) for k in range(n))
        return (*super().shapes(space, size), *itertools.chain(*others))

    def surfaces(self):
        return self._rows(self.radii, ()), self._rows(self.centres, (2,))

    def distance(self, place, surface):
        radius, centre = surface
        return norm(place - centre) - radius

    def share(self, place, surface):
        del surface
        return jnp.ones((), place.dtype)
