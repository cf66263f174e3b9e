"""Evaluations of a term, alike for a plain vector field and for one on a manifold.

diffrax hands a solver its terms wrapped, so that time always increases; what is returned here is the derivative with
respect to that time.
"""

from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from diffrax._term import AdjointTerm, WrapTerm  # diffrax's own wrappers, which it does not export
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from ._base import AbstractManifoldTerm, Args, Chart


class Evaluation(NamedTuple):
    """`y` restored to the manifold, `f` there, the chart, and whether this failed; `y` and `f` are raveled."""

    y: Array
    f: Array
    chart: Chart | None
    failed: Any


def check_term(term: Any) -> None:
    """Raise a `ValueError` unless `term` is an ordinary differential equation."""
    while isinstance(term, (WrapTerm, AdjointTerm)):
        term = term.term
    if not isinstance(term, (diffrax.ODETerm, AbstractManifoldTerm)):
        raise ValueError(
            f"Multistep solvers integrate one `diffrax.ODETerm` or one `AbstractManifoldTerm`, but got a "
            f"`{type(term).__name__}`. Add several vector fields up in a single `ODETerm`; turn a `ControlTerm` with a "
            f"differentiable control into one with `.to_ode()`."
        )


def _manifold(term: Any) -> AbstractManifoldTerm | None:
    return term.term if isinstance(term.term, AbstractManifoldTerm) else None


def ravel(y: PyTree[Array], dtype: Any = None) -> Array:
    """All components of a pytree in one vector, of `dtype` if that is given."""
    with jax.numpy_dtype_promotion("standard"):
        flat, _ = ravel_pytree(y)
    return flat if dtype is None else flat.astype(dtype)


def unravel_like(y: PyTree[Array], flat: Array) -> PyTree[Array]:
    """The inverse of `ravel` on the structure of `y`."""
    with jax.numpy_dtype_promotion("standard"):
        _, unravel = ravel_pytree(y)
    return unravel(flat)


def derivative(term: Any, t: Any, y: PyTree[Array], args: Args) -> PyTree[Array]:
    """The vector field as a rate in the direction of integration."""
    zero = jnp.zeros_like(t)
    return term.vf_prod(t, y, args, term.contr(zero, zero + 1))


def first_chart(term: Any, t: Any, y: PyTree[Array], args: Args) -> Chart | None:
    """A chart at `y`, or `None` for a plain vector field."""
    manifold = _manifold(term)
    return None if manifold is None else _freeze(manifold.init_chart(t * term.direction, y, args))


def next_chart(term: Any, t: Any, y: PyTree[Array], chart: Chart | None, args: Args) -> Chart | None:
    """The same chart, or a better one at `y`."""
    manifold = _manifold(term)
    return None if manifold is None else _freeze(manifold.update_chart(t * term.direction, y, chart, args))


def evaluate(term: Any, t: Any, flat: Array, like: PyTree[Array], chart: Chart | None, args: Args) -> Evaluation:
    """Restore a raveled state to the manifold, if there is one, and evaluate the vector field there."""
    y = unravel_like(like, flat)
    manifold = _manifold(term)
    if manifold is None:
        return Evaluation(flat, ravel(derivative(term, t, y, args), flat.dtype), None, False)
    y, f, chart, failed = manifold.evaluate(t * term.direction, y, chart, args)
    f = ravel(f, flat.dtype) * jnp.asarray(term.direction).astype(flat.dtype)
    return Evaluation(ravel(y, flat.dtype), f, _freeze(chart), failed)


def free_components(term: Any, chart: Chart | None) -> Array | None:
    """A raveled mask of the components that are integrated, or `None` if all of them are."""
    manifold = _manifold(term)
    return None if manifold is None else ravel(manifold.free(chart), bool)


def _freeze(chart: Chart) -> Chart:
    # Index sets and factors steer the solution of the constraints and are no part of its value.
    return jax.tree.map(jax.lax.stop_gradient, chart)
