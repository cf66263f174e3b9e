"""Rules of conditions and loops."""

import jax.numpy as jnp
from jax import lax

from .._compat import jaxpr_as_function, sizes_of_scan
from .evaluate import Value, rule
from .varying import varying, varying_in_scan, varying_in_while


@rule("cond")
def _cond(lanes, equation, values):
    (which, *operands), branches = values, equation.params["branches"]
    number = which.array.astype(jnp.int32)
    given = [value.varies for value in operands]
    if not which.varies:
        each = [varying(branch.jaxpr, given) for branch in branches]
        varies = [any(outputs) for outputs in zip(*each, strict=True)]

        def taken(branch):
            values_of = lambda arrays: [Value(*pair) for pair in zip(arrays, given, strict=True)]
            return lambda *arrays: lanes.outputs(branch, values_of(arrays), varies)

        out = lax.switch(number, [taken(branch) for branch in branches], *[value.array for value in operands])
        return [Value(*pair) for pair in zip(out, varies, strict=True)]
    every = [True] * len(equation.outvars)
    if lanes.rare and len(branches) == 2 and not branches[0].jaxpr.eqns:
        return _of_some(lanes, branches[1], number == 1, operands, lanes.outputs(branches[0], operands, every))
    first, *others = [lanes.outputs(branch, operands, every) for branch in branches]
    for k, other in enumerate(others, 1):
        first = [jnp.where(number == k, new, old) for new, old in zip(other, first, strict=True)]
    return [Value(x, True) for x in first]


def _of_some(lanes, program, takes, operands, other):
    """The outputs of a program for members that take it, one after the other, and the `other` outputs elsewhere."""

    def of_next(carry):
        left, out = carry
        k = jnp.argmax(left)
        alone = [lax.dynamic_index_in_dim(x, k, -1, keepdims=False) if varies else x for x, varies in operands]
        new = jaxpr_as_function(program)(*alone)
        out = [lax.dynamic_update_index_in_dim(x, y.astype(x.dtype), k, -1) for x, y in zip(out, new, strict=True)]
        return left & (jnp.arange(lanes.size) != k), out

    _, out = lax.while_loop(lambda carry: jnp.any(carry[0]), of_next, (takes, other))
    return [Value(x, True) for x in out]


@rule("while")
def _while(lanes, equation, values):
    params, lanes = equation.params, lanes._replace(rare=False)
    goes_on_varies, varies = varying_in_while(params, [value.varies for value in values])
    of_cond, of_body = params["cond_nconsts"], params["body_nconsts"]
    for_cond, for_body, start = values[:of_cond], values[of_cond : of_cond + of_body], values[of_cond + of_body :]
    carried = lambda arrays: [Value(*pair) for pair in zip(arrays, varies, strict=True)]

    # A `vmap` within a member gives the condition axes, which are the first axes of all carried values.
    axes = range(len(params["cond_jaxpr"].out_avals[0].shape))

    def goes_on(arrays):
        (out,) = lanes.outputs(params["cond_jaxpr"], for_cond + carried(arrays), [goes_on_varies])
        return out

    def where(going, new, old):
        along = [*axes, new.ndim - 1] if goes_on_varies else axes
        return lax.select(lax.broadcast_in_dim(going, new.shape, along), new, old)

    def body(arrays):
        new = lanes.outputs(params["body_jaxpr"], for_body + carried(arrays), varies)
        new = [x.astype(old.dtype) for x, old in zip(new, arrays, strict=True)]
        if not goes_on_varies and not axes:
            return new
        going = goes_on(arrays)
        return [where(going, x, old) for x, old in zip(new, arrays, strict=True)]

    arrays = [_first(lanes, value, spread) for value, spread in zip(start, varies, strict=True)]
    out = lax.while_loop(lambda arrays: jnp.any(goes_on(arrays)), body, arrays)
    return carried(out)


@rule("scan")
def _scan(lanes, equation, values):
    params, lanes = equation.params, lanes._replace(rare=False)
    varies, of_outputs = varying_in_scan(params, [value.varies for value in values])
    constants, carried = sizes_of_scan(params)
    fixed, start = values[:constants], values[constants : constants + carried]
    scanned = values[constants + carried :]

    def step(carry, rows):
        now = [Value(*pair) for pair in zip(carry, varies, strict=True)]
        row = [Value(x, value.varies) for x, value in zip(rows, scanned, strict=True)]
        out = lanes.outputs(params["jaxpr"], fixed + now + row, of_outputs)
        return [x.astype(old.dtype) for x, old in zip(out[:carried], carry, strict=True)], out[carried:]

    arrays = [_first(lanes, value, spread) for value, spread in zip(start, varies, strict=True)]
    how = {name: params[name] for name in ("length", "reverse", "unroll")}
    carry, rows = lax.scan(step, arrays, [value.array for value in scanned], **how)
    return [Value(*pair) for pair in zip([*carry, *rows], of_outputs, strict=True)]


def _first(lanes, value, spread):
    return lanes.spread(value) if spread else jnp.asarray(value.array)
