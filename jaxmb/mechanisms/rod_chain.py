"""Chains of rods: a pendulum of many links."""

import numpy as np

from .. import planar
from ..bodies.scene import Scene
from ..parts.forces import Gravity
from .mechanism import Mechanism, References, build, mechanism
from .observe import columns, point_motion


@mechanism(variants=("n",))
def rod_chain(*, n: int = 10, length: float = 1.0, mass: float = 1.0, gravity: float = 9.81) -> Mechanism:
    """A hanging chain of n equal uniform slender rods, released from rest with all links horizontal; y up, the pin in
    the origin.

    The motion is chaotic: errors grow by orders of magnitude a second. The reference values, for n = 2, 5, 10 and 50,
    are solutions in absolute angles in extended precision, checked by a solution with Lagrange multipliers.

    **Arguments:** `n` ≥ 1, the number of links; `length` [m] and `mass` [kg] of the whole chain; `gravity` [m/s²].

    **Labels:** `tip_x`, `tip_y` [m], of the free end; `th1`, `th2`, … [rad], angles of the links from the downward
    vertical, counter-clockwise; `w1`, `w2`, … [rad/s], their rates.
    """
    if n < 1:
        raise ValueError(f"rod_chain needs n ≥ 1 links, got {n}.")
    l, m = length / n, mass / n
    links = [
        planar.Body(f"link{k}", mass=m, inertia=planar.rod(m, l), position=((k - 0.5) * l, 0.0))
        for k in range(1, n + 1)
    ]
    pins = [planar.Revolute("pin1", "ground", "link1", point_a=(0.0, 0.0), point_b=(-l / 2, 0.0))]
    pins += [
        planar.Revolute(f"pin{k}", f"link{k - 1}", f"link{k}", point_a=(l / 2, 0.0), point_b=(-l / 2, 0.0))
        for k in range(2, n + 1)
    ]
    scene = Scene(links, joints=pins, forces=[Gravity((0.0, -gravity))])
    references = References.load(f"rod_chain_{n}") if n in (2, 5, 10, 50) else None
    return build(
        "rod_chain",
        scene,
        t1=1.0 if references is None else references.times[-1],
        observe=lambda trajectory: _observe(trajectory, n, l),
        description=f"Chain of {n} uniform slender rods, released horizontally from rest.",
        references=references,
    )


def _observe(trajectory, n, l):
    tip, _ = point_motion(trajectory, f"link{n}", (0.5 * l, 0.0))
    observed = columns(("tip_x", "tip_y"), tip)
    for k in range(1, n + 1):
        link = trajectory[f"link{k}"]
        observed[f"th{k}"] = link.angle + 0.5 * np.pi
        observed[f"w{k}"] = link.angular_velocity
    return observed
