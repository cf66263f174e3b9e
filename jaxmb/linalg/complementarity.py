"""Linear complementarity problems: `W x + b ≥ 0`, `x ≥ 0`, of which one is zero for each component; and such with
friction in two directions, whose force is in a circular cone.

Sources: R. W. Cottle, J.-S. Pang and R. E. Stone, "The Linear Complementarity Problem", SIAM, 2009, §4.4 (Lemke's
method); for friction F. Pfeiffer and Ch. Glocker, "Multibody Dynamics with Unilateral Contacts", Wiley, 1996, §6.3; for
the direction of slip P. Alart and A. Curnier, "A mixed formulation for frictional contact problems prone to Newton like
solution methods", Computer Methods in Applied Mechanics and Engineering 92, 1991.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .elimination import solve
from .rotations import norm

# Entries of a column below this multiple of its largest one are rounding errors, and no pivots.
_PIVOT = 1e-9
# Right-hand sides are displaced by this multiple of their largest entry, differently in each row, since equal ones
# could make the method return to where it was.
_APART = 1e-10
# Directions of slip are found when they change by less than this, in this many rounds at most, each with this many
# steps of Newton's method.
_TURN, _TURNS, _CORRECTIONS = 1e-7, 60, 2
# The least limit of a force across its direction, as a fraction of that along it.
_ACROSS = 0.01
# Where a force of friction in two directions has not the direction of slip, up to this fraction, there is no solution.
_ASIDE = 1e-8
# Several contacts that stick share forces that are not determined as if they yielded by this fraction of `W`.
_YIELD = 1e-8


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


def _product(a, b):
    """`a @ b`; XLA loses the types of LAPACK calls in programs with products of empty arrays (jaxlib 0.10)."""
    return a @ b if a.size and b.size else jnp.zeros((a.shape[0], b.shape[1]), a.dtype)


def _lemke(W, b):
    k, dtype = b.size, b.dtype
    right = b + _APART * jnp.max(jnp.abs(b), initial=0.0) * jnp.asarray(np.arange(1, k + 1) / k, dtype)
    # Columns: w, x, the artificial variable, the right-hand side; `basis`: the variable of each row.
    table = jnp.concatenate([jnp.eye(k, dtype=dtype), -W, -jnp.ones((k, 1), dtype), right[:, None]], axis=1)

    def proceed(carry):
        _, _, left, solvable, count = carry
        return (left != 2 * k) & solvable & (count < 20 + 10 * k)

    def advance(carry):
        table, basis, left, _, count = carry
        # At first the artificial variable enters, for the row that is furthest from a solution.
        is_first = count == 0
        entering = jnp.where(is_first, 2 * k, jnp.where(left < k, left + k, left - k))
        column, right = table[:, entering], table[:, -1]
        least = _PIVOT * jnp.max(jnp.abs(column), initial=0.0)
        ratio = jnp.where(column > least, right / jnp.where(column > least, column, 1.0), jnp.inf)
        ratio = jnp.where(is_first, right, ratio)
        # Of equal ratios the artificial variable leaves.
        tied = (basis == 2 * k) & (ratio <= jnp.min(ratio) * (1 + 1e-12) + jnp.finfo(dtype).tiny)
        row = jnp.where(jnp.any(tied), jnp.argmax(tied), jnp.argmin(ratio))
        solvable = jnp.isfinite(ratio[row])
        own, changes = np.arange(k) == row, solvable & (np.arange(k) == row)
        pivot = table[row] / table[row, entering]
        table = jnp.where(own[:, None], 0.0, table) + jnp.where(own, 1.0, -column)[:, None] * pivot[None, :]
        left = jnp.where(solvable, basis[row], left)
        return table, jnp.where(changes, entering, basis), left, solvable, count + 1

    # A solution without forces needs no step.
    left = jnp.where(jnp.min(right) >= 0, 2 * k, -1)
    first = table, jnp.arange(k), left, jnp.array(True), jnp.array(0)
    _, basis, left, solvable, _ = lax.while_loop(proceed, advance, first)
    found = jnp.any(basis[None, :] == np.arange(k, 2 * k)[:, None], axis=1)
    return found, solvable & (left == 2 * k)


class Dry(NamedTuple):
    """Laws of dry friction beside those of contacts.

    **Fields:** the number of the contact of each in `contacts`, -1 for one with a normal force of its own; `pairs`: the
    numbers of the first laws of those friction that has two, one after the other; the `coefficient`; where it `slips`,
    1 or -1, of pairs the components of a unit vector, and 0 where it may stick; the `bound` of the force, which that of
    the contact adds to.
    """

    contacts: tuple[int, ...]
    pairs: tuple[int, ...]
    coefficient: Float[Array, "m"]
    slips: Float[Array, "m"]
    bound: Float[Array, "m"]


class Answers(NamedTuple):
    """Which laws hold: contacts that are `closed`; friction that `sticks`; the direction in which other friction
    `slips`, 1 or -1, of pairs the components of a unit vector, and 0 where there is no force; whether there is a
    solution, and no contact that slips has two; friction of pairs that sticks as well, but is `implied` by others, to
    which its force is given.
    """

    closed: Bool[Array, "n"]
    sticks: Bool[Array, "m"]
    slips: Float[Array, "m"]
    solvable: Bool[Array, ""]
    implied: Bool[Array, "m"]


def frictional(W: Float[Array, "n_m n_m"], b: Float[Array, "n_m"], dry: Dry, among: Bool[Array, "n_m"]) -> Answers:
    """Which of some contacts with dry friction are closed, stick and slip; without derivative.

    **Arguments:** `W x + b`: accelerations or velocities along the normals and the slips, with their forces or
    impulses x; `among`: those that may have a force.
    """
    W, b, among, *numbers = lax.stop_gradient((W, b, among, *dry[2:]))
    dry = Dry(dry.contacts, dry.pairs, *numbers)
    return _in_directions(W, b, dry, among) if dry.pairs else _in_lines(W, b, dry, among)


def of_pairs(pairs: tuple[int, ...]) -> np.ndarray:
    """The numbers of both laws of each pair."""
    return np.array(pairs, int)[:, None] + np.arange(2)


def placed_pairs(pairs: tuple[int, ...], values: Array, others: Array, first: int = 0) -> Array:
    """Values of each law of `pairs`, shape (pairs, 2, …), among those of `others`, whose places they take; before them
    `first` zeros.
    """
    # A gather, which is compiled in less time than a scatter.
    m, own = len(others), of_pairs(pairs).reshape(-1)
    place = np.zeros(m, int)
    place[own] = np.arange(own.size)
    taken = values.reshape(-1, *values.shape[2:])[place]
    mask = np.isin(np.arange(m), own).reshape(-1, *(1,) * (values.ndim - 2))
    placed = jnp.where(mask, taken, others)
    return jnp.concatenate([jnp.zeros((first, *placed.shape[1:]), placed.dtype), placed]) if first else placed


def slip_direction(modes: Float[Array, "rows"], slip: Float[Array, "rows"]) -> Float[Array, "rows"]:
    """The unit vector against which dry friction acts, by its modes, which are whole numbers in one direction; zero
    where it sticks or is free.

    In two directions it is that of the slip, on the side of the modes, so that the force has no jump where slip passes
    through zero; where slip has just begun, or there is none, it is that of the modes.
    """
    if modes.size == 1:
        return jnp.where(jnp.abs(jnp.round(modes)) == 1, jnp.round(modes), 0.0)
    size, speed = norm(modes), norm(slip)
    slides = (size > 0.75) & (size < 1.5) & (speed > 0)
    sign = jnp.where(jnp.dot(lax.stop_gradient(slip), modes) < 0, -1.0, 1.0)
    own = sign * slip / jnp.where(slides, speed, 1.0)
    begun = modes / jnp.where(size > 0, size, 1.0)
    return jnp.where(slides, own, jnp.where(size < 1.5, begun, 0.0))


def _in_directions(W, b, dry, among):
    """`frictional` with pairs, in whose planes the first law acts along a direction of slip.

    Where that is found, the force of the second law is zero.
    """
    m, pairs = len(dry.contacts), of_pairs(dry.pairs)
    n = b.size - m
    both, contact = n + pairs, np.array(dry.contacts)[pairs[:, 0]]
    # The normal forces of others are not among the unknowns.
    of_contact = contact >= 0
    known, touches = dry.slips[pairs], among[both[:, 0]]
    may = touches & (known == 0).all(1)
    both_may = placed_pairs(dry.pairs, jnp.stack([touches, may], axis=1), among[n:])
    among = jnp.concatenate([among[:n], both_may])
    rigid = W
    if len(pairs) > 1:
        W = W + _YIELD * jnp.max(jnp.diag(W)) * jnp.diag(np.isin(np.arange(n + m), both).astype(W.dtype))
    # The inverse of the largest change of a slip by its force, at most.
    step = 1 / (W[both[:, 0], both[:, 0]] + W[both[:, 1], both[:, 1]])
    # Turned are pairs by `c` times the first matrix of each, and `s` times the second.
    others = np.diag(~np.isin(np.arange(n + m), both)).astype(W.dtype)
    turns = np.zeros((len(pairs), 2, n + m, n + m), W.dtype)
    for turn, (i, j) in zip(turns, both, strict=True):
        turn[0, [i, j], [i, j]], turn[1, [i, j], [j, i]] = 1, (1, -1)

    def in_lines(e, across):
        """The answers where pairs act along directions and across them, and the equations for the forces."""
        turn = others + jnp.tensordot(e, turns, 2)
        matrix, right = turn @ W @ turn.T, turn @ b
        share = jnp.where(np.isin(np.arange(m), pairs[:, 1]), across, 1.0)
        slips = turn[n:, n:] @ dry.slips
        laws = dry._replace(slips=slips, coefficient=dry.coefficient * share, bound=dry.bound * share)
        answers = _in_lines(matrix, right, laws, among)
        matrix, right = laws_of(matrix, right, laws, answers)
        return answers, matrix @ turn, right

    def direction(e, x):
        """Where slip goes if the force is the nearest one in the cone to what would end it."""
        ahead = step[:, None] * (W @ x + b)[both] - x[both]
        size = norm(ahead)
        return jnp.where((may & (size > 0))[:, None], ahead / jnp.where(size > 0, size, 1.0)[:, None], e)

    def with_slips(answers, e):
        """The answers with the laws of stick and slip of pairs, and which pairs slide in directions to be found."""
        sticks, closed = answers.sticks[pairs].all(1), jnp.concatenate([answers.closed, jnp.ones(1, bool)])
        # The last entry is that of friction without a contact.
        pressed = closed[contact] | (dry.bound[pairs[:, 0]] > 0)
        slips = jnp.where((touches & pressed & ~sticks)[:, None], jnp.where(may[:, None], e, known), 0.0)
        slips = placed_pairs(dry.pairs, slips, answers.slips)
        sticks_both = placed_pairs(dry.pairs, jnp.stack([sticks, sticks], axis=1), answers.sticks)
        return answers._replace(sticks=sticks_both, slips=slips), may & pressed & ~sticks

    def corrected(answers, e, x):
        """The equations of a step of Newton's method for the directions of slip and the forces."""
        laws, slides = with_slips(answers, e)
        matrix, right = laws_of(W, b, dry, laws)
        push = jnp.where(of_contact, jnp.maximum(x[contact], 0.0), 0.0)
        load = dry.bound[pairs[:, 0]] + dry.coefficient[pairs[:, 0]] * push
        rates = (W @ x + b)[both]
        # Along the direction the force is that of slip. Across, force and slip are zero together.
        across = jnp.stack([-e[:, 1], e[:, 0]], axis=1)
        speed = jnp.abs(jnp.sum(e * rates, axis=1))
        size = load / step + speed + jnp.finfo(b.dtype).tiny
        turned = (load / size)[:, None] * jnp.einsum("pi,pik->pk", across, W[both])
        turned = turned + (speed / size)[:, None] * jnp.einsum("pi,pik->pk", across, np.eye(n + m, dtype=b.dtype)[both])
        along = jnp.einsum("pi,pik->pk", e, matrix[both])
        rows = e[:, :, None] * along[:, None] + across[:, :, None] * turned[:, None]
        asked = -load / size * jnp.sum(across * b[both], axis=1)
        asked = e * jnp.sum(e * right[both], axis=1)[:, None] + across * asked[:, None]
        own = placed_pairs(dry.pairs, jnp.stack([slides, slides], axis=1), jnp.zeros(m, bool), first=n)
        rows = placed_pairs(dry.pairs, rows, matrix[n:], first=n)
        asked = placed_pairs(dry.pairs, asked, right[n:], first=n)
        return jnp.where(own[:, None], rows, matrix), jnp.where(own, asked, right)

    def advance(carry):
        e, _, _, _, count = carry
        # The force across is less and less, so that the square of both is near the circle.
        answers, *straight = in_lines(e, jnp.maximum(0.5**count, _ACROSS))

        def correct(k, own):
            last = direction(*own)
            e = jnp.where(k == 0, own[0], last)
            newton = corrected(answers, e, own[1])
            matrix, right = (jnp.where(k == 0, first, other) for first, other in zip(straight, newton, strict=True))
            return e, solve(matrix, right)

        _, x = lax.fori_loop(0, 1 + _CORRECTIONS, correct, (e, jnp.zeros_like(b)))
        new = direction(e, x)
        # Directions between which the method goes to and fro are halved.
        between = e + new
        size = norm(between)
        halved = (count % 4 == 3) & (size > 0.1)
        turned = jnp.max(jnp.abs(new - e))
        new = jnp.where(halved[:, None], between / jnp.where(size > 0, size, 1.0)[:, None], new)
        return new, answers, x, turned, count + 1

    start = jnp.where(may[:, None], b[both], known)
    size = norm(start)[:, None]
    start = jnp.where(size > 0, start / jnp.where(size > 0, size, 1.0), jnp.array([1.0, 0.0], b.dtype))
    nothing = jnp.zeros(m, b.dtype)
    none = Answers(jnp.zeros(n, bool), nothing > 0, nothing, jnp.array(True), nothing > 0)
    first = start, none, jnp.zeros_like(b), jnp.array(jnp.inf, b.dtype), jnp.array(0)
    _, answers, x, turned, _ = lax.while_loop(lambda own: (own[3] > _TURN) & (own[4] < _TURNS), advance, first)
    found, slides = with_slips(answers, direction(start, x))
    if len(pairs) > 1:
        found = _with_implied(rigid, found)
    e, rates = found.slips[pairs], (W @ x + b)[both]
    aside, back = jnp.abs(e[:, 0] * x[both[:, 1]] - e[:, 1] * x[both[:, 0]]), jnp.sum(e * rates, axis=1)
    wrong = (aside > _ASIDE * jnp.max(jnp.abs(x))) | (back < -_ASIDE * jnp.max(jnp.abs(b)))
    solvable = found.solvable & (turned <= _TURN) & ~jnp.any(slides & wrong) & jnp.all(jnp.isfinite(x))
    return found._replace(solvable=solvable)


