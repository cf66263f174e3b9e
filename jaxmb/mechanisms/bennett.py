"""Bennett's linkage."""

import jax.numpy as jnp
import numpy as np

from .. import spatial
from ..bodies.scene import Scene
from ..linalg import rotations
from ..parts.forces import Gravity
from .mechanism import Mechanism, References, build, mechanism
from .observe import body_axis


@mechanism()
def bennett(
    *,
    lengths: tuple[float, float] = (0.3, 0.5),
    twist: float = 70.0,
    masses: tuple[float, float, float] = (0.6, 1.0, 0.6),
    section: float = 0.02,
    angle: float = 1.0,
    speed: float = 8.0,
    gravity: float = 9.81,
) -> Mechanism:
    """Four hinges on skew axes, a loop with one degree of freedom although the count of rows leaves −2; y up.

    Links of length a and twist α alternate with links of length b and twist β, `b sin α = a sin β`. The ground is a
    link of length b, with the input axis z in the origin and the output axis at (−b, 0, 0). Input θ and output φ,
    measured from x, obey `tan(θ/2) tan(φ/2) = sin((α + β)/2) / sin((β − α)/2)`.

    Source: G. T. Bennett, A new mechanism, Engineering 76, 1903; data of this package. The reference values come from
    the energy of a model with one coordinate, and from this relation.

    **Arguments:** `lengths` a and b [m]; `twist` β [degree], α is acute; `masses` [kg] of the moving links, uniform
    round rods of radius `section` [m]; `angle` θ [rad] and `speed` [rad/s] of the input at the start; `gravity` [m/s²].

    **Labels:** `cos`, `sin` of the input θ; `cos_out`, `sin_out` of the output φ; `omega` [rad/s], rate of the input.
    """
    a, b = lengths
    beta = np.radians(twist)
    if not abs(a * np.sin(beta)) < b:
        raise ValueError(f"The lengths {a}, {b} m with the twist {twist}° leave no other twist: b sin α = a sin β.")
    alpha = np.arcsin(a * np.sin(beta) / b)
    output = 2 * np.arctan2(
        np.sin((alpha + beta) / 2) * np.cos(angle / 2), np.sin((beta - alpha) / 2) * np.sin(angle / 2)
    )
    x, z = np.eye(3)[0], np.eye(3)[2]
    point, frame = np.zeros(3), np.eye(3)
    bodies, names = [], ["ground", "link1", "link2", "link3", "ground"]
    axes, points = [z], [point]
    links = zip(names[1:], masses, (a, b, a), (alpha, beta, alpha), (angle, output, -angle), strict=False)
    for name, mass, length, skew, turn in links:
        frame = frame @ _turned(z, turn)
        along = length * frame[:, 0]
        bodies.append(
            spatial.Body(
                name,
                mass=mass,
                inertia=spatial.rod(mass, length, radius=section),
                position=point + along / 2,
                orientation=rotations.from_matrix(frame),
            )
        )
        point, frame = point + along, frame @ _turned(x, skew)
        axes.append(frame[:, 2])
        points.append(point)
    hinges = [
        spatial.Revolute(f"hinge{k + 1}", names[k], names[k + 1], point=points[k], axis=axes[k]) for k in range(4)
    ]
    return build(
        "bennett",
        Scene(bodies, joints=hinges, forces=[Gravity((0.0, -gravity, 0.0))]),
        t1=2.0,
        observe=lambda trajectory: _observe(trajectory, beta),
        description="Bennett's linkage, four hinges on skew axes, over-constrained; under gravity.",
        references=References.load("bennett"),
        rates={"link1.wz": speed},
    )


def _turned(axis, angle):
    return np.asarray(rotations.rotation_matrix(rotations.from_axis_angle(axis, angle)))


def _observe(trajectory, beta):
    first, last = (body_axis(trajectory, link, (1.0, 0.0, 0.0)) for link in ("link1", "link3"))
    return {
        "cos": first[:, 0],
        "sin": first[:, 1],
        "cos_out": last[:, 0],
        "sin_out": last @ jnp.array([0.0, np.cos(beta), -np.sin(beta)]),
        "omega": trajectory["link1"].angular_velocity[:, 2],
    }
