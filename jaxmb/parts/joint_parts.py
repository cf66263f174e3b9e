"""Springs, forces and prescribed motions of a joint's own coordinate, such as `"hip.angle"`."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from . import fields
from .base import AbstractConstraint, AbstractForce, AbstractLink, AbstractPotentialForce
from .forces import generalized_force
from .names import unknown


class AbstractCoordinatePart(AbstractLink):
    """A part that acts on a coordinate of a joint or tendon, in the plane or in space.

    **Fields:** `coordinate`: `"joint.coordinate"`, a coordinate that the joint's class documents. A scene fills in the
    `joint`, whose numbers keep the joint's name, and the coordinate's name `within` it.
    """

    name: str = fields.name()
    coordinate: str = fields.name()
    joint: Any = fields.part(AbstractLink)
    within: str = eqx.field(static=True, default="", kw_only=True)

    @property
    def joint_name(self) -> str:
        """The name of the joint."""
        return self.coordinate.split(".")[0]

    @property
    def bodies(self) -> tuple[str, ...]:
        return () if self.joint is None else self.joint.bodies

    def of_joint(self, joint: AbstractLink) -> Any:
        """The same part with its joint.

        **Raises:** `ValueError` if the joint has no such coordinate; see its class for those that it has.
        """
        return self.with_fields(joint=joint, within=self.coordinate.partition(".")[2])

    def complete(self, space, poses):
        return self.with_numbers(given_coordinate(self, self.joint, self.coordinate, space, poses))

    def unit(self, alternatives: str) -> str:
        """Of the units of an angle and of a displacement, `"N m or N"`, that of the coordinate."""
        of_angle, of_displacement = alternatives.split(" or ")
        return of_displacement if self.within.startswith(("displacement", "length")) else of_angle

    @abc.abstractmethod
    def with_numbers(self, given: np.ndarray) -> Any:
        """A checked copy with omitted numbers filled in, from the coordinate at the given poses."""

    def measured(self, space, poses) -> Float[Array, "n"]:
        """The coordinate, raveled."""
        return self.joint.coordinates_at(space, poses)[self.within].reshape(-1)

    def measured_with_rate(self, space, poses, velocities) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
        """The coordinate and its rate, raveled."""
        rates = jax.vmap(space.rates)(poses, velocities)
        return jax.jvp(lambda x: self.measured(space, x), (poses,), (rates,))

    def difference(self, value: Float[Array, "n"], target: Float[Array, "*shape"]) -> Float[Array, "n"]:
        """`value − target`; of angles that are known up to full turns the smallest such difference."""
        out = value - target.reshape(-1)
        return shortest(out) if self.within in self.joint.periodic else out

    def shortest_difference(self, value: Float[Array, "n"], target: Float[Array, "*shape"]) -> Float[Array, "n"]:
        """`value − target`; of an angle less full turns, in [−π, π]."""
        out = value - target.reshape(-1)
        return shortest(out) if self.within in self.joint.angles else out

    def near(self, value: Float[Array, "n"], middle: Float[Array, "*shape"]) -> Float[Array, "n"]:
        """The value; of angles that are known up to full turns the one within half a turn of `middle`."""
        return middle.reshape(-1) + self.difference(value, middle) if self.within in self.joint.periodic else value

    def _check_shape(self, field: str, given: np.ndarray) -> None:
        shape = np.shape(getattr(self, field))
        if shape != given.shape:
            raise ValueError(
                f"{self.label}: {field} must have the shape of {self.coordinate!r}, {given.shape}, got {shape}."
            )


def given_coordinate(part: AbstractLink, joint: Any, coordinate: str, space: Any, poses: Any) -> np.ndarray:
    """A joint's coordinate at the given poses; an error of the part if there is none of this name."""
    known = joint.coordinates_at(space, poses)
    name, _, within = coordinate.partition(".")
    if within not in known:
        names = [f"{name}.{own}" for own in known]
        if not names:
            raise ValueError(f"{part.label}: {joint.label} has no coordinate of its own.")
        raise unknown("coordinate", coordinate, names, part.label)
    return np.asarray(known[within])


