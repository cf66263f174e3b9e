"""The balance of actuators and constraints with the forces of a motion.

    Bᵀ τ + Aᵀ λ = r = M u̇ − F,    so    (B R)ᵀ τ = Rᵀ r

The rows of B are the rates of the actuators' quantities by u. R spans the admissible velocities, `A R = 0`, and comes
from the elimination that partitions velocities: the second equation balances virtual powers. A and F contain neither
the constraints nor the forces of named drives.

Source: J. García de Jalón and E. Bayo, "Kinematic and Dynamic Simulation of Multibody Systems", Springer, 1994, §6.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ..._compat import with_rest_computed
from ..._types import Scalar, State
from ...formulations.friction import find_multipliers
from ...formulations.laws import laws_of
from ...formulations.shares import least_multipliers
from ...linalg.elimination import Factor, eliminate, full_pivot, solve
from ...linalg.jitted import jitted
from ...linalg.members import vmap_states
from ...linalg.newton import root
from ...linalg.orthogonal import orthogonal_basis
from ...linalg.rotations import norm
from ...linalg.sums import unchecked_take
from ...system import AbstractSystem, with_parameters
from ...system.instant import Instant
from .course import Course, have_pivots
from .drives import Drive

# An actuator moves nothing if its rate is below this part of the rate of free bodies.
_HELD = 1e-8
# Forces are proportional to a parameter up to this part of them.
_PROPORTIONAL = 1e-9

Drives = tuple[Drive, ...]


class Found(NamedTuple):
    """What was found out at each time.

    **Fields:** violations of `positions`, `velocities` and `accelerations`, relative to the sizes of the motion; the
    `gaps` of contacts, relative to the system's size; whether the constraints are `regular`; which actuators drive by
    themselves (`drives`), and which velocities are not free (`bound`); which actuators the constraints have `held`;
    whether friction `failed` to be determined; whether forces are `proportional` to the parameters.
    """

    positions: Float[Array, "*times mp"]
    velocities: Float[Array, "*times mv"]
    accelerations: Float[Array, "*times m"]
    gaps: Float[Array, "*times contacts"]
    regular: Bool[Array, "*times"]
    drives: Bool[Array, "*times k"]
    bound: Bool[Array, "*times nu"]
    held: Bool[Array, "*times k"]
    failed: Bool[Array, "*times"]
    proportional: Bool[Array, "*times"]

    def against(self, path: Course, tolerance: float) -> Bool[Array, "times"]:
        """At which times there is no solution."""
        within = lambda x: jnp.all(jnp.abs(x) <= tolerance, axis=1)
        made = within(self.positions) & within(self.velocities) & within(self.accelerations) & within(path.off)
        made = made & jnp.all(self.gaps >= -tolerance, axis=1)
        driven = self.regular & jnp.all(self.bound, axis=1) & ~self.failed & self.proportional
        return ~(made & path.met & driven)


@jitted
def balanced(
    system: AbstractSystem, rest: AbstractSystem, drives: Drives, spread: Float[Array, "k"], path: Course
) -> tuple[Float[Array, "times k"], Float[Array, "times k"], Float[Array, "times rows"], Found]:
    """Forces of actuators, their powers and multipliers along a motion, and what was found out about it.

    **Arguments:** the `system`; `rest`: the system without its drives; `spread`: the inverse roots of the weights.
    """

    def single(t, y, udot):
        at = _instant(rest, drives, t, y)
        B = _rows(system, drives, at)
        found, factor = _seen(at, B, udot)
        inertia, R = at.inertia.product(udot), factor.null_space

        def balance(force):
            """Forces of actuators and multipliers that balance an applied force."""
            unbalanced = inertia - force
            tau = _least(B @ R, R.T @ unbalanced, spread)
            return tau, (factor.right_inverse.T @ (unbalanced - B.T @ tau))[: rest.acceleration_rows]

        tau, multipliers, failed = _with_friction(at, balance)
        found = found._replace(failed=failed, proportional=_is_proportional(at, drives, B, tau))
        return tau, tau * (B @ at.u), least_multipliers(at, multipliers), found

    numbers = (rest.acceleration_rows + spread.size) * rest.nu
    return vmap_states(single, numbers)(path.ts, path.ys, path.accelerations)


@jitted
def searched(system: AbstractSystem, rest: AbstractSystem, drives: Drives, t: Scalar, y: State) -> Found:
    """What can be found out about one instant without a solution."""
    at = _instant(rest, drives, t, y)
    return _seen(at, _rows(system, drives, at), jnp.zeros_like(at.u))[0]


def _instant(rest, drives, t, y) -> Instant:
    """The instant with zeros in the parameters that are sought."""
    zeros = {drive.where: jnp.zeros(drive.shape, y.q.dtype) for drive in drives if drive.of == "parameter"}
    return Instant.of(with_parameters(rest, zeros) if zeros else rest, jnp.asarray(t, y.q.dtype), y)


def _rows(system, drives, at) -> Float[Array, "k nu"]:
    return jnp.concatenate([drive.rows(system, at) for drive in drives])


def _seen(at: Instant, B, udot) -> tuple[Found, Factor]:
    """What is known without a solution, and the factor of A, followed by zeros for B."""
    rank, m, scale = at.system.acceleration_rank, at.system.acceleration_rows, at.system.velocity_scale()
    rows = jnp.concatenate([at.jacobian, B])
    search = full_pivot(rows, scale=scale, level=jnp.asarray(np.arange(rows.shape[0]) >= m, int))
    factor = eliminate(rows, search.order, rank)
    has_pivot, bound = have_pivots(search)
    regular = (jnp.sum(has_pivot[:m]) == rank) & jnp.all(search.order.rows[:rank] < m)
    moved = jnp.abs(B @ factor.null_space) * scale[search.order.columns[rank:]][None, :]
    held = jnp.max(moved, axis=1, initial=0.0) <= _HELD * norm(B * scale[None, :])
    fine = jnp.array(True)
    return Found(*_violations(at, udot, scale), _gaps(at), regular, has_pivot[m:], bound, held, ~fine, fine), factor


def _gaps(at: Instant):
    """The gaps of contacts, relative to the system's size."""
    contacts = at.system.contacts
    if not contacts.n:
        return jnp.zeros(0, at.q.dtype)
    sizes = at.with_(q=contacts.bound(at.q)).row_sizes()[np.array(contacts.rows[: contacts.n])]
    return at.gaps / sizes


