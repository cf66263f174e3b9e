"""The one equation that every model in the package is a case of.

    kinematics    q̇ = K(t, q, u)
    inertia       M(t, q) u̇ = F(t, q, u) + Aᵀ λ
    constraints   Φ(t, q) = 0,   ψ(t, q, u) = 0   →   A u̇ = γ(t, q, u),   A = ∂ψ/∂u

`Φ` holds the constraints between positions; `ψ` their time derivatives followed by the nonholonomic rows. Coordinates
may have invariants of their own (unit Euler parameters): `coordinate_residual` is `Φ` followed by those.
"""

import abc
from typing import TYPE_CHECKING

import equinox as eqx
from jaxtyping import Array, Float

from .._types import Scalar
from .inertia import AbstractInertia

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class AbstractSystem(eqx.Module):
    """A constrained mechanical system; a pytree with every number a leaf and every choice static.

    Ranks are structural: found once on concrete numbers and static since, so that index sets have static shapes.

    - `nq`, `nu`: numbers of coordinates and of velocities.
    - `position_rows`, `position_rank`: rows of Φ and the number of independent ones.
    - `coordinate_rank`: the same with the coordinates' own invariants.
    - `velocity_rows`, `velocity_rank`: rows of ψ and the number of independent ones.
    - `rates_are_velocities`: whether q̇ = u.
    - `linear`: whether ψ is linear in u up to a constant term; `homogeneous`: whether that term is zero.
    """

    nq: AbstractVar[int]
    nu: AbstractVar[int]
    position_rows: AbstractVar[int]
    position_rank: AbstractVar[int]
    coordinate_rows: AbstractVar[int]
    coordinate_rank: AbstractVar[int]
    velocity_rows: AbstractVar[int]
    velocity_rank: AbstractVar[int]
    rates_are_velocities: AbstractVar[bool]
    linear: AbstractVar[bool]
    homogeneous: AbstractVar[bool]

    @abc.abstractmethod
    def rates(self, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"]) -> Float[Array, "nq"]:
        """`K(t, q, u)`."""

    @abc.abstractmethod
    def inertia(self, t: Scalar, q: Float[Array, "nq"]) -> AbstractInertia:
        """`M(t, q)`."""

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
    def jacobian(self, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"]) -> Float[Array, "velocity_rows nu"]:
        """`A = ∂ψ/∂u`."""

    @abc.abstractmethod
    def constraint_force(
        self, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"], multipliers: Float[Array, "velocity_rows"]
    ) -> Float[Array, "nu"]:
        """`Aᵀ λ`, without the matrix."""

    @abc.abstractmethod
    def acceleration_residual(
        self, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"], udot: Float[Array, "nu"]
    ) -> Float[Array, "velocity_rows"]:
        """`A u̇ − γ`, the time derivative of ψ along the motion."""

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
