"""The structure of a Lagrangian system: shapes, ranks, and whether its mass matrix is diagonal."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from .._names import unknown
from ..assembly import nearest, residual_size, tolerance
from ..elimination import full_pivot
from ..system.rigid_bodies import Ranks
from ._dataflow import depends
from .constraints import AbstractConstraint, Holonomic

if TYPE_CHECKING:
    from .system import LagrangianSystem

# With so many sets of parameters a matrix is looked at.
_LOOKS = 3


def check_functions(system: "LagrangianSystem") -> tuple[int, ...]:
    """The number of rows of each constraint.

    **Raises:** `ValueError` for functions of the wrong shape, and an L without second derivatives in the rates.
    """
    q, p = system.guess.q, system.parameters
    t = jnp.zeros((), q.dtype)
    v = _shaped("kinematics", (q.size,), lambda: system.rates(t, q, system.guess.u))
    if not np.all(np.isfinite(v)):
        raise ValueError(
            f"The velocities u = {system.guess.u.tolist()} are not invertible for the rates at q = {q.tolist()}: no "
            "rates were found that belong to them."
        )
    _shaped("lagrangian", (), lambda: system.lagrangian(t, q, v, p))
    if system.applied is not None:
        applied = system.applied
        _shaped("force", (q.size,), lambda: applied(t, q, v, p))
    mass = np.asarray(jax.hessian(system.lagrangian, 2)(t, q, v, p))
    if not np.all(np.isfinite(mass)) or not np.any(mass):
        raise ValueError(
            f"The Lagrangian needs finite second derivatives with respect to the rates, and not all of them zero; at "
            f"the guess they are {mass.tolist()}."
        )
    sizes = []
    for c in system.constraints:
        row = lambda c=c: c(t, q, v, p) if isinstance(c, AbstractConstraint) else c.residual(t, q, v, v, p)
        sizes.append(int(_shaped(c.name, None, row).size))
        if not isinstance(c, Holonomic) and isinstance(c, AbstractConstraint):
            slope = np.asarray(jax.jacfwd(c, 2)(t, q, v, p))
            if not np.all(np.isfinite(slope)):
                raise ValueError(f"{c.name}: its derivative with respect to the rates is not finite at the guess.")
    return tuple(sizes)


def _shaped(name, shape, evaluate):
    try:
        out = jnp.asarray(evaluate())
    except TypeError as error:
        raise ValueError(f"{name} does not fit the system: {error}") from error
    if shape is not None and out.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {out.shape}.")
    return out


def is_diagonal(system: "LagrangianSystem") -> bool:
    """Whether the mass matrix is diagonal, and constant."""
    q, p = system.guess.q, system.parameters
    t = jnp.zeros((), q.dtype)
    mass = jax.hessian(system.lagrangian, 2)
    # A matrix that depends on where the system is might have other entries elsewhere.
    if any(depends(mass, (t, q, q, p), which) for which in (0, 1, 2)):
        return False
    for k in range(_LOOKS):
        shake = lambda x, k=k: x * (1 + 0.1 * jnp.cos(k + jnp.arange(x.size, dtype=x.dtype)).reshape(x.shape))
        shaken = jax.tree.map(shake, p)
        matrix = np.asarray(mass(t, q, q, shaken))
        if np.any(matrix - np.diag(np.diag(matrix))):
            return False
    return True


def find_ranks(system: "LagrangianSystem") -> tuple[Ranks, int]:
    """Numbers of independent rows, near the guess on the constraints, and that of all rows of A.

    **Raises:** `ValueError` if the constraints cannot be satisfied there, or contradict each other.
    """
    if not system.constraints:
        return Ranks(0, 0, 0), 0
    q, u = system.guess.q, system.guess.u
    t = jnp.zeros((), q.dtype)
    if system.position_rows:
        q, near = nearest(system, t, q, system.coordinate_scale())
        size = float(residual_size(system, t, q, near))
        if not size <= tolerance(q.dtype):
            names = ", ".join(c.name for c in system.constraints if isinstance(c, Holonomic))
            raise ValueError(
                f"The constraints {names} cannot be satisfied near q = {system.guess.q.tolist()}: a scaled "
                f"residual of {size:.2g} remains."
            )
    rank = lambda matrix: int(full_pivot(matrix).rank)
    jacobian = system.jacobian(t, q, u)
    if not np.all(np.isfinite(jacobian)):
        raise ValueError("The constraints have no finite derivatives at the guess; begin at another state.")
    _check_consistent(system, t, q, u, np.asarray(jacobian))
    coordinate = rank(system.coordinate_jacobian(t, q)) if system.position_rows else 0
    position, velocity = rank(jacobian[: system.position_rows]), rank(jacobian[: system.velocity_rows])
    return Ranks(position, coordinate, velocity), rank(jacobian)


def _check_consistent(system, t, q, u, jacobian):
    """Raise a `ValueError` naming the constraints whose rows no accelerations satisfy together."""
    right = -np.asarray(system.acceleration_residual(t, q, u, jnp.zeros_like(u)))
    left_over = right - jacobian @ np.linalg.lstsq(jacobian, right, rcond=None)[0]
    size = 1e-8 * (1.0 + np.max(np.abs(right)))
    # Rows that depend on velocities are left alone: the guess need not satisfy them.
    bound = np.arange(right.size) >= system.velocity_rows
    names = [name for name, _ in system.rows]
    wrong = {name: None for name, x, own in zip(names, left_over, bound, strict=True) if own and abs(x) > size}
    if wrong:
        raise ValueError(
            f"The constraints {', '.join(wrong)} contradict each other: no accelerations satisfy them together at the "
            "guess."
        )


def check_nonideal(system: "LagrangianSystem") -> None:
    """Raise a `ValueError` for laws of constraints that are not there, or whose own force is not determined."""
    names = [name for name, _ in system.rows]
    q, u = system.guess.q, system.guess.u
    t = jnp.zeros((), q.dtype)
    for law in system.nonideal:
        if law.constraint not in names:
            raise ValueError(
                f"{type(law).__name__} is of a constraint {law.constraint!r}, but there are {sorted(set(names))}."
            )
        coefficient = getattr(law, "coefficient", None)
        if coefficient is not None and coefficient not in system.parameters:
            raise unknown("parameter", coefficient, system.parameters)
        others = np.array([name != law.constraint for name in names])
        rest = int(full_pivot(system.jacobian(t, q, u)[others]).rank)
        if rest + int(np.sum(~others)) > system.acceleration_rank:
            raise ValueError(
                f"{type(law).__name__} of {law.constraint!r}: the force of this constraint is not determined, because "
                "other constraints imply some of its rows. Leave the redundant ones out."
            )
