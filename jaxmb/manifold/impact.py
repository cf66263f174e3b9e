"""Impacts and loss of contact: the state after an event of unilateral constraints, and the guards that tell of it.

An impact is Newton's: with the impulses `Λ ≥ 0` of all contacts that touch, `M (u⁺ − u⁻) = Aᵀ Λ`, and a gap that closed
at a rate v opens at least at `restitution` times v; where it opens faster its impulse is zero. Contacts that do not
open then stay closed where their forces push: `λ ≥ 0`, the second derivative of the gap `≥ 0`, and one of them zero.
Both are linear complementarity problems, over the constraints that are always there.

Sources: J. J. Moreau, "Unilateral contact and dry friction in finite freedom dynamics", in: Nonsmooth Mechanics and
Applications, Springer, 1988; Ch. Glocker, "Set-Valued Force Laws", Springer, 2001. The derivative of the state after an
event by that before it is the saltation matrix: P. C. Müller, "Calculation of Lyapunov exponents for dynamic systems
with discontinuities", Chaos, Solitons & Fractals 5, 1995.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .._types import Scalar, State
from ..formulations import AbstractFormulation, accelerations
from ..linalg.complementarity import positive_components, solved_components
from ..solvers import AbstractGuards
from ..system import AbstractEquation
from ..system.gaps import (
    CLOSED,
    IMPLIED,
    OPEN,
    contacts_of,
    gap_accelerations,
    gap_gradients,
    gap_rates,
    gaps,
    modes_of,
    with_modes,
)
from ..system.residuals import binding_velocities, velocity_rows
from .constraints import dense, push
from .impulse import after_impulse

# A step that was meant to end at an event does so where a gap is below this multiple of what counts as zero.
_NEAR = 1e2
# A contact closes where it would bounce no higher than this multiple of it.
_BOUNCE = 1e3
# Rates of gaps, and squares of their gradients, below this fraction of what adds up in them are zero.
_REST = 1e-9


class ContactGuards(AbstractGuards):
    """The gaps of open contacts, in units of the system's size, and the forces of closed ones, relative to the largest
    forces.
    """

    system: AbstractEquation
    formulation: AbstractFormulation
    touch: Float[Array, ""]

    @property
    def near(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return _NEAR * self.touch

    def values(self, t, y):
        system, y = lax.stop_gradient((self.system, y))
        contacts, q = contacts_of(system), system.normalize(y.q)
        t, modes = jnp.asarray(t, q.dtype), modes_of(system, q)
        free = gaps(system, t, q) / system.length

        def forces():
            own = system.at(y)
            _, multipliers = _solved(own, self.formulation, t, q, y.u)
            largest = jnp.max(jnp.abs(multipliers)) + jnp.max(jnp.abs(own.force(t, q, y.u)))
            largest = largest + jnp.finfo(q.dtype).tiny
            return multipliers[jnp.array(contacts.rows)] / largest

        closed = modes == CLOSED
        held = lax.cond(jnp.any(closed), forces, lambda: jnp.ones_like(free))
        return jnp.where(closed, held, jnp.where(modes == OPEN, free, 1.0))

    def impact(self, t: Scalar, y: State) -> "Impact":
        """The event at a state."""
        return impact(self.system.at(y), self.formulation, self.touch, t, y)

    def rates(self, t, y):
        system, y = lax.stop_gradient((self.system, y))
        q = system.normalize(y.q)
        rates = gap_rates(system, jnp.asarray(t, q.dtype), q, y.u) / system.length
        return jnp.where(modes_of(system, q) == OPEN, rates, jnp.inf)


def contact_guards(
    system: AbstractEquation, formulation: AbstractFormulation, touch: Float[Array, ""]
) -> ContactGuards | None:
    """The guards of a system's contacts; None without any."""
    return None if system.contacts is None else ContactGuards(system, formulation, touch)


def after_jump(term: Any, t: Scalar, y: State) -> State:
    """The state after prescribed rates have jumped, or contacts closed or opened, of a term with `system`,
    `formulation` and `guards`.
    """
    if term.guards is None:
        return after_impulse(term.system, t, y)
    return term.guards.impact(t, y).after


