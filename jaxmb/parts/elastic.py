"""Elastic bodies of the plane and of space, in a frame that moves with them: from arrays of modes, and uniform bars.

Sources: A. A. Shabana, "Dynamics of Multibody Systems", Cambridge University Press, chapter 5 (arrays of modes in a
floating frame); T. R. Kane, R. R. Ryan, A. K. Banerjee, "Dynamics of a Cantilever Beam Attached to a Moving Base",
J. Guidance 10(2), 1987 (a bar's stretch as a coordinate, and its shortening by bending).
"""

import abc
from collections.abc import Mapping
from os import PathLike
from types import MappingProxyType
from typing import Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..linalg.arrays import is_traced, namespace
from ..linalg.blocks import vector_products
from ..linalg.sums import unchecked_take
from . import fields
from .bar_shapes import BarShapes, bar_tables, shapes_at
from .base import AbstractFlexibleBody, ScalarCoordinate
from .frames import AbstractFlexibleFrame
from .nodal import reduced
from .space import AbstractSpace

# The matrices of `e × x` for the unit angular velocities e, by the dimension of the space.
_TURNS = {
    2: np.array([[[0.0, -1.0], [1.0, 0.0]]]),
    3: np.array(
        [
            [[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]],
            [[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]],
            [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
        ]
    ),
}
# The smallest eigenvalue of the products of modes of length one that do not depend on each other.
_INDEPENDENT = 1e-12
_MOST_MODES = 8
# Sums of so many terms at most are written term by term.
_UNROLLED = 64
_RECTANGLE = ("width", "thickness")
# The stations by which a picture shows a bar.
_SHOWN = np.linspace(0.0, 1.0, 17)


class ElasticNumbers(eqx.Module):
    """The kernels of an elastic body, with values that depend on its numbers alone.

    **Fields:** `mass` and `inertia` of the body; coefficients `terms` of the mass matrix by 1, ζ_k, and ζ_k ζ_l, k ≤ l;
    `stiffness` and `damping` (n, n).
    """

    mass: Array
    inertia: Array
    terms: Float[Array, "p m m"]
    stiffness: Float[Array, "n n"]
    damping: Float[Array, "n n"]

    def prepared(self, space: AbstractSpace) -> Self:
        del space
        return self

    def mass_matrix(self, space: AbstractSpace, zeta: Float[Array, "n"]) -> Float[Array, "m m"]:
        rows, columns = np.triu_indices(len(zeta))
        products = unchecked_take(zeta, rows) * unchecked_take(zeta, columns)
        factors = jnp.concatenate([jnp.ones_like(zeta[:1]), zeta, products])
        terms = self.terms.reshape(len(factors), -1).T
        product = vector_products if len(factors) <= _UNROLLED else jnp.matmul
        return product(terms, factors).reshape(self.terms.shape[1:])

    def energy(self, space: AbstractSpace, zeta: Float[Array, "n"]) -> Float[Array, ""]:
        return 0.5 * vector_products(vector_products(self.stiffness, zeta)[None], zeta)[0]

    def internal_force(self, space: AbstractSpace, zeta: Float[Array, "n"], rates: Float[Array, "n"]):
        return -vector_products(self.damping, rates)


def _inertia(d: int, second: Array) -> Float[Array, "... r r"]:
    """Moments of inertia from second moments."""
    turns = _TURNS[d].astype(second.dtype)
    return namespace(second).einsum("rab,qac,...bc->...rq", turns, turns, second)


def _symmetric(x: Array) -> Array:
    return x + jnp.swapaxes(x, -1, -2)


def _pairs(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The indices of products of coordinates, and the number of each in a sum over both, (p, 1, 1)."""
    k, l = np.triu_indices(n)
    return k, l, np.where(k == l, 1.0, 2.0)[:, None, None]


class AbstractElastic(AbstractFlexibleBody):
    """An elastic body, from the mass matrix to the second order in ζ, and from stiffness and damping."""

    @abc.abstractmethod
    def mass_terms(self) -> Float[Array, "p m m"]:
        """The terms of the mass matrix as in `ElasticNumbers`."""

    @abc.abstractmethod
    def matrices(self) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
        """Stiffness and damping by the modal coordinates."""

    def prepared(self, space):
        return ElasticNumbers(self.mass, self.inertia, self.mass_terms(), *self.matrices())

    def mass_matrix(self, space, zeta):
        return self.prepared(space).mass_matrix(space, zeta)

    def energy(self, space, zeta):
        return 0.5 * zeta @ self.matrices()[0] @ zeta

    def internal_force(self, space, zeta, rates):
        return -self.matrices()[1] @ rates


class AbstractElasticBody(AbstractElastic):
    """A body whose points move by linear combinations of modes, in a frame that moves with it.

    **Arguments:**

    - `mass` [kg] > 0, and integrals over the mass of undeformed points x and of displacements ψ_k by a unit of the
        coordinate ζ_k, both in the body's frame, with d = 2 in the plane and 3 in space, for n modes: `first_moment`
        [kg m], ∫x, (d,); `second_moment` [kg m²], ∫x xᵀ, (d, d); `modal_moments` [kg], ∫ψ_k, (n, d); `mixed_moments`
        [kg m], ∫x ψ_kᵀ, (n, d, d); `modal_products` [kg], ∫ψ_k ψ_lᵀ, (n, n, d, d).
    - `stiffness` [N/m], (n, n), positive definite, and `damping` [N s/m], (n, n), default zero.
    - `names` of the modes, default `mode_1`, `mode_2`, …
    """

    mass: fields.Number = fields.parameter(unit="kg", sign="positive")
    first_moment: fields.Number = fields.parameter(shape=("d",), unit="kg m")
    second_moment: fields.Number = fields.parameter(shape=("d", "d"), unit="kg m²")
    modal_moments: fields.Number = fields.parameter(shape=(None, "d"), unit="kg")
    mixed_moments: fields.Number = fields.parameter(shape=(None, "d", "d"), unit="kg m")
    modal_products: fields.Number = fields.parameter(shape=(None, None, "d", "d"), unit="kg")
    stiffness: fields.Number = fields.parameter(shape=(None, None), unit="N/m", sign="positive definite")
    damping: fields.Number = fields.parameter(shape=(None, None), unit="N s/m", optional=True)
    names: tuple[str, ...] = eqx.field(static=True, kw_only=True, default=(), converter=tuple)

    @property
    def modes(self):
        names = self.names or [f"mode_{k}" for k in range(1, self.stiffness.shape[-1] + 1)]
        return tuple(ScalarCoordinate(name, is_length=True, moves=True) for name in names)

    @property
    def inertia(self):
        moments = _inertia(self.dimension, self.second_moment)
        return moments if self.dimension == 3 else moments[0, 0]

    def mass_terms(self):
        d, n = self.modal_moments.shape[::-1]
        turns, (k, l, count) = _TURNS[d].astype(self.mass.dtype), _pairs(n)
        nothing = lambda *shape: jnp.zeros(shape, self.mass.dtype)
        once = lambda matrix: jnp.concatenate([matrix[None], nothing(n + len(k), *matrix.shape)])
        both = jnp.concatenate([self.first_moment[None], self.modal_moments, nothing(len(k), d)])
        swept = jnp.einsum("rab,pb->par", turns, both)
        second = [self.second_moment[None], _symmetric(self.mixed_moments)]
        turned = _inertia(d, jnp.concatenate([*second, count / 2 * _symmetric(self.modal_products[k, l])]))
        # The displacement by mode l of points displaced by mode k.
        mixed = jnp.concatenate([self.mixed_moments[None], self.modal_products])
        turning = jnp.einsum("rab,plba->prl", turns, mixed)
        turning = jnp.concatenate([turning, nothing(len(k), len(turns), n)])
        modal = once(jnp.einsum("klaa->kl", self.modal_products))
        moments, transposed = once(self.modal_moments), lambda x: jnp.swapaxes(x, 1, 2)
        rows = [
            [once(self.mass * jnp.eye(d, dtype=self.mass.dtype)), swept, transposed(moments)],
            [transposed(swept), turned, turning],
            [moments, transposed(turning), modal],
        ]
        return jnp.concatenate([jnp.concatenate(row, axis=2) for row in rows], axis=1)

    def matrices(self):
        return self.stiffness, jnp.zeros_like(self.stiffness) if self.damping is None else self.damping

    def validate(self):
        super().validate()
        n, d = self.stiffness.shape[0], self.dimension
        shapes = {"modal_moments": (n, d), "mixed_moments": (n, d, d), "modal_products": (n, n, d, d)}
        for field, shape in (shapes | {"damping": (n, n)}).items():
            value = fields.values_of(self)[field]
            if value is not None and value.shape != shape:
                raise ValueError(f"{self.label}: {field} of {n} modes must have shape {shape}, got {value.shape}.")
        if len(self.modes) != n:
            raise ValueError(f"{self.label}: {n} modes need as many names, got {', '.join(self.names)}.")
        if is_traced(self.modal_products):
            return
        products = np.einsum("klaa->kl", self.modal_products)
        sizes = np.sqrt(np.maximum(np.diag(products), np.finfo(products.dtype).tiny))
        values, vectors = np.linalg.eigh(products / np.outer(sizes, sizes))
        if values[0] < _INDEPENDENT:
            named = [mode.name for mode, x in zip(self.modes, vectors[:, 0], strict=True) if abs(x) > 1e-3]
            raise ValueError(f"{self.label}: the displacements {', '.join(named)} are linearly dependent; omit one.")

    @classmethod
    def from_nodes(
        cls,
        name: str,
        source: Mapping[str, Any] | str | PathLike[str],
        *,
        interfaces: Mapping[str, Any],
        fixed: int = 0,
        damping: float = 0.0,
        **guess: Any,
    ) -> "tuple[Self, tuple[ModalFrame, ...]]":
        """The body of a finite element model whose nodes have displacements alone, with a frame at each interface.

        The model is reduced by constraint modes of the interfaces and by vibrations with fixed interfaces (R. R. Craig,
        M. C. C. Bampton, AIAA J. 6(7), 1968). An interface has the mean displacement of its nodes, and turns by least
        squares. The body's frame moves with the first interface, so that no mode is a rigid motion. The modes are
        orthogonal, in the order of their frequencies, and the largest displacement of a node by each is one.

        **Arguments:**

        - `source`: a mapping, or a file `.npz`, with the arrays `nodes` [m], (n, d), in the body's frame; `mass` [kg],
            (n,) or (n, n), lumped or consistent, for each direction; `stiffness` [N/m], (n d, n d), of the free body,
            with the displacements of a node side by side. `modes`, (n d, k), replace the reduction if given; the
            frame is then theirs. Matrices may be SciPy's sparse ones; a reduction makes dense ones of them.
        - `interfaces`: indices of nodes by the name of the frame there; `fixed`: the number of vibrations.
        - `damping` [s] ≥ 0: damping over stiffness; further arguments, such as `position`, are those of the body.

        **Returns:** the body, and the frames.

        **Raises:** `ValueError` for matrices that are not symmetric or not positive, modes that depend on each other or
        contain rigid motions, interfaces outside the nodes or without rotations, and more modes than displacements.
        """
        arrays, frames = reduced(f"{cls.__name__} {name!r}", cls.dimensions[0], source, interfaces, fixed)
        body = cls(name, **arrays, damping=damping * arrays["stiffness"], **guess)
        return body, tuple(ModalFrame(frame, name, **numbers) for frame, numbers in frames.items())


class AbstractElasticBar(AbstractElastic):
    """A uniform elastic bar along the x axis of its frame, from the origin; the frame moves with the section there.

    Joints at that end name the body, and others a `BarFrame`. Bending takes the law of Euler and Bernoulli, and draws
    sections towards the origin by half the integral of the squared slope: forces along the bar, and rotation, stiffen
    or buckle it. Deflections are below about a tenth of the length. Two modes of bending and one of stretch bear loads
    at the ends exactly; further modes improve loads between them, and frequencies.

    **Arguments:**

    - `length` [m], `young` [Pa], Young's modulus, and `density` [kg/m³], all > 0.
    - `width` and `thickness` [m] > 0 of a rectangular section; or `area` [m²] > 0 of any section, with its moments.
    - `damping` [s] ≥ 0: the stress in the material is `young (ε + damping dε/dt)`, default 0.
    - `bending`, default 2, and `stretch`, default 0: numbers of modes. The coordinates of the first two modes of
        bending, and of the first of stretch, are displacements of the other end [m].
    """

    length: fields.Number = fields.length(sign="positive")
    young: fields.Number = fields.parameter(unit="Pa", sign="positive")
    density: fields.Number = fields.parameter(unit="kg/m³", sign="positive")
    width: fields.Number = fields.parameter(unit="m", sign="positive", optional=True)
    thickness: fields.Number = fields.parameter(unit="m", sign="positive", optional=True)
    area: fields.Number = fields.parameter(unit="m²", sign="positive", optional=True)
    damping: fields.Number = fields.parameter(unit="s", sign="non-negative", default=0.0)
    bending: int = eqx.field(static=True, kw_only=True, default=2)
    stretch: int = eqx.field(static=True, kw_only=True, default=0)
    torsion: ClassVar[Any] = 0
    # Fields that replace width and thickness; names of bending by direction; turns of sections, (r, directions), by the
    # slopes.
    of_section: ClassVar[tuple[str, ...]]
    bends: ClassVar[tuple[str, ...]]
    turns: ClassVar[np.ndarray]

    @abc.abstractmethod
    def second_moments(self) -> Float[Array, "directions"]:
        """∫ y² and in space ∫ z² over the section [m⁴], which resist bending along y and z."""

    @abc.abstractmethod
    def torsional_rigidity(self) -> Any:
        """The moment [N m] for a twist of one radian per metre."""

    @property
    def sectional_area(self) -> Float[Array, ""]:
        """The area [m²]."""
        return self.width * self.thickness if self.area is None else self.area

    @property
    def mass(self):
        return self.density * self.sectional_area * self.length

    @property
    def modes(self):
        counts = dict.fromkeys(self.bends, self.bending) | {"stretch": self.stretch, "twist": self.torsion}
        named = [(name, f"{name}_{k + 1}") for name, count in counts.items() for k in range(count)]
        return tuple(ScalarCoordinate(name, is_length=kind != "twist", moves=True) for kind, name in named)

    @property
    def _tables(self):
        return bar_tables(self.bending, self.stretch, self.torsion)

    def validate(self):
        values = fields.values_of(self)
        for name in ("bending", "stretch", "torsion"):
            count = values.get(name, 0)
            if not isinstance(count, int | np.integer) or not 0 <= count <= _MOST_MODES:
                raise ValueError(f"{self.label}: {name} must be a number of modes to {_MOST_MODES}, got {count!r}.")
        if not self.modes:
            raise ValueError(f"{self.label} has no modes; a bar without deformation is a Body.")
        rectangle, other = ([values[name] is not None for name in names] for names in (_RECTANGLE, self.of_section))
        if all(rectangle) == all(other) or (any(rectangle) and any(other)):
            raise ValueError(f"{self.label}: give width and thickness, or {', '.join(self.of_section)} in their place.")
        super().validate()

    def _split(self, zeta):
        """The coordinates of bending, by direction, of stretch and of torsion."""
        directions, xp = len(self.bends), namespace(zeta)
        bends, stretch, twist = xp.split(zeta, np.cumsum([directions * self.bending, self.stretch]))
        return bends.reshape(directions, self.bending), stretch, twist

    def _line(self, shapes: BarShapes, stations, zeta):
        """Points of the centre line [m], (s, d)."""
        bends, stretch, _ = self._split(zeta)
        xp = namespace(stations, zeta, self.length)
        drawn = xp.einsum("sij,ai,aj->s", shapes.shortening, bends, bends) / (2 * self.length)
        along = self.length * stations + shapes.stretch @ stretch - drawn
        return xp.concatenate([along[:, None], shapes.bend @ bends.T], axis=1)

    def _section_turns(self, shapes: BarShapes):
        """Turns of the sections [rad] by unit coordinates, (s, r, n)."""
        xp, (s, _), r = namespace(shapes.slope, self.length), shapes.slope.shape, len(self.turns)
        bent = xp.einsum("ra,si->srai", self.turns, shapes.slope).reshape(s, r, -1) / self.length
        twisted = shapes.twist[:, None] * np.eye(r)[None, :, :1]
        return xp.concatenate([bent, np.zeros((s, r, self.stretch)), twisted], axis=2)

    def _line_moves(self, shapes: BarShapes):
        """Displacements of the centre line by unit coordinates, (s, d, n)."""
        xp, (s, _), d = namespace(shapes.bend), shapes.bend.shape, self.dimension
        across = xp.einsum("ab,si->sabi", np.eye(d)[:, 1:], shapes.bend).reshape(s, d, -1)
        along = shapes.stretch[:, None] * np.eye(d)[None, :, :1]
        return xp.concatenate([across, along, np.zeros((s, d, self.torsion))], axis=2)

    @property
    def inertia(self):
        along = jnp.reshape(self.mass * self.length**2 / 3, (1,))
        moments = self.density * self.length * self.second_moments()
        matrix = _inertia(self.dimension, jnp.diag(jnp.concatenate([along, moments])))
        return matrix if self.dimension == 3 else matrix[0, 0]

    def mass_terms(self):
        # Velocities by those of the body, of points of the centre line, and by a unit distance from it across the bar:
        # (1 or d, stations, d, m), to the second order in ζ.
        tables, d, n = self._tables, self.dimension, len(self.modes)
        turns, stations, (k, l, count) = _TURNS[d], tables.stations, _pairs(n)
        swept = lambda x: jnp.einsum("rab,...b->...ar", turns, x)
        line = jnp.outer(self.length * stations, np.eye(d)[0])
        places = jnp.concatenate([line[None], np.broadcast_to(np.eye(d)[1:, None], (d - 1, *line.shape))])
        across = jnp.einsum("rab,srn->bsan", turns, self._section_turns(tables.shapes))[1:]
        moves = jnp.concatenate([jnp.asarray(self._line_moves(tables.shapes))[None], across])
        carried = np.zeros((d, len(stations), d, d))
        carried[0] = np.eye(d)
        at_rest = jnp.concatenate([carried, swept(places), moves], axis=3)
        # The displacement along the bar, half of `drawn` by the products of two coordinates.
        drawn = np.kron(np.eye(d - 1), -tables.shapes.shortening) / self.length
        drawn = jnp.pad(drawn, ((0, 0), *((0, self.stretch + self.torsion),) * 2))
        axis = np.eye(d)[0]
        shortened = jnp.einsum("skn,a->ksan", drawn, axis)[:, None]
        shortened = jnp.pad(shortened, ((0, 0), (0, d - 1), (0, 0), (0, 0), (0, 0)))
        still = jnp.zeros((n, d, len(stations), d, d), moves.dtype)
        first = jnp.concatenate([still, swept(jnp.moveaxis(moves, 3, 0)), shortened], axis=4)
        turned = swept(jnp.einsum("sp,a->psa", drawn[:, k, l], axis))
        second = jnp.pad(turned, ((0, 0), (0, 0), (0, 0), (d, n)))
        sides = jnp.concatenate([jnp.reshape(self.sectional_area, (1,)), self.second_moments()])
        weights = self.density * self.length * jnp.outer(sides, jnp.asarray(tables.weights))
        product = lambda x, y: jnp.einsum("cs,...csai,...csaj->...ij", weights, x, y)
        of_pairs = product(first[k], first[l]) + jnp.einsum("s,psai,saj->pij", weights[0], second, at_rest[0])
        by_one = _symmetric(product(first, jnp.broadcast_to(at_rest, first.shape)))
        return jnp.concatenate([product(at_rest, at_rest)[None], by_one, count / 2 * _symmetric(of_pairs)])

    def matrices(self):
        bend, stretch, twist = self._tables.stiffness
        bends = jnp.outer(self.young * self.second_moments(), jnp.asarray(bend)) / self.length**3
        along = self.young * self.sectional_area * stretch / self.length
        twists = self.torsional_rigidity() * twist / self.length
        stiffness = jnp.diag(jnp.concatenate([bends.reshape(-1), along, twists]))
        return stiffness, self.damping * stiffness

    def section(self, station: Any, zeta: Float[Array, "n"]) -> tuple[Float[Array, "d"], Float[Array, "r"]]:
        """The place [m] of a section in the body's frame, and its turn [rad]."""
        # Unrolled products, which compile to fewer kernels than general ones.
        shapes = shapes_at(self._tables, station[None])
        moves, turns = self._line_moves(shapes)[0], self._section_turns(shapes)[0]
        xp, d = namespace(moves, zeta, self.length), self.dimension
        curving = xp.kron(np.eye(d - 1), shapes.shortening[0]) / (2 * self.length)
        bends = zeta[: len(curving)]
        drawn = vector_products(vector_products(curving, bends)[None], bends)
        along = self.length * station - drawn
        moved = vector_products(xp.concatenate([moves, turns]), zeta)
        return xp.concatenate([along, np.zeros(d - 1)]) + moved[:d], moved[d:]

    def line(self, space, zeta):
        del space
        return self._line(shapes_at(self._tables, _SHOWN), _SHOWN, zeta)

    def strain(self, station: Any, offset: Float[Array, "directions"], zeta: Float[Array, "n"]) -> Float[Array, ""]:
        """The strain along the bar at a place of the section [m] across it."""
        shapes = shapes_at(self._tables, station[None])
        bends, stretch, _ = self._split(zeta)
        curvature = bends @ shapes.curvature[0] / self.length**2
        return shapes.strain[0] @ stretch / self.length - offset @ curvature


class BarFrame(AbstractFlexibleFrame):
    """A frame in a section of an `ElasticBar`, which moves and turns with it.

    ```python
    rod = planar.ElasticBar("rod", length=1.0, young=2e11, density=7800.0, width=0.02, thickness=0.01)
    tip, gauge = planar.BarFrame("tip", "rod"), planar.BarFrame("gauge", "rod", station=0.1, offset=0.005)
    clamp = planar.Fixed("clamp", "ground", "rod", point=(0.0, 0.0))
    pull = planar.PointForce("pull", "tip", force=(0.0, 5.0))
    system = jaxmb.Scene([rod], joints=[clamp], forces=[pull], frames=[tip, gauge]).compile()
    ```

    Along a motion it has the quantities of a `Frame`, `deflection` [m], the displacement of its origin in the body's
    axes, and `strain` and `stress` [Pa] along the bar at its origin, without damping.

    **Arguments:** `body`: the name of the bar; `station` of the section, from 0 to 1, default 1, the other end;
    `offset` [m] of the origin across the bar: a number in the plane, shape (2,) in space, default on the centre line.
    """

    station: fields.Number = fields.parameter(unit="1", sign="non-negative", default=1.0)
    offset: fields.Number = fields.parameter(shape=None, unit="m", optional=True)
    bar: Any = fields.part(AbstractElasticBar)
    quantities = MappingProxyType({**AbstractFlexibleFrame.quantities, "strain": (), "stress": ()})

    def validate(self):
        if not is_traced(self.station) and self.station > 1:
            raise ValueError(f"{self.label}: station must be from 0 to 1, the ends of the bar, got {self.station}.")

    def placed(self, body):
        if not isinstance(body, AbstractElasticBar):
            raise ValueError(f"{self.label}: {self.body!r} is a {body.kind}; a BarFrame is in an ElasticBar.")
        shape = () if body.dimension == 2 else (2,)
        frame = self.filled(offset=np.zeros(shape)).with_fields(bar=body)
        if frame.offset.shape != shape:
            raise ValueError(f"{self.label}: offset must have shape {shape}, got {frame.offset.shape}.")
        return frame

    def _across(self):
        return self.offset.reshape(-1)

    def pose_at(self, space, pose, zeta):
        section = space.displaced(pose, *self.bar.section(self.station, zeta))
        xp = namespace(section, self.offset)
        offset = xp.concatenate([xp.zeros(1, section.dtype), self._across()])
        return xp.concatenate([space.point(section, offset), section[space.dimension :]])

    def measured(self, space, zeta):
        strain = self.bar.strain(self.station, self._across(), zeta)
        return super().measured(space, zeta) | {"strain": strain, "stress": self.bar.young * strain}


class ModalFrame(AbstractFlexibleFrame):
    """A frame in an `ElasticBody`, which moves and turns by the modes.

    ```python
    bob = planar.ModalFrame("bob", "rocker", position=(1.0, 0.0), shapes=((0.0,), (1.0,)), turning=((1.5,),))
    pull = planar.PointForce("pull", "bob", force=(0.0, 5.0))
    system = jaxmb.Scene([rocker], forces=[pull], frames=[bob]).compile()
    ```

    Along a motion it has the quantities of a `Frame`, and `deflection` [m], the displacement of its origin in the
    body's axes.

    **Arguments:** `body`: the name of the elastic body; in its frame the undeformed `position` [m], (d,), of the
    origin, with axes parallel to the body's; its displacements `shapes`, (d, n), and its small rotations `turning`
    [rad/m], (1, n) in the plane and (3, n) in space, by unit modal coordinates.
    """

    position: fields.Number = fields.point(body=0, sizes=False)
    shapes: fields.Number = fields.parameter(shape=("d", None), unit="1")
    turning: fields.Number = fields.parameter(shape=(None, None), unit="rad/m")

    def placed(self, body):
        n, r = len(body.modes), len(_TURNS[body.dimension])
        if self.shapes.shape[-1] != n or self.turning.shape != (r, n):
            raise ValueError(
                f"{self.label}: shapes and turning of {n} modes must have shapes {(body.dimension, n)} and {(r, n)}, "
                f"got {self.shapes.shape} and {self.turning.shape}."
            )
        return self

    def pose_at(self, space, pose, zeta):
        return space.displaced(pose, self.position + self.shapes @ zeta, self.turning @ zeta)
