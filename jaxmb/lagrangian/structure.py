"""The structure of a Lagrangian system: shapes, ranks, and whether its mass matrix is diagonal."""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._captured import Captured
from .._compat import changed
from .._dataflow import depends, is_analytic, shaken
from .._index_bounds import check_indices
from .._traced_functions import note_of, traced_by_jax, with_note
from .._types import State
from ..linalg.independent_rows import dense_pivots
from ..linalg.jitted import on_host
from ..parts.boundary import is_of_user, with_captured
from ..parts.names import unknown
from ..states.closest import meet_constraints, residual_size, tolerance
from ..states.redundancy import check_gradients, check_implied_as_one
from ..system.equation import Ranks
from .constraints import AbstractCoordinateConstraint
from .host import HostLagrangian
from .kinematics import AbstractKinematics, Parameters
from .model import AbstractLagrangian, Unanalysed

# Number of random sets of parameters at which the entries of the mass matrix are compared with zero.
_LOOKS = 3
# Equilibrated pivots below this power of eps count as zero.
_ZERO = 0.5


def constraint_sizes(
    energies: Mapping[str, Callable[..., Array] | None],
    applied: Callable[..., Array] | None,
    constraints: tuple[AbstractCoordinateConstraint, ...],
    kinematics: AbstractKinematics,
    guess: State,
    parameters: Parameters,
) -> tuple[int, ...]:
    """The number of rows of each constraint, from shapes alone.

    **Arguments:** `energies`: the given functions among `lagrangian`, `kinetic` and `potential`, by name.

    **Raises:** `ValueError` for functions of the wrong shape.
    """
    q, p = guess.q, parameters
    t = jnp.zeros((), q.dtype)
    _shape("kinematics", (q.size,), kinematics.rates, t, q, guess.u, p)
    for name, energy in energies.items():
        if energy is None:
            continue
        shape = _shape(name, None, energy, t, q, *(() if name == "potential" else (q,)), p)
        if math.prod(shape) != 1:
            raise ValueError(f"{name} must be a scalar, got shape {shape}.")
    if applied is not None:
        _shape("force", (q.size,), applied, t, q, q, p)
    return tuple(math.prod(_shape(c.name, None, c.value, t, q, q, q, p)) for c in constraints)


def _shape(name: str, expected: tuple[int, ...] | None, evaluate: Callable[..., Any], *given: Any) -> tuple[int, ...]:
    try:
        with traced_by_jax(name, "an argument"):
            noted = with_note(lambda *given: jnp.asarray(evaluate(*given)), name)
            program, out = jax.make_jaxpr(noted, return_shape=True)(*given)
            check_indices(program, name)
    except TypeError as error:
        if note_of(name) in getattr(error, "__notes__", ()):
            raise
        raise ValueError(f"{name} does not fit the system: {error}") from error
    if expected is not None and out.shape != expected:
        raise ValueError(f"{name} must have shape {expected}, got {out.shape}.")
    return out.shape


def with_programs(system: Unanalysed) -> Unanalysed:
    """A system with its functions checked, and kept as JAX traces them now."""
    # Modules among the parameters are called by functions.
    parameters = system.parameters
    system, functions = with_captured(changed(system, parameters={}))
    system = changed(system, parameters=parameters)

    def evaluated(system: Unanalysed, t: Any, q: Any, u: Any) -> Any:
        v, p = system.rates(t, q, u), system.parameters
        sizes = {c.name: jnp.zeros(n, q.dtype) for c, n in zip(system.constraints, system.sizes, strict=True)}
        # Laws of missing constraints or coefficients are refused later.
        laws = [law for law in system.nonideal if law.constraint in sizes and p.keys() >= set(law.coefficients)]
        return (
            system.lagrangian(t, q, v, p),
            system.applied_force(t, q, v),
            [system.value(c, t, q, v, v) for c in system.constraints],
            [system.kernel(law, "force")(t, q, v, q, sizes[law.constraint], p) for law in laws],
        )

    given = jnp.zeros((), system.guess.q.dtype), system.guess.q, system.guess.u
    eqx.filter_eval_shape(evaluated, system, *given)
    for function in functions:
        function.keep()
    parts = [(item, "value") for item in system.constraints] + [(item, "force") for item in system.nonideal]
    programs = {
        type(part): Captured(getattr(type(part), name))
        for part, name in [*parts, (system.kinematics, "rates")]
        if is_of_user(part)
    }
    system = changed(system, known=tuple(programs.items()))
    eqx.filter_eval_shape(evaluated, system, *given)
    for function in programs.values():
        function.keep()
    return system


