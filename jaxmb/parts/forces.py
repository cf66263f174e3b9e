"""Forces that read the same in the plane and in space."""

from typing import ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..linalg.rotations import norm
from .base import AbstractForce, AbstractPart, number, optional_number
from .resolve import fill, positive, vector


class Gravity(AbstractPart):
    """Uniform gravity on every body of the scene.

    **Arguments:** `acceleration` [m/s²], shape (2,) in a planar scene and (3,) in a spatial one, in world axes.
    """

    acceleration: Float[Array, "d"] = eqx.field(converter=number)
    name: str = eqx.field(static=True, default="gravity", kw_only=True)


def generalized_force(space, coordinates, poses, velocities, law):
    """Wrenches of forces that act along coordinates.

    `coordinates(poses)` has shape (n,), `law(value, rate)` gives the n forces that do work on them; the wrench on
    body k is `N_kᵀ (∂coordinates/∂pose_k)ᵀ force`.
    """
    pose_rates = jax.vmap(space.rates)(poses, velocities)
    value, rate = jax.jvp(coordinates, (poses,), (pose_rates,))
    _, pull = jax.vjp(coordinates, poses)
    (gradient,) = pull(law(value, rate))
    return jax.vmap(space.pull_back)(poses, gradient)


def fill_points(part, space):
    """The part with its points, the mass centres where none are given, checked."""
    zero = np.zeros(space.dimension)
    for field in ("point_a", "point_b"):
        part = fill(part, field, zero)
        vector(part, field, getattr(part, field), space.dimension)
    return part


def separation(space, part, poses):
    """World vector from point A to point B."""
    return space.point(poses[1], part.point_b) - space.point(poses[0], part.point_a)


def separation_rate(space, part, poses, velocities):
    """Its rate."""
    return space.point_velocity(poses[1], velocities[1], part.point_b) - space.point_velocity(
        poses[0], velocities[0], part.point_a
    )


def between_points(space, part, poses, force_W):
    """Wrenches of `force_W` on B at point B and of its reaction on A at point A."""
    return jnp.stack(
        [
            space.point_force(poses[0], part.point_a, -force_W),
            space.point_force(poses[1], part.point_b, force_W),
        ]
    )


class SpringDamper(AbstractForce):
    """A linear spring and damper along the line between two points: tension `stiffness (l − free_length) + damping l̇`.

    At zero length the direction of a pretension is undefined and the pretension is taken as zero; a spring of zero
    free length is linear there.

    **Arguments:** `stiffness` [N/m] ≥ 0; `damping` [N s/m] ≥ 0; `free_length` [m] ≥ 0, default the length at the
    given poses; `point_a`, `point_b` [m], body-fixed, default the mass centres.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    stiffness: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    damping: Float[Array, ""] = eqx.field(converter=number, default=0.0, kw_only=True)
    free_length: Float[Array, ""] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point_a: Float[Array, "d"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point_b: Float[Array, "d"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    conservative: ClassVar[bool] = True

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        part = fill_points(self, space)
        if part.free_length is None:
            part = fill(part, "free_length", norm(separation(space, part, poses)))
        for field in ("stiffness", "damping", "free_length"):
            positive(part, field, getattr(part, field), zero=True)
        return part

    def wrenches(self, space, poses, velocities, t):
        d, rate = separation(space, self, poses), separation_rate(space, self, poses, velocities)
        square = jnp.dot(d, d)
        apart = square > 0
        length = jnp.sqrt(jnp.where(apart, square, 1.0))
        pretension = jnp.where(apart, self.stiffness * self.free_length / length, 0.0)
        damping = jnp.where(apart, self.damping * jnp.dot(d, rate) / length**2, 0.0)
        return between_points(space, self, poses, -(self.stiffness - pretension + damping) * d)

    def energy(self, space, poses, t):
        d = separation(space, self, poses)
        # ½ k (l − l0)², written so that its derivative at l = 0 is finite.
        return 0.5 * self.stiffness * (jnp.dot(d, d) - 2 * self.free_length * norm(d) + self.free_length**2)


class Damper(AbstractForce):
    """A linear damper on the relative velocity of two points, in every direction: force `−damping (v_B − v_A)` on B.

    The two points should coincide or `body_a` be the ground; otherwise the pair of forces has a moment.

    **Arguments:** `damping` [N s/m] ≥ 0; `point_a`, `point_b` [m], body-fixed, default the mass centres.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    damping: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    point_a: Float[Array, "d"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point_b: Float[Array, "d"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    conservative: ClassVar[bool] = False

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        positive(self, "damping", self.damping, zero=True)
        return fill_points(self, space)

    def wrenches(self, space, poses, velocities, t):
        rate = separation_rate(space, self, poses, velocities)
        return between_points(space, self, poses, -self.damping * rate)


class PointForce(AbstractForce):
    """A constant force at a body-fixed point.

    **Arguments:** `force` [N], in world axes or, with `frame="body"`, turning with the body; `point` [m], body-fixed,
    default the mass centre.
    """

    name: str = eqx.field(static=True)
    body: str = eqx.field(static=True)
    force: Float[Array, "d"] = eqx.field(converter=number, kw_only=True)
    point: Float[Array, "d"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    frame: Literal["world", "body"] = eqx.field(static=True, default="world", kw_only=True)
    conservative: ClassVar[bool] = False

    def __check_init__(self):
        if self.frame not in ("world", "body"):
            raise ValueError(f"PointForce {self.name!r}: frame must be 'world' or 'body', got {self.frame!r}.")

    @property
    def bodies(self):
        return (self.body,)

    def resolve(self, space, poses):
        vector(self, "force", self.force, space.dimension)
        part = fill(self, "point", np.zeros(space.dimension))
        vector(part, "point", part.point, space.dimension)
        return part

    def wrenches(self, space, poses, velocities, t):
        force_W = self.force if self.frame == "world" else space.direction(poses[0], self.force)
        return space.point_force(poses[0], self.point, force_W)[None]