def shortest(angle: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The angle [rad] less full turns, in [−π, π]."""
    return angle - turns(angle)


def turns(angle: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The full turns [rad] that are nearest to an angle."""
    return 2 * np.pi * lax.stop_gradient(jnp.round(angle / (2 * np.pi)))


class JointSpring(AbstractCoordinatePart, AbstractPotentialForce):
    """A linear spring and damper on a coordinate: generalized force `−stiffness (value − free) − damping rate`.

    **Arguments:** `coordinate`, such as `"hip.angle"`; `stiffness` [N m/rad, N/m] ≥ 0; `damping` [N m s/rad, N s/m]
    ≥ 0; `free` [rad, m], where the spring exerts no force, default the coordinate at the given poses. In space the
    spring of an angle takes the shortest way to it, up to half a turn; with `middle` [rad], of the range in which the
    angle stays, it takes the way within half a turn of that.
    """

    stiffness: fields.Number = fields.parameter(unit="N m/rad or N/m", sign="non-negative")
    damping: fields.Number = fields.parameter(unit="N m s/rad or N s/m", sign="non-negative", default=0.0)
    free: fields.Number = fields.parameter(shape=None, unit="rad or m", optional=True)
    middle: fields.Number = fields.parameter(shape=None, unit="rad or m", optional=True)

    def with_numbers(self, given):
        part = self.filled(free=given)
        for field in ("free",) if part.middle is None else ("free", "middle"):
            part._check_shape(field, given)
        return part

    def _stretch(self, value):
        if self.middle is None:
            return self.difference(value, self.free)
        return self.near(value, self.middle) - self.free.reshape(-1)

    def wrenches(self, space, poses, velocities, t):
        law = lambda x, v: -self.stiffness * self._stretch(x) - self.damping * v
        return generalized_force(space, lambda x: self.measured(space, x), poses, velocities, law)

    def energy(self, space, poses, t):
        return 0.5 * self.stiffness * jnp.sum(self._stretch(self.measured(space, poses)) ** 2)


class JointForce(AbstractCoordinatePart, AbstractForce):
    """A force along a coordinate, or a moment about it, with its reaction on the other body: a motor on a hinge.

    **Arguments:** `coordinate`, such as `"hip.angle"`; `force` [N m of an angle, N of a displacement], of the
    coordinate's shape, positive where it increases the coordinate. As an input of `simulate`, `"motor.force"` is a
    function of time.
    """

    force: fields.Number = fields.parameter(shape=None, unit="N m or N")

    def with_numbers(self, given):
        self._check_shape("force", given)
        return self

    def wrenches(self, space, poses, velocities, t):
        law = lambda x, v: self.force.reshape(-1)
        return generalized_force(space, lambda x: self.measured(space, x), poses, velocities, law)


class JointDriver(AbstractCoordinatePart, AbstractConstraint):
    """A coordinate that is prescribed, `value + rate t`. Rows: one for each of its components.

    **Arguments:** `coordinate`, such as `"hip.angle"`; `value` [rad, m], default that at the given poses; `rate`
    [rad/s, m/s], default zero; both of the coordinate's shape. As an input of `simulate`, `"drive.value"` is any
    function of time.
    """

    value: fields.Number = fields.parameter(shape=None, unit="rad or m", optional=True)
    rate: fields.Number = fields.parameter(shape=None, unit="rad/s or m/s", optional=True)
    rows: int = eqx.field(static=True, default=1, kw_only=True)
    rheonomic: ClassVar[bool] = True

    def with_numbers(self, given):
        part = self.filled(value=given, rate=np.zeros_like(given))
        part._check_shape("value", given)
        part._check_shape("rate", given)
        return part.with_fields(rows=given.size)

    def residual(self, space, poses, t):
        return self.difference(self.measured(space, poses), self.value + self.rate * t)
