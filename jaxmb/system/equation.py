"""The one equation that every model in the package is a case of.

    kinematics    q̇ = K(t, q, u)
    inertia       M(t, q, u) u̇ = F(t, q, u) + Aᵀ λ + C(t, q, u, λ)
    constraints   Φ(t, q) = 0,   ψ(t, q, u) = 0   →   A u̇ = γ(t, q, u)

`Φ` holds the constraints between positions; `ψ` their time derivatives followed by the nonholonomic rows; the first
rows of A are ∂ψ/∂u, and those of constraints that bind accelerations only may follow. Coordinates may have invariants
of their own (unit Euler parameters): `coordinate_residual` is `Φ` followed by those. `C` is what constraints that are
not ideal do beyond d'Alembert's principle; M depends on u only where velocities are nonlinear in q̇.
"""

import abc
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
from jaxtyping import Array, Float

from .._types import Scalar, State
from ..linalg.inertia import AbstractInertia
from ..linalg.jacobian import AbstractJacobian, EliminationOrder

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class Ranks(eqx.Module):
    """Numbers of independent rows; static. Of Φ along velocities, of `coordinate_residual`, of ψ, and of A."""

    position: int = eqx.field(static=True)
    coordinate: int = eqx.field(static=True)
    velocity: int = eqx.field(static=True)
    acceleration: int = eqx.field(static=True)


class AbstractSystem(eqx.Module):
    """A constrained mechanical system; a pytree with every number a leaf and every choice static.

    Ranks are structural: found once on concrete numbers and static since, so that index sets have static shapes.

    - `nq`, `nu`: numbers of coordinates and of velocities.
    - `position_rows`, `position_rank`: rows of Φ and the number of independent ones.
    - `coordinate_rank`: the same with the coordinates' own invariants.
    - `velocity_rows`, `velocity_rank`: rows of ψ and the number of independent ones.
    - `acceleration_rows`, `acceleration_rank`: rows of A and the number of independent ones.
    - `ideal`: whether C is zero; `regular`: whether M is positive definite, for motions against constraints as well.
    - `rates_are_velocities`: whether q̇ = u.
    - `linear`: whether ψ is linear in u up to a constant term; `homogeneous`: whether that term is zero.
    - `guess`: a state to begin an assembly with; `length` [m]: the size that residuals of positions are relative to.
    - `rows`: name of the part, and number within it, of every row of A.
    - `elimination`: the order in which blocks of A are eliminated; None where A is one dense matrix. Static.
    """

    nq: AbstractVar[int]
    nu: AbstractVar[int]
    position_rows: AbstractVar[int]
    coordinate_rows: AbstractVar[int]
    velocity_rows: AbstractVar[int]
    acceleration_rows: AbstractVar[int]
    ideal: AbstractVar[bool]
    regular: AbstractVar[bool]
    rates_are_velocities: AbstractVar[bool]
    linear: AbstractVar[bool]
    homogeneous: AbstractVar[bool]
    guess: AbstractVar[State]
    length: AbstractVar[Float[Array, ""]]
    ranks: AbstractVar[Ranks]
    rows: AbstractVar[tuple[tuple[str, int], ...]]
    elimination: AbstractVar[EliminationOrder | None]

    @abc.abstractmethod
    def coordinate_names(self) -> dict[str, list[int]]:
        """Indices in q of every name of a coordinate, or of several."""

    @abc.abstractmethod
    def rate_names(self) -> dict[str, list[int]]:
        """Indices in u of every name of a rate, or of several."""

    @abc.abstractmethod
    def parameter_places(self) -> dict[str, list[tuple[Callable[[Any], Array], int | None]]]:
        """Where each parameter stands: accessors of leaves, and the index in it where parts are stacked."""

    @abc.abstractmethod
    def rates(self, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"]) -> Float[Array, "nq"]:
        """`K(t, q, u)`."""

    @abc.abstractmethod
    def inertia(self, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"]) -> AbstractInertia:
        """`M(t, q, u)`."""

    @abc.abstractmethod
    def force(self, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"]) -> Float[Array, "nu"]:
        """`F(t, q, u)`, applied forces and the bias of inertia."""

    @abc.abstractmethod
    def position_residual(self, t: Scalar, q: Float[Array, "nq"]) -> Float[Array, "position_rows"]:
        """`Φ(t, q)`."""

    @abc.abstractmethod
    def coordinate_residual(self, t: Scalar, q: Float[Array, "nq"]) -> Float[Array, "coordinate_rows"]:
        """`Φ(t, q)` and the coordinates' own invariants."""

    @abc.abstractmethod
    def coordinate_jacobian(self, t: Scalar, q: Float[Array, "nq"]) -> Float[Array, "coordinate_rows nq"]:
        """Derivative of `coordinate_residual` with respect to q."""

    @abc.abstractmethod
    def velocity_residual(
        self, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"]
    ) -> Float[Array, "velocity_rows"]:
        """`ψ(t, q, u)`."""

    @abc.abstractmethod
    def jacobian(self, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"]) -> Float[Array, "acceleration_rows nu"]:
        """`A`."""

    @abc.abstractmethod
    def structured_jacobian(self, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"]) -> AbstractJacobian:
        """`A` in blocks where the system has an order of `elimination`, else as a dense matrix without a factor."""

    @abc.abstractmethod
    def constraint_force(
        self, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"], multipliers: Float[Array, "acceleration_rows"]
    ) -> Float[Array, "nu"]:
        """`Aᵀ λ`, without the matrix."""

    @abc.abstractmethod
    def nonideal_force(
        self, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"], multipliers: Float[Array, "acceleration_rows"]
    ) -> Float[Array, "nu"]:
        """`C`, from the multipliers that the constraints would have if they were ideal; only what it does in the
        displacements that the constraints allow counts.
        """

    @abc.abstractmethod
    def acceleration_residual(
        self, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"], udot: Float[Array, "nu"]
    ) -> Float[Array, "acceleration_rows"]:
        """`A u̇ − γ`; its first rows are the time derivative of ψ along the motion."""

    @abc.abstractmethod
    def normalize(self, q: Float[Array, "nq"]) -> Float[Array, "nq"]:
        """The nearest coordinates that satisfy the coordinates' own invariants."""

    @abc.abstractmethod
    def coordinate_scale(self) -> Float[Array, "nq"]:
        """Size of a typical change of each coordinate; without derivative."""

    @abc.abstractmethod
    def velocity_scale(self) -> Float[Array, "nu"]:
        """Size of a typical displacement along each velocity; without derivative."""

    @abc.abstractmethod
    def kinetic_energy(self, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"]) -> Float[Array, ""]:
        """Kinetic energy [J]."""

    @abc.abstractmethod
    def potential_energy(self, t: Scalar, q: Float[Array, "nq"]) -> Float[Array, ""]:
        """Potential energy [J] of gravity and of every conservative force."""

    @property
    def position_rank(self) -> int:
        return self.ranks.position

    @property
    def coordinate_rank(self) -> int:
        return self.ranks.coordinate

    @property
    def velocity_rank(self) -> int:
        return self.ranks.velocity

    @property
    def acceleration_rank(self) -> int:
        return self.ranks.acceleration

    @property
    def plain(self) -> bool:
        """Whether every constraint is ideal and binds velocities."""
        return self.ideal and self.acceleration_rows == self.velocity_rows

    def velocity_jacobian(
        self, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"]
    ) -> Float[Array, "velocity_rows nu"]:
        """`∂ψ/∂u`, the first rows of A."""
        return self.jacobian(t, q, u)[: self.velocity_rows]
