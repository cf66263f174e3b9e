"""Facts about a function that hold for all its arguments, found from its data flow without compiling it."""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ._compat import ClosedJaxpr, Jaxpr, Literal
from .linalg.arrays import ARRAYS

# Operations that are analytic where they are finite. A composition of these that vanishes at independent random numbers
# vanishes everywhere.
_ANALYTIC = {
    *("add", "add_any", "sub", "mul", "div", "neg", "square", "integer_pow", "pow", "sqrt", "rsqrt", "cbrt"),
    *("exp", "exp2", "expm1", "log", "log1p", "logistic", "sin", "cos", "tan", "asin", "acos", "atan", "atan2"),
    *("sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "erf", "dot_general", "reduce_sum", "cumsum", "reduce_prod"),
    *("broadcast_in_dim", "reshape", "squeeze", "expand_dims", "transpose", "concatenate", "pad", "rev", "copy"),
    *("slice", "dynamic_slice", "dynamic_update_slice", "gather", "scatter", "scatter-add", "convert_element_type"),
    *("optimization_barrier", "triangular_solve", "cholesky", "symmetric_product", "split"),
}
# Operations that do what their inner program does.
_CALLS = {"jit", "pjit", "closed_call", "core_call", "checkpoint", "custom_jvp_call", "custom_vjp_call"}


def depends(function: Callable[..., Any], arguments: tuple[Any, ...], *which: int) -> bool:
    """Whether the data flow of a function leads from one of these arguments to its values.

    A dependence with a factor of zero counts as well.
    """
    program, reached = _traced(function, arguments, which)
    list(_reached(program, reached))
    return any(not isinstance(v, Literal) and v in reached for v in program.outvars)


def is_analytic(function: Callable[..., Any], arguments: tuple[Any, ...], *which: int) -> bool:
    """Whether only analytic operations lead from these arguments to a function's values.

    A comparison, a choice, a loop or an absolute value may behave otherwise for other numbers.
    """
    return _is_analytic(*_traced(function, arguments, which))


def shaken(values: Any, seed: int, share: float = 0.1) -> Any:
    """A pytree with independent random numbers: each number changes by up to this share of it, a zero becomes about 1.

    Numbers that are traced are replaced by numbers of about 1; other leaves than real arrays stay.
    """
    random = np.random.default_rng(seed)

    def one(value):
        if not isinstance(value, (*ARRAYS, jax.ShapeDtypeStruct)) or not jnp.issubdtype(value.dtype, jnp.floating):
            return value
        about_one = 1 + random.uniform(-0.5, 0.5, value.shape)
        if isinstance(value, Tracer | jax.ShapeDtypeStruct):
            return about_one.astype(value.dtype)
        value = np.asarray(value)
        return np.where(value == 0, about_one, value * (1 + 2 * share * (about_one - 1))).astype(value.dtype)

    return jax.tree.map(one, values)


def _traced(function, arguments, which):
    """The program of a function, and the variables of some of its arguments."""
    program = jax.make_jaxpr(function)(*arguments).jaxpr
    owner = [k for k, argument in enumerate(arguments) for _ in jax.tree.leaves(argument)]
    return program, {v for k, v in zip(owner, program.invars, strict=True) if k in which}


def _reached(program: Any, reached: set[Any]) -> Iterator[Any]:
    """The operations that some values reach; their results are added to these values."""
    is_reached = lambda v: not isinstance(v, Literal) and v in reached
    for equation in program.eqns:
        if not any(map(is_reached, equation.invars)):
            continue
        yield equation
        if (inner := _inner(equation, is_reached)) is None:
            reached.update(equation.outvars)
            continue
        inside = inner[1]
        list(_reached(*inner))
        of_inner = zip(equation.outvars, inner[0].outvars, strict=True)
        reached.update(v for v, w in of_inner if not isinstance(w, Literal) and w in inside)


def _inner(equation: Any, is_reached: Callable[[Any], bool]) -> tuple[Any, set[Any]] | None:
    """The program that an operation calls, and its arguments that are reached; None for other operations."""
    if equation.primitive.name not in _CALLS:
        return None
    (inner,) = (x for x in equation.params.values() if isinstance(x, ClosedJaxpr | Jaxpr))
    inner = getattr(inner, "jaxpr", inner)
    return inner, {w for v, w in zip(equation.invars, inner.invars, strict=True) if is_reached(v)}


def _is_analytic(program: Any, reached: set[Any]) -> bool:
    is_reached = lambda v: not isinstance(v, Literal) and v in reached
    for equation in _reached(program, reached):
        name = equation.primitive.name
        if (inner := _inner(equation, is_reached)) is None:
            # A real number may also be rounded to a whole one.
            whole = name == "convert_element_type" and not jnp.issubdtype(equation.params["new_dtype"], jnp.floating)
            if whole or name not in _ANALYTIC:
                return False
        elif not _is_analytic(*inner):
            return False
    return True
