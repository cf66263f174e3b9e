"""The car axis of the test set for initial value problem solvers."""

import jax.numpy as jnp

from .. import planar
from ..bodies.scene import Scene
from ..linalg.rotations import norm
from ..parts.forces import Gravity
from ..parts.functions import Constraint, Force
from .mechanism import Mechanism, References, build, mechanism
from .observe import columns


@mechanism()
def car_axis(
    *,
    mass: float = 10.0,
    epsilon: float = 1e-2,
    length: float = 1.0,
    free_length: float = 0.5,
    amplitude: float = 0.1,
    frequency: float = 10.0,
    gravity: float = 1.0,
) -> Mechanism:
    """A chassis on two stiff springs, one wheel on a flat road and the other on a bumpy one.

    Two point masses `left` and `right` of `mass epsilon² / 2`, joined by a massless bar, on springs of unit stiffness
    over the wheels (0, 0) and (x_b, y_b), `y_b = amplitude sin(frequency t)`, `x_b = √(length² − y_b²)`. The left
    spring stays perpendicular to the line between the wheels, a rheonomic constraint: `x_l x_b + y_l y_b = 0`.

    Source: S. Schneider, "Intégration de systèmes d'équations différentielles raides et différentielles-algébriques par
    des méthodes de collocations et méthodes générales linéaires", thesis, Genève 1994, as in F. Mazzia and C.
    Magherini, "Test Set for Initial Value Problem Solvers", 2008; all quantities without units. The reference values
    were recomputed in extended precision, with multipliers and in two minimal coordinates; the test set's values agree
    to 12 digits in positions and to 9 in velocities.

    **Arguments:** as in the source, `mass` M, `epsilon` ε, `length` L of the axle and `free_length` L₀ of the springs,
    `amplitude` r and `frequency` ω of the road, `gravity` g.

    **Labels:** `xl`, `yl`, `xr`, `yr`; `xl1`, … their rates; `lam1`, `lam2`, the source's multipliers.
    """
    point = 0.5 * mass * epsilon**2
    left = planar.PointMass("left", mass=point, position=(0.0, free_length))
    right = planar.PointMass("right", mass=point, position=(length, free_length))
    road = {"length": length, "amplitude": amplitude, "frequency": frequency}
    joints = [
        Constraint("upright", "left", _upright, parameters=road),
        planar.Distance("axle", "left", "right", length=length),
    ]
    forces = [
        planar.SpringDamper("left_spring", "ground", "left", stiffness=1.0, free_length=free_length),
        Force("right_spring", "right", _right_spring, parameters=road | {"free_length": free_length}),
        Gravity((0.0, -gravity)),
    ]
    return build(
        "car_axis",
        Scene([left, right], joints=joints, forces=forces),
        t1=3.0,
        observe=lambda trajectory: _observe(trajectory, length),
        description="Car axis: a chassis on springs over a bumpy road, two point masses and a constraint in time.",
        references=References.load("car_axis"),
        fix={"left.y": free_length, "right.y": free_length},
        rates={"left.y": 0.0, "right.y": 0.0},
    )


def _wheel(t, road):
    """Contact point of the right wheel."""
    y = road["amplitude"] * jnp.sin(road["frequency"] * t)
    return jnp.stack([jnp.sqrt(road["length"] ** 2 - y**2), y])


def _upright(poses, t, road):
    return jnp.dot(poses[0, :2], _wheel(t, road))


def _right_spring(poses, velocities, t, road):
    del velocities
    d = poses[0, :2] - _wheel(t, road)
    length = norm(d)
    force = (road["free_length"] - length) * d / length
    return jnp.concatenate([force, jnp.zeros_like(force[:1])])


def _observe(trajectory, length):
    observed = {}
    for body, letter in (("left", "l"), ("right", "r")):
        motion = trajectory[body]
        observed |= columns((f"x{letter}", f"y{letter}"), motion.position)
        observed |= columns((f"x{letter}1", f"y{letter}1"), motion.velocity)
    observed["lam1"] = trajectory.reactions["upright"].multipliers[:, 0]
    # A rod's row is its constraint over twice the length, so that its multiplier is a force.
    observed["lam2"] = trajectory.reactions["axle"].multipliers[:, 0] / (2 * length)
    return observed
