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

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
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
from .impulse import after_impulse
from .manifold import VectorField

# A step that was meant to end at an event does so where a gap is below this multiple of what counts as zero.
_NEAR = 1e3
# A contact closes where it would bounce no higher than this multiple of it.
_BOUNCE = 1e2
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
            _, multipliers = accelerations(own, self.formulation, t, q, y.u)
            largest = jnp.max(jnp.abs(multipliers)) + jnp.max(jnp.abs(own.force(t, q, y.u)))
            largest = largest + jnp.finfo(q.dtype).tiny
            return multipliers[jnp.array(contacts.rows)] / largest

        closed = modes == CLOSED
        held = lax.cond(jnp.any(closed), forces, lambda: jnp.ones_like(free))
        return jnp.where(closed, held, jnp.where(modes == OPEN, free, 1.0))

    def impact(self, field: Callable[[Scalar, State, Any], State], t: Scalar, y: State) -> "Impact":
        """The event at a state; `field(t, y, None)`: the vector field of the system, of all that y has."""
        return impact(field, self.system.at(y), self.formulation, self.touch, t, y)

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
    return term.guards.impact(VectorField(term.system, term.formulation), t, y).after


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


def impact(
    field: Callable[[Scalar, State, Any], State],
    system: AbstractEquation,
    formulation: AbstractFormulation,
    touch: Scalar,
    t: Scalar,
    y: State,
) -> Impact:
    """The event of contacts that are about to close, or to open, at a state.

    The first gap that closes at a rate v is zero later by `τ = −gap / v`, a small time. The state moves on by τ,
    changes, and moves back by τ with the new equations. So the state after it is right to the third power of τ, and
    the derivatives are those of a motion whose event time depends on the state.

    **Arguments:** `field(t, y, None)`: the vector field of `system`; `touch`: gaps down to minus this, in units of the
    system's size, count as zero.
    """
    contacts, t = contacts_of(system), jnp.asarray(t, y.q.dtype)
    length = lax.stop_gradient(system.length)
    modes = lax.stop_gradient(modes_of(system, y.q))

    def moved(carry, at_event):
        """To the event, and what happens there; or back from it."""
        y, late, out = carry
        f, rate = jax.jvp(lambda t, y: field(t, y, None), (t, y), (jnp.ones_like(t), field(t, y, None)))
        curve = gap_accelerations(system, t, y.q, y.u, f.u)
        found, hit = _first_zero(system, t, y, modes == OPEN, curve, _NEAR * touch * length)
        late = jnp.where(at_event, found, -late)
        y = jax.tree.map(lambda y, f, rate: y + late * f + 0.5 * late**2 * rate, y, f, rate)
        at = lambda: _at_event(system, formulation, touch * length, t + late, y, modes, hit, lax.stop_gradient(curve))
        y, out = lax.cond(at_event, at, lambda: (y, out))
        return (y, jnp.where(at_event, late, -late), out), None

    none = jnp.zeros(len(contacts.names), y.q.dtype)
    start = y, jnp.zeros_like(t), (none, none, none, jnp.zeros_like(t), jnp.array(True))
    # A loop, so that the field is compiled once.
    (after, late, out), _ = lax.scan(moved, start, jnp.array([True, False]))
    impulses, new, rest, energy, solvable = out
    return Impact(after, late, impulses, (modes, new), rest, energy, solvable)


def _first_zero(system, t, y, is_open, curve, near):
    """The time after which the first open gap is zero, zero where none is about to close; and which one it is."""
    gap, closing = gaps(system, t, y.q), gap_rates(system, t, y.q, y.u)
    about_to = lax.stop_gradient(is_open & (gap <= near) & (closing < 0))
    first = jnp.argmin(jnp.where(about_to, -lax.stop_gradient(gap / closing), jnp.inf))
    any_one = about_to[first]
    g, v, a = (jnp.where(any_one, x[first], instead) for x, instead in ((gap, 0.0), (closing, -1.0), (curve, 0.0)))
    return -g / v - 0.5 * a * g**2 / v**3, about_to & (jnp.arange(gap.size) == first)