class Impact(NamedTuple):
    """An event of contacts.

    **Fields:** the state `after` it, at the time that was asked for; the event is `late` after that; `impulses` of
    contacts; `modes` before and after it; `rest`: the time from the event until the last of infinitely many bounces
    that are left out, zero for contacts without any; the `energy` lost; whether it is `solvable`.
    """

    after: State
    late: Float[Array, ""]
    impulses: Float[Array, "contacts"]
    modes: tuple[Float[Array, "contacts"], Float[Array, "contacts"]]
    rest: Float[Array, "contacts"]
    energy: Float[Array, ""]
    solvable: Bool[Array, ""]


class _Event(NamedTuple):
    """The numbers of an event, by which its derivative is found as well.

    **Fields:** the time until then, `late`, and which gap is `first`, none where `hits` is false; accelerations before
    and after; velocities before (`at`) and after (`u`); contacts that are `held` together by the impact, or `low` ones
    that would bounce lower than can be seen; see `Impact` for the others.
    """

    late: Float[Array, ""]
    first: Any
    hits: Any
    before: Float[Array, "nu"]
    after: Float[Array, "nu"]
    at: Float[Array, "nu"]
    u: Float[Array, "nu"]
    held: Bool[Array, "contacts"]
    low: Bool[Array, "contacts"]
    impulses: Float[Array, "contacts"]
    modes: tuple[Float[Array, "contacts"], Float[Array, "contacts"]]
    rest: Float[Array, "contacts"]
    energy: Float[Array, ""]
    solvable: Bool[Array, ""]


@eqx.filter_jit
def impact(system: AbstractEquation, formulation: AbstractFormulation, touch: Scalar, t: Scalar, y: State) -> Impact:
    """The event of contacts that are about to close, or to open, at a state.

    The first gap that closes is zero later by a small time τ. The state moves on by τ, changes, and moves back by τ
    with the new equations. So the state after it is right to the second power of τ, and the derivative is that of a
    motion whose event time depends on the state. There is no second derivative.

    **Arguments:** `system`: with the internal states of `y`; `touch`: gaps down to minus this, in units of the system's
    size, count as zero.
    """
    t = jnp.asarray(t, y.q.dtype)
    after, event = _impact(system, t, y, formulation, jnp.asarray(touch, y.q.dtype))
    event = lax.stop_gradient(event)
    return Impact(after, event.late, event.impulses, event.modes, event.rest, event.energy, event.solvable)


@eqx.filter_custom_jvp
def _impact(system, t, y, formulation, touch):
    event = _event(system, formulation, touch * system.length, t, y)
    q = with_modes(system, y.q, event.modes[1])
    # The state moves on before the event, and back after it, each at the mean velocity.
    before = system.rates(t, y.q, event.at - 0.5 * event.late * event.before)
    after = system.rates(t, q, event.u - 0.5 * event.late * event.after)
    z = y.z
    if z is not None:
        z = z + event.late * (system.state_rates(t, y.q, event.at) - system.state_rates(t, q, event.u))
    # Without a solution the motion ends here.
    u = jnp.where(event.solvable, event.u - event.late * event.after, jnp.nan)
    return State(q + event.late * (before - after), u, z), event


