"""The equation of motion of every model in the package.

    kinematics    q̇ = K(t, q, u)
    inertia       M(t, q, u) u̇ = F(t, q, u) + Aᵀ λ + C(t, q, u, λ)
    constraints   Φ(t, q) = 0,   ψ(t, q, u) = 0   →   A u̇ = γ(t, q, u)

`Φ` holds the position constraints; `ψ` their time derivatives, followed by the nonholonomic rows. The first rows of A
are ∂ψ/∂u; rows of constraints on accelerations alone may follow. Coordinates may have invariants (unit Euler
parameters), which follow `Φ` in `coordinate_residual`. `C` holds the non-ideal constraint forces, which do virtual
work. M depends on u only if velocities are nonlinear in q̇.
"""

import abc
from typing import TYPE_CHECKING, Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._types import Coordinates, Scalar, State, Velocities
from ..linalg.block_jacobian import JointOrder
from ..linalg.inertia import AbstractInertia
from ..linalg.jacobian import AbstractJacobian, DenseJacobian
from ..solvers.manifold_term import AbstractFieldJacobian, GapsSeen
from .contact_set import ContactLaws, ContactSet, LawTable
from .velocity_facts import VelocityFact, is_drift_free, is_linear

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class Ranks(eqx.Module):
    """Numbers of independent rows of Φ along velocities, of `coordinate_residual`, of ψ and of A; static."""

    position: int = eqx.field(static=True)
    coordinate: int = eqx.field(static=True)
    velocity: int = eqx.field(static=True)
    acceleration: int = eqx.field(static=True)


