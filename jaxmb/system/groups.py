"""Parts of one type, stacked: one kernel and one `vmap` serve any number of them."""

import abc
import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar
from ..linalg.arrays import unchecked_take
from ..parts.base import AbstractPart
from ..parts.fields import anonymous, entry, inner_parts
from ..parts.series import AbstractSignal
from ..parts.space import AbstractSpace
from .layout import Layout


class Input(eqx.Module):
    """A number of stacked parts that is a function of time: the parameter's name, the keys that lead to it in the
    part, and the number of the part.
    """

    signal: AbstractSignal
    name: str = eqx.field(static=True)
    keys: tuple[str, ...] = eqx.field(static=True)
    member: int = eqx.field(static=True)


class Group(eqx.Module):
    """Stacked parts. `part` has the structure of one part with a leading axis on every number; `inputs` replace some
    numbers by functions of time; `inner`: where the parts hold other parts, the keys that lead there and the names of
    these.
    """

    part: Any
    names: tuple[str, ...] = eqx.field(static=True)
    bodies: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    layout: Layout = eqx.field(static=True)
    inputs: tuple[Input, ...] = ()
    inner: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = eqx.field(static=True, default=())

    def map(self, kernel: Callable[..., Any], *per_part: Array) -> Any:
        """`kernel(at, …)` of every part with its rows of some arrays, where `at(t)` is the part at a time."""
        if not self.inputs:
            return jax.vmap(lambda part, *own: kernel(lambda t: part, *own))(self.part, *per_part)
        single = lambda member, part, *own: kernel(lambda t: self._at(member, part, t), *own)
        return jax.vmap(single)(jnp.arange(len(self.names)), self.part, *per_part)

    def single(self, member: int, t: Scalar) -> Any:
        """One part at a time."""
        return self._at(member, jax.tree.map(lambda leaf: leaf[member], self.part), t)

    def _at(self, member, part, t):
        """One part with its inputs at a time."""
        for own in self.inputs:
            where = lambda part, keys=own.keys: entry(part, keys)
            given = where(part)
            value = jnp.where(member == own.member, jnp.asarray(own.signal(t), given.dtype), given)
            part = eqx.tree_at(where, part, value)
        return part

    @property
    def body_index(self) -> np.ndarray:
        """Bodies of each part, shape (parts, k)."""
        return np.array(self.bodies)

    @property
    def rows(self) -> int:
        return self.part.rows

    def gather(self, of_bodies: Float[Array, "b_ground _"]) -> Float[Array, "parts k _"]:
        """Rows of each part's bodies, from those of all bodies and the ground."""
        return unchecked_take(of_bodies, self.body_index)


def stack(
    parts: Sequence[tuple[AbstractPart, tuple[int, ...]]],
    layout: Layout,
    check: Callable[[Any, AbstractSpace, int], None] | None = None,
) -> tuple[Group, ...]:
    """Group parts that share type, static fields and shapes; order of first appearance.

    **Arguments:** `parts` with the numbers of their bodies; `check(part, space, bodies)`: called for one part of each
    group.
    """
    groups: dict[Any, list] = {}
    for part, bodies in parts:
        leaves, structure = jtu.tree_flatten(anonymous(part))
        key = (structure, tuple(leaf.shape for leaf in leaves), len(bodies))
        if key not in groups and check is not None:
            check(part, layout.space, len(bodies))
        groups.setdefault(key, []).append((leaves, part.name, bodies, list(inner_parts(part))))
    out = []
    for key, members in groups.items():
        # NumPy, since XLA would compile a program for thousands of operands.
        columns = zip(*(member[0] for member in members), strict=True)
        leaves = [jax.device_put(np.stack([np.asarray(leaf) for leaf in column])) for column in columns]
        names, bodies = tuple(m[1] for m in members), tuple(m[2] for m in members)
        inner = tuple((keys, tuple(m[3][k][1].name for m in members)) for k, (keys, _) in enumerate(members[0][3]))
        out.append(Group(jtu.tree_unflatten(key[0], leaves), names, bodies, layout, inner=inner))
    return tuple(out)


