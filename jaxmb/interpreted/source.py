"""Programs as Python functions."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from .._compat import place_of
from .lines import Used, written
from .translate import Translator, Unsupported


class Interpreted(NamedTuple):
    """A program of JAX as a function of arrays, in the order of its operands, that returns the arrays of its results.

    **Fields:** the `function` of NumPy, the types of what it has `taken` and `given`, and its source, by `text`.
    """

    function: Callable[..., tuple[Any, ...]]
    taken: list[Any]
    given: list[Any]
    text: Callable[[Callable[[Any], str]], str]

    def __call__(self, arrays: Sequence[Any]) -> list[np.ndarray]:
        host = [np.asarray(x, kind.dtype) for x, kind in zip(arrays, self.taken, strict=True)]
        with np.errstate(all="ignore"):
            out = self.function(*(x if x.ndim else x[()] for x in host))
        return [np.asarray(x, kind.dtype) for x, kind in zip(out, self.given, strict=True)]

    @property
    def source(self) -> str:
        """The source, with the line of the package beside each value."""
        return self.text(place_of)


def interpreted(program: Any) -> Interpreted:
    """A closed program as Python source that calls NumPy.

    **Raises:** `Unsupported` for a program with operations that only the compiler knows.
    """
    t = Translator()
    given = [t.variable(aval, 0) for aval in program.in_avals]
    out = [t.full(x).name for x in t.program(program, given)]
    lines, live = Used(t.block.lines), set(out)
    kept = lines.of(t.block.lines, live, set())
    head, end = f"def program({', '.join(x.name for x in given)}):", f" return ({', '.join(out)}{',' if out else ''})"

    def text(said):
        return "\n".join([head, *written(kept, said), end, ""])

    try:
        exec(compile(text(lambda about: ""), "<interpreted>", "exec"), t.globals)
    except (SyntaxError, RecursionError) as error:
        # Python limits how deep blocks stand in each other.
        raise Unsupported(f"a program that Python does not compile, {error}") from error
    return Interpreted(t.globals["program"], list(program.in_avals), list(program.out_avals), text)
