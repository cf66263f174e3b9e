"""Parts of one type, stacked: one kernel and one `vmap` for all of them, whatever their number."""

import abc
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._parts import AbstractLink
from .._types import Scalar
from .layout import Layout


class Group(eqx.Module):
    """Stacked parts. `part` has the structure of one part with a leading axis on every number."""

    part: Any
    names: tuple[str, ...] = eqx.field(static=True)
    bodies: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    layout: Layout = eqx.field(static=True)

    @property
    def body_index(self) -> np.ndarray:
        """Bodies of each part, shape (parts, k)."""
        return np.array(self.bodies)

    @property
    def rows(self) -> int:
        return self.part.rows

    def own(self, of_bodies: Float[Array, "b_ground _"]) -> Float[Array, "parts k _"]:
        """What each part's bodies have, from poses or velocities of all bodies and the ground."""
        return of_bodies[self.body_index]

    def rates(self, poses: Float[Array, "k p"], velocities: Float[Array, "k v"]) -> Float[Array, "k p"]:
        return jax.vmap(self.layout.space.rates)(poses, velocities)


def stack(parts: Sequence[tuple[AbstractLink, tuple[int, ...]]], layout: Layout) -> tuple[Group, ...]:
    """Group parts that share type, static fields and shapes; order of first appearance."""
    groups: dict[Any, list] = {}
    for part, bodies in parts:
        leaves, structure = jtu.tree_flatten(_anonymous(part))
        key = (structure, tuple(leaf.shape for leaf in leaves), len(bodies))
        groups.setdefault(key, []).append((leaves, part.name, bodies))
    out = []
    for (structure, _, _), members in groups.items():
        leaves = [jnp.stack(column) for column in zip(*(member[0] for member in members), strict=True)]
        names, bodies = tuple(m[1] for m in members), tuple(m[2] for m in members)
        out.append(Group(jtu.tree_unflatten(structure, leaves), names, bodies, layout))
    return tuple(out)


def _anonymous(part: AbstractLink) -> AbstractLink:
    """The part without the names that tell it from its siblings."""
    out = object.__new__(type(part))
    for field in part.__dataclass_fields__:
        value = getattr(part, field)
        if field == "name" or field in ("body", "body_a", "body_b", "reaction", "carrier"):
            value = ""
        elif field == "bodies":
            value = ("",) * len(value)
        object.__setattr__(out, field, value)
    return out


class AbstractConstraintGroup(eqx.Module):
    """Kernels of stacked constraints, from what each says about velocities."""

    group: Group

    @abc.abstractmethod
    def _rate(self, part, t, poses, v) -> Array:
        """Residuals of one part between the velocities of its bodies, shape (rows,)."""

    @abc.abstractmethod
    def jacobian(
        self, t: Scalar, poses: Float[Array, "b_ground p"], velocities: Float[Array, "b_ground v"]
    ) -> Float[Array, "parts rows k v"]:
        """Derivative with respect to velocities, body by body."""

    @property
    def rows(self) -> int:
        return self.group.rows

    def velocity(
        self, t: Scalar, poses: Float[Array, "b_ground p"], velocities: Float[Array, "b_ground v"]
    ) -> Float[Array, "parts rows"]:
        """Residuals between velocities."""
        return self._map(lambda part, poses, v: self._rate(part, t, poses, v), poses, velocities)

    def wrenches(
        self,
        t: Scalar,
        poses: Float[Array, "b_ground p"],
        velocities: Float[Array, "b_ground v"],
        multipliers: Float[Array, "parts rows"],
    ) -> Float[Array, "parts k v"]:
        """What the constraints do to their bodies, `Aᵀ λ` body by body."""

        def single(part, poses, v, multipliers):
            return jax.vjp(lambda w: self._rate(part, t, poses, w), v)[1](multipliers)[0]

        return jax.vmap(single)(self.group.part, self.group.own(poses), self.group.own(velocities), multipliers)

    def acceleration(
        self,
        t: Scalar,
        poses: Float[Array, "b_ground p"],
        velocities: Float[Array, "b_ground v"],
        accelerations: Float[Array, "b_ground v"],
    ) -> Float[Array, "parts rows"]:
        """The time derivative of the residuals between velocities."""

        def single(part, poses, v, a):
            rate = lambda t, poses, v: self._rate(part, t, poses, v)
            return jax.jvp(rate, (t, poses, v), (jnp.ones_like(t), self.group.rates(poses, v), a))[1]

        return self._map(single, poses, velocities, accelerations)

    @property
    def _space(self):
        return self.group.layout.space

    def _map(self, single, poses, *velocities):
        return jax.vmap(single)(self.group.part, self.group.own(poses), *map(self.group.own, velocities))


