"""Rows of joints that consist of elementary constraints, computed together for all types of joints.

Elements are of two kinds: points that coincide (two or three rows), and products X · Y of two vectors. Both need world
components of body-fixed vectors and their rates, `R v`, `R (ω × v)` and `R (ω × (ω × v) + α × v)`: one product of
matrices. Rows, their first and second rates, Jacobians and wrenches are then a few sums and products.

Where the residual of a joint vanishes, its rows vanish too, with the same derivatives. Rows may vanish at other poses
as well, like the sine of an angle half a turn away. So rows of elements serve motions, which stay close to their
constraints, but not the assembly.
"""

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._types import State
from ..linalg import rotations as rot
from ..linalg.arrays import namespace
from ..linalg.bilinear import BilinearMap
from ..linalg.blocks import matrix_products
from ..linalg.digest import digest_of_fields
from ..linalg.sums import placed_sums, unchecked_take
from ..parts.elements import Element, on_bodies
from .groups import AbstractConstraintGroup, BodyPoses, BodyVelocities

_DOT = {d: BilinearMap.of(np.eye(d)[None]) for d in (2, 3)}
# Largest relative difference between rows of elements and rows of residuals.
_AGREE = 1e-9


class Listed(NamedTuple):
    """One element of stacked joints of one type.

    **Fields:** the `element`, with a leading axis for the joints on its vectors; `bodies` of the joints, (joints, 2);
    `rows`: for each joint, the index of the element's first row.
    """

    element: Element
    bodies: np.ndarray
    rows: np.ndarray


@dataclasses.dataclass(frozen=True)
class Places:
    """Bodies and row numbers of stacked elements; static, compared by `key`.

    **Fields:** `of_vectors`: the body of each vector; `pairs`: bodies A and B of all points that coincide, then of all
    products; `between`: the two bodies that an element's vector connects, the ground twice without such a vector;
    `with_x`: which products have a vector X; `with_points`: which products have a vector between points; `order`: the
    permutation of rows into the joints' order; `ground`: the index of the ground.
    """

    key: Any
    of_vectors: np.ndarray = dataclasses.field(compare=False)
    pairs: np.ndarray = dataclasses.field(compare=False)
    between: np.ndarray = dataclasses.field(compare=False)
    with_x: np.ndarray = dataclasses.field(compare=False)
    with_points: np.ndarray = dataclasses.field(compare=False)
    order: np.ndarray = dataclasses.field(compare=False)
    ground: int = dataclasses.field(compare=False)

    @property
    def points(self) -> int:
        """The number of points that coincide."""
        return len(self.pairs) - len(self.with_x)

    @property
    def products(self) -> int:
        return len(self.with_x)

    @property
    def ends(self) -> list[int]:
        """Ends of the vectors' sections: points of B, points of A, X, and Y in B; Y in A follows."""
        s, d = self.points, self.products
        return [s, 2 * s, 2 * s + d, 2 * s + 2 * d]


class _Motion(NamedTuple):
    """World vectors of elements, or their rates.

    **Fields:** `of_b` and `of_a`, from the bodies' origins to points that coincide; `x`; `y_b` and `y_a`, the parts of
    Y in B and in A; `distances` from A to B of points that coincide; `y`, the whole vector Y.
    """

    of_b: Array
    of_a: Array
    x: Array
    y_b: Array
    y_a: Array
    distances: Array
    y: Array


class _Turning(NamedTuple):
    """Functions of rotations in the plane, or in space.

    **Fields:** `matrices(poses)`: R of prepared poses; `rate(spin, v)`: rates of body-fixed vectors, in the body;
    `moment(arm, force)` in world axes; `in_bodies(matrices, moments)`: world moments in body axes; `dimension`.
    """

    matrices: Callable[[Array], Array]
    rate: Callable[[Array, Array], Array]
    moment: Callable[[Array, Array], Array]
    in_bodies: Callable[[Array, Array], Array]
    dimension: int


def _quarter_turn(v):
    x, y = _cut(v, [1])
    return namespace(v).concatenate([-y, x], axis=-1)


def _planar_matrices(poses):
    xp, (c, s) = namespace(poses), _cut(_cut(poses, [3])[1], [1])
    return xp.stack([xp.concatenate([c, -s], axis=-1), xp.concatenate([s, c], axis=-1)], axis=-2)


