"""The equations of a Lagrangian system in any velocities, and their forms, before its structure is known."""

import abc
import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._captured import Captured
from .._types import Coordinates, Scalar, State, Velocities
from ..system import AbstractSystem, DenseInertia, DiagonalInertia
from ..system.description import Description, count_independent, count_rows, counted, remarks, shorten
from ..system.design_variables import DesignVariables, description_rows
from ..system.equation import Ranks
from ..system.parameter_table import ParameterPath
from .constraints import AbstractCoordinateConstraint
from .kinematics import AbstractKinematics, Parameters
from .nonideal import AbstractNonIdealForce
from .parameters import DrivenParameters, LagrangianParameters

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class AbstractEquations(eqx.Module):
    """A form of `M u̇ = F + Aᵀ λ`; all forms give the same F."""

    @abc.abstractmethod
    def check(self, system: "AbstractLagrangian") -> None:
        """Raise a `ValueError` for a system that does not admit this form."""

    @abc.abstractmethod
    def force(self, system: "AbstractLagrangian", t: Scalar, q: Coordinates, u: Velocities) -> Float[Array, "nu"]:
        """`F(t, q, u)`."""


class AbstractLagrangian(AbstractSystem):
    """The functions of a Lagrangian system, and the kernels that follow by automatic differentiation.

    **Fields:** the arguments of `LagrangianSystem`; `lagrangian(t, q, v, parameters)`; `applied`, the forces without
    potential, or None; `constraints`, ordered by level; `sizes`, the number of rows of each.

    `inputs`: the parameters that are functions of time; `known`: the traces of users' classes from when the system was
    made; `diagonal`: whether the mass matrix is diagonal and constant.
    """

    lagrangian: Callable[..., Array] = eqx.field(static=True)
    applied: Callable[..., Array] | None = eqx.field(static=True)
    constraints: tuple[AbstractCoordinateConstraint, ...]
    nonideal: tuple[AbstractNonIdealForce, ...]
    kinematics: AbstractKinematics
    equations: AbstractEquations
    parameters: Parameters
    guess: State
    length: Float[Array, ""]
    coordinates: tuple[str, ...] = eqx.field(static=True)
    sizes: tuple[int, ...] = eqx.field(static=True)
    inputs: tuple[DrivenParameters, ...]
    known: tuple[tuple[type, Captured], ...] = eqx.field(static=True)
    design: tuple[DesignVariables, ...] = eqx.field(default=(), kw_only=True)

    diagonal: AbstractVar[bool]

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
    def velocity_rows(self) -> int:
        return self._rows(1)

    @property
    def acceleration_rows(self) -> int:
        return self._rows(2)

    def _rows(self, level):
        return sum(n for c, n in zip(self.constraints, self.sizes, strict=True) if c.level <= level)

    @property
    def ideal(self) -> bool:
        return not self.nonideal

    @property
    def friction_rows(self):
        parts = {law.constraint for law in self.nonideal if law.of_multipliers}
        return np.array([k for k, (name, _) in enumerate(self.rows) if name in parts], int)

    @property
    def rates_are_velocities(self) -> bool:
        return self.kinematics.identity

    @property
    def rows(self) -> tuple[tuple[str, int], ...]:
        """For every row of A, the name of its constraint and its index within the constraint."""
        return tuple((c.name, k) for c, n in zip(self.constraints, self.sizes, strict=True) for k in range(n))

    def coordinate_names(self):
        return {name: [k] for k, name in enumerate(self.coordinates)}

    def rate_names(self):
        if self.kinematics.identity:
            return super().rate_names()
        return {f"u{k}": [k] for k in range(self.nu)}

    def parameter_paths(self) -> dict[str, list[ParameterPath]]:
        modules = self.parameter_table.modules()
        return {name: [(_parameter(name, name in modules), None)] for name in self.parameters}

    @property
    def parameter_table(self):
        return LagrangianParameters(self)

    def parameters_at(self, t: Scalar) -> Parameters:
        """The parameters at a time, the last argument of every function."""
        driven = ((name, x) for group in self.inputs for name, x in zip(group.names, group.at(t), strict=True))
        return self.parameters | {name: jnp.asarray(x, self.parameters[name].dtype) for name, x in driven}

    def kernel(self, item: Any, name: str) -> Callable[..., Array]:
        """A method of a constraint, of a non-ideal force or of the kinematics."""
        trace = dict(self.known).get(type(item))
        return getattr(item, name) if trace is None else functools.partial(trace, item)

    def value(self, constraint: AbstractCoordinateConstraint, t: Scalar, *motion: Array) -> Array:
        """The residual of a constraint, from coordinates, rates and accelerations."""
        return self.kernel(constraint, "value")(t, *motion, self.parameters_at(t))

    # Kinematics

    def rates(self, t, q, u):
        t = jnp.asarray(t, q.dtype)
        return self.kernel(self.kinematics, "rates")(t, q, u, self.parameters_at(t))

    # Constraints

    @eqx.filter_jit
    def position_residual(self, t, q):
        t = jnp.asarray(t, q.dtype)
        return self._join(self.value(c, t, q, q, q) for c in self.constraints if c.level == 0)

    @eqx.filter_jit
    def velocity_residual(self, t, q, u):
        t = jnp.asarray(t, q.dtype)
        v = self.rates(t, q, u)
        _, rate = jax.jvp(self.position_residual, (t, q), (jnp.ones_like(t), v))
        return self._join([rate, *(self.value(c, t, q, v, v) for c in self.constraints if c.level == 1)])

    @eqx.filter_jit
    def acceleration_residual(self, t, q, u, udot):
        t = jnp.asarray(t, q.dtype)
        v, one = self.rates(t, q, u), jnp.ones_like(t)
        _, rate = jax.jvp(self.velocity_residual, (t, q, u), (one, v, udot))
        _, a = jax.jvp(self.rates, (t, q, u), (one, v, udot))
        others = [self.value(c, t, q, v, a) for c in self.constraints if c.level == 2]
        return self._join([rate, *others])

    @eqx.filter_jit
    def nonideal_force(self, t, q, u, multipliers):
        t = jnp.asarray(t, q.dtype)
        v, pull = jax.vjp(lambda u: self.rates(t, q, u), u)
        total = jnp.zeros_like(q)
        for law in self.nonideal:
            mine = jnp.array([name == law.constraint for name, _ in self.rows])
            reaction = self._on_coordinates(t, q, v, jnp.where(mine, multipliers, 0.0))
            first = [name for name, _ in self.rows].index(law.constraint)
            law_multipliers = multipliers[first : first + sum(name == law.constraint for name, _ in self.rows)]
            total = total + self.kernel(law, "force")(t, q, v, reaction, law_multipliers, self.parameters_at(t))
        return pull(total)[0]

    def _on_coordinates(self, t, q, v, multipliers):
        """The generalized force of these multipliers on the coordinates."""

        def residual(a):
            return self._join(
                jax.jacfwd(self.value, 2 + c.level)(c, t, q, v, v) @ a if c.level < 2 else self.value(c, t, q, v, a)
                for c in self.constraints
            )

        return jax.vjp(residual, jnp.zeros_like(v))[1](multipliers)[0]

    def _join(self, blocks):
        return jnp.concatenate([jnp.zeros(0, self.guess.q.dtype), *blocks])

    # Dynamics

    def momentum(self, t: Scalar, q: Coordinates, v: Float[Array, "nq"]) -> Float[Array, "nq"]:
        """`∂L/∂q̇`."""
        return jax.grad(self.lagrangian, 2)(t, q, v, self.parameters_at(t))

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

    def applied_force(self, t: Scalar, q: Coordinates, v: Float[Array, "nq"]) -> Float[Array, "nq"]:
        """Q, the generalized forces without potential on the coordinates."""
        return jnp.zeros_like(v) if self.applied is None else jnp.asarray(self.applied(t, q, v, self.parameters_at(t)))

    # Energy

    @eqx.filter_jit
    def kinetic_energy(self, t, q, u):
        """`q̇ · ∂L/∂q̇ − L` without the potential energy: the kinetic energy, if L is quadratic in q̇."""
        t = jnp.asarray(t, q.dtype)
        v = self.rates(t, q, u)
        energy = v @ self.momentum(t, q, v) - self.lagrangian(t, q, v, self.parameters_at(t))
        return energy - self.potential_energy(t, q)

    @eqx.filter_jit
    def potential_energy(self, t, q):
        """`−L(t, q, 0)`."""
        t = jnp.asarray(t, q.dtype)
        return -self.lagrangian(t, q, jnp.zeros_like(q), self.parameters_at(t))

    # Scales

    def coordinate_scale(self):
        return jnp.ones(self.nq)

    def velocity_scale(self):
        return jnp.ones(self.nu)

    # Description

    def describe(self) -> Description:
        kind = "rates of the coordinates" if self.kinematics.identity else f"of a {type(self.kinematics).__name__}"
        facts = [
            ("system", f"of a Lagrangian, {counted(self.nq, 'coordinate')}: {shorten(self.coordinates)}"),
            ("velocities", f"{self.nu}, {kind}"),
            ("constraint rows", count_rows(self)),
            ("degrees of freedom", str(self.nu - self.velocity_rank)),
            ("independent", count_independent(self)),
            ("equations", type(self.equations).__name__),
        ]
        if self.parameters:
            facts.append(("parameters", shorten(self.parameters)))
        sizes = zip(self.constraints, self.sizes, strict=True)
        tables = {
            "constraints": tuple((type(c).__name__, c.name, counted(n, "row")) for c, n in sizes),
            "non-ideal forces": tuple((type(law).__name__, law.constraint, "") for law in self.nonideal),
            "design variables": tuple(description_rows(self.design)),
        }
        left_out = []
        if self.diagonal:
            left_out.append("factorisation of the mass matrix: it is diagonal")
        if self.applied is None:
            left_out.append("forces besides the Lagrangian's: there are none")
        return Description(tuple(facts), tables, remarks(self, left_out))


