"""A disc that rolls without slipping."""

import jax
import jax.numpy as jnp
import numpy as np

from .. import spatial
from ..bodies.scene import Scene
from ..linalg import rotations
from ..parts.forces import Gravity
from .mechanism import Mechanism, References, build, mechanism
from .observe import body_axis


@mechanism()
def rolling_disc(
    *,
    mass: float = 1.0,
    radius: float = 0.3,
    lean: float = 0.4,
    roll: float | None = None,
    turn: float = -2.0,
    pitch: float = 0.0,
    gravity: float = 9.81,
) -> Mechanism:
    """A thin uniform disc that rolls on a horizontal plane without slipping; z up. By default it runs in a circle,
    leaning steadily.

    With the heading ψ and the lean θ from upright, `e₁ = (cos ψ, sin ψ, 0)` is the heading, `e₂ = (−sin ψ cos θ, cos ψ
    cos θ, sin θ)` the axle and `e₃ = e₁ × e₂` points from the contact to the centre; ω₁, ω₂, ω₃ are the components of
    the angular velocity along them. Steady motion needs `m g r sin θ + (C + m r²) ω₂ ω₃ = A ω₃² tan θ`.

    Source: E. J. Routh, "Advanced Dynamics of a System of Rigid Bodies", 1905, §244. The reference values are the
    steady circle, in closed form.

    **Arguments:** `mass` [kg]; `radius` [m]; `lean` θ [rad] at the start, with ψ = 0; `roll` ω₂ [rad/s], default steady
    motion; `turn` ω₃ [rad/s]; `pitch` ω₁ [rad/s], the rate of the lean; `gravity` [m/s²].

    **Labels:** `xc`, `yc` [m], the centre, from (0, 0); `theta` [rad]; `cos_psi`, `sin_psi`; `w1`, `w2`, `w3` [rad/s].
    """
    A, C = mass * radius**2 / 4, mass * radius**2 / 2
    if roll is None:
        if turn * lean == 0:
            raise ValueError("rolling_disc: straight rolling is steady at any roll; give roll [rad/s].")
        roll = (A * turn**2 * np.tan(lean) - mass * gravity * radius * np.sin(lean)) / ((C + mass * radius**2) * turn)
    disc = spatial.Body(
        "disc",
        mass=mass,
        inertia=spatial.disc(mass, radius, "y"),
        position=(0.0, 0.0, radius * np.cos(lean)),
        orientation=rotations.from_axis_angle((1.0, 0.0, 0.0), lean),
    )
    plane = spatial.RollingDisc("plane", "disc", radius=radius, axis=(0.0, 1.0, 0.0))
    return build(
        "rolling_disc",
        Scene([disc], joints=[plane], forces=[Gravity((0.0, 0.0, -gravity))]),
        t1=4.0,
        observe=_observe,
        description="A thin disc that rolls on a plane without slipping, in a steady circle.",
        references=References.load("rolling_disc"),
        rates={"disc.angular_velocity": (pitch, roll, turn)},
    )


def _observe(trajectory):
    disc = trajectory["disc"]
    axle = body_axis(trajectory, "disc", (0.0, 1.0, 0.0))
    omega_W = jax.vmap(rotations.rotate)(disc.orientation, disc.angular_velocity)
    level = jnp.sqrt(axle[:, 0] ** 2 + axle[:, 1] ** 2)
    cos, sin = axle[:, 1] / level, -axle[:, 0] / level
    e1 = jnp.stack([cos, sin, jnp.zeros_like(cos)], axis=1)
    e3 = jnp.cross(e1, axle)
    along = lambda e: jnp.sum(e * omega_W, axis=1)
    return {
        "xc": disc.position[:, 0],
        "yc": disc.position[:, 1],
        "theta": jnp.arctan2(axle[:, 2], level),
        "cos_psi": cos,
        "sin_psi": sin,
        "w1": along(e1),
        "w2": along(axle),
        "w3": along(e3),
    }