class ConstraintGroup(AbstractConstraintGroup):
    """Kernels of stacked constraints between positions."""

    def residual(self, t: Scalar, poses: Float[Array, "b_ground p"]) -> Float[Array, "parts rows"]:
        return self._map(lambda part, poses: part.residual(self._space, poses, t), poses)

    def coordinate_jacobian(self, t: Scalar, poses: Float[Array, "b_ground p"]) -> Float[Array, "parts rows k p"]:
        return self._map(lambda part, poses: jax.jacfwd(lambda x: part.residual(self._space, x, t))(poses), poses)

    def jacobian(
        self, t: Scalar, poses: Float[Array, "b_ground p"], velocities: Float[Array, "b_ground v"]
    ) -> Float[Array, "parts rows k v"]:
        """Derivative along unit velocities: `Φ_q N`, body by body."""
        del velocities

        def single(part, poses):
            residual = lambda x: part.residual(self._space, x, t)
            along = lambda v: jax.jvp(residual, (poses,), (self.group.rates(poses, v),))[1]
            k, size = poses.shape[0], self._space.velocity_size
            unit = jnp.eye(k * size, dtype=poses.dtype).reshape(-1, k, size)
            return jax.vmap(along, out_axes=-1)(unit).reshape(-1, k, size)

        return self._map(single, poses)

    def _rate(self, part, t, poses, v):
        rates = self.group.rates(poses, v)
        if part.rheonomic:
            return jax.jvp(lambda t, x: part.residual(self._space, x, t), (t, poses), (jnp.ones_like(t), rates))[1]
        return jax.jvp(lambda x: part.residual(self._space, x, t), (poses,), (rates,))[1]


class VelocityConstraintGroup(AbstractConstraintGroup):
    """Kernels of stacked constraints between velocities."""

    def jacobian(
        self, t: Scalar, poses: Float[Array, "b_ground p"], velocities: Float[Array, "b_ground v"]
    ) -> Float[Array, "parts rows k v"]:
        single = lambda part, poses, v: jax.jacfwd(lambda w: part.residual(self._space, poses, w, t))(v)
        return self._map(single, poses, velocities)

    def _rate(self, part, t, poses, v):
        return part.residual(self._space, poses, v, t)


class ForceGroup(eqx.Module):
    """Kernels of stacked forces."""

    group: Group

    def wrenches(
        self, t: Scalar, poses: Float[Array, "b_ground p"], velocities: Float[Array, "b_ground v"]
    ) -> Float[Array, "parts k v"]:
        single = lambda part, poses, v: part.wrenches(self.group.layout.space, poses, v, t)
        return jax.vmap(single)(self.group.part, self.group.own(poses), self.group.own(velocities))

    def energy(self, t: Scalar, poses: Float[Array, "b_ground p"]) -> Float[Array, ""]:
        if not self.group.part.conservative:
            return jnp.zeros((), poses.dtype)
        single = lambda part, poses: part.energy(self.group.layout.space, poses, t)
        return jnp.sum(jax.vmap(single)(self.group.part, self.group.own(poses)))
