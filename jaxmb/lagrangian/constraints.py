"""Constraints of a Lagrangian system, each from a function of the user."""

import abc
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._dataflow import depends
from .._types import Coordinates, Scalar
from .kinematics import Parameters

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class AbstractCoordinateConstraint(eqx.Module):
    """Some rows of constraint equations in generalized coordinates, with a name.

    The rows bind positions (`level` 0), velocities (1) or accelerations (2).
    """

    name: AbstractVar[str]
    level: AbstractVar[int]

    @abc.abstractmethod
    def value(
        self, t: Scalar, q: Coordinates, v: Float[Array, "nq"], a: Float[Array, "nq"], parameters: Parameters
    ) -> Float[Array, "rows"]:
        """The residual, with `v = q̇` and `a = q̈`; derivatives above the constraint's level are not used."""

    def is_linear(self, q: Coordinates, parameters: Parameters) -> bool:
        """Hook: whether the rows are affine in velocities, by default from the data flow of `value`; always true for
        other constraints than between velocities.
        """
        slope = lambda t, q, v, p: jax.jacfwd(self.value, 2)(t, q, v, v, p)
        return self.level != 1 or not depends(slope, (jnp.zeros((), q.dtype), q, q, parameters), 2)

    def is_drift_free(self, q: Coordinates, parameters: Parameters) -> bool:
        """Hook: whether rows between velocities, or rates of rows between positions, vanish at rest; always true for a
        constraint between accelerations. By default rows between velocities count as if they had a drift.
        """
        if self.level != 0:
            return self.level == 2
        t = jnp.zeros((), q.dtype)
        return not depends(lambda t, q, p: self.value(t, q, q, q, p), (t, q, parameters), 0)


class Holonomic(AbstractCoordinateConstraint):
    """A constraint between positions, `residual(t, q, parameters) = 0`, shape (rows,); twice differentiable.

    ```python
    ring = jaxmb.lagrangian.Holonomic("ring", lambda t, q, p: jnp.array([q @ q - p["radius"] ** 2]))
    common = {"kinetic": lambda t, q, v, p: 0.5 * v @ v, "q": [0.6, 0.8], "parameters": {"radius": 1.0}}
    bead = jaxmb.lagrangian.LagrangianSystem(**common, constraints=[ring])
    ```
    """

    name: str = eqx.field(static=True)
    residual: Callable[..., Array] = eqx.field(static=True)
    level: ClassVar[int] = 0

    def value(self, t, q, v, a, parameters):
        return jnp.ravel(self.residual(t, q, parameters))


class Nonholonomic(AbstractCoordinateConstraint):
    """A constraint between velocities, linear in them or not, `residual(t, q, v, parameters) = 0` with `v = q̇`, shape
    (rows,).

    ```python
    held = jaxmb.lagrangian.Nonholonomic("held", lambda t, q, v, p: jnp.array([v @ v - p["speed"] ** 2]))
    common = {"kinetic": lambda t, q, v, p: 0.5 * v @ v, "potential": lambda t, q, p: 9.81 * q[1]}
    start = {"q": [0.0, 0.0], "u": [1.0, 0.0], "parameters": {"speed": 1.0}}
    particle = jaxmb.lagrangian.LagrangianSystem(**common, constraints=[held], **start)
    ```
    """

    name: str = eqx.field(static=True)
    residual: Callable[..., Array] = eqx.field(static=True)
    level: ClassVar[int] = 1

    def value(self, t, q, v, a, parameters):
        return jnp.ravel(self.residual(t, q, v, parameters))


class Pfaffian(AbstractCoordinateConstraint):
    """A constraint linear in velocities, `matrix(t, q, parameters) q̇ + drift(t, q, parameters) = 0`.

    ```python
    blade = jaxmb.lagrangian.Pfaffian("blade", lambda t, q, p: jnp.array([[-jnp.sin(q[2]), jnp.cos(q[2]), 0.0]]))
    kinetic = lambda t, q, v, p: 0.5 * (v[0] ** 2 + v[1] ** 2 + 0.1 * v[2] ** 2)
    sled = jaxmb.lagrangian.LagrangianSystem(kinetic=kinetic, constraints=[blade], q=[0.0, 0.0, 0.0], u=[1.0, 0.0, 0.5])
    ```

    **Arguments:** `matrix`: shape (rows, nq); `drift`: shape (rows,), default zero.
    """

    name: str = eqx.field(static=True)
    matrix: Callable[..., Array] = eqx.field(static=True)
    drift: Callable[..., Array] | None = eqx.field(static=True, default=None)
    level: ClassVar[int] = 1

    def value(self, t, q, v, a, parameters):
        out = jnp.atleast_2d(self.matrix(t, q, parameters)) @ v
        return out if self.drift is None else out + _of_rows(self.name, "drift", out, self.drift(t, q, parameters))

    def is_drift_free(self, q, parameters):
        return self.drift is None


