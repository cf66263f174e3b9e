"""What Newton's method of an implicit step asks of the derivatives of a field, whatever their structure."""

import abc
from typing import TYPE_CHECKING, Any

import equinox as eqx
from jaxtyping import Array, Bool, Complex, Float, Int

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class AbstractLinearization(eqx.Module):
    """How a state and its derivatives in time change with the unknowns of a step `y = past + a f + b g`.

    **Fields:** `spectrum`: eigenvalues of the derivative J of the field; `renewals`: the number of next steps that must
    compute their own linearisation; `is_structured`: whether the unknowns are all components of the state, which is
    then projected on the manifold.

    `free` are the indices of the unknowns among the components of the state, and `inverses` what `inverses(a, b, free)`
    returns.
    """

    spectrum: AbstractVar[Complex[Array, " k"]]
    renewals: AbstractVar[Int[Array, ""]]
    is_structured: AbstractVar[bool]

    @property
    @abc.abstractmethod
    def patience(self) -> int:
        """The number of iterations that cost about as much as a new linearisation."""

    @property
    @abc.abstractmethod
    def slow(self) -> float:
        """The linearisation is renewed after a step whose corrections shrank more slowly than by this factor."""

    @abc.abstractmethod
    def inverses(self, a: Any, b: Any, free: Int[Array, " free"]) -> Any:
        """The solved form of Newton's equation."""

    @abc.abstractmethod
    def no_inverses(self, a: Any, b: Any, free: Int[Array, " free"]) -> Any:
        """Zeros in its place."""

    @abc.abstractmethod
    def observed(self, inverses: Any, anew: Bool[Array, ""]) -> Any:
        """With a spectrum that needs the inverses; `anew`: whether the linearisation is new."""

    @abc.abstractmethod
    def moved(self, change: Float[Array, " free"]) -> Float[Array, " n"]:
        """The change of the state with the unknowns."""

    @abc.abstractmethod
    def correction(
        self,
        inverses: Any,
        offset: Float[Array, " n"],
        f: Float[Array, " n"],
        g: Float[Array, " n"],
        along: Float[Array, " n"],
        b: Any,
        free: Int[Array, " free"],
    ) -> tuple[Float[Array, " free"], Float[Array, " free"], Float[Array, " n"], Float[Array, " n"]]:
        """The correction of the unknowns, with and without the derivative of g at a held rate, and f and g after it.

        **Arguments:** `offset`: `y - past`; `f`, `g`: at y, g along a rate `along` that f approaches.
        """

    @abc.abstractmethod
    def errors(
        self, inverses: Any, changes: Float[Array, "formulas n"], free: Int[Array, " free"]
    ) -> Float[Array, "formulas n"]:
        """The changes of the solution with those of the past, also of what does not follow from the unknowns."""
