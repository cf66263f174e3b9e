"""Rules of operations on numbers, entry by entry."""

from typing import Any

import numpy as np

from .translate import Translator, Unsupported, Value, rule

_INFIX = {
    "add": "+",
    "add_any": "+",
    "sub": "-",
    "mul": "*",
    "lt": "<",
    "le": "<=",
    "gt": ">",
    "ge": ">=",
    "eq": "==",
    "ne": "!=",
}
# The function of arrays, for the operations that have the same name or another in NumPy.
_FUNCTIONS = {
    **{name: f"np.{name}" for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "exp2", "log", "sqrt")},
    **{name: f"np.{name}" for name in ("log1p", "expm1", "cbrt", "floor", "ceil", "abs", "nextafter")},
    **{f"a{name}": f"np.arc{name}" for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    "atan2": "np.arctan2",
    "is_finite": "np.isfinite",
    "sign": "sign",
    "logistic": "logistic",
    "erf": "special.erf",
    "erfc": "special.erfc",
    "erf_inv": "special.erfinv",
    "lgamma": "special.gammaln",
    "digamma": "special.digamma",
}
# Of single numbers in double precision.
_OF_ONE = {"sin": "sine", "cos": "cosine", "sqrt": "root", "exp": "power_of_e", "abs": "abs", "is_finite": "isfinite"}
# JAX copies arrays, and holds back derivatives and the compiler, where nothing is computed.
_SAME = ("copy", "stop_gradient", "optimization_barrier")


def scalars(values: list[Value]) -> bool:
    """Whether all values are single numbers in NumPy."""
    return all(value.is_scalar for value in values)


@rule(*_INFIX)
def _infix(t, e, values):
    out, (a, b) = e.outvars[0].aval, values
    return t.elementwise(f"{a.name} {_INFIX[e.primitive.name]} {b.name}", values, out.dtype)


@rule(*_FUNCTIONS)
def _function(t, e, values):
    out, name = e.outvars[0].aval, e.primitive.name
    if e.params.get("accuracy") is not None:
        raise Unsupported(f"{name} with an accuracy")
    single = scalars(values) and values[0].dtype == np.float64
    function = _OF_ONE[name] if single and name in _OF_ONE else _FUNCTIONS[name]
    return t.elementwise(f"{function}({', '.join(x.name for x in values)})", values, out.dtype)


@rule(*_SAME)
def _same(t, e, values):
    return values


@rule("neg")
def _neg(t, e, values):
    return t.elementwise(f"-{values[0].name}", values, values[0].dtype)


@rule("square")
def _square(t, e, values):
    return product(t, values[0], values[0])


@rule("rsqrt")
def _rsqrt(t, e, values):
    (x,) = values
    return t.elementwise(f"{_one(t, x)} / np.sqrt({x.name})", values, x.dtype)


def product(t: Translator, a: Value, b: Value) -> Value:
    """The product of two values of one shape and type."""
    return t.elementwise(f"{a.name} * {b.name}", [a, b], a.dtype)


def _one(t, like):
    return t.constant(np.ones((), like.dtype)).name


@rule("not")
def _not(t, e, values):
    (x,) = values
    word = "not " if x.is_scalar and x.dtype == bool else "~"
    return t.elementwise(f"{word}{x.name}", values, x.dtype)


@rule("and", "or", "xor")
def _logic(t, e, values):
    (a, b), name = values, e.primitive.name
    word = {"and": "&", "or": "|", "xor": "^"}[name]
    if scalars(values) and a.dtype == bool:
        word = {"and": "and", "or": "or", "xor": "is not"}[name]
        if name == "xor":
            return t.elementwise(f"bool({a.name}) is not bool({b.name})", values, a.dtype)
    return t.elementwise(f"{a.name} {word} {b.name}", values, a.dtype)


@rule("div")
def _div(t, e, values):
    a, b = values
    text = f"{a.name} / {b.name}" if np.dtype(a.dtype).kind == "f" else f"divided({a.name}, {b.name})"
    return t.elementwise(text, values, a.dtype)


