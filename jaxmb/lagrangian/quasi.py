"""Nonlinear quasi-velocities, and the forces that hold the dependent velocities at zero."""

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._types import Coordinates, Scalar, VectorLike, Velocities
from ..linalg.elimination import eliminate, full_pivot
from ..linalg.newton import newton
from .kinematics import AbstractKinematics, Parameters

_ITERATIONS = 50


class QuasiVelocities(AbstractKinematics):
    r"""Velocities that are any functions of the rates, `ω = ω(t, q, q̇)`; the `dependent` velocities are zero.

    ```python
    speed_and_heading = lambda t, q, v, p: jnp.array([jnp.hypot(v[0], v[1]) - p["speed"], jnp.arctan2(v[1], v[0])])
    near = lambda t, q, omega, p: p["speed"] * jnp.array([jnp.cos(omega[1]), jnp.sin(omega[1])])
    held = jaxmb.lagrangian.QuasiVelocities(speed_and_heading, near=near, dependent=(0,))
    common = {"kinetic": lambda t, q, v, p: 0.5 * v @ v, "potential": lambda t, q, p: 9.81 * q[1], "q": [0.0, 0.0]}
    particle = jaxmb.lagrangian.LagrangianSystem(**common, kinematics=held, u=[0.3], parameters={"speed": 1.0})
    ```

    There are as many functions as coordinates, invertible for the rates. `ω_D = 0` are nonholonomic constraints, also
    nonlinear; virtual displacements are Chetaev's, along `∂q̇/∂ω_I`. The system's velocities u are the independent ω_I,
    in their order. Newton's method finds the inverse from the rates `near`, which select the branch at a fold; the
    inverse is differentiated as an implicit function.

    **Arguments:**

    - `omega(t, q, v, parameters)`: shape (nq,).
    - `dependent`: indices of the components that are zero.
    - `near`: start of Newton's method, rates of shape (nq,), or a function `near(t, q, omega, parameters)`, for
        branches that turn.

    **Reference:**

    ```bibtex
    @article{papastavridis1994boltzmann,
      author = {Papastavridis, J. G.}, title = {On the Boltzmann-Hamel Equations of Motion: A Vectorial
      Treatment}, journal = {Journal of Applied Mechanics}, volume = {61}, number = {2}, pages = {453--459},
      year = {1994},
    }
    ```
    """

    omega: Callable[..., Array] = eqx.field(static=True)
    near: Float[Array, "nq"] | None
    near_at: Callable[..., Array] | None = eqx.field(static=True)
    dependent: tuple[int, ...] = eqx.field(static=True)
    identity: ClassVar[bool] = False
    linear: ClassVar[bool] = False
    drift_free: ClassVar[bool] = False

    def __init__(
        self,
        omega: Callable[..., Array],
        near: VectorLike | Callable[..., Array],
        dependent: tuple[int, ...] = (),
    ):
        self.omega = omega
        self.near = None if callable(near) else jnp.asarray(near, jnp.result_type(float))
        self.near_at = near if callable(near) else None
        self.dependent = tuple(dependent)

    def count(self, nq):
        if any(not 0 <= k < nq for k in self.dependent) or len(set(self.dependent)) != len(self.dependent):
            raise ValueError(f"dependent lists some of the {nq} quasi-velocities, each once; got {self.dependent}.")
        return nq - len(self.dependent)

    def all_of(self, nq: int, u: Velocities) -> Float[Array, "nq"]:
        """ω, from the independent components."""
        return jnp.zeros(nq, u.dtype).at[np.delete(np.arange(nq), self.dependent)].set(u)

    def rates(self, t, q, u, parameters):
        return self.rates_of_all(t, q, self.all_of(q.size, u), parameters)

    def rates_of_all(
        self, t: Scalar, q: Coordinates, omega: Float[Array, "nq"], parameters: Parameters
    ) -> Float[Array, "nq"]:
        """`q̇(t, q, ω)`; NaN where Newton's method does not converge."""
        near = self.near if self.near_at is None else self.near_at(t, q, omega, parameters)
        return _inverse(self.omega, jnp.asarray(t, q.dtype), q, omega, parameters, lax.stop_gradient(near))


@eqx.filter_custom_jvp
def _inverse(omega, t, q, target, parameters, near):
    residual = lambda v: omega(t, q, v, parameters) - target
    slope = jax.jacfwd(residual)

    def correct(v):
        step = _solve(slope(v), residual(v))
        return v - step, jnp.max(jnp.abs(step))

    far = lambda v, size: size > 8 * jnp.finfo(v.dtype).eps * (1.0 + jnp.max(jnp.abs(v)))
    v, size = newton(correct, far, near, most=_ITERATIONS, dtype=q.dtype)
    # The inverse is accepted also if rounding keeps corrections slightly larger than demanded.
    converged = size <= jnp.sqrt(jnp.finfo(q.dtype).eps) * (1.0 + jnp.max(jnp.abs(v)))
    return jnp.where(converged, v, jnp.nan)


@_inverse.def_jvp
def _inverse_jvp(primals, tangents):
    omega, t, q, target, parameters, near = primals
    _, dt, dq, dtarget, dparameters, _ = tangents
    v = _inverse(omega, t, q, target, parameters, near)
    _, drift = eqx.filter_jvp(lambda t, q, p: omega(t, q, v, p), (t, q, parameters), (dt, dq, dparameters))
    drift = jnp.zeros_like(v) if drift is None else drift
    change = -drift if dtarget is None else dtarget - drift
    return v, _solve(jax.jacfwd(omega, 2)(t, q, v, parameters), change)


def _solve(matrix, right):
    return eliminate(matrix, lax.stop_gradient(full_pivot(matrix).order), matrix.shape[0]).right_inverse @ right
