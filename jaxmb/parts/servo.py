"""Servo constraints, enforced by a control force."""

from typing import Any

from . import fields
from .base import AbstractConstraint, AbstractLink
from .coordinate_parts import AbstractOfJoints


class Servo(AbstractLink):
    """A desired motion as a constraint: the residual Φ of `program` is brought to zero and kept there.

    ```python
    lift = {"motion": lambda t, p: p["rate"] * t, "parameters": {"rate": 0.5}}
    turn = planar.Driver("turn", "ground", "bar", quantity="angle", **lift)
    servo = jaxmb.Servo(turn, damping=20.0, stiffness=100.0)
    system = jaxmb.Scene([bar], joints=[pin, servo], forces=[jaxmb.Gravity((0.0, -9.81))]).compile()
    ```

    The constraint acts on accelerations, `Φ̈ + damping Φ̇ + stiffness Φ = 0`, so the motion may start off the program.
    The reaction of the servo is the exact control force, the smallest one in the metric of M⁻¹. The servo has the name
    of its program; the numbers of the program and the gains are parameters under that name.

    A servo that others imply at the given pose is watched along the motion: where its program begins to differ from
    theirs, the run fails and names them.

    `motion["turn"].drive_force` is the control force along the quantity of a `Driver` [N, of an angle N m]: force ×
    rate is the power that the servo puts into the machine. For another program it is the force along each residual.

    **Arguments:** `program`: a position constraint between bodies, such as a `Driver` or a `Constraint`, not on the
    coordinate of a joint; `damping` [1/s] and `stiffness` [1/s²] ≥ 0, default zero: the motion stays on the program but
    is not brought to it.

    Source: R. E. Kalaba and F. E. Udwadia, "Equations of motion for nonholonomic, constrained dynamical systems via
    Gauss's principle", J. Appl. Mech. 60, 1993.
    """

    program: Any = fields.law(
        AbstractConstraint, what="a constraint between positions, such as a Driver", kw_only=False
    )
    damping: fields.Number = fields.parameter(unit="1/s", sign="non-negative", default=0.0, kw_only=False)
    stiffness: fields.Number = fields.parameter(unit="1/s²", sign="non-negative", default=0.0, kw_only=False)

    def __check_init__(self):
        if isinstance(self.program, AbstractOfJoints):
            raise ValueError(
                f"{self.label}: the program must be a constraint between bodies, such as a Driver or a Constraint; a "
                f"{self.program.kind} acts on coordinates of joints. Prescribe a coordinate of a body with a Driver, "
                "or write the coordinate's residual as a Constraint."
            )
        repeated = {"damping", "stiffness"} & set(getattr(self.program, "parameters", {}))
        if repeated:
            raise ValueError(f"{self.label}: {repeated.pop()!r} is the name of a gain; rename that parameter.")

    @property
    def name(self):
        return self.program.name

    @property
    def bodies(self):
        return self.program.bodies

    @property
    def dimensions(self):
        return self.program.dimensions

    @property
    def rows(self):
        return self.program.rows

    def residual(self, space, poses, t):
        """Φ of the program."""
        return self.program.residual(space, poses, t)

    def complete(self, space, poses):
        return self.with_fields(program=self.program.resolve(space, poses))
