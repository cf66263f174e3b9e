"""Forces with the same definition in the plane and in space."""

from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..linalg.rotations import norm
from . import fields
from .base import AbstractForce, AbstractPair, AbstractPart, AbstractPointPair, AbstractPotentialForce, PathKind
from .curves import check_given, over_arrays
from .space import force_pair, moment_pair, rate_of, separation, separation_rate, with_drift


class Gravity(AbstractPart):
    """Uniform gravity on every body of the scene.

    ```python
    on_the_moon = jaxmb.Scene([bar], joints=[pin], forces=[jaxmb.Gravity((0.0, -1.62))]).compile()
    ```

    **Arguments:** `acceleration` [m/s²], shape (2,) in a planar scene and (3,) in a spatial one, in world axes.
    """

    acceleration: fields.Number = fields.parameter(shape=("d",), unit="m/s²", kw_only=False)
    name: str = eqx.field(static=True, default="gravity", kw_only=True)


def over_ground(part: Any, point: Float[Array, "d"], velocity: Float[Array, "d"]) -> Float[Array, "d"]:
    """A velocity [m/s] relative to the ground below a point; the ground rises and sinks if numbers of the part's
    `terrain` are inputs.
    """
    upwards = jnp.zeros_like(point).at[-1].set(1.0)
    return with_drift(part, velocity, lambda part: -part.terrain.height(point[:-1]) * upwards)


def generalized_force(space, part, coordinates, poses, velocities, law):
    """Wrenches of generalized forces along given coordinates.

    `coordinates(part, poses)` has shape (n,), `law(value, rate)` returns the n conjugate forces; the wrench on body k
    is `N_kᵀ (∂coordinates/∂pose_k)ᵀ force`.
    """
    value, push = jax.linearize(lambda x: coordinates(part, x), poses)
    rate = with_drift(part, push(jax.vmap(space.rates)(poses, velocities)), lambda part: coordinates(part, poses))
    (gradient,) = jax.linear_transpose(push, poses)(law(value, rate))
    return jax.vmap(space.pull_back)(poses, gradient)


class SpringDamper(AbstractPointPair, AbstractPotentialForce):
    """A linear spring and damper along the line between two points: tension `stiffness (l − free_length) + damping l̇`.

    ```python
    spring = planar.SpringDamper(
        "spring", "ground", "bar", stiffness=100.0, damping=1.0, free_length=1.2, point_a=(0.0, 1.0), point_b=(0.5, 0.0)
    )
    system = jaxmb.Scene([bar], joints=[pin], forces=[spring]).compile()
    ```

    At zero length a pretension is taken as zero, since its direction is undefined; a spring of zero free length is
    linear there. Damping then acts against the relative velocity, its limit along every motion that reaches zero
    length.

    Along a motion it has the quantities `length` [m] and `tension` [N]: `motion.plot("spring.tension")`.

    **Arguments:** `stiffness` [N/m] ≥ 0; `damping` [N s/m] ≥ 0; `free_length` [m] ≥ 0, default the length at the
    given poses.
    """

    stiffness: fields.Number = fields.parameter(unit="N/m", sign="non-negative")
    damping: fields.Number = fields.parameter(unit="N s/m", sign="non-negative", default=0.0)
    free_length: fields.Number = fields.parameter(unit="m", sign="non-negative", optional=True)
    path_kind: ClassVar[PathKind] = "coil"
    is_spring: ClassVar[bool] = True

    def complete(self, space, poses):
        return self if self.free_length is not None else self.filled(free_length=norm(separation(space, self, poses)))

    def curve(self, length: ArrayLike, rate: ArrayLike = 0.0) -> Float[Array, "..."]:
        """The tension [N] at lengths [m] > 0 and rates [m/s], arrays that broadcast: the law of a motion, without a
        machine.
        """
        return over_arrays(self.label, _tension, check_given(self, "free_length"), length=length, rate=rate)

    def wrenches(self, space, poses, velocities, t):
        d, rate = separation(space, self, poses), separation_rate(space, self, poses, velocities)
        square = jnp.dot(d, d)
        apart = square > 0
        length = jnp.sqrt(jnp.where(apart, square, 1.0))
        pretension = jnp.where(apart, self.stiffness * self.free_length / length, 0.0)
        along = jnp.where(apart, jnp.dot(d, rate) / length**2 * d, rate)
        return force_pair(space, self, poses, -(self.stiffness - pretension) * d - self.damping * along)

    def observables(self, space, poses, velocities, t):
        length, rate = rate_of(space, self, lambda part, x: norm(separation(space, part, x)), poses, velocities)
        return {"length": length, "tension": _tension(self, length, rate)}

    def energy(self, space, poses, t):
        d = separation(space, self, poses)
        # ½ k (l − l0)², written so that its derivative at l = 0 is finite.
        return 0.5 * self.stiffness * (jnp.dot(d, d) - 2 * self.free_length * norm(d) + self.free_length**2)