_PLANE = _Turning(
    _planar_matrices,
    lambda spin, v: spin * _quarter_turn(v),
    lambda arm, force: _DOT[2](_quarter_turn(arm), force),
    lambda matrices, moments: moments,
    2,
)
_SPACE = _Turning(
    lambda poses: _cut(poses, [7])[1].reshape(-1, 3, 3),
    rot.cross,
    rot.cross,
    lambda matrices, moments: matrix_products(moments[:, None], matrices)[:, 0],
    3,
)
_TURNING = {2: _PLANE, 3: _SPACE}


class _Rows:
    """The rows of elements. A plain class, whose methods are cheap to call from NumPy code."""

    vectors: Any
    turns: Any
    lengths: Any
    inverses: Any
    places: Places

    @property
    def _turning(self):
        return _TURNING[self.vectors.shape[1]]

    def _dot(self, a, b):
        return _DOT[self.vectors.shape[1]](a, b)

    def residual(self, poses: BodyPoses) -> Float[Array, "rows"]:
        """The rows at prepared poses of the bodies and the ground."""
        (now,) = self._moving(poses)
        products = self._dot(self._x(now), now.y)
        if self.lengths is not None:
            half = np.where(self.places.with_x, 1.0, 0.5)[:, None].astype(products.dtype)
            products = half * (products - self.lengths)
        return self._ordered(now.distances, products)

    def velocity(self, poses: BodyPoses, velocities: BodyVelocities) -> Float[Array, "rows"]:
        """Rates of the rows."""
        now, rate = self._moving(poses, velocities)
        return self._ordered(rate.distances, self._dot(self._x(now), rate.y) + self._dot(rate.x, now.y))

    def acceleration(
        self, poses: BodyPoses, velocities: BodyVelocities, accelerations: BodyVelocities
    ) -> Float[Array, "rows"]:
        """Second rates of the rows."""
        now, rate, second = self._moving(poses, velocities, accelerations)
        # The row of a length is (Y² / length − length) / 2; its second rate contains Ẏ² / length once, not twice.
        x_rate = rate.x if self.inverses is None else rate.x + 0.5 * self.inverses * rate.y
        products = self._dot(second.x, now.y) + 2.0 * self._dot(x_rate, rate.y) + self._dot(self._x(now), second.y)
        return self._ordered(second.distances, products)

    def jacobian(self, poses: BodyPoses) -> Float[Array, "rows 2 v"]:
        """Derivatives of each row by the velocities of its two bodies."""
        (now,) = self._moving(poses)
        return self._take_ordered(self._blocks(poses, now))

    def jacobian_of_poses(self, poses: BodyPoses) -> Float[Array, "rows 2 7"]:
        """Derivatives of each row by the poses of its two bodies, with Euler parameters of any length."""
        xp, (now,) = namespace(poses), self._moving(poses)
        blocks, x = self._blocks(poses, now), self._x(now)
        # R is quadratic in Euler parameters, so a change of their length alone changes rows by twice this.
        of_points = xp.stack([-now.of_a, now.of_b], axis=-1).reshape(-1, 2, 1)
        of_products = self._dot(xp.stack([x, x]), xp.stack([self._with_x(now.y) - now.y_a, now.y_b]))
        along = xp.concatenate([of_points, of_products.swapaxes(0, 1)])
        s = self.places.points
        pairs = np.concatenate([np.repeat(self.places.pairs[:s], 3, axis=0), self.places.pairs[s:]])
        p = unchecked_take(_cut(poses, [3, 7])[1], pairs.ravel()).reshape(-1, 2, 4)
        r, turn = _cut(blocks, [3])
        return self._take_ordered(xp.concatenate([r, 4.0 * rot.rates(p, turn) + 2.0 * along * p], axis=-1))

    def wrenches(self, poses: BodyPoses, multipliers: Float[Array, "rows"]) -> Float[Array, "ground v"]:
        """Wrenches of all rows on each body, `Aᵀ λ`."""
        places, s, turning, d = self.places, self.places.points, self._turning, self._turning.dimension
        (now,) = self._moving(poses)
        of_points, of_products = _cut(unchecked_take(multipliers, np.argsort(places.order)), [d * s], axis=0)
        force = of_points.reshape(s, d)
        forces = jnp.stack([-force, force])
        moments = turning.moment(jnp.stack([now.of_a, now.of_b]), forces)
        along, turn = self._of_products(now)
        factors = of_products[None, :, None]
        wrenches = [jnp.concatenate(x, axis=-1) for x in ((forces, moments), (factors * along, factors * turn))]
        entries = jnp.concatenate([x.reshape(-1, x.shape[-1]) for x in wrenches])
        bodies = np.concatenate([places.pairs[:s].T.ravel(), places.pairs[s:].T.ravel()])
        force, moment = _cut(placed_sums(bodies, places.ground)(entries), [d])
        matrices = turning.matrices(poses[: places.ground])
        return jnp.concatenate([force, turning.in_bodies(matrices, moment)], axis=-1)

    def _moving(self, poses, *rates) -> list[_Motion]:
        """World vectors at poses, then their first and second rates if velocities and accelerations are given."""
        places, v, bodies = self.places, self.vectors, self.places.of_vectors
        rate, d = self._turning.rate, self._turning.dimension
        columns, spins = [v], [unchecked_take(_cut(rate_values, [d])[1], bodies) for rate_values in rates]
        if spins:
            columns.append(rate(spins[0], v))
        if len(spins) == 2:
            columns.append(rate(spins[0], columns[1]) + rate(spins[1], v))
        matrices = unchecked_take(self._turning.matrices(poses), bodies)
        of_world = matrix_products(matrices, namespace(poses).stack(columns, axis=-1))
        origins = [_cut(values, [d])[0] for values in (poses, *rates)]
        motions = []
        for vectors, origin in zip(_cut(of_world, list(range(1, len(columns)))), origins, strict=True):
            of_b, of_a, x, y_b, y_a = _cut(vectors[..., 0], places.ends, axis=0)
            apart = unchecked_take(origin, places.between[:, 1]) - unchecked_take(origin, places.between[:, 0])
            of_points, of_products = _cut(apart, [places.points], axis=0)
            motions.append(_Motion(of_b, of_a, x, y_b, y_a, of_points + of_b - of_a, of_products + y_b - y_a))
        return motions

    def _x(self, now: _Motion):
        """X of all products; `Y / length` for products with a length."""
        return now.x if self.inverses is None else now.x + self.inverses * now.y

    def _with_x(self, values):
        """Values of products with an X fixed in A; zero for other products."""
        return values if self.places.with_x.all() else self.places.with_x[:, None].astype(values.dtype) * values

    def _of_products(self, now: _Motion):
        """Forces and world moments on A and B of products with unit multipliers, (2, d, 3) each."""
        xp, x, with_points = namespace(now.x), self._x(now), self.places.with_points
        force = x if with_points.all() else with_points[:, None].astype(x.dtype) * x
        arms = xp.stack([self._with_x(now.y) + now.y_a, -now.y_b])
        return xp.stack([-force, force]), self._turning.moment(xp.stack([x, x]), arms)

    def _blocks(self, poses, now: _Motion):
        """The Jacobian, in the order of the elements."""
        xp, places, s, d = namespace(poses), self.places, self.places.points, self._turning.dimension
        matrices = self._turning.matrices(poses)
        points = matrix_products(unchecked_take(matrices, places.of_vectors[: 2 * s]), self.turns)
        of_b, of_a = _cut(points, [s], axis=0)
        unit = np.broadcast_to(np.stack([-np.eye(d), np.eye(d)], axis=1), (s, d, 2, d)).astype(poses.dtype)
        of_points = xp.concatenate([unit, xp.stack([-of_a, of_b], axis=2)], axis=-1)
        along, turn = self._of_products(now)
        of_bodies = unchecked_take(matrices, places.pairs[s:].T.ravel())
        moments = self._turning.in_bodies(of_bodies, turn.reshape(-1, turn.shape[-1])).reshape(turn.shape)
        of_products = xp.concatenate([along, moments], axis=-1).swapaxes(0, 1)
        return xp.concatenate([of_points.reshape(-1, *of_products.shape[1:]), of_products])

    def _ordered(self, of_points, of_products):
        """Rows in the order of the joints."""
        return self._take_ordered(
            namespace(of_points).concatenate([of_points.reshape(-1), of_products.reshape(-1)]),
        )

    def _take_ordered(self, values):
        order = self.places.order
        return values if np.array_equal(order, np.arange(order.size)) else unchecked_take(values, order)


