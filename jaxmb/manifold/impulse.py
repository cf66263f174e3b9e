"""Jumps of prescribed rates: the velocities after them, and a search for them."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._types import Scalar, State
from ..linalg.elimination import solve_positive
from ..system import AbstractSystem
from ..system.padded_rows import binding_velocities, velocity_rows
from .orthogonal_projection import independent_rows

# A jump is looked for in this number of intervals, and the one chosen is halved so often.
_INTERVALS, _HALVINGS = 256, 32
# Variations smaller than this fraction of the largest value are not looked at.
_VISIBLE = 1e-6


def after_impulse(system: AbstractSystem, t: Scalar, y: State) -> State:
    """The state just after a time at which prescribed rates jump: `M (u⁺ − u⁻) = Aᵀ Λ`, `ψ(t, q, u⁺) = 0`.

    Where no rate jumps the impulses Λ are zero. Constraints are taken as ideal.

    Source: L. A. Pars, "A Treatise on Analytical Dynamics", Heinemann, 1965 (impulsive motion).
    """
    u, inertia = y.u, system.inertia(t, y.q, y.u)
    if system.elimination is not None:
        projector = binding_velocities(system, t, y.q, u).projector(inertia)
        change, _ = projector.solve(jnp.zeros_like(u), -velocity_rows(system, t, y.q, u))
        return dataclasses.replace(y, u=u + change)
    for _ in range(1 if system.linear else 3):
        jacobian = system.velocity_jacobian(t, y.q, u)
        rows = independent_rows(jacobian, system.velocity_scale(), system.velocity_rank)
        per_impulse = inertia.solve(jacobian[rows].T)
        residual = system.velocity_residual(t, y.q, u)[rows]
        u = u - per_impulse @ solve_positive(jacobian[rows] @ per_impulse, residual)
    return dataclasses.replace(y, u=u)


def find_jump(
    system: AbstractSystem, q: Float[Array, "nq"], t0: Scalar, t1: Scalar
) -> tuple[Float[Array, ""], Int[Array, ""], Bool[Array, ""]]:
    """Look for a time between two others at which a prescribed rate, or its derivative, jumps.

    Of all rows that with the largest share of its variation in one of many equal intervals is followed into the half
    that varies more, again and again: a smooth function varies less and less, one that jumps as before.

    **Returns:** the time, the number of the row among those of ψ and of A one after the other, and whether it jumps.
    """
    return _find_jump(system, q, jnp.asarray(t0, q.dtype), jnp.asarray(t1, q.dtype))


@eqx.filter_jit
def _find_jump(system, q, t0, t1):
    rest = jnp.zeros(system.nu, q.dtype)

    def prescribed(t):
        return jnp.concatenate([system.velocity_residual(t, q, rest), system.acceleration_residual(t, q, rest, rest)])

    grid = jnp.linspace(t0, t1, _INTERVALS + 1)
    values = jax.vmap(prescribed)(grid)
    changes = jnp.abs(jnp.diff(values, axis=0))
    visible = jnp.max(changes, axis=0) > _VISIBLE * jnp.max(jnp.abs(values))
    share = jnp.where(visible, jnp.max(changes, axis=0) / jnp.sum(changes, axis=0), 0.0)
    row = jnp.argmax(share)
    k = jnp.argmax(changes[:, row])

    def halve(_, ends):
        a, b = ends
        middle = 0.5 * (a + b)
        first, second, third = jax.vmap(prescribed)(jnp.stack([a, middle, b]))[:, row]
        left = jnp.abs(second - first) > jnp.abs(third - second)
        return jnp.where(left, a, middle), jnp.where(left, middle, b)

    a, b = lax.fori_loop(0, _HALVINGS, halve, (grid[k], grid[k + 1]))
    left = jnp.abs(prescribed(b)[row] - prescribed(a)[row])
    return b, row, visible[row] & (left > 0.5 * changes[k, row])
