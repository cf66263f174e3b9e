"""Static equilibrium of constrained systems.

At rest the applied forces and the constraint forces balance, `F(t, q, 0) + Aᵀ λ = 0`, `Φ(t, q) = 0`. The search follows
the forces along the displacements that the constraints allow, by Newton's method with positive curvatures and bounded
steps. So a conservative system reaches a minimum of its potential. If the guess is an unstable equilibrium, the search
starts again beside it. The balance is differentiated by the implicit function theorem.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .._types import Coordinates, Scalar, State, VectorLike
from ..linalg.arrays import derivatives_of, is_traced, namespace
from ..linalg.failure import nan_where
from ..linalg.jitted import on_host
from ..linalg.newton import root
from ..linalg.rotations import norm
from ..parts.names import names_arguments
from ..system import AbstractSystem
from ..system.instant import Instant
from ..system.quantities import directions
from .arguments import (
    check_system,
    checked_guess,
    checked_time,
    counted_angles,
    holding,
    split_coordinates,
    split_internal_states,
)
from .assembly import configuration
from .balance import Balance, HostBalance, balance_on_host
from .closest import tolerance
from .held import about_contacts, contacts_against

_ITERATIONS = 200

# Half the initial bound of steps, and the largest bound, in units of the system's size and radians.
_FIRST, _LONGEST = 0.025, 0.5

# Singular values and curvatures below this fraction of the largest are rounding errors.
_NEGLIGIBLE = 1e-12

# An equilibrium is unstable if the stiffness has a negative eigenvalue larger than this fraction of the largest. The
# search restarts at a distance from it, in units of the system's size and radians, for a limited number of times.
_FALLS = 1e-10
_BESIDE = 0.05
_STARTS = 10


@names_arguments
def equilibrium(
    system: AbstractSystem,
    guess: State | None = None,
    *,
    fix: Mapping[str, VectorLike] | None = None,
    t: Scalar = 0.0,
    stable: bool = True,
    throw: bool | None = None,
) -> State:
    """Find a static equilibrium near a guess, by default a stable equilibrium: a pendulum hangs.

    ```python
    hanging = jaxmb.equilibrium(system)
    upright = jaxmb.equilibrium(system, jaxmb.assemble(system, fix={"bar.angle": 1.5}), stable=False)
    ```

    An equilibrium is stable here if the forces lead back from all displacements that the constraints allow: no
    eigenvalue of the stiffness has a negative real part. With conservative forces the potential then has a minimum. The
    search leaves an unstable equilibrium along the displacement from which forces lead away, on one side and, if need
    be, on the other. `linearise` tells whether motions about an equilibrium are damped.

    Equilibria form a family if some displacements meet no resistance: a vehicle may roll along level ground, its wheels
    may turn. The search finds a member near the guess, by the shortest steps in the scales of the velocities; `fix`
    selects another. Wheels that roll without slipping reach it by rolling.

    **Arguments:**

    - `system`: a compiled scene, or another system; its forces must be able to balance at zero velocity.
    - `guess`: the start, default the poses given with the bodies; assembled first.
    - `fix`: coordinates that must have these values, by name, as in `assemble`; the prescription may exert a force.
        Internal states take values from `fix`, else from the guess, and must rest at these values.
    - `t`: the time, for forces and drivers that depend on it [s].
    - `stable`: with `False` the search is Newton's method on the balance of forces. It goes to an equilibrium near the
        guess, stable or not, such as a pendulum upright.
    - `throw`: whether to raise an error if the search fails. By default an error is raised, except under `jit`, `vmap`
        or a derivative. There, and with `False` everywhere, the state is NaN, so that one member of a batch does not
        spoil the others. `True` raises under `jit` as well, by a callback to Python; JAX does not cache such programs
        on disk.

    **Returns:** a `State` with velocities zero, differentiable by the parameters and the fixed values.

    Contacts (`Stop`, `RigidContact`, `Slack`, …) stay open or closed as in the guess; `fix` closes a contact,
    `{"floor.mode": 1}`, or opens it, 0. In an equilibrium no open contact is overlapped and no closed contact pulls.

    **Raises:** `ValueError` if the mechanism cannot be assembled, if a prescribed motion has a velocity at time t, if
    internal states change, or if no equilibrium is found: none at all, none that is stable, or none that agrees with
    the contacts. The message names the coordinates that are unbalanced, or along which the equilibrium falls. Also for
    a system with dry friction, other constraints that are not ideal, or servos. With `throw=True` under `jit`, a
    run-time error without the names.
    """
    check_system("equilibrium", system)
    if not system.ideal_on_velocities:
        raise ValueError(
            "equilibrium needs ideal constraints that bind positions or velocities; remove friction and servos."
        )
    guess = checked_guess("equilibrium", system, guess)
    time = checked_time("equilibrium", t, guess.q.dtype)
    z, fix = split_internal_states(system, guess.z, fix)
    fix, of_joints = split_coordinates(system, fix)
    angles = counted_angles(system, guess, of_joints)
    system = holding(system if z is None else system.with_states(z), of_joints, {}, time)
    raises = throw is not False
    start, fixed, assembled = configuration(system, guess.q, fix, time, raises)
    held = tuple(np.flatnonzero(fixed).tolist())
    u = jax.device_put(np.zeros(system.nu, start.dtype))
    at_rest = jnp.array(True) if system.drift_free else _drivers_at_rest(Instant(system, time, start, u))
    # Under a derivative the outcome is concrete, but numbers for a message are traced.
    errors = raises and not is_traced((system, time, start, z, at_rest))
    if errors and not bool(at_rest):
        raise ValueError(
            "A prescribed motion has a velocity at this time; choose a time t at which all drivers are at rest."
        )
    q, unbalanced, falling, ok, overlaps, pulls = _found(system, time, start, held, bool(stable))
    if errors and not bool(ok):
        unbalanced = np.asarray(unbalanced) / np.asarray(system.velocity_scale())
        raise ValueError(_only_unstable(system, falling) if np.any(falling) else _not_found(system, start, unbalanced))
    if errors and np.any(overlaps | pulls):
        against, change = about_contacts("The forces balance", system, overlaps, pulls)
        raise ValueError(f"{against}For example jaxmb.equilibrium(system, {change}).")
    at = Instant(system, time, q, u, z)
    steady = True if z is None else _steady(at)
    if errors and not np.all(steady):
        raise ValueError(_changing(at, np.asarray(steady)))
    if errors:
        return State(q, u, z, angles)
    ok = ok & at_rest & assembled & jnp.all(jnp.asarray(steady)) & ~jnp.any(overlaps | pulls)
    if raises and not is_traced(ok) and ok:
        return State(q, u, z, angles)
    if throw:
        q = eqx.error_if(
            q,
            ~ok,
            "No static equilibrium was found; call equilibrium outside jit to see the coordinates at fault.",
        )
    state = State(q, u, z, angles)
    return state if throw else nan_where(jnp.logical_not(ok), state, (system, guess, fix, time))


@eqx.filter_jit
def _drivers_at_rest(at):
    """Whether all prescribed motions are at rest."""
    speeds = jnp.concatenate([at.velocity_residual, at.rates])
    return jnp.max(jnp.abs(speeds), initial=0.0) <= tolerance(at.q.dtype)


@eqx.filter_jit
def _steady(at):
    """Which internal states do not change."""
    return jnp.abs(at.state_rates) <= tolerance(at.q.dtype) ** 0.5 * at.system.state_scale()


def _changing(at, steady):
    rates = np.asarray(at.state_rates)
    names = {name: rates[index] for name, index in at.system.state_names().items() if not np.all(steady[index])}
    listed = ", ".join(f"{name} ({np.max(np.abs(rate)):.3g} per second)" for name, rate in names.items())
    return (
        f"In the equilibrium internal states change: {listed}. Their values are from the guess; give values at which "
        "they rest with fix, such as a motor's torque after its lag."
    )


class _Linearised(NamedTuple):
    """The balance for small displacements z from a configuration: `force − stiffness z` along allowed displacements.

    **Fields:** `curvatures` and `directions` of the symmetric part of the stiffness, in which forbidden directions
    count as stiff; `loose`: which directions have no stiffness; `multipliers` of the rows; `correction`: the
    displacement back to the rows; `sizes` of the rows; `implied`: the projector on vanishing combinations of rows.
    """

    force: Float[Array, "n"]
    stiffness: Float[Array, "n n"]
    curvatures: Float[Array, "n"]
    directions: Float[Array, "n n"]
    loose: Bool[Array, "n"]
    multipliers: Float[Array, "m"]
    correction: Float[Array, "n"]
    sizes: Float[Array, "m"]
    implied: Float[Array, "m m"]


# The configuration after a small displacement from another, and the balance there.
_At: TypeAlias = Callable[[Coordinates, Float[Array, "n"]], tuple[Float[Array, "nq"], _Linearised]]


def _linearise(balance: Balance | HostBalance, q: Coordinates) -> _Linearised:
    xp, jacobian = namespace(q), balance.jacobian(q)
    m, n = jacobian.shape
    sizes = norm(jacobian)
    sizes = xp.where(sizes > 0, sizes, 1.0)
    left, values, right = xp.linalg.svd(jacobian / sizes[:, None], full_matrices=False)
    # Off the constraints implied rows are only nearly implied: the rank tells how many to drop.
    kept = (xp.arange(values.size) < balance.rank) & (values > _NEGLIGIBLE * xp.max(values, initial=0.0))
    left, right = xp.where(kept[None, :], left, 0.0), xp.where(kept[:, None], right, 0.0)
    inverse = right.T @ (left / xp.where(kept, values, 1.0)[None, :]).T
    allowed = xp.eye(n, dtype=q.dtype) - right.T @ right

    softness, applied = balance.applied_along(q)
    multipliers = -(inverse.T @ applied) / sizes
    row_softness, force = balance.of_rows_along(q, multipliers)
    softness, force = softness + row_softness, applied + force
    stiffness = -allowed @ softness @ allowed
    largest, overall = xp.max(xp.abs(stiffness)), xp.max(xp.abs(softness))
    # If the rows allow no displacement, or none that is resisted, the stiffness consists of rounding errors.
    largest = xp.where(largest > _NEGLIGIBLE * overall, largest, overall)
    stiffness = stiffness + xp.where(largest > 0, largest, 1.0) * (right.T @ right)
    curvatures, directions = xp.linalg.eigh(0.5 * (stiffness + stiffness.T))
    return _Linearised(
        allowed @ force,
        stiffness,
        curvatures,
        directions,
        xp.abs(curvatures) <= _NEGLIGIBLE * xp.max(xp.abs(curvatures)),
        multipliers,
        -inverse @ (balance.residual(q, jacobian, xp.zeros(n, q.dtype)) / sizes),
        sizes,
        xp.eye(m, dtype=q.dtype) - left @ left.T,
    )


def _linearised(
    balance: Balance | HostBalance, q: Coordinates, z: Float[Array, "nu"]
) -> tuple[Float[Array, "nq"], _Linearised]:
    """The configuration after a small displacement, and the balance there."""
    moved = balance.moved(q, z)
    return moved, _linearise(balance, moved)


def _step(local: _Linearised, *, downhill: bool) -> Float[Array, "n"]:
    """Newton's step, downhill with positive curvatures; zero along loose directions without force."""
    xp = namespace(local.force)
    along = local.directions.T @ local.force
    largest = lambda x: xp.max(xp.abs(x), initial=0.0)
    noise = 1e3 * jnp.finfo(along.dtype).eps * (largest(local.curvatures) + largest(local.sizes * local.multipliers))
    quiet = local.loose & (xp.abs(along) <= noise)
    size = xp.abs(local.curvatures)
    # Without any stiffness the bound on steps decides the length.
    stiff = xp.where(xp.max(size) > 0, xp.max(size), 1.0)
    # Directions without force count as stiff, so that rounding errors cause no motion along them.
    size = xp.where(quiet, stiff, xp.maximum(size, _NEGLIGIBLE * stiff))
    size = size if downhill else xp.where(~quiet & (local.curvatures < 0), -size, size)
    stiffness = local.stiffness + (local.directions * (size - local.curvatures)[None, :]) @ local.directions.T
    return xp.linalg.solve(stiffness, local.directions @ xp.where(quiet, 0.0, along))


