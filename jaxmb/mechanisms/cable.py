"""A cable of rods, hung at both ends."""

import numpy as np

from .. import spatial
from ..bodies.scene import Scene
from ..linalg import rotations
from ..parts.forces import Gravity
from .mechanism import Mechanism, build, mechanism
from .observe import columns, point_motion

# Angle of the plane of the cable from the vertical at the start [rad].
_SWUNG = 0.5


@mechanism()
def cable(
    *,
    n: int = 10,
    length: float = 1.0,
    span: float = 0.8,
    mass: float = 1.0,
    radius: float = 0.01,
    gravity: float = 9.81,
) -> Mechanism:
    """A cable of n equal uniform round rods on ball joints, hung from two points at one height; z up.

    It hangs from the origin and from `(span, 0, 0)`. At the start it is at rest on a circular arc, a polygon of equal
    sides and equal angles, in a plane at 0.5 rad from the vertical: swung to the side of positive y. Every rod is free
    to turn about its axis, but nothing turns it. Of the `6 n` velocities `3 n - 3` are free.

    With the turn α from one rod to the next, a polygon of n sides l spans `l Σ cos((k - (n + 1) / 2) α)`, k = 1 … n.
    The span falls from `n l` to zero while α grows from zero to `2 π / n`; α is found by bisection. The tests check the
    motion by independent equations in the directions of the rods.

    **Arguments:** `n` ≥ 2, the number of rods; `length` [m] and `mass` [kg] of the whole cable; `span` [m], the
    distance of its ends, less than its length; `radius` [m] of the rods; `gravity` [m/s²].

    **Labels:** `x`, `y`, `z` [m] and `vx`, `vy`, `vz` [m/s] of the middle of the cable: a joint if n is even, the
    centre of a rod if it is odd.

    **Raises:** `ValueError` for less than two rods, and for ends that coincide or are out of reach.
    """
    if n < 2:
        raise ValueError(f"cable needs n ≥ 2 rods, got {n}.")
    if not 0 < span < length:
        raise ValueError(f"cable needs a span between zero and its length of {length} m, got {span} m.")
    l, m = length / n, mass / n
    pitch = _turn(n, span / l) * (np.arange(n) - (n - 1) / 2)
    across = np.array([0.0, np.cos(_SWUNG), np.sin(_SWUNG)])
    up = np.array([0.0, -np.sin(_SWUNG), np.cos(_SWUNG)])
    along = np.cos(pitch)[:, None] * np.array([1.0, 0.0, 0.0]) + np.sin(pitch)[:, None] * up
    ends = np.concatenate([np.zeros((1, 3)), np.cumsum(l * along, axis=0)])
    rods = [
        spatial.Body(
            f"rod{k + 1}",
            mass=m,
            inertia=spatial.rod(m, l, radius=radius),
            position=(ends[k] + ends[k + 1]) / 2,
            orientation=rotations.from_matrix(np.stack([along[k], across, np.cross(along[k], across)], axis=1)),
        )
        for k in range(n)
    ]
    left, right = (-l / 2, 0.0, 0.0), (l / 2, 0.0, 0.0)
    joints = [spatial.Spherical("ball1", "ground", "rod1", point_a=(0.0, 0.0, 0.0), point_b=left)]
    joints += [
        spatial.Spherical(f"ball{k}", f"rod{k - 1}", f"rod{k}", point_a=right, point_b=left) for k in range(2, n + 1)
    ]
    joints += [spatial.Spherical(f"ball{n + 1}", f"rod{n}", "ground", point_a=right, point_b=(span, 0.0, 0.0))]
    return build(
        "cable",
        Scene(rods, joints=joints, forces=[Gravity((0.0, 0.0, -gravity))]),
        t1=1.0,
        observe=lambda trajectory: _observe(trajectory, n, l),
        description=f"Cable of {n} rods on ball joints, hung at both ends, swung to the side and released from rest.",
    )


def _turn(n, sides):
    """The turn [rad] from side to side of a polygon of n equal sides whose ends are `sides` sides apart."""
    apart = lambda turn: np.sum(np.cos((np.arange(n) - (n - 1) / 2) * turn))
    low, high = 0.0, 2 * np.pi / n
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if apart(middle) > sides else (low, middle)
    return (low + high) / 2


def _observe(trajectory, n, l):
    place, velocity = point_motion(trajectory, f"rod{(n + 1) // 2}", (0.0 if n % 2 else l / 2, 0.0, 0.0))
    return columns("xyz", place) | columns(("vx", "vy", "vz"), velocity)
