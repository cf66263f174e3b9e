"""Trees of rods: an open system that branches."""

import numpy as np

from .. import planar
from ..bodies.scene import Scene
from ..parts.forces import Gravity
from .mechanism import Mechanism, build, mechanism
from .observe import columns, point_motion

# Angle of the first rod from the downward vertical at the start [rad].
_TILT = 0.5


@mechanism()
def tree(
    *,
    n: int = 15,
    branching: int = 2,
    spread: float = 0.5,
    length: float = 1.0,
    mass: float = 1.0,
    gravity: float = 9.81,
) -> Mechanism:
    """A tree of n equal uniform slender rods on pins, released from rest; y up, the first pin in the origin.

    Rod 1 hangs from the ground, and every further rod k from the free end of rod `1 + (k - 2) // branching`. At the
    start rod 1 is at 0.5 rad from the downward vertical, and the rods that hang from one rod are at evenly spaced
    angles from `-spread` to `spread` about its direction; a single rod is straight on. Rods may pass through each
    other.

    The equations of motion in the rods' angles have a closed form; the tests compare with it. Its mass matrix couples a
    rod only with rods above and below it.

    **Arguments:** `n` ≥ 1, the number of rods; `branching` ≥ 1, the number of rods that hang from one; `spread` [rad];
    `length` [m] and `mass` [kg] of one rod; `gravity` [m/s²].

    **Labels:** `tip_x`, `tip_y` [m], of the free end of the last rod; `th1`, `th2`, … [rad], angles of the rods from
    the downward vertical, counter-clockwise; `w1`, `w2`, … [rad/s], their rates.

    **Raises:** `ValueError` for less than one rod, or less than one rod that hangs from another.
    """
    if n < 1 or branching < 1:
        raise ValueError(f"tree needs n ≥ 1 rods and a branching ≥ 1, got n = {n} and branching {branching}.")
    above = [0, *(1 + (k - 2) // branching for k in range(2, n + 1))]
    hanging = np.bincount(above, minlength=n + 1)
    angles, ends = [_TILT - 0.5 * np.pi], [np.zeros(2)]
    for k in range(1, n + 1):
        direction = np.array([np.cos(angles[k - 1]), np.sin(angles[k - 1])])
        ends.append(ends[above[k - 1]] + length * direction)
        relative = np.linspace(-spread, spread, hanging[k]) if hanging[k] > 1 else np.zeros(hanging[k])
        angles += list(angles[k - 1] + relative)
    rods, pins = [], []
    for k in range(1, n + 1):
        parent, angle = above[k - 1], angles[k - 1]
        middle = (ends[parent] + ends[k]) / 2
        rods.append(planar.Body(f"rod{k}", mass=mass, inertia=planar.rod(mass, length), position=middle, angle=angle))
        held, point = (f"rod{parent}", (length / 2, 0.0)) if parent else ("ground", (0.0, 0.0))
        pins.append(planar.Revolute(f"pin{k}", held, f"rod{k}", point_a=point, point_b=(-length / 2, 0.0)))
    return build(
        "tree",
        Scene(rods, joints=pins, forces=[Gravity((0.0, -gravity))]),
        t1=1.0,
        observe=lambda trajectory: _observe(trajectory, n, length),
        description=f"Tree of {n} uniform slender rods, {branching} hanging from one, released from rest.",
    )


def _observe(trajectory, n, length):
    tip, _ = point_motion(trajectory, f"rod{n}", (0.5 * length, 0.0))
    observed = columns(("tip_x", "tip_y"), tip)
    for k in range(1, n + 1):
        rod = trajectory[f"rod{k}"]
        observed |= {f"th{k}": rod.angle + 0.5 * np.pi, f"w{k}": rod.angular_velocity}
    return observed