class ElementaryRows(_Rows, eqx.Module):
    """The rows of all joints that consist of elements.

    **Fields:** body-fixed `vectors`: points of B, points of A, X, Y in B, Y in A; `turns`: rates of the points of B and
    A for unit angular velocities; `lengths` of products and their `inverses`, zero for products without a length, None
    if no product has a length.
    """

    vectors: Float[Array, "n d"]
    turns: Float[Array, "p d turns"]
    lengths: Float[Array, "d 1"] | None
    inverses: Float[Array, "d 1"] | None
    places: Places = eqx.field(static=True)


@dataclasses.dataclass
class HostRows(_Rows):
    """The same rows in NumPy. Not a module: methods of modules take a hundred times as long to call."""

    vectors: np.ndarray
    turns: np.ndarray
    lengths: np.ndarray | None
    inverses: np.ndarray | None
    places: Places

    @classmethod
    def of(cls, rows: ElementaryRows) -> "HostRows":
        """These rows, whose numbers are arrays of NumPy."""
        return cls(rows.vectors, rows.turns, rows.lengths, rows.inverses, rows.places)  # pyright: ignore[reportArgumentType]


def is_elementary(group: AbstractConstraintGroup) -> bool:
    """Whether elements give the rows of stacked joints."""
    part = group.group.part
    return group.is_position and not (group.group.inputs or part.modal_rows) and part.declares("elements")


