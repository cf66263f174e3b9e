"""A manifold policy: how the state stays on the constraints while it is integrated."""

import abc
import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import diffrax
import equinox as eqx
from jaxtyping import Array, PyTree

from .._types import Scalar, State
from ..formulations import AbstractFormulation, Multipliers, NullSpace
from ..formulations.laws import accelerations_at
from ..solvers.manifold_term import AbstractVectorField
from ..system.equation import AbstractEquation
from ..system.instant import Instant
from .accuracy import Accuracy
from .compliant_gaps import compliant_gaps

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar

Correction = Callable[[AbstractEquation, Scalar, State], State]


# Defaults, made once.
_MULTIPLIERS, _NULL_SPACE = Multipliers(), NullSpace()


class AbstractManifold(eqx.Module):
    """A policy that turns a system into a term, and a solver into a solver that respects the constraints.

    **Fields:**

    - `restores`: whether every step ends on the constraints.
    - `newton_tol`: the size of the last Newton correction of positions, if given.
    - `takes_impulses`: whether velocities follow a jump of prescribed rates.
    - `uses_charts`: whether independent coordinates are chosen.
    """

    restores: AbstractVar[bool]
    newton_tol: ClassVar[float | None] = None
    takes_impulses: ClassVar[bool] = True
    uses_charts: ClassVar[bool] = False

    @abc.abstractmethod
    def prepare(
        self,
        system: AbstractEquation,
        formulation: AbstractFormulation,
        solver: diffrax.AbstractSolver,
        accuracy: Accuracy,
    ) -> tuple[diffrax.AbstractTerm, diffrax.AbstractSolver]:
        """The term to integrate and the solver for it.

        **Raises:** `ValueError` for a solver that the policy cannot work with.
        """

    def default_formulation(self, system: AbstractEquation) -> AbstractFormulation:
        """The default formulation: the cheapest one without a partition that the mass matrix allows."""
        return _MULTIPLIERS if system.positive_definite_mass else _NULL_SPACE

    @abc.abstractmethod
    def correction(self, interpolated: bool) -> Correction | None:
        """The function that returns saved states to the constraints; None if they are on them already.

        **Arguments:** `interpolated`: whether states between steps are saved.
        """

    def accuracy(self, rtol: Scalar) -> Accuracy:
        """The tolerances of a motion by that of integration."""
        return Accuracy.of(rtol, self.newton_tol)

    def statistics(self, solver_state: Any) -> dict[str, Array]:
        """Counts of the policy's work, from the final state of the solver."""
        del solver_state
        return {}

    def violated(self, system: AbstractEquation, t: Scalar, y: State, accuracy: Accuracy) -> Any:
        """Whether the end of a simulation violates constraint rows that the policy omits; False if it omits none."""
        del system, t, y, accuracy
        return False

    def evidence(self, solver_state: Any) -> PyTree[Array]:
        """The data for `diagnose` from the final state of the solver."""
        del solver_state
        return None

    def diagnose(
        self,
        system: AbstractEquation,
        t: Scalar,
        y: State,
        evidence: PyTree[Array],
        result: Any,
        failed: Any,
        accuracy: Accuracy,
    ) -> Any:
        """The outcome of a simulation that failed, made precise if the policy knows the reason.

        **Arguments:** `t`, `y`: the last state; `evidence` of the solver there; `result`: a `RESULTS`; `failed`:
        whether it is a failure that starts from finite numbers.
        """
        del system, t, y, evidence, failed, accuracy
        return result


class VectorField(AbstractVectorField):
    """The rate of a state, with the accelerations of a formulation."""

    system: AbstractEquation
    formulation: AbstractFormulation

    @property
    def gaps(self):
        return compliant_gaps(self.system)

    def __call__(self, t, y, args):
        del args
        at = Instant.of(self.system, t, y).normalized()
        udot, _ = accelerations_at(at, self.formulation)
        return at.motion(udot)


def normalize_state(system: AbstractEquation, t: Scalar, y: State) -> State:
    """The state with normalised coordinates."""
    return dataclasses.replace(y, q=system.normalize(t, y.q))
