"""The equation of motion of every model in the package.

    kinematics    q̇ = K(t, q, u)
    inertia       M(t, q, u) u̇ = F(t, q, u) + Aᵀ λ + C(t, q, u, λ)
    constraints   Φ(t, q) = 0,   ψ(t, q, u) = 0   →   A u̇ = γ(t, q, u)

`Φ` holds the position constraints; `ψ` their time derivatives, followed by the nonholonomic rows. The first rows of A
are ∂ψ/∂u; rows of constraints on accelerations alone may follow. Coordinates may have invariants (unit Euler
parameters), which follow `Φ` in `coordinate_residual`. `C` holds the non-ideal constraint forces, which do virtual
work; M depends on u only where velocities are nonlinear in q̇.
"""

import abc
from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING, Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._types import Scalar, State
from ..linalg.block_jacobian import JointOrder
from ..linalg.inertia import AbstractInertia
from ..linalg.jacobian import AbstractJacobian
from ..parts.series import AbstractSignal
from .description import Description
from .design_variables import DesignVariables
from .picture import Picture
from .quantities import Quantity, Reaction

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


# From this number of velocities on, implicit methods eliminate in blocks. (A step of eight cars with draft gears, 24
# velocities, takes 0.5 ms so and 6.4 ms with dense matrices; small machines with joints have cheap dense ones.)
_LEAST_VELOCITIES = 40

# An accessor of an array of the system, and the index of the parameter along axis 0 where parts are stacked.
ParameterPath = tuple[Callable[[Any], Array], int | None]


class Ranks(eqx.Module):
    """Numbers of independent rows of Φ along velocities, of `coordinate_residual`, of ψ and of A; static."""

    position: int = eqx.field(static=True)
    coordinate: int = eqx.field(static=True)
    velocity: int = eqx.field(static=True)
    acceleration: int = eqx.field(static=True)


