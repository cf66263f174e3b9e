"""Equations of a program that only call another program, and tables of rules for the others."""

from collections.abc import Callable
from typing import Any, TypeVar

from .._compat import ClosedJaxpr

Rule = TypeVar("Rule")

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


def entered_in(rules: dict[str, Rule]) -> Callable[..., Callable[[Rule], Rule]]:
    """A decorator that enters a function in a table as the rule of the primitives it names."""

    def rule(*names: str) -> Callable[[Rule], Rule]:
        def enter(function: Rule) -> Rule:
            rules.update(dict.fromkeys(names, function))
            return function

        return enter

    return rule
