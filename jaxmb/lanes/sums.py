"""Rules of sums, products of matrices and other reductions."""

import functools
import math

import jax.numpy as jnp
from jax import lax

from .evaluate import apart, rule

# Sums of more than `_TERMS` terms are called in parts, since LLVM does not vectorise them. XLA's own operations compute
# reductions of more than `_REDUCED` entries, and searches and cumulative sums of more than `_SEARCHED`.
_TERMS, _REDUCED, _SEARCHED = 16, 16, 64
_OPERATIONS = {
    "reduce_sum": lax.add,
    "reduce_prod": lax.mul,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
    "reduce_and": lax.bitwise_and,
    "reduce_or": lax.bitwise_or,
    "cumsum": lax.add,
    "cumprod": lax.mul,
    "cummax": lax.max,
    "cummin": lax.min,
}


def _entries(array, axis, keepdims=False):
    return [lax.index_in_dim(array, k, axis, keepdims=keepdims) for k in range(array.shape[axis])]


@rule("reduce_sum", "reduce_prod", "reduce_max", "reduce_min", "reduce_and", "reduce_or")
def _reduce(lanes, equation, values):
    array, params = values[0].array, equation.params
    for axis in sorted(map(int, params["axes"]), reverse=True):
        if 0 < array.shape[axis] <= _REDUCED:
            array = functools.reduce(_OPERATIONS[equation.primitive.name], _entries(array, axis))
        else:
            along = params | {"axes": (axis,)}
            array = apart(lambda array, along=along: equation.primitive.bind(array, **along))(array)
    return array


@rule("cumsum", "cumprod", "cummax", "cummin")
def _cumulative(lanes, equation, values):
    array, axis, backward = values[0].array, equation.params["axis"], equation.params["reverse"]
    if not 0 < array.shape[axis] <= _SEARCHED:
        return equation.primitive.bind(array, **equation.params)
    operation, entries = _OPERATIONS[equation.primitive.name], _entries(array, axis, keepdims=True)
    out = list(_accumulated(operation, entries[::-1] if backward else entries))
    return lax.concatenate(out[::-1] if backward else out, axis)


def _accumulated(operation, entries):
    total = None
    for entry in entries:
        total = entry if total is None else operation(total, entry)
        yield total


@rule("argmax", "argmin")
def _position(lanes, equation, values):
    array, (axis,), dtype = values[0].array, equation.params["axes"], equation.params["index_dtype"]
    if array.shape[axis] > _SEARCHED:
        return equation.primitive.bind(array, **equation.params)
    first, *others = _entries(array, axis)
    best, place = first, jnp.zeros(first.shape, dtype)
    for k, entry in enumerate(others, 1):
        better = entry > best if equation.primitive.name == "argmax" else entry < best
        if jnp.issubdtype(array.dtype, jnp.floating):
            # The first NaN.
            better = (better | jnp.isnan(entry)) & ~jnp.isnan(best)
        best, place = jnp.where(better, entry, best), jnp.where(better, jnp.asarray(k, dtype), place)
    return place


@rule("dot_general")
def _dot_general(lanes, equation, values):
    (contracted, batched), dtype = equation.params["dimension_numbers"], equation.params["preferred_element_type"]
    arrays = [jnp.asarray(value.array) if dtype is None else jnp.asarray(value.array, dtype) for value in values]
    shapes, axes = [atom.aval.shape for atom in equation.invars], list(zip(contracted, batched, strict=True))
    sides = [_sizes(*side) for side in zip(shapes, axes, strict=True)]
    (batch, k, free_a), (_, _, free_b) = sides
    shape = (*batch, *free_a, *free_b, lanes.size)
    if k == 0:
        return jnp.zeros(shape, arrays[0].dtype)
    last = len(shape) - 1
    axes_a = [*range(len(batch) + len(free_a)), *([last] if values[0].varies else [])]
    axes_b = [*range(len(batch)), *range(len(batch) + len(free_a), last), *([last] if values[1].varies else [])]

    def added(total, *arrays, first, end):
        # Copies of parts would take as long as the sum, so the parts are taken within it.
        a, b = (_ordered(*side) for side in zip(arrays, values, shapes, axes, strict=True))
        for x, y in zip(_entries(a, len(batch))[first:end], _entries(b, len(batch))[first:end], strict=True):
            product = lax.broadcast_in_dim(x, shape, axes_a) * lax.broadcast_in_dim(y, shape, axes_b)
            total = product if total is None else total + product
        return total

    parts, total = -(-k // _TERMS), None
    for part in range(parts):
        add = functools.partial(added, first=part * k // parts, end=(part + 1) * k // parts)
        # Entries of the factors are read many times.
        if k > 1 and math.prod(free_a) * math.prod(free_b) > 1:
            add = apart(add)
        total = add(total, *arrays)
    return total


def _sizes(shape, axes):
    """Of a factor: the sizes of its batched axes, the number of contracted terms, the sizes of its free axes."""
    inner, batch = axes
    free = [n for axis, n in enumerate(shape) if axis not in inner and axis not in batch]
    return [shape[axis] for axis in batch], math.prod(shape[axis] for axis in inner), free


def _ordered(array, value, shape, axes):
    """A factor with batched axes first, then one contracted axis, then free axes."""
    inner, batch = axes
    free = [axis for axis in range(len(shape)) if axis not in inner and axis not in batch]
    array = lax.transpose(array, [*batch, *inner, *free, *([len(shape)] if value.varies else [])])
    sizes, k, rest = _sizes(shape, axes)
    return array.reshape(*sizes, k, *rest, *array.shape[len(shape) :])