class AccelerationConstraint(AbstractCoordinateConstraint):
    """A constraint between accelerations, `matrix(t, q, v, parameters) q̈ = right(t, q, v, parameters)`.

    ```python
    pull = jaxmb.lagrangian.AccelerationConstraint(
        "pull", lambda t, q, v, p: jnp.array([[1.0, 2.0]]), lambda t, q, v, p: jnp.array([jnp.cos(t) - v[0]])
    )
    free = lambda t, q, v, p: 0.5 * v @ v
    system = jaxmb.lagrangian.LagrangianSystem(kinetic=free, constraints=[pull], q=[0.0, 0.0])
    ```

    If the rows are the derivative of a relation between positions or velocities, the motion may drift off this
    relation. A row that others imply at the guess is watched along the motion, which fails where they begin to differ.

    **Arguments:** `matrix`: shape (rows, nq); `right`: shape (rows,).
    """

    name: str = eqx.field(static=True)
    matrix: Callable[..., Array] = eqx.field(static=True)
    right: Callable[..., Array] = eqx.field(static=True)
    level: ClassVar[int] = 2

    def value(self, t, q, v, a, parameters):
        out = jnp.atleast_2d(self.matrix(t, q, v, parameters)) @ a
        return out - _of_rows(self.name, "right", out, self.right(t, q, v, parameters))


class ServoConstraint(AbstractCoordinateConstraint):
    """A desired motion as a constraint: `deviation(t, q, parameters)` is brought to zero and kept there.

    ```python
    rise = jaxmb.lagrangian.ServoConstraint("rise", lambda t, q, p: q[:1] - 0.1 * t, damping=4.0, stiffness=4.0)
    kinetic, potential = lambda t, q, v, p: 0.5 * v @ v, lambda t, q, p: 9.81 * q[0]
    lift = jaxmb.lagrangian.LagrangianSystem(kinetic=kinetic, potential=potential, constraints=[rise], q=[0.2])
    ```

    The constraint acts on accelerations, `φ̈ + damping φ̇ + stiffness φ = 0`, so the motion may start off it. Its
    constraint force is the exact generalized control force, the smallest in the metric of M⁻¹.

    **Arguments:** `deviation`: φ, shape (rows,); `damping` [1/s] and `stiffness` [1/s²], default zero: a deviation of
    zero is kept.

    **Reference:**

    ```bibtex
    @article{kalaba1993equations,
      author = {Kalaba, R. E. and Udwadia, F. E.}, title = {Equations of Motion for Nonholonomic, Constrained
      Dynamical Systems via Gauss's Principle}, journal = {Journal of Applied Mechanics}, volume = {60}, number =
      {3}, pages = {662--668}, year = {1993},
    }
    ```
    """

    name: str = eqx.field(static=True)
    deviation: Callable[..., Array] = eqx.field(static=True)
    damping: float = eqx.field(static=True, default=0.0)
    stiffness: float = eqx.field(static=True, default=0.0)
    level: ClassVar[int] = 2

    def value(self, t, q, v, a, parameters):
        one = jnp.ones_like(t)
        phi = lambda t, q: jnp.ravel(self.deviation(t, q, parameters))
        first = lambda t, q, v: jax.jvp(phi, (t, q), (one, v))[1]
        rate, second = jax.jvp(first, (t, q, v), (one, v, a))
        return second + self.damping * rate + self.stiffness * phi(t, q)


def _of_rows(constraint: str, what: str, rows: Float[Array, "rows"], value: Any) -> Float[Array, "rows"]:
    value = jnp.ravel(value)
    if value.shape != rows.shape:
        raise ValueError(f"{constraint}: {what} must have shape {rows.shape}, as matrix has rows; got {value.shape}.")
    return value


def check_names(constraints: tuple[Any, ...], coordinates: tuple[str, ...]) -> None:
    """Raise a `ValueError` unless every entry is a constraint with a unique name."""
    for constraint in constraints:
        if not isinstance(constraint, AbstractCoordinateConstraint):
            raise ValueError(
                f"constraints must hold Holonomic, Nonholonomic, Pfaffian, AccelerationConstraint or ServoConstraint, "
                f"got {constraint!r}."
            )
    names = [constraint.name for constraint in constraints]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ValueError(
            f"The name {', '.join(map(repr, repeated))} is used twice; every constraint needs a different name."
        )
    for name in names:
        if name in coordinates:
            raise ValueError(f"{name!r} is a constraint as well as a coordinate; rename one of them.")