class Unanalysed(AbstractLagrangian):
    """A Lagrangian system without its structure; its programs serve before and after the structure is known."""

    diagonal: ClassVar[bool] = False
    positive_definite_mass: ClassVar[bool] = False
    linear: ClassVar[bool] = False
    drift_free: ClassVar[bool] = False
    ranks: ClassVar[Ranks] = Ranks(0, 0, 0, 0)

    @classmethod
    def of(cls, system: AbstractLagrangian) -> Self:
        """The functions and numbers of a system."""
        return cls(**{field.name: getattr(system, field.name) for field in dataclasses.fields(cls)})


class Projected(AbstractEquations):
    """Lagrange's equations in the coordinates, projected on the directions of the velocities: the default.

    For any kinematics, also nonlinear. The cheapest form: two derivatives of L, and one of the kinematics.
    """

    def check(self, system):
        del system

    def force(self, system, t, q, u):
        v, pull = jax.vjp(lambda u: system.rates(t, q, u), u)
        momentum = lambda t, q: system.momentum(t, q, system.rates(t, q, u))
        _, rate = jax.jvp(momentum, (t, q), (jnp.ones_like(t), v))
        total = jax.grad(system.lagrangian, 1)(t, q, v, system.parameters_at(t)) - rate
        return pull(total + system.applied_force(t, q, v))[0]


def _parameter(name: str, is_module: bool) -> Callable[[Any], Array]:
    return lambda system: system.parameters[name].values if is_module else system.parameters[name]
