"""The steps of a solver as linear maps of tangents."""

import abc
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import equinox as eqx
from jaxtyping import Array, PyTree

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class Moving(NamedTuple):
    """The numbers of a run that have tangents, or their tangents.

    **Fields:** `terms`: the terms, their arguments and the solver; `jumps`: the times of jumps in the solver's time,
    None if they have no tangents.
    """

    terms: PyTree
    jumps: Any


class LinearStep(NamedTuple):
    """A step as linear maps of tangents.

    **Fields:** `push(dmoved, w, memory)`: the tangents of the raveled state at the end, of the solver's memory, and of
    the step's dense output; `at(dense, t)`: the tangent of the raveled state at a time, from the dense output's.
    """

    push: Callable[..., tuple[Array, PyTree, PyTree]]
    at: Callable[[PyTree, Any], Array]


class AbstractSteps(eqx.Module):
    """How a solver's steps are stored, and linearised from their rows.

    **Fields:** `jumps`: whether steps may begin after a jump.
    """

    jumps: AbstractVar[bool]

    @property
    def starts(self) -> bool:
        """Whether the start of a run has a row before the row of its first step."""
        return False

    @abc.abstractmethod
    def row(self, terms: PyTree, before: Any, after: Any) -> PyTree[Array]:
        """The row that is stored of an accepted step, from the states of an integration before and after the step."""

    @abc.abstractmethod
    def alone(self, solver_state: Any) -> Any:
        """The state of the solver, without the tangents that it carries along."""

    @abc.abstractmethod
    def chosen(self, solver_state: Any) -> PyTree[Array]:
        """The parts of the solver's state that the error estimate chose for the next step; None without any."""

    def of_solver_alone(self) -> Self:
        """The same for runs of the solver without tangents."""
        return self

    def after_first_jump(self) -> Self:
        """The same for runs that begin with a jump."""
        return self

    def from_start(self) -> Self:
        """The same for runs that begin with a state, and not with the memory of another run."""
        return self

    def again(self, solver: Any, *step: Any) -> tuple[PyTree[Array], Any]:
        """The end of an accepted step that is repeated, and the solver's state there, from the arguments of `step`."""
        y, _, _, solver_state, _ = solver.step(*step)
        return y, solver_state

    @abc.abstractmethod
    def memory(self, solver_state: Any) -> PyTree[Array]:
        """The numbers of a solver's state, or of its tangent, that a step depends on smoothly."""

    def start(self, terms: PyTree, before: Any, after: Any) -> PyTree[Array]:
        """The row of the start of a run (`starts`), from the states around the first accepted step."""
        raise NotImplementedError(f"{type(self).__name__} says starts, and needs a method start.")

    @abc.abstractmethod
    def linearised(self, of: Callable, moved: Moving, like: PyTree[Array], row: PyTree[Array]) -> LinearStep:
        """A step at its row.

        **Arguments:** `of(moved.terms)`: the terms, their arguments and the solver; `like`: a state before raveling.
        """

    @abc.abstractmethod
    def row_tangent(
        self, row: PyTree[Array], like: PyTree[Array], before: tuple[Array, PyTree], after: tuple[Array, PyTree]
    ) -> PyTree[Array]:
        """The tangent of a row, from the tangents around its step; None for numbers without one."""


def refuse_moving_jumps(moved: Moving, solver: Any) -> None:
    """Raise a `ValueError` for derivatives by the times of jumps."""
    if moved.jumps is not None:
        raise ValueError(
            "Derivatives by the times of jumps are known to jaxmb.solvers.Adams and Hermite only, got "
            f"{type(solver).__name__}: use these, or stop_gradient for the times."
        )
