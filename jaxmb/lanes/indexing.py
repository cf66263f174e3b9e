"""Rules of slices, gathers and scatters at indices that may differ between members."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax

from .evaluate import apart, by_vmap, rule

# Rows of tables of at most this many rows are selected; rows of larger tables are gathered.
_SELECTED = 8
_MODE = lax.GatherScatterMode


def _in_range(index, largest):
    return jnp.clip(index, 0, largest)


@rule("dynamic_slice")
def _dynamic_slice(lanes, equation, values):
    (table, *indices), sizes = values, equation.params["slice_sizes"]
    if not any(index.varies for index in indices):
        take = lambda *operands: equation.primitive.bind(*operands, slice_sizes=(*sizes, lanes.size))
        return apart(take)(table.array, *_starts(indices))
    shape = equation.invars[0].aval.shape
    if max(n - k + 1 for n, k in zip(shape, sizes, strict=True)) > _SELECTED:
        if not table.varies or math.prod(sizes) <= 2 * _SELECTED:
            return by_vmap(lanes, equation, values)
        places = [_in_range(index.array, n - k) for index, n, k in zip(indices, shape, sizes, strict=True)]
        return _read(lanes, table.array, sizes, places)
    array = lanes.spread(table)
    for axis, (index, n, k) in enumerate(zip(indices, shape, sizes, strict=True)):
        if n == k:
            continue
        at = _in_range(index.array, n - k)
        if not index.varies:
            array = lax.dynamic_slice_in_dim(array, at, k, axis)
            continue
        out = lax.slice_in_dim(array, 0, k, axis=axis)
        for first in range(1, n - k + 1):
            out = jnp.where(at == first, lax.slice_in_dim(array, first, first + k, axis=axis), out)
        array = out
    return array


def _starts(indices):
    """Start indices that members share, followed by zero for the axis of the members.

    They are those of the operation itself, which brings them into range. `jax.lax` would count negative ones from the
    end of the axis once more.
    """
    start = [jnp.asarray(index.array) for index in indices]
    return [*start, jnp.zeros((), start[0].dtype)]


@rule("dynamic_update_slice")
def _dynamic_update_slice(lanes, equation, values):
    table, part, *indices = values
    if not any(index.varies for index in indices):
        return equation.primitive.bind(lanes.spread(table), lanes.spread(part), *_starts(indices))
    shape, sizes = (atom.aval.shape for atom in equation.invars[:2])
    rows = all(k in (1, n) for n, k in zip(shape, sizes, strict=True))
    if not rows or math.prod(shape) > 64 * _SELECTED:
        places = [_in_range(index.array, n - k) for index, n, k in zip(indices, shape, sizes, strict=True)]
        return _written(lanes, lanes.spread(table), lanes.spread(part), places)
    at = {
        axis: _in_range(index.array, n - 1)
        for axis, (index, n, k) in enumerate(zip(indices, shape, sizes, strict=True))
        if n != k
    }
    return jnp.where(_at(at, (*shape, lanes.size)), lanes.spread(part), lanes.spread(table))


def _read(lanes, table, sizes, places):
    """The part of each member's large table at its place. A loop over members takes half the time of a gather."""

    def read(member, out):
        start = _of_member(places, member)
        new = lax.dynamic_slice(table, [*start, member.astype(start[0].dtype)], (*sizes, 1))
        return lax.dynamic_update_slice_in_dim(out, new, member, -1)

    return lax.fori_loop(0, lanes.size, read, jnp.zeros((*sizes, lanes.size), table.dtype))


def _of_member(places, member):
    """Start indices of a member; indices without an axis are of all members."""
    return [lax.dynamic_index_in_dim(place, member, keepdims=False) if place.ndim else place for place in places]


def _written(lanes, table, part, places):
    """A large table with the part of each member written at its place, if this place is in the table. The loop does
    not copy the table.
    """
    largest = [n - k for n, k in zip(table.shape[:-1], part.shape[:-1], strict=True)]

    def write(member, table):
        start = _of_member(places, member)
        fits = [(place >= 0) & (place <= n) for place, n in zip(start, largest, strict=True)]
        start = [*start, member.astype(start[0].dtype)]
        new = lax.dynamic_slice_in_dim(part, member, 1, -1)
        new = jnp.where(jnp.all(jnp.stack(fits)), new, lax.dynamic_slice(table, start, new.shape))
        return lax.dynamic_update_slice(table, new, start)

    return lax.fori_loop(0, lanes.size, write, table)


def _at(places: dict[int, Any], shape: tuple[int, ...]) -> Any:
    """A mask of the entries at each member's indices along some axes."""
    mask = jnp.ones(shape, bool)
    for axis, place in places.items():
        place = lax.broadcast_in_dim(place, shape, (len(shape) - 1,) * place.ndim)
        mask = mask & (lax.broadcasted_iota(place.dtype, shape, axis) == place)
    return mask


