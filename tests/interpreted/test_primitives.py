"""Each operation that NumPy computes gives what the compiler gives, to the bit or to rounding, edge cases included."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxmb.interpreted import interpreted
from jaxmb.interpreted.translate import RULES
from jaxmb.linalg.bilinear import BilinearMap
from jaxmb.linalg.blocks import matrix_products
from jaxmb.linalg.jitted import FOR_FEW_CALLS
from jaxmb.linalg.sums import unchecked_take

MOST_PROGRAMS = 8
RANDOM = np.random.default_rng(0)
NORMAL = RANDOM.standard_normal
NAN, INF = np.nan, np.inf
# Without numbers below 2.2e-308, which are zero to the compiler.
EDGES = np.array(
    [
        0.0,
        -0.0,
        1.0,
        -1.0,
        0.5,
        -0.5,
        1.5,
        2.5,
        -2.5,
        0.49999999999999994,
        3.7,
        -0.001,
        1e300,
        -1e300,
        2000000000.0,
        -3000000000.0,
        2.3e-308,
        2.0**52 + 1,
        9.3e18,
        -9.3e18,
        700.0,
        -750.0,
        INF,
        -INF,
        NAN,
    ]
)
PAIRS = [x.ravel() for x in np.meshgrid(EDGES, EDGES)]
with np.errstate(over="ignore"):
    SINGLE = EDGES.astype(np.float32)
PAIRS_SINGLE = [x.ravel() for x in np.meshgrid(SINGLE, SINGLE)]
LIMIT = np.iinfo(np.int64)
INTEGERS = np.array([0, 1, -1, 2, 3, -7, 10, 2**31, -(2**31) - 5, LIMIT.max, LIMIT.min, LIMIT.min + 1])
OF_TWO = [x.ravel() for x in np.meshgrid(INTEGERS, INTEGERS)]
SHORT = next(x.ravel() for x in np.meshgrid(INTEGERS, INTEGERS)).astype(np.int32), OF_TWO[1].astype(np.int32)
BYTES = RANDOM.integers(0, 256, (2, 40)).astype(np.uint8)
BYTES[:, :4] = [[0, 255, 255, 7], [0, 0, 255, 200]]
TRUTHS = np.array([True, True, False, False]), np.array([True, False, True, False])
MATRIX, TALL, EMPTY = NORMAL((4, 3)), NORMAL((3, 4)), np.zeros((0, 3))
STACK = NORMAL((2, 3, 3))
WITH_NAN = np.array([[1.0, NAN, -0.0], [0.0, 2.0, -INF], [NAN, 2.0, INF], [1.0, -0.0, 0.0]])
TIES = np.array([2, 1, 2, 0, 1, 2, 0])
PLACES = np.array([0, 3, 1, -1, 2, 7, 3, -5, 100])
MODES = {"clip": {"mode": "clip"}, "fill": {"mode": "fill"}, "promised": {"mode": "promise_in_bounds"}}


def of_each(operation, *others):
    """On arrays of each type, and on each number by itself."""
    return [(operation, *x) for x in (PAIRS, PAIRS_SINGLE, *others)]


def unary(operation, *others):
    return [(operation, EDGES), (operation, SINGLE), (operation, 3 * NORMAL(50)), *[(operation, x) for x in others]]


def of_rows(function, *kinds):
    return [(lambda a, axes=axes: function(a, axes), x) for x in kinds for axes in ((0,), (1,), (0, 1))]


def placed(change):
    """Of entries, rows and overlapping windows, in each way to treat places out of bounds."""
    inside = PLACES[:3]
    for mode in ("clip", "drop"):
        yield lambda a, k, b, mode=mode: change(a.at[k], mode)(b), MATRIX, PLACES, NORMAL((9, 3))
        yield lambda a, k, b, mode=mode: change(a.at[:, k], mode)(b), MATRIX, PLACES, NORMAL((4, 9))
        yield lambda a, k, b, mode=mode: change(a.at[k, k], mode)(b), MATRIX, PLACES, NORMAL(9)
        yield lambda a, k, b, mode=mode: change(a.at[k], mode)(b), np.arange(6), PLACES, np.arange(9)
        yield (
            jax.vmap(lambda a, k, b, mode=mode: change(a.at[k], mode)(b)),
            *(STACK, PLACES.reshape(1, 9)[:, :8].reshape(2, 4), NORMAL((2, 4, 3))),
        )
    yield lambda a, k, b: change(a.at[k], "promise_in_bounds")(b), MATRIX, inside, NORMAL((3, 3))
    yield lambda a, b: change(a.at[np.array([0, 2])], None)(b), MATRIX, NORMAL((2, 3))
    yield lambda a, k, b: windows(change, a, k, b), NORMAL(6), np.array([[0], [1], [4], [5], [2]]), NORMAL((5, 3))


def windows(change, a, k, b):
    """Overlapping windows; the last one is partly out of bounds."""
    numbers = lax.ScatterDimensionNumbers((1,), (), (0,))
    kinds = {"set": lax.scatter, "add": lax.scatter_add, "multiply": lax.scatter_mul}
    kinds |= {"min": lax.scatter_min, "max": lax.scatter_max, "subtract": lax.scatter_sub}
    return kinds[change.__name__](a, k, b, numbers)


def changing(name):
    def change(at, mode):
        return functools.partial(getattr(at, name), mode=mode)

    change.__name__ = name
    return list(placed(change))


def gathers():
    for mode in MODES.values():
        inside = PLACES[:3] if mode["mode"] == "promise_in_bounds" else PLACES
        for a in (MATRIX, np.arange(12).reshape(4, 3), np.arange(12, dtype=np.uint8).reshape(4, 3), MATRIX > 0):
            yield lambda a, k, mode=mode: (a.at[k].get(**mode), a.at[k, k].get(**mode)), a, inside
        yield lambda a, k, mode=mode: a.at[:, k].get(**mode), MATRIX, inside
        numbers = lax.GatherDimensionNumbers((), (0, 1), (0, 1))
        for k in inside[:, None] + np.array([0, -1]):
            yield lambda a, k, mode=mode, at=numbers: lax.gather(a, k, at, (1, 1), **mode), MATRIX, np.abs(k) % 4
        yield jax.vmap(lambda a, k, mode=mode: a.at[k].get(**mode)), STACK, np.array([[0, 2], [1, 7]])
    yield lambda a, k: a.at[k].get(mode="fill", fill_value=5.0), MATRIX, PLACES
    yield lambda a: a[np.array([[2, 0]]), 1:], MATRIX
    numbers = lax.GatherDimensionNumbers((1,), (), (0,))
    yield lambda a, k: lax.gather(a, k, numbers, (3,)), NORMAL(6), np.array([[0], [5], [-2], [3]])


def spread(pred, axes):
    return lax.reduce(pred, False, lax.bitwise_xor, axes)


SIGNED_NANS = [x.ravel() for x in np.meshgrid(*[np.append(EDGES, -np.float64(NAN))] * 2)]


def total(name):
    from jax._src.lax import lax as internal

    return lambda a, b: getattr(internal, f"{name}_p").bind(a, b)


def added(a, b):
    from jax.interpreters import ad

    return ad.add_jaxvals_p.bind(a, b)


SMALL = np.array([0.3, -0.7, 0.99, -1.0, 1.0, 0.0, -0.0, NAN, 2.0])
POSITIVE = STACK @ STACK.transpose(0, 2, 1) + 0.1 * np.eye(3)
UPPER = np.triu(NORMAL((2, 3, 3))) + 2 * np.eye(3)
MAP = BilinearMap.of(NORMAL((2, 3, 4)))
CASES = {
    "add": of_each(lax.add, OF_TWO, SHORT, BYTES),
    "add_any": [(added, MATRIX, MATRIX)],
    "sub": of_each(lax.sub, OF_TWO, SHORT, BYTES),
    "mul": of_each(lax.mul, OF_TWO, SHORT, BYTES),
    "div": of_each(lax.div, OF_TWO, SHORT, BYTES),
    "rem": of_each(lax.rem, OF_TWO, SHORT, BYTES),
    "max": of_each(lax.max, OF_TWO, SHORT, BYTES, TRUTHS),
    "min": of_each(lax.min, OF_TWO, SHORT, BYTES, TRUTHS),
    "pow": [*of_each(lax.pow), (lax.pow, PAIRS[0], SHORT[1][:1].repeat(625) + 3)],
    "atan2": of_each(lax.atan2),
    "nextafter": of_each(lax.nextafter),
    **{
        name: of_each(getattr(lax, name), OF_TWO, SHORT, BYTES, TRUTHS) for name in ("lt", "le", "gt", "ge", "eq", "ne")
    },
    "lt_to": [(total("lt_to"), *SIGNED_NANS), (total("lt_to"), *OF_TWO)],
    "le_to": [(total("le_to"), *SIGNED_NANS), (total("le_to"), *PAIRS_SINGLE), (total("le_to"), *OF_TWO)],
    "and": [(lax.bitwise_and, *x) for x in (TRUTHS, OF_TWO, BYTES)],
    "or": [(lax.bitwise_or, *x) for x in (TRUTHS, OF_TWO, BYTES)],
    "xor": [(lax.bitwise_xor, *x) for x in (TRUTHS, OF_TWO, BYTES)],
    "not": [(lax.bitwise_not, x) for x in (TRUTHS[0], INTEGERS, BYTES)],
    "neg": unary(lax.neg, INTEGERS, BYTES),
    "abs": unary(lax.abs, INTEGERS),
    "sign": unary(lax.sign, INTEGERS),
    **{name: unary(getattr(lax, name)) for name in ("floor", "ceil", "is_finite", "exp", "exp2", "expm1", "cbrt")},
    **{name: unary(getattr(lax, name)) for name in ("sqrt", "rsqrt", "log", "log1p", "tanh", "sinh", "cosh", "atan")},
    **{name: unary(getattr(lax, name), SMALL) for name in ("asin", "acos", "asinh", "acosh", "atanh")},
    # At 1e300 the compiler's tangent of single numbers and of vectors differ.
    **{name: [(getattr(lax, name), x) for x in (EDGES, SINGLE, SMALL)] for name in ("sin", "cos", "tan")},
    "logistic": unary(lax.logistic),
    "erf": unary(lax.erf),
    "erfc": [(lax.erfc, x) for x in (SMALL, NORMAL(20))],
    "erf_inv": [(lax.erf_inv, SMALL)],
    "lgamma": [(lax.lgamma, np.abs(EDGES)), (lax.lgamma, 5 * NORMAL(50))],
    "digamma": [(lax.digamma, np.abs(NORMAL(50)) + 0.1)],
    "square": unary(lax.square, INTEGERS),
    "integer_pow": [(lambda x, n=n: lax.integer_pow(x, n), a) for n in (0, 1, 2, 3, 7, -1, -4) for a in (EDGES, SINGLE)]
    + [(lambda x: lax.integer_pow(x, 5), INTEGERS)],
    "round": unary(lax.round) + unary(lambda x: lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN)),
    "clamp": [
        (lax.clamp, PAIRS[0], PAIRS[1], PAIRS[0][::-1]),
        (lambda x: lax.clamp(-1.0, x, 2.0), EDGES),
        (lambda x: lax.clamp(-3, x, 5), INTEGERS),
    ],
    "convert_element_type": [
        (lambda x, kind=kind: lax.convert_element_type(x, kind), a)
        for kind in ("float64", "float32", "int64", "int32", "uint8", "int8", "bool")
        for a in (EDGES, SINGLE, INTEGERS, BYTES, TRUTHS[0])
        if a.dtype != kind
    ],
    "reduce_precision": [(lambda x: lax.reduce_precision(x, 11, 52), EDGES)],
    "select_n": [
        (lambda p, a, b: lax.select(p, a, b), EDGES > 0, EDGES, EDGES[::-1]),
        (lambda p, a, b: lax.select(p, a, b), TRUTHS[0][0], EDGES, EDGES[::-1]),
        (lambda p, a: lax.select(p, a, jnp.zeros_like(a)), TRUTHS[0][2], EDGES),
        (lambda k, a, b: lax.select_n(k, a, b, a + b), TIES.astype(np.int32), NORMAL(7), NORMAL(7)),
    ],
    "copy": [(jnp.copy, EDGES)],
    "stop_gradient": [(lax.stop_gradient, EDGES)],
    "optimization_barrier": [(lambda a, b: lax.optimization_barrier((a, b)), EDGES, INTEGERS)],
    "iota": [(lambda x: x + lax.broadcasted_iota(x.dtype, (2, 3, 4), 1), x) for x in (np.float64(2), np.int32(3))],
    "platform_index": [(lambda x: lax.platform_dependent(x, cpu=lambda x: 2 * x, default=lambda x: x), EDGES)],
    "broadcast_in_dim": [
        (lambda a: lax.broadcast_in_dim(a, (2, 4, 5, 3), (1, 3)), MATRIX),
        (lambda a: lax.broadcast_in_dim(a[:1, :1], (4, 3), (0, 1)), MATRIX),
        (lambda a: jnp.broadcast_to(a[:, :1], (4, 3)) + a + a[:1] + a[0, 0], MATRIX),
        (
            lambda a: (jnp.broadcast_to(a[:, None, :1], (4, 2, 3)).reshape(8, 3), jnp.broadcast_to(a[0, 0], (0, 3))),
            MATRIX,
        ),
    ],
    "reshape": [(lambda a: (a.reshape(2, 6), a.reshape(-1), a[:1, :1].reshape(()), a.T.reshape(12)), MATRIX)],
    "squeeze": [(lambda a: lax.squeeze(a[:1, None], (0, 1)), MATRIX), (lambda a: lax.squeeze(a[0, :1], (0,)), MATRIX)],
    "transpose": [
        (lambda a: (a.T, jnp.broadcast_to(a[0, 0], (2, 3)).T), MATRIX),
        (lambda a: a.transpose(1, 2, 0), STACK),
    ],
    "rev": [(lambda a: (lax.rev(a, (0,)), lax.rev(a, (0, 1))), MATRIX)],
    "slice": [(lambda a: (a[1:3], a[:, 1:], a[::2, ::-1], a[3:3], lax.slice(a, (1, 0), (4, 3), (2, 2))), MATRIX)],
    "split": [(lambda a: lax.split(a, (1, 0, 3), 0), MATRIX), (lambda a: jnp.split(a, 3, 1), MATRIX)],
    "unstack": [(lambda a: (jnp.unstack(a), jnp.unstack(a, axis=1)), MATRIX)],
    "concatenate": [
        (lambda a, b: (jnp.concatenate([a, b[:, :3]]), jnp.concatenate([a.T, b], 1)), MATRIX, TALL),
        (lambda a: (jnp.concatenate([a, a[:0]]), jnp.concatenate([a[:0], a[:0]], 1)), MATRIX),
        (lambda a: (jnp.append(a[0], a[1, 1]), jnp.concatenate([jnp.full(3, a[0, 0]), jnp.full(20, a[0, 1])])), MATRIX),
    ],
    "stack": [
        (lambda a: (jnp.stack([a, a + 1]), jnp.stack([a, a + 1], 1), jnp.stack([a, a + 1], 2), jnp.stack([a])), MATRIX),
        (lambda a: jnp.stack([a[0, 0], a[1, 0], a[0, 1]]), MATRIX),
    ],
    "tile": [(lambda a: (jnp.tile(a, (2, 2)), jnp.tile(a[0], 3)), MATRIX)],
    "pad": [
        (lambda a, way=way: lax.pad(a, a[0, 0], way), MATRIX)
        for way in (
            ((1, 2, 0), (0, 1, 0)),
            ((0, 0, 2), (1, 0, 1)),
            ((-1, 1, 0), (0, -2, 0)),
            ((-2, -1, 1), (2, -1, 2)),
            ((-4, 5, 0), (0, 0, 0)),
        )
    ]
    + [(lambda a: lax.pad(a, 7, ((2, 1, 0), (1, 1, 0))), np.zeros((0, 3), int))],
    "reduce_sum": [
        *of_rows(lambda a, axes: a.sum(axes), MATRIX, EMPTY, WITH_NAN, OF_TWO[0].reshape(12, 12)),
        (lambda a: (a.astype(np.int32).sum(dtype=np.int32), jnp.broadcast_to(a[0], (7,)).sum(), a[:2].sum()), INTEGERS),
    ],
    "reduce_prod": of_rows(lambda a, axes: a.prod(axes), MATRIX, EMPTY, WITH_NAN),
    "reduce_max": of_rows(lambda a, axes: a.max(axes, initial=None if a.size else 0), MATRIX, WITH_NAN)
    + [(lambda a: lax.reduce_max(a, (0,)), x) for x in (EMPTY, np.zeros((0, 2), int), np.zeros((0, 2), np.uint8))],
    "reduce_min": of_rows(lambda a, axes: a.min(axes), MATRIX, WITH_NAN, MATRIX > 0)
    + [(lambda a: lax.reduce_min(a, (0,)), x) for x in (EMPTY, np.zeros((0, 2), int), np.zeros((0, 2), bool))],
    "reduce_and": of_rows(lambda a, axes: jnp.all(a, axes), MATRIX > 0, EMPTY > 0),
    "reduce_or": [
        *of_rows(lambda a, axes: jnp.any(a, axes), MATRIX > 0, EMPTY > 0),
        (lambda a: jnp.any(jnp.broadcast_to(a[0, 0] > 0, (3,))), MATRIX),
    ],
    "reduce_xor": of_rows(spread, MATRIX > 0),
    "argmax": [(lambda a: (jnp.argmax(a), jnp.argmax(a, 0), jnp.argmax(a, 1)), x) for x in (MATRIX, WITH_NAN, BYTES)],
    "argmin": [(lambda a: (jnp.argmin(a), lax.argmin(a, 0, np.int32)), x) for x in (MATRIX, WITH_NAN, BYTES)],
    **{
        f"cum{name}": [
            (lambda a, name=name, way=way: getattr(lax, f"cum{name}")(a, *way), x)
            for way in ((0,), (1, True))
            for x in (MATRIX, WITH_NAN, EMPTY, BYTES)
        ]
        for name in ("sum", "prod", "max", "min")
    },
    "sort": [(lambda a: (jnp.sort(a, 0), jnp.argsort(a, 1)), x) for x in (MATRIX, WITH_NAN, BYTES, EMPTY)]
    + [(lambda a, b: lax.sort((a, b, a), num_keys=2), TIES, np.array([0.0, NAN, -1.0, 2.0, -0.0, -1.0, 1.0]))],
    "dot_general": [
        (lambda a, b: (a @ b, a.T @ a, b @ a, a[:, 0] @ b[:, 1].repeat(2)[:4], a @ a[0], a[0] @ b), MATRIX, TALL),
        (
            lambda a: (jnp.einsum("kij,klj->kil", a, a), jnp.einsum("kij,kji->k", a, a), jnp.tensordot(a, a[0], 1)),
            STACK,
        ),
        (lambda a: (a[:, :0] @ a[:, :0].T, a[:0] @ a.T, jnp.dot(a, 2.0)), MATRIX),
        (lambda a: (a.astype(np.int32) @ a.T.astype(np.int32), jnp.dot(a, a.T)), TIES[:6].reshape(2, 3)),
        (lambda a: lax.dot(a, a.T, preferred_element_type=np.float64), MATRIX.astype(np.float32)),
    ],
    "dynamic_slice": [
        (lambda a, i, j: (lax.dynamic_slice(a, (i, j), (2, 3)), lax.dynamic_slice(a, (i, j), (1, 2))), MATRIX, i, j)
        for i, j in ((np.int32(k), np.int32(n)) for k in (0, 2, 9, -3) for n in (0, 1, -1))
    ],
    "dynamic_update_slice": [
        (lambda a, i, j: (lax.dynamic_update_slice(a, a[:2, :2], (i, j)), a), MATRIX, np.int32(i), np.int32(j))
        for i in (0, 2, 9, -3)
        for j in (0, 1, -1)
    ],
    "gather": list(gathers()),
    "scatter": changing("set"),
    "scatter-add": changing("add"),
    "scatter-sub": changing("subtract"),
    "scatter-mul": changing("multiply"),
    "scatter-min": changing("min"),
    "scatter-max": changing("max"),
    "lu": [(lambda a: lax.linalg.lu(a), x) for x in (STACK, MATRIX, TALL, np.ones((3, 3)), np.zeros((0, 0)))],
    "triangular_solve": [
        (
            lambda a, b, way=way: lax.linalg.triangular_solve(a, b, **way),
            UPPER.transpose(0, 2, 1) if low else UPPER,
            STACK,
        )
        for low in (False, True)
        for way in (
            {"left_side": side, "lower": low, "transpose_a": turn} for side in (False, True) for turn in (False, True)
        )
    ]
    + [(lambda a, b: lax.linalg.triangular_solve(a, b, left_side=True, unit_diagonal=True), UPPER, STACK)],
    "cholesky": [(lax.linalg.cholesky, x) for x in (POSITIVE, -POSITIVE, np.array([[NAN, 0], [0, 1.0]]))],
    "custom_linear_solve": [(jnp.linalg.solve, STACK, NORMAL((2, 3, 1))), (jnp.linalg.inv, STACK)],
    "cond": [
        (lambda k, a: lax.switch(k, [lambda a: a + 1, lambda a: a[::-1], lambda a: jnp.sin(a) + a.sum()], a), n, MATRIX)
        for n in (-1, 0, 1, 2, 5)
    ]
    + [(lambda p, a: lax.cond(p, lambda a: (a, a[0]), lambda a: (2 * a, a[1]), a), x, MATRIX) for x in TRUTHS[0][1:3]],
    "while": [
        (
            lambda n, a: lax.while_loop(lambda c: c[0] < n, lambda c: (c[0] + 1, c[2], c[1] + a), (0, a, 2 * a)),
            n,
            MATRIX,
        )
        for n in (0, 1, 5)
    ]
    + [
        (
            jax.vmap(lambda n, x: lax.while_loop(lambda c: c[0] < n, lambda c: (c[0] + 1, c[1] * x), (0, x))),
            TIES,
            NORMAL(7),
        ),
        (jax.vmap(lambda n: lax.while_loop(lambda c: c < n, lambda c: c + 1, 0)), TIES),
    ],
    "scan": [
        (lambda a, back=back: lax.scan(lambda c, x: (c + x, jnp.outer(c, x)), a[0], a, reverse=back), MATRIX)
        for back in (False, True)
    ]
    + [
        (lambda a: lax.scan(lambda c, x: (c, c.sum()), a, None, length=3), MATRIX),
        (lambda a: lax.scan(lambda c, x: (x, (c, x)), a[0], a[:0]), MATRIX),
        (lambda a: lax.scan(lambda c, x: (c.at[0].set(x), c), a[0], a[:, 0]), MATRIX),
    ],
    "bilinear_map": [(MAP, jnp.asarray(NORMAL(3)), NORMAL(4)), (MAP, jnp.asarray(NORMAL((5, 3))), NORMAL((5, 4)))],
    "block_products": [
        (lambda a, b: matrix_products(jnp.asarray(a), b), STACK, STACK),
        (lambda a, b: matrix_products(a[..., :0], b[..., :0, :]), STACK, STACK),
    ],
    "static_take": [
        (lambda a, k=k: (unchecked_take(a, k), jax.vmap(lambda a: unchecked_take(a, k))(a[None])), MATRIX)
        for k in map(np.array, ([2, 0, 0], [1, 2], [0, 1, 2, 3], [[0, 1], [3, 3]], 2, []))
        for k in (k.astype(np.int32),)
    ],
}
# Functions of the compiler and of NumPy differ in rounding, more so where they overflow or cancel.
ROUGH = {"lgamma": 1e-13, "digamma": 1e-13, "erf_inv": 1e-13, "logistic": 1e-14, "exp2": 1e-13, "pow": 1e-13}
ROUGH |= {"sinh": 1e-13, "cosh": 1e-13, "cbrt": 1e-13}
ROUGH |= {"lu": 1e-12, "triangular_solve": 1e-12, "custom_linear_solve": 1e-12, "cholesky": 1e-12}
# Zeros of either sign are the same to these.
UNSIGNED = {"max", "min", "clamp", "reduce_max", "reduce_min", "cummax", "cummin", "cumsum", "sort", "nextafter"}
# Operations on axes.
OF_AXES = {"sort", "while"}


def primitives(program):
    for equation in program.jaxpr.eqns:
        yield equation.primitive.name
        for inner in jax.tree.leaves(
            [*equation.params.values()], is_leaf=lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr")
        ):
            if hasattr(inner, "jaxpr"):
                yield from primitives(inner)


def compare(name, found, expected, message):
    assert [(x.shape, x.dtype) for x in found] == [(x.shape, x.dtype) for x in expected], message
    for x, y in zip(found, expected, strict=True):
        if x.dtype.kind != "f":
            np.testing.assert_array_equal(x, y, message)
            continue
        exact = 1e-15 if x.dtype == np.float64 else 4e-7
        rtol = max(ROUGH.get(name, 0), 5 * exact)
        np.testing.assert_allclose(x, y, rtol=rtol, atol=1e-307 if name not in ROUGH else 1e-14, err_msg=message)
        if name not in UNSIGNED | ROUGH.keys():
            zero = (x == 0) & (y == 0)
            np.testing.assert_array_equal(np.signbit(x[zero]), np.signbit(y[zero]), message)


def test_primitives_all_have_cases():
    assert RULES.keys() == CASES.keys()


@functools.cache
def compiled_results():
    given = {name: [list(case[1:]) for case in cases] for name, cases in CASES.items()}
    every = lambda given: {
        name: [jax.tree.leaves(case[0](*own)) for case, own in zip(cases, given[name], strict=True)]
        for name, cases in CASES.items()
    }
    return jax.device_get(jax.jit(every, compiler_options=FOR_FEW_CALLS)(given))


@pytest.mark.parametrize("name", CASES)
def test_primitives_give_what_the_compiler_gives(name):
    for k, (case, expected) in enumerate(zip(CASES[name], compiled_results()[name], strict=True)):
        function, *given = case
        program = jax.make_jaxpr(function)(*given)
        assert name in primitives(program), f"{name} {k}: {program}"
        leave = [np.array(x) for x in given]
        message = f"{name} {k}: {interpreted(program).source}"
        compare(name, interpreted(program)(given), expected, message)
        # Nothing is written to an operand.
        for x, before in zip(given, leave, strict=True):
            np.testing.assert_array_equal(x, before, message)
        # Computed beforehand, of constants.
        closed = jax.make_jaxpr(lambda function=function, given=given: function(*map(jnp.asarray, given)))()
        compare(name, interpreted(closed)([]), expected, message)
        if (
            name not in OF_AXES
            and all(np.shape(x) == np.shape(given[0]) for x in [*given, *expected])
            and np.ndim(given[0]) == 1
        ):
            single = interpreted(jax.make_jaxpr(function)(*(x[0] for x in given)))
            one_by_one = [single([x[n] for x in given]) for n in range(len(given[0]))]
            compare(
                name, [np.stack(x) for x in zip(*one_by_one, strict=True)], expected, f"{name} {k}: {single.source}"
            )
