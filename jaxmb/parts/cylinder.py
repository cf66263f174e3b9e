"""Hydraulic and pneumatic cylinders between two points, in the plane and in space."""

from typing import ClassVar

from jaxtyping import Array, Float

from ..linalg.rotations import norm
from . import fields
from .base import AbstractForce, AbstractPointPair, AbstractTendon, PathKind
from .space import force_pair, separation


class AbstractCylinder(AbstractPointPair):
    """Pressures on the two sides of a piston.

    **Arguments:**

    - `bore_area` [m²] > 0 of the piston; `pressure` [Pa] on it, default zero.
    - `rod_area` [m²] > 0, the annulus on the side of the rod, at most `bore_area`; `rod_pressure` [Pa] on it, default
        zero. A plunger has neither.
    """

    bore_area: fields.Number = fields.parameter(unit="m²", sign="positive")
    pressure: fields.Number = fields.parameter(unit="Pa", default=0.0)
    rod_area: fields.Number = fields.parameter(unit="m²", sign="positive", optional=True)
    rod_pressure: fields.Number = fields.parameter(unit="Pa", optional=True)

    def validate(self):
        if self.rod_area is None and self.rod_pressure is not None:
            raise ValueError(f"{self.label}: a rod_pressure needs the area on which it acts; give rod_area.")
        if self.rod_area is not None and self.rod_area > self.bore_area:
            raise ValueError(
                f"{self.label}: rod_area is the annulus around the rod, at most bore_area {self.bore_area:g}, got "
                f"{self.rod_area:g}."
            )

    def numbers_agree(self):
        return True if self.rod_area is None else self.rod_area <= self.bore_area

    @property
    def force(self) -> Float[Array, ""]:
        """The force [N] that pushes the points apart."""
        push = self.pressure * self.bore_area
        return push if self.rod_area is None else push - self.rod_pressure * self.rod_area


class Cylinder(AbstractCylinder, AbstractTendon):
    """A hydraulic or pneumatic cylinder without mass between two points. It pushes them apart with the force `pressure
    bore_area − rod_pressure rod_area`.

    ```python
    ram = {"bore_area": 2e-3, "rod_area": 1.4e-3, "point_a": (0.0, -1.0)}
    lift = planar.Cylinder("lift", "ground", "bar", pressure=1e4, rod_pressure=2e3, **ram)
    ends = jaxmb.JointStop("ends", "lift.length", lower=0.9, upper=1.3, stiffness=1e5)
    system = jaxmb.Scene([bar], joints=[pin, lift], forces=[ends]).compile()
    ```

    It stands among the joints of a scene, and has the coordinate `length`. Other parts act on `"lift.length"`:
    `JointStop` or `Stop` ends the stroke, `JointFriction` rubs as the seals do, `JointForce` or `Motor` pushes with
    a force. `required_forces` with `by=["lift.pressure"]` finds the pressure along a motion. A `JointDriver` prescribes
    the length; `needed_pressure` is the pressure for its force:

    ```python
    ram = {"bore_area": 2e-3, "point_a": (0.0, -1.0)}
    lift, move = planar.Cylinder("lift", "ground", "bar", **ram), jaxmb.JointDriver("move", "lift.length")
    system = jaxmb.Scene([bar], joints=[pin, lift, move], forces=[jaxmb.Gravity((0.0, -9.81))]).compile()
    start = jaxmb.parameters(system)["move.value"]
    stroke = {"move.value": lambda t: jaxmb.smooth_step(t, start, 1.2, 0.5)}
    motion = jaxmb.simulate(system, jaxmb.assemble(system), t1=0.5, inputs=stroke)
    pressure = lift.needed_pressure(motion.reactions["move"].multipliers[:, 0])
    ```

    Pressures count from the ambient pressure, and may be inputs. The points must not coincide, neither at the given
    poses nor later.
    """

    def complete(self, space, poses):
        if not norm(separation(space, self, poses)) > 0:
            raise ValueError(f"{self.label}: its points coincide at the given poses; move one.")
        return self if self.rod_area is None else self.filled(rod_pressure=0.0)

    def length(self, space, poses):
        return norm(separation(space, self, poses))

    def components(self):
        names = ("bore_area", "pressure", "rod_area", "rod_pressure", "point_a", "point_b")
        push = CylinderForce(*(self.name, self.body_a, self.body_b), **{name: getattr(self, name) for name in names})
        return (self, push)

    def needed_pressure(self, force: Float[Array, "..."]) -> Float[Array, "..."]:
        """The pressure [Pa] on the bore side that pushes with this further force [N], such as the force of a driver."""
        return self.pressure + force / self.bore_area


class CylinderForce(AbstractCylinder, AbstractForce):
    """The force of a cylinder on its points."""

    path_kind: ClassVar[PathKind] = "rod"

    def wrenches(self, space, poses, velocities, t):
        d = separation(space, self, poses)
        return force_pair(space, self, poses, self.force / norm(d) * d)
