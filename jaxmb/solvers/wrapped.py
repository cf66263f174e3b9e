"""Solvers inside others, and the settings of diffrax's solvers that a run chooses."""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx

from .._compat import from_controller


class _Tolerances(NamedTuple):
    rtol: Any
    atol: Any
    norm: Any


# It stands in a solver for a tolerance of the step size controller.
_OF_CONTROLLER = from_controller(_Tolerances).rtol


class AbstractSolverAround(diffrax.AbstractWrappedSolver):
    """A diffrax solver inside another one."""

    solver: diffrax.AbstractSolver

    @property
    def term_structure(self):
        return self.solver.term_structure

    @property
    def interpolation_cls(self):  # pyright: ignore
        return self.solver.interpolation_cls

    def order(self, terms):
        return self.solver.order(terms)

    def error_order(self, terms):
        return self.solver.error_order(terms)

    def func(self, terms, t0, y0, args):
        return self.solver.func(terms, t0, y0, args)

    def init(self, terms, t0, t1, y0, args):
        return self.solver.init(terms, t0, t1, y0, args)


def with_tolerances(solver: Any, controller: Any) -> Any:
    """A solver with tolerances that it takes from the step size controller.

    **Raises:** `ValueError` if the controller has none.
    """
    if isinstance(solver, diffrax.AbstractWrappedSolver):
        return eqx.tree_at(lambda s: s.solver, solver, with_tolerances(solver.solver, controller))
    if not isinstance(solver, diffrax.AbstractImplicitSolver):
        return solver
    taken = [name for name in _Tolerances._fields if getattr(solver.root_finder, name, None) is _OF_CONTROLLER]
    if not taken:
        return solver
    if not isinstance(controller, diffrax.AbstractAdaptiveStepSizeController):
        raise ValueError(
            f"{type(solver).__name__} takes its tolerances from the step size controller, and "
            f"{type(controller).__name__} has none: give them to the solver, or use diffrax.PIDController."
        )
    values = [getattr(controller, name) for name in taken]
    return eqx.tree_at(lambda s: [getattr(s.root_finder, name) for name in taken], solver, values)