class BodyGroup(eqx.Module):
    """Stacked bodies."""

    group: Group

    @property
    def mass(self) -> Float[Array, "parts"]:
        """Masses [kg]."""
        return jax.vmap(lambda body: body.mass)(self.group.part)

    @property
    def inertia(self) -> Float[Array, "parts *matrix"]:
        """Moments of inertia [kg m²] about the mass centres."""
        return jax.vmap(lambda body: body.inertia)(self.group.part)


class AbstractConstraintGroup(eqx.Module):
    """Kernels of stacked constraints."""

    group: Group

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

    def residual(self, t: Scalar, poses: Float[Array, "b_ground p"]) -> Float[Array, "parts rows"]:
        return self._map(lambda at, x: at(t).residual(self._space, x, t), poses)

    def coordinates(self, t: Scalar, poses: Float[Array, "b_ground p"]) -> dict[str, Float[Array, "parts *shape"]]:
        """The joints' own coordinates, by name within the joint."""
        return self._map(lambda at, x: at(t).coordinates(self._space, x), poses)

    def along(
        self, t: Scalar, poses: Float[Array, "b_ground p"], moves: Float[Array, "b_ground n p"]
    ) -> Float[Array, "parts rows k n"]:
        """Derivatives along `n` motions of every body, one at a time."""

        def single(at, x, moves):
            def along_one(body):
                residual = lambda own: at(t).residual(self._space, x.at[body].set(own), t)
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
        _, pull = jax.vjp(lambda x: at(t).residual(self._space, x, t), x)
        return jax.vmap(self._space.pull_back)(x, *pull(multipliers))

    def wrench_derivatives(self, t, poses, velocities, multipliers):
        del velocities
        single = lambda at, x, own: _along_moves(self._space, lambda x: self._wrench(t, at, x, own), x)
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
            residual = lambda t, x: at(t).residual(self._space, x, t)
            return jax.jvp(residual, (t, x), (jnp.ones_like(t), xdot))[1]
        return jax.jvp(lambda x: at(t).residual(self._space, x, t), (x,), (xdot,))[1]


class VelocityConstraintGroup(AbstractConstraintGroup):
    """Kernels of stacked velocity constraints."""

    @property
    def homogeneous(self) -> bool:
        """Whether the residuals vanish at rest."""
        return self.group.part.homogeneous and not self.group.inputs

    def velocity(self, t, poses, velocities):
        return self._map(lambda at, x, v: at(t).residual(self._space, x, v, t), poses, velocities)

    def jacobian(self, t, poses, velocities):
        single = lambda at, x, v: jax.jacfwd(lambda w: at(t).residual(self._space, x, w, t))(v)
        return self._map(single, poses, velocities)

    def wrenches(self, t, poses, velocities, multipliers):
        return self._map(functools.partial(self._wrench, t), poses, velocities, more=(multipliers,))

    def _wrench(self, t, at, x, v, multipliers):
        return jax.vjp(lambda w: at(t).residual(self._space, x, w, t), v)[1](multipliers)[0]

    def wrench_derivatives(self, t, poses, velocities, multipliers):
        single = lambda at, x, v, own: _along_moves(self._space, lambda x: self._wrench(t, at, x, v, own), x)
        return self._map(single, poses, velocities, more=(multipliers,))

    def acceleration(self, t, poses, velocities, accelerations):
        def single(at, x, xdot, v, a):
            residual = lambda t, x, v: at(t).residual(self._space, x, v, t)
            return jax.jvp(residual, (t, x, v), (jnp.ones_like(t), xdot, a))[1]

        rates = jax.vmap(self._space.rates)(poses, velocities)
        return self._map(single, poses, rates, velocities, accelerations)


def _along_moves(space: AbstractSpace, function: Callable[[Array], Array], x: Float[Array, "k p"]) -> Array:
    """Derivatives of a function of the poses of some bodies along their unit velocities, (…, k, v)."""
    moves = jax.vmap(space.moves)(x)
    k, size, _ = moves.shape
    _, push = jax.linearize(function, x)
    along = jnp.eye(k, dtype=x.dtype)[:, None, :, None] * moves[:, :, None, :]
    columns = jax.vmap(push, out_axes=-1)(along.reshape(k * size, *x.shape))
    return columns.reshape(*columns.shape[:-1], k, size)