class AbstractSystem(eqx.Module):
    """A constrained mechanical system; a pytree with every number a leaf and every choice static.

    Ranks are found once, on concrete numbers, and are static, so that index sets have static shapes.

    - `nq`, `nu`: numbers of coordinates and of velocities; `state_ends`: for each kind of internal state, in the order
        of z, the index after the last one of this kind.
    - `position_rows`, `position_rank`: rows of Φ and the number of independent ones.
    - `coordinate_rank`: the same with the coordinates' own invariants.
    - `velocity_rows`, `velocity_rank`: rows of ψ and the number of independent ones.
    - `acceleration_rows`, `acceleration_rank`: rows of A and the number of independent ones.
    - `ideal`: whether C is zero; `friction_parts`: names of the parts that C depends on the multipliers of.
    - `positive_definite_mass`: whether M is positive definite for all velocities, also those that violate constraints.
    - `rates_are_velocities`: whether q̇ = u.
    - `linear`: whether ψ is linear in u up to a constant term; `drift_free`: whether that term is zero.
    - `has_bodies`: whether the system has bodies; `Trajectory[name]` is the motion of a body if so, otherwise of a
        coordinate.
    - `guess`: the default guess of `assemble`; `length` [m]: the scale of position residuals.
    - `rows`: for every row of A, the name of its part and its number within the part.
    - `elimination`: the order in which blocks of A are eliminated; None where A is one dense matrix. Static.
    - `design`: the design variables, in the order in which they were added; those of later ones may determine earlier
        ones.
    """

    nq: AbstractVar[int]
    nu: AbstractVar[int]
    state_ends: AbstractVar[tuple[int, ...]]
    position_rows: AbstractVar[int]
    coordinate_rows: AbstractVar[int]
    velocity_rows: AbstractVar[int]
    acceleration_rows: AbstractVar[int]
    ideal: AbstractVar[bool]
    friction_parts: AbstractVar[frozenset[str]]
    positive_definite_mass: AbstractVar[bool]
    rates_are_velocities: AbstractVar[bool]
    linear: AbstractVar[bool]
    drift_free: AbstractVar[bool]
    has_bodies: AbstractVar[bool]
    guess: AbstractVar[State]
    length: AbstractVar[Float[Array, ""]]
    ranks: AbstractVar[Ranks]
    rows: AbstractVar[tuple[tuple[str, int], ...]]
    elimination: AbstractVar[JointOrder | None]
    design: AbstractVar[tuple[DesignVariables, ...]]

    @abc.abstractmethod
    def coordinate_names(self) -> dict[str, list[int]]:
        """Indices in q by name; one name may denote several coordinates."""

    @abc.abstractmethod
    def rate_names(self) -> dict[str, list[int]]:
        """Indices in u by name; one name may denote several rates."""

    # Internal states z, for which ż = h(t, q, u, z). Forces depend on them, constraints do not, so the equations above
    # hold as they are for a system that has its states.

    @abc.abstractmethod
    def state_names(self) -> dict[str, list[int]]:
        """Indices in z by name; one name may denote several internal states."""

    @abc.abstractmethod
    def with_states(self, z: Float[Array, "nz"]) -> Self:
        """The same system with values of its internal states, which its forces and `state_rates` need."""

    @abc.abstractmethod
    def state_rates(self, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"]) -> Float[Array, "nz"]:
        """ż, of a system that has its internal states."""

    @abc.abstractmethod
    def state_scale(self) -> Float[Array, "nz"]:
        """Typical size of each internal state; without derivative."""

    @abc.abstractmethod
    def parameter_paths(self) -> dict[str, list[ParameterPath]]:
        """Paths to the arrays that hold each parameter, by name."""

    @abc.abstractmethod
    def positive_parameters(self) -> frozenset[str]:
        """Names of the parameters that must stay positive or, if they are matrices, positive definite."""

    @abc.abstractmethod
    def check_parameters(self, names: Collection[str]) -> None:
        """Raise a `ValueError` for values of these parameters that are out of range; traced ones are left to
        `parameters_in_range`.
        """

    @abc.abstractmethod
    def parameters_in_range(self) -> bool | Bool[Array, ""]:
        """Whether all parameters that are traced are in their ranges; True if none are traced."""

    @abc.abstractmethod
    def signals(self) -> dict[str, tuple[AbstractSignal, bool]]:
        """The parameters that are functions of time, by name; and whether constraints depend on them."""

    @abc.abstractmethod
    def with_signals(self, signals: Mapping[str, AbstractSignal]) -> Self:
        """A copy with some parameters as functions of time; shapes have been checked.

        **Raises:** `ValueError` for parameters that must be constant.
        """

    @abc.abstractmethod
    def describe(self) -> Description:
        """A description of parts, rows, degrees of freedom and redundant rows, as text and as HTML."""

    # A motion, with time as axis 0: `ts` of shape (times,), `ys` a `State`, `multipliers` of shape (times, rows).

    @abc.abstractmethod
    def motion_names(self) -> tuple[str, ...]:
        """Names of the bodies, or of the coordinates of a system without bodies."""

    @abc.abstractmethod
    def motion(self, name: str, ys: State) -> Any:
        """The motion of one of `motion_names`: a `BodyMotion`, or the values of a coordinate, shape (times,)."""

    @abc.abstractmethod
    def quantities(self) -> dict[str, Quantity]:
        """The quantities that can be measured of a motion, by name."""

    @abc.abstractmethod
    def joint_coordinates(self) -> Mapping[str, Any]:
        """The own coordinates of joints, by name; each has a `shape`. Empty for a system without bodies."""

    @abc.abstractmethod
    def joint_coordinate(self, coordinate: Any, t: Scalar, q: Float[Array, "nq"]) -> Float[Array, "*shape"]:
        """The value of one of `joint_coordinates`; an angle known up to full turns is in (−π, π]."""

    @abc.abstractmethod
    def holding(self, values: Mapping[str, Array], rates: Mapping[str, Array], t: Scalar) -> Self:
        """The same system with coordinates of joints held at values, which change at some rates, from t on."""

    @abc.abstractmethod
    def position_quantities(self) -> tuple[str, ...]:
        """Names of the quantities that determine the configuration up to the attitude of bodies."""

    @abc.abstractmethod
    def picture(self, ts: Float[Array, "times"], ys: State) -> Picture:
        """The bodies and parts that a picture shows along a motion.

        **Raises:** `ValueError` for a system without bodies.
        """

    @abc.abstractmethod
    def not_finite(self, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"]) -> tuple[str, ...]:
        """What is not finite at a state: forces, residuals and rates of internal states by name; for messages."""

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
        """`C`, from the multipliers λ of the same equation."""

    @abc.abstractmethod
    def acceleration_residual(
        self, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"], udot: Float[Array, "nu"]
    ) -> Float[Array, "acceleration_rows"]:
        """`A u̇ − γ`; its first rows are the time derivative of ψ along the motion."""

    @abc.abstractmethod
    def normalize(self, q: Float[Array, "nq"]) -> Float[Array, "nq"]:
        """The nearest coordinates that satisfy the coordinates' own invariants."""

    @abc.abstractmethod
    def normalize_fixed(self, q: Float[Array, "nq"], fixed: Bool[np.ndarray, "nq"]) -> tuple[Float[Array, "nq"], int]:
        """Coordinates that satisfy the invariants of fixed entries alone, and the number of these invariants.

        Such invariants have no free coordinate that could satisfy them.
        """

    @abc.abstractmethod
    def held_velocities(self, held: Bool[np.ndarray, "nq"]) -> Bool[np.ndarray, "nu"] | None:
        """The velocities along which held coordinates do not move; None where some of a rotation is held but not all
        of it.
        """

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

    # Of bodies; a system without bodies raises a `ValueError`.

    @abc.abstractmethod
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""

    @abc.abstractmethod
    def reaction(
        self, name: str, ts: Float[Array, "times"], ys: State, multipliers: Float[Array, "times rows"]
    ) -> Reaction:
        """Reactions of one joint along a motion."""

    @abc.abstractmethod
    def force_names(self) -> tuple[str, ...]:
        """Names of the force elements."""

    @abc.abstractmethod
    def applied_wrenches(
        self, name: str, ts: Float[Array, "times"], ys: State, multipliers: Float[Array, "times rows"] | None
    ) -> Float[Array, "times bodies v"]:
        """Wrenches of one force element, or of the friction of one joint, on its bodies along a motion. `multipliers`
        of the rows may be None if the constraints are ideal.
        """

    @abc.abstractmethod
    def linear_momentum(self, q: Float[Array, "nq"], u: Float[Array, "nu"]) -> Float[Array, "d"]:
        """`Σ m v` [kg m/s], world axes."""

    @abc.abstractmethod
    def angular_momentum(self, q: Float[Array, "nq"], u: Float[Array, "nu"]) -> Float[Array, "*d"]:
        """Moment of momentum about the world origin [kg m²/s]; a scalar in the plane, shape (3,) in world axes in
        space.
        """

    @abc.abstractmethod
    def with_frames_of(self, before: Self) -> Self:
        """The system with the guess of its bodies' frames from before its parameters changed: where the mass centre of
        a body was moved in its frame, the guess of the mass centre follows.
        """

    def at(self, y: State) -> Self:
        """The same system with the internal states of a state, if there are any."""
        return self if y.z is None else self.with_states(y.z)

    @property
    def nz(self) -> int:
        """The number of internal states."""
        return self.state_ends[-1] if self.state_ends else 0

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
    def friction_rows(self) -> Int[np.ndarray, "k"]:
        """Numbers of the rows of A that C depends on the multipliers of."""
        parts = self.friction_parts
        return np.array([k for k, (name, _) in enumerate(self.rows) if name in parts], int)

    @property
    def ideal_on_velocities(self) -> bool:
        """Whether every constraint is ideal and binds velocities."""
        return self.ideal and self.acceleration_rows == self.velocity_rows

    @property
    def implicit_in_blocks(self) -> bool:
        """Whether implicit methods eliminate bodies and joints in blocks by default: where a scene is so large that
        this is faster, unless constraints are not ideal or bind accelerations, or parts have internal states.
        """
        in_blocks = self.elimination is not None or self.acceleration_rows == 0
        plain = self.has_bodies and self.ideal_on_velocities and self.nz == 0
        return plain and in_blocks and self.nu >= _LEAST_VELOCITIES

    def velocity_jacobian(
        self, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"]
    ) -> Float[Array, "velocity_rows nu"]:
        """`∂ψ/∂u`, the first rows of A."""
        return self.jacobian(t, q, u)[: self.velocity_rows]

    def constraint_names(self) -> tuple[str, ...]:
        """Names of the parts that exert constraint forces."""
        return tuple(dict.fromkeys(name for name, _ in self.rows))

    @eqx.filter_jit
    def rates_along(self, ts: Float[Array, "times"], ys: State) -> Float[Array, "times nq"]:
        """q̇ along a motion."""
        return jax.vmap(lambda t, y: self.rates(t, y.q, y.u))(ts, ys)

    @eqx.filter_jit
    def generalized_constraint_force(
        self, name: str, ts: Float[Array, "times"], ys: State, multipliers: Float[Array, "times rows"]
    ) -> Float[Array, "times nu"]:
        """The contribution of one constraint to `Aᵀ λ`, along a motion."""
        own = jnp.array([row == name for row, _ in self.rows])
        multipliers = jnp.where(own[None, :], multipliers, jnp.zeros_like(multipliers))
        return jax.vmap(lambda t, y, own: self.constraint_force(t, y.q, y.u, own))(ts, ys, multipliers)

    def __str__(self) -> str:
        return str(self.describe())

    def _repr_html_(self) -> str:
        return self.describe()._repr_html_()