class Structure(NamedTuple):
    """Static properties of a system, found from its functions and their values at the guess.

    **Fields:** `diagonal`: whether the mass matrix is diagonal and constant; `positive_definite_mass`: whether the mass
    matrix in the velocities is positive definite at the guess; `linear`, `drift_free`: as in `AbstractSystem`; `ranks`,
    near the guess on the constraints.
    """

    diagonal: bool
    positive_definite_mass: bool
    linear: bool
    drift_free: bool
    ranks: Ranks


def find_structure(system: AbstractLagrangian) -> Structure:
    """Evaluate a system's functions at its guess, and eliminate.

    **Raises:** `ValueError` for an L without second derivatives in the rates, for constraints that cannot be satisfied
    near the guess, and for laws of constraints that are missing or whose force is not determined.
    """
    q: Any = np.asarray(system.guess.q)
    u, p = np.asarray(system.guess.u), system.parameters
    t, host = np.zeros((), q.dtype), HostLagrangian(system, 0.0)
    # A matrix that depends on the coordinates may have other entries elsewhere.
    matrix, given = jax.hessian(system.lagrangian, 2), (t, q, q, p)
    constant = system.kinematics.identity and not depends(matrix, given, 0, 1, 2) and is_analytic(matrix, given, 3)
    looks = [p, *(shaken(p, seed) for seed in range(_LOOKS if constant else 0))]
    stacked = jax.tree.map(lambda *each: np.stack(each), *looks)
    rates, columns, masses = _evaluate(system, stacked, len(looks))
    _check_finite(system, rates, masses[0])
    jacobian = np.zeros((0, rates.size), q.dtype)
    if system.acceleration_rows:
        jacobian = host.jacobian(q)
        for c in _between_velocities(system):
            if not np.all(np.isfinite(jacobian[_rows_of(system, c.name)])):
                raise ValueError(f"{c.name}: its derivative with respect to the rates is not finite at the guess.")
        q = _met(system, host, q)
        jacobian = host.jacobian(q)
    if not np.all(np.isfinite(jacobian)):
        raise ValueError("The constraints have no finite derivatives at the guess; begin at another state.")
    position, velocity, acceleration = (_independent(jacobian[:rows]) for rows in _row_counts(system))
    check_gradients(system, np.linalg.norm(jacobian, axis=1))
    linear = system.kinematics.linear and all(c.is_linear(system.guess.q, p) for c in system.constraints)
    drift_free = linear and system.kinematics.drift_free
    drift_free = drift_free and all(c.is_drift_free(system.guess.q, p) for c in system.constraints)
    if linear and system.velocity_rows:
        rows = slice(0, system.velocity_rows)
        _check_consistent(system, "velocities", jacobian[rows], -host.velocity_rows_at(q, u)[0], rows)
    # Only rows that bind accelerations: the guess need not satisfy rows that bind velocities.
    if system.acceleration_rows > system.velocity_rows:
        rows = slice(system.velocity_rows, system.acceleration_rows)
        _check_consistent(system, "accelerations", jacobian, np.asarray(_asked(system, q)), rows)
    check_implied_as_one(system, q, position, acceleration)
    _check_nonideal(system, jacobian, acceleration.size)
    diagonal = constant and not np.any(masses[1:] * (1 - np.eye(q.size, dtype=q.dtype)))
    sizes = np.linalg.eigvalsh(columns.T @ masses[0] @ columns)
    rank = _independent(host.coordinate_jacobian(q)).size if system.position_rows else 0
    return Structure(
        diagonal=bool(diagonal),
        positive_definite_mass=bool(sizes[0] > np.finfo(q.dtype).eps ** 0.75 * sizes[-1]),
        linear=linear,
        drift_free=drift_free,
        ranks=Ranks(position.size, rank, velocity.size, acceleration.size),
    )


