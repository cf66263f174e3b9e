"""Newton's method and its chord variant inside `lax`, and the derivative of their solution.

Iterations are not differentiated: the derivative of a root follows from its equation, by the implicit function theorem.
(The iteration of the implicit solvers is in `solvers/_newton.py`, which does not use `linalg`.)
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from .elimination import solve


def newton(
    correct: Callable[[PyTree], tuple[PyTree, Float[Array, ""]]],
    far: Callable[[PyTree, Float[Array, ""]], Bool[Array, ""]],
    start: PyTree,
    *,
    most: int,
    dtype: Any,
) -> tuple[PyTree, Float[Array, ""]]:
    """Correct an iterate until it is close enough.

    **Arguments:** `correct(x)`: the next iterate and the size of the correction; `far(x, size)`: whether to continue
    from an iterate that was reached by a correction of this size; `most`: the largest number of corrections; `dtype` of
    sizes.

    **Returns:** the last iterate and the size of its correction.
    """

    def advance(carry):
        x, _, k = carry
        return *correct(x), k + 1

    def proceed(carry):
        x, size, k = carry
        return far(x, size) & (k < most)

    x, size, _ = lax.while_loop(proceed, advance, (start, jnp.array(jnp.inf, dtype), 0))
    return x, size


def chord(
    correct: Callable[[PyTree], tuple[PyTree, Float[Array, ""]]],
    start: PyTree,
    *,
    first: Float[Array, ""],
    tol: Any,
    most: int,
    rate: Any = 0.0,
    rounding: Any = None,
    largest: Any = 1.0,
    peel: bool = False,
) -> tuple[PyTree, Int[Array, ""], Bool[Array, ""]]:
    """Newton's method with one matrix for all corrections.

    Corrections shrink by a constant factor, so the size of the next correction is known without iterating. The
    iteration ends if the next correction is below `tol`, or at the level of rounding errors, where corrections stop
    shrinking. It fails if a correction is too large.

    **Arguments:**

    - `correct(x)`: the next iterate and the relative size of the correction.
    - `first`: the size to which the first correction is compared. 1: the error of the matrix is as large as the first
        correction; 0: unknown, and a second correction is made.
    - `tol`: the bound of the next correction.
    - `most`: the largest number of corrections.
    - `rate`: a lower bound of the factor by which corrections shrink.
    - `rounding`: the size below which they may stop shrinking, default some thousand rounding errors.
    - `largest`: the size from which a correction is too large.
    - `peel`: whether the first correction precedes the loop. This saves half a microsecond in small programs, and
        compiles the correction twice.

    **Returns:** the last iterate, the number of corrections, and whether the iteration failed.
    """

    def advance(carry):
        x, before, _, k = carry
        x, size = correct(x)
        shrinks = jnp.where(size < before, size / before, 1.0)
        small = 4096 * jnp.finfo(size.dtype).eps if rounding is None else rounding
        rounded = (size < small) & (shrinks > 0.5)
        return x, size, jnp.where(rounded, 0.0, size * jnp.maximum(shrinks, rate)), k + 1

    def proceed(carry):
        _, size, ahead, k = carry
        return (not peel and k == 0) | ((ahead > tol) & (size < largest) & (k < most))

    carry = (start, first, first, jnp.array(0))
    x, _, ahead, k = lax.while_loop(proceed, advance, advance(carry) if peel else carry)
    return x, k, ~(ahead <= tol)


def root(residual: Callable[[Array], Array], start: Array, solve: Callable[[Callable, Array], Array]) -> Array:
    """The root that `solve(residual, start)` finds, differentiated implicitly."""
    return lax.custom_root(residual, start, solve, solve_linear)


def solve_linear(linear: Callable[[Array], Array], b: Float[Array, "n"]) -> Float[Array, "n"]:
    """Solve `linear(x) = b` with the matrix of a linear function."""
    return solve(jax.vmap(linear, out_axes=1)(jnp.eye(b.size, dtype=b.dtype)), b)
