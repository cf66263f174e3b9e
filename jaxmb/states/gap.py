"""The gap of a mechanism that does not close: a smooth distance for optimisers where `assemble` fails."""

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._types import Coordinates, Scalar, State, VectorLike
from ..linalg.newton import newton
from ..system import AbstractSystem
from .arguments import (
    check_system,
    checked_guess,
    checked_time,
    holding,
    prescribe,
    split_coordinates,
    split_internal_states,
)
from .closest import meet_constraints, residual_size, tolerance

# Newton's method on the squares: largest number of steps, size of the last step, and halvings of a step.
_ITERATIONS = 200
_LAST = 1e-12
_HALVINGS = 12

# Curvatures below this share of the largest curvature count as this share.
_FLAT = 1e-8


def assembly_gap(
    system: AbstractSystem,
    guess: State | None = None,
    *,
    fix: Mapping[str, VectorLike] | None = None,
    t: Scalar = 0.0,
) -> Float[Array, ""]:
    """The distance of a mechanism from closing, zero if `assemble` finds a configuration.

    ```python
    gap = jaxmb.assembly_gap(system, fix={"bar.x": 0.8})  # The pin holds the bar's centre at 0.5 m.
    ```

    A coupler that is too short leaves a gap between its joint and the rocker. `assemble(..., throw=False)` then returns
    a state of NaN, which tells an optimiser nothing. The gap tells it the way: as a constraint of `optimise`,
    `{"gap": (None, 0)}`, or as a first objective if a start cannot be assembled.

    The gap is the least norm of the residuals of all position constraints, near the guess, by Newton's method. Each
    residual is relative to the norm of its gradient at the guess, with translations in units of `system.length`. So the
    gap is about the open distance divided by the system's size.

    The gap is proportional to the missing length, so it has a kink at zero; its square is smooth. First derivatives by
    parameters, guess and prescribed values are exact: a minimum changes with parameters as the function does at a fixed
    configuration (the envelope theorem). Second derivatives are wrong.

    **Arguments:** as for `assemble`. Coordinates in `fix` keep their values; rates do not matter.

    **Returns:** the gap, dimensionless; exactly zero if the constraints can be met.
    """
    check_system("assembly_gap", system)
    guess = checked_guess("assembly_gap", system, guess)
    t = checked_time("assembly_gap", t, guess.q.dtype)
    _, fix = split_internal_states(system, guess.z, fix)
    fix, of_joints = split_coordinates(system, fix)
    system = holding(system, of_joints, {}, t)
    q, fixed = prescribe("coordinate", system.coordinate_names(), fix, guess.q)
    q, _ = system.normalize_fixed(q, fixed)
    return _gap(system, t, q, tuple(fixed.tolist()))


@eqx.filter_jit
def _gap(system: AbstractSystem, t: Scalar, guess: Coordinates, held: tuple[bool, ...]) -> Float[Array, ""]:
    if system.coordinate_rows == 0:
        return jnp.zeros((), guess.dtype)
    scale = jnp.where(np.array(held), 0.0, system.coordinate_scale())
    frozen, t0, start = lax.stop_gradient((system, t, guess))
    met, jacobian = meet_constraints(frozen, t0, start, scale)
    closed = lax.stop_gradient(residual_size(frozen, t0, met, jacobian) <= tolerance(guess.dtype))
    weights = _weights(system, t, guess)
    fixed_weights = lax.stop_gradient(weights)
    nearest = lax.stop_gradient(_nearest(lambda q: fixed_weights * _residual(frozen, t0, q), start, scale))
    square = jnp.sum((weights * _residual(system, t, nearest)) ** 2)
    open_ = ~closed & (square > 0)
    return jnp.where(open_, jnp.sqrt(jnp.where(open_, square, 1.0)), 0.0)


def _weights(system, t, q):
    """One over the norms of the rows of the scaled Jacobian; rows without a gradient take the largest norm."""
    jacobian = system.coordinate_jacobian(t, q) * system.coordinate_scale()[None, :]
    squares = jnp.sum(jacobian * jacobian, axis=1)
    some = squares > jnp.finfo(q.dtype).eps ** 1.5 * jnp.max(squares)
    return 1.0 / jnp.sqrt(jnp.where(some, squares, jnp.max(squares) + jnp.finfo(q.dtype).tiny))


def _residual(system, t, q):
    """Φ of normalised coordinates, and the coordinates' invariants, so that no body shrinks to close a gap."""
    position = system.position_residual(t, system.normalize(t, q))
    return jnp.concatenate([position, system.coordinate_residual(t, q)[system.position_rows :]])


def _nearest(residual, start, scale):
    """A local minimum of the sum of squares, by Newton's method with the sizes of curvatures and step halving."""

    def squares(z):
        return 0.5 * jnp.sum(residual(start + scale * z) ** 2)

    def slope(z):
        value, gradient = jax.value_and_grad(squares)(z)
        return gradient, (value, gradient)

    def correct(z):
        hessian, (value, gradient) = jax.jacfwd(slope, has_aux=True)(z)
        curvatures, directions = jnp.linalg.eigh(hessian)
        sizes = jnp.abs(curvatures)
        sizes = jnp.maximum(sizes, _FLAT * jnp.max(sizes) + jnp.finfo(z.dtype).tiny)
        step = -directions @ ((directions.T @ gradient) / sizes)
        longest = jnp.max(jnp.abs(step))
        step = step / jnp.maximum(longest, 1.0)
        lengths = 0.5 ** jnp.arange(_HALVINGS, dtype=z.dtype)
        values = lax.map(lambda a: squares(z + a * step), lengths)
        best = jnp.argmin(jnp.where(jnp.isfinite(values), values, jnp.inf))
        # At the level of rounding errors no step decreases the squares, and the full Newton step is the best.
        small = longest <= jnp.finfo(z.dtype).eps ** 0.5
        better = (values[best] < value) | small
        length = jnp.where(better, jnp.where(small, 1.0, lengths[best]), 0.0)
        return z + length * step, jnp.where(better, longest, 0.0)

    far = lambda z, size: (size > _LAST) & jnp.all(jnp.isfinite(z))
    z = newton(correct, far, jnp.zeros_like(start), most=_ITERATIONS, dtype=start.dtype)[0]
    return start + scale * z
