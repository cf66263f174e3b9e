"""Terms of systems whose parts have internal states, and the blocks of their states.

Forces depend on internal states, constraints do not. So charts, projections and accelerations are those of the system
that has the internal states of the moment, and the states themselves are integrated beside (q, u) as they are.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import State
from ..solvers import AbstractManifoldTerm, Block
from ..solvers.manifold_term import AbstractVectorField
from ..system import AbstractSystem
from .impulse import after_jump, found_at_jump


def with_internal_states(term: Any) -> Any:
    """The term for (q, u, z) from one for (q, u), which a manifold has prepared; the same one where z is empty."""
    field: Any = term.vector_field if isinstance(term, diffrax.ODETerm) else None
    equation: Any = term if field is None else field
    if equation.system.nz == 0:
        return term
    return StatefulTerm(term) if field is None else diffrax.ODETerm(StatefulField(field))


def _at(equation, y):
    """A term or vector field whose system has the internal states of y."""
    return eqx.tree_at(lambda equation: equation.system, equation, equation.system.at(y))


def _mechanical(y):
    return State(y.q, y.u)


class StatefulField(AbstractVectorField):
    """`(q, u, z) ↦ (q̇, u̇, ż)` from a vector field of (q, u)."""

    field: Any

    @property
    def gaps(self):
        return self.field.gaps

    @property
    def system(self):
        return self.field.system

    def __call__(self, t, y, args):
        field = _at(self.field, y)
        f = field(t, _mechanical(y), args)
        return State(f.q, f.u, field.system.state_rates(t, field.system.normalize(y.q), y.u))


class StatefulTerm(AbstractManifoldTerm):
    """A term for (q, u, z) from one for (q, u). Internal states are independent in every chart."""

    term: Any

    @property
    def system(self):
        return self.term.system

    def vf(self, t, y, args):
        term = _at(self.term, y)
        f = term.vf(t, _mechanical(y), args)
        return State(f.q, f.u, term.system.state_rates(t, term.system.normalize(y.q), y.u))

    def init_chart(self, t, y, args):
        return _at(self.term, y).init_chart(t, _mechanical(y), args)

    def evaluate(self, t, y, chart, args):
        term = _at(self.term, y)
        return _with_states(term.system, t, y.z, term.evaluate(t, _mechanical(y), chart, args))

    def project_near(self, t, y, linearized_at, args):
        before = linearized_at._replace(y=_mechanical(linearized_at.y), f=_mechanical(linearized_at.f))
        term = _at(self.term, y)
        return _with_states(term.system, t, y.z, term.project_near(t, _mechanical(y), before, args))

    def project_cold(self, t, y, chart, args):
        term = _at(self.term, y)
        return _with_states(term.system, t, y.z, term.project_cold(t, _mechanical(y), chart, args))

    def kept(self, chart):
        return self.term.kept(chart)

    def kept_at_start(self, chart):
        return self.term.kept_at_start(chart)

    def at_solution(self, t, y, f, kept, args):
        term = _at(self.term, y)
        own, rates = term.at_solution(t, _mechanical(y), _mechanical(f), kept, args)
        return State(own.q, own.u, y.z), State(rates.q, rates.u, term.system.state_rates(t, own.q, own.u))

    @property
    def guards(self):
        return self.term.guards

    @property
    def gaps(self):
        return self.term.gaps

    def found_at_jump(self, t, y, args):
        return found_at_jump(self.guards, t, y)

    def after_jump(self, t, y, found, args):
        if self.guards is not None:
            return after_jump(self.system, self.guards, t, y, found)
        after = self.term.after_jump(t, _mechanical(y), found, args)
        return State(after.q, after.u, y.z)

    def chart_after_jump(self, chart):
        return self.term.chart_after_jump(chart)

    def controlled(self, chart):
        own = self.term.controlled(chart)
        return State(own.q, own.u, jnp.ones(self.system.nz, bool))

    def free(self, chart):
        own, first = self.term.free(chart), self.system.nq + self.system.nu
        return jnp.concatenate([own, first + jnp.arange(self.system.nz, dtype=own.dtype)])

    def update_chart(self, t, y, chart, args):
        return _at(self.term, y).update_chart(t, _mechanical(y), chart, args)

    def after_step(self, t, y, chart, args):
        return _at(self.term, y).after_step(t, _mechanical(y), chart, args)

    def refuses(self, chart, before):
        return self.term.refuses(chart, before)


def _with_states(system, t, z, out):
    """An evaluation with the internal states and their rates at its state."""
    rates = system.state_rates(t, out.y.q, out.y.u)
    return out._replace(y=State(out.y.q, out.y.u, z), f=State(out.f.q, out.f.u, rates))


def state_blocks(system: AbstractSystem, rate: Any) -> tuple[Block, ...]:
    """The blocks of a raveled state.

    **Arguments:** `rate`: that of velocities where nothing is known of them, in their natural units [1/s].
    """
    kinds = np.diff([0, *system.state_ends])
    return (
        Block("coordinates", system.nq, 1.0),
        Block("velocities", system.nu, rate, rate_of="coordinates"),
        *(Block(f"states {k}", int(size)) for k, size in enumerate(kinds)),
    )


def counted_components(system: AbstractSystem) -> tuple[int, ...] | None:
    """The indices of the components of a raveled state whose sizes and errors count: all but the modes of contacts and
    dry friction, which have none; None for all.
    """
    if not system.contacts:
        return None
    modes = np.isin(np.arange(system.nq), system.contacts.places)
    along = system.held_velocities(modes)
    assert along is not None, "a mode is no part of a rotation"
    uncounted = np.concatenate([modes, along, np.zeros(system.nz, bool)])
    return tuple(np.flatnonzero(~uncounted).tolist())


def natural_units(system: AbstractSystem, velocities: Float[Array, " nu"], dtype: Any) -> Float[Array, " n"]:
    """The natural sizes of the components of a raveled state, with given ones of velocities."""
    units = [system.coordinate_scale(), velocities, *([system.state_scale()] if system.nz else [])]
    return jnp.concatenate(units).astype(dtype)
