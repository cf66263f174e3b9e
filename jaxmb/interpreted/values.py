"""The functions that the source calls, besides those of NumPy. None of them raises, whatever the numbers."""

import math
import sys
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.special

# Single numbers: functions of `math` take a tenth of the time of NumPy's.


def _of_one(quick: Callable[[float], float], name: str) -> Callable[[Any], Any]:
    any_number = getattr(np, name)

    def of_one(x):
        try:
            return np.float64(quick(x))
        except (ValueError, OverflowError):
            return any_number(x)

    return of_one


def power(x: Any, y: Any) -> Any:
    """The power of a number."""
    try:
        return x.dtype.type(math.pow(x, y))
    except (ValueError, OverflowError):
        return np.power(np.full(1, x), np.full(1, y))[0]


def larger(a: Any, b: Any) -> Any:
    """The maximum of two numbers, NaN if either is."""
    return a if a > b or a != a else b


def smaller(a: Any, b: Any) -> Any:
    """The minimum of two numbers, NaN if either is."""
    return a if a < b or a != a else b


# Numbers


def to_integer(x: Any, dtype: Any) -> Any:
    """Rounded towards zero, to the nearest integer of the type; zero for NaN."""
    limits = np.iinfo(dtype)
    x = np.asarray(x)
    # The largest integer may have no float: then the next float is beyond it.
    above, below = x >= np.float64(limits.max), x <= np.float64(limits.min)
    safe = np.where(above | below | (x != x), 0, x).astype(dtype)
    return np.where(above, limits.max, np.where(below, limits.min, safe)).astype(dtype)[()]


def divided(a: Any, b: Any) -> Any:
    """Integers divided, rounded towards zero; all bits are one for a division by zero."""
    dtype = np.result_type(a, b)
    by = np.where(b == 0, np.ones_like(b), b)
    # The remainder has the sign of the first number.
    out = np.floor_divide(a - np.fmod(a, by), by)
    return np.where(b == 0, ~np.zeros((), dtype), out).astype(dtype)[()]


def remainder(a: Any, b: Any) -> Any:
    """The remainder of a division that is rounded towards zero; of a division by zero the number itself."""
    by = np.where(b == 0, np.ones_like(b), b)
    return np.where(b == 0, a, np.fmod(a, by)).astype(np.result_type(a, b))[()]


def rounded_away(x: Any) -> Any:
    """The nearest integer, away from zero if two are as near."""
    whole = np.trunc(x)
    return whole + np.copysign(np.abs(x - whole) >= 0.5, x).astype(whole.dtype)


def sign(x: Any) -> Any:
    """The sign, with the sign of a zero, and NaN for NaN."""
    return np.where((x == 0) | (x != x), x, np.sign(x)).astype(x.dtype)[()]


def rank(x: Any) -> Any:
    """An integer that orders floats by their bits."""
    bits = np.asarray(x).view(np.dtype(f"int{8 * x.itemsize}"))
    return np.where(bits < 0, bits ^ np.iinfo(bits.dtype).max, bits)[()]


def logistic(x: Any) -> Any:
    return 1 / (1 + np.exp(-x))


# Arrays


def full(x: Any, shape: tuple[int, ...], dtype: Any) -> Any:
    """An array of these entries."""
    out = np.empty(shape, dtype)
    out[...] = x
    return out


def padded(x: Any, value: Any, shape: tuple[int, ...], place: Any, cut: Any) -> Any:
    """An array of this value that has the entries `x[cut]` at a place."""
    x = np.asarray(x)
    out = np.full(shape, value, x.dtype)
    out[place] = x[cut]
    return out


def _counted(x: Any) -> int:
    return sys.getrefcount(x)


def _count_of_a_variable() -> int:
    x = np.zeros(1)
    x = _counted(x)
    return x


# The count of references to an array that is only the variable of a caller; a new array has fewer.
_ALONE = _count_of_a_variable()


def _writable(count: int, x: Any) -> Any:
    """The array, or a copy if anything else refers to it."""
    flags = x.flags
    return x if count <= _ALONE and flags.owndata and flags.c_contiguous and flags.writeable else x.copy("C")


def updated(x: Any, part: Any, starts: Sequence[Any]) -> Any:
    """The array with a new part that begins at `starts`, or as near as it fits."""
    x = _writable(sys.getrefcount(x), x)
    sizes = zip(starts, x.shape, part.shape, strict=True)
    first = [min(max(int(start), 0), whole - size) for start, whole, size in sizes]
    x[tuple(slice(start, start + size) for start, size in zip(first, part.shape, strict=True))] = part
    return x


