"""The structure of a Lagrangian system: shapes, ranks, and whether its mass matrix is diagonal."""

import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._captured import Captured
from .._compat import changed
from .._traced_functions import note_of, traced_by_jax, with_note
from .._types import State
from ..linalg.elimination import full_pivot
from ..parts.boundary import is_of_user, with_captured
from ..parts.names import unknown
from ..states.closest import meet_constraints, residual_size, tolerance
from ..states.redundancy import check_gradients, check_implied_as_one
from ..system.equation import Ranks
from .constraints import AbstractCoordinateConstraint
from .dataflow import depends
from .kinematics import AbstractKinematics, Parameters
from .model import AbstractLagrangian

# Number of sets of parameters at which the entries of the mass matrix are compared with zero.
_LOOKS = 3


class Unanalysed(AbstractLagrangian):
    """A Lagrangian system whose structure is not known yet; only `find_structure` evaluates it."""

    diagonal: ClassVar[bool] = False
    positive_definite_mass: ClassVar[bool] = False
    linear: ClassVar[bool] = False
    drift_free: ClassVar[bool] = False
    ranks: ClassVar[Ranks] = Ranks(0, 0, 0, 0)


def constraint_sizes(
    energies: Mapping[str, Callable[..., Array] | None],
    applied: Callable[..., Array] | None,
    constraints: tuple[AbstractCoordinateConstraint, ...],
    kinematics: AbstractKinematics,
    guess: State,
    parameters: Parameters,
) -> tuple[int, ...]:
    """The number of rows of each constraint, from shapes alone.

    **Arguments:** `energies`: those that are given of `lagrangian`, `kinetic` and `potential`, by these names.

    **Raises:** `ValueError` for functions of the wrong shape.
    """
    q, p = guess.q, parameters
    t = jnp.zeros((), q.dtype)
    _shape("kinematics", (q.size,), kinematics.rates, t, q, guess.u, p)
    for name, energy in energies.items():
        if energy is None:
            continue
        found = _shape(name, None, energy, t, q, *(() if name == "potential" else (q,)), p)
        if math.prod(found) != 1:
            raise ValueError(f"{name} must be a scalar, got shape {found}.")
    if applied is not None:
        _shape("force", (q.size,), applied, t, q, q, p)
    return tuple(math.prod(_shape(c.name, None, c.value, t, q, q, q, p)) for c in constraints)


def _shape(name: str, expected: tuple[int, ...] | None, evaluate: Callable[..., Any], *given: Any) -> tuple[int, ...]:
    try:
        with traced_by_jax(name, "an argument"):
            shape = jax.eval_shape(with_note(lambda *given: jnp.asarray(evaluate(*given)), name), *given).shape
    except TypeError as error:
        if note_of(name) in getattr(error, "__notes__", ()):
            raise
        raise ValueError(f"{name} does not fit the system: {error}") from error
    if expected is not None and shape != expected:
        raise ValueError(f"{name} must have shape {expected}, got {shape}.")
    return shape


