"""Evaluations of a term. A plain vector field counts as a term on a manifold without constraints.

diffrax wraps the terms of a solver so that time always increases; derivatives here are with respect to that time.
States are raveled: one vector of all components.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from .directed import direction_of, inner_term, term_of
from .manifold_term import (
    AbstractGaps,
    AbstractGuards,
    AbstractManifoldTerm,
    Args,
    Chart,
    ManifoldEvaluation,
    PlainTerm,
    stop,
)
from .packing import Layout


class Evaluation(NamedTuple):
    """A state, its derivative, the chart, whether the evaluation failed, and the manifold's evaluation."""

    y: Array
    f: Array
    chart: Chart | None
    failed: Any
    of_manifold: ManifoldEvaluation


def check_term(term: Any) -> None:
    """Raise a `ValueError` unless `term` is an ordinary differential equation."""
    term = term_of(term)
    if not isinstance(term, (diffrax.ODETerm, AbstractManifoldTerm)):
        raise ValueError(
            f"Multistep methods integrate a single `diffrax.ODETerm` or `AbstractManifoldTerm`, but got a "
            f"`{type(term).__name__}`. Several vector fields can be added up in one `ODETerm`; a `ControlTerm` with a "
            f"differentiable control becomes one by `.to_ode()`."
        )


def check_real(y: PyTree[Array]) -> None:
    """Raise a `ValueError` if a state has complex components."""
    if any(jnp.iscomplexobj(leaf) for leaf in jax.tree.leaves(y)):
        raise ValueError("Multistep methods take real states: split complex ones into real and imaginary parts.")


def ravel(y: PyTree[Array], dtype: Any = None) -> Array:
    """All components in one vector, of `dtype` if that is given."""
    with jax.numpy_dtype_promotion("standard"):
        flat, _ = ravel_pytree(y)
    return flat if dtype is None else flat.astype(dtype)


def unravel_like(y: PyTree[Array], flat: Array) -> PyTree[Array]:
    """The inverse of `ravel`, for the structure of `y`."""
    with jax.numpy_dtype_promotion("standard"):
        _, unravel = ravel_pytree(y)
    return unravel(flat)


def derivative(term: Any, t: Any, y: PyTree[Array], args: Args) -> PyTree[Array]:
    """The vector field as a rate in the direction of integration."""
    zero = jnp.zeros_like(t)
    return term.vf_prod(t, y, args, term.contr(zero, zero + 1))


def first_chart(term: Any, t: Any, y: PyTree[Array], args: Args) -> Chart | None:
    """A chart for `next_chart` at `y`; None for a plain vector field."""
    return freeze(_manifold(term).init_chart(t * direction_of(term), y, args))


def next_chart(term: Any, t: Any, y: PyTree[Array], chart: Chart | None, args: Args) -> Chart | None:
    """The same chart, or a better one at `y`."""
    return freeze(_manifold(term).update_chart(t * direction_of(term), y, chart, args))


def chart_after_step(term: Any, t: Any, y: PyTree[Array], chart: Chart | None, args: Args) -> Chart | None:
    """The chart at the end of a step to `y`, for `refused`."""
    return freeze(_manifold(term).after_step(t * direction_of(term), y, chart, args))


def refused(term: Any, chart: Chart | None, before: Chart | None) -> Any:
    """Whether the step from a chart `before` to this one must be retried with a smaller step."""
    return _manifold(term).refuses(chart, before)


def found_at_jump(term: Any, t: Any, y: PyTree[Array], args: Args) -> PyTree[Array]:
    """The numbers of a jump from which `after_jump` computes the state after it, as few vectors; None without any."""
    numbers = _manifold(term).found_at_jump(t * direction_of(term), y, args)
    return None if numbers is None else Layout(numbers).packed(numbers)


def after_jump(term: Any, t: Any, y: PyTree[Array], numbers: PyTree[Array], args: Args) -> PyTree[Array]:
    """The state just after a jump."""
    manifold, t = _manifold(term), t * direction_of(term)
    if numbers is not None:
        numbers = Layout(eqx.filter_eval_shape(manifold.found_at_jump, t, y, args)).unpacked(numbers)
    return manifold.after_jump(t, y, numbers, args)


def chart_after_jump(term: Any, chart: Chart | None) -> Chart | None:
    """The chart just after a jump, for `next_chart`."""
    return _manifold(term).chart_after_jump(chart)


def guards_of(term: Any) -> AbstractGuards | None:
    """The guards of a term; None without any."""
    return _manifold(term).guards


def gaps_of(term: Any) -> AbstractGaps | None:
    """The gaps of the forces of a term; None without any."""
    return _manifold(term).gaps


def evaluate(term: Any, t: Any, flat: Array, like: PyTree[Array], chart: Chart | None, args: Args) -> Evaluation:
    """Evaluate the vector field; `like` has the structure of the state before raveling."""
    out = _manifold(term).evaluate(t * direction_of(term), unravel_like(like, flat), chart, args)
    return _raveled(term, out, flat.dtype)


