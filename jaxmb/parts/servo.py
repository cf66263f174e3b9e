"""Programmed motions: constraints that a control force is to satisfy."""

from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from .base import AbstractConstraint, AbstractLink, number
from .resolve import label, positive, vector


class Servo(AbstractLink):
    """A desired motion as a constraint: the residual Φ of `program` is brought to zero and kept there.

    The constraint acts on accelerations, `Φ̈ + damping Φ̇ + stiffness Φ = 0`, so the motion may start off it. What it
    takes to do that, the reaction of this name, is the exact control force: of all that do it the least in the metric
    of M⁻¹. The program goes by its own name, and its numbers are parameters under it, as are the gains.

    **Arguments:** `program`: any constraint between positions, such as a `Driver` or a `Constraint`; `damping` [1/s]
    and `stiffness` [1/s²] ≥ 0, default zero: kept only, once it is met.

    Source: R. E. Kalaba and F. E. Udwadia, "Equations of motion for nonholonomic, constrained dynamical systems via
    Gauss's principle", J. Appl. Mech. 60, 1993.
    """

    program: Any
    damping: Float[Array, ""] = eqx.field(converter=number, default=0.0, kw_only=True)
    stiffness: Float[Array, ""] = eqx.field(converter=number, default=0.0, kw_only=True)

    def __check_init__(self):
        if not isinstance(self.program, AbstractConstraint):
            raise ValueError(f"Servo needs a constraint between positions as its program, got {self.program!r}.")
        taken = {"damping", "stiffness"} & set(getattr(self.program, "parameters", {}))
        if taken:
            raise ValueError(f"{label(self)}: {taken.pop()!r} is the name of a gain; call that parameter otherwise.")

    @property
    def name(self):
        return self.program.name

    @property
    def bodies(self):
        return self.program.bodies

    def resolve(self, space, poses):
        for field in ("damping", "stiffness"):
            vector(self, field, getattr(self, field)[None], 1)
            positive(self, field, getattr(self, field), zero=True)
        return eqx.tree_at(lambda part: part.program, self, self.program.resolve(space, poses))

    def components(self):
        return tuple(eqx.tree_at(lambda part: part.program, self, own) for own in self.program.components())
