"""Velocities of a Lagrangian system, and the rates of the coordinates that follow from them: `q̇ = K(t, q, u)`."""

import abc
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Coordinates, Scalar, Velocities

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar

# Functions of the user take `t`, `q`, velocities if they depend on them, and the parameters: numbers and modules by
# name.
Parameters = dict[str, Any]


class AbstractKinematics(eqx.Module):
    """The map from velocities u to rates q̇.

    - `identity`: whether u is q̇.
    - `linear`: whether q̇ is affine in u; `drift_free`: whether its constant term is zero.
    """

    identity: AbstractVar[bool]
    linear: AbstractVar[bool]
    drift_free: AbstractVar[bool]

    @abc.abstractmethod
    def count(self, nq: int) -> int:
        """The number of velocities of a system with nq coordinates."""

    @abc.abstractmethod
    def rates(self, t: Scalar, q: Coordinates, u: Velocities, parameters: Parameters) -> Array:
        """q̇, shape (nq,)."""


class Rates(AbstractKinematics):
    """Velocities are the coordinates' rates, `u = q̇`: the kinematics by default."""

    identity: ClassVar[bool] = True
    linear: ClassVar[bool] = True
    drift_free: ClassVar[bool] = True

    def count(self, nq):
        return nq

    def rates(self, t, q, u, parameters):
        return u


class QuasiVelocityFrame(AbstractKinematics):
    r"""Quasi-velocities in a frame, `q̇ = N(t, q) u + ν(t, q)`.

    ```python
    along = lambda t, q, p: jnp.array([[jnp.cos(q[2]), 0.0], [jnp.sin(q[2]), 0.0], [0.0, 1.0]])  # Of (x, y, angle).
    frame = jaxmb.lagrangian.QuasiVelocityFrame(along, columns=2)
    kinetic = lambda t, q, v, p: 0.5 * (v[0] ** 2 + v[1] ** 2 + 0.1 * v[2] ** 2)
    sled = jaxmb.lagrangian.LagrangianSystem(kinetic=kinetic, kinematics=frame, q=[0.0, 0.0, 0.0], u=[1.0, 0.5])
    ```

    With fewer columns than coordinates the frame eliminates constraints: since `A N = 0`, any `u` satisfies them, and
    the equations are projected on the frame's columns.

    **Arguments:**

    - `matrix(t, q, parameters)`: N, shape (nq, nu), with independent columns everywhere.
    - `columns`: nu, the number of columns.
    - `drift(t, q, parameters)`: ν, shape (nq,); default zero.
    """

    matrix: Callable[..., Array] = eqx.field(static=True)
    columns: int = eqx.field(static=True)
    drift: Callable[..., Array] | None = eqx.field(static=True, default=None)
    identity: ClassVar[bool] = False
    linear: ClassVar[bool] = True

    @property
    def drift_free(self) -> bool:
        return self.drift is None

    def count(self, nq):
        if not 0 < self.columns <= nq:
            raise ValueError(
                f"A frame must have at least one column and at most one per coordinate, {nq}; got {self.columns}."
            )
        return self.columns

    def columns_of(self, t: Scalar, q: Coordinates, parameters: Parameters) -> Float[Array, "nq columns"]:
        """N."""
        return _of_shape("The matrix of a frame", (q.size, self.columns), self.matrix(t, q, parameters))

    def rates(self, t, q, u, parameters):
        v = self.columns_of(t, q, parameters) @ u
        if self.drift is not None:
            v = v + _of_shape("The drift of a frame", q.shape, self.drift(t, q, parameters))
        return v


class Connection(AbstractKinematics):
    """Velocities are the rates of some coordinates r, the base; a connection gives the rates of the others, the fibre.

    ```python
    slope = lambda t, q, p: jnp.array([[-jnp.tan(q[2]), 0.0]])  # ẏ = tan(angle) ẋ, of (x, y, angle).
    blade = jaxmb.lagrangian.Connection(base=(0, 2), fibre=(1,), matrix=slope)
    kinetic = lambda t, q, v, p: 0.5 * (v[0] ** 2 + v[1] ** 2 + 0.1 * v[2] ** 2)
    sled = jaxmb.lagrangian.LagrangianSystem(kinetic=kinetic, kinematics=blade, q=[0.0, 0.0, 0.0], u=[1.0, 0.5])
    ```

    `ṡ = −A(t, q) ṙ − a(t, q)`: constraints solved for rates, as in Voronets' equations.

    **Arguments:**

    - `base`, `fibre`: indices of the coordinates r and s, together all coordinates.
    - `matrix(t, q, parameters)`: A, shape (fibre, base).
    - `drift(t, q, parameters)`: a, shape (fibre,); default zero.
    """

    base: tuple[int, ...] = eqx.field(static=True, converter=tuple)
    fibre: tuple[int, ...] = eqx.field(static=True, converter=tuple)
    matrix: Callable[..., Array] = eqx.field(static=True)
    drift: Callable[..., Array] | None = eqx.field(static=True, default=None)
    identity: ClassVar[bool] = False
    linear: ClassVar[bool] = True

    @property
    def drift_free(self) -> bool:
        return self.drift is None

    def count(self, nq):
        if sorted((*self.base, *self.fibre)) != list(range(nq)):
            raise ValueError(
                f"A connection's base {self.base} and fibre {self.fibre} must hold the {nq} coordinates, each of them "
                "once."
            )
        return len(self.base)

    def rates(self, t, q, u, parameters):
        label = f"of the Connection of base {self.base} and fibre {self.fibre}"
        rows, columns = len(self.fibre), len(self.base)
        s = -_of_shape(f"The matrix {label}", (rows, columns), self.matrix(t, q, parameters)) @ u
        if self.drift is not None:
            s = s - _of_shape(f"The drift {label}", (rows,), self.drift(t, q, parameters))
        return jnp.zeros_like(q).at[jnp.array(self.base)].set(u).at[jnp.array(self.fibre)].set(s)


def _of_shape(what: str, shape: tuple[int, ...], value: Any) -> Array:
    value = jnp.asarray(value)
    if value.shape != shape:
        raise ValueError(f"{what} must have shape {shape}, got {value.shape}.")
    return value
