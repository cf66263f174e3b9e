"""The SE(2)-snake with three platforms on wheels."""

import itertools
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .. import planar
from ..bodies.scene import Scene
from ..lagrangian import Connection, Holonomic, LagrangianSystem, Pfaffian
from ..lagrangian.kinematics import Rates
from ..lagrangian.model import AbstractEquations
from ..parts.fields import as_jax
from .mechanism import Mechanism, Model, References, build, is_rigid, mechanism
from .observe import columns, lagrangian_coordinates


@mechanism(variants=("gait", "model"))
def three_platform_snake(
    *,
    mass: float = 1.0,
    inertia: float = 0.02,
    half: float = 0.2,
    angles: tuple[float, float] = (0.9, 0.2),
    rates: tuple[float, float] = (0.3, -0.2),
    gait: Callable[[Array], Array] | None = None,
    form: Literal["connection", "constraints"] = "connection",
    equations: AbstractEquations | None = None,
    model: Model = "lagrangian",
) -> Mechanism:
    """Three platforms in a row, joined by pins, each with one axle in its middle whose wheels do not slip sideways.

    Coordinates: x, y [m] of the middle platform, its heading θ, and φ1, φ2 [rad]: the rear platform's heading is θ −
    φ1, the front platform's θ + φ2. Three axles leave only the two velocities of the shape: a change of shape moves the
    snake by a connection, and a closed path of shapes by a geometric phase. The connection is singular if the lines of
    the axles meet in one point or are parallel, for example if φ1 = φ2.

    Source: P. S. Krishnaprasad and D. P. Tsakiris, G-Snakes: nonholonomic kinematic chains on Lie groups, Proc. 33rd
    IEEE CDC, 1994. Reference values from DOP853 on Voronets' equations, with a gait on the connection.

    **Arguments:** `mass` [kg], `inertia` [kg m²] and `half` length [m] of a platform; `angles` φ [rad] and `rates`
    [rad/s] at the start, of a free motion; `gait(t)`: prescribes the angles, shape (2,), as a function of time; `form`:
    the velocities are the rates of φ, `"connection"`, or of all coordinates, `"constraints"` (always with a gait);
    `equations`: the form of the equations, default `Projected()`; `model`: from its Lagrangian, or as rigid bodies
    `rear`, `middle` and `front`.

    **Labels:** `x`, `y` [m], `theta`, `phi1`, `phi2` [rad], and the velocities `u0`, `u1`, ….
    """
    if form not in ("connection", "constraints"):
        raise ValueError(f"The forms are connection, constraints; got {form!r}.")
    rigid = is_rigid(model, form=form == "connection", equations=equations is None)
    parameters = {"mass": mass, "inertia": inertia, "half": half}
    numbers = {name: as_jax(value) for name, value in parameters.items()}
    shape, turning = as_jax(angles), as_jax(rates)
    if gait is not None:
        shape, turning = jax.jvp(gait, (jnp.zeros(()),), (jnp.ones(()),))
    q, v = _without_slip(shape, turning, numbers)
    if rigid:
        system = _bodies(numbers, q, v, gait)
    else:
        held = form == "constraints" or gait is not None
        system = LagrangianSystem(
            kinetic=_kinetic,
            constraints=_constraints(gait) if held else (),
            kinematics=Rates() if held else Connection((3, 4), (0, 1, 2), _connection),
            equations=equations,
            q=q,
            u=v if held else turning,
            parameters=parameters,
            coordinates=("x", "y", "theta", "phi1", "phi2"),
        )
    return build(
        "three_platform_snake",
        system,
        t1=1.0 if gait is None else 2 * np.pi,
        observe=_observe_bodies if rigid else lagrangian_coordinates,
        description="SE(2)-snake of three platforms on wheels (Krishnaprasad and Tsakiris).",
        references=References.load("three_platform_snake") if gait is None else None,
    )


def _constraints(gait) -> list[Any]:
    wheels = Pfaffian("wheels", _wheels)
    return [wheels] if gait is None else [wheels, Holonomic("gait", lambda t, q, p: q[3:] - gait(t))]


def _bodies(p, q, v, gait) -> Scene:
    """The platforms as rigid bodies `rear`, `middle` and `front`."""
    names = ("rear", "middle", "front")
    (places, headings), (velocities, turning) = jax.jvp(lambda q: _platforms(q, p["half"]), (q,), (v,))
    bodies = [
        planar.Body(
            name,
            mass=p["mass"],
            inertia=p["inertia"],
            position=places[k],
            angle=headings[k],
            velocity=velocities[k],
            angular_velocity=turning[k],
        )
        for k, name in enumerate(names)
    ]
    end = jnp.stack([p["half"], jnp.zeros_like(p["half"])])
    pairs = list(itertools.pairwise(names))
    joints: list[Any] = [
        planar.Revolute(f"pin{k + 1}", *pair, point_a=end, point_b=-end) for k, pair in enumerate(pairs)
    ]
    joints += [planar.KnifeEdge(f"{name}_wheels", name) for name in names]
    if gait is not None:
        joints += [
            planar.Driver(f"phi{k + 1}", *pair, quantity="angle", motion=lambda t, p, k=k: gait(t)[k])
            for k, pair in enumerate(pairs)
        ]
    return Scene(bodies, joints=joints)


def _observe_bodies(trajectory):
    rear, middle, front = (trajectory[name] for name in ("rear", "middle", "front"))
    return columns("xy", middle.position) | {
        "theta": middle.angle,
        "phi1": middle.angle - rear.angle,
        "phi2": front.angle - middle.angle,
        "u0": middle.angular_velocity - rear.angular_velocity,
        "u1": front.angular_velocity - middle.angular_velocity,
    }


def _platforms(q, half):
    """Positions (3, 2) and headings (3,), rear to front."""
    headings = jnp.stack([q[2] - q[3], q[2], q[2] + q[4]])
    along = jnp.stack([jnp.cos(headings), jnp.sin(headings)], axis=1)
    steps = half * (along[:-1] + along[1:])
    return jnp.stack([q[:2] - steps[0], q[:2], q[:2] + steps[1]]), headings


@jax.jit
def _without_slip(shape, turning, p):
    """Coordinates and their rates, the middle platform at the origin."""
    q = jnp.concatenate([jnp.zeros(3, shape.dtype), shape])
    return q, jnp.concatenate([-_connection(0.0, q, p) @ turning, turning])


def _kinetic(t, q, v, p):
    _, (velocities, turning) = jax.jvp(lambda q: _platforms(q, p["half"]), (q,), (v,))
    return 0.5 * (p["mass"] * jnp.sum(velocities**2) + p["inertia"] * jnp.sum(turning**2))


def _wheels(t, q, p):
    """Gradients of the sideways slip of the axles."""
    slope = jax.jacfwd(lambda q: _platforms(q, p["half"])[0])(q)
    headings = _platforms(q, p["half"])[1]
    return jnp.einsum("ka,kaj->kj", jnp.stack([-jnp.sin(headings), jnp.cos(headings)], axis=1), slope)


def _connection(t, q, p):
    matrix = _wheels(t, q, p)
    # Cramer's rule: three rows, so no elimination is needed.
    a, b, c = matrix[:, :3]
    cofactors = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=1)
    return cofactors @ matrix[:, 3:] / (a @ jnp.cross(b, c))
