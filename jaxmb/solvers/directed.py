"""Terms in the time of a solver, which always increases, and the next number in a direction of time."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import PyTree


class Directed(diffrax.AbstractTerm):
    """A `term` as a solver sees it in a run whose time has this `direction`, 1 or -1.

    `diffrax.diffeqsolve` wraps terms in the same way, with the same names.
    """

    term: Any
    direction: Any

    def vf(self, t, y, args):
        return self.term.vf(t * self.direction, y, args)

    def vf_prod(self, t, y, args, control):
        return self.term.vf_prod(t * self.direction, y, args, control)

    def contr(self, t0, t1, **kwargs):
        control = self.term.contr(*self._ends(t0, t1), **kwargs)
        return jax.tree.map(lambda x: self.direction * x, control)

    def prod(self, vf, control):
        with jax.numpy_dtype_promotion("standard"):
            return self.term.prod(vf, control)

    def is_vf_expensive(self, t0, t1, y, args):
        return self.term.is_vf_expensive(*self._ends(t0, t1), y, args)

    def _ends(self, t0, t1):
        forward = self.direction == 1
        return jnp.where(forward, t0, -t1), jnp.where(forward, t1, -t0)


def next_number(t: Any, direction: Any) -> Any:
    """The next larger number, or the next smaller one for a direction of −1; after zero the least normal number, as in
    solvers that stop just before a jump.
    """
    sign = jnp.asarray(direction, t.dtype)
    return jnp.where(t == 0, sign * jnp.finfo(t.dtype).tiny, jnp.nextafter(t, sign * jnp.inf))


def directed(terms: PyTree, direction: Any) -> PyTree:
    """The terms of a solver with a direction of time."""
    return jax.tree.map(lambda term: Directed(term, direction), terms, is_leaf=_is_single)


def undirected(terms: PyTree) -> PyTree:
    """The terms inside `directed`."""
    return jax.tree.map(inner_term, terms, is_leaf=_is_single)


def term_of(terms: Any) -> Any:
    """The user's term, which a run has wrapped (in `diffrax.BacksolveAdjoint` twice)."""
    while _is_around(terms):
        terms = terms.term
    return terms


def inner_term(terms: Any) -> Any:
    """The term inside the wrapper that makes time increase."""
    return terms.term


def direction_of(terms: Any) -> Any:
    """The sign of the user's time in the solver's time; 1 for a term without a direction."""
    return getattr(terms, "direction", 1)


def _is_single(term):
    return isinstance(term, diffrax.AbstractTerm) and not isinstance(term, diffrax.MultiTerm)


def _is_around(term):
    return isinstance(term, diffrax.AbstractTerm) and isinstance(getattr(term, "term", None), diffrax.AbstractTerm)
