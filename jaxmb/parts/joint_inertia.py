"""The inertia of a joint itself: of a rotor behind a gear, which moves with the joint's own coordinate."""

from typing import ClassVar

from . import fields
from .base import AbstractInertialConstraint, ScalarCoordinate
from .combinations import AbstractCombination
from .joint_parts import shortest


class JointInertia(AbstractCombination, AbstractInertialConstraint):
    """An inertia that moves with a coordinate of a joint or tendon: kinetic energy `½ inertia ẋ²`, and nothing else.

    The rotor of a motor with inertia J behind a gear of ratio n adds `n² J` to its joint: the reflected inertia, the
    armature of MuJoCo. It has no mass, no weight and no momentum of its own. The gyroscopic moment of the rotor and the
    reaction of its acceleration on the housing are neglected, as is usual for gears of high ratio; where they count,
    model the rotor as a body and the gear by a `JointCoupling`.

    The scene has one coordinate, one velocity and one row more for each: the coordinate x itself, `"rotor.angle"` of an
    angle, `"rotor.displacement"` of a displacement or length, which counts on through full turns. The reaction of the
    part is the generalized force `−inertia ẍ`, on the last body of the joint.

    **Arguments:** `coordinate`, a number, such as `"hip.angle"`; `inertia` [kg m² of an angle, kg of a displacement]
    > 0.
    """

    coordinate: str = fields.name()
    inertia: fields.Number = fields.parameter(unit="kg m² or kg", sign="positive", constant=True)
    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = False

    @property
    def combined(self):
        return (self.coordinate,)

    def scalar_coordinates(self, parts):
        is_length = self.coordinate.partition(".")[2].startswith(("displacement", "length"))
        name = f"{self.name}.{'displacement' if is_length else 'angle'}"
        return (ScalarCoordinate(name, is_length=is_length, moves=True),)

    def residual(self, space, poses, t):
        (value,) = self.values(space, poses[:-1])
        out = (poses[-1, 0] - value)[None]
        return shortest(out) if self.is_periodic(0) else out