def _at_event(system, formulation, touch, t, y, modes, hit, free):
    """The state after an event that happens at a state, with impulses, modes, times of rest, the energy lost, and
    whether the problems had a solution.

    **Arguments:** `touch` [m, rad]; `modes` before; which contact is `hit`; `free`: second derivatives of gaps before.
    """
    contacts, q = contacts_of(system), y.q
    touching = (modes != OPEN) | hit | (gaps(system, t, q) <= touch)
    open_q = with_modes(system, q, OPEN)
    inertia = system.inertia(t, open_q, y.u)
    rows = gap_gradients(system, t, q, y.u)
    jacobian = binding_velocities(system, t, open_q, y.u).selected(system.velocity_rank, system.velocity_scale())
    projector = jacobian.projector(inertia)
    none = jnp.zeros(system.acceleration_rows, q.dtype)
    # The changes of velocities by unit impulses, with those that the other constraints answer with; in the last row the
    # change that these constraints ask for themselves.
    unmet = -velocity_rows(system, t, open_q, y.u)
    forces = jnp.concatenate([rows, jnp.zeros_like(rows[:1])])
    asked = jnp.concatenate([jnp.tile(none, (len(rows), 1)), unmet[None]])
    moves = jax.vmap(lambda force, rows: projector.solve(force, rows)[0])(forces, asked)
    moves, unbound = moves[:-1], y.u + moves[-1]
    influence = rows @ moves.T

    before = gap_rates(system, t, q, y.u)
    bounce = contacts.restitution * jnp.maximum(-before, 0.0)
    impulses, _, solvable = _complementary(influence, before + rows @ (unbound - y.u) - bounce, touching)
    struck = unbound + impulses @ moves
    udot = _free_acceleration(system, formulation, projector, t, open_q, struck)
    opening, rate = gap_accelerations(system, t, q, struck, udot), gap_rates(system, t, q, struck)
    sizes = jnp.abs(rows) @ (jnp.abs(struck) + jnp.abs(y.u))
    staying = touching & (rate <= _REST * sizes)
    # Contacts that would open by less than can be seen, before they close again, stay closed.
    falls = jnp.where(opening < 0, -opening, 1.0)
    low = touching & ~staying & (opening < 0) & (rate**2 <= 2 * falls * _BOUNCE * touch) & (contacts.restitution < 1)
    staying = staying | lax.stop_gradient(low)
    lost = jnp.where(jnp.any(low), solved_components(influence, rate, _independent(influence, staying)), 0.0)
    u, impulses = struck + lost @ moves, impulses + lost
    # Each bounce takes `restitution` times the time of the one before.
    bounces = lax.stop_gradient(low & (bounce > 0))
    ratio = jnp.where(bounces, contacts.restitution, 0.0)
    rest = jnp.where(bounces, 2 * rate / (falls * (1 - ratio)), 0.0)
    _, closed, held = _complementary(influence, opening, staying)
    implied = staying & ~closed & _is_implied(influence, closed)
    new = lax.stop_gradient(jnp.where(closed, CLOSED, jnp.where(implied, IMPLIED, OPEN))).astype(q.dtype)

    after = dataclasses.replace(y, q=with_modes(system, q, new), u=u)
    energy = 0.5 * (jnp.dot(y.u, inertia.product(y.u)) - jnp.dot(u, inertia.product(u)))
    return after, (impulses, new, lax.stop_gradient(rest), energy, solvable & held)


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
    if system.ideal and system.acceleration_rows == system.velocity_rows:
        gamma = -system.acceleration_residual(t, q, u, jnp.zeros_like(u))
        return projector.solve(system.force(t, q, u), gamma)[0]
    return accelerations(system, formulation, t, q, u)[0]


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
