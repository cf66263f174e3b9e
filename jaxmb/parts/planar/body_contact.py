"""Compliant contact between bodies in the plane: a disc of one body on plates or discs of others.

The laws are those of contact with terrain: the force is a function of the depth to which the disc has entered the other
body, so contact adds no constraint and no event.
"""

import abc

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...linalg.rotations import norm
from .. import fields
from ..base import AbstractPlanarPart, AbstractPotentialForce
from ..contact import AbstractFrictionLaw, AbstractNormalLaw
from ..smooth import ramp, step

Number = Float[Array, ""]
Vector = Float[Array, "2"]
# The numbers that describe a surface.
Surface = tuple[Array, ...]


class AbstractBodyContact(AbstractPlanarPart, AbstractPotentialForce):
    """Base class of contacts of one disc with other bodies. Subclasses define the numbers of each of the others
    (`surfaces`), and with these the distance of the disc's centre from its surface (`distance`) and how much of the
    force acts (`share`), as functions of the place of that centre in the other body's frame.
    """

    name: str = fields.name()
    bodies: fields.Names = fields.body_names()
    normal: AbstractNormalLaw = fields.law(AbstractNormalLaw, what="a law from jaxmb.contact")
    friction: AbstractFrictionLaw | None = fields.law(
        AbstractFrictionLaw | None, what="a law from jaxmb.contact", default=None
    )
    radius: fields.Number = fields.length(sign="positive")
    centre: fields.Number = fields.point(body=0, default="mass centre")
    damping: fields.Number = fields.parameter(unit="N s/m", sign="non-negative", default=0.0)
    damping_depth: fields.Number = fields.parameter(unit="m", sign="positive", default=0.01)
    smoothing: fields.Number = fields.parameter(unit="m", sign="positive", default=1e-3)

    @abc.abstractmethod
    def surfaces(self) -> Surface:
        """Numbers that describe the surfaces, with a row for each of the other bodies."""

    @abc.abstractmethod
    def distance(self, place: Vector, surface: Surface) -> Number:
        """Distance [m] of a point from the surface, both in the frame of the other body."""

    @abc.abstractmethod
    def share(self, place: Vector, surface: Surface) -> Number:
        """Fraction of the force, from 0 to 1, where the disc's centre is at a point of the other body's frame."""

    def wrenches(self, space, poses, velocities, t):
        centre = space.point(poses[0], self.centre)
        travel = space.point_velocity(poses[0], velocities[0], self.centre)
        own = lambda *other: self._pair(space, poses[0], velocities[0], centre, travel, *other)
        on_disc, on_others = jax.vmap(own)(poses[1:], velocities[1:], self.surfaces())
        return jnp.concatenate([jnp.sum(on_disc, axis=0, keepdims=True), on_others])

    def energy(self, space, poses, t):
        centre = space.point(poses[0], self.centre)
        own = lambda pose, surface: self._energy(space.body_point(pose, centre), surface)
        return jnp.sum(jax.vmap(own)(poses[1:], self.surfaces()))

    def _depth(self, place, surface):
        """Depth of the disc's deepest point, smoothed."""
        return ramp(self.radius - self.distance(place, surface), self.smoothing)

    def _energy(self, place, surface):
        return self.share(place, surface) * self.normal.energy(self._depth(place, surface))

    def _pair(self, space, disc, disc_velocity, centre, travel, pose, velocity, surface):
        """Wrenches on the disc's body and on another one."""
        place = space.body_point(pose, centre)
        elastic = -space.direction(pose, jax.grad(self._energy)(place, surface))
        normal = space.direction(pose, jax.grad(self.distance)(place, surface))
        share, depth = self.share(place, surface), self._depth(place, surface)
        engaged = share * step(depth / self.damping_depth)
        relative = travel - space.point_velocity(pose, velocity, place)
        # Normal forces pass through the centre, so that they have the same wrench there as at the deepest point.
        push = elastic - self.damping * engaged * jnp.dot(relative, normal) * normal
        on_disc = space.point_force(disc, self.centre, push)
        on_other = space.point_force(pose, place, -push)
        if self.friction is None:
            return on_disc, on_other
        touching = centre - self.radius * normal
        here, there = space.body_point(disc, touching), space.body_point(pose, touching)
        along = lambda v: v - jnp.dot(v, normal) * normal
        slip = space.point_velocity(disc, disc_velocity, here) - space.point_velocity(pose, velocity, there)
        load = share * self.normal.force(depth)
        rub = self.friction.force(load, engaged, along(slip), along(relative))
        return on_disc + space.point_force(disc, here, rub), on_other + space.point_force(pose, there, -rub)

    def _rows(self, value, shape):
        """A number given once, or once for each of the other bodies, as one for each."""
        return jnp.broadcast_to(value, (len(self.bodies) - 1, *shape))

    def _check_rows(self, **shapes):
        n = len(self.bodies) - 1
        if n < 1:
            raise ValueError(
                f"{self.label}: bodies must name the disc's body and then at least one other, got {n + 1}."
            )
        for field, shape in shapes.items():
            given = getattr(self, field).shape
            if given not in (shape, (n, *shape)):
                raise ValueError(f"{self.label}: {field} must have shape {shape} or {(n, *shape)}, got {given}.")


