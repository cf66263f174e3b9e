"""Names, parameters and measured quantities of a model, beside its equation."""

import abc
from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._types import Coordinates, Scalar, State, Velocities
from ..linalg.arrays import is_traced
from ..parts.series import AbstractSignal
from .description import Description, count_independent, count_rows, counted, remarks, shorten
from .design_variables import DesignVariables, description_rows, variables_in_range
from .equation import AbstractEquation
from .picture import Picture
from .quantities import Measure, Quantities, Quantity, Reaction, entries_along, view_of_motion
from .structures import of_structure

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar

# An accessor of an array of the system, and the index of the parameter along axis 0 where parts are stacked.
ParameterPath = tuple[Callable[[Any], Array], int | None]


class AbstractSystem(AbstractEquation):
    """A model: an equation of motion whose numbers have names.

    Methods have the values of a model without bodies, whose motion is that of its coordinates: measurable quantities
    are the coordinates, their rates q̇, and generalized constraint forces, `"theta"`, `"theta_rate"`, `"A.force"`.

    - `guess`: the default guess of `assemble`.
    - `design`: the design variables, in the order in which they were added; those of later ones may determine earlier
        ones.
    - `rows`: for every row of A, the name of its part and its number within the part.
    - `state_ends`: for each kind of internal state, in the order of z, the index after the last one of this kind.
    - `friction_parts`: names of the parts whose multipliers non-ideal forces depend on.
    - `body_names`: names of the bodies; `Trajectory[name]` is the motion of a body if there are any, otherwise of a
        coordinate.
    """

    guess: AbstractVar[State]
    design: AbstractVar[tuple[DesignVariables, ...]]

    state_ends: ClassVar[tuple[int, ...]] = ()
    friction_parts: ClassVar[frozenset[str]] = frozenset()
    rows: ClassVar[tuple[tuple[str, int], ...]] = ()
    body_names: ClassVar[tuple[str, ...]] = ()

    def prepared(self) -> Self:
        """The system for the steps of a motion, whose states are close to the constraints, with what depends on its
        parameters alone computed once; itself where there is no such thing.
        """
        return self

    def closing(self) -> Self:
        """The system whose rows, with `half_turned`, tell whether a state is consistent."""
        return self.prepared()

    def half_turned(self, q: Coordinates) -> Any:
        """Which rows of Φ vanish at q because the system is `prepared`, with a joint turned away from where its
        residual vanishes; False without such rows.
        """
        del q
        return False

    def on_host(self, t: Scalar) -> Any:
        """The constraints at a time in NumPy, whose numbers are known, so that little or nothing is compiled to satisfy
        them once; None where there is no such form.
        """
        return None

    @property
    def nz(self) -> int:
        return self.state_ends[-1] if self.state_ends else 0

    @property
    def friction_rows(self) -> Int[np.ndarray, "k"]:
        parts = self.friction_parts
        return np.array([k for k, (name, _) in enumerate(self.rows) if name in parts], int)

    # Coordinates

    @abc.abstractmethod
    def coordinate_names(self) -> dict[str, list[int]]:
        """Indices in q by name; one name may denote several coordinates."""

    def rate_names(self) -> dict[str, list[int]]:
        """Indices in u by name; one name may denote several rates."""
        return {f"{name}_rate": index for name, index in self.coordinate_names().items()}

    def state_names(self) -> dict[str, list[int]]:
        """Indices in z by name; one name may denote several internal states."""
        return {}

    def normalize_fixed(self, q: Coordinates, fixed: Bool[np.ndarray, "nq"]) -> tuple[Float[Array, "nq"], int]:
        """Coordinates that satisfy the invariants of fixed entries alone, and the number of these invariants.

        Such invariants have no free coordinate that could satisfy them.
        """
        del fixed
        return q, 0

    def joint_coordinates(self) -> Mapping[str, Any]:
        """The own coordinates of joints, by name; each has a `shape`."""
        return {}

    def joint_coordinate(self, coordinate: Any, t: Scalar, q: Coordinates) -> Float[Array, "*shape"]:
        """The value of one of `joint_coordinates`; an angle known up to full turns is in (−π, π]."""
        raise ValueError("This system has no joints between bodies, and so no coordinates of joints.")

    def holding(self, values: Mapping[str, Array], rates: Mapping[str, Array], t: Scalar) -> Self:
        """The same system with coordinates of joints held at values, which change at some rates, from t on."""
        del values, rates, t
        return self

    # Parameters

    def parameter_paths(self) -> dict[str, list[ParameterPath]]:
        """Paths to the arrays that hold each parameter, by name."""
        return {}

    def module_structures(self) -> dict[str, eqx.Module]:
        """The modules whose weights are parameters, by name, with shapes in place of the weights."""
        return {}

    def positive_parameters(self) -> frozenset[str]:
        """Names of the parameters that must stay positive or, if they are matrices, positive definite."""
        return frozenset()

    def check_parameters(self, names: Collection[str]) -> None:
        """Raise a `ValueError` for values of these parameters that are out of range; traced ones are left to
        `parameters_in_range`.
        """
        for name in self.positive_parameters() & set(names):
            value = self._parameter(name)
            if not is_traced(value) and not np.all(np.asarray(value) > 0):
                raise ValueError(f"Parameter {name!r} must be positive, got {np.asarray(value)}.")

    def parameters_in_range(self) -> bool | Bool[Array, ""]:
        """Whether all parameters that are traced are in their ranges; True if none are traced."""
        values = [self._parameter(name) for name in sorted(self.positive_parameters())]
        traced = [jnp.all(value > 0) for value in values if is_traced(value)]
        return (jnp.all(jnp.stack(traced)) if traced else True) & variables_in_range(self.design)

    def _parameter(self, name):
        where, index = self.parameter_paths()[name][0]
        return where(self) if index is None else where(self)[index]

    def with_frames_of(self, before: Self) -> Self:
        """The same system with its bodies' frames where they were before parameters changed."""
        del before
        return self

    @property
    def signals(self) -> dict[str, tuple[AbstractSignal, bool]]:
        """The parameters that are functions of time, by name; and whether constraints depend on them."""
        return {}

    @of_structure
    def input_names(self) -> dict[str, None]:
        """The names of these parameters."""
        return dict.fromkeys(self.signals)

    def with_signals(self, signals: Mapping[str, AbstractSignal]) -> Self:
        """A copy with some parameters as functions of time; shapes have been checked.

        **Raises:** `ValueError` for parameters that must be constant.
        """
        raise ValueError(f"{type(self).__name__} takes no inputs; got {', '.join(signals)}.")

    # Functions of time

    @property
    def of_time(self) -> bool:
        """Whether parts have functions of time from the user, for `given_in_time`."""
        return False

    def given_in_time(self, t: Scalar, q: Coordinates, u: Velocities) -> Float[Array, "k"]:
        """What these functions give while nothing moves, such as a prescribed motion or a force; of many parts of one
        kind a combination. Empty where `of_time` is False.
        """
        return jnp.zeros(0, q.dtype)

    # Energy

    @abc.abstractmethod
    def kinetic_energy(self, t: Scalar, q: Coordinates, u: Velocities) -> Float[Array, ""]:
        """Kinetic energy [J]."""

    @abc.abstractmethod
    def potential_energy(self, t: Scalar, q: Coordinates) -> Float[Array, ""]:
        """Potential energy [J] of gravity and of every conservative force."""

    # A motion, with time as axis 0: `ts` of shape (times,), `ys` a `State`, `multipliers` of shape (times, rows).

    def motion_names(self) -> tuple[str, ...]:
        """Names of the bodies, or of the coordinates of a system without bodies."""
        return tuple(self.coordinate_names())

    def motion(self, name: str, ys: State) -> Any:
        """The motion of one of `motion_names`: a `BodyMotion`, or the values of a coordinate, shape (times,)."""
        return _coordinate(np.array(self.coordinate_names()[name][0]), ys.q)

    def quantities(self) -> Mapping[str, Quantity]:
        """The quantities that can be measured of a motion, by name."""
        return Quantities(self, self.measures())

    @of_structure
    def measures(self) -> dict[str, Measure]:
        """The same for all systems of this structure."""
        names, out = self.coordinate_names(), {}
        for name in self.motion_names():
            out[name] = Measure((), entries_along, ("q", np.array(names[name][0]), ()))
        for name, (index,) in names.items():
            out[f"{name}_rate"] = Measure((), _rate_along, np.array(index))
        for name in self.constraint_names():
            out[f"{name}.force"] = Measure((self.nu,), _force_along, self._rows_of(name), of_forces=True)
        return out

    def position_quantities(self) -> tuple[str, ...]:
        """Names of the quantities that determine the configuration up to the attitude of bodies."""
        return self.motion_names()

    def rates_along(self, ts: Float[Array, "times"], ys: State) -> Float[Array, "times nq"]:
        """q̇ along a motion."""
        return _rates_along(self, (), ts, ys)

    def constraint_names(self) -> tuple[str, ...]:
        """Names of the parts that exert constraint forces."""
        return tuple(dict.fromkeys(name for name, _ in self.rows))

    def _rows_of(self, name) -> Bool[np.ndarray, "rows"]:
        return np.array([row == name for row, _ in self.rows])

    def generalized_constraint_force(
        self, name: str, ts: Float[Array, "times"], ys: State, multipliers: Float[Array, "times rows"]
    ) -> Float[Array, "times nu"]:
        """The contribution of one constraint to `Aᵀ λ`, along a motion."""
        return _forces_along(self, self._rows_of(name), ts, ys, multipliers)

    # Forces on bodies; a system without bodies raises a `ValueError`.

    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        raise ValueError(_NO_REACTIONS)

    def reaction(
        self, name: str, ts: Float[Array, "times"], ys: State, multipliers: Float[Array, "times rows"]
    ) -> Reaction:
        """Reactions of one joint along a motion."""
        raise ValueError(_NO_REACTIONS)

    def force_names(self) -> tuple[str, ...]:
        """Names of the force elements."""
        raise ValueError(_NO_FORCES)

    def applied_wrenches(
        self, name: str, ts: Float[Array, "times"], ys: State, multipliers: Float[Array, "times rows"] | None
    ) -> Float[Array, "times bodies v"]:
        """Wrenches of one force element, or of the friction of one joint, on its bodies along a motion. `multipliers`
        of the rows may be None if the constraints are ideal.
        """
        raise ValueError(_NO_FORCES)

    def linear_momentum(self, q: Coordinates, u: Velocities) -> Float[Array, "d"]:
        """`Σ m v` [kg m/s], world axes."""
        raise ValueError(_NO_MOMENTUM)

    def angular_momentum(self, q: Coordinates, u: Velocities) -> Float[Array, "*d"]:
        """Moment of momentum about the world origin [kg m²/s]; a scalar in the plane, shape (3,) in world axes in
        space.
        """
        raise ValueError(_NO_MOMENTUM)

    # Descriptions

    def describe(self) -> Description:
        """A description of parts, rows, degrees of freedom and redundant rows, as text and as HTML."""
        coordinates = f"{counted(self.nq, 'coordinate')}: {shorten(self.coordinate_names())}"
        facts = [
            ("system", f"{type(self).__name__} of {coordinates}"),
            ("velocities", str(self.nu)),
            ("constraint rows", count_rows(self)),
            ("degrees of freedom", str(self.nu - self.velocity_rank)),
            ("independent", count_independent(self)),
        ]
        tables = {"design variables": tuple(description_rows(self.design))}
        return Description(tuple(facts), tables, remarks(self))

    def picture(self, ts: Float[Array, "times"], ys: State) -> Picture:
        """The bodies and parts that a picture shows along a motion.

        **Raises:** `ValueError` for a system without bodies.
        """
        raise ValueError(
            f"A picture shows bodies, and a {type(self).__name__} has none; viz.plot_motion shows its coordinates."
        )

    def not_finite(self, t: Scalar, q: Coordinates, u: Velocities) -> tuple[str, ...]:
        """The forces, residuals and rates of internal states that are not finite at a state, by name, for messages."""
        t, rows = jnp.asarray(t, q.dtype), self.rows
        residuals = (self.position_residual(t, q), self.acceleration_residual(t, q, u, jnp.zeros_like(u)))
        wrong = [rows[k][0] for residual in residuals for k in np.flatnonzero(~np.isfinite(np.asarray(residual)))]
        forces = () if np.all(np.isfinite(self.force(t, q, u))) else ("the force on the coordinates",)
        return (*forces, *dict.fromkeys(f"the residual of {name!r}" for name in wrong))

    def __repr__(self) -> str:
        (_, kind), *_ = self.describe().facts
        return f"{type(self).__name__}: {kind}, {counted(self.nu - self.velocity_rank, 'degree')} of freedom"

    def __str__(self) -> str:
        return str(self.describe())

    def _repr_html_(self) -> str:
        return self.describe()._repr_html_()


# One program for all coordinates.
@jax.jit
def _coordinate(k, q):
    return lax.dynamic_index_in_dim(q, k, axis=-1, keepdims=False)


@view_of_motion
def _rates_along(system, place, ts, ys):
    del place
    return jax.vmap(lambda t, y: system.rates(t, y.q, y.u))(ts, ys)


@view_of_motion
def _rate_along(system, index, ts, ys, solved):
    del solved
    return _coordinate(index, system.rates_along(ts, ys))


@view_of_motion
def _forces_along(system, rows, ts, ys, multipliers):
    multipliers = jnp.where(rows[None, :], multipliers, jnp.zeros_like(multipliers))
    return jax.vmap(lambda t, y, own: system.constraint_force(t, y.q, y.u, own))(ts, ys, multipliers)


@view_of_motion
def _force_along(system, rows, ts, ys, solved):
    return _forces_along(system, rows, ts, ys, solved.multipliers)


_NO_REACTIONS = "reactions are defined for joints between bodies; this system has constraint_forces."
_NO_FORCES = "forces are defined for parts that act on bodies; this system has none."
_NO_MOMENTUM = "Momentum is that of bodies; this system has none. Compute it from the coordinates."