class AbstractEquation(eqx.Module):
    """The equation of a constrained mechanical system; a pytree with every number a leaf and every choice static.

    Formulations, manifolds and the search for states see a system as this equation.

    A class gives `nq`, `nu`, `length`, `inertia`, `force` and the scales. With constraints it gives residuals of
    positions, velocities and accelerations, which are differentiated automatically. All other members have the values
    of a system without constraints and internal states, where velocities are the rates of coordinates.

    Ranks are found once, on concrete numbers, and are static, so that index sets have static shapes.

    - `nq`, `nu`: numbers of coordinates and of velocities.
    - `length` [m]: the scale of position residuals.
    - `ranks`: the numbers of independent rows.
    - `positive_definite_mass`: whether M is positive definite for all velocities, even if they violate constraints.
    - `linear`: whether ψ is linear in u up to a constant term; `drift_free`: whether that term is zero. By default they
        are found from ψ, and hold for all numbers of the system.
    - `elimination`: the order of elimination of the blocks of A; None for one dense matrix. Static.
    - `contacts`: the unilateral constraints and dry friction. Static. A system with dry friction has
        `friction_reactions` as well.
    """

    nq: AbstractVar[int]
    nu: AbstractVar[int]
    length: AbstractVar[Float[Array, ""]]

    ranks: ClassVar[Ranks] = Ranks(0, 0, 0, 0)
    positive_definite_mass: ClassVar[bool] = True
    linear: ClassVar[Any] = VelocityFact(is_linear)
    drift_free: ClassVar[Any] = VelocityFact(is_drift_free)
    elimination: ClassVar[JointOrder | None] = None
    contacts: ClassVar[ContactSet] = ContactSet()

    # Sizes

    @property
    def position_rows(self) -> int:
        """The number of rows of Φ."""
        return 0

    @property
    def coordinate_rows(self) -> int:
        """The number of rows of Φ and of the coordinates' invariants."""
        return self.position_rows

    @property
    def velocity_rows(self) -> int:
        """The number of rows of ψ."""
        return self.position_rows

    @property
    def acceleration_rows(self) -> int:
        """The number of rows of A."""
        return self.velocity_rows

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

    # Kinematics and inertia

    def placed(self, t: Scalar, q: Coordinates) -> Any:
        """What several functions of (t, q) share, computed once at an instant; None if they share nothing. With
        `contacts` it has a `ContactPlace` of this name.
        """
        del t, q

    def moving(self, placed: Any, u: Velocities) -> Any:
        """What several functions of (t, q, u) share. Such functions take it as `now`, if it is known. With `contacts`
        it has a `ContactMotion` of this name.
        """
        del placed, u

    @property
    def rates_are_velocities(self) -> bool:
        """Whether q̇ = u."""
        return True

    def rates(self, t: Scalar, q: Coordinates, u: Velocities) -> Float[Array, "nq"]:
        """`K(t, q, u)`."""
        return u

    def normalize(self, t: Scalar, q: Coordinates) -> Float[Array, "nq"]:
        """The nearest coordinates that satisfy the coordinates' invariants at a time."""
        del t
        return q

    @abc.abstractmethod
    def coordinate_scale(self) -> Float[Array, "nq"]:
        """The size of a typical change of each coordinate; without derivative."""

    @abc.abstractmethod
    def velocity_scale(self) -> Float[Array, "nu"]:
        """The size of a typical displacement along each velocity; without derivative."""

    @abc.abstractmethod
    def inertia(self, t: Scalar, q: Coordinates, u: Velocities) -> AbstractInertia:
        """`M(t, q, u)`."""

    @abc.abstractmethod
    def force(self, t: Scalar, q: Coordinates, u: Velocities) -> Float[Array, "nu"]:
        """`F(t, q, u)`: applied forces and the bias of inertia."""

    # Internal states z with ż = h(t, q, u, z). Forces, laws of contacts and inertia may depend on z, constraints do
    # not. So the equations above hold as they are for a system that holds values of its states.

    @property
    def nz(self) -> int:
        """The number of internal states."""
        return 0

    def with_states(self, z: Float[Array, "nz"]) -> Self:
        """The same system with values of its internal states."""
        del z
        return self

    def at(self, y: State) -> Self:
        """The same system with the internal states of a state, if any."""
        return self if y.z is None else self.with_states(y.z)

    def state_rates(self, t: Scalar, q: Coordinates, u: Velocities) -> Float[Array, "nz"]:
        """ż; the system must hold values of its internal states."""
        del t, u
        return jnp.zeros(0, q.dtype)

    def state_scale(self) -> Float[Array, "nz"]:
        """The typical size of each internal state; without derivative."""
        return jnp.zeros(0)

    # Constraints

    def position_residual(self, t: Scalar, q: Coordinates) -> Float[Array, "position_rows"]:
        """`Φ(t, q)`."""
        del t
        return jnp.zeros(0, q.dtype)

    def coordinate_residual(self, t: Scalar, q: Coordinates) -> Float[Array, "coordinate_rows"]:
        """`Φ(t, q)` and the coordinates' invariants."""
        return self.position_residual(t, q)

    @eqx.filter_jit
    def coordinate_jacobian(self, t: Scalar, q: Coordinates) -> Float[Array, "coordinate_rows nq"]:
        """The derivative of `coordinate_residual` by q."""
        return jax.jacfwd(self.coordinate_residual, 1)(t, q)

    def velocity_residual(self, t: Scalar, q: Coordinates, u: Velocities) -> Float[Array, "velocity_rows"]:
        """`ψ(t, q, u)`."""
        del t, u
        return jnp.zeros(0, q.dtype)

    def acceleration_residual(
        self, t: Scalar, q: Coordinates, u: Velocities, udot: Float[Array, "nu"]
    ) -> Float[Array, "acceleration_rows"]:
        """`A u̇ − γ`; its first rows are the time derivative of ψ along the motion."""
        del t, u, udot
        return jnp.zeros(0, q.dtype)

    @eqx.filter_jit
    def jacobian(self, t: Scalar, q: Coordinates, u: Velocities) -> Float[Array, "acceleration_rows nu"]:
        """`A`."""
        # Residuals are linear in accelerations, so their derivative is the same at all accelerations.
        return jax.jacfwd(self.acceleration_residual, 3)(t, q, u, jnp.zeros_like(u))

    def structured_jacobian(self, t: Scalar, q: Coordinates, u: Velocities) -> AbstractJacobian:
        """`A` in blocks if the system has an order of `elimination`, else a dense matrix without a factor."""
        return DenseJacobian(self.jacobian(t, q, u))

    @eqx.filter_jit
    def constraint_force(
        self, t: Scalar, q: Coordinates, u: Velocities, multipliers: Float[Array, "acceleration_rows"]
    ) -> Float[Array, "nu"]:
        """`Aᵀ λ`, without the matrix."""
        _, pull = jax.vjp(lambda udot: self.acceleration_residual(t, q, u, udot), jnp.zeros_like(u))
        return pull(multipliers)[0]

    def held_velocities(self, held: Bool[np.ndarray, "nq"]) -> Bool[np.ndarray, "nu"] | None:
        """The velocities that leave held coordinates unchanged; None where a rotation is held in part."""
        return held if self.rates_are_velocities else None

    # Constraints that are not ideal

    @property
    def ideal(self) -> bool:
        """Whether C is zero."""
        return True

    @property
    def ideal_on_velocities(self) -> bool:
        """Whether every constraint is ideal and binds velocities."""
        return self.ideal and self.acceleration_rows == self.velocity_rows

    @property
    def ideal_without_friction(self) -> bool:
        """`ideal_on_velocities`, if no dry friction slips."""
        return self.ideal_on_velocities

    @property
    def friction_rows(self) -> Int[np.ndarray, "k"]:
        """Indices of the rows of A on whose multipliers C depends."""
        return np.zeros(0, int)

    def nonideal_force(
        self, t: Scalar, q: Coordinates, u: Velocities, multipliers: Float[Array, "acceleration_rows"]
    ) -> Float[Array, "nu"]:
        """`C`, from the multipliers λ."""
        del t, q, multipliers
        return jnp.zeros_like(u)

    # Gaps of compliant contacts

    @property
    def has_gaps(self) -> bool:
        """Whether some forces act only at closed gaps, for `gaps_seen`."""
        return False

    def gaps_seen(self, t: Scalar, q: Coordinates, u: Velocities) -> GapsSeen:
        """The gaps of forces that act only at closed gaps."""
        raise ValueError(f"{type(self).__name__} has no forces with gaps.")

    # Headings

    def headings(self, t: Scalar, q: Coordinates) -> Float[Array, "headings d"]:
        """Vectors whose directions the equations need; a motion ends where one of them vanishes."""
        del t
        return jnp.zeros((0, 0), q.dtype)

    # Unilateral constraints

    def contact_laws(self, t: Scalar) -> ContactLaws:
        """The laws of `contacts` at a time; their numbers are parameters, and some may be inputs."""
        del t
        none = LawTable((), (), jnp.zeros(0))
        return ContactLaws(none, none, none.none)

    # Implicit methods

    @property
    def has_field_jacobian(self) -> bool:
        """Whether `field_jacobian` exists, so that implicit methods can eliminate in blocks."""
        return False

    @property
    def implicit_in_blocks(self) -> bool:
        """Whether implicit methods eliminate in blocks by default, as the faster way."""
        return False

    def field_jacobian(self, t: Scalar, y: State) -> AbstractFieldJacobian:
        """The derivative of the equations of motion along the constraints, at a state on them."""
        raise ValueError(f"{type(self).__name__} does not know the structure of its derivative; use Partition().")
