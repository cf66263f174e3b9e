"""Lagrange's heavy symmetric top."""

import numpy as np

from .. import spatial
from ..bodies.scene import Scene
from ..linalg import rotations
from ..parts.forces import Gravity
from .mechanism import Mechanism, References, build, mechanism
from .observe import columns


@mechanism()
def heavy_top(
    *,
    mass: float = 1.0,
    distance: float = 0.1,
    inertia: tuple[float, float] = (0.002, 0.001),
    tilt: float = np.pi / 6,
    precession: float = 2.0,
    spin: float = 60.0,
    gravity: float = 9.81,
) -> Mechanism:
    """A symmetric top whose tip is held in the origin by a ball joint; z up.

    Its axis is `e₃ = (sin ψ sin θ, −cos ψ sin θ, cos θ)`, θ the tilt from the vertical and ψ the precession angle. The
    reference values are Lagrange's solution in elliptic functions.

    **Arguments:** `mass` [kg]; `distance` [m] from the tip to the mass centre; `inertia` [kg m²] about the mass centre,
    across and along the axis, shape (2,); `tilt` θ [rad], `precession` dψ/dt [rad/s] and `spin` ω₃ [rad/s] about its
    axis at the start, with dθ/dt = 0; `gravity` [m/s²].

    **Labels:** `xc`, `yc`, `zc` [m], the mass centre; `e0` … `e3`, Euler parameters from the body frame, whose third
    axis is the top's; `w1`, `w2`, `w3` [rad/s], angular velocity in the body frame.
    """
    across, along = inertia
    p = np.asarray(rotations.from_axis_angle((1.0, 0.0, 0.0), tilt))
    position = distance * np.array([0.0, -np.sin(tilt), np.cos(tilt)])
    top = spatial.Body("top", mass=mass, inertia=(across, across, along), position=position, orientation=p)
    tip = spatial.Spherical("tip", "ground", "top", point_a=(0.0, 0.0, 0.0), point_b=(0.0, 0.0, -distance))
    return build(
        "heavy_top",
        Scene([top], joints=[tip], forces=[Gravity((0.0, 0.0, -gravity))]),
        t1=2.0,
        observe=_observe,
        description="Lagrange's heavy symmetric top on a fixed tip.",
        references=References.load("heavy_top"),
        rates={"top.angular_velocity": (0.0, precession * np.sin(tilt), spin)},
    )


def _observe(trajectory):
    top = trajectory["top"]
    observed = columns(("xc", "yc", "zc"), top.position) | columns(("e0", "e1", "e2", "e3"), top.orientation)
    return observed | columns(("w1", "w2", "w3"), top.angular_velocity)
