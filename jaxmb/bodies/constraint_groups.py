"""Stacked constraints of positions, of velocities, and of accelerations."""

import abc
import dataclasses
import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Scalar
from ..parts.servo import Servo
from .groups import AbstractGroup, Group, along_moves


class AbstractConstraintGroup(AbstractGroup):
    """Kernels of stacked constraints."""

    @abc.abstractmethod
    def velocity(
        self, t: Scalar, poses: Float[Array, "b_ground p"], velocities: Float[Array, "b_ground v"]
    ) -> Float[Array, "parts rows"]:
        """Residuals of the velocity constraints, or rates of the position constraints."""

    @abc.abstractmethod
    def jacobian(
        self, t: Scalar, poses: Float[Array, "b_ground p"], velocities: Float[Array, "b_ground v"]
    ) -> Float[Array, "parts rows k v"]:
        """Derivative with respect to velocities, body by body."""

    @abc.abstractmethod
    def wrenches(
        self,
        t: Scalar,
        poses: Float[Array, "b_ground p"],
        velocities: Float[Array, "b_ground v"],
        multipliers: Float[Array, "parts rows"],
    ) -> Float[Array, "parts k v"]:
        """Wrenches of the constraints on their bodies, `Aᵀ λ` body by body."""

    @abc.abstractmethod
    def wrench_derivatives(
        self,
        t: Scalar,
        poses: Float[Array, "b_ground p"],
        velocities: Float[Array, "b_ground v"],
        multipliers: Float[Array, "parts rows"],
    ) -> Float[Array, "parts k v k v"]:
        """Derivatives of `wrenches` with respect to displacements along the velocities of the parts' bodies."""

    @abc.abstractmethod
    def acceleration(
        self,
        t: Scalar,
        poses: Float[Array, "b_ground p"],
        velocities: Float[Array, "b_ground v"],
        accelerations: Float[Array, "b_ground v"],
    ) -> Float[Array, "parts rows"]:
        """The time derivative of `velocity`."""

    @property
    def rows(self) -> int:
        return self.group.rows

    @property
    def _space(self):
        return self.group.layout.space

    def _map(self, kernel, *of_bodies, more=()):
        """`kernel(at, …)` of every part, with the rows of its bodies, and with `more` per part."""
        return self.group.map(kernel, *map(self.group.gather, of_bodies), *more)


class ConstraintGroup(AbstractConstraintGroup):
    """Kernels of stacked position constraints."""

    @property
    def rheonomic(self) -> bool:
        """Whether the residuals depend on time."""
        return self.group.part.rheonomic or bool(self.group.inputs)

    def _residual(self, at, t, x):
        part = at(t)
        return part.residual(self._space, part.seen_poses(self._space, x), t)

    def residual(self, t: Scalar, poses: Float[Array, "b_ground p"]) -> Float[Array, "parts rows"]:
        return self._map(lambda at, x: self._residual(at, t, x), poses)

    def coordinates(self, t: Scalar, poses: Float[Array, "b_ground p"]) -> dict[str, Float[Array, "parts *shape"]]:
        """The joints' own coordinates, by name within the joint."""
        return self._map(lambda at, x: at(t).coordinates_at(self._space, x), poses)

    def along(
        self, t: Scalar, poses: Float[Array, "b_ground p"], moves: Float[Array, "b_ground n p"]
    ) -> Float[Array, "parts rows k n"]:
        """Derivatives along `n` motions of every body, one at a time."""

        def single(at, x, moves):
            def along_one(body):
                residual = lambda own: self._residual(at, t, x.at[body].set(own))
                push = lambda dx: jax.jvp(residual, (x[body],), (dx,))[1]
                return jax.vmap(push, out_axes=-1)(moves[body])

            # One body moves, the others rest.
            return jnp.stack([along_one(body) for body in range(len(moves))], axis=1)

        return self._map(single, poses, moves)

    def jacobian(self, t, poses, velocities):
        del velocities
        moves = jax.vmap(self._space.moves)(poses)
        return self.along(t, poses, moves)

    def velocity(self, t, poses, velocities):
        return self._map(lambda at, x, xdot: self._rate(at, t, x, xdot), poses, self._rates(poses, velocities))

    def wrenches(self, t, poses, velocities, multipliers):
        del velocities
        return self._map(functools.partial(self._wrench, t), poses, more=(multipliers,))

    def _wrench(self, t, at, x, multipliers):
        _, pull = jax.vjp(lambda x: self._residual(at, t, x), x)
        return jax.vmap(self._space.pull_back)(x, *pull(multipliers))

    def wrench_derivatives(self, t, poses, velocities, multipliers):
        del velocities
        single = lambda at, x, own: along_moves(self._space, lambda x: self._wrench(t, at, x, own), x)
        return self._map(single, poses, more=(multipliers,))

    def acceleration(self, t, poses, velocities, accelerations):
        rates = self._rates(poses, velocities)
        _, second = jax.jvp(self._rates, (poses, velocities), (rates, accelerations))

        def single(at, x, xdot, xddot):
            rate = lambda t, x, xdot: self._rate(at, t, x, xdot)
            return jax.jvp(rate, (t, x, xdot), (jnp.ones_like(t), xdot, xddot))[1]

        return self._map(single, poses, rates, second)

    def _rates(self, poses, velocities):
        return jax.vmap(self._space.rates)(poses, velocities)

    def _rate(self, at, t, x, xdot):
        """Velocity residuals of one part, from the rates of its bodies' poses."""
        if self.rheonomic:
            residual = lambda t, x: self._residual(at, t, x)
            return jax.jvp(residual, (t, x), (jnp.ones_like(t), xdot))[1]
        return jax.jvp(lambda x: self._residual(at, t, x), (x,), (xdot,))[1]


