"""Constraints of a Lagrangian system, each from a function of the user."""

import abc
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Scalar
from .dataflow import depends
from .kinematics import Parameters

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class AbstractConstraint(eqx.Module):
    """Some rows of constraint equations, with a name."""

    name: AbstractVar[str]

    @abc.abstractmethod
    def __call__(self, t: Scalar, q: Float[Array, "nq"], v: Float[Array, "nq"], parameters: Parameters) -> Array:
        """What vanishes, shape (rows,); of a constraint between positions `v` is not used."""


class Holonomic(AbstractConstraint):
    """A constraint between positions, `residual(t, q, parameters) = 0`, shape (rows,); twice differentiable."""

    name: str = eqx.field(static=True)
    residual: Callable[..., Array] = eqx.field(static=True)

    def __call__(self, t, q, v, parameters):
        return jnp.ravel(self.residual(t, q, parameters))


class Nonholonomic(AbstractConstraint):
    """A constraint between velocities, linear in them or not, `residual(t, q, v, parameters) = 0` with `v = q̇`, shape
    (rows,).
    """

    name: str = eqx.field(static=True)
    residual: Callable[..., Array] = eqx.field(static=True)

    def __call__(self, t, q, v, parameters):
        return jnp.ravel(self.residual(t, q, v, parameters))


class Pfaffian(AbstractConstraint):
    """A constraint linear in velocities, `matrix(t, q, parameters) q̇ + drift(t, q, parameters) = 0`.

    **Arguments:** `matrix`: shape (rows, nq); `drift`: shape (rows,), default zero.
    """

    name: str = eqx.field(static=True)
    matrix: Callable[..., Array] = eqx.field(static=True)
    drift: Callable[..., Array] | None = eqx.field(static=True, default=None)

    def __call__(self, t, q, v, parameters):
        out = jnp.atleast_2d(self.matrix(t, q, parameters)) @ v
        return out if self.drift is None else out + jnp.ravel(self.drift(t, q, parameters))


class AccelerationConstraint(eqx.Module):
    """A constraint between accelerations, `matrix(t, q, v, parameters) q̈ = right(t, q, v, parameters)`.

    Nothing keeps the motion on a relation that such a constraint is a derivative of: it is what its rows say.

    **Arguments:** `matrix`: shape (rows, nq); `right`: shape (rows,).
    """

    name: str = eqx.field(static=True)
    matrix: Callable[..., Array] = eqx.field(static=True)
    right: Callable[..., Array] = eqx.field(static=True)

    def residual(self, t: Scalar, q: Array, v: Array, a: Array, parameters: Parameters) -> Array:
        """`matrix q̈ − right` at accelerations `a`, shape (rows,)."""
        matrix = jnp.atleast_2d(self.matrix(t, q, v, parameters))
        return matrix @ a - jnp.ravel(self.right(t, q, v, parameters))


class Servo(eqx.Module):
    """A desired motion as a constraint: `deviation(t, q, parameters)` is brought to zero and kept there.

    The constraint acts on accelerations, `φ̈ + damping φ̇ + stiffness φ = 0`, so the motion may start off it. What it
    takes to do that, its constraint force, is the exact generalized control force, the least one in the metric of M⁻¹.

    **Arguments:** `deviation`: φ, shape (rows,); `damping` [1/s] and `stiffness` [1/s²], default zero: kept only.

    ??? cite "Reference"
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

    def residual(self, t: Scalar, q: Array, v: Array, a: Array, parameters: Parameters) -> Array:
        """`φ̈ + damping φ̇ + stiffness φ` at accelerations `a`, shape (rows,)."""
        one = jnp.ones_like(t)
        phi = lambda t, q: jnp.ravel(self.deviation(t, q, parameters))
        first = lambda t, q, v: jax.jvp(phi, (t, q), (one, v))[1]
        rate, second = jax.jvp(first, (t, q, v), (one, v, a))
        return second + self.damping * rate + self.stiffness * phi(t, q)


def check_names(constraints: tuple[Any, ...]) -> None:
    """Raise a `ValueError` unless every constraint is one, with a name of its own."""
    kinds = (AbstractConstraint, AccelerationConstraint, Servo)
    for constraint in constraints:
        if not isinstance(constraint, kinds):
            raise ValueError(
                f"constraints must hold Holonomic, Nonholonomic, Pfaffian, AccelerationConstraint or Servo, got "
                f"{constraint!r}."
            )
    names = [constraint.name for constraint in constraints]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ValueError(f"Constraints need names of their own; {', '.join(map(repr, repeated))} is there twice.")


def is_linear(constraint: AbstractConstraint, arguments: tuple[Any, ...]) -> bool:
    """Whether a constraint is linear in velocities up to a term without them."""
    slope = lambda t, q, v, p: jax.jacfwd(constraint, 2)(t, q, v, p)
    return not depends(slope, arguments, 2)


def is_rheonomic(constraint: AbstractConstraint, arguments: tuple[Any, ...]) -> bool:
    """Whether a constraint depends on time."""
    return depends(constraint, arguments, 0)
