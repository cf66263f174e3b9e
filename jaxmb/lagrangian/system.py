"""Systems given by a Lagrangian."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar, State, VectorLike
from ..linalg.jacobian import DenseJacobian
from ..parts.base import array
from ..system import AbstractSystem, DenseInertia, DiagonalInertia
from ..system.equation import Ranks
from .constraints import AbstractConstraint, Holonomic, Pfaffian, check_names, is_linear, is_rheonomic
from .equations import AbstractEquations, Projected
from .kinematics import AbstractKinematics, Rates
from .nonideal import AbstractNonIdeal
from .structure import count_rows, find_structure

if TYPE_CHECKING:
    from ..system.describe import Description

# What a saved motion holds besides the coordinates.
_TAKEN = ("t", "q", "u", "energy")


class LagrangianSystem(AbstractSystem):
    r"""A mechanical system from its Lagrangian `L(t, q, q̇)`, forces, and constraints at any level.

    With velocities u, `q̇ = K(t, q, u)` and `B = ∂K/∂u`, the equations are Lagrange's, projected on the columns of B:

    $$B^T \left(\frac{d}{dt} \frac{\partial L}{\partial \dot q} - \frac{\partial L}{\partial q} - Q\right)
      = A^T \lambda$$

    All of it is found by automatic differentiation; structure functions of quasi-velocities never appear, unless the
    equations are to be written with them.

    Functions are of JAX, and take numbers of the model by name in their last argument, a dictionary: the system's
    parameters.

    **Arguments:**

    - `lagrangian(t, q, v, parameters)`: L, with `v = q̇`; or instead
    - `kinetic(t, q, v, parameters)` and `potential(t, q, parameters)`: energies [J], `L = T − V`; no potential if that
        is not given.
    - `force(t, q, v, parameters)`: generalized forces Q without potential, shape (nq,).
    - `constraints`: `Holonomic`, `Nonholonomic`, `Pfaffian`, `AccelerationConstraint`, `Servo`; rows may imply others.
    - `nonideal`: what constraints do beyond d'Alembert's principle: `Friction`, `Viscous`, `NonIdeal`.
    - `kinematics`: what u is; default `Rates()`, u = q̇.
    - `equations`: how they are written; default `Projected()`, as above, or `Hamel()`, `Voronets()`.
    - `q`, `u`: a state near the constraints, the guess for `assemble`; ranks are found there. Default u is zero.
    - `parameters`: numbers by name.
    - `coordinates`: names of the coordinates, other than `t`, `q`, `u`, `energy`; default `q0`, `q1`, ….
    - `length`: the size that residuals of positions are relative to.

    **Raises:** `ValueError` for functions of the wrong shape, an L that is not twice differentiable in q̇, constraints
    that no positions satisfy near the guess, constraints on velocities or accelerations that contradict others,
    friction of a constraint that others imply, and names that are not unique.
    """

    lagrangian: Callable[..., Array] = eqx.field(static=True)
    applied: Callable[..., Array] | None = eqx.field(static=True)
    constraints: tuple[Any, ...]
    nonideal: tuple[AbstractNonIdeal, ...]
    kinematics: AbstractKinematics
    equations: AbstractEquations
    parameters: dict[str, Array]
    guess: State
    length: Float[Array, ""]
    coordinates: tuple[str, ...] = eqx.field(static=True)
    sizes: tuple[int, ...] = eqx.field(static=True)
    diagonal: bool = eqx.field(static=True)
    regular: bool = eqx.field(static=True)
    linear: bool = eqx.field(static=True)
    homogeneous: bool = eqx.field(static=True)
    ranks: Ranks
    elimination: ClassVar[None] = None

    def __init__(
        self,
        lagrangian: Callable[..., Array] | None = None,
        *,
        kinetic: Callable[..., Array] | None = None,
        potential: Callable[..., Array] | None = None,
        force: Callable[..., Array] | None = None,
        constraints: Sequence[Any] = (),
        nonideal: Sequence[AbstractNonIdeal] = (),
        kinematics: AbstractKinematics | None = None,
        equations: AbstractEquations | None = None,
        q: VectorLike,
        u: VectorLike | None = None,
        parameters: Mapping[str, VectorLike] | None = None,
        coordinates: Sequence[str] | None = None,
        length: VectorLike = 1.0,
    ):
        self.lagrangian = _lagrangian(lagrangian, kinetic, potential)
        self.applied = force
        # Φ, then the rest of ψ, then rows that bind accelerations only.
        self.constraints = tuple(sorted(constraints, key=_level))
        self.nonideal = tuple(nonideal)
        self.kinematics = Rates() if kinematics is None else kinematics
        self.equations = Projected() if equations is None else equations
        self.parameters = {name: array(value) for name, value in (parameters or {}).items()}
        self.length = array(length)
        check_names(self.constraints)

        q = array(q)
        if q.ndim != 1:
            raise ValueError(f"q is a vector, got shape {q.shape}.")
        nu = self.kinematics.count(q.size)
        self.guess = State(q, array(np.zeros(nu)) if u is None else array(u))
        if self.guess.u.shape != (nu,):
            raise ValueError(f"The system has {nu} velocities, got u of shape {self.guess.u.shape}.")
        self.coordinates = tuple(f"q{k}" for k in range(q.size)) if coordinates is None else tuple(coordinates)
        if len(self.coordinates) != q.size or len(set(self.coordinates)) != q.size:
            raise ValueError(f"{q.size} coordinates need as many names, all different; got {self.coordinates}.")
        taken = [name for name in self.coordinates if name in _TAKEN]
        if taken:
            raise ValueError(f"In a saved motion {', '.join(map(repr, taken))} is something else; choose another name.")

        self.sizes = count_rows(self)
        at = (jnp.zeros((), q.dtype), q, q, self.parameters)
        own = [c for c in self.constraints if isinstance(c, AbstractConstraint)]
        self.linear = self.kinematics.linear and all(isinstance(c, Holonomic) or is_linear(c, at) for c in own)
        fixed = lambda c: not is_rheonomic(c, at) if isinstance(c, Holonomic) else _without_drift(c)
        self.homogeneous = self.linear and self.kinematics.homogeneous and all(fixed(c) for c in own)
        self.diagonal = False
        self.diagonal, self.regular, self.ranks = find_structure(self)
        self.equations.check(self)

    def __str__(self) -> str:
        return str(self.describe())

    def _repr_html_(self) -> str:
        return self.describe()._repr_html_()

    def describe(self) -> "Description":
        """Coordinates, velocities, rows of constraints, degrees of freedom, and what was left out; as text and as
        HTML.
        """
        from .describe import describe

        return describe(self)

    # Sizes

    @property
    def nq(self) -> int:
        return self.guess.q.shape[-1]

    @property
    def nu(self) -> int:
        return self.guess.u.shape[-1]

    @property
    def position_rows(self) -> int:
        return self._rows(0)

    @property
    def coordinate_rows(self) -> int:
        return self.position_rows

    @property
    def velocity_rows(self) -> int:
        return self._rows(1)

    @property
    def acceleration_rows(self) -> int:
        return self._rows(2)

    def _rows(self, level):
        return sum(n for c, n in zip(self.constraints, self.sizes, strict=True) if _level(c) <= level)

    @property
    def ideal(self) -> bool:
        return not self.nonideal

    @property
    def rates_are_velocities(self) -> bool:
        return self.kinematics.identity

    @property
    def rows(self) -> tuple[tuple[str, int], ...]:
        """Name of the constraint, and number within it, of every row of A."""
        return tuple((c.name, k) for c, n in zip(self.constraints, self.sizes, strict=True) for k in range(n))

    def coordinate_names(self):
        return {name: [k] for k, name in enumerate(self.coordinates)}

    def rate_names(self):
        if self.kinematics.identity:
            return self.coordinate_names()
        return {f"u{k}": [k] for k in range(self.nu)}

    def parameter_places(self) -> dict[str, list[tuple[Callable[[Any], Array], int | None]]]:
        return {name: [(_parameter(name), None)] for name in self.parameters}

    # Kinematics

    def rates(self, t, q, u):
        return self.kinematics.rates(t, q, u, self.parameters)

    def normalize(self, q):
        return q

    # Constraints

    @eqx.filter_jit
    def position_residual(self, t, q):
        return self._join(c(t, q, q, self.parameters) for c in self.constraints if _level(c) == 0)

    def coordinate_residual(self, t, q):
        return self.position_residual(t, q)

    @eqx.filter_jit
    def coordinate_jacobian(self, t, q):
        return jax.jacfwd(self.position_residual, 1)(t, q)

    @eqx.filter_jit
    def velocity_residual(self, t, q, u):
        t = jnp.asarray(t, q.dtype)
        v = self.rates(t, q, u)
        _, rate = jax.jvp(self.position_residual, (t, q), (jnp.ones_like(t), v))
        return self._join([rate, *(c(t, q, v, self.parameters) for c in self.constraints if _level(c) == 1)])

    @eqx.filter_jit
    def acceleration_residual(self, t, q, u, udot):
        t = jnp.asarray(t, q.dtype)
        v, one = self.rates(t, q, u), jnp.ones_like(t)
        _, rate = jax.jvp(self.velocity_residual, (t, q, u), (one, v, udot))
        _, a = jax.jvp(self.rates, (t, q, u), (one, v, udot))
        others = [c.residual(t, q, v, a, self.parameters) for c in self.constraints if _level(c) == 2]
        return self._join([rate, *others])

    @eqx.filter_jit
    def jacobian(self, t, q, u):
        # Linear in accelerations, so that its derivative is the same anywhere.
        return jax.jacfwd(self.acceleration_residual, 3)(t, q, u, jnp.zeros_like(u))

    def structured_jacobian(self, t, q, u):
        return DenseJacobian(self.jacobian(t, q, u))

    @eqx.filter_jit
    def constraint_force(self, t, q, u, multipliers):
        _, pull = jax.vjp(lambda udot: self.acceleration_residual(t, q, u, udot), jnp.zeros_like(u))
        return pull(multipliers)[0]

    @eqx.filter_jit
    def nonideal_force(self, t, q, u, multipliers):
        t = jnp.asarray(t, q.dtype)
        v, pull = jax.vjp(lambda u: self.rates(t, q, u), u)
        total = jnp.zeros_like(q)
        for law in self.nonideal:
            mine = jnp.array([name == law.constraint for name, _ in self.rows])
            ideal = self._on_coordinates(t, q, v, jnp.where(mine, multipliers, 0.0))
            first = [name for name, _ in self.rows].index(law.constraint)
            own = multipliers[first : first + sum(name == law.constraint for name, _ in self.rows)]
            total = total + law.force(t, q, v, ideal, own, self.parameters)
        return pull(total)[0]

    def _on_coordinates(self, t, q, v, multipliers):
        """The generalized force on the coordinates of these multipliers."""

        def residual(a):
            rows = [
                jnp.ravel(jax.jacfwd(c, 1)(t, q, v, self.parameters) @ a)
                if _level(c) == 0
                else jax.jacfwd(c, 2)(t, q, v, self.parameters) @ a
                if _level(c) == 1
                else c.residual(t, q, v, a, self.parameters)
                for c in self.constraints
            ]
            return self._join(rows)

        return jax.vjp(residual, jnp.zeros_like(v))[1](multipliers)[0]

    def _join(self, blocks):
        return jnp.concatenate([jnp.zeros(0, self.guess.q.dtype), *blocks])

    # Dynamics

    def momentum(self, t: Scalar, q: Float[Array, "nq"], v: Float[Array, "nq"]) -> Float[Array, "nq"]:
        """`∂L/∂q̇`."""
        return jax.grad(self.lagrangian, 2)(t, q, v, self.parameters)

    @eqx.filter_jit
    def inertia(self, t, q, u):
        t = jnp.asarray(t, q.dtype)
        v = self.rates(t, q, u)
        along = lambda w: jax.jvp(lambda v: self.momentum(t, q, v), (v,), (w,))[1]
        if self.diagonal:
            return DiagonalInertia(along(jnp.ones_like(v)))
        if self.kinematics.identity:
            return DenseInertia(jax.vmap(along)(jnp.eye(self.nq, dtype=q.dtype)))
        columns = jax.jacfwd(lambda u: self.rates(t, q, u))(u)
        return DenseInertia(jax.vmap(along, in_axes=1)(columns) @ columns)

    @eqx.filter_jit
    def force(self, t, q, u):
        return self.equations.force(self, jnp.asarray(t, q.dtype), q, u)

    def applied_force(self, t: Scalar, q: Float[Array, "nq"], v: Float[Array, "nq"]) -> Float[Array, "nq"]:
        """Q, the generalized forces on the coordinates that have no potential."""
        return jnp.zeros_like(v) if self.applied is None else jnp.asarray(self.applied(t, q, v, self.parameters))

    # Energy

    @eqx.filter_jit
    def kinetic_energy(self, t, q, u):
        """`q̇ · ∂L/∂q̇ − L` without the potential energy: the kinetic energy, if L is quadratic in q̇."""
        t = jnp.asarray(t, q.dtype)
        v = self.rates(t, q, u)
        energy = v @ self.momentum(t, q, v) - self.lagrangian(t, q, v, self.parameters)
        return energy - self.potential_energy(t, q)

    @eqx.filter_jit
    def potential_energy(self, t, q):
        """`−L(t, q, 0)`."""
        return -self.lagrangian(t, q, jnp.zeros_like(q), self.parameters)

    # Scales

    def coordinate_scale(self):
        return jnp.ones(self.nq)

    def velocity_scale(self):
        return jnp.ones(self.nu)


def _level(constraint: Any) -> int:
    """Whether a constraint binds positions, velocities or accelerations: 0, 1, 2."""
    return 0 if isinstance(constraint, Holonomic) else 1 if isinstance(constraint, AbstractConstraint) else 2


def _parameter(name: str) -> Callable[[Any], Array]:
    return lambda system: system.parameters[name]


def _without_drift(constraint: AbstractConstraint) -> bool:
    return isinstance(constraint, Pfaffian) and constraint.drift is None


def _lagrangian(lagrangian, kinetic, potential):
    if (lagrangian is None) == (kinetic is None):
        raise ValueError("A LagrangianSystem takes either `lagrangian` or `kinetic`, and `potential` with the latter.")
    if lagrangian is not None and potential is not None:
        raise ValueError("`lagrangian` holds the potential energy already; pass `kinetic` to give it apart.")
    return _Difference(kinetic if lagrangian is None else lagrangian, potential)


@dataclasses.dataclass(frozen=True)
class _Difference:
    """L = T − V, or L alone; equal for equal functions, so that another system of them is not compiled anew."""

    kinetic: Callable[..., Array]
    potential: Callable[..., Array] | None

    def __call__(self, t, q, v, parameters):
        value = self.kinetic(t, q, v, parameters)
        if self.potential is not None:
            value = value - self.potential(t, q, parameters)
        return jnp.reshape(value, ())
