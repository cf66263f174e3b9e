"""Batches in blocks: a function of many members, as many at once as fit the cache of a core."""

import functools
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

from .._arguments import whole_number
from .._setup import bytes_of_kernel_loops
from .._traced_functions import NEED_NUMBERS
from ..lanes import together as side_by_side
from ..lanes.members import SIDE_BY_SIDE, stand_side_by_side
from ..lanes.sizes import loops
from ..linalg.arrays import ARRAYS
from ..linalg.members import in_blocks
from ..parts.names import names_arguments

# Largest number of bytes carried from step to step by the loops of a block, and largest number of members of a block.
_CARRIED, _MOST = 2**20, 64
# Ratio of the bytes that the equations of a loop body write to the bytes that its fused kernels read and write (rule of
# thumb).
_FUSED = 3


@names_arguments
def batch(function: Callable[..., Any], size: int | None = None) -> Callable[..., Any]:
    """`jax.vmap` of a function, in blocks that are computed one after the other in one program.

    ```python
    angles = mb.batch(angle_at_end)(lengths, masses)  # As jax.vmap(angle_at_end)(lengths, masses).
    slopes = mb.batch(jax.grad(angle_at_end))(lengths, masses)
    ```

    The members of a block go through the loop of a simulation together, until the slowest member has ended. Each
    operation acts on the numbers of all members. The caches hold the numbers of some tens of simulations. So `jax.vmap`
    of a few hundred takes longer than blocks, or even than one run after the other. Use `jax.vmap` for functions
    without loops. Use it on a GPU as well, where it pays from some hundred members on: on an H100, a step of a four-bar
    takes 0.2 ms, and of 65 536 four-bars 2 ms; on a core, a step of one takes 0.01 ms.

    **Arguments:**

    - `function`: takes pytrees of arrays by position and returns a pytree of arrays. JAX traces it.
    - `size`: the most members of a block; 1 computes one after the other, without `vmap`. The default is a power of two
        for which the numbers carried by the function's largest loop stay in the cache of a core. The default is 1 if
        that loop becomes one kernel by `setup(compile="for speed")`: this is as fast, and no member waits for another.
        The default is 8 with `setup(compile="for batches")`, with members side by side in the registers of a processor.
        Functions without loops have one block, and so have all functions on other devices than a CPU.

    **Returns:** a function of the same arguments with members along axis 0 of each array. Its results have members
    along axis 0 as well. The function is compiled at its first call. Values other than arrays, such as names, are the
    same for all members, and so are values that the function refers to. The last block is filled up with copies of the
    last member, which costs time and does not change results. The function has derivatives in all modes; reverse mode
    keeps the values that it needs from all blocks at once.

    **Raises:** `ValueError` for a size that is not an integer of at least 1; for arguments without members or of
    different numbers of members; for a function that needs an argument as a number; and, unless `size=1`, for an
    operation without a rule for batches.
    """
    if not callable(function):
        raise ValueError(f"batch needs a function, got {function!r}.")
    size = None if size is None else whole_number("size", size, 1, ", or None")

    @eqx.filter_jit
    def of_all(members, count):
        arrays, shared = eqx.partition(members, lambda x: isinstance(x, ARRAYS))
        member = Member(lambda block: function(*eqx.combine(block, shared)), jax.tree.map(lambda x: x[0], arrays))
        together = lambda block: member.block(jax.tree.leaves(block)[0].shape[0])(block)
        return in_blocks(together, arrays, min(size or member.block_size(count), count))

    @functools.wraps(function)
    def batched(*members: Any) -> Any:
        return of_all(members, _count(members))

    return batched


class Member:
    """A function of one member, traced once for an example of its arguments. The example may be traced itself.

    **Raises:** `ValueError` for a function that needs an argument as a number.
    """

    def __init__(self, function: Callable[..., Any], example: PyTree):
        self._function = jax.jit(function)
        self._like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), example)
        try:
            self._program = self._function.trace(self._like).jaxpr
        except NEED_NUMBERS as error:
            raise ValueError(
                "The function cannot be batched: it needs an argument as a number, which differs between members. "
                f"Use jnp.where or jax.lax.cond for `if`, and jax.numpy for NumPy. ({error})"
            ) from error

    @functools.cached_property
    def _loops(self) -> list[tuple[int, int]]:
        return list(loops(self._program))

    @property
    def _carried(self) -> int:
        """The bytes that the largest loop carries for a member."""
        return max((carried for carried, _ in self._loops), default=0)

    @property
    def _side_by_side(self) -> bool:
        return stand_side_by_side(self._carried)

    def block_size(self, members: int) -> int:
        """The number of members, a power of two or all, that are computed at once on the default device."""
        if self._carried == 0 or jax.default_backend() != "cpu":
            return members
        if self._side_by_side:
            return min(SIDE_BY_SIDE, members)
        if max(written for _, written in self._loops) < _FUSED * bytes_of_kernel_loops():
            return 1
        return min(2 ** int(math.log2(max(_CARRIED / self._carried, 1))), _MOST)

    def block(self, size: int) -> Callable[..., Any]:
        """The function of `size` members at once; without `vmap` for one member."""
        if size == 1:
            alone = lambda x: jax.tree.map(lambda x: x[0], x)
            return lambda own: jax.tree.map(lambda x: x[None], self._function(alone(own)))
        at_once = self._in_lanes if self._side_by_side else jax.vmap(self._function)

        def together(members):
            try:
                return at_once(members)
            except NotImplementedError as error:
                raise ValueError(
                    f"The function cannot be batched ({error}); size=1 computes one member after the other."
                ) from error

        return together

    def _in_lanes(self, members: PyTree) -> PyTree:
        program, like = jax.make_jaxpr(self._function, return_shape=True)(self._like)
        return jax.tree.unflatten(jax.tree.structure(like), side_by_side(program)(*jax.tree.leaves(members)))


def _count(members: tuple[Any, ...]) -> int:
    """The number of members along axis 0 of all arrays."""
    counts = {}
    for path, x in jax.tree_util.tree_leaves_with_path(members):
        name = f"Argument {jax.tree_util.keystr(path)}"
        if isinstance(x, bool | int | float | complex) or (isinstance(x, ARRAYS) and not np.shape(x)):
            raise ValueError(
                f"{name} is a single number, {x!r}: members are along axis 0. A list of members of one structure is "
                "stacked by jax.tree.map(lambda *x: jnp.stack(x), *members)."
            )
        if isinstance(x, ARRAYS):
            counts[name] = np.shape(x)[0]
    if not counts:
        raise ValueError("A batch needs an array with members along axis 0, got none.")
    (first, count), *others = counts.items()
    for name, number in others:
        if number != count:
            raise ValueError(f"{first} has {count} members, but {name} has {number}.")
    if count == 0:
        raise ValueError(f"A batch needs at least one member, and {first} has none.")
    return count