def elementary_rows(groups: Sequence[AbstractConstraintGroup], ground: int) -> ElementaryRows | None:
    """The rows of the elementary groups in `groups`; None without such groups.

    **Arguments:** `ground`: the index of the ground.
    """
    listed = _listed(groups)
    return stacked(listed, ground, groups[0].group.layout.space.dimension) if listed else None


def _listed(groups: Sequence[AbstractConstraintGroup]) -> list[Listed]:
    """The elements of the elementary groups in `groups`, with consecutive row numbers."""
    listed, first = [], 0
    for g in filter(is_elementary, groups):
        group = g.group
        of_part = lambda part, group=group: on_bodies(part, group.layout.space, group.kernel("elements")(part))
        places = first + g.rows * np.arange(len(group.names))
        for element in jax.vmap(of_part)(group.part):
            listed.append(Listed(element, group.body_index, places))
            places = places + element.rows(group.layout.space.dimension)
        first += g.rows * len(group.names)
    return listed


def half_turned(groups: Sequence[AbstractConstraintGroup], poses: BodyPoses) -> Bool[Array, "rows"]:
    """Which rows of elementary joints vanish at these poses although the joint is open.

    Such a joint is turned by half a turn, or by a third of a turn about a diagonal.
    """
    space, listed = groups[0].group.layout.space, _listed(groups)
    rows = sum(item.element.rows(space.dimension) * len(item.rows) for item in listed)
    pairs = [item for item in listed if getattr(item.element, "along_a", None) is not None]
    if not pairs:
        return jnp.zeros(rows, bool)
    direction = jax.vmap(space.direction)
    bodies = np.concatenate([item.bodies for item in pairs])
    of_a, of_b = (jnp.concatenate([getattr(item.element, name) for item in pairs]) for name in ("along_a", "along_b"))
    a, b = direction(unchecked_take(poses, bodies[:, 0]), of_a), direction(unchecked_take(poses, bodies[:, 1]), of_b)
    sizes = rot.norm(of_a) * rot.norm(of_b)
    # The two directions are parallel where the joint closes.
    opposite = _DOT[space.dimension](a, b)[:, 0] < 0.5 * sizes
    return jnp.zeros(rows, bool).at[np.concatenate([item.rows for item in pairs])].set(opposite)


