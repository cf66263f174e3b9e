"""Steady motions: states that keep their velocities while all bodies travel, turn and spin uniformly."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from ..._arguments import real_array
from ..._types import Scalar, State
from ...linalg.arrays import is_traced
from ...linalg.failure import nan_where
from ...linalg.newton import newton, root
from ...linalg.rotations import unrotate
from ...parts.names import names_arguments, unknown
from ...states.arguments import check_no_states, check_system, checked_guess, checked_time
from ...states.held import about_contacts, contacts_against
from ...system import AbstractSystem
from ...system.instant import Instant
from .comoving import AbstractCarrier, Advance, Bodies, body_index, carriers
from .linear_equations import fastest, vector_field
from .linearise import remaining
from .perturbations import coordinate_function, rate_function
from .pseudoinverse import pseudoinverse
from .quantities import checked_names

_ITERATIONS = 60
# The longest step in units of the system's size, radians, and the fastest rate; the largest residual of a solution.
_LONGEST, _SOLVED = 0.5, 1e-9


@names_arguments
def steady_motion(
    system: AbstractSystem,
    guess: State | None = None,
    *,
    fix: Mapping[str, Scalar] | None = None,
    rates: Mapping[str, Scalar] | None = None,
    ignorable: Sequence[str] = (),
    t: Scalar = 0.0,
    throw: bool = True,
) -> State:
    """Find a steady motion near a guess.

    ```python
    bob = spatial.PointMass("bob", mass=1.0, position=(0.6, 0.0, -0.8), velocity=(0.0, 2.0, 0.0))
    cord = spatial.Distance("cord", "ground", "bob")
    conical = jaxmb.Scene([bob], joints=[cord], forces=[jaxmb.Gravity((0.0, 0.0, -9.81))]).compile()
    circling = jaxmb.steady_motion(conical, fix={"bob.z": -0.8})  # Its speed is √(9.81 / 0.8) · 0.6.
    ```

    All bodies travel and turn together, uniformly, and may spin about separate axes in addition: a vehicle that runs
    straight or in a circle, a governor, a top that precesses. With `ignorable` only these coordinates change,
    uniformly, and all velocities are constant. Steady motions form families; the result is the nearest to the guess in
    the scales of coordinates and velocities, and `fix` and `rates` select another.

    **Arguments:**

    - `system`: a compiled scene, or another system.
    - `guess`: start of the search, default the poses and velocities given with the bodies. It should move: its
        velocities determine the first rates of a turn.
    - `fix`: prescribed values of coordinates by name: entries of q, or scalar quantities that depend on q.
    - `rates`: likewise velocities, `{"wheel.wy": 5.0}`, `{"frame.velocity[0]": 3.0}`.
    - `ignorable`: names of coordinates that advance uniformly; needed for a system without bodies, unless its
        coordinates are constant.
    - `t`: the time [s] for drivers.
    - `throw`: whether a failed search is an error. With `False` the state is NaN instead.

    Contacts stay open or closed as in the guess, as in `equilibrium`.

    **Returns:** a `State` on the constraints, differentiable with respect to parameters and prescribed values.

    **Raises:** `ValueError` for unknown names; for a system with dry friction that may stick; if there is no such
    motion, with the remaining accelerations; and if an open contact would overlap or a closed contact would have to
    pull. Under `jit` the result is NaN instead.
    """
    check_system("steady_motion", system)
    check_no_states("steady_motion", system)
    if system.contacts.m:
        names = ", ".join(system.contacts.friction_names)
        raise ValueError(
            f"steady_motion: {names} may stick or slip, which the search does not support. Remove the friction, or use "
            "smooth `Friction`."
        )
    guess = checked_guess("steady_motion", system, guess)
    t = jnp.asarray(checked_time("steady_motion", t, guess.q.dtype))
    chosen, values = _conditions(system, t, guess, {} if fix is None else fix, {} if rates is None else rates)
    advancing = _indices(system, ignorable)
    solution = _search(system, t, State(system.normalize(t, guess.q), guess.u), chosen, values, advancing)
    holds = True if solution.against is None else ~jnp.any(solution.against[0] | solution.against[1])
    if is_traced(solution) or not throw:
        return nan_where(~(solution.ok & holds), solution.state, (system, guess, values, t))
    if not solution.ok:
        raise ValueError(_not_found(system, solution, [*chosen[0], *chosen[1]]))
    if solution.against is not None and not holds:
        against, change = about_contacts("The motion is steady", system, *solution.against)
        raise ValueError(f"{against}For example jaxmb.steady_motion(system, jaxmb.assemble(system, guess, {change})).")
    return solution.state


class _Found(NamedTuple):
    """A state, its `remaining` rates (n,), and the residuals `left` of all equations, conditions last. `met`: whether
    these vanish; `ok`: whether they also vanish a little later; `against`: masks of overlapped and of pulling contacts,
    None without contacts.
    """

    state: State
    remaining: Float[Array, "n"]
    left: Float[Array, "e"]
    met: Bool[Array, ""]
    ok: Bool[Array, ""]
    against: tuple[Bool[Array, "contacts"], Bool[Array, "contacts"]] | None


class _Unknowns(eqx.Module):
    """A state, and the turning and travel of all bodies."""

    state: State
    turning: Float[Array, "3"]
    travel: Float[Array, "3"]


def _conditions(system, t, guess, fix, rates):
    for what, given in (("fix", fix), ("rates", rates)):
        if not isinstance(given, Mapping):
            raise ValueError(f"steady_motion: {what} prescribes values by name, {{'crank.angle': 0.3}}; got {given!r}.")
    for name in fix:
        coordinate_function(system, t, None, name)
    for name in rates:
        rate_function(system, t, guess, name)
    dtype = guess.q.dtype
    values = [real_array(f"steady_motion: {name}", value, dtype) for name, value in (*fix.items(), *rates.items())]
    return (tuple(fix), tuple(rates)), jnp.stack(values) if values else jnp.zeros(0, dtype)


def _indices(system, ignorable):
    names, out = system.coordinate_names(), []
    for name in checked_names("coordinate", ignorable):
        if name not in names:
            raise unknown("coordinate", name, names)
        out += names[name]
    return tuple(out)


@eqx.filter_jit
def _search(
    system: AbstractSystem, t: Array, guess: State, chosen: Any, values: Array, advancing: tuple[int, ...]
) -> _Found:
    frozen = lax.stop_gradient((system, t, guess, values))
    start, unknowns = ravel_pytree(_start(*frozen[:3], advancing))
    rate = fastest(frozen[0], frozen[2], vector_field(*frozen[:3])[0])
    # For a guess at rest, only the prescribed rates tell of the motion.
    rate = jnp.where(rate > 0, rate, 1.0)
    later = 0.4 / rate
    length, units = frozen[0].length, (frozen[0].coordinate_scale(), rate * frozen[0].velocity_scale())
    like = unknowns(start)
    of_twist = eqx.tree_at(
        lambda x: (x.turning, x.travel), like, (jnp.full(3, rate, start.dtype), jnp.full(3, rate * length, start.dtype))
    )
    scale = ravel_pytree(eqx.tree_at(lambda x: x.state, of_twist, State(*units)))[0]

    def residual(arguments, z):
        system, t, values = arguments
        return _residual(system, t, values, chosen, advancing, unknowns(scale * z), (*units, rate), later)

    def correct(z):
        step = -pseudoinverse(jax.jacfwd(lambda z: residual(now, z))(z)) @ residual(now, z)
        longest = jnp.max(jnp.abs(step))
        step = step * jnp.minimum(1.0, _LONGEST / jnp.where(longest > 0, longest, 1.0))
        lengths = 0.5 ** jnp.arange(6, dtype=z.dtype)
        sizes = jax.vmap(lambda a: jnp.sum(residual(now, z + a * step) ** 2))(lengths)
        z = z + lengths[jnp.argmin(jnp.where(jnp.isfinite(sizes), sizes, jnp.inf))] * step
        return z, jnp.max(jnp.abs(step))

    now = (frozen[0], frozen[1], frozen[3])
    far = lambda z, size: (size > 1e-12) & jnp.all(jnp.isfinite(z))
    z = newton(correct, far, start / scale, most=_ITERATIONS, dtype=start.dtype)[0]
    left = residual(now, z)
    tol = max(_SOLVED, float(jnp.finfo(start.dtype).eps) ** 0.5)
    solved = jnp.max(jnp.abs(left)) <= tol

    # The equations of the nearest solution, for its derivatives: directions that the residuals leave free do not
    # change.
    inverse = pseudoinverse(jax.jacfwd(lambda z: residual(now, z))(z))
    free = jnp.eye(z.size, dtype=z.dtype) - inverse @ jax.jacfwd(lambda z: residual(now, z))(z)
    good = solved & jnp.all(jnp.isfinite(inverse))
    equations = lambda x: jnp.where(good, inverse @ residual((system, t, values), x) + free @ (x - z), x - z)
    solution = unknowns(scale * root(equations, z, lambda _, x: x))
    state = State(system.normalize(t, solution.state.q), solution.state.u)

    # The residuals at another time, and the remaining rates now.
    check = _residual(system, t, values, chosen, advancing, solution, (*units, rate), 0.7 * later)
    same = jnp.max(jnp.abs(check)) <= 1e3 * tol
    carrier = _carrier(system, solution, system.rates(t, state.q, state.u), advancing)
    (field, multipliers), carried = vector_field(system, t, state), carrier.field(state)
    against = None
    if system.contacts:
        at, forces = lax.stop_gradient((Instant.of(system, t, state), multipliers))
        against = contacts_against(at, forces, alone=jnp.ones(system.contacts.n, bool))
    remaining = jnp.concatenate([field.q - carried.q, field.u - carried.u])
    # An array without entries that a program returns makes XLA lose the types of its LAPACK calls (jaxlib 0.10.2).
    return _Found(state, remaining, left, solved, solved & same, against)


def _start(system, t, guess, advancing):
    """The guess with the best-fitting turning and travel."""
    none = jnp.zeros(3, guess.q.dtype)
    if advancing or not system.body_names:
        return _Unknowns(guess, none, none)
    together = carriers(system, guess, vector_field(system, t, guess)[0], system.length)
    return _Unknowns(guess, together.turning[1], together.travel[1, 0])


def _carrier(system, unknowns, rates, advancing) -> AbstractCarrier:
    """The displacement of a motion: all bodies together, or only the coordinates that advance."""
    if advancing or not system.body_names:
        moves = np.isin(np.arange(system.nq), advancing)
        return Advance(jnp.where(moves, rates, 0.0))
    return _bodies(system, unknowns, rates)


def _bodies(system, unknowns, rates):
    """Bodies that turn and travel together; their spins are the remainders of their angular velocities."""
    index = body_index(system)
    travel = jnp.broadcast_to(unknowns.travel[None, :], (len(index.rotates), 3))
    no_spin = jnp.zeros((len(index.spin), 3), travel.dtype)
    advance = rates[np.array(index.scalars, int)]
    without = Bodies(unknowns.turning, travel, no_spin, advance, index)
    if not index.spin:
        return without
    spins = unknowns.state.u[np.array(index.spin)]
    if spins.shape[1] == 1:
        spins = jnp.pad(spins - unknowns.turning[2], ((0, 0), (2, 0)))
        return Bodies(unknowns.turning, travel, spins, advance, index)
    attitude = unknowns.state.q[np.array(index.attitude)]
    turning_in_body = jax.vmap(lambda p: unrotate(p, unknowns.turning))(attitude)
    return Bodies(unknowns.turning, travel, spins - turning_in_body, advance, index)


def _residual(system, t, values, chosen, advancing, unknowns, units, later):
    """All equations of a steady motion, in units of the system's size and of the fastest rate: at the state, and at the
    displaced state later. Balance at one time does not last if the surroundings change.
    """
    state = unknowns.state
    carrier = _carrier(system, unknowns, system.rates(t, state.q, state.u), advancing)
    sizes, rate, length = jnp.concatenate(units[:2]), units[2], system.length

    def balance(t, at):
        field, carried = vector_field(system, t, at)[0], carrier.field(at)
        left = jnp.concatenate([field.q - carried.q, field.u - carried.u]) / (sizes * rate)
        rows = system.coordinate_residual(t, at.q) / length
        return jnp.concatenate([left, rows, system.velocity_residual(t, at.q, at.u) / (length * rate)])

    both = jax.tree.map(lambda *x: jnp.stack(x), state, carrier.moved(state, later))
    names = [coordinate_function(system, t, None, name) for name in chosen[0]]
    names += [rate_function(system, t, state, name) for name in chosen[1]]
    reached = jnp.stack([f(state) for f in names]) - values if names else values
    balances = jax.vmap(balance)(jnp.stack([t, t + later]), both)
    return jnp.concatenate([balances.reshape(-1), reached])


def _not_found(system, found, names):
    residuals = np.asarray(found.left)[len(found.left) - len(names) :]
    unmet = [name for name, left in zip(names, residuals, strict=True) if not abs(left) < 1e-6]
    held = f" with {', '.join(names)} prescribed" if names else ""
    if found.met:
        return (
            f"No steady motion was found{held}: the nearest state is in balance at one time only, since its "
            "surroundings change along the motion. Prescribe other values, or give another guess."
        )
    cause = f"{', '.join(unmet)} cannot be reached. " if unmet else ""
    return (
        f"No steady motion was found{held}: {cause}{remaining(system, found.remaining)}. Prescribe fewer or other "
        "values, or give a guess nearer to the motion."
    )
