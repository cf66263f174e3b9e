"""Three masses that follow a desired motion."""

import jax.numpy as jnp
import numpy as np

from ..lagrangian import LagrangianSystem, Servo
from ._base import Mechanism, References, build, mechanism, observe_coordinates


@mechanism()
def tracking_chain(
    *,
    masses: tuple[float, float, float] = (1.0, 2.0, 1.5),
    stiffness: tuple[float, float, float] = (10.0, 8.0, 6.0),
    cubic: tuple[float, float, float] = (30.0, 20.0, 10.0),
    damping: float = 0.1,
    drive: float = 3.0,
    offset: float = 0.0,
    gains: tuple[float, float] = (0.0, 0.0),
) -> Mechanism:
    """Three masses in a row on nonlinear springs, driven at the end, that are to move as two given functions of time.

    Coordinates: displacements q1, q2, q3 [m]; springs to the ground and between neighbours have the force k d + κ
    d³. The desired motion, q1 = 0.5 sin t and q3 − q1 = 0.2 cos 2t, is a constraint on accelerations, and its force
    `trajectory.constraint_forces["track"]` the control that achieves it exactly.

    Source: R. E. Kalaba and F. E. Udwadia, Equations of motion for nonholonomic, constrained dynamical systems via
    Gauss's principle, J. Appl. Mech. 60(3), 1993; data of this package. Reference values from DOP853 on their
    equation.

    **Arguments:** `masses` [kg]; `stiffness` k [N/m] and `cubic` κ [N/m³]; `damping` [N s/m] of every mass; `drive`
    [rad/s], of the force sin on the last mass; `offset` [m], of the start: q1 too far ahead by it, q3 − q1 behind
    by twice as much; `gains` [1/s, 1/s²] with which deviations are brought to zero.

    **Labels:** `q1`, `q2`, `q3` [m], `u0`, `u1`, `u2` [m/s].
    """
    system = LagrangianSystem(
        kinetic=lambda t, q, v, p: 0.5 * jnp.dot(p["masses"], v * v),
        potential=_potential,
        force=lambda t, q, v, p: (-p["damping"] * v).at[2].add(jnp.sin(p["drive"] * t)),
        constraints=[Servo("track", _deviation, damping=gains[0], stiffness=gains[1])],
        q=(offset, 0.0, 0.2 - offset),
        u=(0.5, 0.0, 0.5),
        parameters={
            "masses": masses,
            "stiffness": stiffness,
            "cubic": cubic,
            "damping": damping,
            "drive": drive,
        },
        coordinates=("q1", "q2", "q3"),
    )
    return build(
        "tracking_chain",
        system,
        t1=20.0,
        observe=_observe,
        description="Three masses held to a desired motion by the least control force (Kalaba and Udwadia).",
        references=_REFERENCES,
    )


def _potential(t, q, p):
    d = jnp.diff(q, prepend=jnp.zeros_like(q[:1]))
    return jnp.dot(p["stiffness"], d**2) / 2 + jnp.dot(p["cubic"], d**4) / 4


def _deviation(t, q, p):
    return jnp.stack([q[0] - 0.5 * jnp.sin(t), q[2] - q[0] - 0.2 * jnp.cos(2 * t)])


def _observe(trajectory):
    force = trajectory.constraint_forces["track"]
    return observe_coordinates(trajectory) | {"force1": force[:, 0], "force3": force[:, 2]}


_REFERENCES = References(
    times=np.array([20.0]),
    labels=("q1", "q2", "q3", "force1", "force3"),
    values=np.array(
        [[0.5 * np.sin(20.0), 0.3463702111, 0.5 * np.sin(20.0) + 0.2 * np.cos(40.0), 7.88958994, 0.27118949]]
    ),
    source="DOP853 at 1e-12 on the equation of Kalaba and Udwadia; q1 and q3 are the desired motion",
    tolerance=1e-8,
)