def stacked(listed: Sequence[Listed], ground: int, d: int) -> ElementaryRows:
    """The rows of elements in `d` dimensions."""
    points = [item for item in listed if item.element.coincide]
    products = [item for item in listed if not item.element.coincide]
    xp = namespace(*jax.tree.leaves([item.element for item in listed]))
    dtype = xp.result_type(*jax.tree.leaves([item.element for item in listed]))

    def numbers(of_element: Callable[[Any], Any], among: Sequence[Listed], shape: tuple[int, ...] = (d,)):
        """A field of the elements `among`, zeros where it is None."""
        entries = [(of_element(item.element), (len(item.bodies), *shape)) for item in among]
        return xp.concatenate(
            [xp.zeros((0, *shape), dtype), *(np.zeros(size) if x is None else x.reshape(size) for x, size in entries)],
            dtype=dtype,
        )

    def of_joints(of_element: Callable[[Any], Any], among: Sequence[Listed]):
        """A boolean of the elements `among`, once for each joint."""
        values = [np.full(len(item.bodies), of_element(item.element)) for item in among]
        return np.concatenate([np.zeros(0, bool), *values])

    bodies = lambda among: np.concatenate([np.zeros((0, 2), int), *(item.bodies for item in among)])
    s = sum(len(item.bodies) for item in points)
    of_points = [numbers(lambda x: x.point_b, points), numbers(lambda x: x.point_a, points)]
    of_products = [numbers(lambda x: x.x_a, products), numbers(lambda x: x.y_b, products)]
    vectors = xp.concatenate([*of_points, *of_products, numbers(lambda x: x.y_a, products)])
    unit = np.eye(3, dtype=dtype) if d == 3 else np.ones((1, 1), dtype)
    spins: Any = [xp.broadcast_to(axis, (2 * s, *axis.shape)) for axis in unit]
    turns = xp.stack([_TURNING[d].rate(spin, vectors[: 2 * s]) for spin in spins], axis=-1)
    lengths = inverses = None
    if any(item.element.length is not None for item in products):  # pyright: ignore[reportAttributeAccessIssue]
        lengths = numbers(lambda x: x.length, products, (1,))
        inverses = numbers(lambda x: None if x.length is None else 1 / x.length, products, (1,))
    with_x = of_joints(lambda x: x.x_a is not None, products)
    with_points = of_joints(lambda x: x.y_a is not None, products)
    (a, b), (a2, b2) = bodies(points).T, bodies(products).T
    between = np.where(with_points[:, None], bodies(products), ground)
    rows = [np.add.outer(item.rows, np.arange(d)).ravel() for item in points] + [item.rows for item in products]
    places = Places(
        key=None,
        of_vectors=np.concatenate([b, a, np.where(with_x, a2, ground), b2, np.where(with_points, a2, ground)]),
        pairs=np.concatenate([bodies(points), bodies(products)]),
        between=np.concatenate([bodies(points), between]),
        with_x=with_x,
        with_points=with_points,
        order=np.argsort(np.concatenate(rows)),
        ground=ground,
    )
    key = digest_of_fields(places), ground
    return ElementaryRows(vectors, turns, lengths, inverses, dataclasses.replace(places, key=key))


def check_elements(system: Any, state: State, t: float = 0.0) -> None:
    """Raise a `ValueError` if the `elements` that a joint declares disagree with its residual.

    ```python
    jaxmb.report.check_elements(system, jaxmb.assemble(system))
    ```

    Give a generic state, with velocities that are not zero: a row whose derivatives vanish there is not tested.

    **Arguments:** `system`: a compiled scene; a consistent `state`; the time `t` [s].
    """
    for what, (elementary, exact) in _compared(system, jnp.asarray(t, state.q.dtype), state).items():
        elementary, exact = (np.asarray(x).reshape(x.shape[0], -1)[: system.position_rows] for x in (elementary, exact))
        off = np.max(np.abs(elementary - exact), axis=1, initial=0.0)
        row = int(np.argmax([*off, 0.0]))
        if row < off.size and not off[row] <= _AGREE * (1 + np.max(np.abs(exact))):
            name, number = system.rows[row]
            raise ValueError(
                f"Joint {name!r}: the {what} of row {number} of its elements and of its residual differ by "
                f"{off[row]:.2g}. Where the residual vanishes, the elements must as well, with the same derivatives."
            )


@eqx.filter_jit
def _compared(system, t, state):
    """The rows of a system, from elements and from residuals."""
    near, (q, u) = system.prepared(), (state.q, state.u)
    other = jnp.linspace(-1.0, 1.0, u.size, dtype=u.dtype)
    both = lambda rows_of: (rows_of(near), rows_of(system))
    return {
        "values": both(lambda model: model.position_residual(t, q)),
        "rates": both(lambda model: model.velocity_residual(t, q, other)),
        "Jacobians": both(lambda model: model.jacobian(t, q, u)),
        "second rates": both(lambda model: model.acceleration_residual(t, q, u, other)),
    }


def _cut(values: Any, places: Any, axis: int = -1) -> list[Any]:
    """`values` split at `places`. The derivative is a concatenation; slices would be padded and added."""
    if isinstance(values, np.ndarray):
        ends = [0, *places, values.shape[axis]]
        every = (slice(None),) * (axis % values.ndim)
        return [values[(*every, slice(a, b))] for a, b in itertools.pairwise(ends)]
    return jnp.split(values, places, axis=axis)
