"""Rules of operations that place entries."""

import math

import numpy as np

from .translate import Unsupported, rule


@rule("iota")
def _iota(t, e, values):
    out, axis = e.outvars[0].aval, e.params["dimension"]
    count = np.arange(out.shape[axis], dtype=out.dtype).reshape([-1 if k == axis else 1 for k in range(len(out.shape))])
    return t.constant(np.broadcast_to(count, out.shape).copy())


@rule("platform_index")
def _platform(t, e, values):
    for k, names in enumerate(e.params["platforms"]):
        if names is None or "cpu" in names:
            return t.constant(np.int32(k))
    raise Unsupported("a program without a version for processors")


@rule("broadcast_in_dim")
def _broadcast(t, e, values):
    """Nothing is copied: NumPy broadcasts where the value is used."""
    x, shape = values[0], e.outvars[0].aval.shape
    real = [1] * len(shape)
    for axis, size in zip(e.params["broadcast_dimensions"], (1,) * (len(x.shape) - len(x.real)) + x.real, strict=True):
        real[axis] = size
    while real and real[0] == 1:
        real.pop(0)
    real = tuple(map(int, real))
    if real == x.real:
        return x._replace(shape=shape)
    if real == ():
        return t.put(f"{x.name}[{', '.join('0' for _ in x.real)}]", values, shape, x.dtype, real)
    return t.put(f"{x.name}.reshape({real})", values, shape, x.dtype, real)


@rule("reshape", "squeeze")
def _reshape(t, e, values):
    if e.params.get("dimensions") is not None and e.primitive.name == "reshape":
        raise Unsupported("reshape in another order")
    return t.reshaped(values[0], e.outvars[0].aval.shape)


@rule("transpose")
def _transpose(t, e, values):
    return t.transposed(values[0], e.params["permutation"])


@rule("rev")
def _rev(t, e, values):
    x, axes = values[0], e.params["dimensions"]
    if x.is_scalar:
        return x
    x = t.full(x)
    place = ", ".join("::-1" if k in axes else ":" for k in range(len(x.shape)))
    return t.put(f"{x.name}[{place}]", [x], x.shape, x.dtype)


@rule("slice")
def _slice(t, e, values):
    x, shape, p = values[0], e.outvars[0].aval.shape, e.params
    if x.is_scalar or shape == x.shape:
        return x._replace(shape=shape)
    x = t.full(x)
    steps = p["strides"] or (1,) * len(shape)
    parts = [
        ":" if (first, last, step) == (0, size, 1) else f"{first}:{last}" if step == 1 else f"{first}:{last}:{step}"
        for first, last, step, size in zip(p["start_indices"], p["limit_indices"], steps, x.shape, strict=True)
    ]
    while parts[-1] == ":":
        parts.pop()
    return t.put(f"{x.name}[{', '.join(parts)}]", [x], shape, x.dtype)


@rule("split")
def _split(t, e, values):
    (x,), axis, first, out = values, int(e.params["axis"]), 0, []
    x = x if x.is_scalar else t.full(x)
    for variable, size in zip(e.outvars, e.params["sizes"], strict=True):
        shape, last = variable.aval.shape, first + int(size)
        text = f"{x.name}[{':, ' * axis}{first}:{last}]"
        out.append(x._replace(shape=shape) if x.is_scalar or shape == x.shape else t.put(text, [x], shape, x.dtype))
        first = last
    return out


@rule("unstack")
def _unstack(t, e, values):
    (x,), axis = values, int(e.params["axis"])
    shapes = [variable.aval.shape for variable in e.outvars]
    if x.is_scalar:
        return [x._replace(shape=shape) for shape in shapes]
    x = t.full(x)
    return [t.put(f"{x.name}[{':, ' * axis}{k}]", [x], shape, x.dtype) for k, shape in enumerate(shapes)]


# So many numbers are written one by one.
_FEW = 12


@rule("concatenate")
def _concatenate(t, e, values):
    shape, axis = e.outvars[0].aval.shape, int(e.params["dimension"])
    if math.prod(shape) == 0:
        return t.constant(np.zeros(shape, values[0].dtype))
    values = [x for x in values if math.prod(x.shape)]
    if len(values) == 1:
        return values[0]
    first = values[0]
    if all(x.is_scalar for x in values):
        if len({x.name for x in values}) == 1:
            return first._replace(shape=shape)
        if len(shape) == 1 and shape[0] <= _FEW:
            return _of_numbers(t, [x for x in values for _ in range(x.shape[0])])
    return _joined(t, values, axis, shape)


def _of_numbers(t, numbers):
    first = numbers[0]
    text = f"array([{', '.join(x.name for x in numbers)}], {t.type(first.dtype)})"
    return t.put(text, numbers, (len(numbers),), first.dtype)


def _joined(t, values, axis, shape):
    values = [t.full(x) for x in values]
    place = f", {axis}" if axis else ""
    return t.put(f"concatenate(({', '.join(x.name for x in values)}){place})", values, shape, values[0].dtype)


@rule("stack")
def _stack(t, e, values):
    shape, axis = e.outvars[0].aval.shape, int(e.params["axis"])
    if all(x.is_scalar for x in values) and len(shape) == 1:
        return _of_numbers(t, values)
    each = tuple(1 if k == axis else size for k, size in enumerate(shape))
    values = [t.reshaped(x, each) for x in values]
    return values[0] if len(values) == 1 else _joined(t, values, axis, shape)


@rule("tile")
def _tile(t, e, values):
    x = t.full(values[0])
    return t.put(f"np.tile({x.name}, {tuple(map(int, e.params['reps']))})", [x], e.outvars[0].aval.shape, x.dtype)


@rule("pad")
def _pad(t, e, values):
    """With holes, and with negative sizes, which cut entries off."""
    (x, value), shape = values, e.outvars[0].aval.shape
    x, place, cut = t.full(x), [], []
    for (low, _, inner), size, new in zip(e.params["padding_config"], x.shape, shape, strict=True):
        step = int(inner) + 1
        kept = [k for k in range(size) if 0 <= low + k * step < new]
        start = low + kept[0] * step if kept else 0
        place.append(slice(start, start + (len(kept) - 1) * step + 1 if kept else 0, step))
        cut.append(slice(kept[0], kept[-1] + 1) if kept else slice(0, 0))
    names = t.bind(tuple(place)), t.bind(tuple(cut))
    return t.put(f"padded({x.name}, {value.name}, {shape}, {', '.join(names)})", [x, value], shape, x.dtype)