def _tension(spring, length, rate):
    return spring.stiffness * (length - spring.free_length) + spring.damping * rate


class Damper(AbstractPointPair, AbstractForce):
    """A linear damper on the relative velocity of two points, in every direction: force `−damping (v_B − v_A)` on B.

    ```python
    damper = planar.Damper("damper", "ground", "bar", damping=0.5, point_b=(0.5, 0.0))
    system = jaxmb.Scene([bar], joints=[pin], forces=[damper]).compile()
    ```

    The two points should coincide or `body_a` be the ground; otherwise the pair of forces has a moment.

    **Arguments:** `damping` [N s/m] ≥ 0.
    """

    damping: fields.Number = fields.parameter(unit="N s/m", sign="non-negative")

    def wrenches(self, space, poses, velocities, t):
        rate = separation_rate(space, self, poses, velocities)
        return force_pair(space, self, poses, -self.damping * rate)


class PointForce(AbstractForce):
    """A constant force at a body-fixed point.

    ```python
    push = planar.PointForce("push", "bar", force=(0.0, 5.0), point=(0.5, 0.0), frame="body")
    system = jaxmb.Scene([bar], joints=[pin], forces=[push]).compile()
    ```

    **Arguments:** `force` [N], in world axes or, with `frame="body"`, turning with the body; `point` [m], body-fixed,
    default the origin of the frame.
    """

    name: str = fields.name()
    body: str = fields.body_name()
    force: fields.Number = fields.parameter(shape=("d",), unit="N")
    point: fields.Number = fields.point(body=0, default="origin")
    frame: Literal["world", "body"] = fields.choice("world", "body", default="world")

    def wrenches(self, space, poses, velocities, t):
        force_W = self.force if self.frame == "world" else space.direction(poses[0], self.force)
        return space.point_force(poses[0], self.point, force_W)[None]


class Torque(AbstractForce):
    """A constant moment on `body`, with its reaction on another body.

    ```python
    motor = planar.Torque("motor", "bar", torque=2.0)
    system = jaxmb.Scene([bar], joints=[pin], forces=[motor]).compile()
    ```

    In `Trajectory.forces` the reaction is the first row, and the moment on `body` the second.

    **Arguments:** `torque` [N m], a number in the plane; in space shape (3,), in world axes or, with `frame="body"`,
    turning with the body; `reaction`, the body that bears the reaction, default ground.
    """

    name: str = fields.name()
    reaction: str = fields.body_name(default="ground")
    body: str = fields.body_name()
    torque: fields.Number = fields.parameter(shape=None, unit="N m")
    frame: Literal["world", "body"] = fields.choice("world", "body", default="world")

    def complete(self, space, poses):
        shape = () if space.dimension == 2 else (3,)
        if self.torque.shape != shape:
            raise ValueError(f"{self.label}: torque must have shape {shape}, got {self.torque.shape}.")
        return self

    def wrenches(self, space, poses, velocities, t):
        turns_along = self.frame == "body" and space.dimension == 3
        torque_W = space.direction(poses[1], self.torque) if turns_along else self.torque.reshape(-1)
        return moment_pair(space, poses, torque_W)


class RotationalDamper(AbstractPair, AbstractForce):
    """A linear damper on the relative angular velocity, about every axis: moment `−damping (ω_B − ω_A)` on B.

    ```python
    ball = spatial.Body("ball", mass=1.0, inertia=spatial.sphere(1.0, 0.1), angular_velocity=(0.0, 0.0, 10.0))
    oil = spatial.RotationalDamper("oil", "ground", "ball", damping=0.01)
    socket = spatial.Spherical("socket", "ground", "ball", point=(0.0, 0.0, 0.0))
    system = jaxmb.Scene([ball], joints=[socket], forces=[oil]).compile()
    ```

    **Arguments:** `damping` [N m s/rad] ≥ 0.
    """

    damping: fields.Number = fields.parameter(unit="N m s/rad", sign="non-negative")

    def wrenches(self, space, poses, velocities, t):
        omega_a, omega_b = (space.turning(x, v) for x, v in zip(poses, velocities, strict=True))
        return moment_pair(space, poses, -self.damping * (omega_b - omega_a))
