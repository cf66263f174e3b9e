"""What a manifold policy is: how the state stays on the constraints while it is integrated."""

import abc

import diffrax
import equinox as eqx

from .._types import Scalar
from ..formulations import AbstractFormulation
from ..system import AbstractSystem


class AbstractManifold(eqx.Module):
    """A policy that turns a system into a term, and a solver into one that respects the constraints."""

    @abc.abstractmethod
    def prepare(
        self, system: AbstractSystem, formulation: AbstractFormulation, solver: diffrax.AbstractSolver, rtol: Scalar
    ) -> tuple[diffrax.AbstractTerm, diffrax.AbstractSolver]:
        """The term to integrate and the solver to do it with.

        **Raises:** `ValueError` for a solver that the policy cannot work with.
        """
