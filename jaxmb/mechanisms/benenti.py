"""Benenti's two particles with parallel velocities."""

import jax.numpy as jnp
import numpy as np

from .. import planar
from ..bodies.scene import Scene
from ..lagrangian import LagrangianSystem, Nonholonomic
from ..parts.forces import Gravity
from ..parts.functions import VelocityConstraint
from .mechanism import Mechanism, Model, References, build, is_rigid, mechanism
from .observe import lagrangian_coordinates, point_coordinates

_COORDINATES = ("x1", "y1", "x2", "y2")


@mechanism(variants=("model",))
def benenti(
    *,
    masses: tuple[float, float] = (1.0, 2.0),
    stiffness: float = 4.0,
    gravity: float = 9.81,
    model: Model = "lagrangian",
) -> Mechanism:
    """Two particles in the vertical plane with a spring between them; their velocities are held parallel.

    Coordinates: x1, y1, x2, y2 [m], y up. The constraint ẋ1 ẏ2 − ẋ2 ẏ1 = 0 is quadratic and homogeneous in velocities,
    so energy is conserved.

    Source: S. Benenti, Geometrical aspects of the dynamics of non-holonomic systems, Rend. Sem. Mat. Univ. Pol. Torino
    54, 1996; data of this package. Reference values from DOP853 on the equations with a multiplier.

    **Arguments:** `masses` [kg]; `stiffness` of the spring [N/m], of zero free length; `gravity` [m/s²];
    `model`: from its Lagrangian, or as two point masses `one` and `two`.

    **Labels:** `x1`, `y1`, `x2`, `y2` [m], `u0` … `u3` [m/s].
    """
    rigid = is_rigid(model)
    q, u = np.array([0.0, 0.0, 1.0, 0.0]), np.array([1.0, 2.0, 0.5, 1.0])
    if rigid:
        system = _particles(masses, stiffness, gravity, q, u)
    else:
        system = LagrangianSystem(
            kinetic=lambda t, q, v, p: 0.5 * jnp.dot(jnp.repeat(p["masses"], 2), v * v),
            potential=_potential,
            constraints=[Nonholonomic("parallel", lambda t, q, v, p: v[0] * v[3] - v[2] * v[1])],
            q=q,
            u=u,
            parameters={"masses": masses, "stiffness": stiffness, "gravity": gravity},
            coordinates=_COORDINATES,
        )
    return build(
        "benenti",
        system,
        t1=2.0,
        observe=(lambda trajectory: point_coordinates(trajectory, _COORDINATES)) if rigid else lagrangian_coordinates,
        description="Two particles with parallel velocities; a constraint quadratic in them (Benenti).",
        references=References.load("benenti"),
    )


def _potential(t, q, p):
    apart = q[:2] - q[2:]
    return 0.5 * p["stiffness"] * jnp.dot(apart, apart) + p["gravity"] * jnp.dot(p["masses"], q[1::2])


def _particles(masses, stiffness, gravity, q, u) -> Scene:
    one, two = (
        planar.PointMass(name, mass=masses[k], position=q[2 * k : 2 * k + 2], velocity=u[2 * k : 2 * k + 2])
        for k, name in enumerate(("one", "two"))
    )
    parallel = VelocityConstraint("parallel", ("one", "two"), _parallel, homogeneous=True)
    spring = planar.SpringDamper("spring", "one", "two", stiffness=stiffness, free_length=0.0)
    return Scene([one, two], joints=[parallel], forces=[spring, Gravity((0.0, -gravity))])


def _parallel(poses, velocities, t, p):
    a, b = velocities
    return a[0] * b[1] - b[0] * a[1]
