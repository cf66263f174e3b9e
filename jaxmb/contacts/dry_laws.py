"""Which laws of contacts and dry friction hold: contacts that are closed, friction that sticks or slips in a direction.

Source: F. Pfeiffer and Ch. Glocker, "Multibody Dynamics with Unilateral Contacts", Wiley, 1996, §6.3.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..linalg.complementarity import PIVOT, lemke, scale_of


class Dry(NamedTuple):
    """Laws of dry friction beside the laws of contacts.

    **Fields:** `contact_of`: the index of each law's contact, -1 for friction with its own normal force; `pairs`: the
    index of the first of two successive laws, for friction in two directions; the `coefficient`; `slips`: 1 or -1 where
    friction slips, for pairs the components of a unit vector, and 0 where it may stick; `bound`: the limit of the force
    without its contact, which adds `coefficient` times its own force.
    """

    contact_of: tuple[int, ...]
    pairs: tuple[int, ...]
    coefficient: Float[Array, "m"]
    slips: Float[Array, "m"]
    bound: Float[Array, "m"]


class Answers(NamedTuple):
    """Which laws hold.

    **Fields:** contacts that are `closed`; friction that `sticks`; `slips`: the direction of sliding friction, 1 or -1,
    for pairs a unit vector, and 0 without force; `solvable`: a solution exists, and is unique for slipping contacts;
    `implied`: pairs whose sticking follows from other laws, which carry their force.
    """

    closed: Bool[Array, "n"]
    sticks: Bool[Array, "m"]
    slips: Float[Array, "m"]
    solvable: Bool[Array, ""]
    implied: Bool[Array, "m"]


def in_lines(W: Float[Array, "n_m n_m"], b: Float[Array, "n_m"], dry: Dry, among: Bool[Array, "n_m"]) -> Answers:
    """`frictional` where each law acts along one direction."""
    m = len(dry.contact_of)
    n, none = b.size - m, jnp.zeros((), b.dtype)
    scale = jnp.where(among, scale_of(W), 1.0)
    both = among[:, None] & among[None, :]
    W = jnp.where(both, W / scale[:, None] / scale[None, :], 0.0)
    b = jnp.where(among, b / scale, 0.0)
    bound = jnp.where(among[n:], dry.bound * scale[n:], 0.0)
    size = jnp.max(jnp.abs(jnp.concatenate([b, bound])), initial=0.0)
    size = jnp.where(size > 0, size, 1.0)
    b, bound = b / size, bound / size
    # The force of friction is `right - coefficient normal - bound`, or the force of slip, with `right >= 0` and `left =
    # 2 coefficient normal + 2 bound - right >= 0`. Slip accelerates forwards or backwards if one of them is zero.
    normal = np.zeros((m, n))
    for k, contact in enumerate(dry.contact_of):
        if contact >= 0:
            normal[k, contact] = 1
    ratio = scale[n:, None] / jnp.where(among[:n], scale[:n], 1.0)[None, :]
    limits = dry.coefficient[:, None] * normal * ratio
    may = among[n:] & (dry.slips == 0)
    sign = jnp.where(dry.slips == 0, 1.0, dry.slips)
    of_normal, fixed = -sign[:, None] * limits, -sign * bound
    of_right = jnp.diag(may.astype(b.dtype))
    to_normal, to_slip = W[:, :n] + _product(W[:, n:], of_normal), W[:, n:] @ of_right
    # In Painlevé's paradox the friction of a normal force draws the bodies together more than the force pushes them
    # apart: the force has no value or two.
    of_itself = jnp.diag(W[:n, :n] + _product(W[:n, n:], jnp.where(may[:, None], 0.0, of_normal)))
    unique = jnp.all(of_itself >= -PIVOT)
    free = b + W[:, n:] @ fixed
    idle = ~among[:n]
    rows_n = jnp.concatenate(
        [jnp.where(idle[:, None], jnp.eye(n, dtype=b.dtype), to_normal[:n]), to_slip[:n], jnp.zeros((n, m))], axis=1
    )
    one, open_ = jnp.eye(m, dtype=b.dtype), may[:, None]
    rows_r = jnp.concatenate(
        [jnp.where(open_, to_normal[n:], none), jnp.where(open_, to_slip[n:], one), jnp.where(open_, one, none)], axis=1
    )
    rows_l = jnp.concatenate(
        [jnp.where(open_, 2 * limits, none), jnp.where(open_, -one, none), jnp.where(open_, none, one)], axis=1
    )
    right = jnp.concatenate(
        [jnp.where(idle, 1.0, free[:n]), jnp.where(may, free[n:], 1.0), jnp.where(may, 2 * bound, 1.0)]
    )
    nonbasic, solvable = lemke(jnp.concatenate([rows_n, rows_r, rows_l]), right)
    closed, inside, backward = nonbasic[:n], nonbasic[n : n + m], nonbasic[n + m :]
    pressed = jnp.any(closed[None, :] & (normal > 0), axis=1) | (np.array(dry.contact_of) < 0) | (bound > 0)
    force = among[n:] & pressed
    sticks = force & may & inside & ~backward
    direction = jnp.where(may, jnp.where(backward, -1.0, 1.0), dry.slips)
    slips = jnp.where(force & ~sticks, direction, 0.0)
    return Answers(closed & ~idle, sticks, slips, solvable & unique, jnp.zeros(m, bool))


def laws_of(
    W: Float[Array, "n_m n_m"], b: Float[Array, "n_m"], dry: Dry, answers: Answers
) -> tuple[Float[Array, "n_m n_m"], Float[Array, "n_m"]]:
    """The matrix and the right-hand side of the linear equations for the forces, or impulses, x of contacts and
    friction, given which laws hold; differentiable.

    **Arguments:** see `frictional`; `dry` has the coefficients and bounds of slip.
    """
    m = len(dry.contact_of)
    n = b.size - m
    is_held = jnp.concatenate([answers.closed, answers.sticks])
    of_normal = np.zeros((n + m, n + m), b.dtype)
    for k, contact in enumerate(dry.contact_of):
        if contact >= 0:
            of_normal[n + k, contact] = 1
    slope = jnp.concatenate([jnp.zeros(n, b.dtype), dry.coefficient * answers.slips])
    law = np.eye(n + m, dtype=b.dtype) + slope[:, None] * of_normal
    bounds = jnp.concatenate([jnp.zeros(n, b.dtype), -dry.bound * answers.slips])
    return jnp.where(is_held[:, None], W, law), jnp.where(is_held, -b, bounds)


def _product(a, b):
    """`a @ b`; XLA loses the types of LAPACK calls in programs with products of empty arrays (jaxlib 0.10)."""
    return a @ b if a.size and b.size else jnp.zeros((a.shape[0], b.shape[1]), a.dtype)
