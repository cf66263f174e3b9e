"""The swash-plate compressor."""

import numpy as np

from .. import spatial
from ..bodies.scene import Scene
from ..linalg import rotations
from ..parts.forces import Gravity
from .mechanism import Mechanism, References, build, mechanism
from .observe import turn_about_x


@mechanism()
def swash_plate(
    *,
    pistons: int = 3,
    radius: float = 0.2,
    rod: float = 0.5,
    tilt: float = np.pi / 9,
    masses: tuple[float, float, float, float] = (4.0, 3.0, 0.5, 0.8),
    shaft_inertia: float = 0.03,
    speed: float = 20 * np.pi,
    torque: float = 0.0,
    gravity: float = 9.81,
) -> Mechanism:
    """A plate on an inclined journal of a shaft drives pistons parallel to the shaft by rods; x along the shaft, z up.

    A pin in a slot keeps a point of the plate in the plane of x and y: the plate wobbles and does not turn with the
    shaft. Rods have ball joints at the plate and Cardan joints at the pistons. With three pistons, and the ground
    counted as a body, there are nine bodies with 63 coordinates and 62 rows: one degree of freedom.

    Source: the air compressor of E. J. Haug, "Computer Aided Kinematics and Dynamics of Mechanical Systems", 1989,
    §10.4, with masses of this package. The reference values come from the energy of a model with one coordinate.

    **Arguments:** `pistons` ≥ 1; `radius` [m] of the circles of pistons and of the plate's joints; length of a `rod`
    [m]; `tilt` [rad] of the journal; `masses` [kg] of shaft, plate, a rod and a piston, shape (4,): the plate a thin
    disc, rods slender; `shaft_inertia` [kg m²]; `speed` [rad/s] of the shaft at the start, `torque` [N m] on it;
    `gravity` [m/s²].

    **Labels:** `cos`, `sin` of the shaft's angle θ, zero at the start; `omega` [rad/s], its rate; `x1`, `x2`, … [m] and
    `v1`, `v2`, … [m/s] of the pistons.
    """
    if pistons < 1:
        raise ValueError(f"swash_plate needs at least one piston, got {pistons}.")
    x, z = np.eye(3)[0], np.eye(3)[2]
    journal = np.array([np.cos(tilt), np.sin(tilt), 0.0])
    plate = np.stack([journal, np.cross(z, journal), z], axis=1)
    angles = 2 * np.pi * np.arange(pistons) / pistons
    circle = np.stack([np.zeros(pistons), np.cos(angles), np.sin(angles)], axis=1)
    turned = lambda frame: rotations.from_matrix(frame)

    bodies = [
        spatial.Body("shaft", mass=masses[0], inertia=(shaft_inertia,) * 3),
        spatial.Body("plate", mass=masses[1], inertia=spatial.disc(masses[1], radius, "x"), orientation=turned(plate)),
    ]
    joints = [
        spatial.Revolute("bearing", "ground", "shaft", point=np.zeros(3), axis=x),
        spatial.Revolute("journal", "shaft", "plate", point=np.zeros(3), axis=journal),
        spatial.PointOnPlane("slot", "ground", "plate", point_a=np.zeros(3), point_b=(0.0, radius, 0.0), axis_a=z),
    ]
    for k, out in enumerate(circle, start=1):
        pin = radius * plate @ out
        across = radius * out - pin
        across[0] = 0.0
        reach = rod**2 - across @ across
        if reach <= 0:
            raise ValueError(f"The rods of {rod} m do not reach the pistons: make them longer, or the radius smaller.")
        head = radius * out + (pin[0] + np.sqrt(reach)) * x
        along, tangent = (head - pin) / rod, np.cross(x, out)
        bend = np.cross(along, tangent)
        bend /= np.linalg.norm(bend)
        frame = np.stack([along, bend, np.cross(along, bend)], axis=1)
        inertia = spatial.rod(masses[2], rod, radius=rod / 50)
        bodies += [
            spatial.Body(
                f"rod{k}", mass=masses[2], inertia=inertia, position=(pin + head) / 2, orientation=turned(frame)
            ),
            spatial.Body(f"piston{k}", mass=masses[3], inertia=spatial.sphere(masses[3], radius / 4), position=head),
        ]
        joints += [
            spatial.Spherical(f"ball{k}", "plate", f"rod{k}", point=pin),
            spatial.Universal(f"cardan{k}", f"rod{k}", f"piston{k}", point=head, axis_a_W=bend, axis_b_W=tangent),
            spatial.Prismatic(f"cylinder{k}", "ground", f"piston{k}", point=head, axis=x),
        ]
    forces = [spatial.Torque("drive", "shaft", torque=torque * x), Gravity((0.0, 0.0, -gravity))]
    return build(
        "swash_plate",
        Scene(bodies, joints=joints, forces=forces),
        t1=0.1,
        observe=lambda trajectory: _observe(trajectory, pistons),
        description="Swash-plate compressor: a wobbling plate, rods and pistons, coasting at 600 rpm.",
        references=References.load("swash_plate"),
        rates={"shaft.wx": speed},
    )


def _observe(trajectory, pistons):
    observed = turn_about_x(trajectory, "shaft") | {"omega": trajectory["shaft"].angular_velocity[:, 0]}
    for k in range(1, pistons + 1):
        piston = trajectory[f"piston{k}"]
        observed |= {f"x{k}": piston.position[:, 0], f"v{k}": piston.velocity[:, 0]}
    return observed
