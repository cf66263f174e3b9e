"""A net of knots and rods."""

from .. import spatial
from ..bodies.scene import Scene
from ..parts.forces import Gravity
from .mechanism import Mechanism, build, mechanism
from .observe import columns


@mechanism()
def net(*, n: int = 4, m: int = 4, spacing: float = 1.0, mass: float = 1.0, gravity: float = 9.81) -> Mechanism:
    """A net of n × m equal masses on massless rods, hung at two corners and released from rest in the horizontal plane;
    z up.

    Knot (i, j), i = 1 … n and j = 1 … m, starts at `((i - 1) spacing, (j - 1) spacing, 0)`, and a rod connects it with
    each of its neighbours in the grid. Knots (1, 1) and (n, 1) hang from ground points at the height `spacing` above
    them, on rods of this length. Rods carry tension and compression alike, and may pass through each other.

    Meshes are squares without diagonals. Thus the `2 n m - n - m + 2` rows are independent, also while all rods are in
    one plane, and leave `n m + n + m - 2` of the `3 n m` velocities free. The motion is symmetric about the plane `x =
    (n - 1) spacing / 2`.

    The tests check the motion by independent equations for the forces in the rods.

    **Arguments:** `n`, `m` ≥ 2, the numbers of knots along x and y; `spacing` [m] of the knots; `mass` [kg] of one
    knot; `gravity` [m/s²].

    **Labels:** `x`, `y`, `z` [m] and `vx`, `vy`, `vz` [m/s] of knot (n, m), the corner opposite to the first support.

    **Raises:** `ValueError` for less than two knots along a side.
    """
    if n < 2 or m < 2:
        raise ValueError(f"net needs n ≥ 2 and m ≥ 2 knots along its sides, got n = {n} and m = {m}.")
    knots = [
        spatial.PointMass(f"knot{i}_{j}", mass=mass, position=((i - 1) * spacing, (j - 1) * spacing, 0.0))
        for i in range(1, n + 1)
        for j in range(1, m + 1)
    ]
    rods = [
        spatial.Distance(
            f"hanger{k}", "ground", f"knot{i}_1", point_a=((i - 1) * spacing, 0.0, spacing), length=spacing
        )
        for k, i in ((1, 1), (2, n))
    ]
    rods += [
        spatial.Distance(f"x{i}_{j}", f"knot{i}_{j}", f"knot{i + 1}_{j}", length=spacing)
        for i in range(1, n)
        for j in range(1, m + 1)
    ]
    rods += [
        spatial.Distance(f"y{i}_{j}", f"knot{i}_{j}", f"knot{i}_{j + 1}", length=spacing)
        for i in range(1, n + 1)
        for j in range(1, m)
    ]
    return build(
        "net",
        Scene(knots, joints=rods, forces=[Gravity((0.0, 0.0, -gravity))]),
        t1=1.0,
        observe=lambda trajectory: _observe(trajectory, n, m),
        description=f"Net of {n} × {m} masses on rods, hung at two corners, released from rest while horizontal.",
    )


def _observe(trajectory, n, m):
    corner = trajectory[f"knot{n}_{m}"]
    return columns("xyz", corner.position) | columns(("vx", "vy", "vz"), corner.velocity)
