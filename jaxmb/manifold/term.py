"""A constrained system as a term: the part that does not depend on how its states return to the constraints."""

import abc
from typing import TYPE_CHECKING, Any

from jaxtyping import Array, Float

from .._types import State
from ..contacts.guards import contact_guards
from ..formulations import AbstractFormulation
from ..formulations.laws import Memory
from ..solvers.manifold_term import AbstractManifoldTerm, ManifoldEvaluation
from ..system.equation import AbstractEquation
from ..system.instant import Instant
from .accuracy import Accuracy
from .compliant_gaps import compliant_gaps
from .constraints import Linearise, SolvedState, rates_along, solved
from .impulse import after_jump, found_at_jump
from .manifold import VectorField

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class AbstractConstrainedTerm(AbstractManifoldTerm):
    """A constrained system, with its internal states if it has any."""

    system: AbstractVar[AbstractEquation]
    formulation: AbstractVar[AbstractFormulation]
    accuracy: AbstractVar[Accuracy]

    def at(self, t: Any, y: State) -> Instant:
        """The system at a state."""
        return Instant.of(self.system, t, y)

    def evaluated(
        self, at: Instant, udot: Float[Array, "nu"], chart: Any, failed: Any, near: SolvedState | None = None
    ) -> ManifoldEvaluation:
        """The evaluation at a state with known accelerations.

        **Arguments:** `near`: the data for restoring other states from this one, None if there will be no others.
        """
        return ManifoldEvaluation(at.state, at.motion(udot), chart, failed, near)

    @abc.abstractmethod
    def linearisation(self, kept: Any) -> tuple[Linearise, Memory] | None:
        """The constraints at a solution, as a function of an instant, and the memory of the laws there; None if the
        equations are solved again.
        """

    def at_solution(self, t, y, f, kept, args):
        linearisation = self.linearisation(kept)
        if linearisation is None:
            return super().at_solution(t, y, f, kept, args)
        at, (linearise, memory) = self.at(t, y), linearisation
        out = solved(linearise, at, f.u, memory)
        at = at.with_(q=out.q, u=out.u)
        return at.state, at.motion(out.udot)

    def along_solution(self, t, y, f, along, kept, args):
        linearisation = self.linearisation(kept)
        if linearisation is None or linearisation[1] is not None or y.z is not None:
            return super().along_solution(t, y, f, along, kept, args)
        return rates_along(linearisation[0], self.at(t, y), f.u, along)

    def vf(self, t, y, args):
        return VectorField(self.system, self.formulation)(t, y, args)

    @property
    def guards(self):
        return contact_guards(self.system, self.formulation, self.accuracy.at_contacts)

    @property
    def gaps(self):
        return compliant_gaps(self.system)

    def found_at_jump(self, t, y, args):
        return found_at_jump(self.guards, t, y)

    def after_jump(self, t, y, found, args):
        return after_jump(self.system, self.guards, t, y, found)
