"""Independent perturbations of a constrained state: coordinates and velocities by name.

A state moves on the constraints along directions T, as many as there are independent coordinates and independent
velocities; dependent velocities change with the coordinates too, since ψ(t, q, u) = 0 holds along them. Named states
read small changes, `z = S δx`, and `δx = R z` with `R = T (S T)⁻¹`.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Bool, Float, Int

from ..._compat import used_inputs
from ..._types import Scalar, State
from ...linalg.elimination import PivotSearch, eliminate, full_pivot
from ...parts.names import unknown
from ...system import AbstractSystem
from ...system.instant import Instant
from ...system.quantities import directions, rates_of, single_names
from .quantities import checked_names, components, measured

# Weights of preference between equally suitable states: turns before displacements, rates of chosen coordinates before
# other rates, and rates of coordinates that the user named before all.
_TURN, _CHOSEN, _NAMED = 4.0, 4.0, 64.0


class StateNames(NamedTuple):
    """The states that the user names; static. With `rates` None: the rates of the named coordinates, as far as these
    rates are independent.
    """

    coordinates: tuple[str, ...]
    rates: tuple[str, ...] | None


class Perturbations(eqx.Module):
    """Independent perturbations z of a state.

    **Fields:** `basis` (n × k): `δx = basis z` of x = (q, u) and internal states; `reading` (k × n): `z = reading δx`;
    `coordinates`, the number of coordinates among the states, which come first; internal states come last; `picked`:
    the states that the user did not name, as indices of coordinates in `displacement_names` and of rates in
    `rate_candidates`; `regular`: whether the constraints have their ranks, and the named coordinates and rates are
    independent.
    """

    basis: Float[Array, "n k"]
    reading: Float[Array, "k n"]
    coordinates: int = eqx.field(static=True)
    picked: tuple[Int[Array, "c"], Int[Array, "r"]]
    regular: Bool[Array, "3"]


def joined(state: State) -> Float[Array, "n"]:
    """Coordinates, velocities and internal states in one vector."""
    # Full turns of joints in space have no perturbations.
    return jnp.concatenate([x for x in (state.q, state.u, state.z) if x is not None])


def parted(system: AbstractSystem, x: Array) -> State:
    """The state of a vector, or of a matrix with a column for each of several vectors."""
    q, u, z = jnp.split(x, [system.nq, system.nq + system.nu])
    return State(q, u, z if system.nz else None)


def counts(system: AbstractSystem) -> tuple[int, int]:
    """The number of independent coordinates, and of independent velocities."""
    return system.nq - system.coordinate_rank, system.nu - system.velocity_rank


def displacement_names(system: AbstractSystem) -> list[str]:
    """Names of the displacements among which coordinates are chosen: the coordinates, or for coordinates with
    invariants translations and small turns about the body's axes, `"rod.x"` and `"rod.rotation_x"`.
    """
    if not _has_invariants(system):
        return single_names(system.coordinate_names(), system.nq)
    names = directions(system.rate_names())
    moves = [names[k] for k in range(system.nu)]
    return [f"{name[:-2]}rotation_{name[-1]}" if name[-3:-1] == ".w" else name for name in moves]


def rate_candidates(system: AbstractSystem, names: StateNames) -> list[str]:
    """Names of the rates among which velocities are chosen: rates of named coordinates, and all velocities."""
    named = [f"{name}_rate" for name in names.coordinates] if names.rates is None else []
    return named + single_names(system.rate_names(), system.nu)


def check_state_names(system: AbstractSystem, t: Scalar, state: State, coordinates, rates) -> StateNames:
    """The states that a user names.

    **Raises:** `ValueError` for unknown names, more names than independent states, and quantities that are not
    coordinates.
    """
    names = StateNames(
        () if coordinates is None else checked_names("coordinate", coordinates),
        None if rates is None else checked_names("rate", rates),
    )
    given_names = names.coordinates, names.rates or ()
    for kind, given, most in zip(("coordinate", "rate"), given_names, counts(system), strict=True):
        if len(given) > most:
            raise ValueError(
                f"There are {most} independent {kind}s, and {len(given)} are named: {', '.join(given)}. Name fewer; "
                "the others are chosen."
            )
    for name in names.coordinates:
        function = coordinate_function(system, t, state, name)
        if _depends_on_velocities(function, state):
            raise ValueError(f"{name!r} depends on velocities and is not a coordinate; name it in rates.")
    for name in names.rates or ():
        rate_function(system, t, state, name)
    return names


def coordinate_function(system: AbstractSystem, t: Scalar, at: State | None, name: str) -> Callable[[State], Array]:
    """A coordinate as a function of the state: an entry of q, a displacement from the state `at` if given, or a
    quantity.
    """
    entries = system.coordinate_names()
    if name in entries and len(entries[name]) == 1:
        return lambda state: state.q[entries[name][0]]
    displacements = [] if at is None else displacement_names(system)
    if at is not None and name in displacements:
        place = displacements.index(name)
        return lambda state: _displacements(system, t, at)[place] @ (state.q - at.q)
    return _quantity(system, t, name, "coordinate", [*(k for k, v in entries.items() if len(v) == 1), *displacements])


def rate_function(system: AbstractSystem, t: Scalar, at: State, name: str) -> Callable[[State], Array]:
    """A rate as a function of the state: an entry of u, the rate of a coordinate, or a quantity."""
    entries = {name: index for name, index in rates_of(system.rate_names()).items() if len(index) == 1}
    if name in entries:
        return lambda state: state.u[entries[name][0]]
    base = name.removesuffix("_rate")
    coordinates = {*system.coordinate_names(), *displacement_names(system), *system.quantities()}
    if name in system.joint_coordinates() or (base != name and base.split("[")[0] in coordinates):
        function = coordinate_function(system, t, at, base)
        if not _depends_on_velocities(function, at):
            return lambda state: _rate(system, t, function, state)
    return _quantity(system, t, name, "rate", entries)


def is_rate(system: AbstractSystem, t: Scalar, state: State, name: str) -> bool:
    """Whether a name is a rate's, and not a coordinate's.

    **Raises:** `ValueError` for an unknown name, and for displacements, which are zero at every state.
    """
    base, rates = name.removesuffix("_rate"), system.rate_names()
    if name in rates and len(rates[name]) == 1:
        return True
    function = coordinate_function(system, t, None, base)
    return base != name or _depends_on_velocities(function, state)


def internal_names(system: AbstractSystem) -> list[str]:
    """The names of the internal states in their order, of vectors by component."""
    names = {
        k: name if len(index) == 1 else f"{name}[{place}]"
        for name, index in system.state_names().items()
        for place, k in enumerate(index)
    }
    return [names[k] for k in range(system.nz)]


def tangent_basis(system: AbstractSystem, t: Scalar, state: State) -> tuple[Array, Array, Array, Bool[Array, ""]]:
    """The directions of a state on its constraints: of coordinates (nq × kq), with their changes of velocities (nu ×
    kq), and of velocities alone (nu × ku); and whether the constraints have their ranks.
    """
    q, u = state.q, state.u
    if _has_invariants(system):
        moves = jax.jacfwd(lambda u: system.rates(t, q, u))(u)
        rows, scale = system.jacobian(t, q, u)[: system.position_rows], system.velocity_scale()
        rank = system.position_rank
    else:
        moves = jnp.eye(system.nq, dtype=q.dtype)
        rows, scale, rank = system.coordinate_jacobian(t, q), system.coordinate_scale(), system.coordinate_rank
    positions = full_pivot(rows, scale=scale)
    along = moves @ eliminate(rows, positions.order, rank).null_space
    jacobian = Instant(system, t, q, u).velocity_jacobian
    velocities = full_pivot(jacobian, scale=system.velocity_scale())
    solved = eliminate(jacobian, velocities.order, system.velocity_rank)
    change = lambda dq: jax.jvp(lambda q: system.velocity_residual(t, q, u), (q,), (dq,))[1]
    following = -solved.right_inverse @ jax.vmap(change, in_axes=1, out_axes=1)(along)
    full = (positions.rank >= rank) & (velocities.rank >= system.velocity_rank)
    return along, following, solved.null_space, full


def perturbations(system: AbstractSystem, t: Scalar, state: State, names: StateNames) -> Perturbations:
    """The named states and the most suitable others, by pivoting."""
    along, following, alone, regular = tangent_basis(system, t, state)
    nq, kq, ku = system.nq, along.shape[1], alone.shape[1]
    displacements = _displacements(system, t, state)
    named = _gradients([coordinate_function(system, t, state, name) for name in names.coordinates], state)
    free, coordinates_ok = _remaining(named[:, :nq] @ along)
    turns = _turns(system)
    size = jnp.where(turns, 1.0 / _TURN, _sizes(system))
    picked = _picked(displacements @ along @ free, 1.0 / size)
    rows_q = jnp.concatenate([named, jnp.pad(displacements[picked], ((0, 0), (0, system.nu)))])

    if names.rates is None:
        given = jnp.zeros((0, nq + system.nu), state.q.dtype)
        functions = [coordinate_function(system, t, state, name) for name in names.coordinates]
        preferred = _gradients([lambda x, f=f: _rate(system, t, f, x) for f in functions], state)
    else:
        given = _gradients([rate_function(system, t, state, name) for name in names.rates], state)
        preferred = given[:0]
    free, rates_ok = _remaining(given[:, nq:] @ alone)
    velocities = jnp.eye(system.nu, nq + system.nu, nq, dtype=state.q.dtype)
    candidates = jnp.concatenate([preferred, velocities])
    chosen = jnp.zeros(len(displacements), bool).at[picked].set(True)
    chosen = chosen if len(displacements) == system.nu else jnp.zeros(system.nu, bool)
    speeds = jnp.where(_turns(system, rates=True), 1.0 / _TURN, system.velocity_scale())
    weight = jnp.where(chosen, _CHOSEN, 1.0) / speeds
    along_velocities = preferred[:, nq:] @ alone
    largest = jnp.max(jnp.abs(along_velocities), axis=1, initial=0.0)
    weight = jnp.concatenate([_NAMED / jnp.where(largest > 0, largest, 1.0), weight])
    picked_rates = _picked(candidates[:, nq:] @ alone @ free, weight)
    rows_u = jnp.concatenate([given, candidates[picked_rates]])

    tangent = jnp.block([[along, jnp.zeros((nq, ku), along.dtype)], [following, alone]])
    reading = jnp.concatenate([rows_q, rows_u])
    basis = tangent @ jnp.linalg.inv(reading @ tangent)
    if system.nz:
        identity = jnp.eye(system.nz, dtype=basis.dtype)
        basis, reading = block_diag(basis, identity), block_diag(reading, identity)
    return Perturbations(basis, reading, kq, (picked, picked_rates), jnp.stack([regular, coordinates_ok, rates_ok]))


def _remaining(rows: Float[Array, "m k"]) -> tuple[Float[Array, "k f"], Bool[Array, ""]]:
    """A basis of the directions that named states leave free, and whether the states are independent."""
    m, k = rows.shape
    if m == 0:
        return jnp.eye(k, dtype=rows.dtype), jnp.array(True)
    pivots = full_pivot(rows)
    return eliminate(rows, pivots.order, m).null_space, pivots.rank == m


def _picked(rows: Float[Array, "c f"], weight: Float[Array, "c"]) -> Int[Array, "f"]:
    """The rows that determine all free directions best, by full pivoting, in ascending order."""
    pivots: PivotSearch = full_pivot(rows.T, scale=weight)
    return jnp.sort(pivots.order.columns[: rows.shape[1]])


def _gradients(functions: Sequence[Callable[[State], Array]], state: State) -> Float[Array, "m n"]:
    if not functions:
        return jnp.zeros((0, state.q.size + state.u.size), state.q.dtype)
    return jnp.stack([jnp.concatenate([(g := jax.grad(f)(state)).q, g.u]) for f in functions])


def _rate(system, t, function, state):
    """The time derivative of a function of the coordinates."""
    rest = jax.tree.map(jnp.zeros_like, state)
    moving = dataclasses.replace(rest, q=system.rates(t, state.q, state.u))
    return jax.jvp(function, (state,), (moving,))[1]


def _quantity(system, t, name, kind, others):
    quantities = {key: value for key, value in system.quantities().items() if not value.of_forces}
    shapes = {key: value.shape for key, value in quantities.items()}
    base = name.split("[")[0]
    if base not in shapes:
        raise unknown(kind, name, [*others, *shapes])
    chosen = components(kind, (name,), shapes)
    if len(chosen) != 1:
        raise ValueError(f"{name!r} has {len(chosen)} components; name one of them, '{name}[0]'.")
    return lambda state: measured(system, chosen, t, state, None)[0]


def _depends_on_velocities(function, state):
    """Whether a function of the state is computed from velocities."""
    return used_inputs(function, state).u


def _displacements(system, t, state):
    """The matrix that reads displacements off small changes of q."""
    if not _has_invariants(system):
        return jnp.eye(system.nq, dtype=state.q.dtype)
    moves = jax.jacfwd(lambda u: system.rates(t, state.q, u))(state.u)
    return jnp.linalg.solve(moves.T @ moves, moves.T)


def _has_invariants(system):
    return system.coordinate_rows > system.position_rows


def _sizes(system):
    return system.velocity_scale() if _has_invariants(system) else system.coordinate_scale()


def _turns(system, rates=False):
    """Whether each displacement, or rate, is a turn of a body."""
    entries = system.rate_names() if rates or _has_invariants(system) else system.coordinate_names()
    count = system.nu if rates or _has_invariants(system) else system.nq
    turns = np.zeros(count, bool)
    for body in system.body_names:
        for name in (f"{body}.angle", f"{body}.angle_rate", f"{body}.angular_velocity"):
            turns[entries.get(name, [])] = True
    return turns