def with_programs(system: Unanalysed) -> Unanalysed:
    """A system whose functions have been checked, with these as JAX traces them now."""
    # Modules among the parameters are called by functions.
    parameters = system.parameters
    system, functions = with_captured(changed(system, parameters={}))
    system = changed(system, parameters=parameters)

    def evaluated(system: Unanalysed, t: Any, q: Any, u: Any) -> Any:
        v, p = system.rates(t, q, u), system.parameters
        sizes = {c.name: jnp.zeros(n, q.dtype) for c, n in zip(system.constraints, system.sizes, strict=True)}
        # The law of a constraint or a coefficient that is not there is refused later.
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
    parts = [(own, "value") for own in system.constraints] + [(own, "force") for own in system.nonideal]
    own = {
        type(part): Captured(getattr(type(part), name))
        for part, name in [*parts, (system.kinematics, "rates")]
        if is_of_user(part)
    }
    system = changed(system, known=tuple(own.items()))
    eqx.filter_eval_shape(evaluated, system, *given)
    for function in own.values():
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

    **Raises:** `ValueError` for an L without second derivatives in the rates, constraints that cannot be satisfied near
    the guess, and laws of constraints that are not there, or whose own force is not determined.
    """
    q, p = system.guess.q, system.parameters
    t = jnp.zeros((), q.dtype)
    # A matrix that depends on where the system is might have other entries elsewhere.
    constant = system.kinematics.identity and not depends(jax.hessian(system.lagrangian, 2), (t, q, q, p), 0, 1, 2)
    found = jax.tree.map(np.asarray, _evaluate(system, constant))
    if not np.all(np.isfinite(found.rates)):
        raise ValueError(
            f"The velocities u = {system.guess.u.tolist()} are not invertible for the rates at q = {q.tolist()}: no "
            "rates were found that belong to them."
        )
    if not np.all(np.isfinite(found.mass)) or not np.any(found.mass):
        raise ValueError(
            f"The Lagrangian needs finite second derivatives with respect to the rates, and not all of them zero; at "
            f"the guess they are {found.mass.tolist()}."
        )
    for c, slope in zip(_between_velocities(system), found.slopes, strict=True):
        if not np.all(np.isfinite(slope)):
            raise ValueError(f"{c.name}: its derivative with respect to the rates is not finite at the guess.")
    if not found.residual <= tolerance(q.dtype):
        names = ", ".join(c.name for c in system.constraints if c.level == 0)
        raise ValueError(
            f"The constraints {names} cannot be satisfied near q = {q.tolist()}: a scaled residual of "
            f"{float(found.residual):.2g} remains."
        )
    if not np.all(np.isfinite(found.jacobian)):
        raise ValueError("The constraints have no finite derivatives at the guess; begin at another state.")
    position, velocity, acceleration, *others = map(int, found.row_ranks)
    check_gradients(system, np.linalg.norm(found.jacobian, axis=1))
    linear = system.kinematics.linear and all(c.is_linear(q, p) for c in system.constraints)
    drift_free = linear and system.kinematics.drift_free and all(c.is_drift_free(q, p) for c in system.constraints)
    if linear:
        rows = slice(0, system.velocity_rows)
        _check_consistent(system, "velocities", found.jacobian[rows], -found.unmet, rows)
    # Only rows that bind accelerations: the guess need not satisfy those that bind velocities.
    rows = slice(system.velocity_rows, system.acceleration_rows)
    _check_consistent(system, "accelerations", found.jacobian, found.right, rows)
    check_implied_as_one(system, found.q, found.row_orders[0, :position], found.row_orders[2, :acceleration])
    _check_nonideal(system, acceleration, others)
    diagonal = constant and not np.any(found.masses * (1 - np.eye(q.size, dtype=q.dtype)))
    sizes = np.linalg.eigvalsh(found.inertia)
    return Structure(
        diagonal=bool(diagonal),
        positive_definite_mass=bool(sizes[0] > np.finfo(q.dtype).eps ** 0.75 * sizes[-1]),
        linear=linear,
        drift_free=drift_free,
        ranks=Ranks(position, int(found.coordinate_rank), velocity, acceleration),
    )


class _Numbers(NamedTuple):
    """A configuration on the constraints; rates, second derivatives of L and mass matrix at the guess, second
    derivatives with other parameters; slopes of the constraints between velocities; the residual that remains of the
    constraints between positions; A, γ, ψ, and of some sets of rows of A the ranks and the orders of elimination.
    """

    q: Any
    rates: Any
    mass: Any
    inertia: Any
    masses: Any
    slopes: tuple[Any, ...]
    residual: Any
    coordinate_rank: Any
    jacobian: Any
    right: Any
    unmet: Any
    row_ranks: Any
    row_orders: Any


@eqx.filter_jit
def _evaluate(system: AbstractLagrangian, constant: bool) -> _Numbers:
    """All that needs the user's functions, in one compiled function."""
    q, u, p = system.guess.q, system.guess.u, system.parameters
    t = jnp.zeros((), q.dtype)
    v = system.rates(t, q, u)
    hessian = jax.hessian(system.lagrangian, 2)
    looks = jnp.arange(_LOOKS if constant else 0, dtype=q.dtype)
    masses = jax.vmap(lambda k: hessian(t, q, v, jax.tree.map(lambda x: _shaken(x, k), p)))(looks)
    slopes = tuple(jax.jacfwd(system.value, 3)(c, t, q, v, v) for c in _between_velocities(system))
    residual, coordinate_rank = jnp.zeros((), q.dtype), jnp.array(0)
    mass, inertia = hessian(t, q, v, p), system.inertia(t, q, u).product(jnp.eye(u.size, dtype=q.dtype))
    if system.position_rows:
        q, linearized = meet_constraints(system, t, q, system.coordinate_scale())
        residual = residual_size(system, t, q, linearized)
        coordinate_rank = full_pivot(system.coordinate_jacobian(t, q)).rank
    jacobian = system.jacobian(t, q, u)
    pivots = jax.vmap(lambda own: full_pivot(jnp.where(own[:, None], jacobian, 0.0)))(_row_sets(system))
    return _Numbers(
        q=q,
        rates=v,
        mass=mass,
        inertia=inertia,
        masses=masses,
        slopes=slopes,
        residual=residual,
        coordinate_rank=coordinate_rank,
        jacobian=jacobian,
        right=-system.acceleration_residual(t, q, u, jnp.zeros_like(u)),
        unmet=system.velocity_residual(t, q, u),
        row_ranks=pivots.rank,
        row_orders=pivots.order.packed,
    )


def _shaken(x: Array, k: Array) -> Array:
    """A parameter with each of its numbers changed by a different factor."""
    return x * (1 + 0.1 * jnp.cos(k + jnp.arange(x.size, dtype=x.dtype)).reshape(x.shape))


def _row_sets(system: AbstractLagrangian) -> np.ndarray:
    """Masks of the rows whose ranks are asked for: between positions, between velocities, all, and for each law that
    is not ideal those of the other constraints.
    """
    names = np.array([name for name, _ in system.rows], dtype=str)
    rows = np.arange(names.size)
    others = [names != law.constraint for law in system.nonideal]
    return np.stack([rows < system.position_rows, rows < system.velocity_rows, rows >= 0, *others])


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
    wrong = dict.fromkeys(name for (name, _), own in zip(system.rows[rows], bound, strict=True) if own)
    if wrong:
        raise ValueError(
            f"The constraints {', '.join(wrong)} contradict each other: no {what} satisfy them together at the guess."
        )


def _check_nonideal(system: AbstractLagrangian, rank: int, others: list[int]) -> None:
    """Raise a `ValueError` unless every law is of a constraint whose force is determined.

    `rank` of all rows; `others`: for each law that of the rows of the other constraints.
    """
    names = [name for name, _ in system.rows]
    for law, rest in zip(system.nonideal, others, strict=True):
        if law.constraint not in names:
            raise ValueError(
                f"{type(law).__name__} is of a constraint {law.constraint!r}, but there are {sorted(set(names))}."
            )
        for coefficient in law.coefficients:
            if coefficient not in system.parameters:
                raise unknown("parameter", coefficient, system.parameters)
        if rest + names.count(law.constraint) > rank:
            raise ValueError(
                f"{type(law).__name__} of {law.constraint!r}: the force of this constraint is not determined, because "
                "other constraints imply some of its rows. Leave the redundant ones out."
            )
