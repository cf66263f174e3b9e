"""The Jacobian of constraints as blocks of joints on bodies, and its Gram matrix by sparse elimination.

The Gram matrix `A M⁻¹ Aᵀ` couples the joints that share a body. A body of very many joints would couple them all. Such
a body is a node of the elimination itself, eliminated after its joints:

    [ G    C ] [λ]   [b]       C = A_hubs L⁻ᵀ,   M = L Lᵀ,   G of the other bodies,
    [ Cᵀ  −1 ] [z] = [0]

a symmetric quasi-definite matrix. M couples no other bodies.
"""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .block_elimination import BlockFactor, eliminate_blocks
from .blocks import matrix_products, transpose_vector_products, vector_products
from .elimination_order import NodeOrder
from .inertia import AbstractInertia
from .jacobian import AbstractJacobian, DenseJacobian
from .positive_definite import AbstractPositiveDefinite, AbstractPositiveFactor
from .sums import PlacedSums, unchecked_take


@dataclasses.dataclass(frozen=True)
class JointOrder:
    """The order of elimination of a scene's joints: static index arithmetic, compared by its `key`.

    A joint has up to r rows and k bodies, a body v velocities.

    **Fields:**

    - `rows` (joints, r): index of the rows of each joint among all m; padding has the index m.
    - `kept` (joints, r): whether a row is independent of the others; false for padding.
    - `place` (m,): index of each row among the rows of the joints in order, raveled.
    - `bodies` (joints, k): the bodies; padding has the number of bodies.
    - `blocks` (joints, k, r, v): index of each entry among the blocks of all joints as given to `block_jacobian`;
        padding has the index of the zero at the end.
    - `on_bodies`: sums of the actions of joints on each body, from (joints · k) entries.
    - `velocity_index` (bodies + 1, v): index of each body's velocities among all n; padding, and the last row, for no
        body, have the index n.
    - `velocity_place` (n,): index of each velocity among the velocities of the bodies, raveled.
    - `first`, `second` (products,): the blocks, by joint and body raveled, whose products add up to G; `products`: the
        sums of products for the stored blocks of the matrix.
    - `hubs` (h,): the bodies that are nodes, after the joints; `on_hubs` (entries,): the blocks, by joint and body
        raveled, of joints on hubs, and `hub_places` their places among the stored blocks.
    - `nodes`: the order of elimination of joints and hubs.
    - `left_out`: indices of rows that are not eliminated, as given.
    - `absolute`: indices of parts that bind bodies to the world, not only to each other, as given.
    """

    key: Any
    rows: np.ndarray = dataclasses.field(compare=False)
    kept: np.ndarray = dataclasses.field(compare=False)
    place: np.ndarray = dataclasses.field(compare=False)
    bodies: np.ndarray = dataclasses.field(compare=False)
    blocks: np.ndarray = dataclasses.field(compare=False)
    on_bodies: PlacedSums = dataclasses.field(compare=False)
    velocity_index: np.ndarray = dataclasses.field(compare=False)
    velocity_place: np.ndarray = dataclasses.field(compare=False)
    first: np.ndarray = dataclasses.field(compare=False)
    second: np.ndarray = dataclasses.field(compare=False)
    products: PlacedSums = dataclasses.field(compare=False)
    hubs: np.ndarray = dataclasses.field(compare=False)
    on_hubs: np.ndarray = dataclasses.field(compare=False)
    hub_places: np.ndarray = dataclasses.field(compare=False)
    nodes: NodeOrder = dataclasses.field(compare=False)
    left_out: tuple[int, ...] = dataclasses.field(compare=False)
    absolute: frozenset[int] = dataclasses.field(compare=False)

    def __str__(self) -> str:
        text = f"sparse elimination of {len(self.kept)} joints"
        if self.hubs.size:
            text += f" and {self.hubs.size} bodies of many joints"
        rest = self.nodes.rest.size
        return f"{text} in {self.nodes.levels} levels" + f" and a rest of {rest}" * bool(rest)

    @property
    def uniform(self) -> bool:
        """Whether every body has all its velocities, so that they are a plain reshape of all velocities."""
        return self.velocity_place.size == self.velocity_index[:-1].size

    @property
    def is_kept(self) -> np.ndarray:
        """Whether each of all m rows is independent of the others."""
        return self.kept.reshape(-1)[self.place]

    def of_rows(self, numbers: tuple[int, ...]) -> "JointOrder":
        """The same order with at most these rows kept."""
        return dataclasses.replace(self, key=(self.key, numbers), kept=self.kept & np.isin(self.rows, numbers))


