"""The laws of contacts and dry friction at a state, for impulses and for forces."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ..linalg.complementarity import positive_components, reduced, solved_components
from ..linalg.elimination import solve
from ..linalg.pairs import sizes_of
from ..linalg.rotations import norm
from ..parts.modes import Modes
from ..system.contact_set import ContactSet
from ..system.instant import Instant
from .dry_laws import Answers, Dry, laws_of
from .forces import Limits, sliding, slowly_sliding, sticking
from .friction import frictional
from .tolerance import REST

# Friction that sticks begins to slip at this fraction below its limit: if it still held after the event, the same event
# would follow at once.
_REACHED = 1e-7
# Other friction sticks up to this fraction above its limit. At the limit itself, the guard of its force then decides
# whether it slips, by the first nonzero derivative.
_HELD = 1e-8
# The normal forces of joints, which depend on the friction in them, take this many corrections.
_CORRECTIONS = 6


class Problem(NamedTuple):
    """The unknown impulses, or forces.

    **Fields:** `free`: the rates or accelerations along the laws without the unknowns; `among`: the laws that may have
    any; `coefficient`, `slips` and `bound`: see `Dry`; `speeds` of slip, None if no law depends on them; `reactions` of
    the joints with friction, without forces along the laws and by a unit force along each, None without such friction.
    """

    free: Float[Array, "laws"]
    among: Bool[Array, "laws"]
    coefficient: Float[Array, "m"]
    slips: Float[Array, "m"]
    bound: Float[Array, "m"]
    speeds: Float[Array, "m"] | None
    reactions: Float[Array, "more_laws m d"] | None


class Laws(NamedTuple):
    """The laws of `contacts` and their dry friction at a state.

    **Fields:** the instant `at`; the `influence` of the forces; the limits of friction, as multiples of the forces
    along the gaps: of stick (`sticking`), and of slip at speed zero (`slow`).
    """

    at: Instant
    influence: Float[Array, "n_m n_m"]
    sticking: Limits
    slow: Limits

    @classmethod
    def of(cls, at: Instant, influence: Float[Array, "n_m n_m"]) -> "Laws":
        """The laws at an instant."""
        return cls(at, influence, sticking(at).along_gaps(at), slowly_sliding(at).along_gaps(at))

    @property
    def contacts(self) -> ContactSet:
        return self.at.system.contacts

    def of_modes(self, modes: Modes, rates: Float[Array, "n_m"]) -> Answers:
        """Which laws hold in given modes, at given rates of gaps and slips."""
        slips = modes.slips(rates[self.contacts.n :])
        return Answers(modes.closed, modes.sticks, slips, jnp.array(True), modes.implied_stick)

    def sliding(self, speeds: Any) -> Limits:
        """The forces of slip at some speeds, as multiples of the forces along the gaps."""
        return sliding(self.at, speeds).along_gaps(self.at) if self.at.contact_laws.slip.varies else self.slow

    def sizes(self, values):
        """The sizes of friction values: of one direction, or of both directions together."""
        return sizes_of(self.contacts.pairs, values)

    def of_impulses(self, approach, touching, reactions) -> Problem:
        """The impulses of contacts that are `touching`.

        Friction in joints has no impulse; the problem has zeros in place of the `reactions`.

        **Arguments:** `approach`: the rates before the impact, minus the rates of the rebounds.
        """
        reactions = jax.tree.map(jnp.zeros_like, reactions)
        none, may = jnp.zeros(self.contacts.m, approach.dtype), self.may(touching) & ~self.contacts.in_joints
        among, speeds = jnp.concatenate([touching, may]), none if self.at.contact_laws.slip.varies else None
        return Problem(approach, among, self.slow.coefficient, none, none, speeds, reactions)

    def of_expansion(self, free, again, touching, reactions) -> Problem:
        """The impulses in an expansion, beyond the least normal impulses `again`.

        **Arguments:** `free`: the rates at the end of compression.
        """
        pushes = jnp.where(self.contacts.in_joints, 0.0, again[np.array(self.contacts.contact_of, int)])
        problem = self.of_impulses(free + self.influence[:, : self.contacts.n] @ again, touching, reactions)
        return problem._replace(bound=problem.coefficient * pushes)

    def of_forces(self, opening, reactions, staying, rates, slips, modes, forces) -> Problem:
        """The forces after an event, of contacts that are `staying`, and of friction.

        **Arguments:** `opening`: the accelerations without these forces; the `rates` of slips; `slips`: the direction
        of slip, zero where friction may stick; `forces`: approximate forces, by which the normal forces of joints are
        found.
        """
        # Friction that has just reached its limit is beyond it, up to the resolution of the search for laws.
        near, may_stick = jnp.where(modes.sticks, 1 - _REACHED, 1 + _HELD), self.sizes(slips) == 0
        speeds = jnp.where(may_stick, 0.0, self.sizes(rates)) if self.at.contact_laws.slip.varies else None
        limit = lambda stick, slip: jnp.where(may_stick, stick * near, slip)
        coefficient, bounds = jax.tree.map(limit, self.sticking, self.sliding(speeds))
        if reactions is not None:
            normal = norm(reactions[0] + jnp.tensordot(forces, reactions[1:], 1))
            of_joints = jnp.where(self.contacts.in_joints, coefficient * normal, 0.0)
            bounds = of_joints if bounds is None else bounds + of_joints
        bounds = jnp.zeros(self.contacts.m, opening.dtype) if bounds is None else bounds
        among = jnp.concatenate([staying, self.may(staying)])
        return Problem(opening, among, coefficient, slips, bounds, speeds, reactions)

    def answers(self, problem: Problem) -> Answers:
        """Which laws hold."""
        free, among = problem.free, problem.among
        if self.contacts.m:
            dry = self._dry(problem.coefficient, problem.slips, problem.bound)
            return frictional(self.influence, free, dry, among)
        both, none = among[:, None] & among[None, :], free[:0]
        influence = jnp.where(both, self.influence, jnp.eye(free.size, dtype=free.dtype))
        closed, solvable = positive_components(influence, jnp.where(among, free, 1.0))
        return Answers(closed, none > 0, none, solvable, none > 0)

    def solved(self, problem: Problem, answers: Answers):
        """The impulses or forces of laws that hold."""
        free, reactions = problem.free, problem.reactions
        if not self.contacts.m:
            return solved_components(self.influence, free, answers.closed)
        none, (coefficient, own) = jnp.zeros(self.contacts.m, free.dtype), self.sliding(problem.speeds)
        # The normal forces of joints follow below.
        bound = jnp.where(self.contacts.in_joints, 0.0 if own is None else own, problem.bound)
        matrix, right = laws_of(self.influence, free, self._dry(coefficient, none, bound), answers)
        # The other forces are exactly zero.
        act = jnp.concatenate([answers.closed, answers.sticks | (answers.slips != 0)])
        if reactions is None:
            return jnp.where(act, solve(matrix, right), 0.0)
        factor = jnp.where(self.contacts.in_joints & ~answers.sticks, coefficient * answers.slips, 0.0)

        def correct(_, forces):
            # Newton's method: the size of a reaction is not linear.
            reaction = reactions[0] + jnp.tensordot(forces, reactions[1:], 1)
            normal = norm(reaction)
            along = reaction / jnp.where(normal > 0, normal, 1.0)[:, None]
            slope = jnp.einsum("kmd,md->mk", reactions[1:], along)
            coupled = matrix + jnp.pad(factor[:, None] * slope, ((self.contacts.n, 0), (0, 0)))
            return solve(coupled, right + jnp.pad(factor * (slope @ forces - normal), (self.contacts.n, 0)))

        linear = solve(matrix, right)
        return jnp.where(act, lax.fori_loop(0, _CORRECTIONS, correct, linear), 0.0)

    def may(self, staying):
        """Which friction may have a force."""
        if not self.contacts.m:
            return jnp.zeros(0, bool)
        return jnp.stack([staying[k] if k >= 0 else jnp.array(True) for k in self.contacts.contact_of])

    def _dry(self, coefficient, slips, bound) -> Dry:
        return Dry(self.contacts.contact_of, self.contacts.pairs, coefficient, slips, bound)


def is_implied(influence, closed):
    """Which gaps cannot move if some contacts are closed, up to rounding errors."""
    if not closed.size:
        return closed
    influence, closed = lax.stop_gradient((influence, closed))
    return jnp.diag(reduced(influence, closed)) <= REST * jnp.diag(influence)