@rule("rem")
def _rem(t, e, values):
    a, b = values
    function = "np.fmod" if np.dtype(a.dtype).kind == "f" else "remainder"
    return t.elementwise(f"{function}({a.name}, {b.name})", values, a.dtype)


@rule("max", "min")
def _extreme(t, e, values):
    return _larger(t, *values) if e.primitive.name == "max" else _smaller(t, *values)


def _larger(t, a, b):
    function = "larger" if scalars([a, b]) else "np.maximum"
    return t.elementwise(f"{function}({a.name}, {b.name})", [a, b], a.dtype)


def _smaller(t, a, b):
    function = "smaller" if scalars([a, b]) else "np.minimum"
    return t.elementwise(f"{function}({a.name}, {b.name})", [a, b], a.dtype)


@rule("clamp")
def _clamp(t, e, values):
    low, x, high = values
    return _smaller(t, _larger(t, x, low), high)


@rule("integer_pow")
def _integer_pow(t, e, values):
    """By repeated squares, in the order of JAX."""
    (x,), exponent = values, int(e.params["y"])
    if exponent == 0:
        return t.constant(np.ones((), x.dtype))._replace(shape=x.shape)
    out: Any = None
    square, left = x, abs(exponent)
    while left:
        if left & 1:
            out = square if out is None else product(t, out, square)
        left >>= 1
        if left:
            square = product(t, square, square)
    if exponent > 0:
        return out
    return t.elementwise(f"{_one(t, x)} / {out.name}", [out], x.dtype)


@rule("pow")
def _pow(t, e, values):
    """NumPy takes a root for the power of one half, which differs for -0.0 and -inf, unless it stands in an array."""
    x, y = values[0], t.converted(values[1], values[0].dtype)
    if scalars([x, y]):
        return t.elementwise(f"power({x.name}, {y.name})", [x, y], x.dtype)
    return t.elementwise(f"np.power({x.name}, {(y := t.full(y)).name})", [x, y], x.dtype)


@rule("lt_to", "le_to")
def _total_order(t, e, values):
    """By bits: -NaN, numbers with -0.0 before 0.0, NaN."""
    word, real = {"lt_to": "<", "le_to": "<="}[e.primitive.name], np.dtype(values[0].dtype).kind == "f"
    a, b = (f"rank({x.name})" if real else x.name for x in values)
    return t.elementwise(f"{a} {word} {b}", values, np.dtype(bool))


@rule("round")
def _round(t, e, values):
    (x,) = values
    function = "np.rint" if int(e.params["rounding_method"]) == 1 else "rounded_away"
    return t.elementwise(f"{function}({x.name})", values, x.dtype)


@rule("convert_element_type")
def _convert(t, e, values):
    return t.converted(values[0], e.outvars[0].aval.dtype)


@rule("reduce_precision")
def _reduce_precision(t, e, values):
    (x,), found = values, np.finfo(values[0].dtype)
    if (e.params["exponent_bits"], e.params["mantissa_bits"]) != (found.iexp, found.nmant):
        raise Unsupported("reduce_precision")
    return x


@rule("select_n")
def _select(t, e, values):
    which, first, *others = values
    out = first
    for k, other in enumerate(others, 1):
        out = _chosen(t, which if which.dtype == bool else _is(t, which, k), other, out)
    return out


def _is(t: Translator, which: Value, k: int) -> Value:
    return t.elementwise(f"{which.name} == {k}", [which], np.dtype(bool))


def _chosen(t: Translator, truth: Value, new: Value, old: Value) -> Any:
    if new.name == old.name and new.real == old.real:
        return old
    if not truth.is_scalar:
        text = f"where({truth.name}, {new.name}, {old.name})"
        return t.elementwise(text, [truth, new, old], old.dtype)
    if truth.constant is not None:
        return new if truth.constant else old
    if new.real != old.real:
        new, old = t.full(new), t.full(old)
    return t.elementwise(f"{new.name} if {truth.name} else {old.name}", [truth, new, old], old.dtype)
