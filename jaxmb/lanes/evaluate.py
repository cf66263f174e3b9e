"""The evaluation of a program of one member for several members."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from .._compat import Literal, bound, is_of_jax, like_of, not_inlined
from .calls import called, entered_in


class Value(NamedTuple):
    """A value of a program.

    **Fields:** the `array`, with members along its last axis where it `varies` between them.
    """

    array: Any
    varies: bool


# `rule(lanes, equation, values)` gives the array of the only output, which varies, or the values of all outputs. At
# least one operand varies.
Rule = Callable[["Lanes", Any, list[Value]], Any]
RULES: dict[str, Rule] = {}
rule = entered_in(RULES)


class Lanes(NamedTuple):
    """How a program is evaluated.

    **Fields:** `size`: the number of members; `rare`: whether, in a condition with a branch that does nothing, members
    that take the other branch are computed one after the other.
    """

    size: int
    rare: bool = False

    def spread(self, value: Value) -> Any:
        """A value as an array with members along its last axis."""
        if value.varies:
            return value.array
        array = jnp.asarray(value.array)
        return lax.broadcast_in_dim(array, (*array.shape, self.size), tuple(range(array.ndim)))

    def outputs(self, program: Any, values: list[Value], varies: list[bool]) -> list[Any]:
        """The arrays of the outputs of a closed program, with members in the outputs marked by `varies`."""
        out = self.run(program, values)
        return [self.spread(x) if spread else x.array for x, spread in zip(out, varies, strict=True)]

    def run(self, program: Any, values: list[Value]) -> list[Value]:
        """The outputs of a closed program."""
        jaxpr = program.jaxpr
        constants = [Value(x, False) for x in program.consts]
        of_variable = dict(zip(jaxpr.constvars, constants, strict=True))
        of_variable |= zip(jaxpr.invars, values, strict=True)
        read = lambda atom: Value(atom.val, False) if isinstance(atom, Literal) else of_variable[atom]
        for equation in jaxpr.eqns:
            out = self.equation(equation, [read(atom) for atom in equation.invars])
            of_variable |= zip(equation.outvars, out, strict=True)
        return [read(atom) for atom in jaxpr.outvars]

    def equation(self, equation: Any, values: list[Value]) -> list[Value]:
        """The outputs of an equation."""
        inner = called(equation)
        if inner is not None:
            # `cond_of_lanes` gives a condition a rule for batches; other programs with such rules are longer.
            ends = [last.primitive.name for last in inner.jaxpr.eqns[-1:]]
            rare = self.rare or (equation.primitive.name == "custom_vmap_call" and ends == ["cond"])
            return self._replace(rare=rare).run(inner, values)
        if not any(value.varies for value in values) and equation.primitive.name not in _LOOPS:
            out = bound(equation, [value.array for value in values])
            return [Value(x, False) for x in (out if equation.primitive.multiple_results else [out])]
        found = RULES.get(equation.primitive.name, by_vmap)(self, equation, values)
        return found if isinstance(found, list) else [Value(found, True)]


# Programs within these may spread what comes in.
_LOOPS = ("while", "scan", "cond")


def by_vmap(lanes, equation, values):
    """An equation without a rule: JAX's own primitive by its rule for batches, any other by its equations."""
    if not is_of_jax(equation.primitive):
        like = [like_of(atom.aval) for atom in equation.invars]
        return lanes.run(jax.make_jaxpr(lambda *x: equation.primitive.impl(*x, **equation.params))(*like), values)
    axes = [-1 if value.varies else None for value in values]
    together = jax.vmap(lambda *arrays: bound(equation, arrays), in_axes=axes, out_axes=-1)
    out = together(*[value.array for value in values])
    return [Value(x, True) for x in (out if equation.primitive.multiple_results else [out])]


def apart(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function as a call that the compiler does not inline, so that operands and results are written to memory."""
    compiled = jax.jit(function)

    @functools.wraps(function)
    def separate(*arrays):
        with not_inlined():
            return compiled(*arrays)

    return separate


def in_lanes(program: Any, size: int, varies: Sequence[bool] | None = None) -> Callable[..., list[Any]]:
    """A closed program of one member, as a function of arrays with `size` members along their last axis. Results have
    members along their last axis as well.

    **Arguments:** `varies`: which arrays have members, default all; the others are the same for all members.
    """

    def of_members(*arrays):
        values = map(Value, arrays, [True] * len(arrays) if varies is None else varies)
        out = Lanes(size).run(program, list(values))
        return [Lanes(size).spread(value) for value in out]

    return of_members
