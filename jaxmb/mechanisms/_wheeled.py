"""Two platforms with a pin between them, each on an axle whose wheels roll without slipping sideways; from their
Lagrangian, or as rigid bodies.

Coordinates: x, y of the middle of the rear axle, its heading θ, and the angle φ of the front platform against it.
Parameters: `mass`, `inertia` and `ahead`, the distance of the mass centre ahead of the axle, of the rear platform;
`front_mass`, `front_inertia` and `front_ahead` of the front platform; `pivot`, the distance of the pin ahead of the
rear axle; `handle`, the distance of the front axle ahead of the pin.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from .. import planar
from ..bodies.scene import Scene
from ..lagrangian import Connection, LagrangianSystem, Pfaffian, QuasiVelocityFrame
from ..lagrangian.kinematics import Rates
from ..lagrangian.model import AbstractEquations
from ..parts.fields import as_jax
from ..system import parameters as parameters_of
from .mechanism import Mechanism, Model, References, build, is_rigid
from .observe import columns, lagrangian_coordinates, point_motion

COORDINATES = ("x", "y", "theta", "phi")
FORMS = ("frame", "constraints", "connection")


def build_wheeled(
    name: str,
    description: str,
    parameters: dict[str, Any],
    start: tuple[float, float, float],
    *,
    form: str,
    equations: AbstractEquations | None,
    model: Model,
    as_bodies: Callable[[dict[str, Any]], dict[str, Any]] = lambda parameters: parameters,
) -> Mechanism:
    """A mechanism of two wheeled platforms, in one of its models.

    **Arguments:** `start`: the angle φ [rad], speed [m/s] and turning rate [rad/s]; `form`, `equations` and `model` as
    in `roller_racer`; `as_bodies`: the parameters of its rigid bodies, from those of its Lagrangian.

    **Raises:** `ValueError` for an unknown form or model.
    """
    if form not in FORMS:
        raise ValueError(f"The forms are {', '.join(FORMS)}; got {form!r}.")
    if is_rigid(model, form=form == "frame", equations=equations is None):
        system, observe = _bodies(as_bodies(parameters), start), _observe_bodies
    else:
        system, observe = _lagrangian(parameters, start, form, equations), lagrangian_coordinates
    return build(name, system, t1=5.0, observe=observe, description=description, references=References.load(name))


def _lagrangian(parameters, start, form, equations) -> LagrangianSystem:
    parameters, q, u, v = _start(parameters, *start)
    kinematics, velocities, constraints = {
        "frame": (QuasiVelocityFrame(frame, 2), u, ()),
        "constraints": (Rates(), v, (Pfaffian("wheels", wheels),)),
        "connection": (Connection((2, 3), (0, 1), connection), v[2:], ()),
    }[form]
    return LagrangianSystem(
        kinetic=kinetic,
        constraints=constraints,
        kinematics=kinematics,
        equations=equations,
        q=q,
        u=velocities,
        parameters=parameters,
        coordinates=COORDINATES,
    )


def _bodies(parameters, start) -> Scene:
    parameters, q, _, v = _start(parameters, *start)
    places, rates = jax.jvp(lambda q: _places(q, parameters), (q,), (v,))
    names, masses = ("rear", "front"), (parameters["mass"], parameters["front_mass"])
    inertias, ahead = zip(*((parameters[k + "inertia"], parameters[k + "ahead"]) for k in ("", "front_")), strict=True)
    bodies = [
        planar.Body(
            name,
            mass=masses[k],
            inertia=inertias[k],
            position=places[k, :2],
            angle=places[k, 2],
            velocity=rates[k, :2],
            angular_velocity=rates[k, 2],
        )
        for k, name in enumerate(names)
    ]
    along = lambda x: jnp.stack([x, jnp.zeros_like(x)])
    pin = planar.Revolute(
        "pin",
        *names,
        point_a=along(parameters["pivot"] - ahead[0]),
        point_b=along(-parameters["handle"] - ahead[1]),
    )
    wheels = [planar.KnifeEdge(f"{name}_wheels", name, point=along(-a)) for name, a in zip(names, ahead, strict=True)]
    return Scene(bodies, joints=[pin, *wheels])


def _observe_bodies(trajectory):
    rear, front = trajectory["rear"], trajectory["front"]
    axle, velocity = point_motion(trajectory, "rear", parameters_of(trajectory.system)["rear_wheels.point"])
    return columns("xy", axle) | {
        "theta": rear.angle,
        "phi": front.angle - rear.angle,
        "u0": velocity[:, 0] * jnp.cos(rear.angle) + velocity[:, 1] * jnp.sin(rear.angle),
        "u1": rear.angular_velocity,
    }


def _start(parameters, angle, speed, rate):
    """Numbers, coordinates, speed and turning rate, and rates of the coordinates."""
    parameters = {name: as_jax(value) for name, value in parameters.items()}
    q = jnp.stack([as_jax(0.0), as_jax(0.0), as_jax(0.0), as_jax(angle)])
    u = jnp.stack([as_jax(speed), as_jax(rate)])
    return parameters, q, u, frame(0.0, q, parameters) @ u


def _places(q, p):
    """Positions of the mass centres and headings, rear and front, shape (2, 3)."""
    front = q[2] + q[3]
    along = lambda angle: jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    rear_centre = q[:2] + p["ahead"] * along(q[2])
    front_centre = q[:2] + p["pivot"] * along(q[2]) + (p["handle"] + p["front_ahead"]) * along(front)
    return jnp.stack([jnp.append(rear_centre, q[2]), jnp.append(front_centre, front)])


def kinetic(t, q, v, p):
    heading, front = q[2], q[2] + q[3]
    turning = v[2] + v[3]
    rear = v[:2] + p["ahead"] * v[2] * _across(heading)
    lever = p["handle"] + p["front_ahead"]
    other = v[:2] + p["pivot"] * v[2] * _across(heading) + lever * turning * _across(front)
    translation = p["mass"] * (rear @ rear) + p["front_mass"] * (other @ other)
    return 0.5 * (translation + p["inertia"] * v[2] ** 2 + p["front_inertia"] * turning**2)


def frame(t, q, p):
    """Columns along the heading, and turning in place: no wheel slips with either."""
    theta, phi = q[2], q[3]
    zero, one = jnp.zeros_like(theta), jnp.ones_like(theta)
    ahead = jnp.stack([jnp.cos(theta), jnp.sin(theta), zero, jnp.sin(phi) / p["handle"]])
    turn = jnp.stack([zero, zero, one, -_lever(phi, p) / p["handle"]])
    return jnp.stack([ahead, turn], axis=1)


def wheels(t, q, p):
    """Gradients of the sideways slip of both axles."""
    front = q[2] + q[3]
    zero = jnp.zeros_like(front)
    rear = jnp.concatenate([_across(q[2]), jnp.stack([zero, zero])])
    return jnp.stack([rear, jnp.concatenate([_across(front), jnp.stack([_lever(q[3], p), p["handle"]])])])


def connection(t, q, p):
    """Rates of x, y over rates of θ, φ; singular where the platforms are in line."""
    along = jnp.stack([jnp.cos(q[2]), jnp.sin(q[2])])
    return -along[:, None] * jnp.stack([_lever(q[3], p), p["handle"]])[None, :] / jnp.sin(q[3])


def _lever(phi, p):
    return p["pivot"] * jnp.cos(phi) + p["handle"]


def _across(angle):
    return jnp.stack([-jnp.sin(angle), jnp.cos(angle)])
