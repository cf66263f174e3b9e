"""Rules of indices that are only known when the program runs."""

import math
from typing import Any

import numpy as np

from .translate import Translator, Unsupported, Value, rule
from .values import Places


@rule("dynamic_slice")
def _dynamic_slice(t, e, values):
    (x, *starts), shape = values, e.outvars[0].aval.shape
    if x.is_scalar or shape == x.shape:
        return x._replace(shape=shape)
    x, parts, uses = t.full(x), [], []
    for start, size, whole in zip(starts, shape, x.shape, strict=True):
        if size == whole:
            parts.append(":")
            continue
        first = t.put(f"min(max({start.name}, 0), {whole - size})", [start], (), np.dtype(np.int64))
        uses.append(first)
        parts.append(f"{first.name}:{first.name} + {size}")
    while parts[-1] == ":":
        parts.pop()
    return t.put(f"{x.name}[{', '.join(parts)}]", [x, *uses], shape, x.dtype)


@rule("dynamic_update_slice")
def _dynamic_update_slice(t, e, values):
    x, part, *starts = (t.full(x) for x in values)
    if part.shape == x.shape:
        return part
    text = f"updated({x.name}, {part.name}, [{', '.join(start.name for start in starts)}])"
    return t.put(text, [x, part, *starts], x.shape, x.dtype, updates=x.name)


def _places(
    t: Translator,
    shape: tuple[int, ...],
    index: Value,
    window: dict[int, int],
    sizes: list[int],
    numbers: Any,
    clipped: bool,
) -> Value:
    """Places in an array of a `shape` that indices name.

    **Arguments:** `window`: the axes of the result along which the windows lie, by the axes of the array; `sizes` of a
    window along all axes of the array; `numbers`: which axes of the array, and of the indices, belong together.
    """
    indexed, of_array, of_index = numbers
    if np.dtype(index.dtype) == np.uint64:
        raise Unsupported("indices of type uint64")
    strides = [math.prod(shape[k + 1 :]) for k in range(len(shape))]
    rank = len(index.shape) - 1 + len(window)
    free = [k for k in range(rank) if k not in window.values()]
    on_axis = lambda entries, axis: entries.reshape([-1 if k == axis else 1 for k in range(rank)])
    fixed, along = np.zeros((1,) * rank, np.int64), [1] * rank
    for k, axis in window.items():
        fixed = fixed + on_axis(np.arange(sizes[k]) * strides[k], axis)
    for k, axis in zip(of_array, of_index, strict=True):
        fixed = fixed + on_axis(np.arange(shape[k]) * strides[k], free[axis])
    for axis, size in zip(free, index.shape[:-1], strict=True):
        along[axis] = size
    limits = np.array([shape[k] - sizes[k] for k in indexed], np.int64)
    way = Places(np.array([strides[k] for k in indexed], np.int64), limits, tuple(along), fixed, clipped)
    index = t.full(index)
    return t.put(f"{t.bind(way.at)}({index.name})", [index], None, None)


def _is_filled(mode: Any) -> bool:
    if "ONE_HOT" in str(mode):
        raise Unsupported(f"indices with {mode}")
    return "FILL" in str(mode)


@rule("gather")
def _gather(t, e, values):
    (x, index), out, p = values, e.outvars[0].aval, e.params
    numbers, shape = p["dimension_numbers"], out.shape
    filled = _is_filled(p["mode"])
    if math.prod(x.shape) == 0 or math.prod(shape) == 0:
        raise Unsupported("indices into an array without entries")
    if x.is_scalar and not filled:
        return x._replace(shape=shape)
    x, dropped = t.full(x), {*numbers.collapsed_slice_dims, *numbers.operand_batching_dims}
    kept = [k for k in range(len(x.shape)) if k not in dropped]
    window = dict(zip(kept, numbers.offset_dims, strict=True))
    pairs = numbers.start_index_map, numbers.operand_batching_dims, numbers.start_indices_batching_dims
    places = _places(t, x.shape, index, window, [int(n) for n in p["slice_sizes"]], pairs, not filled)
    fill = _fill(out.dtype) if p["fill_value"] is None else np.asarray(p["fill_value"], out.dtype)[()]
    text = f"gathered({x.name}, {places.name}, {t.constant(fill).name})"
    return t.put(text, [x, places], shape, out.dtype)


def _fill(dtype):
    kind = np.dtype(dtype).kind
    if kind in "fb":
        return np.asarray(np.nan if kind == "f" else True, dtype)
    return np.asarray(np.iinfo(dtype).min if kind == "i" else np.iinfo(dtype).max, dtype)


_COMBINED = {"": "None", "add": "np.add", "sub": "np.subtract", "mul": "np.multiply"}
_COMBINED |= {"min": "np.minimum", "max": "np.maximum"}


@rule(*(f"scatter-{name}" if name else "scatter" for name in _COMBINED))
def _scatter(t, e, values):
    (x, index, parts), p = values, e.params
    numbers = p["dimension_numbers"]
    if math.prod(x.shape) == 0 or math.prod(parts.shape) == 0:
        return x
    dropped = {*numbers.inserted_window_dims, *numbers.operand_batching_dims}
    kept = [k for k in range(len(x.shape)) if k not in dropped]
    of_window = numbers.update_window_dims
    # As in XLA, one index after the other: windows last.
    free = [k for k in range(len(parts.shape)) if k not in of_window]
    sizes = [1] * len(x.shape)
    for k, axis in zip(kept, of_window, strict=True):
        sizes[k] = parts.shape[axis]
    window = {k: len(free) + count for count, k in enumerate(kept)}
    pairs = numbers.scatter_dims_to_operand_dims, numbers.operand_batching_dims, numbers.scatter_indices_batching_dims
    clipped = "CLIP" in str(p["mode"])
    places = _places(t, x.shape, index, window, sizes, pairs, clipped and not _is_filled(p["mode"]))
    parts = t.full(t.transposed(t.full(parts), (*free, *of_window)))
    combine = _COMBINED[e.primitive.name.removeprefix("scatter").removeprefix("-")]
    x = t.full(x)
    text = f"scattered({x.name}, {places.name}, {parts.name}, {combine}, {bool(p['unique_indices'])})"
    return t.put(text, [x, places, parts], x.shape, x.dtype, updates=x.name)
