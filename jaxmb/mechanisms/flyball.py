"""The stiff flyball governor."""

import jax.numpy as jnp
import numpy as np

from .. import spatial
from ..bodies.scene import Scene
from ..linalg import rotations
from ..parts.forces import Gravity
from .mechanism import Mechanism, References, build, mechanism
from .observe import body_axis

# Lengths [m] and density [kg/m³] of the source.
_HEIGHT, _ARM, _SECTION, _CUBE, _OFFSET = 1.0, 1.0, 0.01, 0.1, 0.05
_DENSITY = 3000.0


@mechanism()
def flyball(
    *,
    stiffness: float = 8e5,
    damping: float = 4e4,
    ball: float = 5.0,
    angle: float = np.pi / 6,
    speed: float = 2 * np.pi,
    gravity: float = 9.81,
) -> Mechanism:
    """A governor: two arms with balls, hinged to the top of a turning shaft, and a cube that slides on the shaft, held
    by stiff springs and dampers from the arms; z up.

    The shaft, 1 m high, stands in the origin on its axis z. The arms, 1 m long, hang on hinges along the shaft's y axis
    at (±0.05, 0, 1) m in its frame, and point away from the axis, α below the horizontal. A spring and a damper act
    between the middle of each arm and the point (±0.05, 0, s) m of the cube, s the height of its centre. They are 0.5 m
    long and free of force at the start, and all parts turn together. Shaft and arms are bars of 0.01 m × 0.01 m, the
    cube has 0.1 m, their density is 3000 kg/m³; the balls are points at the arms' ends. The fastest motion of the
    springs decays at 8100 / s, the slowest at 20 / s.

    Source: problem A05 of the IFToMM Library of Computational Benchmark Problems, with the data of
    MBSbenchmarksInOpenSim. The reference values were recomputed in three minimal coordinates in extended precision.

    **Arguments:** `stiffness` [N/m] and `damping` [N s/m] of each spring; `ball` [kg], mass of a ball; `angle` α [rad],
    between 0 and π/2, and `speed` [rad/s] of the shaft, at the start; `gravity` [m/s²].

    **Labels:** `cos`, `sin` of the shaft's angle, zero at the start; `alpha` [rad] of `arm1`, at +x; `s` [m]; `omega`
    [rad/s] of the shaft; `alpha_dot` [rad/s]; `s_dot` [m/s].
    """
    z = np.array([0.0, 0.0, 1.0])
    rod, cube = _DENSITY * _ARM * _SECTION**2, _DENSITY * _CUBE**3
    shaft = _DENSITY * _HEIGHT * _SECTION**2
    height = _HEIGHT - _ARM * np.sin(angle)
    # Mass centre of an arm with its ball, from the hinge.
    centre = (rod * _ARM / 2 + ball * _ARM) / (rod + ball)
    offsets = rod * (_ARM / 2 - centre) ** 2 + ball * (_ARM - centre) ** 2
    inertia = spatial.box(rod, _ARM, _SECTION, _SECTION) + offsets * jnp.diag(jnp.array([0.0, 1.0, 1.0]))

    def arm(k, turn):
        along = np.array([np.cos(turn), 0.0, -np.sin(turn)])
        hinge = np.array([np.sign(along[0]) * _OFFSET, 0.0, _HEIGHT])
        position = hinge + centre * along
        body = spatial.Body(
            f"arm{k}",
            mass=rod + ball,
            inertia=inertia,
            position=position,
            orientation=rotations.from_axis_angle((0.0, 1.0, 0.0), turn),
            velocity=np.cross(speed * z, position),
            angular_velocity=(-speed * np.sin(turn), 0.0, speed * np.cos(turn)),
        )
        joint = spatial.Revolute(f"hinge{k}", "shaft", body.name, point=hinge, axis=(0.0, 1.0, 0.0))
        spring = spatial.SpringDamper(
            f"spring{k}",
            "slider",
            body.name,
            stiffness=stiffness,
            damping=damping,
            free_length=_ARM / 2,
            point_a=(hinge[0], 0.0, 0.0),
            point_b=(_ARM / 2 - centre, 0.0, 0.0),
        )
        return body, joint, spring

    arms, hinges, springs = zip(arm(1, angle), arm(2, np.pi - angle), strict=True)
    bodies = [
        spatial.Body(
            "shaft",
            mass=shaft,
            inertia=spatial.box(shaft, _SECTION, _SECTION, _HEIGHT),
            position=_HEIGHT / 2 * z,
            angular_velocity=speed * z,
        ),
        *arms,
        spatial.Body(
            "slider",
            mass=cube,
            inertia=spatial.box(cube, _CUBE, _CUBE, _CUBE),
            position=height * z,
            angular_velocity=speed * z,
        ),
    ]
    joints = [
        spatial.Revolute("axle", "ground", "shaft", point=np.zeros(3), axis=z),
        *hinges,
        spatial.Prismatic("slide", "shaft", "slider", point=height * z, axis=z),
    ]
    return build(
        "flyball",
        Scene(bodies, joints=joints, forces=[*springs, Gravity((0.0, 0.0, -gravity))]),
        t1=10.0,
        observe=_observe,
        description="Flyball governor with stiff springs and dampers, turning freely under gravity (IFToMM A05).",
        references=References.load("flyball"),
        rates={"shaft.wz": speed, "arm1.wy": 0.0, "arm2.wy": 0.0, "slider.z": 0.0},
    )


def _observe(trajectory):
    shaft, arm, slider = trajectory["shaft"], trajectory["arm1"], trajectory["slider"]
    x, along = (body_axis(trajectory, name, (1.0, 0.0, 0.0)) for name in ("shaft", "arm1"))
    return {
        "cos": x[:, 0],
        "sin": x[:, 1],
        "alpha": jnp.arctan2(-along[:, 2], jnp.sum(x * along, axis=1)),
        "s": slider.position[:, 2],
        "omega": shaft.angular_velocity[:, 2],
        "alpha_dot": arm.angular_velocity[:, 1],
        "s_dot": slider.velocity[:, 2],
    }
