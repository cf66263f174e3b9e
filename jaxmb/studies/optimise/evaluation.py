"""Objective and constraints of a design with their derivatives, from one compiled program."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._arguments import bounds_of
from ..._traced_functions import traced_by_jax
from ...parts.names import unknown
from ...system.quantities import component_names
from ..batch import batch
from .space import Space

# A row in reverse mode costs about as much as this number of tangents in forward mode: a gradient takes three to five
# runs; forward mode has a fixed cost and little for each further tangent.
_TANGENTS_A_ROW = 2

# The name of the output of a function that returns a number.
OBJECTIVE = "objective"


class Program(eqx.Module):
    """Outputs of a function of named parameters, as rows that depend on the vector of the parameters' components.

    **Fields:** `function(values)`; `space`: named values of a vector; `names` of the outputs that are rows; `forward`:
    the mode of differentiation.
    """

    function: Callable[..., Any]
    space: Space
    names: tuple[str, ...] = eqx.field(static=True)
    forward: bool = eqx.field(static=True)

    def outputs(self, z: Float[Array, "n"]) -> dict[str, Array]:
        """All outputs by name."""
        out = self.function(self.space(z))
        return {
            name: jnp.asarray(x, z.dtype) for name, x in (out if isinstance(out, Mapping) else {OBJECTIVE: out}).items()
        }

    def rows(self, z: Float[Array, "n"]) -> tuple[Float[Array, "rows"], dict[str, Array]]:
        out = self.outputs(z)
        return jnp.concatenate([out[name].reshape(-1) for name in self.names]), out

    def linearised(self, z: Float[Array, "n"]) -> tuple[Float[Array, "rows"], Float[Array, "rows n"], dict[str, Array]]:
        """Rows, their Jacobian, and all outputs."""

        def rows(z):
            value, out = self.rows(z)
            return value, (value, out)

        if self.forward:
            jacobian, (value, out) = jax.jacfwd(rows, has_aux=True)(z)
        else:
            value, pull, (_, out) = jax.vjp(rows, z, has_aux=True)
            (jacobian,) = jax.vmap(pull)(jnp.eye(value.size, dtype=value.dtype))
        return value, jacobian, out


@eqx.filter_jit
def linearised(program: Program, z: Float[Array, "n"]):
    """Rows, their Jacobian, and all outputs."""
    return program.linearised(z)


@eqx.filter_jit
def rows_of_batch(program: Program, z: Float[Array, "starts n"]) -> Float[Array, "starts rows"]:
    """Rows of several vectors at once."""
    return batch(lambda z: program.rows(z)[0])(z)


@dataclasses.dataclass(frozen=True)
class Limits:
    """Bounds of outputs, component by component.

    **Fields:** `names` of the outputs; `components`: names of all components, the rows after the objective; `low`,
    `high`, equal for equations.
    """

    names: tuple[str, ...]
    components: tuple[str, ...]
    low: np.ndarray
    high: np.ndarray

    def worst(self, values: np.ndarray, scales: np.ndarray) -> str:
        """The component farthest out of its bounds, relative to its size, in words."""
        k = int(np.argmax(self.excess(values, scales)))
        low, high = self.low[k], self.high[k]
        if low == high:
            return f"{self.components[k]!r} is {values[k]:.6g} instead of {low:.6g}"
        side = f"below {low:.6g}" if values[k] < low else f"above {high:.6g}"
        return f"{self.components[k]!r} is {values[k]:.6g}, {side}"

    def excess(self, values: np.ndarray, scales: np.ndarray) -> np.ndarray:
        """The violation of bounds by components, relative to the sizes of both sides; zero within."""
        low, high = scales
        return np.maximum(np.maximum((self.low - values) / low, (values - self.high) / high), 0.0)


def output_shapes(program: Program) -> dict[str, tuple[int, ...]]:
    """The shapes of all outputs.

    **Raises:** `ValueError` for outputs that are not real numbers.
    """
    with traced_by_jax("the function of optimise", "a parameter"):
        outputs = eqx.filter_eval_shape(lambda z: program.function(program.space(z)), jnp.zeros(program.space.size))
    outputs = outputs if isinstance(outputs, Mapping) else {OBJECTIVE: outputs}
    shapes = {}
    for name, output in outputs.items():
        if not isinstance(name, str) or not hasattr(output, "shape") or not jnp.issubdtype(output.dtype, jnp.number):
            raise ValueError(
                f"The function must return a number, or numbers and arrays by name; got {output!r} under {name!r}."
            )
        shapes[name] = output.shape
    return shapes


def chosen_objective(objective: str | None, shapes: Mapping[str, tuple[int, ...]], constraints: Any) -> str:
    """The name of the objective among the outputs.

    **Raises:** `ValueError` for an unknown output, an objective that is not a number, and a missing name.
    """
    if objective is None:
        left = [name for name in shapes if name not in (constraints or {})]
        if len(left) != 1:
            raise ValueError(f"Name the objective, one of the outputs {', '.join(map(repr, shapes))}.")
        objective = left[0]
    if objective not in shapes:
        raise unknown("output", objective, shapes)
    if shapes[objective] != ():
        raise ValueError(f"The objective must be a number, but {objective!r} has shape {shapes[objective]}.")
    return objective


def limits(constraints: Mapping[str, Any] | None, shapes: Mapping[str, tuple[int, ...]]) -> Limits:
    """Bounds of outputs by name, from `(low, high)`, or from a number for an equation.

    **Raises:** `ValueError` for unknown outputs and for bounds that are reversed, absent, or of another shape.
    """
    names, components, lows, highs = [], [], [], []
    for name, given in (constraints or {}).items():
        if name not in shapes:
            raise unknown("output", name, shapes)
        # A list is an array that the output equals, or, for an output that is a number, two bounds.
        pair = isinstance(given, tuple) or (isinstance(given, list) and shapes[name] == ())
        sides = given if pair else (given, given)
        if all(side is None for side in sides):
            raise ValueError(
                f"The constraint of {name!r} must be (low, high), one of them None at most; got {given!r}."
            )
        low, high = bounds_of(f"The constraint of {name!r}", sides, shapes[name], equal=True)
        names.append(name)
        components += component_names(name, shapes[name])
        lows.append(low.ravel())
        highs.append(high.ravel())
    flat = lambda parts: np.concatenate([np.zeros(0), *parts])
    return Limits(tuple(names), tuple(components), flat(lows), flat(highs))


def with_derivatives(program: Program, rows: int) -> Program:
    """The program in the cheaper mode of derivatives that the function allows.

    **Raises:** `ValueError` for a function without derivatives.
    """
    cheaper = program.space.size <= _TANGENTS_A_ROW * rows
    first: Exception | None = None
    for forward in (cheaper, not cheaper):
        trial = Program(program.function, program.space, program.names, forward)
        try:
            eqx.filter_eval_shape(trial.linearised, jnp.zeros(program.space.size))
        except (TypeError, ValueError) as error:
            first = first or error
            continue
        return trial
    raise ValueError(
        "The function has no derivatives in either mode. A jax.custom_vjp rules out forward mode; a loop such as "
        "jax.lax.while_loop rules out reverse mode."
    ) from first