class _Outcome(NamedTuple):
    """An equilibrium, and facts about it.

    **Fields:** the residual forces, `unbalanced`, in the scales of velocities; the displacement along which a discarded
    equilibrium is `falling`, else zero; `ok`: whether the search succeeded; which open contacts have `overlaps`; which
    closed contacts have `pulls`.
    """

    q: Float[Array, "nq"]
    unbalanced: Float[Array, "nu"]
    falling: Float[Array, "nu"]
    ok: Bool[Array, ""]
    overlaps: Bool[Array, "contacts"]
    pulls: Bool[Array, "contacts"]


def _found(system, t, start, held, stable) -> _Outcome:
    """The equilibrium; known numbers are searched in NumPy, also those of a derivative."""
    frozen = lax.stop_gradient((system, t, start))
    found: Any = (None, None, None) if is_traced(frozen) else _on_host(*frozen, held, stable)
    outcome, local, host = found
    if outcome is None:
        return _balanced(system, t, start, held, stable)
    if not is_traced((system, t, start)):
        return outcome
    if not outcome.ok:
        return _balanced(system, t, start, held, stable)
    balance = Balance(system, t, start[np.array(held, int)], held)
    inverse = None
    if host is not None and derivatives_of((system, t, start)).levels == 1:
        inverse = _inverse(host, np.asarray(outcome.q), local)
    return outcome._replace(q=_followed(balance, outcome.q, local, outcome.ok, inverse)[0])