class BlockJacobian(AbstractJacobian):
    """Blocks of joints on bodies. The graph of the joints determines the time of products and elimination: for trees
    and local loops it is proportional to the number of joints.

    **Fields:** `blocks` (joints, k, r, v): of each joint on its bodies; the `order` of elimination.
    """

    blocks: Float[Array, "j k r v"]
    order: JointOrder = eqx.field(static=True)

    def product(self, v):
        return self._all_rows(self.on_joints(v))

    def on_joints(self, v: Float[Array, "n"]) -> Float[Array, "j r"]:
        """`A v`, joint by joint."""
        of_bodies = unchecked_take(_of_bodies(self.order, v), self.order.bodies)
        along = vector_products(self.blocks, of_bodies)
        return functools.reduce(jnp.add, [along[:, k] for k in range(along.shape[1])])

    def transpose_product(self, multipliers):
        return self.on_velocities(self._joint_rows(multipliers))

    def on_velocities(self, multipliers: Float[Array, "j r"]) -> Float[Array, "n"]:
        """`Aᵀ λ` from multipliers joint by joint."""
        wrenches = transpose_vector_products(self.blocks, multipliers[:, None, :])
        of_bodies = self.order.on_bodies(wrenches.reshape(-1, wrenches.shape[2])).reshape(-1)
        return of_bodies if self.order.uniform else unchecked_take(of_bodies, self.order.velocity_place)

    def sizes(self, v):
        return BlockJacobian(jnp.abs(self.blocks), self.order).product(jnp.abs(v))

    def row_norms(self, scale):
        of_bodies = unchecked_take(_of_bodies(self.order, scale), self.order.bodies)
        return self._all_rows(jnp.sqrt(jnp.sum((self.blocks * of_bodies[:, :, None, :]) ** 2, axis=(1, 3))))

    def gather_rows(self, values):
        return jnp.where(self.order.kept, self._joint_rows(values), 0.0)

    def scatter_rows(self, values):
        return self._all_rows(jnp.where(self.order.kept, values, 0.0))

    def responses(self, inertia):
        return None

    def gram(self, inertia, responses):
        return BlockGram(self, inertia)

    def dense(self):
        unit = jnp.eye(self.order.velocity_place.size, dtype=self.blocks.dtype)
        matrix, kept = jax.vmap(self.product, in_axes=1, out_axes=1)(unit), self.order.is_kept
        return DenseJacobian(matrix, rows=None if kept.all() else jnp.asarray(np.flatnonzero(kept)))

    def of_rows(self, numbers):
        return BlockJacobian(self.blocks, self.order.of_rows(numbers))

    def selected(self, rank, scale, level=None):
        # The order of elimination leaves implied rows out.
        del rank, scale, level
        return self

    @property
    def active(self):
        return jnp.asarray(self.order.is_kept, self.blocks.dtype)

    def _joint_rows(self, values):
        return unchecked_take(jnp.append(values, jnp.zeros((), values.dtype)), self.order.rows)

    def _all_rows(self, values):
        return unchecked_take(values.reshape(-1), self.order.place)


