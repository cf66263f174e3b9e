"""N four-bar linkages in a row."""

import numpy as np

from .. import planar
from ..bodies.scene import Scene
from ..parts.forces import Gravity
from .mechanism import Mechanism, References, build, mechanism
from .observe import columns, point_motion


@mechanism()
def n_four_bar(
    *, n: int = 2, length: float = 1.0, mass: float = 1.0, speed: float = 1.0, gravity: float = 9.81
) -> Mechanism:
    """n + 1 upright bars on ground pivots a length apart, their tips joined by n level bars, fall to one side; y up.

    One degree of freedom, θ from upright: `I θ̈ = P g sin θ / l` with `I = (n + 1)/3 + n`, `P = (n + 1)/2 + n`. Where
    all bars lie in one line, at odd multiples of π/2, the rows lose rank and other motions branch off. Steps pass over
    these positions and stay on their branch, because the prediction is much closer to it than to any other branch.
    Steps keep a distance from these positions, since round-off is divided by the cube of the distance. At rtol 1e-11
    and below, no step can cross the necessary distance: steps become tiny, and the motion ends with a result that
    reports this.

    Source: problem A02 of the IFToMM Library of Computational Benchmark Problems for multibody dynamics (1 m, 1 kg,
    1 m/s, 10 s). The reference values, for n = 2, come from the equation above.

    **Arguments:** `n` ≥ 1; `length` [m] and `mass` [kg] of every bar, uniform and slender; `speed` [m/s] of the tips
    at the start, along x; `gravity` [m/s²].

    **Labels:** `x`, `y` [m] and `vx`, `vy` [m/s] of the first tip; `rate` [rad/s], θ̇.
    """
    if n < 1:
        raise ValueError(f"n_four_bar needs n ≥ 1 linkages, got {n}.")
    half = length / 2
    inertia = planar.rod(mass, length)
    uprights = [
        planar.Body(f"upright{k}", mass=mass, inertia=inertia, position=(k * length, half), angle=np.pi / 2)
        for k in range(n + 1)
    ]
    levels = [
        planar.Body(f"level{k}", mass=mass, inertia=inertia, position=((k - 0.5) * length, length))
        for k in range(1, n + 1)
    ]
    pin = lambda name, a, b, at_a, at_b: planar.Revolute(name, a, b, point_a=(at_a, 0.0), point_b=(at_b, 0.0))
    joints = [pin(f"foot{k}", "ground", f"upright{k}", k * length, -half) for k in range(n + 1)]
    for k in range(1, n + 1):
        joints += [
            pin(f"left{k}", f"upright{k - 1}", f"level{k}", half, -half),
            pin(f"right{k}", f"level{k}", f"upright{k}", half, half),
        ]
    return build(
        "n_four_bar",
        Scene([*uprights, *levels], joints=joints, forces=[Gravity((0.0, -gravity))]),
        t1=10.0,
        observe=lambda trajectory: _observe(trajectory, half),
        description="Four-bar linkages in a row that fall and lie flat in passing (IFToMM benchmark A02).",
        references=References.load("n_four_bar"),
        fix={"upright0.angle": np.pi / 2},
        rates={"upright0.angle": -speed / length},
    )


def _observe(trajectory, half):
    tip, velocity = point_motion(trajectory, "upright0", (half, 0.0))
    rate = -trajectory["upright0"].angular_velocity
    return columns("xy", tip) | columns(("vx", "vy"), velocity) | {"rate": rate}