@eqx.filter_jit
def _balanced(system: AbstractSystem, t: Array, start: Coordinates, held: tuple[int, ...], stable: bool) -> _Outcome:
    """The equilibrium by a program."""
    balance = Balance(system, t, start[np.array(held, int)], held)
    search = _settled if stable else _nearest
    fixed = lax.stop_gradient(balance)
    q, local, falling, ok = search(functools.partial(_linearised, fixed), lax.stop_gradient(start), _unknown(balance))
    q, multipliers = _followed(balance, q, local, ok)
    overlaps, pulls = lax.stop_gradient(_against(system, t, q, multipliers, local.implied))
    return _Outcome(q, local.force, falling, ok, overlaps, pulls)


# A nested program, which is one of its own for known numbers.
@eqx.filter_jit
def _followed(
    balance: Balance, q: Coordinates, local: _Linearised, ok: Any, inverse: Array | None = None
) -> tuple[Array, Array]:
    """A known equilibrium and its multipliers, with their derivatives by the implicit function theorem.

    **Arguments:** `inverse` of the derivative of the equations, for first derivatives, if it is known.
    """
    # Equations with a unique solution: the configuration does not move along loose directions, and the multipliers of
    # implied rows are as small as possible.
    n, stiff = balance.system.nu, jnp.max(jnp.abs(local.curvatures))
    loose = jnp.where(local.loose[None, :], local.directions, 0.0) @ local.directions.T
    jacobian = lax.stop_gradient(balance).jacobian(q)

    def equations(x):
        z, multipliers = x[:n], x[n:]
        moved = balance.moved(q, z)
        force = balance.forces(moved, multipliers) - stiff * (loose @ z)
        rows = balance.residual(moved, jacobian, z) / local.sizes
        rows += local.implied @ (local.sizes * multipliers) / stiff
        # Without an equilibrium, equations with a solution replace these, so that derivatives stay finite.
        return jnp.where(ok, jnp.concatenate([force, rows]), x - initial)

    initial = jnp.concatenate([jnp.zeros(n, q.dtype), local.multipliers])
    if inverse is None:
        solved = root(equations, initial, lambda _, x: x)
    else:
        unmet = equations(initial)
        solved = initial - inverse @ (unmet - lax.stop_gradient(unmet))
    return balance.moved(q, solved[:n]), solved[n:]