def _with_implied(W, answers):
    """With as many laws of stick as are independent of each other and of the contacts."""
    n, sticks = answers.closed.size, answers.sticks
    closed = jnp.concatenate([answers.closed, jnp.zeros_like(sticks)])
    columns = jnp.where(closed[:, None], W, 0.0)
    matrix = jnp.where(closed[:, None] & closed[None, :], W, jnp.eye(W.shape[0], dtype=W.dtype))
    left = (W - columns.T @ solve(matrix, columns))[n:, n:]
    own = independent_components(left, sticks)
    return answers._replace(sticks=own, implied=sticks & ~own)


def independent_components(W: Float[Array, "k k"], among: Bool[Array, "k"]) -> Bool[Array, "k"]:
    """Some components whose columns are independent, of which those of all others among some are combinations; for a
    positive semidefinite W; without derivative.
    """
    W, among = lax.stop_gradient((W, among))
    scale = _scale(W)

    def advance(_, carry):
        # The Cholesky factorisation with pivots: the next one is furthest from the span of those before it.
        left, found, others = carry
        rest = jnp.where(others, jnp.diag(left), 0.0)
        own = jnp.argmax(rest)
        is_own, pivot = np.arange(among.size) == own, rest[own]
        is_pivot = pivot > _PIVOT
        left = left - left[:, own, None] * (left[own] / jnp.where(is_pivot, pivot, jnp.inf))[None, :]
        return left, found | (is_own & is_pivot), others & ~is_own

    first = W / scale[:, None] / scale[None, :], jnp.zeros_like(among), among
    return lax.fori_loop(0, among.size, advance, first)[1]


