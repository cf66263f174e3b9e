"""Unilateral constraints: gaps that close at an instant, with an impact, and open again.

A gap is a function of the poses of bodies that stays non-negative. Where it is open the part does nothing; where it is
closed, `gap = 0` is a constraint like that of a joint, whose force pushes and never pulls. `simulate` finds the times of
impacts and of loss of contact within its steps.
"""

import abc
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from . import fields
from .base import AbstractInertialConstraint, ScalarCoordinate
from .coordinate_parts import AbstractScalarPart

# The mode of a contact that is closed, as `jaxmb.system` numbers modes.
_CLOSED = 1


class AbstractUnilateralConstraint(AbstractInertialConstraint):
    """A gap between bodies, which stays non-negative.

    Subclasses define the `gap` and list the bodies. The scene has one coordinate, one velocity and one row more for
    each: its mode, which is 0 where it is open, 1 where it is closed, and 2 where it is closed but other contacts imply
    it. By name the mode is `"stop.mode"`: `assemble(system, fix={"stop.mode": 1})` closes the gap.

    An impact is Newton's: the gap opens at `restitution` times the rate at which it closed. Contacts that are closed
    at the same time share the impulse.

    **Fields:** `restitution` from 0 to 1, default 0.
    """

    restitution: fields.Number = fields.parameter(sign="non-negative", default=0.0)
    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = False

    @property
    def inertia(self) -> Float[Array, ""]:  # pyright: ignore[reportIncompatibleVariableOverride]
        # That of the mode, which no force acts on.
        return jnp.ones_like(self.restitution)

    def validate(self):
        if not self.restitution <= 1:
            raise ValueError(f"{self.label}: restitution must lie between 0 and 1, got {self.restitution}.")

    def scalar_coordinates(self, parts):
        del parts
        return (ScalarCoordinate(f"{self.name}.mode", moves=True),)

    @abc.abstractmethod
    def gap(self, space, poses, t) -> Float[Array, ""]:
        """The gap [m, rad] at the poses of the bodies; its derivatives are finite wherever bodies may be."""

    def residual(self, space, poses, t):
        mode = poses[-1, 0]
        kind = lax.stop_gradient(jnp.round(mode))
        return jnp.where(kind == _CLOSED, self.gap(space, poses[:-1], t), mode - kind)[None]


class Stop(AbstractScalarPart, AbstractUnilateralConstraint):
    """Rigid stops at one end or both ends of a coordinate's range.

    **Arguments:** `coordinate`, such as `"hip.angle"` or `"rope.length"`, a number; `lower` < `upper` [rad, m], of
    which one may be left out; `restitution` from 0 to 1, default 0: the rate after an impact over that before. The
    range of an angle must be less than a full turn.
    """

    lower: fields.Number = fields.parameter(unit="rad or m", optional=True)
    upper: fields.Number = fields.parameter(unit="rad or m", optional=True)

    def validate(self):
        AbstractUnilateralConstraint.validate(self)
        if self.lower is None and self.upper is None:
            raise ValueError(f"{self.label}: give lower, upper or both.")
        if self.lower is not None and self.upper is not None and not self.lower < self.upper:
            raise ValueError(f"{self.label}: lower must be less than upper, got {self.lower} and {self.upper}.")

    def with_numbers(self, given):
        if self.within in self.joint.periodic:
            if self.lower is None or self.upper is None:
                raise ValueError(
                    f"{self.label}: an angle in space is known up to full turns; give lower and upper of its range."
                )
            if self.upper - self.lower >= 2 * np.pi:
                raise ValueError(
                    f"{self.label}: the range of an angle must be less than a full turn, got {self.lower} to "
                    f"{self.upper}."
                )
        return super().with_numbers(given)

    def gap(self, space, poses, t):
        (value,) = self.measured(space, poses)
        if self.lower is None or self.upper is None:
            return value - self.lower if self.upper is None else self.upper - value
        middle = 0.5 * (self.lower + self.upper)
        # Of the two stops that which is nearer.
        return 0.5 * (self.upper - self.lower) - jnp.abs(self.near(value[None], middle)[0] - middle)