def _against(system, t, q, multipliers, implied):
    """Which open contacts are overlapped, and which closed contacts pull."""
    contacts = system.contacts
    if not contacts:
        return (jnp.zeros(0, bool),) * 2
    alone = contacts.at_rows(jnp.diag(implied))[: contacts.n] <= tolerance(q.dtype) ** 0.5
    return contacts_against(Instant(system, t, q, jnp.zeros(system.nu, q.dtype)), multipliers, alone)


_linearised_alone, _against_alone = on_host(_linearised), on_host(_against)


def _on_host(system, t, start, held, stable) -> tuple[_Outcome | None, Any, HostBalance | None]:
    """`_balanced` with the search in NumPy, for concrete numbers, with the balance there and its equations; None if a
    matrix is singular or not finite.
    """
    start, time = jax.tree.map(np.asarray, (start, t))
    balance = Balance(system, time, start[np.array(held, int)], held)
    host = balance_on_host(balance)
    at = functools.partial(_linearised_alone, balance) if host is None else functools.partial(_linearised, host)
    try:
        q, local, falling, ok = (_settled if stable else _nearest)(at, start, _unknown(balance))
    except np.linalg.LinAlgError:
        return None, None, None
    against: Any = (np.zeros(0, bool),) * 2
    if ok and system.contacts:
        against = _against_alone(system, time, q, local.multipliers, local.implied)
    return _Outcome(jax.device_put(q), local.force, falling, jax.device_put(np.asarray(ok)), *against), local, host


