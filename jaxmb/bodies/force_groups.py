"""Stacked forces, and the laws that make constraints non-ideal."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Scalar
from .groups import AbstractGroup, along_moves


class ForceGroup(AbstractGroup):
    """Kernels of stacked forces."""

    def wrenches(
        self, t: Scalar, poses: Float[Array, "b_ground p"], velocities: Float[Array, "b_ground v"]
    ) -> Float[Array, "parts k v"]:
        single = lambda at, x, v: self._wrenches(at, t, x, v)
        return self.group.map(single, self.group.gather(poses), self.group.gather(velocities))

    def _wrenches(self, at, t, x, v):
        part, space = at(t), self.group.layout.space
        wrenches = part.wrenches(space, *part.seen(space, x, v), t)
        return part.wrenches_on_bodies(space, x, wrenches)

    def state_rates(
        self, t: Scalar, poses: Float[Array, "b_ground p"], velocities: Float[Array, "b_ground v"]
    ) -> dict[str, Float[Array, "parts *shape"]]:
        """Rates of the parts' internal states, by the name of the field."""
        space = self.group.layout.space

        def single(at, x, v):
            part = at(t)
            return part.state_rates(space, *part.seen(space, x, v), t)

        return self.group.map(single, self.group.gather(poses), self.group.gather(velocities))

    def derivatives(
        self, t: Scalar, poses: Float[Array, "b_ground p"], velocities: Float[Array, "b_ground v"]
    ) -> tuple[Float[Array, "parts k v k v"], Float[Array, "parts k v k v"]]:
        """Derivatives of `wrenches` with respect to displacements along the velocities of the parts' bodies, and to the
        velocities.
        """
        space = self.group.layout.space

        def single(at, x, v):
            of_positions = along_moves(space, lambda x: self._wrenches(at, t, x, v), x)
            return of_positions, jax.jacfwd(lambda v: self._wrenches(at, t, x, v))(v)

        return self.group.map(single, self.group.gather(poses), self.group.gather(velocities))

    def energy(self, t: Scalar, poses: Float[Array, "b_ground p"]) -> Float[Array, ""]:
        if not self.group.part.conservative:
            return jnp.zeros((), poses.dtype)
        space = self.group.layout.space

        def single(at, x):
            part = at(t)
            return part.energy(space, part.seen_poses(space, x), t)

        return jnp.sum(self.group.map(single, self.group.gather(poses)))


class NonIdealGroup(AbstractGroup):
    """Kernels of stacked non-ideal laws; `joints`: the joint's name for each."""

    joints: tuple[str, ...] = eqx.field(static=True)

    def wrenches(
        self,
        t: Scalar,
        poses: Float[Array, "b_ground p"],
        velocities: Float[Array, "b_ground v"],
        reactions: Float[Array, "parts k v"],
    ) -> Float[Array, "parts k v"]:
        """Wrenches of the laws on the bodies of their joints; `reactions`: those of the joints."""
        space = self.group.layout.space

        def single(at, x, v, own):
            part = at(t)
            wrenches = part.wrenches(space, *part.seen(space, x, v), part.seen_wrenches(space, x, own), t)
            return part.wrenches_on_bodies(space, x, wrenches)

        return self.group.map(single, self.group.gather(poses), self.group.gather(velocities), reactions)
