"""The derivatives of the impulses of an impact, and of the velocities after them, by the numbers before it.

Each phase has one linear system: `M (u⁺ − u⁻) = Aᵀ Λ`, with the rates of held gaps and of ending slips.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..linalg.complementarity import solved_components
from ..linalg.elimination import solve
from ..linalg.pairs import of_pairs
from ..linalg.pushed import push
from ..linalg.rotations import norm
from ..system.contact_set import ContactSet, LawTable
from ..system.instant import Instant
from .forces import other_rows, slowly_sliding
from .groups import HOLDS, group_sums, of_contacts
from .impacting import Event, Phase


class Frame(NamedTuple):
    """Gaps and slips at a place, and at the same place in motion.

    **Fields:** the `gaps`; `rows`, the derivatives of the rates of gaps and slips by velocities; the rates of a system
    at rest, `drift`; the `coefficient` of friction as a multiple of the force along the gap; the `laws` of impact.
    """

    gaps: Float[Array, "contacts"]
    rows: Float[Array, "laws nu"]
    drift: Float[Array, "laws"]
    coefficient: Float[Array, "frictions"]
    laws: LawTable

    @classmethod
    def of(cls, system: Any, t: Float[Array, ""], q: Float[Array, "nq"]) -> "Frame":
        at = Instant(system, t, q, jnp.zeros(system.nu, q.dtype))
        place, drift, coefficient = (
            at.contact_place,
            at.contact_motion.rates,
            slowly_sliding(at).along_gaps(at).coefficient,
        )
        return cls(place.gaps, place.gradients, drift, coefficient, at.contact_laws.normal)

    def rates(self, u: Float[Array, "nu"]) -> Float[Array, "laws"]:
        """The rates of gaps and the velocities of slip."""
        return self.rows @ u + self.drift


class MovingFrame(NamedTuple):
    """A frame with its tangent."""

    here: Frame
    change: Frame

    @classmethod
    def of(cls, at: tuple[Any, ...], along: tuple[Any, ...]) -> "MovingFrame":
        """The frame at a system, t and q, with the tangent along theirs."""
        return cls(Frame.of(*at), Frame(*push(Frame.of, at, along)))

    def later(self, by: "MovingFrame", time: Float[Array, ""]) -> "MovingFrame":
        """With the tangent of another in addition, so many times."""
        return self._replace(change=jax.tree.map(lambda a, b: a + time * b, self.change, by.change))

    def of_impact(
        self, question: str, numbers: tuple[Array, ...], change: tuple[Array, ...]
    ) -> tuple[Float[Array, "contacts"], Float[Array, "contacts"]]:
        """What the laws of impact answer, and the tangent, with the tangents of their numbers."""
        ask = lambda laws, *numbers: laws.ask(question, *numbers)
        return jax.jvp(ask, (self.here.laws, *numbers), (self.change.laws, *change))

    def change_of_rates(self, u: Float[Array, "nu"], du: Float[Array, "nu"]) -> Float[Array, "laws"]:
        """The tangent of the rates, with the tangent of the velocities."""
        return self.change.rates(u) + self.here.rows @ du


@dataclasses.dataclass(frozen=True, eq=False)
class Phases:
    """The linear equations of the phases of an impact.

    **Fields:** `at`: system, t and q at the `event`; their `tangents`, and `du`, the tangent of the velocities before
    it; the `frame` there; the `projector` on the other constraints; `moves`: the changes of velocities by unit
    impulses.
    """

    event: Event
    at: tuple[Any, Float[Array, ""], Float[Array, "nq"]]
    tangents: tuple[Any, ...]
    du: Float[Array, "nu"]
    frame: MovingFrame
    projector: Any
    moves: Float[Array, "laws nu"]

    @classmethod
    def of(cls, event: Event, at, tangents, du, frame: MovingFrame) -> "Phases":
        system, t, q = at
        after = Instant(system, t, q, event.u)
        projector, none = other_rows(after).projector(after.inertia), jnp.zeros(system.acceleration_rows, q.dtype)
        moves = jax.vmap(lambda force: projector.solve(force, none)[0])(frame.here.rows)
        return cls(event, at, tangents, du, frame, projector, moves)

    @property
    def rows(self) -> Float[Array, "laws nu"]:
        """The rows of A of contacts and friction."""
        return self.frame.here.rows

    @property
    def contacts(self) -> ContactSet:
        return self.at[0].contacts

    def alone(self, own: Bool[Array, "laws"], impulses, held) -> Float[Array, "laws"]:
        """The impulses if those of some groups act alone: laws that hold bodies answer to them."""
        alone, influence = jnp.where(own, impulses, 0.0), self.rows @ self.moves.T
        return alone + solved_components(influence, influence @ alone, held & (self.event.group == HOLDS))

    def of_group(self, own: Bool[Array, "laws"], tangents, du, frame: MovingFrame) -> "Phases":
        """The phases of an impact of one group alone, its `own` laws, with tangents and a frame of its own."""
        event, compression = self.event, self.event.compression
        acts = own | (event.group == HOLDS)
        slips = lambda slips: jnp.where(own[self.contacts.n :], slips, 0.0)
        if compression is not None:
            impulses = self.alone(own, compression.impulses, compression.held)
            u = event.at + impulses @ self.moves
            compression = Phase(u, compression.held & acts, slips(compression.slips), impulses)
        impulses = self.alone(own, event.impulses, event.held)
        event = event._replace(
            u=event.at + impulses @ self.moves,
            held=event.held & acts,
            slips=slips(event.slips),
            impulses=impulses,
            share=jnp.where(own, event.share, 1.0),
            compression=compression,
        )
        return dataclasses.replace(self, event=event, tangents=tangents, du=du, frame=frame)

    @property
    def closing(self) -> tuple[Float[Array, "contacts"], Float[Array, "contacts"]]:
        """The rates at which gaps close before the impact, zero for others, and the tangents."""
        n, at = self.contacts.n, self.event.at
        rates, change = self.frame.here.rates(at)[:n], self.frame.change_of_rates(at, self.du)[:n]
        return jnp.maximum(-rates, 0.0), -change

    @property
    def share(self) -> Float[Array, "*contacts"]:
        """The share of the rebounds of each contact."""
        return of_contacts(self.event.share, self.contacts.n)

    def changes(self) -> tuple[Float[Array, "laws"], Float[Array, "nu"]]:
        """The derivatives of all impulses, and of the velocities after them."""
        event, contacts, frame = self.event, self.contacts, self.frame
        # Velocities and impulses also change with the share of the rebounds.
        rates, (closing, _) = frame.here.rates(event.at), self.closing
        bounce = jnp.where(event.low, 0.0, frame.here.laws.ask("rebound", closing))
        bounce = jnp.pad(bounce, (0, contacts.m))
        impulses, change, by_share = (self.in_one if event.compression is None else self.in_two)(bounce)

        # At this share no energy is gained.
        both = rates + frame.here.rates(event.u)
        changed = frame.change_of_rates(event.at, self.du) + frame.change_of_rates(event.u, change)
        group, one = event.balance, jnp.ones_like(event.share)
        gained = group_sums(group, impulses * both + event.impulses * changed)
        less = by_share(one)
        slope = group_sums(group, less * both + event.impulses * (self.rows @ (less @ self.moves)))
        is_less = event.share < 1
        factor = jnp.where(is_less, -gained / jnp.where(is_less, slope, 1.0), 0.0)
        # Laws that hold bodies answer to all groups.
        less = factor * less if group is None else by_share(factor)
        return impulses + less, change + less @ self.moves

    def in_one(self, bounce):
        """The derivatives of impulses and velocities at a fixed share of the rebounds, and the derivative of the
        impulses by that share as a function of its change. `bounce`: the rates of the whole rebounds.
        """
        event = self.event
        last = Phase(event.u, event.held, event.slips, event.impulses)
        none = jnp.zeros(self.contacts.n, event.u.dtype)
        impulses, change, matrix = self.solved(event.at, self.du, last, none)
        return impulses, change, lambda dshare: solve(matrix, jnp.where(event.held, dshare * bounce, 0.0))

    def in_two(self, bounce):
        """The same for an impact by Poisson's law."""
        event, compression = self.event, self.event.compression
        assert compression is not None
        n, m = self.contacts.n, self.contacts.m
        none = jnp.zeros(n, event.u.dtype)
        first, between, matrix = self.solved(event.at, self.du, compression, none)
        first_by_share = lambda dshare: solve(matrix, jnp.where(compression.held, dshare * bounce, 0.0))
        (closing, dclosing), struck = self.closing, compression.impulses[:n]
        _, again = self.frame.of_impact("pushed", (struck, closing), (first[:n], dclosing))
        normal = jnp.where(event.low, 0.0, self.share * again)
        last = Phase(event.u, event.held, event.slips, event.impulses - compression.impulses)
        second, change, last_matrix = self.solved(compression.u, between, last, normal)

        def by_share(dshare):
            first = first_by_share(dshare)
            pushed = lambda impulses: self.frame.here.laws.ask("pushed", impulses, closing)
            pushed, again = jax.jvp(pushed, (struck,), (first[:n],))
            normal = jnp.where(event.low, 0.0, of_contacts(dshare, n) * pushed + self.share * again)
            asked = dshare * bounce - self.rows @ (first @ self.moves)
            return first + solve(last_matrix, jnp.where(event.held, asked, jnp.pad(normal, (0, m))))

        return first + second, change, by_share

    def solved(self, before, dbefore, phase: Phase, normal):
        """The derivatives of the impulses of a phase and of the velocities at its end, and the matrix of the equations
        for the impulses; see `equations`.
        """
        plain, matrix, right = self.equations(before, dbefore, phase, normal)
        impulses = solve(matrix, right)
        return impulses, plain + impulses @ self.moves, matrix

    def equations(self, before, dbefore, phase: Phase, normal):
        """The derivatives of the velocities after a phase at fixed impulses, and the linear equations for the impulses'
        derivatives.

        **Arguments:** the velocities `before` the phase, and their derivative; `normal`: the changes of the normal
        impulses of contacts that are not held.
        """
        contacts, (here, moved) = self.contacts, self.frame
        rows, n = np.array(contacts.rows), contacts.n
        impulses = phase.impulses @ here.rows
        asked = self.projector.jacobian.product(phase.u - before)
        _, multipliers = self.projector.solve(impulses, asked)

        def unmet(system, t, q, u):
            """The remaining rates, and the unbalanced momentum, but for those of contacts and friction."""
            at = Instant(system, t, q, phase.u)
            momentum = at.inertia.product(phase.u - u)
            if contacts.alone(system):
                return jnp.zeros(system.acceleration_rows, u.dtype), momentum
            return at.velocity_rows, momentum - at.constraint_force(multipliers)

        rates, forces = push(unmet, (*self.at, before), (*self.tangents, dbefore))
        # Rows of modes have no right-hand side.
        is_law, forces = np.isin(np.arange(rates.size), rows), forces - phase.impulses @ moved.rows
        plain, _ = self.projector.solve(-forces, jnp.where(is_law, 0.0, -rates))
        closing, change = self.closing
        _, bounce = self.frame.of_impact("rebound", (closing,), (change,))
        bounces = phase.held[:n] & ~self.event.low & (closing > 0)
        bounce = jnp.pad(jnp.where(bounces, self.share * bounce, 0.0), (0, contacts.m))
        asked = bounce - moved.rates(phase.u) - here.rows @ plain
        law, right = jnp.eye(rows.size, dtype=plain.dtype), jnp.pad(normal, (0, contacts.m))
        if contacts.m:
            law, right = self.friction_laws(plain, phase, law, right)
        matrix = jnp.where(phase.held[:, None], here.rows @ self.moves.T, law)
        return plain, matrix, jnp.where(phase.held, asked, right)

    def friction_laws(self, plain, phase: Phase, law, right):
        """The equations with the laws of slipping friction, with impulses proportional to the contacts'."""
        contacts, (here, moved) = self.contacts, self.frame
        coefficient, change = here.coefficient, moved.coefficient
        n, contact_of = contacts.n, np.array(contacts.contact_of)
        pushed = jnp.where(contacts.in_joints, 0.0, phase.impulses[contact_of])
        right = jnp.concatenate([right[:n], -change * phase.slips * pushed])
        for k in np.flatnonzero(~contacts.in_joints):
            law = law.at[n + k, contact_of[k]].set(coefficient[k] * phase.slips[k])
        for both in of_pairs(contacts.pairs):
            # The direction of slip changes with the velocity after the impact.
            k, laws, slips = both[0], n + both, phase.slips[both]
            turned, last, speed = moved.rates(phase.u)[laws], here.rates(phase.u)[laws], norm(slips)
            across = jnp.eye(2, dtype=law.dtype) - jnp.outer(slips, slips)
            by = coefficient[k] * pushed[k] * speed * across / jnp.where(speed > 0, norm(last), 1.0)
            law = law.at[laws].add(by @ self.rows[laws] @ self.moves.T, unique_indices=True)
            right = right.at[laws].add(-by @ (turned + self.rows[laws] @ plain), unique_indices=True)
        return law, right
