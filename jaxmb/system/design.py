"""Design variables for a system: one name for a number on which several parameters depend."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, ArrayLike

from .._arguments import check_kind, real_shape
from .._index_bounds import check_indices
from .._traced_functions import asked_argument, traced_by_jax
from .._types import VectorLike
from ..linalg.arrays import is_traced
from ..parts.fields import as_jax
from ..parts.names import unknown
from .design_variables import DesignVariables, Variable
from .parameters import System, parameters, with_parameters
from .system import AbstractSystem

Bounds = tuple[ArrayLike | None, ArrayLike | None]


def design(
    system: System,
    variables: Mapping[str, Variable | VectorLike],
    derive: Callable[[dict[str, Array]], Mapping[str, VectorLike]],
) -> System:
    """Give a system design variables that determine several of its parameters.

    The length of a coupler appears in the points of two joints and in a moment of inertia. As a design variable it has
    one name:

    ```python
    machine = mb.design(
        system,
        {"rod": mb.Variable(3.0, bounds=(1.0, 5.0), unit="m")},
        lambda v: {
            "B.point_b": jnp.array([-v["rod"] / 2, 0.0]),
            "C.point_a": jnp.array([v["rod"] / 2, 0.0]),
            "coupler.inertia": 3.0 * v["rod"] ** 2 / 12,
        },
    )
    longer = mb.with_parameters(machine, {"rod": 3.2})
    ```

    The result is the same system, with the variables among its parameters: `with_parameters`, `identify`
    and `optimise` take them by name, with their bounds. States change with lengths, so `assemble` them anew.

    **Arguments:**

    - `system`: a compiled scene, or another system. If it has design variables already, these may follow from the new
        variables.
    - `variables`: `Variable`s by name, or values alone.
    - `derive(values)`: parameters by name from the values of all variables by name, a pure JAX function. It is static:
        systems that share it share their compiled programs.

    **Returns:** the system, with all parameters that `derive` gives.

    **Raises:** `ValueError` for a name that the system has already, and for a variable that `derive` does not use. Also
    for derived parameters that are unknown, follow from other variables already, or have another shape.
    """
    check_kind("design: system", system, AbstractSystem, "a compiled scene or another system", "scene.compile()")
    existing = parameters(system)
    if not isinstance(variables, Mapping) or not variables:
        raise ValueError(f"variables must be Variables by name, at least one; got {variables!r}.")
    declared = {}
    for name, value in variables.items():
        if not isinstance(name, str) or not name:
            raise ValueError(f"A design variable's name is a string that is not empty, got {name!r}.")
        if name in existing:
            raise ValueError(f"The system has a parameter {name!r} already; give the design variable another name.")
        try:
            # A concrete class: the declaration that users write, or a number in its place.
            declared[name] = value if isinstance(value, Variable) else Variable(value)
        except ValueError as error:
            raise ValueError(f"Design variable {name!r}: {error}") from None
    values = {name: as_jax(variable.value) for name, variable in declared.items()}
    added = DesignVariables(values, tuple(declared.items()), derive, ())
    derived = _checked(added, existing)
    changed = with_parameters(system, derived)
    added = DesignVariables(values, added.variables, derive, tuple(derived))
    return eqx.tree_at(lambda s: s.design, changed, (*changed.design, added), is_leaf=lambda x: x is changed.design)


def design_bounds(system: AbstractSystem, bounds: Mapping[str, Bounds] | None = None) -> dict[str, Bounds]:
    """The given bounds by name, completed by the bounds of design variables.

    **Raises:** `ValueError` for bounds that reach beyond the bounds of a design variable.
    """
    out = dict(bounds or {})
    for group in system.design:
        for name, variable in group.variables:
            low, high = out.get(name, (None, None))
            low, high = (variable.low if low is None else low), (variable.high if high is None else high)
            if np.any(np.asarray(low) < variable.low) or np.any(np.asarray(high) > variable.high):
                raise ValueError(
                    f"The bounds {out[name]} of {name!r} reach beyond those of the design variable, "
                    f"{variable.low.tolist(), variable.high.tolist()}."
                )
            if name in out or np.any(np.isfinite([variable.low, variable.high])):
                out[name] = low, high
    return out


def _checked(added: DesignVariables, existing: Mapping[str, Array]) -> dict[str, Array]:
    """The checked parameters that follow from the initial values of design variables."""
    try:
        derived: Any = added.derive(dict(added.values))
    except KeyError as error:
        if asked_argument(error) is None:
            raise
        raise unknown("design variable", str(error.args[0]), added.values) from None
    if not isinstance(derived, Mapping) or not derived:
        raise ValueError(f"derive must return parameters by name, at least one; got {derived!r}.")
    for name, value in derived.items():
        if name not in existing:
            raise unknown("parameter", name, existing)
        shape = real_shape(f"The derived parameter {name!r}", value)
        if shape != existing[name].shape:
            raise ValueError(
                f"The derived parameter {name!r} has shape {shape}, but {existing[name].shape} in the system."
            )
        if not is_traced(value) and not np.all(np.isfinite(np.asarray(value))):
            raise ValueError(f"The derived parameter {name!r} is not finite: {np.asarray(value)}.")
    with traced_by_jax("derive", "a design variable"):
        closed = jax.make_jaxpr(added.derive)(dict(added.values))
    check_indices(closed, "derive")
    program = closed.jaxpr
    used = {id(v) for equation in program.eqns for v in equation.invars} | {id(v) for v in program.outvars}
    # JAX sorts the entries of a dictionary.
    idle = [name for name, v in zip(sorted(added.values), program.invars, strict=True) if id(v) not in used]
    if idle:
        raise ValueError(f"Nothing follows from the design variable {idle[0]!r}: use it in derive, or leave it out.")
    return {name: as_jax(value) for name, value in derived.items()}
