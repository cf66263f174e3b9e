"""Forces of contacts and dry friction at a state, and their sizes of comparison."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..formulations import Multipliers
from ..formulations.laws import accelerations_at
from ..linalg.elimination import solve
from ..linalg.pairs import sizes_of
from ..linalg.rotations import norm
from ..system.instant import Instant

# Forces of several contacts that stick are the smallest possible up to this fraction of them.
_YIELD = 1e-10


def largest_force(at: Instant, multipliers):
    """The size to which forces are compared."""
    largest = jnp.max(jnp.abs(multipliers)) + jnp.max(jnp.abs(at.force))
    hold = sticking(at).force
    # No other force may act.
    largest = largest if hold is None else largest + jnp.max(hold)
    return largest + jnp.finfo(largest.dtype).tiny


def reserves(at: Instant, multipliers):
    """The forces [N] of contacts, and the reserve of sticking friction forces below their limits."""
    contacts = at.system.contacts
    forces, n = contacts.at_rows(multipliers), contacts.n
    if not contacts.m:
        return forces
    normal, dry = norm(at.friction_reactions(multipliers)), forces[n:]
    if len(contacts.pairs) > 1:
        # Undetermined forces are as small as possible.
        stick = contacts.modes(at.q).held
        gradients = jnp.where(stick[:, None], at.contact_place.gradients[n:], 0.0)
        gram = gradients @ gradients.T
        size = _YIELD * jnp.max(jnp.diag(gram)) + jnp.finfo(gram.dtype).tiny
        shared = solve(gram + size * jnp.eye(stick.size, dtype=gram.dtype), gram @ dry)
        dry = jnp.where(stick, shared, dry)
    coefficient, hold = sticking(at)
    limit = coefficient * normal if hold is None else coefficient * normal + hold
    return jnp.concatenate([forces[:n], limit - sizes_of(contacts.pairs, dry)])


class Limits(NamedTuple):
    """The largest forces of friction: `coefficient` times a normal force, and a `force`, None if all are zero."""

    coefficient: Float[Array, "frictions"]
    force: Float[Array, "frictions"] | None

    def along_gaps(self, at: Instant) -> "Limits":
        """The limits with multiples of the forces along the gaps of contacts. Such a force is the normal force if the
        gap grows by one metre a metre.
        """
        return self._replace(coefficient=self.coefficient * at.contact_place.sizes)


def sticking(at: Instant) -> Limits:
    """The limits of stick."""
    laws = at.contact_laws.slip
    return Limits(laws.ask("limit"), laws.ask("hold") if laws.resists else None)


def sliding(at: Instant, speeds: Float[Array, "frictions"]) -> Limits:
    """The forces of slip at some speeds."""
    laws = at.contact_laws.slip
    force = laws.ask("resistance", speeds) if laws.resists else None
    return Limits(laws.ask("coefficient", speeds), force)


def slowly_sliding(at: Instant) -> Limits:
    """The forces of slip at speed zero."""
    return sliding(at, jnp.zeros(at.system.contacts.m, at.q.dtype))


def contact_forces(at: Instant):
    """Accelerations and multipliers at a state, without a search for pivots."""
    system = at.system
    if not system.ideal_on_velocities:
        return accelerations_at(at, Multipliers())
    jacobian = at.structured_jacobian.selected(system.acceleration_rank, system.velocity_scale())
    return jacobian.projector(at.inertia).solve(at.force, at.gamma)


def other_rows(at: Instant):
    """A with the rows that bind velocities and belong to no contact or friction, selected."""
    system, numbers = at.system, at.system.contacts.rows
    others = tuple(k for k in range(system.velocity_rows) if k not in numbers)
    # The rows of open contacts and slipping friction bind only their modes.
    rank = system.velocity_rank - len(numbers)
    return at.structured_jacobian.of_rows(others).selected(rank, system.velocity_scale())


def free_accelerations(at: Instant, formulation, projector):
    """Accelerations and multipliers without contacts and friction, and the accelerations along their directions.

    **Arguments:** the `projector` on the other constraints.
    """
    contacts = at.system.contacts
    if at.system.ideal_without_friction:
        udot, multipliers = projector.solve(at.force, at.gamma)
    else:
        udot, multipliers = accelerations_at(at.with_(q=contacts.with_modes(at.q, 0.0)), formulation)
    return udot, multipliers, at.contact_accelerations(udot)
