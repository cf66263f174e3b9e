"""A rigid body that tumbles freely."""

import numpy as np

from .. import spatial
from ..bodies.scene import Scene
from .mechanism import Mechanism, References, build, mechanism
from .observe import columns


@mechanism()
def free_body(
    *,
    mass: float = 1.0,
    inertia: tuple[float, float, float] = (1.0, 2.0, 3.0),
    angular_velocity: tuple[float, float, float] = (0.1, 2.0, 0.1),
) -> Mechanism:
    """A rigid body without forces, spinning about its middle axis, which is unstable: it turns over again and again.

    The reference values are Jacobi's elliptic functions (angular velocity), and a quaternion solution in extended
    precision.

    **Arguments:** `mass` [kg]; `inertia` [kg m²], principal moments, shape (3,); `angular_velocity` [rad/s] at the
    start, body frame, shape (3,).

    **Labels:** `q0` … `q3`, Euler parameters, scalar first, from (1, 0, 0, 0); `w1`, `w2`, `w3` [rad/s], angular
    velocity in the body frame.
    """
    body = spatial.Body("body", mass=mass, inertia=np.asarray(inertia, dtype=float))
    return build(
        "free_body",
        Scene([body]),
        t1=20.0,
        observe=_observe,
        description="A free rigid body that tumbles about its unstable middle axis.",
        references=References.load("free_body"),
        rates={"body.angular_velocity": angular_velocity},
    )


def _observe(trajectory):
    body = trajectory["body"]
    return columns(("q0", "q1", "q2", "q3"), body.orientation) | columns(("w1", "w2", "w3"), body.angular_velocity)
