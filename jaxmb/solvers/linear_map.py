"""Linear maps whose values and transposes are computed by given programs, such as loops.

JAX transposes a linear function by transposing each of its operations, but cannot transpose a loop of unknown length. A
`linear_map` is one operation that comes with its transpose: forward mode evaluates the map, reverse mode the transpose,
and batches of either are the batched programs.
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
    """A map and its transpose on lists of arrays.

    **Fields:** `forward(residuals, x, used)`, whose values may be anything where they are not `used`;
    `backward(residuals, cotangents)`, where None stands for a zero cotangent; `again`: both in a form with correct
    derivatives by the residuals; the shapes of `inputs` and `outputs`.
    """

    def __init__(self, forward: Callable, backward: Callable, again: tuple[Callable, Callable], inputs, outputs):
        self.forward, self.backward, self.again = forward, backward, again
        self.inputs, self.outputs = tuple(inputs), tuple(outputs)

    def program_of(self, operands: Sequence[jax.ShapeDtypeStruct]) -> Any:
        """The traced map for operands (residuals and x) of these shapes; it distinguishes the map from others."""
        count = len(operands) - len(self.inputs)
        return jax.make_jaxpr(lambda *arrays: _evaluate(*arrays, programs=self, split=count))(*operands)

    def transposed(self, nonzero: tuple[bool, ...]) -> "_Programs":
        """The transpose, for cotangents of which only the `nonzero` ones are given."""

        def every(cotangents):
            given = iter(cotangents)
            return [next(given) if here else None for here in nonzero]

        def turned(forward, backward):
            def from_cotangents(residuals, cotangents, _):
                return backward(residuals, every(cotangents))

            def of_these(residuals, x):
                values = forward(residuals, filled(list(self.inputs), x), nonzero)
                return [value for value, here in zip(values, nonzero, strict=True) if here]

            return from_cotangents, of_these

        outputs = [a for a, here in zip(self.outputs, nonzero, strict=True) if here]
        return _Programs(*turned(self.forward, self.backward), turned(*self.again), outputs, self.inputs)

    def only(self, used: Sequence[bool]) -> "_Programs":
        """The maps to the `used` values only."""

        def narrowed(forward, backward):
            def to_these(residuals, x, among):
                among = iter(among)
                values = forward(residuals, x, [here and next(among) for here in used])
                return [value for value, here in zip(values, used, strict=True) if here]

            def from_these(residuals, cotangents):
                given = iter(cotangents)
                return backward(residuals, [next(given) if here else None for here in used])

            return to_these, from_these

        outputs = [a for a, here in zip(self.outputs, used, strict=True) if here]
        return _Programs(*narrowed(self.forward, self.backward), narrowed(*self.again), self.inputs, outputs)

    def batched(self, size: int, axes: Sequence[int | None]) -> "_Programs":
        """The maps of a batch, whose residuals have these `axes`."""
        backward_of = lambda backward: jax.vmap(backward, in_axes=(list(axes), 0))

        def forward_of(forward):
            return lambda r, x, used: jax.vmap(lambda r, x: forward(r, x, used), in_axes=(list(axes), 0))(r, x)

        shapes = lambda avals: [ShapedArray((size, *a.shape), a.dtype) for a in avals]
        again = forward_of(self.again[0]), backward_of(self.again[1])
        return _Programs(
            forward_of(self.forward), backward_of(self.backward), again, shapes(self.inputs), shapes(self.outputs)
        )


def linear_map(
    forward: Callable, backward: Callable, again: tuple[Callable, Callable], residuals: PyTree, x: PyTree, like: PyTree
) -> PyTree:
    """`forward(residuals, x, used)`, linear in x.

    **Arguments:**

    - `forward(residuals, x, used)`: the map; `used`: which of its values matter.
    - `backward(residuals, cotangents)`: its transpose; None stands for a zero cotangent.
    - `again`: both in a form that may be differentiated by the residuals.
    - `residuals`: the other data of the map, a pytree.
    - `x`: a pytree of floating-point arrays.
    - `like`: a pytree of arrays or shapes with the structure of the value.

    Derivatives by the residuals exist in forward mode only; reverse mode raises a `TypeError`.
    """
    arrays, static = eqx.partition(residuals, eqx.is_array)
    residual_leaves, structure = jax.tree.flatten(arrays)
    inputs, of_inputs = jax.tree.flatten(x)
    outputs, of_outputs = jax.tree.flatten(like)
    with_static = lambda leaves: eqx.combine(jax.tree.unflatten(structure, leaves), static)

    def map_of(function):
        given = lambda x, used: (jax.tree.unflatten(of_inputs, x), jax.tree.unflatten(of_outputs, used))
        return lambda r, x, used: jax.tree.leaves(function(with_static(r), *given(x, used)))

    def transpose_of(function):
        def transpose(r, cotangents):
            return jax.tree.leaves(filled(x, function(with_static(r), jax.tree.unflatten(of_outputs, cotangents))))

        return transpose

    shapes = lambda leaves: [ShapedArray(a.shape, a.dtype) for a in leaves]
    both = map_of(again[0]), transpose_of(again[1])
    programs = _Programs(map_of(forward), transpose_of(backward), both, shapes(inputs), shapes(outputs))
    values = _linear_map.bind(*residual_leaves, *inputs, programs=programs, split=len(residual_leaves))
    return jax.tree.unflatten(of_outputs, values)


def filled(x: PyTree, tangent: PyTree) -> PyTree:
    """A tangent of x, with zeros where it has None and x has an array."""
    fill = lambda x, t: jnp.zeros(x.shape, x.dtype) if t is None and x is not None else t
    return jax.tree.map(fill, x, tangent, is_leaf=lambda x: x is None)


def _evaluate(*operands: Array, programs: _Programs, split: int) -> list[Array]:
    return programs.forward(list(operands[:split]), list(operands[split:]), [True] * len(programs.outputs))


def _push(primals, tangents, *, programs: _Programs, split: int):
    out = _linear_map.bind(*primals, programs=programs, split=split)
    pushed = [jnp.zeros(a.shape, a.dtype) for a in programs.outputs]
    if any(type(t) is not Zero for t in tangents[split:]):
        x = [ad.instantiate_zeros(t) for t in tangents[split:]]
        pushed = _linear_map.bind(*primals[:split], *x, programs=programs, split=split)
    moving = [k for k in range(split) if type(tangents[k]) is not Zero]
    if moving:

        def moved(*values):
            residuals = list(primals[:split])
            for k, value in zip(moving, values, strict=True):
                residuals[k] = value
            return programs.again[0](residuals, list(primals[split:]), [True] * len(programs.outputs))

        along = tuple(tangents[k] for k in moving)
        _, by_residuals = jax.jvp(moved, tuple(primals[k] for k in moving), along)
        pushed = [_forward_only.bind(a + b) for a, b in zip(pushed, by_residuals, strict=True)]
    return out, pushed


def _transpose(cotangents, *operands, programs: _Programs, split: int):
    nonzero = tuple(type(c) is not Zero for c in cotangents)
    given = [c for c, here in zip(cotangents, nonzero, strict=True) if here]
    pulled = _linear_map.bind(*operands[:split], *given, programs=programs.transposed(nonzero), split=split)
    return [None] * split + list(pulled)


def _batch(operands, axes, *, programs: _Programs, split: int):
    size = next(x.shape[axis] for x, axis in zip(operands, axes, strict=True) if axis is not None)
    front = [
        jnp.broadcast_to(x[None], (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(operands[split:], axes[split:], strict=True)
    ]
    batched = programs.batched(size, axes[:split])
    out = _linear_map.bind(*operands[:split], *front, programs=batched, split=split)
    return out, [0] * len(out)


def _without_unused(used, equation):
    """The operation without unused values, and which of its operands it needs."""
    operands = len(equation.invars)
    if not any(used):
        return [False] * operands, None
    outputs = [value for value, here in zip(equation.outvars, used, strict=True) if here]
    params = equation.params | {"programs": equation.params["programs"].only(used)}
    return [True] * operands, equation.replace(outvars=outputs, params=params)


def _not_in_reverse(cotangent, x):
    raise TypeError(_SECOND_REVERSE)


# An identity with a derivative in forward mode only.
_forward_only = Primitive("forward_only")
_forward_only.def_impl(lambda x: x)
_forward_only.def_abstract_eval(lambda x: x)
mlir.register_lowering(_forward_only, lambda ctx, x: [x])
ad.deflinear2(_forward_only, _not_in_reverse)
batching.defvectorized(_forward_only)

_linear_map = Primitive("linear_map")
_linear_map.multiple_results = True
_linear_map.def_impl(lambda *operands, **static: jax.jit(lambda *x: _evaluate(*x, **static))(*operands))
_linear_map.def_abstract_eval(lambda *operands, programs, split: list(programs.outputs))
mlir.register_lowering(_linear_map, mlir.lower_fun(_evaluate, multiple_results=True))
ad.primitive_jvps[_linear_map] = _push
ad.primitive_transposes[_linear_map] = _transpose
batching.primitive_batchers[_linear_map] = _batch
let_go(_linear_map, _without_unused)