class PlateContact(AbstractBodyContact):
    """Contact of a disc with plates of other bodies, each a straight line between two points of its body.

    A plate bears on both sides: it pushes a disc to the side on which the disc's centre is, so one whose centre is
    driven across the line leaves on the other side. Near its ends the force fades: the depth is measured from the
    plate's line, and the potential is that of `normal` times a step with two continuous derivatives, from one at the
    distance `edge` before the end to zero as far behind it. A disc that rolls from a plate to the next one in line is
    thus borne by both as by one, whatever its depth.

    The depth is smoothed, and damping and friction act, as in `Contact`; forces and their reactions act on one line.

    **Arguments:**

    - `bodies`: names, first that of the disc's body, then those of the plates' bodies.
    - `normal`, `friction`: `Linear`, `Hertz` or `Bekker`; `Coulomb`, `Janosi` or None; from `jaxmb.contact`.
    - `radius` [m] > 0 of the disc, and its `centre` [m], fixed in its body, default the mass centre.
    - `start`, `end` [m] of the plates, fixed in their bodies, shape (2,) or (plates, 2).
    - `edge` [m] > 0, at most half as long as a plate.
    - `damping` [N s/m] ≥ 0, and `damping_depth` [m] > 0, the depth from which on it acts fully.
    - `smoothing` [m] > 0. At a distance d a depth of `smoothing² / (4 d)` remains.
    """

    start: fields.Number = fields.parameter(shape=None, unit="m")
    end: fields.Number = fields.parameter(shape=None, unit="m")
    edge: fields.Number = fields.parameter(unit="m", sign="positive", default=0.01)

    def validate(self):
        self._check_rows(start=(2,), end=(2,))
        start, end = self.surfaces()
        shortest = float(jnp.min(norm(end - start)))
        if not 0 < 2 * self.edge <= shortest:
            raise ValueError(
                f"{self.label}: edge must be at most half as long as a plate, got {float(self.edge):g} m, with "
                f"{shortest:g} m from start to end."
            )

    def surfaces(self):
        return self._rows(self.start, (2,)), self._rows(self.end, (2,))

    def distance(self, place, surface):
        (_, across), _ = _along(place, *surface)
        return jnp.abs(across)

    def share(self, place, surface):
        (past, _), length = _along(place, *surface)
        fade = lambda inside: step(0.5 * (inside / self.edge + 1.0))
        return fade(past) * fade(length - past)


def _along(place, start, end):
    """A point's coordinates along and across the way from start to end, and its length."""
    way, d = end - start, place - start
    length = norm(way)
    return (jnp.dot(d, way) / length, (way[0] * d[1] - way[1] * d[0]) / length), length


class DiscContact(AbstractBodyContact):
    """Contact of a disc with discs of other bodies, from outside.

    The depth is smoothed, and damping and friction act, as in `Contact`; forces and their reactions act on one line.

    **Arguments:**

    - `bodies`: names, first that of the body of `radius` and `centre`, then those of the others.
    - `normal`, `friction`, `radius`, `centre`, `damping`, `damping_depth`, `smoothing`: as in `PlateContact`.
    - `radii` [m] ≥ 0 of the other discs, shape () or (others,), 0 for points.
    - `centres` [m] of the other discs, fixed in their bodies, shape (2,) or (others, 2), default the mass centres.
    """

    radii: fields.Number = fields.length(shape=None, sign="non-negative")
    centres: fields.Number = fields.parameter(shape=None, unit="m", default=(0.0, 0.0))

    def validate(self):
        self._check_rows(radii=(), centres=(2,))

    def surfaces(self):
        return self._rows(self.radii, ()), self._rows(self.centres, (2,))

    def distance(self, place, surface):
        radius, centre = surface
        return norm(place - centre) - radius

    def share(self, place, surface):
        del surface
        return jnp.ones((), place.dtype)
