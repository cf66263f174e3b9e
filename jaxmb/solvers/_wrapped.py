"""One-step solvers with something added to every step."""

from typing import Any

import diffrax
import equinox as eqx


class WrappedSolver(diffrax.AbstractWrappedSolver):
    """A diffrax solver inside another one, to which diffrax's settings are passed on."""

    solver: diffrax.AbstractSolver
    scan_kind: Any = eqx.field(default=None, kw_only=True)  # set by diffrax's adjoints, for the loop over stages

    @property
    def term_structure(self):
        return self.solver.term_structure

    @property
    def interpolation_cls(self):  # pyright: ignore
        return self.solver.interpolation_cls

    # Of implicit solvers: where diffrax looks for their tolerances, and fills them in.
    @property
    def root_finder(self) -> Any:
        return self.solver.root_finder  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def root_find_max_steps(self) -> int:
        return self.solver.root_find_max_steps  # pyright: ignore[reportAttributeAccessIssue]

    def order(self, terms):
        return self.solver.order(terms)

    def error_order(self, terms):
        return self.solver.error_order(terms)

    def func(self, terms, t0, y0, args):
        return self.solver.func(terms, t0, y0, args)

    @property
    def inner(self) -> Any:
        """The solver, with the loops that the adjoint asked for."""
        return with_loops(self.solver, self.scan_kind)


def with_loops(solver: Any, kind: Any) -> Any:
    """A solver with loops of a kind over its stages."""
    if kind is None or not hasattr(solver, "scan_kind"):
        return solver
    return eqx.tree_at(lambda s: s.scan_kind, solver, kind, is_leaf=lambda x: x is None)
