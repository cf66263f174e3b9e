"""Linear complementarity problems: `W x + b ≥ 0`, `x ≥ 0`, of which one is zero for each component.

Sources: R. W. Cottle, J.-S. Pang and R. E. Stone, "The Linear Complementarity Problem", SIAM, 2009, §4.4 (Lemke's
method); for friction F. Pfeiffer and Ch. Glocker, "Multibody Dynamics with Unilateral Contacts", Wiley, 1996, §6.3.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

# Entries of a column below this multiple of its largest one are rounding errors, and no pivots.
_PIVOT = 1e-9
# Right-hand sides are displaced by this multiple of their largest entry, differently in each row, since equal ones
# could make the method return to where it was.
_APART = 1e-10


def positive_components(W: Float[Array, "k k"], b: Float[Array, "k"]) -> tuple[Bool[Array, "k"], Bool[Array, ""]]:
    """Which components of the solution are not zero, and whether there is a solution; without derivative.

    The columns of W of these components are independent, also where W is singular. For a positive semidefinite W there
    is a solution if any x ≥ 0 has `W x + b ≥ 0`; for others the method may end without one.
    """
    W, b = lax.stop_gradient((W, b))
    scale = _scale(W)
    return _lemke(W / scale[:, None] / scale[None, :], b / scale)


def _scale(W):
    return jnp.sqrt(jnp.maximum(jnp.diag(W), jnp.finfo(W.dtype).tiny))


def _lemke(W, b):
    k, dtype = b.size, b.dtype
    right = b + _APART * jnp.max(jnp.abs(b), initial=0.0) * jnp.asarray(np.arange(1, k + 1) / k, dtype)
    # Columns: w, x, the artificial variable, the right-hand side; `basis`: the variable of each row.
    table = jnp.concatenate([jnp.eye(k, dtype=dtype), -W, -jnp.ones((k, 1), dtype), right[:, None]], axis=1)

    def pivoted(table, basis, row, column):
        own = table[row] / table[row, column]
        table = table - table[:, column][:, None] * own[None, :]
        return table.at[row].set(own), basis.at[row].set(column), basis[row]

    def proceed(carry):
        _, _, left, solvable, count = carry
        return (left != 2 * k) & solvable & (count < 20 + 10 * k)

    def advance(carry):
        table, basis, left, _, count = carry
        entering = jnp.where(left < k, left + k, left - k)
        column, right = table[:, entering], table[:, -1]
        least = _PIVOT * jnp.max(jnp.abs(column), initial=0.0)
        ratio = jnp.where(column > least, right / jnp.where(column > least, column, 1.0), jnp.inf)
        # Of equal ratios the artificial variable leaves.
        tied = (basis == 2 * k) & (ratio <= jnp.min(ratio) * (1 + 1e-12) + jnp.finfo(dtype).tiny)
        row = jnp.where(jnp.any(tied), jnp.argmax(tied), jnp.argmin(ratio))
        solvable = jnp.isfinite(ratio[row])
        new = pivoted(table, basis, row, entering)
        kept = lambda new, old: jnp.where(solvable, new, old)
        return kept(new[0], table), kept(new[1], basis), kept(new[2], left), solvable, count + 1

    basis, row = jnp.arange(k), jnp.argmin(right)
    nothing = right[row] >= 0
    started = pivoted(table, basis, row, 2 * k)
    table, basis, left = (
        jnp.where(nothing, old, new) for new, old in zip(started, (table, basis, jnp.asarray(2 * k)), strict=True)
    )
    _, basis, left, solvable, _ = lax.while_loop(proceed, advance, (table, basis, left, jnp.array(True), jnp.array(0)))
    found = jnp.zeros(2 * k + 1, bool).at[basis].set(True)[k : 2 * k]
    return found, solvable & (left == 2 * k)


class Dry(NamedTuple):
    """Laws of dry friction beside those of contacts.

    **Fields:** the number of the contact of each in `contacts`, -1 for one with a normal force of its own; the
    `coefficient`; where it `slips`, 1 or -1, and 0 where it may stick; the `bound` of the force of those without a
    contact.
    """

    contacts: tuple[int, ...]
    coefficient: Float[Array, "m"]
    slips: Float[Array, "m"]
    bound: Float[Array, "m"]


class Answers(NamedTuple):
    """Which laws hold: contacts that are `closed`; friction that `sticks`; the direction in which other friction
    `slips`, 1 or -1, and 0 where there is no force; whether there is a solution, and no contact that slips has two.
    """

    closed: Bool[Array, "n"]
    sticks: Bool[Array, "m"]
    slips: Float[Array, "m"]
    solvable: Bool[Array, ""]


def frictional(W: Float[Array, "n_m n_m"], b: Float[Array, "n_m"], dry: Dry, among: Bool[Array, "n_m"]) -> Answers:
    """Which of some contacts with dry friction are closed, stick and slip; without derivative.

    **Arguments:** `W x + b`: accelerations or velocities along the normals and the slips, with their forces or
    impulses x; `among`: those that may have a force.
    """
    W, b, among, *numbers = lax.stop_gradient((W, b, among, *dry[1:]))
    dry = Dry(dry.contacts, *numbers)
    m = len(dry.contacts)
    n, none = b.size - m, jnp.zeros((), b.dtype)
    scale = jnp.where(among, _scale(W), 1.0)
    both = among[:, None] & among[None, :]
    W = jnp.where(both, W / scale[:, None] / scale[None, :], 0.0)
    b = jnp.where(among, b / scale, 0.0)
    bound = jnp.where(among[n:], dry.bound * scale[n:], 0.0)
    size = jnp.max(jnp.abs(jnp.concatenate([b, bound])), initial=0.0)
    size = jnp.where(size > 0, size, 1.0)
    b, bound = b / size, bound / size
    # The force of friction is `right - coefficient normal - bound`, or that of slip, with `right >= 0` and
    # `left = 2 coefficient normal + 2 bound - right >= 0`; slip accelerates forwards or backwards where one is zero.
    normal = np.zeros((m, n))
    for k, contact in enumerate(dry.contacts):
        if contact >= 0:
            normal[k, contact] = 1
    ratio = scale[n:, None] / jnp.where(among[:n], scale[:n], 1.0)[None, :]
    limits = dry.coefficient[:, None] * normal * ratio
    may = among[n:] & (dry.slips == 0)
    sign = jnp.where(dry.slips == 0, 1.0, dry.slips)
    of_normal, fixed = -sign[:, None] * limits, -sign * bound
    of_right = jnp.diag(may.astype(b.dtype))
    to_normal, to_slip = W[:, :n] + W[:, n:] @ of_normal, W[:, n:] @ of_right
    # A normal force whose own friction draws the bodies together more than it pushes them apart, in Painlevé's paradox,
    # has no value or two.
    of_itself = jnp.diag(W[:n, :n] + W[:n, n:] @ jnp.where(may[:, None], 0.0, of_normal))
    unique = jnp.all(of_itself >= -_PIVOT)
    free = b + W[:, n:] @ fixed
    idle = ~among[:n]
    rows_n = jnp.concatenate(
        [jnp.where(idle[:, None], jnp.eye(n, dtype=b.dtype), to_normal[:n]), to_slip[:n], jnp.zeros((n, m))], axis=1
    )
    one = jnp.eye(m, dtype=b.dtype)
    own = may[:, None]
    rows_r = jnp.concatenate(
        [jnp.where(own, to_normal[n:], none), jnp.where(own, to_slip[n:], one), jnp.where(own, one, none)], axis=1
    )
    rows_l = jnp.concatenate(
        [jnp.where(own, 2 * limits, none), jnp.where(own, -one, none), jnp.where(own, none, one)], axis=1
    )
    right = jnp.concatenate(
        [jnp.where(idle, 1.0, free[:n]), jnp.where(may, free[n:], 1.0), jnp.where(may, 2 * bound, 1.0)]
    )
    found, solvable = _lemke(jnp.concatenate([rows_n, rows_r, rows_l]), right)
    closed, inside, backward = found[:n], found[n : n + m], found[n + m :]
    pressed = jnp.any(closed[None, :] & (normal > 0), axis=1) | (np.array(dry.contacts) < 0)
    force = among[n:] & pressed
    sticks = force & may & inside & ~backward
    direction = jnp.where(may, jnp.where(backward, -1.0, 1.0), dry.slips)
    return Answers(closed & ~idle, sticks, jnp.where(force & ~sticks, direction, 0.0), solvable & unique)


def laws_of(
    W: Float[Array, "n_m n_m"], b: Float[Array, "n_m"], dry: Dry, answers: Answers
) -> tuple[Float[Array, "n_m n_m"], Float[Array, "n_m"]]:
    """The matrix and the right-hand side of the linear equations for the forces, or impulses, x of contacts and
    friction of which it is known which laws hold; differentiable.

    **Arguments:** see `frictional`; of `dry` the coefficients and bounds of slip.
    """
    m = len(dry.contacts)
    n = b.size - m
    held = jnp.concatenate([answers.closed, answers.sticks])
    law = jnp.eye(n + m, dtype=b.dtype)
    for k, contact in enumerate(dry.contacts):
        if contact >= 0:
            law = law.at[n + k, contact].set(dry.coefficient[k] * answers.slips[k])
    bounds = jnp.concatenate([jnp.zeros(n, b.dtype), -dry.bound * answers.slips])
    return jnp.where(held[:, None], W, law), jnp.where(held, -b, bounds)


def solved_components(W: Float[Array, "k k"], b: Float[Array, "k"], positive: Bool[Array, "k"]) -> Float[Array, "k"]:
    """x with `W x + b = 0` in these components and zero in the others; differentiable."""
    both = positive[:, None] & positive[None, :]
    matrix = jnp.where(both, W, jnp.eye(b.size, dtype=b.dtype))
    return jnp.linalg.solve(matrix, jnp.where(positive, -b, 0.0))
