"""Which values of a program differ between members, where some of its inputs do."""

from typing import Any

from .._compat import Literal, sizes_of_scan
from .calls import called


def varying(jaxpr: Any, inputs: list[bool]) -> list[bool]:
    """Which outputs of a jaxpr differ between members, from the inputs that do."""
    of_variable = dict(zip(jaxpr.invars, inputs, strict=True))
    read = lambda atom: not isinstance(atom, Literal) and of_variable.get(atom, False)
    for equation in jaxpr.eqns:
        given = [read(atom) for atom in equation.invars]
        of_variable |= zip(equation.outvars, _of_equation(equation, given), strict=True)
    return [read(atom) for atom in jaxpr.outvars]


def _of_equation(equation, given):
    name, params = equation.primitive.name, equation.params
    if name.startswith("unvmap_"):
        return [False]
    inner = called(equation)
    if inner is not None:
        return varying(inner.jaxpr, given)
    match name:
        case "while":
            return varying_in_while(params, given)[1]
        case "scan":
            return varying_in_scan(params, given)[1]
        case "cond":
            branches = [varying(branch.jaxpr, given[1:]) for branch in params["branches"]]
            return [given[0] or any(outputs) for outputs in zip(*branches, strict=True)]
    return [any(given)] * len(equation.outvars)


def varying_in_while(params: Any, given: list[bool]) -> tuple[bool, list[bool]]:
    """Whether the condition of a loop differs between members, and which of its carried values differ."""
    of_cond, of_body = params["cond_nconsts"], params["body_nconsts"]
    for_cond, for_body, carry = given[:of_cond], given[of_cond : of_cond + of_body], given[of_cond + of_body :]
    while True:
        (goes_on,) = varying(params["cond_jaxpr"].jaxpr, for_cond + carry)
        after = varying(params["body_jaxpr"].jaxpr, for_body + carry)
        after = [goes_on or before or new for before, new in zip(carry, after, strict=True)]
        if after == carry:
            return goes_on, carry
        carry = after


def varying_in_scan(params: Any, given: list[bool]) -> tuple[list[bool], list[bool]]:
    """Which carried values of a scan differ between members, and which of all its outputs differ."""
    constants, carried = sizes_of_scan(params)
    fixed, carry, scanned = given[:constants], given[constants : constants + carried], given[constants + carried :]
    while True:
        after = varying(params["jaxpr"].jaxpr, fixed + carry + scanned)
        joined = [before or new for before, new in zip(carry, after[:carried], strict=True)]
        if joined == carry:
            return carry, carry + after[carried:]
        carry = joined
