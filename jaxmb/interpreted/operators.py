"""Rules of operations of this package, which are written out term by term for XLA."""

import math

import numpy as np

from .translate import rule


@rule("bilinear_map")
def _bilinear_map(t, e, values):
    """Two products of matrices."""
    (a, b), shape, of = (t.full(x) for x in values), e.outvars[0].aval.shape, e.params["of"]
    columns, j, k = np.ascontiguousarray(of.table.reshape(of.shape[0], -1).T, a.dtype), *of.shape[1:]
    table = t.constant(columns)
    if len(shape) == 1:
        text = f"({a.name}[:, None] * {b.name}).reshape({j * k}).dot({table.name})"
    else:
        text = f"({a.name}[..., None] * {b.name}[..., None, :]).reshape({(*shape[:-1], j * k)}).dot({table.name})"
    return t.put(text, [a, b, table], shape, a.dtype)


@rule("block_products")
def _block_products(t, e, values):
    a, b = (t.full(x) for x in values)
    return t.put(f"{a.name} @ {b.name}", [a, b], e.outvars[0].aval.shape, a.dtype)


@rule("static_take")
def _static_take(t, e, values):
    (x,), shape, index, axis = values, e.outvars[0].aval.shape, e.params["of"].index, int(e.params["lead"])
    if x.is_scalar:
        return x._replace(shape=shape)
    x = t.full(x)
    ahead = ":, " * axis
    if index.ndim == 0:
        return t.put(f"{x.name}[{ahead}{int(index)}]", [x], shape, x.dtype)
    if index.ndim == 1 and index.size and np.array_equal(index, np.arange(index[0], index[0] + index.size)):
        if index.size == x.shape[axis]:
            return x
        return t.put(f"{x.name}[{ahead}{index[0]}:{index[-1] + 1}]", [x], shape, x.dtype)
    if math.prod(shape) == 0:
        return t.constant(np.zeros(shape, x.dtype))
    return t.put(f"{x.name}.take({t.constant(index.astype(np.int64)).name}, {axis})", [x], shape, x.dtype)
