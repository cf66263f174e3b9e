"""Error control of tangents beside the state.

Steps that follow a motion may lie far outside the stability region of a mode that is not excited. The motion does not
show this mode, but the motion's derivatives grow from step to step without bound. A differentiated solve therefore
carries a tangent w of the state along, `w' = J(t, y) w`, and keeps its local error small as well. The start of w
excites every mode.

Nor does a motion show a force of strength zero. But the motion's derivative by this strength is a function of time that
steps must resolve. With derivatives by parameters, the solve also carries a tangent that parameters cause,
`d' = J d + f_p`.

Tangents that are carried along have no derivatives. They differentiate the numerical solution: each step is
differentiated along the tangents of the state and of the solver's memory. The derivative of the error estimate is then
the error estimate of the tangent.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .directed import Directed
from .evaluation import freeze, ravel, unravel_like
from .scales import ends_of

# The tolerance of a tangent, in units of the state's tolerance; and its absolute part, relative to the largest entry.
_LOOSER, _FLOOR = 5.0, 0.01
# The start of a tangent that parameters cause, instead of zero, in units of the other start. So the first step has a
# length, and a mode that is excited late is followed until then. Fainter effects of parameters are resolved relative to
# this start. (From 1e-12 the first steps are so short that rounding makes derivatives of different modes differ by
# 1e-10.)
_FAINT = 1e-4
# The largest rounding errors of a tangent, in units of its largest entry so far and of eps. The tangents of a body that
# constraints hold or drive consist of nothing else.
_ROUNDING = 100.0


class TangentControl(eqx.Module):
    """The tangents whose error a solver controls.

    **Fields:**

    - `units`: the natural sizes of the components of the raveled state.
    - `blocks`: sizes of the blocks of components that are measured by their largest component.
    - `direction`: a tangent of the term, None without derivatives by its numbers. The tangent of the state that it
        causes is carried along.
    - `excites`: whether the tangent from a start that excites every mode is carried along as well.
    - `counted`: the indices of the components that the starts excite, None for all.
    - `restored`: the starts on constraints (`on_constraints`); None if `starts` need not satisfy constraints.
    """

    units: Float[Array, " n"]
    blocks: tuple[int, ...] = eqx.field(static=True)
    direction: PyTree = None
    excites: bool = eqx.field(static=True, default=True)
    counted: tuple[int, ...] | None = eqx.field(static=True, default=None)
    restored: tuple[Float[Array, " n"], ...] | None = None

    def starts(self) -> tuple[Float[Array, " n"], ...]:
        """A start with entries of one half to one unit and of random signs, always the same; and a faint start."""
        if self.restored is not None:
            return self.restored
        random = np.random.default_rng(0)
        excited_indices = np.arange(self.units.size) if self.counted is None else np.array(self.counted, int)
        entries = np.zeros(self.units.size)
        entries[excited_indices] = random.choice([-1.0, 1.0], excited_indices.size) * random.uniform(
            0.5, 1.0, excited_indices.size
        )
        excited = self.units * jnp.asarray(entries, self.units.dtype)
        return tuple(size * excited for size in self.start_sizes)

    @property
    def start_sizes(self) -> tuple[float, ...]:
        """The size of each start, in units, before it is put on constraints."""
        if self.direction is None:
            return (1.0,)
        return (1.0, _FAINT) if self.excites else (_FAINT,)

    @property
    def directions(self) -> tuple[PyTree, ...]:
        """The tangent of the term for each start; None for the start that excites every mode."""
        if self.direction is None:
            return (None,)
        return (None, self.direction) if self.excites else (self.direction,)

    def on_constraints(self, restore: Any, term: PyTree, y0: PyTree) -> "TangentControl":
        """This control with starts pushed forward through `restore(term, y)`, so that they are tangent to constraints.

        Otherwise a solver that projects its steps would change the start by a finite amount in the first step, however
        short.
        """
        none = jax.tree.map(lambda _: None, term)
        starts = [
            ravel(pushed_only(restore, (term, y0), (none if direction is None else direction, unravel_like(y0, w))))
            for direction, w in zip(self.directions, self.starts(), strict=True)
        ]
        return dataclasses.replace(self, restored=tuple(starts))

    def of_terms(self, terms: PyTree) -> tuple[PyTree, ...]:
        """The tangents of a solver's terms, which diffrax has wrapped."""
        none = jax.tree.map(lambda _: None, terms)
        return tuple(none if direction is None else Directed(direction, None) for direction in self.directions)

    def largest(self, w: Float[Array, " n"]) -> Float[Array, " n"]:
        """The largest entry of the group of each component, in its unit."""
        relative = jnp.abs(w) / self.units
        groups = [jnp.full(b - a, jnp.max(relative[a:b], initial=0.0), w.dtype) for a, b in ends_of(self.blocks)]
        return self.units * jnp.concatenate(groups)

    def scales(
        self, rtol: Any, tangents: Sequence["Tangent"], afters: Sequence[Float[Array, " n"]]
    ) -> list[Float[Array, " n"]]:
        """The errors tolerated in the components of tangents in a step that ends with `afters`."""
        return [self._scale(rtol, *data) for data in zip(tangents, afters, self.start_sizes, strict=True)]

    def _scale(self, rtol, tangent, after, start_size):
        after = jnp.where(jnp.isnan(after), 0.0, jnp.abs(after))
        peak = jnp.maximum(tangent.peak, self.largest(after))
        size = jnp.maximum(jnp.abs(tangent.w), after) + _FLOOR * peak
        largest = jnp.maximum(start_size, jnp.max(peak / self.units, initial=0.0))
        return jnp.maximum(_LOOSER * rtol * size, _ROUNDING * jnp.finfo(after.dtype).eps * largest * self.units)


