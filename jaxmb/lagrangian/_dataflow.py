"""What a function depends on, found without running it."""

from collections.abc import Callable
from typing import Any

import jax
from jax.extend.core import Literal


def depends(function: Callable[..., Any], arguments: tuple[Any, ...], which: int) -> bool:
    """Whether the data flow of a function leads from one of its arguments to its values.

    An argument that only drops out numerically (a factor of zero) counts as one that it depends on.
    """
    closed = jax.make_jaxpr(function)(*arguments)
    sizes = [len(jax.tree.leaves(argument)) for argument in arguments]
    first = sum(sizes[:which])
    reached = set(closed.jaxpr.invars[first : first + sizes[which]])
    for equation in closed.jaxpr.eqns:
        if any(not isinstance(v, Literal) and v in reached for v in equation.invars):
            reached.update(equation.outvars)
    return any(not isinstance(v, Literal) and v in reached for v in closed.jaxpr.outvars)