def _check_finite(system, rates, mass):
    if not np.all(np.isfinite(rates)):
        raise ValueError(
            f"The velocities u = {system.guess.u.tolist()} are not invertible for the rates at q = "
            f"{system.guess.q.tolist()}: no rates were found for them."
        )
    if not np.all(np.isfinite(mass)) or not np.any(mass):
        raise ValueError(
            "The Lagrangian needs finite second derivatives with respect to the rates, not all zero; at the guess they "
            f"are {mass.tolist()}."
        )


def _met(system, host, start):
    """The configuration on the constraints; NumPy finds it without compilation if possible."""
    if not system.position_rows:
        return start
    q = host.met(start)
    if not host.holds(q):
        q, residual = map(np.asarray, _met_by_jax(system))
        if not residual <= tolerance(q.dtype):
            names = ", ".join(c.name for c in system.constraints if c.level == 0)
            raise ValueError(
                f"The constraints {names} cannot be satisfied near q = {start.tolist()}: a scaled residual of "
                f"{float(residual):.2g} remains."
            )
    return q


@eqx.filter_jit
def _met_by_jax(system):
    t = jnp.zeros((), system.guess.q.dtype)
    q, jacobian = meet_constraints(system, t, system.guess.q, system.coordinate_scale())
    return q, residual_size(system, t, q, jacobian)


@on_host
def _evaluate(system, looks, count):
    """The rates, their derivatives with respect to the velocities, and second derivatives of L for stacked sets of
    parameters: `looks`, as many as `count`.
    """
    q, u = system.guess.q, system.guess.u
    t = jnp.zeros((), q.dtype)
    v = system.rates(t, q, u)
    columns = jnp.eye(q.size, dtype=q.dtype)
    if not system.kinematics.identity:
        columns = jax.jacfwd(lambda u: system.rates(t, q, u))(u)
    hessian = lambda p: jax.hessian(system.lagrangian, 2)(t, q, v, p)
    return v, columns, jax.vmap(hessian, axis_size=count)(looks)


@eqx.filter_jit
def _asked(system, q):
    """The right-hand side of the rows for accelerations, at the given velocities."""
    u = system.guess.u
    return -system.acceleration_residual(jnp.zeros((), q.dtype), q, u, jnp.zeros_like(u))


def _row_counts(system):
    return system.position_rows, system.velocity_rows, system.acceleration_rows


def _rows_of(system, name):
    return np.array([row_name == name for row_name, _ in system.rows], bool)


def _independent(jacobian):
    """Independent rows of a matrix."""
    order, rank = dense_pivots(jacobian, np.zeros(len(jacobian), int), _ZERO)
    return order[:rank]


def _between_velocities(system: AbstractLagrangian) -> list[AbstractCoordinateConstraint]:
    return [c for c in system.constraints if c.level == 1]


def _check_consistent(
    system: AbstractLagrangian, what: str, jacobian: np.ndarray, right: np.ndarray, rows: slice
) -> None:
    """Raise a `ValueError` naming the constraints among some rows that contradict others at the guess."""
    if right.size == 0:
        return
    left_over = np.abs(right - jacobian @ np.linalg.lstsq(jacobian, right, rcond=None)[0])
    bound = left_over[rows] > 1e-8 * (1.0 + np.max(np.abs(right)))
    wrong = dict.fromkeys(name for (name, _), is_wrong in zip(system.rows[rows], bound, strict=True) if is_wrong)
    if wrong:
        raise ValueError(
            f"The constraints {', '.join(wrong)} contradict each other: no {what} satisfy them together at the guess."
        )


def _check_nonideal(system: AbstractLagrangian, jacobian: np.ndarray, rank: int) -> None:
    """Raise a `ValueError` unless the force of every law's constraint is determined.

    **Arguments:** `rank` of all rows of A.
    """
    names = [name for name, _ in system.rows]
    for law in system.nonideal:
        if law.constraint not in names:
            raise ValueError(
                f"{type(law).__name__} is of a constraint {law.constraint!r}, but there are {sorted(set(names))}."
            )
        for coefficient in law.coefficients:
            if coefficient not in system.parameters:
                raise unknown("parameter", coefficient, system.parameters)
        others = jacobian[~_rows_of(system, law.constraint)]
        if _independent(others).size + names.count(law.constraint) > rank:
            raise ValueError(
                f"{type(law).__name__} of {law.constraint!r}: the force of this constraint is not determined, because "
                "other constraints imply some of its rows. Leave out the redundant rows."
            )
