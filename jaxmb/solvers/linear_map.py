"""Linear maps whose values and transposes are computed by programs of one's own, such as loops.

JAX transposes a linear function by transposing each of its operations, which a loop of unknown length does not allow.
A `linear_map` is one operation that comes with its transpose: forward mode evaluates the map, reverse mode the
transpose, and batches of either are the batched programs.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from .._compat import Primitive, ShapedArray, Zero, ad, batching, let_go, mlir

_SECOND_REVERSE = (
    "A derivative of a motion is differentiated in forward mode only: take jax.hessian, or jax.jacfwd of jax.grad, "
    "instead of jax.jacrev of a derivative."
)


class _Programs:
    """A map and its transpose on lists of arrays: `there(residuals, x, used)`, where values that are not `used` may be
    anything, and `back(residuals, cotangents)`, where a cotangent may be None for zeros; `again`, both in a form whose
    derivatives by residuals are right; and the shapes of x and of the value.
    """

    def __init__(self, there: Callable, back: Callable, again: tuple[Callable, Callable], inputs, outputs):
        self.there, self.back, self.again = there, back, again
        self.inputs, self.outputs = tuple(inputs), tuple(outputs)

    def program_of(self, operands: Sequence[jax.ShapeDtypeStruct]) -> Any:
        """The traced map for operands of these shapes, residuals and x, which tells it from others."""
        count = len(operands) - len(self.inputs)
        return jax.make_jaxpr(lambda *own: _evaluate(*own, programs=self, known=count))(*operands)

    def transposed(self, known: tuple[bool, ...]) -> "_Programs":
        """The transpose, of the `known` ones of the cotangents."""

        def every(cotangents):
            left = iter(cotangents)
            return [next(left) if here else None for here in known]

        def turned(there, back):
            def from_cotangents(residuals, cotangents, _):
                return back(residuals, every(cotangents))

            def of_these(residuals, x):
                values = there(residuals, filled(list(self.inputs), x), known)
                return [value for value, here in zip(values, known, strict=True) if here]

            return from_cotangents, of_these

        outputs = [a for a, here in zip(self.outputs, known, strict=True) if here]
        return _Programs(*turned(self.there, self.back), turned(*self.again), outputs, self.inputs)

    def only(self, used: Sequence[bool]) -> "_Programs":
        """The maps to those of the values that are used."""

        def narrowed(there, back):
            def to_these(residuals, x, among):
                among = iter(among)
                values = there(residuals, x, [here and next(among) for here in used])
                return [value for value, here in zip(values, used, strict=True) if here]

            def from_these(residuals, cotangents):
                left = iter(cotangents)
                return back(residuals, [next(left) if here else None for here in used])

            return to_these, from_these

        outputs = [a for a, here in zip(self.outputs, used, strict=True) if here]
        return _Programs(*narrowed(self.there, self.back), narrowed(*self.again), self.inputs, outputs)

    def batched(self, size: int, axes: Sequence[int | None]) -> "_Programs":
        """The maps of a batch, whose residuals have these `axes`."""
        back_of = lambda back: jax.vmap(back, in_axes=(list(axes), 0))

        def there_of(there):
            return lambda r, x, used: jax.vmap(lambda r, x: there(r, x, used), in_axes=(list(axes), 0))(r, x)

        shapes = lambda avals: [ShapedArray((size, *a.shape), a.dtype) for a in avals]
        again = there_of(self.again[0]), back_of(self.again[1])
        return _Programs(there_of(self.there), back_of(self.back), again, shapes(self.inputs), shapes(self.outputs))


def linear_map(
    there: Callable, back: Callable, again: tuple[Callable, Callable], residuals: PyTree, x: PyTree, like: PyTree
) -> PyTree:
    """`there(residuals, x, used)`, linear in x.

    **Arguments:**

    - `there(residuals, x, used)`: the map; `used`: of each of its values, whether it matters what it is.
    - `back(residuals, cotangents)`: its transpose; a cotangent that is None stands for zeros.
    - `again`: both in a form that may be differentiated by the residuals.
    - `residuals`: what the map depends on otherwise, a pytree.
    - `x`: a pytree of floating-point arrays.
    - `like`: a pytree of arrays or shapes, those of the value.

    Derivatives by the residuals exist in forward mode only; a `TypeError` says it otherwise.
    """
    arrays, static = eqx.partition(residuals, eqx.is_array)
    known, structure = jax.tree.flatten(arrays)
    inputs, of_inputs = jax.tree.flatten(x)
    outputs, of_outputs = jax.tree.flatten(like)
    held = lambda leaves: eqx.combine(jax.tree.unflatten(structure, leaves), static)

    def map_of(function):
        given = lambda x, used: (jax.tree.unflatten(of_inputs, x), jax.tree.unflatten(of_outputs, used))
        return lambda r, x, used: jax.tree.leaves(function(held(r), *given(x, used)))

    def transpose_of(function):
        def transpose(r, cotangents):
            return jax.tree.leaves(filled(x, function(held(r), jax.tree.unflatten(of_outputs, cotangents))))

        return transpose

    shapes = lambda leaves: [ShapedArray(a.shape, a.dtype) for a in leaves]
    both = map_of(again[0]), transpose_of(again[1])
    programs = _Programs(map_of(there), transpose_of(back), both, shapes(inputs), shapes(outputs))
    values = _linear_map.bind(*known, *inputs, programs=programs, known=len(known))
    return jax.tree.unflatten(of_outputs, values)


def filled(x: PyTree, tangent: PyTree) -> PyTree:
    """A tangent of x, with zeros where it has None and x has an array."""
    fill = lambda x, t: jnp.zeros(x.shape, x.dtype) if t is None and x is not None else t
    return jax.tree.map(fill, x, tangent, is_leaf=lambda x: x is None)


def _evaluate(*operands: Array, programs: _Programs, known: int) -> list[Array]:
    return programs.there(list(operands[:known]), list(operands[known:]), [True] * len(programs.outputs))


def _push(primals, tangents, *, programs: _Programs, known: int):
    out = _linear_map.bind(*primals, programs=programs, known=known)
    pushed = [jnp.zeros(a.shape, a.dtype) for a in programs.outputs]
    if any(type(t) is not Zero for t in tangents[known:]):
        x = [ad.instantiate_zeros(t) for t in tangents[known:]]
        pushed = _linear_map.bind(*primals[:known], *x, programs=programs, known=known)
    moving = [k for k in range(known) if type(tangents[k]) is not Zero]
    if moving:

        def moved(*values):
            residuals = list(primals[:known])
            for k, value in zip(moving, values, strict=True):
                residuals[k] = value
            return programs.again[0](residuals, list(primals[known:]), [True] * len(programs.outputs))

        along = tuple(tangents[k] for k in moving)
        _, more = jax.jvp(moved, tuple(primals[k] for k in moving), along)
        pushed = [_forward_only.bind(a + b) for a, b in zip(pushed, more, strict=True)]
    return out, pushed


def _transpose(cotangents, *operands, programs: _Programs, known: int):
    there = tuple(type(c) is not Zero for c in cotangents)
    given = [c for c, here in zip(cotangents, there, strict=True) if here]
    pulled = _linear_map.bind(*operands[:known], *given, programs=programs.transposed(there), known=known)
    return [None] * known + list(pulled)


def _batch(operands, axes, *, programs: _Programs, known: int):
    size = next(x.shape[axis] for x, axis in zip(operands, axes, strict=True) if axis is not None)
    front = [
        jnp.broadcast_to(x[None], (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(operands[known:], axes[known:], strict=True)
    ]
    batched = programs.batched(size, axes[:known])
    out = _linear_map.bind(*operands[:known], *front, programs=batched, known=known)
    return out, [0] * len(out)


def _without_unused(used, equation):
    """The operation without the values that nothing uses, and which of its operands it needs."""
    operands = len(equation.invars)
    if not any(used):
        return [False] * operands, None
    left = [value for value, here in zip(equation.outvars, used, strict=True) if here]
    params = equation.params | {"programs": equation.params["programs"].only(used)}
    return [True] * operands, equation.replace(outvars=left, params=params)


def _not_in_reverse(cotangent, x):
    raise TypeError(_SECOND_REVERSE)


# An identity that is differentiated in forward mode only.
_forward_only = Primitive("forward_only")
_forward_only.def_impl(lambda x: x)
_forward_only.def_abstract_eval(lambda x: x)
mlir.register_lowering(_forward_only, lambda ctx, x: [x])
ad.deflinear2(_forward_only, _not_in_reverse)
batching.defvectorized(_forward_only)

_linear_map = Primitive("linear_map")
_linear_map.multiple_results = True
_linear_map.def_impl(lambda *operands, **static: jax.jit(lambda *x: _evaluate(*x, **static))(*operands))
_linear_map.def_abstract_eval(lambda *operands, programs, known: list(programs.outputs))
mlir.register_lowering(_linear_map, mlir.lower_fun(_evaluate, multiple_results=True))
ad.primitive_jvps[_linear_map] = _push
ad.primitive_transposes[_linear_map] = _transpose
batching.primitive_batchers[_linear_map] = _batch
let_go(_linear_map, _without_unused)
