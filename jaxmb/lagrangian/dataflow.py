"""The arguments that a function depends on, found from its data flow without running it."""

from collections.abc import Callable
from typing import Any

import jax

from .._compat import Literal


def depends(function: Callable[..., Any], arguments: tuple[Any, ...], *which: int) -> bool:
    """Whether the data flow of a function leads from one of these arguments to its values.

    A dependence with a factor of zero counts as well.
    """
    closed = jax.make_jaxpr(function)(*arguments)
    owner = [k for k, argument in enumerate(arguments) for _ in jax.tree.leaves(argument)]
    reached = {v for k, v in zip(owner, closed.jaxpr.invars, strict=True) if k in which}
    for equation in closed.jaxpr.eqns:
        if any(not isinstance(v, Literal) and v in reached for v in equation.invars):
            reached.update(equation.outvars)
    return any(not isinstance(v, Literal) and v in reached for v in closed.jaxpr.outvars)