@_impact.def_jvp
def _impact_jvp(primals, tangents):
    system, t, y, *_ = primals
    dsystem, dt, dy, *_ = tangents
    after, event = _impact(*primals)
    system, t, y, event = _without_second_derivative((system, t, y, event))
    contacts = contacts_of(system)
    dq, du, dt = dense(dy.q, y.q), dense(dy.u, y.u), dense(dt, t)

    # The time of the event changes, and so do time and state there, with the equations before it.
    gap = push(gaps, (system, t, y.q), (dsystem, dt, dq))[event.first]
    rate = jnp.where(event.hits, gap_rates(system, t, y.q, event.at)[event.first], 1.0)
    dlate = jnp.where(event.hits, -gap / rate, 0.0)
    q = with_modes(system, y.q, event.modes[1])
    rates = system.rates(t, y.q, event.at), system.rates(t, q, event.u)
    dq, du, dt = dq + dlate * rates[0], du + dlate * event.before, dt + dlate

    # Of the impact `M (u⁺ − u⁻) = Aᵀ Λ` and the rates of gaps that are held together are known.
    held = with_modes(system, y.q, jnp.where(event.held, CLOSED, OPEN).astype(q.dtype))
    jacobian = binding_velocities(system, t, held, event.u).selected(system.velocity_rank, system.velocity_scale())
    projector = jacobian.projector(system.inertia(t, held, event.u))
    change = event.u - event.at
    _, multipliers = projector.solve(jnp.zeros_like(change), jacobian.product(change))

    def equations(system, t, q, u):
        unmet = velocity_rows(system, t, q, event.u)
        bounce = contacts_of(system).restitution * jnp.maximum(-gap_rates(system, t, q, u), 0.0)
        bounce = jnp.where(event.held & ~event.low, bounce, 0.0)
        rows = unmet.at[np.array(contacts.rows)].add(-bounce)
        force = system.inertia(t, q, u).product(event.u - u)
        return rows, force - system.constraint_force(t, q, event.u, multipliers)

    rows, forces = push(equations, (system, t, held, event.at), (dsystem, dt, dq, du))
    du, _ = projector.solve(-forces, -rows)
    dq, du = dq - dlate * rates[1], du - dlate * event.after
    dq = jnp.where(_are_modes(system), 0.0, dq)
    dz = None
    if y.z is not None:
        jump = system.state_rates(t, y.q, event.at) - system.state_rates(t, q, event.u)
        dz = dense(dy.z, y.z) + dlate * jump
    return (after, event), (State(dq, du, dz), jax.tree.map(lambda _: None, event))


def _are_modes(system):
    """A mask of the modes in q."""
    return np.isin(np.arange(system.nq), contacts_of(system).modes)


@eqx.filter_custom_jvp
def _without_second_derivative(x):
    return x


@_without_second_derivative.def_jvp
def _without_jvp(primals, tangents):
    raise ValueError(
        "Second derivatives through impacts are not supported: their times and states have first derivatives only."
    )


def _event(system, formulation, touch, t, y) -> _Event:
    """An event at a state; `touch` [m, rad]."""
    contacts, q, u = contacts_of(system), y.q, y.u
    modes, open_q = modes_of(system, q), with_modes(system, q, OPEN)
    inertia = system.inertia(t, open_q, u)
    rows = gap_gradients(system, t, q, u)
    jacobian = binding_velocities(system, t, open_q, u).selected(system.velocity_rank, system.velocity_scale())
    projector = jacobian.projector(inertia)
    none = jnp.zeros(system.acceleration_rows, q.dtype)
    # The changes of velocities by unit impulses, with those that the other constraints answer with; in the last row the
    # change that these constraints ask for themselves.
    unmet = -velocity_rows(system, t, open_q, u)
    forces = jnp.concatenate([rows, jnp.zeros_like(rows[:1])])
    asked = jnp.concatenate([jnp.tile(none, (len(rows), 1)), unmet[None]])
    moves = jax.vmap(lambda force, rows: projector.solve(force, rows)[0])(forces, asked)
    moves, jump = moves[:-1], moves[-1]
    influence = rows @ moves.T

    def accelerated(u):
        """Accelerations with open contacts, and those of the gaps."""
        udot = _free_acceleration(system, formulation, projector, t, open_q, u)
        return udot, gap_accelerations(system, t, q, u, udot)

    # What is next, of the equations before.
    udot, opening = accelerated(u)
    before = udot + solved_components(influence, opening, modes == CLOSED) @ moves
    gap, closing = gaps(system, t, q), gap_rates(system, t, q, u)
    about_to = (modes == OPEN) & (gap <= _NEAR * touch) & (closing < 0)
    # The first zero of a parabola.
    curve = gap_accelerations(system, t, q, u, before)
    until = 2 * gap / (jnp.sqrt(jnp.maximum(closing**2 - 2 * curve * gap, 0.0)) + jnp.where(about_to, -closing, 1.0))
    first = jnp.argmin(jnp.where(about_to, until, jnp.inf))
    hits = about_to[first]
    late = jnp.where(hits, until[first], 0.0)
    u = u + late * before

    touching = (modes != OPEN) | (about_to & (jnp.arange(gap.size) == first)) | (gap + late * closing <= touch)
    at = gap_rates(system, t, q, u)
    bounce = contacts.restitution * jnp.maximum(-at, 0.0)
    impulses, held, solvable = _complementary(influence, at + rows @ jump - bounce, touching)
    struck = u + jump + impulses @ moves
    rate = gap_rates(system, t, q, struck)
    udot, opening = accelerated(struck)
    sizes = jnp.abs(rows) @ (jnp.abs(struck) + jnp.abs(u))
    staying = touching & (rate <= _REST * sizes)
    # Contacts that would open by less than can be seen, before they close again, stay closed.
    curve = opening + influence @ _complementary(influence, opening, staying)[0]
    falls = jnp.where(curve < 0, -curve, 1.0)
    low = touching & ~staying & (curve < 0) & (rate**2 <= 2 * falls * _BOUNCE * touch) & (contacts.restitution < 1)
    staying, held = staying | low, held | low
    held = held & _independent(influence, held)
    lost = jnp.where(jnp.any(low), solved_components(influence, jnp.where(staying, rate, 0.0), held & staying), 0.0)
    after, impulses = struck + lost @ moves, impulses + lost
    # Each bounce takes `restitution` times the time of the one before.
    bounces = low & (bounce > 0)
    ratio = jnp.where(bounces, contacts.restitution, 0.0)
    rest = jnp.where(bounces, 2 * rate / (falls * (1 - ratio)), 0.0)

    forces, closed, stays = _complementary(influence, opening, staying)
    implied = staying & ~closed & _is_implied(influence, closed)
    new = jnp.where(closed, CLOSED, jnp.where(implied, IMPLIED, OPEN)).astype(q.dtype)
    energy = 0.5 * (jnp.dot(u, inertia.product(u)) - jnp.dot(after, inertia.product(after)))
    return _Event(
        late=late,
        first=first,
        hits=hits,
        before=before,
        after=udot + forces @ moves,
        at=u,
        u=after,
        held=held,
        low=low,
        impulses=impulses,
        modes=(modes, new),
        rest=rest,
        energy=energy,
        solvable=solvable & stays,
    )