class Places(NamedTuple):
    """How indices become places in an array.

    **Fields:** `strides` and `limits` of the indexed axes; the shape `along` which the indices lie in the result;
    `fixed`: the part of the places that does not depend on the indices; `clipped`: whether indices out of bounds are
    taken as the nearest in bounds, without being marked.
    """

    strides: np.ndarray
    limits: np.ndarray
    along: tuple[int, ...]
    fixed: np.ndarray
    clipped: bool

    def at(self, index: Any) -> tuple[Any, Any]:
        """Places in the flat array, and which are in bounds: None if all are, or it makes no difference."""
        index = np.asarray(index).astype(np.int64, copy=False)
        places = (np.clip(index, 0, self.limits) @ self.strides).reshape(self.along) + self.fixed
        if self.clipped:
            return places, None
        inside = np.all((index >= 0) & (index <= self.limits), -1)
        return places, None if np.all(inside) else np.broadcast_to(inside.reshape(self.along), places.shape)


def gathered(x: Any, places: tuple[Any, Any], fill: Any) -> Any:
    """The entries at places, `fill` where they are out of bounds."""
    found = x.reshape(-1)[places[0]]
    return found if places[1] is None else np.where(places[1], found, fill).astype(x.dtype)[()]


def scattered(x: Any, places: tuple[Any, Any], parts: Any, combine: Any, unique: bool) -> Any:
    """The array with entries changed at places in bounds, one after the other."""
    x, (places, inside) = _writable(sys.getrefcount(x), x), places
    if inside is not None:
        places, parts = places[inside], parts[inside]
    flat = x.reshape(-1)
    if combine is None:
        flat[places] = parts
    elif unique:
        flat[places] = combine(flat[places], parts)
    else:
        combine.at(flat, places, parts)
    return x


def ordered(arrays: tuple[Any, ...], axis: int, keys: int) -> tuple[Any, ...]:
    """Arrays in the order of the first ones, `keys` in number; NaN comes last."""
    if keys == 1:
        order = np.argsort(arrays[0], axis, kind="stable")
    else:
        order = np.lexsort(arrays[keys - 1 :: -1], axis)
    return tuple(np.take_along_axis(x, order, axis) for x in arrays)


def accumulated(x: Any, function: Any, axis: int, backward: bool) -> Any:
    """Partial sums, products or extremes along an axis."""
    if backward:
        return np.flip(function.accumulate(np.flip(x, axis), axis, x.dtype), axis)
    return function.accumulate(x, axis, x.dtype)


# Matrices


def factored(a: Any) -> tuple[Any, Any, Any]:
    """The factors L and U of matrices, which rows were swapped, and the order of rows."""
    *stack, m, n = a.shape
    both, swaps = np.empty_like(a), np.zeros((*stack, min(m, n)), np.int32)
    order = np.broadcast_to(np.arange(m, dtype=np.int32), (*stack, m)).copy()
    (factor,) = scipy.linalg.get_lapack_funcs(("getrf",), (a,))
    for at in np.ndindex(*stack):
        if both[at].size:
            both[at], swaps[at], _ = factor(a[at])
        for k, other in enumerate(swaps[at]):
            order[at][[k, other]] = order[at][[other, k]]
    return both, swaps, order


def solved(a: Any, b: Any, left: bool, lower: bool, transpose: bool, unit: bool) -> Any:
    """The solutions of triangular systems, `a x = b` or from the other side."""
    (solve,) = scipy.linalg.get_blas_funcs(("trsm",), (a, b))
    out = np.empty_like(b)
    for at in np.ndindex(*a.shape[:-2]):
        if out[at].size:
            out[at] = solve(1.0, a[at], b[at], side=not left, lower=lower, trans_a=transpose, diag=unit)
    return out


def rooted(a: Any) -> Any:
    """The factors L of positive definite matrices, NaN for others."""
    out = np.empty_like(a)
    (factor,) = scipy.linalg.get_lapack_funcs(("potrf",), (a,))
    for at in np.ndindex(*a.shape[:-2]):
        if out[at].size:
            found, info = factor(a[at], lower=True, clean=True)
            out[at] = found if info == 0 else np.nan
    return out


GLOBALS: dict[str, Any] = {
    "np": np,
    "special": scipy.special,
    "where": np.where,
    "array": np.array,
    "concatenate": np.concatenate,
    "isfinite": math.isfinite,
    "sine": _of_one(math.sin, "sin"),
    "cosine": _of_one(math.cos, "cos"),
    "root": _of_one(math.sqrt, "sqrt"),
    "power_of_e": _of_one(math.exp, "exp"),
}
_OWN: list[Callable[..., Any]] = [
    *(power, larger, smaller, to_integer, divided, remainder, rounded_away, sign, rank, logistic, full, padded),
    *(updated, gathered, scattered, ordered, accumulated, factored, solved, rooted),
]
GLOBALS |= {function.__name__: function for function in _OWN}