def _in_lines(W, b, dry, among):
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
    to_normal, to_slip = W[:, :n] + _product(W[:, n:], of_normal), W[:, n:] @ of_right
    # A normal force whose own friction draws the bodies together more than it pushes them apart, in Painlevé's paradox,
    # has no value or two.
    of_itself = jnp.diag(W[:n, :n] + _product(W[:n, n:], jnp.where(may[:, None], 0.0, of_normal)))
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
    pressed = jnp.any(closed[None, :] & (normal > 0), axis=1) | (np.array(dry.contacts) < 0) | (bound > 0)
    force = among[n:] & pressed
    sticks = force & may & inside & ~backward
    direction = jnp.where(may, jnp.where(backward, -1.0, 1.0), dry.slips)
    slips = jnp.where(force & ~sticks, direction, 0.0)
    return Answers(closed & ~idle, sticks, slips, solvable & unique, jnp.zeros(m, bool))


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
    of_normal = np.zeros((n + m, n + m), b.dtype)
    for k, contact in enumerate(dry.contacts):
        if contact >= 0:
            of_normal[n + k, contact] = 1
    slope = jnp.concatenate([jnp.zeros(n, b.dtype), dry.coefficient * answers.slips])
    law = np.eye(n + m, dtype=b.dtype) + slope[:, None] * of_normal
    bounds = jnp.concatenate([jnp.zeros(n, b.dtype), -dry.bound * answers.slips])
    return jnp.where(held[:, None], W, law), jnp.where(held, -b, bounds)


def solved_components(W: Float[Array, "k k"], b: Float[Array, "k"], positive: Bool[Array, "k"]) -> Float[Array, "k"]:
    """x with `W x + b = 0` in these components and zero in the others; differentiable."""
    both = positive[:, None] & positive[None, :]
    matrix = jnp.where(both, W, jnp.eye(b.size, dtype=b.dtype))
    return solve(matrix, jnp.where(positive, -b, 0.0))