class BlockGram(AbstractPositiveDefinite):
    """`A M⁻¹ Aᵀ` for independent rows, and the identity for the others; its vectors are (joints, r)."""

    jacobian: BlockJacobian
    inertia: AbstractInertia

    def product(self, x):
        kept = self.jacobian.order.kept
        forces = self.jacobian.on_velocities(jnp.where(kept, x, 0.0))
        return jnp.where(kept, self.jacobian.on_joints(self.inertia.solve(forces)), x)

    def eliminate(self, share=None):
        order, blocks = self.jacobian.order, self.jacobian.blocks
        joints, k, r, v = blocks.shape
        scaled = jnp.where(order.kept[:, None, :, None], blocks, 0.0)
        root = _of_bodies(order, self.inertia.root().solve(_units(order, blocks.dtype)))
        scaled = scaled.reshape(joints * k, r, v)
        root = unchecked_take(root, order.bodies.reshape(-1)).swapaxes(1, 2)
        # Barriers keep XLA from computing the factors again for each entry of a product.
        scaled = lax.optimization_barrier(matrix_products(scaled, root))
        first, second = (unchecked_take(scaled, of_joints) for of_joints in (order.first, order.second))
        first, second = lax.optimization_barrier((first, second))
        products = lax.optimization_barrier(matrix_products(first, second.swapaxes(1, 2)))
        stored = order.products(products)
        hubs = order.hubs.size
        size = max(r, v) if hubs else r
        stored = jnp.pad(stored, ((0, 0), (0, size - r), (0, size - r)))
        if hubs:
            across = jnp.pad(unchecked_take(scaled, order.on_hubs), ((0, 0), (0, size - r), (0, size - v)))
            # The later of the two nodes is the row.
            hub_is_row = order.nodes.row[order.hub_places] >= joints
            across = jnp.where(hub_is_row[:, None, None], across.swapaxes(1, 2), across)
            stored = stored.at[order.hub_places].set(across, unique_indices=True, mode="promise_in_bounds")
        stored = stored + jnp.asarray(_identities(order, size), blocks.dtype)
        shift = None
        if share is not None:
            of_joints = stored[:joints]
            largest = jnp.max(jnp.diagonal(of_joints, axis1=1, axis2=2)) + jnp.finfo(blocks.dtype).tiny
            shift = share * largest
            stored = stored.at[:joints].set(of_joints + shift * jnp.eye(size, dtype=blocks.dtype)[None])
        factor = eliminate_blocks(stored, order.nodes)
        # The first stored blocks are on the diagonal.
        return BlockGramFactor(self, shift, factor, jnp.diagonal(stored[: order.nodes.nodes], axis1=1, axis2=2))


class BlockGramFactor(AbstractPositiveFactor):
    """A factored Gram matrix: the factor of joints and hubs, and the `diagonal` (nodes, b) before elimination."""

    matrix: BlockGram
    shift: Any
    factor: BlockFactor
    diagonal: Float[Array, "nodes b"]

    def substitute(self, b):
        joints, r = b.shape
        nodes, size = self.diagonal.shape
        return self.factor.solve(jnp.pad(b, ((0, nodes - joints), (0, size - r))))[:joints, :r]

    def smallest_pivot(self):
        joints = self.matrix.jacobian.order.kept.shape[0]
        return jnp.min((self.factor.pivots() / self.diagonal)[:joints], initial=1.0)


def block_jacobian(blocks: Float[Array, "entries"], order: JointOrder) -> BlockJacobian:
    """A from the blocks of all joints, (rows, bodies, v) each, raveled one after the other and followed by a zero."""
    return BlockJacobian(unchecked_take(blocks, order.blocks), order)


def _of_bodies(order, values):
    """Values (n, …) body by body, followed by zeros, (bodies + 1, v, …)."""
    if order.uniform:
        values = values.reshape(-1, order.velocity_index.shape[1], *values.shape[1:])
        return jnp.pad(values, ((0, 1), *[(0, 0)] * (values.ndim - 1)))
    zero = jnp.zeros((1, *values.shape[1:]), values.dtype)
    return unchecked_take(jnp.concatenate([values, zero]), order.velocity_index)


def _units(order, dtype):
    """The identity of each body's velocities, (n, v)."""
    n, v = order.velocity_place.size, order.velocity_index.shape[1]
    if order.uniform:
        return jnp.tile(jnp.eye(v, dtype=dtype), (n // v, 1))
    unit = np.zeros((n + 1, v))
    unit[order.velocity_index, np.arange(v)] = 1.0
    return jnp.asarray(unit[:-1], dtype)


def _identities(order, size):
    """Ones on the diagonal for rows that are not kept, and minus ones for hubs: (stored blocks, b, b)."""
    nodes = order.nodes
    joints, r = order.kept.shape
    diagonal = np.ones((nodes.nodes, size))
    diagonal[:joints, :r] = ~order.kept
    diagonal[joints:] = -1.0
    out = np.zeros((nodes.blocks, size, size))
    out[: nodes.nodes, np.arange(size), np.arange(size)] = diagonal
    return out
