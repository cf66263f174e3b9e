"""A bead on a rough ring."""

import jax.numpy as jnp
import numpy as np

from .. import planar
from ..bodies.scene import Scene
from ..lagrangian import CoulombFriction, Holonomic, LagrangianSystem
from ..parts.forces import Gravity
from .mechanism import Mechanism, Model, References, build, is_rigid, mechanism
from .observe import lagrangian_coordinates, point_coordinates


@mechanism(variants=("model",))
def rough_ring(
    *,
    radius: float = 1.0,
    friction: float = 0.3,
    speed: float = 2.0,
    mass: float = 1.0,
    gravity: float = 0.0,
    model: Model = "lagrangian",
) -> Mechanism:
    """A bead slides on a ring with Coulomb friction in proportion to the ring's force on it.

    Coordinates: x, y [m], the ring's centre in the origin; the bead starts at (radius, 0), upward. Without gravity the
    speed falls as v0 / (1 + μ v0 t / R).

    Source: F. E. Udwadia and R. E. Kalaba, Analytical Dynamics, Cambridge, 1996, on constraints that are not ideal.
    Reference values in closed form.

    **Arguments:** `radius` R [m]; `friction` μ; `speed` v0 [m/s]; `mass` [kg]; `gravity` [m/s²] along −y;
    `model`: from its Lagrangian, or as a point mass `bead` on a rod of length R.

    **Labels:** `x`, `y` [m], `u0`, `u1` [m/s].
    """
    rigid = is_rigid(model)
    if rigid:
        system = _bead(radius, friction, speed, mass, gravity)
    else:
        system = LagrangianSystem(
            kinetic=lambda t, q, v, p: 0.5 * p["mass"] * jnp.dot(v, v),
            potential=lambda t, q, p: p["mass"] * p["gravity"] * q[1],
            constraints=[Holonomic("ring", lambda t, q, p: 0.5 * (jnp.dot(q, q) / p["radius"] - p["radius"]))],
            nonideal=[CoulombFriction("ring", "friction")],
            q=(radius, 0.0),
            u=(0.0, speed),
            parameters={"radius": radius, "friction": friction, "mass": mass, "gravity": gravity},
            coordinates=("x", "y"),
        )
    return build(
        "rough_ring",
        system,
        t1=3.0,
        observe=(lambda trajectory: point_coordinates(trajectory, "xy")) if rigid else lagrangian_coordinates,
        description="Bead on a ring with Coulomb friction; a constraint that is not ideal.",
        references=_references(),
    )


def _bead(radius, friction, speed, mass, gravity) -> Scene:
    return Scene(
        [planar.PointMass("bead", mass=mass, position=(radius, 0.0), velocity=(0.0, speed))],
        joints=[planar.Distance("ring", "ground", "bead", length=radius)],
        forces=[
            planar.Friction("roughness", "ring", coefficient=friction),
            Gravity((0.0, -gravity)),
        ],
    )


def _references():
    t, radius, friction, start = np.array([1.0, 3.0]), 1.0, 0.3, 2.0
    speed = start / (1 + friction * start * t / radius)
    angle = np.log1p(friction * start * t / radius) / friction
    along = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    place = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return References(
        times=t,
        labels=("x", "y", "u0", "u1"),
        values=np.concatenate([place, speed[:, None] * along], axis=1),
        source="closed form",
        # The library's friction is smooth near rest, and complete at these speeds.
        tolerance=1e-12,
    )