class ForceGroup(eqx.Module):
    """Kernels of stacked forces."""

    group: Group

    def wrenches(
        self, t: Scalar, poses: Float[Array, "b_ground p"], velocities: Float[Array, "b_ground v"]
    ) -> Float[Array, "parts k v"]:
        single = lambda at, poses, v: at(t).wrenches(self.group.layout.space, poses, v, t)
        return self.group.map(single, self.group.gather(poses), self.group.gather(velocities))

    def state_rates(
        self, t: Scalar, poses: Float[Array, "b_ground p"], velocities: Float[Array, "b_ground v"]
    ) -> dict[str, Float[Array, "parts *shape"]]:
        """Rates of the parts' internal states, by the name of the field."""
        single = lambda at, poses, v: at(t).state_rates(self.group.layout.space, poses, v, t)
        return self.group.map(single, self.group.gather(poses), self.group.gather(velocities))

    def derivatives(
        self, t: Scalar, poses: Float[Array, "b_ground p"], velocities: Float[Array, "b_ground v"]
    ) -> tuple[Float[Array, "parts k v k v"], Float[Array, "parts k v k v"]]:
        """Derivatives of `wrenches` with respect to displacements along the velocities of the parts' bodies, and to the
        velocities.
        """
        space = self.group.layout.space

        def single(at, x, v):
            of_positions = _along_moves(space, lambda x: at(t).wrenches(space, x, v, t), x)
            return of_positions, jax.jacfwd(lambda v: at(t).wrenches(space, x, v, t))(v)

        return self.group.map(single, self.group.gather(poses), self.group.gather(velocities))

    def energy(self, t: Scalar, poses: Float[Array, "b_ground p"]) -> Float[Array, ""]:
        if not self.group.part.conservative:
            return jnp.zeros((), poses.dtype)
        single = lambda at, poses: at(t).energy(self.group.layout.space, poses, t)
        return jnp.sum(self.group.map(single, self.group.gather(poses)))


class TendonGroup(eqx.Module):
    """Stacked tendons."""

    group: Group

    def coordinates(self, t: Scalar, poses: Float[Array, "b_ground p"]) -> dict[str, Float[Array, "parts *shape"]]:
        """Their coordinates, by name within the tendon."""
        space = self.group.layout.space
        return self.group.map(lambda at, x: at(t).coordinates(space, x), self.group.gather(poses))


class FrameGroup(eqx.Module):
    """Stacked frames."""

    group: Group

    def poses(self, t: Scalar, poses: Float[Array, "b_ground p"]) -> Float[Array, "parts p"]:
        """Prepared poses of the frames."""
        space = self.group.layout.space
        return self.group.map(lambda at, x: at(t).pose(space, x[0]), self.group.gather(poses))

    def velocities(
        self, t: Scalar, poses: Float[Array, "b_ground p"], velocities: Float[Array, "b_ground v"]
    ) -> Float[Array, "parts v"]:
        """Velocities of the frames."""
        space = self.group.layout.space
        own = self.group.gather(poses), self.group.gather(velocities)
        return self.group.map(lambda at, x, v: at(t).velocity(space, x[0], v[0]), *own)


class ServoGroup(AbstractConstraintGroup):
    """Kernels of stacked servos, which act on accelerations; `group` holds their programs."""

    damping: Float[Array, "parts"]
    stiffness: Float[Array, "parts"]

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
    own = Group(part.program, group.names, group.bodies, group.layout)
    return ServoGroup(own, part.damping, part.stiffness)


class NonIdealGroup(eqx.Module):
    """Kernels of stacked non-ideal laws; `joints`: the joint's name for each."""

    group: Group
    joints: tuple[str, ...] = eqx.field(static=True)

    def wrenches(
        self,
        t: Scalar,
        poses: Float[Array, "b_ground p"],
        velocities: Float[Array, "b_ground v"],
        reactions: Float[Array, "parts k v"],
    ) -> Float[Array, "parts k v"]:
        """Wrenches of the laws on the bodies of their joints; `reactions`: those of the joints."""
        single = lambda at, x, v, own: at(t).wrenches(self.group.layout.space, x, v, own, t)
        return self.group.map(single, self.group.gather(poses), self.group.gather(velocities), reactions)