class VelocityConstraintGroup(AbstractConstraintGroup):
    """Kernels of stacked velocity constraints."""

    @property
    def homogeneous(self) -> bool:
        """Whether the residuals vanish at rest."""
        return self.group.part.homogeneous and not self.group.inputs

    def _residual(self, at, t, x, v):
        part, space = at(t), self._space
        return part.residual(space, *part.seen(space, x, v), t)

    def velocity(self, t, poses, velocities):
        return self._map(lambda at, x, v: self._residual(at, t, x, v), poses, velocities)

    def jacobian(self, t, poses, velocities):
        single = lambda at, x, v: jax.jacfwd(lambda w: self._residual(at, t, x, w))(v)
        return self._map(single, poses, velocities)

    def wrenches(self, t, poses, velocities, multipliers):
        return self._map(functools.partial(self._wrench, t), poses, velocities, more=(multipliers,))

    def _wrench(self, t, at, x, v, multipliers):
        return jax.vjp(lambda w: self._residual(at, t, x, w), v)[1](multipliers)[0]

    def wrench_derivatives(self, t, poses, velocities, multipliers):
        single = lambda at, x, v, own: along_moves(self._space, lambda x: self._wrench(t, at, x, v, own), x)
        return self._map(single, poses, velocities, more=(multipliers,))

    def acceleration(self, t, poses, velocities, accelerations):
        def single(at, x, xdot, v, a):
            residual = lambda t, x, v: self._residual(at, t, x, v)
            return jax.jvp(residual, (t, x, v), (jnp.ones_like(t), xdot, a))[1]

        rates = jax.vmap(self._space.rates)(poses, velocities)
        return self._map(single, poses, rates, velocities, accelerations)


class ServoGroup(AbstractConstraintGroup):
    """Kernels of stacked servos, which act on accelerations; `group` holds their programs."""

    damping: Float[Array, "parts"]
    stiffness: Float[Array, "parts"]

    def part(self, name=""):
        return Servo(super().part(name), self.damping, self.stiffness)

    @property
    def program(self) -> ConstraintGroup:
        return ConstraintGroup(self.group)

    def velocity(self, t, poses, velocities):
        return self.program.velocity(t, poses, velocities)

    def jacobian(self, t, poses, velocities):
        return self.program.jacobian(t, poses, velocities)

    def wrenches(self, t, poses, velocities, multipliers):
        return self.program.wrenches(t, poses, velocities, multipliers)

    def wrench_derivatives(self, t, poses, velocities, multipliers):
        return self.program.wrench_derivatives(t, poses, velocities, multipliers)

    def acceleration(self, t, poses, velocities, accelerations):
        second = self.program.acceleration(t, poses, velocities, accelerations)
        rate, value = self.program.velocity(t, poses, velocities), self.program.residual(t, poses)
        return second + self.damping[:, None] * rate + self.stiffness[:, None] * value


def servo_group(group: Group) -> ServoGroup:
    """From stacked servos."""
    part = group.part
    own = dataclasses.replace(group, part=part.program.with_fields(body_frames=part.body_frames))
    return ServoGroup(own, part.damping, part.stiffness)
