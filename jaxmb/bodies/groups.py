"""Parts of one type, stacked: one kernel and one `vmap` serve any number of them."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar
from ..linalg.arrays import unchecked_take
from ..parts.base import AbstractPart
from ..parts.contents import anonymous, entry, inner_parts
from ..parts.series import AbstractSignal
from ..parts.space import AbstractSpace
from .layout import Layout


class Input(eqx.Module):
    """A number of stacked parts that is a function of time: the parameter's name, the keys that lead to it in the
    part, and the number of the part.
    """

    signal: AbstractSignal
    name: str = eqx.field(static=True)
    keys: tuple[str, ...] = eqx.field(static=True)
    member: int = eqx.field(static=True)


class Group(eqx.Module):
    """Stacked parts. `part` has the structure of one part with a leading axis on every number; `inputs` replace some
    numbers by functions of time; `inner`: where the parts hold other parts, the keys that lead there and the names of
    these.
    """

    part: Any
    names: tuple[str, ...] = eqx.field(static=True)
    bodies: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    layout: Layout = eqx.field(static=True)
    inputs: tuple[Input, ...] = ()
    inner: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = eqx.field(static=True, default=())

    def map(self, kernel: Callable[..., Any], *per_part: Array) -> Any:
        """`kernel(at, …)` of every part with its rows of some arrays, where `at(t)` is the part at a time."""
        if not self.inputs:
            return jax.vmap(lambda part, *own: kernel(lambda t: part, *own))(self.part, *per_part)
        single = lambda member, part, *own: kernel(lambda t: self._at(member, part, t), *own)
        return jax.vmap(single)(jnp.arange(len(self.names)), self.part, *per_part)

    def single(self, member: int, t: Scalar) -> Any:
        """One part at a time."""
        return self._at(member, jax.tree.map(lambda leaf: leaf[member], self.part), t)

    def _at(self, member, part, t):
        """One part with its inputs at a time."""
        for own in self.inputs:
            where = lambda part, keys=own.keys: entry(part, keys)
            given = where(part)
            value = jnp.where(member == own.member, jnp.asarray(own.signal(t), given.dtype), given)
            part = eqx.tree_at(where, part, value)
        return part

    @property
    def body_index(self) -> np.ndarray:
        """Bodies of each part, shape (parts, k)."""
        return np.array(self.bodies, np.int32)

    @property
    def rows(self) -> int:
        return self.part.rows

    def gather(self, of_bodies: Float[Array, "b_ground _"]) -> Float[Array, "parts k _"]:
        """Rows of each part's bodies, from those of all bodies and the ground."""
        return unchecked_take(of_bodies, self.body_index)


def stack(
    parts: Sequence[tuple[AbstractPart, tuple[int, ...]]],
    layout: Layout,
    check: Callable[[Any, AbstractSpace, int], None] | None = None,
) -> tuple[Group, ...]:
    """Group parts that share type, static fields and shapes; order of first appearance.

    **Arguments:** `parts` with the numbers of their bodies; `check(part, space, bodies)`: called for one part of each
    group.
    """
    groups: dict[Any, list] = {}
    for part, bodies in parts:
        leaves, structure = jtu.tree_flatten(anonymous(part))
        if not all(eqx.is_array_like(leaf) for leaf in leaves):
            raise ValueError(_not_numbers(part))
        key = (structure, tuple(leaf.shape for leaf in leaves), len(bodies))
        if key not in groups and check is not None:
            check(part, layout.space, len(bodies))
        groups.setdefault(key, []).append((leaves, part.name, bodies, list(inner_parts(part))))
    out = []
    for key, members in groups.items():
        # NumPy, since XLA would compile a program for thousands of operands.
        columns = zip(*(member[0] for member in members), strict=True)
        leaves = [jax.device_put(np.stack([np.asarray(leaf) for leaf in column])) for column in columns]
        names, bodies = tuple(m[1] for m in members), tuple(m[2] for m in members)
        inner = tuple((keys, tuple(m[3][k][1].name for m in members)) for k, (keys, _) in enumerate(members[0][3]))
        out.append(Group(jtu.tree_unflatten(key[0], leaves), names, bodies, layout, inner=inner))
    return tuple(out)


def _not_numbers(part: AbstractPart) -> str:
    """What is wrong with a part that holds other things than numbers in fields that are not static."""
    found = [(path, leaf) for path, leaf in jtu.tree_flatten_with_path(part)[0] if not eqx.is_array_like(leaf)]
    path, leaf = found[0]
    field = jtu.keystr(path).removeprefix(".")
    return (
        f"{part.label}: {field} is {leaf!r}, which is not a number. Declare a function with fields.function(). Split a "
        "module that holds functions, such as a neural network, by arrays, rest = eqx.partition(module, eqx.is_array), "
        "with a field for the arrays and one that is fields.function() for the rest."
    )


class AbstractGroup(eqx.Module):
    """Stacked parts with the kernels of their kind."""

    group: Group

    def part(self, name: str = "") -> AbstractPart:
        """The part of a group of one without the leading axis; of others a part with that axis on every number."""
        return self.group.part.named(name)


class BodyGroup(AbstractGroup):
    """Stacked bodies."""

    @property
    def mass(self) -> Float[Array, "parts"]:
        """Masses [kg]."""
        return jax.vmap(lambda body: body.mass)(self.group.part)

    @property
    def inertia(self) -> Float[Array, "parts *matrix"]:
        """Moments of inertia [kg m²] about the mass centres."""
        return jax.vmap(lambda body: body.inertia)(self.group.part)


class CoordinateGroup(AbstractGroup):
    """Stacked parts that have coordinates and no rows: tendons, and joints that leave all motions free."""

    @property
    def rows(self) -> int:
        return 0

    def coordinates(self, t: Scalar, poses: Float[Array, "b_ground p"]) -> dict[str, Float[Array, "parts *shape"]]:
        """Their coordinates, by name within the part."""
        space = self.group.layout.space
        return self.group.map(lambda at, x: at(t).coordinates_at(space, x), self.group.gather(poses))


class FrameGroup(AbstractGroup):
    """Stacked frames."""

    def poses(self, t: Scalar, poses: Float[Array, "b_ground p"]) -> Float[Array, "parts p"]:
        """Prepared poses of the frames."""
        space = self.group.layout.space
        return self.group.map(lambda at, x: at(t).pose(space, x[0]), self.group.gather(poses))

    def velocities(
        self, t: Scalar, poses: Float[Array, "b_ground p"], velocities: Float[Array, "b_ground v"]
    ) -> Float[Array, "parts v"]:
        """Velocities of the frames."""
        space = self.group.layout.space
        own = self.group.gather(poses), self.group.gather(velocities)
        return self.group.map(lambda at, x, v: at(t).velocity(space, x[0], v[0]), *own)


def along_moves(space: AbstractSpace, function: Callable[[Array], Array], x: Float[Array, "k p"]) -> Array:
    """Derivatives of a function of the poses of some bodies along their unit velocities, (…, k, v)."""
    moves = jax.vmap(space.moves)(x)
    k, size, _ = moves.shape
    _, push = jax.linearize(function, x)
    along = jnp.eye(k, dtype=x.dtype)[:, None, :, None] * moves[:, :, None, :]
    columns = jax.vmap(push, out_axes=-1)(along.reshape(k * size, *x.shape))
    return columns.reshape(*columns.shape[:-1], k, size)
