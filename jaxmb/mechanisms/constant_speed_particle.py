"""A particle whose speed is held constant."""

from typing import Literal

import jax.numpy as jnp
import numpy as np

from .. import planar
from ..bodies.scene import Scene
from ..lagrangian import LagrangianSystem, Nonholonomic, QuasiVelocities
from ..lagrangian.kinematics import Rates
from ..parts.forces import Gravity
from ..parts.functions import VelocityConstraint
from .mechanism import Mechanism, Model, References, build, is_rigid, mechanism
from .observe import lagrangian_coordinates, point_coordinates


@mechanism(variants=("model",))
def constant_speed_particle(
    *,
    speed: float = 3.0,
    steepness: float = 1.2,
    gravity: float = 9.81,
    mass: float = 1.0,
    form: Literal["constraint", "quasi"] = "constraint",
    model: Model = "lagrangian",
) -> Mechanism:
    """A particle in the vertical plane whose speed is held by a constraint nonlinear in velocity; gravity turns it.

    Coordinates: x, y [m], y up, the start in the origin. Its heading φ obeys c φ̇ = −g cos φ. The constraint is not
    homogeneous in velocity, so energy is not conserved.

    Source: J. G. Papastavridis, Analytical Mechanics, World Scientific, 2014, on nonlinear constraints; reference
    values in closed form, with Gudermann's function: φ = gd(C − g t / c).

    **Arguments:** `speed` c [m/s]; `steepness` C, with φ = gd(C) at the start; `gravity` [m/s²]; `mass` [kg]; `form`:
    `"constraint"`, with the coordinates' rates as velocities, or `"quasi"`, with the heading φ as the only velocity,
    from the nonlinear quasi-velocities |q̇| − c and φ; `model`: from its Lagrangian, or as a point mass `particle`.

    **Labels:** `x`, `y` [m], and the velocities `u0`, …: [m/s], or the heading [rad].
    """
    if form not in ("constraint", "quasi"):
        raise ValueError(f"The forms are constraint, quasi; got {form!r}.")
    heading = 2.0 * jnp.arctan(jnp.tanh(jnp.asarray(steepness, jnp.result_type(float)) / 2))
    ahead = speed * jnp.stack([jnp.cos(heading), jnp.sin(heading)])
    rigid = is_rigid(model, form=form == "constraint")
    if rigid:
        system = _particle(mass, speed, gravity, ahead)
    else:
        system = _lagrangian(form, {"speed": speed, "gravity": gravity, "mass": mass}, ahead, heading)
    return build(
        "constant_speed_particle",
        system,
        t1=1.0,
        observe=(lambda trajectory: point_coordinates(trajectory, "xy")) if rigid else lagrangian_coordinates,
        description="Particle with its speed held, turned by gravity; a constraint nonlinear in velocity.",
        references=_references(),
    )


def _lagrangian(form, parameters, ahead, heading) -> LagrangianSystem:
    held = lambda t, q, v, p: _length(v) - p["speed"]
    quasi = QuasiVelocities(
        lambda t, q, v, p: jnp.stack([_length(v) - p["speed"], jnp.arctan2(v[1], v[0])]),
        near=lambda t, q, omega, p: p["speed"] * jnp.stack([jnp.cos(omega[1]), jnp.sin(omega[1])]),
        dependent=(0,),
    )
    return LagrangianSystem(
        kinetic=lambda t, q, v, p: 0.5 * p["mass"] * jnp.dot(v, v),
        potential=lambda t, q, p: p["mass"] * p["gravity"] * q[1],
        constraints=[Nonholonomic("speed", held)] if form == "constraint" else (),
        kinematics=Rates() if form == "constraint" else quasi,
        q=(0.0, 0.0),
        u=ahead if form == "constraint" else heading[None],
        parameters=parameters,
        coordinates=("x", "y"),
    )


def _particle(mass, speed, gravity, velocity) -> Scene:
    held = lambda poses, velocities, t, p: _length(velocities[0, :2]) - p["speed"]
    return Scene(
        [planar.PointMass("particle", mass=mass, velocity=velocity)],
        joints=[VelocityConstraint("held", "particle", held, parameters={"speed": speed})],
        forces=[Gravity((0.0, -gravity))],
    )


def _length(v):
    return jnp.sqrt(jnp.dot(v, v))


def _references():
    c, g, start, t = 3.0, 9.81, 1.2, np.array([0.5, 1.0])
    k = g / c
    gudermann = lambda x: 2 * np.arctan(np.tanh(x / 2))
    x = c / k * (gudermann(start) - gudermann(start - k * t))
    y = c / k * (np.log(np.cosh(start)) - np.log(np.cosh(start - k * t)))
    return References(
        times=t, labels=("x", "y"), values=np.stack([x, y], axis=1), source="closed form", tolerance=1e-14
    )
