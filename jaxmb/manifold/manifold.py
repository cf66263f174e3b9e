"""A manifold policy: how the state stays on the constraints while it is integrated."""

import abc
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp

from .._types import Scalar
from ..formulations import AbstractFormulation
from ..linalg.arrays import as_array, namespace
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


def newton_tolerance(given: float | None, rtol: Scalar) -> Any:
    """Size of the last Newton correction of positions relative to the system's size: as given, or tied to the tolerance
    of integration.
    """
    dtype = jnp.result_type(float)
    if given is not None:
        return as_array(given, dtype)
    return namespace(rtol).clip(1e-3 * rtol, 64 * float(jnp.finfo(dtype).eps), 1e-6)
