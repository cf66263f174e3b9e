"""Stacked forces, and the laws that make constraints non-ideal."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Scalar
from .groups import Group, along_moves


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
            of_positions = along_moves(space, lambda x: at(t).wrenches(space, x, v, t), x)
            return of_positions, jax.jacfwd(lambda v: at(t).wrenches(space, x, v, t))(v)

        return self.group.map(single, self.group.gather(poses), self.group.gather(velocities))

    def energy(self, t: Scalar, poses: Float[Array, "b_ground p"]) -> Float[Array, ""]:
        if not self.group.part.conservative:
            return jnp.zeros((), poses.dtype)
        single = lambda at, poses: at(t).energy(self.group.layout.space, poses, t)
        return jnp.sum(self.group.map(single, self.group.gather(poses)))


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
