"""Equations of a program that only call another program."""

from typing import Any

from .._compat import ClosedJaxpr

# The parameter that holds the called program, by the name of the primitive. (JAX 0.9 to 0.12.)
_PROGRAMS = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "checkpoint": "jaxpr",
    "remat2": "jaxpr",
    # Functions with their own rule for batches.
    "custom_vmap_call": "call",
}


def called(equation: Any) -> Any:
    """The closed program that an equation calls; None for any other equation."""
    place = _PROGRAMS.get(equation.primitive.name)
    if place is None:
        return None
    program = equation.params[place]
    return program if hasattr(program, "consts") else ClosedJaxpr(program, ())
