"""The planar pendulum."""

import numpy as np

from .. import planar
from ..bodies.scene import Scene
from ..parts.forces import Gravity
from .mechanism import Mechanism, References, build, mechanism
from .observe import columns

_SOURCE = (
    "Problem A01 of the IFToMM Library of Computational Benchmark Problems for multibody dynamics "
    "(https://www.iftomm-multibody.org/benchmark)"
)


@mechanism()
def pendulum(
    *, mass: float = 1.0, length: float = 1.0, angle: float = -np.pi / 2, rate: float = 0.0, gravity: float = 9.81
) -> Mechanism:
    """A point mass on a massless bar, released at the side; x to the right, y up, the pivot in the origin.

    Source: problem A01 of the IFToMM Library of Computational Benchmark Problems (1 kg, 1 m, released at (−1, 0)). The
    reference values are Jacobi's elliptic functions in 22 digits.

    **Arguments:** `mass` [kg]; `length` [m]; `angle` [rad] from the downward vertical, counter-clockwise, and its
    `rate` [rad/s], at the start; `gravity` [m/s²].

    **Labels:** `x`, `y` [m], `vx`, `vy` [m/s] of the mass.
    """
    along = np.array([np.sin(angle), -np.cos(angle)])
    across = np.array([-along[1], along[0]])
    bob = planar.PointMass("bob", mass=mass, position=length * along, velocity=length * rate * across)
    bar = planar.Distance("bar", "ground", "bob", length=length)
    scene = Scene([bob], joints=[bar], forces=[Gravity((0.0, -gravity))])
    return build(
        "pendulum",
        scene,
        t1=9.99,
        observe=_observe,
        description=f"Planar pendulum: a point mass on a massless bar. {_SOURCE}.",
        references=References.load("pendulum"),
    )


def _observe(trajectory):
    bob = trajectory["bob"]
    return columns("xy", bob.position) | columns(("vx", "vy"), bob.velocity)
