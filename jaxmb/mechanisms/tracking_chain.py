"""Three masses that follow a desired motion."""

import jax
import jax.numpy as jnp

from .. import planar
from ..bodies.scene import Scene
from ..lagrangian import LagrangianSystem, ServoConstraint
from ..parts.functions import Constraint, Force
from ..parts.servo import Servo
from .mechanism import Mechanism, Model, References, build, is_rigid, mechanism
from .observe import lagrangian_coordinates

_MASSES = ("one", "two", "three")


@mechanism(variants=("model",))
def tracking_chain(
    *,
    masses: tuple[float, float, float] = (1.0, 2.0, 1.5),
    stiffness: tuple[float, float, float] = (10.0, 8.0, 6.0),
    cubic: tuple[float, float, float] = (30.0, 20.0, 10.0),
    damping: float = 0.1,
    drive: float = 3.0,
    offset: float = 0.0,
    gains: tuple[float, float] = (0.0, 0.0),
    model: Model = "lagrangian",
) -> Mechanism:
    """Three masses in a row on nonlinear springs, driven at the end; a control force makes two of them follow a desired
    motion.

    Coordinates: displacements q1, q2, q3 [m]; springs to the ground and between neighbours have the force k d + κ
    d³. The desired motion, q1 = 0.5 sin t and q3 − q1 = 0.2 cos 2t, is a servo constraint on accelerations; its force
    `trajectory.constraint_forces["track"]` is the control that achieves it exactly.

    Source: R. E. Kalaba and F. E. Udwadia, Equations of motion for nonholonomic, constrained dynamical systems via
    Gauss's principle, J. Appl. Mech. 60(3), 1993; data of this package. Reference values from DOP853 on their
    equation.

    **Arguments:** `masses` [kg]; `stiffness` k [N/m] and `cubic` κ [N/m³]; `damping` [N s/m] of every mass; `drive`
    [rad/s], the frequency of the force on the last mass; `offset` [m] of the start: q1 is ahead of the desired motion
    by it, q3 − q1 behind by twice as much; `gains` [1/s, 1/s²] of the feedback that reduces deviations;
    `model`: from its Lagrangian, or as point masses `one`, `two` and `three` on a rail along x.

    **Labels:** `q1`, `q2`, `q3` [m], `u0`, `u1`, `u2` [m/s]; `force1`, `force3` [N], the control on the first and last
    mass.
    """
    q, u = (offset, 0.0, 0.2 - offset), (0.5, 0.0, 0.5)
    numbers = {"stiffness": stiffness, "cubic": cubic, "damping": damping, "drive": drive}
    rigid = is_rigid(model)
    if rigid:
        system = _points(masses, numbers, gains, q, u)
    else:
        system = LagrangianSystem(
            kinetic=lambda t, q, v, p: 0.5 * jnp.dot(p["masses"], v * v),
            potential=_potential,
            force=_applied,
            constraints=[ServoConstraint("track", _deviation, damping=gains[0], stiffness=gains[1])],
            q=q,
            u=u,
            parameters={"masses": masses, **numbers},
            coordinates=("q1", "q2", "q3"),
        )
    return build(
        "tracking_chain",
        system,
        t1=20.0,
        observe=_observe_points if rigid else _observe,
        description="Three masses held to a desired motion by the least control force (Kalaba and Udwadia).",
        references=References.load("tracking_chain"),
    )


def _potential(t, q, p):
    d = jnp.diff(q, prepend=jnp.zeros_like(q[:1]))
    return jnp.dot(p["stiffness"], d**2) / 2 + jnp.dot(p["cubic"], d**4) / 4


def _applied(t, q, v, p):
    return (-p["damping"] * v).at[2].add(jnp.sin(p["drive"] * t))


def _deviation(t, q, p):
    return jnp.stack([q[0] - 0.5 * jnp.sin(t), q[2] - q[0] - 0.2 * jnp.cos(2 * t)])


def _points(masses, numbers, gains, q, u) -> Scene:
    bodies = [
        planar.PointMass(name, mass=m, position=(x, 0.0), velocity=(v, 0.0))
        for name, m, x, v in zip(_MASSES, masses, q, u, strict=True)
    ]
    origin = (0.0, 0.0)
    rails = [
        planar.PointOnLine(f"rail_{name}", "ground", name, point_a=origin, point_b=origin, axis_a=(1.0, 0.0))
        for name in _MASSES
    ]
    track = Constraint("track", _MASSES, lambda poses, t, p: _deviation(t, poses[:, 0], p), rows=2)
    springs = Force(
        "springs", _MASSES, _wrenches, parameters=numbers, potential=lambda x, t, p: _potential(t, x[:, 0], p)
    )
    return Scene(bodies, joints=[*rails, Servo(track, damping=gains[0], stiffness=gains[1])], forces=[springs])


def _wrenches(poses, velocities, t, p):
    q, v = poses[:, 0], velocities[:, 0]
    along = _applied(t, q, v, p) - jax.grad(_potential, 1)(t, q, p)
    return jnp.pad(along[:, None], ((0, 0), (0, 2)))


def _observe(trajectory):
    force = trajectory.constraint_forces["track"]
    return lagrangian_coordinates(trajectory) | {"force1": force[:, 0], "force3": force[:, 2]}


def _observe_points(trajectory):
    places = {f"q{k + 1}": trajectory[name].position[:, 0] for k, name in enumerate(_MASSES)}
    rates = {f"u{k}": trajectory[name].velocity[:, 0] for k, name in enumerate(_MASSES)}
    # The program's rows are for q1 and q3 − q1.
    first, second = trajectory.reactions["track"].multipliers.T
    return places | rates | {"force1": first - second, "force3": second}