def _independent(influence, among):
    """Contacts of some ones whose impulses can all be found from the changes of the rates of their gaps."""
    among = lax.stop_gradient(among)
    both = among[:, None] & among[None, :]
    # What must be cancelled in a random direction is nearly always cancelled by a basis.
    asked = -jnp.where(both, influence, 0.0) @ (1 + jnp.arange(among.size, dtype=influence.dtype))
    matrix = jnp.where(both, influence, jnp.eye(among.size, dtype=influence.dtype))
    return positive_components(matrix, jnp.where(among, asked, 1.0))[0]


def _is_implied(influence, closed):
    """Which gaps cannot move where some contacts are closed, up to rounding errors."""
    influence, closed = lax.stop_gradient((influence, closed))
    columns = jnp.where(closed[:, None], influence, 0.0)
    matrix = jnp.where(closed[:, None] & closed[None, :], influence, jnp.eye(closed.size, dtype=influence.dtype))
    left = influence - columns.T @ jnp.linalg.solve(matrix, columns)
    return jnp.diag(left) <= _REST * jnp.diag(influence)


def _free_acceleration(system, formulation, projector, t, q, u):
    """The accelerations at coordinates with open contacts, where the projector on the other constraints is known."""
    if not system.ideal_on_velocities:
        return accelerations(system, formulation, t, q, u)[0]
    return _by_projector(system, projector, t, q, u)[0]


def _solved(system, formulation, t, q, u):
    """Accelerations and multipliers at a state, without a search for pivots where that is possible."""
    if not system.ideal_on_velocities:
        return accelerations(system, formulation, t, q, u)
    jacobian = system.structured_jacobian(t, q, u).selected(system.acceleration_rank, system.velocity_scale())
    return _by_projector(system, jacobian.projector(system.inertia(t, q, u)), t, q, u)


def _by_projector(system, projector, t, q, u):
    gamma = -system.acceleration_residual(t, q, u, jnp.zeros_like(u))
    return projector.solve(system.force(t, q, u), gamma)


def _complementary(influence, free, among):
    """Impulses `≥ 0` of some contacts with `influence impulses + free ≥ 0`, of which contacts they are positive, and
    whether there are any.
    """
    among = lax.stop_gradient(among)
    both = among[:, None] & among[None, :]
    influence = jnp.where(both, influence, jnp.eye(free.size, dtype=free.dtype))
    free = jnp.where(among, free, 1.0)
    positive, solvable = positive_components(influence, free)
    return solved_components(influence, free, positive), positive, solvable
