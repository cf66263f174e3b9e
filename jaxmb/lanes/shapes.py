"""Rules of elementwise operations, and of operations that move elements."""

import jax.numpy as jnp
from jax import lax

from . import elementary
from .evaluate import Value, rule

_ELEMENTWISE = [
    "add",
    "sub",
    "mul",
    "div",
    "rem",
    "max",
    "min",
    "neg",
    "sign",
    "floor",
    "ceil",
    "round",
    "exp",
    "exp2",
    "log",
    "log1p",
    "expm1",
    "sin",
    "cos",
    "tan",
    "asin",
    "acos",
    "atan",
    "atan2",
    "sinh",
    "cosh",
    "tanh",
    "asinh",
    "acosh",
    "atanh",
    "sqrt",
    "rsqrt",
    "cbrt",
    "abs",
    "pow",
    "integer_pow",
    "square",
    "and",
    "or",
    "xor",
    "not",
    "eq",
    "ne",
    "lt",
    "le",
    "gt",
    "ge",
    "select_n",
    "clamp",
    "is_finite",
    "nextafter",
    "convert_element_type",
    "copy",
    "copy_p",
    "stop_gradient",
    "add_any",
    "erf",
    "erfc",
    "erf_inv",
    "lgamma",
    "digamma",
    "shift_left",
    "shift_right_logical",
    "shift_right_arithmetic",
    "logistic",
    "real",
    "imag",
    "conj",
    "complex",
    "reduce_precision",
    "population_count",
    "clz",
    "nondifferentiable",
    "nondifferentiable_backward",
    "nonbatchable",
    "nontraceable",
]
# Functions that have a vectorised form in double precision.
_BY_OPERATIONS = {"sin": elementary.sin, "cos": elementary.cos, "pow": elementary.power}


@rule(*_ELEMENTWISE)
def _elementwise(lanes, equation, values):
    shape, operands = equation.outvars[0].aval.shape, []
    name, params = equation.primitive.name, equation.params
    for k, (atom, value) in enumerate(zip(equation.invars, values, strict=True)):
        # The condition of `select_n` and the bounds of `clamp` may be single numbers.
        single = atom.aval.shape == () and (name == "clamp" or (name == "select_n" and k == 0))
        if single and not value.varies:
            operands.append(jnp.asarray(value.array, atom.aval.dtype))
            continue
        array = lanes.spread(value._replace(array=jnp.asarray(value.array, atom.aval.dtype)))
        if atom.aval.shape != shape:
            axes = range(len(shape) - len(atom.aval.shape), len(shape) + 1)
            array = lax.broadcast_in_dim(array, (*shape, lanes.size), tuple(axes))
        operands.append(array)
    function = _BY_OPERATIONS.get(name)
    if function is not None and all(x.dtype == jnp.float64 for x in operands):
        return function(*operands)
    if "sharding" in params:
        params = params | {"sharding": None}
    return equation.primitive.bind(*operands, **params)


@rule("select_if_vmap")
def _select_if_vmap(lanes, equation, values):
    condition, *cases = values
    if not condition.varies:
        # The second case is for members that have ended; there are none.
        return [cases[0]]
    return jnp.where(condition.array, *map(lanes.spread, cases))


@rule("broadcast_in_dim")
def _broadcast_in_dim(lanes, equation, values):
    shape, axes = equation.params["shape"], equation.params["broadcast_dimensions"]
    return lax.broadcast_in_dim(values[0].array, (*shape, lanes.size), (*axes, len(shape)))


@rule("reshape")
def _reshape(lanes, equation, values):
    return lax.reshape(values[0].array, (*equation.params["new_sizes"], lanes.size))


@rule("transpose")
def _transpose(lanes, equation, values):
    permutation = equation.params["permutation"]
    return lax.transpose(values[0].array, (*permutation, len(permutation)))


@rule("squeeze", "expand_dims", "rev")
def _with_axes(lanes, equation, values):
    return equation.primitive.bind(values[0].array, **equation.params)


@rule("concatenate")
def _concatenate(lanes, equation, values):
    return lax.concatenate([lanes.spread(value) for value in values], equation.params["dimension"])


@rule("stack")
def _stack(lanes, equation, values):
    return jnp.stack([lanes.spread(value) for value in values], equation.params["axis"])


@rule("split")
def _split(lanes, equation, values):
    parts = lax.split(values[0].array, equation.params["sizes"], equation.params["axis"])
    return [Value(part, True) for part in parts]


@rule("unstack")
def _unstack(lanes, equation, values):
    return [Value(part, True) for part in equation.primitive.bind(values[0].array, **equation.params)]


@rule("slice")
def _slice(lanes, equation, values):
    first, last, strides = (equation.params[name] for name in ("start_indices", "limit_indices", "strides"))
    strides = None if strides is None else (*strides, 1)
    return lax.slice(values[0].array, (*first, 0), (*last, lanes.size), strides)


@rule("pad")
def _pad(lanes, equation, values):
    (array, padding), config = values, equation.params["padding_config"]
    whole = (*config, (0, 0, 0))
    if not padding.varies:
        return lax.pad(lanes.spread(array), jnp.asarray(padding.array), whole)
    inside = lax.pad(jnp.ones(equation.invars[0].aval.shape, bool), False, config)
    return jnp.where(
        inside[..., None], lax.pad(lanes.spread(array), jnp.zeros_like(padding.array[0]), whole), padding.array
    )


@rule("unvmap_any")
def _unvmap_any(lanes, equation, values):
    return [Value(jnp.any(values[0].array), False)]


@rule("unvmap_all")
def _unvmap_all(lanes, equation, values):
    return [Value(jnp.all(values[0].array), False)]


@rule("unvmap_max")
def _unvmap_max(lanes, equation, values):
    return [Value(jnp.max(values[0].array), False)]
