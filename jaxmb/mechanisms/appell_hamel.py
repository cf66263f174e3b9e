"""Appell's and Hamel's machine, with a constraint nonlinear in velocities."""

import jax.numpy as jnp
import numpy as np

from .. import spatial
from ..bodies.scene import Scene
from ..lagrangian import LagrangianSystem, Nonholonomic
from ..parts.fields import as_jax
from ..parts.forces import Gravity
from ..parts.functions import VelocityConstraint
from .mechanism import Mechanism, Model, References, build, is_rigid, mechanism
from .observe import lagrangian_coordinates, point_coordinates


@mechanism(variants=("model",))
def appell_hamel(
    *,
    slope: float = 0.7,
    speed: float = 3.0,
    heading: float = 0.4,
    gravity: float = 9.81,
    mass: float = 1.0,
    model: Model = "lagrangian",
) -> Mechanism:
    """A particle whose vertical velocity is held in proportion to its horizontal speed: ż = a √(ẋ² + ẏ²).

    Coordinates: x, y, z [m], z up, the start in the origin. It moves on a straight line, slower and slower; at rest the
    constraint has no gradient, and the motion cannot continue.

    Source: P. Appell, Exemple de mouvement d'un point assujetti à une liaison exprimée par une relation non linéaire
    entre les composantes de la vitesse, Rend. Circ. Mat. Palermo 32, 1911. Reference values in closed form.

    **Arguments:** `slope` a; horizontal `speed` [m/s] and `heading` [rad] at the start; `gravity` [m/s²]; `mass` [kg];
    `model`: from its Lagrangian, or as a point mass `particle`.

    **Labels:** `x`, `y`, `z` [m]; `u0`, `u1`, `u2` [m/s].
    """
    along = as_jax(speed) * jnp.stack([jnp.cos(as_jax(heading)), jnp.sin(as_jax(heading)), as_jax(slope)])
    rigid = is_rigid(model)
    if rigid:
        cone = lambda poses, velocities, t, p: _excess(velocities[0], p["slope"])
        system = Scene(
            [spatial.PointMass("particle", mass=mass, velocity=along)],
            joints=[VelocityConstraint("cone", "particle", cone, parameters={"slope": slope}, homogeneous=True)],
            forces=[Gravity((0.0, 0.0, -gravity))],
        )
    else:
        system = LagrangianSystem(
            kinetic=lambda t, q, v, p: 0.5 * p["mass"] * jnp.dot(v, v),
            potential=lambda t, q, p: p["mass"] * p["gravity"] * q[2],
            constraints=[Nonholonomic("cone", lambda t, q, v, p: _excess(v, p["slope"]))],
            q=(0.0, 0.0, 0.0),
            u=along,
            parameters={"slope": slope, "gravity": gravity, "mass": mass},
            coordinates=("x", "y", "z"),
        )
    return build(
        "appell_hamel",
        system,
        t1=0.5,
        observe=(lambda trajectory: point_coordinates(trajectory, "xyz")) if rigid else lagrangian_coordinates,
        description="Particle with its climb held in proportion to its speed (Appell, Hamel).",
        references=_references(),
    )


def _excess(v, slope):
    return v[2] - slope * jnp.sqrt(jnp.dot(v[:2], v[:2]))


def _references():
    slope, speed, heading, gravity, t = 0.7, 3.0, 0.4, 9.81, np.array([0.25, 0.5])
    slowing = slope * gravity / (1 + slope**2)
    way, now = speed * t - slowing * t**2 / 2, speed - slowing * t
    along = np.array([np.cos(heading), np.sin(heading), slope])
    return References(
        times=t,
        labels=("x", "y", "z", "u0", "u1", "u2"),
        values=np.concatenate([np.outer(way, along), np.outer(now, along)], axis=1),
        source="closed form: a straight line with constant deceleration",
        tolerance=1e-15,
    )
