"""Chaplygin's sleigh."""

import jax.numpy as jnp

from .. import planar
from ..bodies.scene import Scene
from .mechanism import Mechanism, References, build, mechanism
from .observe import columns, point_motion


@mechanism()
def chaplygin_sleigh(
    *, mass: float = 2.0, inertia: float = 0.5, distance: float = 0.3, speed: float = 1.0, spin: float = 2.0
) -> Mechanism:
    """A sleigh on a horizontal plane with one blade behind its mass centre: it straightens out without dissipation.

    Source: S. A. Chaplygin, "On the theory of motion of nonholonomic systems. The reducing-multiplier theorem", Mat.
    Sb. 28(2), 1911. The reference values are the closed form `v = V tanh(kt + c)`, `ω = V/√J sech(kt + c)`, `k = aV/J`,
    `J = (I + m a²)/m`.

    **Arguments:** `mass` m [kg]; `inertia` I [kg m²] about the mass centre; `distance` a [m] from the blade forward to
    the mass centre; `speed` [m/s] of the blade and `spin` [rad/s] at the start, with the blade in the origin, along x.

    **Labels:** `x_blade`, `y_blade` [m]; `theta` [rad], heading from x; `v` [m/s] of the blade, forward; `omega`
    [rad/s].
    """
    sleigh = planar.Body("sleigh", mass=mass, inertia=inertia, position=(distance, 0.0))
    blade = planar.KnifeEdge("blade", "sleigh", point=(-distance, 0.0))
    return build(
        "chaplygin_sleigh",
        Scene([sleigh], joints=[blade]),
        t1=4.0,
        observe=lambda trajectory: _observe(trajectory, distance),
        description="Chaplygin's sleigh: a rigid body on one blade, which straightens out.",
        references=References.load("chaplygin_sleigh"),
        rates={"sleigh.x": speed, "sleigh.angle": spin},
    )


def _observe(trajectory, distance):
    sleigh = trajectory["sleigh"]
    blade, _ = point_motion(trajectory, "sleigh", (-distance, 0.0))
    c, s = jnp.cos(sleigh.angle), jnp.sin(sleigh.angle)
    return columns(("x_blade", "y_blade"), blade) | {
        "theta": sleigh.angle,
        "v": c * sleigh.velocity[:, 0] + s * sleigh.velocity[:, 1],
        "omega": sleigh.angular_velocity,
    }