@rule("gather")
def _gather(lanes, equation, values):
    (table, index), params = values, equation.params
    numbers, sizes, mode = params["dimension_numbers"], params["slice_sizes"], params["mode"]
    if not index.varies:
        numbers = numbers._replace(offset_dims=(*numbers.offset_dims, len(equation.outvars[0].aval.shape)))
        given = params | {"dimension_numbers": numbers, "slice_sizes": (*sizes, lanes.size)}
        return equation.primitive.bind(table.array, index.array, **given)
    shape, axes = equation.invars[0].aval.shape, [int(axis) for axis in numbers.start_index_map]
    # Whole rows, or single entries.
    plain = (
        not numbers.operand_batching_dims
        and all(sizes[axis] == (1 if axis in axes else n) for axis, n in enumerate(shape))
        and sorted(map(int, numbers.collapsed_slice_dims)) == sorted(axes)
    )
    if plain and len(axes) == 1 and shape[axes[0]] <= _SELECTED:
        return _selected_rows(lanes, equation, lanes.spread(table), index.array[..., 0, :])
    if plain and mode != _MODE.FILL_OR_DROP and not numbers.offset_dims and axes == list(range(len(shape))):
        places = [index.array[..., axis, :] for axis in axes]
        if mode == _MODE.CLIP:
            places = [_in_range(place, n - 1) for place, n in zip(places, shape, strict=True)]
        return apart(_entries_of_members)(lanes.spread(table), *places)
    return by_vmap(lanes, equation, values)


def _entries_of_members(table, *places):
    """Entries of each member's table at its own places."""

    def of_each():
        member = lax.broadcasted_iota(places[0].dtype, places[0].shape, places[0].ndim - 1)
        return table.at[(*places, member)].get(mode="promise_in_bounds")

    def of_first():
        return table.at[tuple(place[..., 0] for place in places)].get(mode="promise_in_bounds")

    # Members next to each other often have the same places. Then their entries are next to each other as well.
    same = jnp.all(jnp.stack([jnp.all(place == place[..., :1]) for place in places]))
    return lax.cond(same, of_first, of_each)


def _selected_rows(lanes, equation, table, index):
    """Rows of a small table, by selection; `index`: shape (*batch, members)."""
    params, (batch, size) = equation.params, (index.shape[:-1], lanes.size)
    numbers, mode = params["dimension_numbers"], params["mode"]
    (axis,) = map(int, numbers.start_index_map)
    table = jnp.moveaxis(table, axis, 0)
    rest = table.shape[1:-1]
    count, whole = len(batch) + len(rest), (*batch, *rest, size)
    index = lax.broadcast_in_dim(index, whole, (*range(len(batch)), count))
    row = lambda k: lax.broadcast_in_dim(table[k], whole, tuple(range(len(batch), count + 1)))
    place = index if mode == _MODE.FILL_OR_DROP else _in_range(index, len(table) - 1)
    out = row(0)
    for k in range(1, len(table)):
        out = jnp.where(place == k, row(k), out)
    if mode == _MODE.FILL_OR_DROP:
        out = jnp.where((place >= 0) & (place < len(table)), out, _filling(params["fill_value"], out.dtype))
    # The order of axes is that of the gather.
    of_batch, of_rest = iter(range(len(batch))), iter(range(len(batch), count))
    order = [next(of_rest if k in numbers.offset_dims else of_batch) for k in range(count)]
    return lax.transpose(out, (*order, count))


def _filling(given, dtype):
    """JAX's value for entries outside of a table."""
    if given is not None:
        return jnp.asarray(given, dtype)
    if jnp.issubdtype(dtype, jnp.inexact):
        return jnp.asarray(jnp.nan, dtype)
    if jnp.issubdtype(dtype, jnp.bool_):
        return jnp.asarray(True)
    limits = jnp.iinfo(dtype)
    return jnp.asarray(limits.min if jnp.issubdtype(dtype, jnp.signedinteger) else limits.max, dtype)


@rule("scatter", "scatter-add", "scatter_add", "scatter-mul", "scatter_mul", "scatter-min", "scatter-max")
def _scatter(lanes, equation, values):
    (table, index, update), params = values, equation.params
    numbers, name = params["dimension_numbers"], equation.primitive.name
    if not index.varies:
        numbers = numbers._replace(update_window_dims=(*numbers.update_window_dims, len(equation.invars[2].aval.shape)))
        given = params | {"dimension_numbers": numbers}
        return equation.primitive.bind(lanes.spread(table), index.array, lanes.spread(update), **given)
    shape, axes = equation.invars[0].aval.shape, [int(axis) for axis in numbers.scatter_dims_to_operand_dims]
    one_row = (
        name in ("scatter", "scatter-add", "scatter_add")
        and len(equation.invars[1].aval.shape) == 1
        and not numbers.operand_batching_dims
        and sorted(map(int, numbers.inserted_window_dims)) == sorted(axes)
    )
    if not one_row:
        return by_vmap(lanes, equation, values)
    if math.prod(np.array(shape)[axes]) > 4 * _SELECTED:
        if name != "scatter":
            return by_vmap(lanes, equation, values)
        zero = jnp.zeros((), index.array.dtype)
        places = [index.array[axes.index(axis)] if axis in axes else zero for axis in range(len(shape))]
        if params["mode"] == _MODE.CLIP:
            places = [_in_range(place, n - 1) for place, n in zip(places, shape, strict=True)]
        return _written(lanes, lanes.spread(table), jnp.expand_dims(lanes.spread(update), axes), places)
    places = {axis: index.array[k] for k, axis in enumerate(axes)}
    if params["mode"] == _MODE.CLIP:
        places = {axis: _in_range(place, shape[axis] - 1) for axis, place in places.items()}
    old, new, whole = lanes.spread(table), lanes.spread(update), (*shape, lanes.size)
    new = lax.broadcast_in_dim(new, whole, [axis for axis in range(len(whole)) if axis not in axes])
    return jnp.where(_at(places, whole), new if name == "scatter" else old + new, old)