def _inverse(host: HostBalance, q: np.ndarray, local: Any) -> Array | None:
    """The inverse of the derivative of the equations in `_followed`, None if it is singular."""
    jacobian, stiff = host.jacobian(q), np.max(np.abs(local.curvatures))
    softness = np.asarray(host.applied_along(q)[0]) + host.of_rows_along(q, local.multipliers)[0]
    loose = np.where(local.loose[None, :], local.directions, 0.0) @ local.directions.T
    rows = jacobian / local.sizes[:, None]
    matrix = np.block([[softness - stiff * loose, jacobian.T], [rows, local.implied * local.sizes / stiff]])
    try:
        inverse = np.linalg.inv(matrix)
    except np.linalg.LinAlgError:
        return None
    return jax.device_put(inverse) if np.all(np.isfinite(inverse)) else None


def _nearest(at: _At, start: Coordinates, unknown: _Linearised):
    """The equilibrium that Newton's method reaches from a guess."""
    q, local, balanced = _search(at, start, unknown, downhill=False)
    return q, local, namespace(start).zeros_like(local.force), balanced


def _settled(at: _At, start: Coordinates, unknown: _Linearised):
    """The equilibrium to which forces lead from a guess, or from beside an unstable equilibrium."""
    xp = namespace(start)

    def proceed(carry):
        *_, done, k = carry
        return ~done & (k < _STARTS)

    def start_again(carry):
        begin, beside, _, _, origin, falling, side, *_, k = carry
        q, local, balanced = _search(at, begin, unknown, downhill=True, first=beside)
        stable, softest = _softest(local.stiffness)
        ok = balanced & stable
        leave, turn_round = balanced & ~ok, ~balanced & (side > 0)
        origin, falling = xp.where(leave, q, origin), xp.where(leave, softest, falling)
        side = xp.where(leave, 1.0, xp.where(turn_round, -1.0, side))
        begin, beside = xp.where(ok, q, origin), xp.where(ok, 0.0, side * _BESIDE * falling)
        return begin, beside, q, local, origin, falling, side, ok, ok | ~(leave | turn_round), k + 1

    none, no, zero = xp.zeros((), start.dtype), xp.asarray(False), xp.zeros_like(unknown.force)
    begun = start, zero, start, unknown, start, zero, none, no, no, 0
    _, _, q, local, _, falling, _, ok, _, _ = _repeated(proceed, start_again, begun)
    return q, local, falling, ok


def _repeated(proceed: Callable[[Any], Any], advance: Callable[[Any], Any], carry: Any) -> Any:
    """A while loop: in Python for NumPy arrays, else in XLA."""
    if namespace(carry[0]) is not np:
        return lax.while_loop(proceed, advance, carry)
    while proceed(carry):
        carry = advance(carry)
    return carry


def _softest(stiffness: Float[Array, "n n"]) -> tuple[Bool[Array, ""], Float[Array, "n"]]:
    """Whether no eigenvalue has a negative real part; and the softest direction, with largest entry about one."""
    xp = namespace(stiffness)
    values, vectors = xp.linalg.eig(stiffness)
    direction = vectors[:, xp.argmin(values.real)].real
    size = xp.abs(direction)
    # The first of several large entries decides the sign, so that rounding errors do not.
    first = direction[xp.argmax(size > 0.5 * xp.max(size))]
    stable = xp.min(values.real) >= -_FALLS * xp.max(xp.abs(values))
    return stable, direction / xp.where(first != 0, first, 1.0)


