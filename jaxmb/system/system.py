"""A model: an equation of motion whose numbers have names."""

import abc
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._types import Coordinates, Scalar, State, Velocities
from .catalogue import Catalogue
from .description import Description, count_independent, count_rows, counted, remarks, shorten
from .design_variables import DesignVariables, description_rows
from .equation import AbstractEquation
from .parameter_table import ParameterPath, ParameterTable
from .quantities import Quantities, Quantity

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar

_NO_MOMENTUM = "Momentum is defined for bodies; this system has none. Compute momentum from the coordinates."


class GivenInTime(NamedTuple):
    """Values of functions of time at one time.

    **Fields:** `turning`: those at whose turns steps end, with a combination in place of many functions of one kind;
    `each`: of every function.
    """

    turning: Float[Array, "k"]
    each: Float[Array, "n"]


class AbstractSystem(AbstractEquation):
    """A model: an equation of motion whose numbers have names.

    This class describes models without bodies. Their quantities are coordinates, rates q̇ and generalized constraint
    forces: `"theta"`, `"theta_rate"`, `"A.force"`.

    - `guess`: the default guess of `assemble`.
    - `design`: the design variables in order of addition; later variables may determine earlier variables.
    - `rows`: for every row of A, the name of its part and its index within the part.
    - `state_ends`: for each kind of internal state, in the order of z, the index after its last entry.
    - `body_names`: names of the bodies; `Trajectory[name]` is the motion of a body, or of a coordinate in a model
        without bodies.
    """

    guess: AbstractVar[State]
    design: AbstractVar[tuple[DesignVariables, ...]]

    state_ends: ClassVar[tuple[int, ...]] = ()
    rows: ClassVar[tuple[tuple[str, int], ...]] = ()
    body_names: ClassVar[tuple[str, ...]] = ()

    def parameter_paths(self) -> dict[str, list[ParameterPath]]:
        """Paths to the arrays that hold each parameter, by name."""
        return {}

    @property
    def parameter_table(self) -> ParameterTable:
        """The ranges of the parameters, and the parameters that are functions of time."""
        return ParameterTable(self)

    @property
    def catalogue(self) -> Catalogue:
        """The motions, quantities and forces along a motion."""
        return Catalogue(self)

    def quantities(self) -> Mapping[str, Quantity]:
        """The quantities of a motion, by name."""
        return Quantities(self, self.catalogue.measures())

    def prepared(self) -> Self:
        """The system for the steps of a motion, with values that depend on parameters alone computed once.

        Its rows are valid close to the constraints only. By default the system itself.
        """
        return self

    def closing(self) -> Self:
        """The system whose rows decide, together with `half_turned`, whether a state is consistent."""
        return self.prepared()

    def half_turned(self, q: Coordinates) -> Any:
        """Which rows of a `prepared` system's Φ vanish at q although their joint is turned away from closing.

        False without such rows.
        """
        del q
        return False

    def on_host(self, t: Scalar) -> Any:
        """The constraints at a time in NumPy, to satisfy them once with little or no compilation.

        None for traced systems, and for systems without this form.
        """
        return None

    @property
    def nz(self) -> int:
        return self.state_ends[-1] if self.state_ends else 0

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

    def with_unit_attitudes(self, q: Coordinates) -> Float[Array, "nq"]:
        """Coordinates with Euler parameters of length one; the same array if they have this length."""
        return q

    def normalize_fixed(self, q: Coordinates, fixed: Bool[np.ndarray, "nq"]) -> tuple[Float[Array, "nq"], int]:
        """Coordinates that satisfy all invariants of fixed entries alone, and the number of these invariants.

        No free coordinate could satisfy such an invariant.
        """
        del fixed
        return q, 0

    def joint_coordinates(self) -> Mapping[str, Any]:
        """The coordinates of joints, by name; each has a `shape`."""
        return self.catalogue.joint_coordinates()

    def wrapped_angle_names(self) -> tuple[str, ...]:
        """The names of the angles of joints that are known up to full turns, such as `"hinge.angle"` in space."""
        return ()

    def wrapped_angles(self, t: Scalar, q: Coordinates) -> Float[Array, "k"]:
        """These angles [rad], each within half a turn of zero."""
        return jnp.zeros(0, q.dtype)

    def holding(self, values: Mapping[str, Array], rates: Mapping[str, Array], t: Scalar) -> Self:
        """The same system with coordinates of joints held at `values` at time t; the values change at `rates`."""
        del values, rates, t
        return self

    # Functions of time

    @property
    def of_time(self) -> bool:
        """Whether parts have functions of time from the user, for `given_in_time`."""
        return False

    def given_in_time(self, t: Scalar, q: Coordinates, u: Velocities) -> GivenInTime:
        """Values of the functions of time, such as a prescribed motion or a force, while nothing moves."""
        return GivenInTime(jnp.zeros(0, q.dtype), jnp.zeros(0, q.dtype))

    def with_strengths(self, change: Callable[[Any], Any]) -> Self:
        """The same system; `change` gets the numbers of its functions of time, a pytree, and returns other ones."""
        del change
        return self

    # Energy

    @abc.abstractmethod
    def kinetic_energy(self, t: Scalar, q: Coordinates, u: Velocities) -> Float[Array, ""]:
        """Kinetic energy [J]."""

    @abc.abstractmethod
    def potential_energy(self, t: Scalar, q: Coordinates) -> Float[Array, ""]:
        """Potential energy [J] of gravity and of every conservative force, at rest."""

    def energy_in_motion(self, t: Scalar, q: Coordinates, u: Velocities) -> Float[Array, ""]:
        """Hook: the potential energy [J] with that of forces whose stored energy depends on velocities."""
        del u
        return self.potential_energy(t, q)

    def linear_momentum(self, q: Coordinates, u: Velocities) -> Float[Array, "d"]:
        """`Σ m v` [kg m/s], world axes."""
        raise ValueError(_NO_MOMENTUM)

    def angular_momentum(self, q: Coordinates, u: Velocities) -> Float[Array, "*d"]:
        """Moment of momentum about the world origin [kg m²/s], world axes; a scalar in the plane, (3,) in space."""
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

    def __repr__(self) -> str:
        (_, kind), *_ = self.describe().facts
        return f"{type(self).__name__}: {kind}, {counted(self.nu - self.velocity_rank, 'degree')} of freedom"

    def __str__(self) -> str:
        return str(self.describe())

    def _repr_html_(self) -> str:
        return self.describe()._repr_html_()