def _violations(at: Instant, udot, scale):
    """Residuals of positions, velocities and accelerations, relative to the sizes of the motion."""
    unmet = jnp.abs(at.acceleration_residual(udot))
    if not at.system.acceleration_rows:
        return at.position_residual, at.velocity_residual, unmet
    largest = lambda x: jnp.max(jnp.abs(x) / scale)
    size = largest(udot) + largest(at.u) ** 2
    if at.system.positive_definite_mass:
        size = size + largest(at.inertia.solve(at.force))
    sizes = at.structured_jacobian.row_norms(scale) * jnp.where(size > 0, size, 1.0)
    positions, velocities = at.violations(at.row_sizes()) if at.system.velocity_rows else (unmet[:0], unmet[:0])
    return positions, velocities, unmet / jnp.maximum(sizes, jnp.finfo(sizes.dtype).tiny)


def _least(G: Float[Array, "k f"], power: Float[Array, "f"], spread: Float[Array, "k"]) -> Float[Array, "k"]:
    """τ of `Gᵀ τ = power` with the least norm of `τ / spread`."""
    if G.shape[0] == G.shape[1]:
        return solve(G.T, power)
    return spread * (orthogonal_basis(spread[:, None] * G).pseudoinverse.T @ power)


def _with_friction(at: Instant, balance: Callable[[Array], tuple[Array, Array]]) -> tuple[Array, Array, Any]:
    """Forces of actuators and multipliers, with the forces of constraints that are not ideal, and whether these are
    undetermined.
    """
    laws, rows = laws_of(at.system), at.system.friction_rows
    if not rows.size:
        return *balance(laws.applied(at, None)), jnp.array(False)
    fixed, contacts = lax.stop_gradient(at), at.system.contacts
    reactions = lambda force: lax.stop_gradient(unchecked_take(balance(force)[1], rows))
    law = with_rest_computed(fixed.friction_force, reactions(fixed.force))
    influence = jax.jacfwd(lambda force: unchecked_take(balance(force)[1], rows))(fixed.force)
    pushes = np.isin(rows, contacts.rows[: contacts.n])
    near, _, failed = find_multipliers(law, lax.stop_gradient(influence), reactions(fixed.force), pushes)
    solved = lambda memory: balance(laws.applied(at, memory))
    residual: Any = lambda memory: memory - laws.remembered(at, solved(memory)[1])
    return *solved(root(residual, near, lambda _, start: start)), failed


def _is_proportional(at: Instant, drives: Drives, B, tau) -> Bool[Array, ""]:
    """Whether the applied forces with the values of parameters are as B says."""
    ends = np.cumsum([drive.size for drive in drives])
    values = zip(drives, jnp.split(tau, ends[:-1]), jnp.split(B, ends[:-1]), strict=True)
    chosen = [(drive, force, rows) for drive, force, rows in values if drive.of == "parameter"]
    if not chosen:
        return jnp.array(True)
    rest: Any = at.system
    system = with_parameters(rest, {drive.where: force.reshape(drive.shape) for drive, force, _ in chosen})
    expected = sum((force @ rows for _, force, rows in chosen), start=at.force)
    off = jnp.max(jnp.abs(system.force(at.t, at.q, at.u) - expected))
    return off <= _PROPORTIONAL * (jnp.max(jnp.abs(expected)) + jnp.max(jnp.abs(at.force)))