def _unknown(balance: Balance) -> _Linearised:
    """A linearisation of zeros."""
    n, m, dtype = balance.system.nu, balance.system.velocity_rows + len(balance.held), balance.system.guess.q.dtype
    vector, rows, matrix = np.zeros(n, dtype), np.zeros(m, dtype), np.zeros((n, n), dtype)
    zeros: Any = vector, matrix, vector, matrix, np.zeros(n, bool), rows, vector, rows, np.zeros((m, m), dtype)
    return _Linearised(*zeros)


def _search(
    at: _At, start: Coordinates, unknown: _Linearised, *, downhill: bool, first: Float[Array, "n"] | None = None
) -> tuple[Float[Array, "nq"], _Linearised, Bool[Array, ""]]:
    """Follow the forces, or the steps of Newton's method, until the forces vanish; also returns whether they vanish.

    **Arguments:** `first`: a displacement from the start, default zero.
    """
    xp, close = namespace(start), float(np.finfo(start.dtype).eps) ** 0.5

    def proceed(carry):
        *_, radius, balanced, k = carry
        return ~balanced & (radius > close) & (k < _ITERATIONS)

    def advance(carry):
        q, local, step, radius, _, k = carry
        size, off = xp.max(xp.abs(step)), xp.max(xp.abs(local.correction))
        trial, ahead = at(q, step + local.correction)
        # A step is too long if forces at its end push back at least half as hard as they pushed at its beginning. The
        # effect of the rows' correction on the forces is not counted.
        other = xp.max(xp.abs(local.curvatures)) * norm(local.correction) * norm(step)
        back = xp.dot(ahead.force, step) < -0.5 * xp.abs(xp.dot(local.force, step)) - other
        weaker = norm(ahead.force) < norm(local.force)
        better = ~back | weaker if downhill else (size <= close) | weaker
        # Forces after a step of rounding errors are rounding errors, and may push back.
        good = (k == 0) | ((better | (size <= close**1.5)) & xp.all(xp.isfinite(ahead.force)))
        q, local = jax.tree.map(lambda new, old: xp.where(good, new, old), (trial, ahead), (q, local))
        radius = xp.where(good, xp.minimum(2 * radius, _LONGEST), 0.25 * radius)
        step = _step(local, downhill=downhill)
        longest = xp.max(xp.abs(step))
        step = step * xp.minimum(1.0, radius / xp.where(longest > 0, longest, 1.0))
        # After a small Newton step the error is of the order of the step's square, plus the rows' correction. The
        # effect of the correction on the forces is not counted.
        return q, local, step, radius, good & (size <= close) & (off <= close**1.5) & (k > 0), k + 1

    # Without a linearisation yet, the first step is zero unless it is given.
    step = xp.zeros_like(unknown.force) if first is None else first
    begun = (start, unknown, step, xp.asarray(_FIRST, start.dtype), xp.asarray(False), 0)
    q, local, _, _, balanced, _ = _repeated(proceed, advance, begun)
    return q, local, balanced


def _largest(system, values, least):
    """The rates with the largest values, above a fraction `least` of the largest, as text."""
    size = np.abs(np.asarray(values))
    names = directions(system.rate_names())
    return ", ".join(f"{names[k]} ({values[k]:.3g})" for k in np.argsort(-size)[:4] if size[k] > least * np.max(size))


def _only_unstable(system, falling):
    return (
        "No stable equilibrium was found. There is one that is not stable, which falls along "
        f"{_largest(system, falling, 0.1)}, and no forces balance where this leads. Hold such a coordinate with fix, "
        "give a guess nearer to the equilibrium, or ask for the unstable one with stable=False."
    )


def _not_found(system, q, unbalanced):
    listed = _largest(system, unbalanced, 1e-6)
    contacts = system.contacts
    opens = [name for name, is_open in zip(contacts.contact_names, contacts.modes(q).open, strict=True) if is_open]
    closing = f", or close a contact, such as fix={{'{opens[0]}.mode': 1}}" if opens else ""
    return (
        f"No static equilibrium was found: residual forces along {listed or 'nothing'}, in N and N m. Hold such a "
        f"coordinate with fix, remove the force that drives it, or give a guess nearer to the equilibrium{closing}."
    )