def project_near(term: Any, t: Any, flat: Array, like: PyTree[Array], before: Evaluation, args: Args) -> Evaluation:
    """Project a corrected state on the manifold, and evaluate the vector field there.

    **Arguments:** `before`: the evaluation of the prediction, at the same time.
    """
    y = unravel_like(like, flat)
    return _raveled(term, _manifold(term).project_near(t * direction_of(term), y, before.of_manifold, args), flat.dtype)


def jacobian_of(term: Any, t: Any, like: PyTree[Array], args: Args) -> Callable[[Array], Any]:
    """`y -> (J, direction)` for raveled states, a pytree. J is the derivative, with known structure, of the vector
    field in the term's time, and `direction` the direction of this time. None if the structure is unknown.
    """
    return eqx.Partial(_jacobian, term, t, like, args)


def _jacobian(term, t, like, args, flat):
    direction = direction_of(term)
    jacobian = _manifold(term).jacobian(t * direction, unravel_like(like, flat), args)
    return None if jacobian is None else (jacobian, jnp.asarray(direction))


def field_of(term: Any, t: Any, like: PyTree[Array], chart: Chart | None, args: Args) -> Any:
    """`(t, y) -> ((y on the manifold, f), (chart, failed))` for raveled states, a pytree."""
    manifold, flat = _manifold(term), ravel(like)

    def field(t, flat):
        out = manifold.project_cold(t * direction_of(term), unravel_like(like, flat), chart, args)
        out = _raveled(term, out, flat.dtype)
        return (out.y, out.f), (out.chart, jnp.asarray(out.failed))

    return eqx.filter_closure_convert(field, t, flat)


def kept_of_chart(term: Any, chart: Chart | None, at_start: bool = False) -> PyTree[Array]:
    """The part of the chart at the end of a step that `at_solution` needs; `at_start`: for the start of a run."""
    manifold = _manifold(term)
    return manifold.kept_at_start(chart) if at_start else manifold.kept(chart)


def at_solution(
    term: Any, t: Any, flat: Array, f: Array, like: PyTree[Array], kept: PyTree[Array], args: Args
) -> tuple[Array, Array]:
    """The known state and vector field at the end of a step, with their derivatives."""
    manifold, direction = _manifold(term), direction_of(term)
    sign = jnp.asarray(direction).astype(flat.dtype)
    y, f = manifold.at_solution(t * direction, unravel_like(like, flat), unravel_like(like, f * sign), kept, args)
    return ravel(y, flat.dtype), ravel(f, flat.dtype) * sign


def solution_of(term: Any, t: Any, like: PyTree[Array], kept: PyTree[Array], args: Args) -> Any:
    """`(t, y, f, along) -> (y, f, g)` for raveled states, a pytree: a known state, the vector field there, and the
    field's rate along a rate of the state (None: the field), with their derivatives by the equations.
    """
    direction = direction_of(term)
    manifold = _manifold(term).closed(t * direction, like, args)
    return eqx.Partial(_along_solution, manifold, jnp.asarray(direction), like, kept, args)


def _along_solution(manifold, direction, like, kept, args, t, flat, f, along):
    sign = direction.astype(flat.dtype)
    in_time = lambda rate: None if rate is None else unravel_like(like, rate * sign)
    y = unravel_like(like, flat)
    y, f, g = manifold.along_solution(t * direction, y, in_time(f), in_time(along), kept, args)
    return ravel(y, flat.dtype), ravel(f, flat.dtype) * sign, ravel(g, flat.dtype)


def free_components(term: Any, flat: Array, chart: Chart | None) -> Array:
    """Indices of the components that are integrated."""
    free = _manifold(term).free(chart)
    return jnp.arange(flat.size) if free is None else free


def controlled_components(term: Any, chart: Chart | None) -> Array | None:
    """A mask of the components that are integrated, or `None` if all of them are."""
    controlled = _manifold(term).controlled(chart)
    return None if controlled is None else ravel(controlled, bool)


def _raveled(term, out: ManifoldEvaluation, dtype):
    chart, factors = freeze((out.chart, out.factors))
    out, sign = out._replace(chart=chart, factors=factors), jnp.asarray(direction_of(term))
    f = jax.tree.map(lambda x: x * sign.astype(jnp.result_type(x)), out.f)
    return Evaluation(ravel(out.y, dtype), ravel(f, dtype), chart, out.failed, out)


def _manifold(term: Any) -> AbstractManifoldTerm:
    inner = inner_term(term)
    return inner if isinstance(inner, AbstractManifoldTerm) else PlainTerm(inner)


def freeze(tree: Any) -> Any:
    """The same numbers, without derivatives."""
    # Index sets and factors steer how the constraints are solved; the solution does not depend on them.
    return jax.tree.map(stop, tree)
