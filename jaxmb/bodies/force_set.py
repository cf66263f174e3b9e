"""The forces of a scene: gravity and stacked force elements."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Scalar
from ..parts.forces import Gravity
from .groups import Acting, BodyPoses, ForceGroup, Kinematics


class ForceSet(eqx.Module):
    """Gravity and groups of force elements.

    **Fields:** `groups`; the acceleration of `gravity` [m/s²], or None; its name.
    """

    groups: tuple[ForceGroup, ...]
    gravity: Float[Array, "d"] | None
    gravity_name: str = eqx.field(static=True)

    @property
    def gravity_part(self) -> tuple[Gravity, ...]:
        """Gravity as a part; empty without gravity."""
        return () if self.gravity is None else (Gravity(self.gravity, name=self.gravity_name),)

    @property
    def with_gaps(self) -> tuple[ForceGroup, ...]:
        """The groups of forces that act only at closed gaps."""
        return tuple(g for g in self.groups if g.group.part.has_gaps)

    def wrenches(self, now: Kinematics) -> list[Acting]:
        """Wrenches of the force elements."""
        return [(g.wrenches(now), g.group.body_index) for g in self.groups]

    def energy(self, t: Scalar, poses: BodyPoses) -> Float[Array, ""]:
        """Potential energy [J] of conservative force elements."""
        return sum((g.energy(t, poses) for g in self.groups), start=jnp.zeros((), poses.dtype))

    def energy_in_motion(self, now: Kinematics) -> Float[Array, ""]:
        """The energy [J] that conservative force elements store, which may depend on velocities."""
        return sum((g.energy_in_motion(now) for g in self.groups), start=jnp.zeros((), now.poses.dtype))
