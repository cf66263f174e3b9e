"""Outputs of a swept function: arrays by name, and how each member ended."""

import inspect
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..._compat import canonical, codes_of, is_enumerated, messages_of
from ..._jaxpr_digest import Digest, digest_of
from ..._traced_functions import traced_by_jax
from ...parts.names import unknown

PENDING, OK, NOT_FINITE = 0, 1, 2
RESERVED = ("member", "status", "message", "num_steps", "result")


class Returned(NamedTuple):
    """Outputs of one member by name; and the code and the steps of its `result`, None without one."""

    values: dict[str, Any]
    result: Any
    steps: Any


class Outputs(NamedTuple):
    """The outputs before anything is computed: shapes and types by name, whether steps are counted, and the name and
    message of each status.
    """

    shapes: dict[str, tuple[tuple[int, ...], np.dtype]]
    steps: bool
    statuses: tuple[tuple[str, str], ...]


def returned(function: Callable[..., Any], parameters: Mapping[str, Any]) -> Returned:
    """Call the function for one member, and sort its outputs."""
    with traced_by_jax("the function of a sweep", "a parameter"):
        given = function(**parameters)
    if not isinstance(given, Mapping):
        raise ValueError(
            f"The function of a sweep must return a dictionary of outputs by name, got {type(given).__name__}."
        )
    given = dict(given)
    result, steps = given.pop("result", None), None
    if result is not None:
        steps = getattr(result, "stats", {}).get("num_steps")
        result = getattr(result, "result", result)
        if not is_enumerated(result):
            raise ValueError(
                f"The output 'result' must be a trajectory or its result, got {type(result).__name__}. Leave it out: "
                "other studies have NaN where they fail."
            )
    values = dict(_flat("", given))
    for name in values:
        if name in RESERVED or name in parameters:
            raise ValueError(f"An output cannot have the name {name!r}, which a sweep or its cases use; rename it.")
    if not values:
        raise ValueError("The function of a sweep returned no outputs.")
    return Returned(values, result, steps)


def _flat(prefix: str, given: Mapping[str, Any]):
    for name, value in given.items():
        if not isinstance(name, str) or "/" in name:
            raise ValueError(f"The name of an output must be a string without '/', got {prefix}{name!r}.")
        if isinstance(value, Mapping):
            yield from _flat(f"{prefix}{name}.", value)
            continue
        array = jnp.asarray(value) if isinstance(value, bool | int | float | complex | np.ndarray) else value
        if not isinstance(array, jax.Array) or np.dtype(getattr(array.dtype, "name", "O")).kind not in "biufc":
            hint = "; give a trajectory itself as 'result'" if hasattr(value, "stats") else ""
            raise ValueError(f"The output {prefix + name!r} must be an array of numbers, got {value!r:.80}{hint}.")
        yield prefix + name, array


def check_parameters(function: Callable[..., Any], names: Any) -> None:
    """Raise a `ValueError` where the cases and the arguments of the function differ."""
    try:
        arguments = inspect.signature(function).parameters
    except (TypeError, ValueError):
        return  # Without a signature, the first call raises the error.
    kinds = inspect.Parameter
    named = {n: a for n, a in arguments.items() if a.kind in (kinds.POSITIONAL_OR_KEYWORD, kinds.KEYWORD_ONLY)}
    if not any(a.kind == kinds.VAR_KEYWORD for a in arguments.values()):
        for name in names:
            if name not in named:
                raise unknown("argument of the function", name, named, "The cases")
    for name, argument in arguments.items():
        needed = argument.default is kinds.empty and argument.kind not in (kinds.VAR_KEYWORD, kinds.VAR_POSITIONAL)
        if needed and name not in names:
            raise ValueError(f"The function needs the parameter {name!r}, of which the cases give no values.")


def declared(function: Callable[..., Any], example: Mapping[str, np.ndarray]) -> tuple[Outputs, Digest]:
    """Trace the function twice with the parameters of one member: its outputs, and the hash of its program.

    **Raises:** `ValueError` for a result that is not a dictionary of arrays, and for a function that is not pure:
    traced again, it has another program.
    """
    abstract = {k: jax.ShapeDtypeStruct(np.shape(v), canonical(v.dtype)) for k, v in example.items()}
    # A new lambda each time, since JAX remembers what it has traced.
    trace = lambda: jax.make_jaxpr(lambda p: returned(function, p), return_shape=True)(abstract)
    (program, found), (again, found_again) = trace(), trace()
    first = outputs_of(found)
    check_same(first, outputs_of(found_again))
    digest = digest_of(program, rules=False)
    if digest.value != digest_of(again, rules=False).value:
        raise ValueError(
            "The function is not pure: traced twice, it has other numbers in it, as from numpy.random or from "
            "something that it changes. Make such numbers parameters of the cases."
        )
    return first, digest


def outputs_of(found: Returned) -> Outputs:
    """The outputs of one member, from the shapes that tracing gives."""
    statuses = [("pending", "Not computed yet."), ("ok", ""), ("not_finite", "An output is not finite.")]
    if found.result is not None:
        statuses += list(messages_of(found.result).items())[1:]
    shapes = {name: (tuple(value.shape), np.dtype(value.dtype)) for name, value in found.values.items()}
    return Outputs(shapes, found.steps is not None, tuple(statuses))


def check_same(first: Outputs, other: Outputs) -> None:
    """Raise a `ValueError` if the function returned other outputs than at first."""
    if first == other:
        return
    names = sorted(set(first.shapes) ^ set(other.shapes))
    differing = names or [name for name in first.shapes if first.shapes[name] != other.shapes[name]] or ["result"]
    raise ValueError(
        "The function is not pure: traced again, it returned other names, shapes or types of "
        f"{', '.join(map(repr, differing))}."
    )


def statuses(found: Returned) -> np.ndarray:
    """The status of each member of a batch, shape (members,)."""
    members = next(iter(found.values.values())).shape[0]
    finite = np.ones(members, bool)
    for value in found.values.values():
        if value.dtype.kind in "fc":
            # Times of events hold infinity after the last event; a result tells of failures.
            sound = np.isfinite(value) if found.result is None else ~np.isnan(value)
            finite &= sound.reshape(members, -1).all(axis=1)
    ended = np.where(finite, OK, NOT_FINITE)
    if found.result is not None:
        names, code = list(messages_of(found.result)), codes_of(found.result)
        # After an event the saved times that are left are infinite, and outputs that depend on them may be anything.
        by_event = code == (names.index("event_occurred") if "event_occurred" in names else -1)
        ended = np.where(code == 0, ended, np.where(by_event, OK, code + NOT_FINITE))
    return ended.astype(np.int16)