class Tangent(eqx.Module):
    """A tangent between steps.

    **Fields:** `w`, of the raveled state; `memory`, of the solver's memory; `peak`: the largest entries of the groups
    so far.
    """

    w: Float[Array, " n"]
    memory: PyTree
    peak: Float[Array, " n"]


def pushed(function: Any, at: PyTree, along: tuple[PyTree, ...], differentiable: Any = None) -> tuple[PyTree, list]:
    """`function(*at)` and its derivatives `along` tangents; these have no derivatives of their own.

    **Arguments:** `function`: a pytree, since it has derivatives as well; `differentiable`: another form of the same
    function that adjoints can differentiate, if needed.
    """
    out, tangents = _pushed(function, at, along, differentiable)
    return out, [_filled(tangent, out) for tangent in tangents]


def pushed_only(function: Any, at: PyTree, along: PyTree) -> PyTree:
    """The derivative of `function(*at)` along a tangent."""
    out, tangent = eqx.filter_jvp(function, freeze(at), along)
    return _filled(tangent, out)


def _filled(tangent, out):
    """A tangent with zeros where it has no entries, as for constants, and where it is NaN."""

    def fill(t, x):
        if t is None:
            return jnp.zeros_like(x) if eqx.is_inexact_array(x) else None
        return jnp.where(jnp.isnan(t), jnp.zeros_like(t), t) if eqx.is_inexact_array(t) else t

    return freeze(jax.tree.map(fill, tangent, out, is_leaf=_is_none))


@eqx.filter_custom_jvp
def _pushed(function, at, along, differentiable):
    del differentiable
    outs = [eqx.filter_jvp(function, at, tangent) for tangent in along]
    return outs[0][0], [tangent for _, tangent in outs]


@_pushed.def_jvp
def _pushed_jvp(primals, tangents):
    function, at, along, differentiable = primals
    dfunction, dat, _, ddifferentiable = tangents
    if differentiable is not None:
        out, pushes = _pushed(*primals)
        call = lambda function, at: function(*at)
        _, dout = eqx.filter_jvp(call, (differentiable, at), (ddifferentiable, dat))
        return (out, pushes), (dout, jax.tree.map(lambda _: None, pushes))
    # One linearisation serves all directions.
    none = jax.tree.map(lambda _: None, function)
    directions = [(none, tangent) for tangent in along]
    used = lambda *tangents: any(t is not None for t in tangents)
    moving, still = eqx.partition((function, at), jax.tree.map(used, (dfunction, dat), *directions, is_leaf=_is_none))

    def run(moving):
        function, at = eqx.combine(moving, still)
        return eqx.partition(function(*at), eqx.is_inexact_array)

    out, push, rest = jax.linearize(run, moving, has_aux=True)
    zeros = jax.tree.map(jnp.zeros_like, moving)
    dout = push(eqx.combine((dfunction, dat), zeros))
    # Each is a derivative of the linear function, and so omits parts that its direction does not change.
    pushes = [eqx.filter_jvp(push, (zeros,), (tangent,))[1] for tangent in directions]
    return (eqx.combine(out, rest), pushes), (dout, jax.tree.map(lambda _: None, pushes))


def _is_none(x):
    return x is None
