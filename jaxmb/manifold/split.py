"""The return of coordinates to the position constraints in a chart, in which some coordinates depend on the others.

There are three kinds of splits: coordinates that share the split of the velocities, coordinates with another split, and
coordinates that are all independent, without position constraints.
"""

import abc
import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._branches import cond_of_lanes
from ..linalg.elimination import Factor, PivotOrder, eliminate, full_pivot
from ..linalg.newton import chord, newton
from ..system.equation import AbstractEquation
from ..system.instant import Instant
from .constraints import dense_along, push

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar

# Largest number of Newton iterations for positions.
_MAX_ITERATIONS = 12
# The size of the last step of Newton's method, as a power of eps: the error is of the size of its square.
_LAST = 0.6

# Coordinates on the constraints, the number of Newton's iterations, and whether they failed.
Restored = tuple[Float[Array, "nq"], Int[Array, ""] | None, Bool[Array, ""] | None]


class AbstractSplit(eqx.Module):
    """The index sets of a chart.

    **Fields:** `velocity`: order of elimination of the velocities' Jacobian; `acceleration`: order of all rows of A,
    None if no row binds accelerations only; `ages`: whether the stored matrix belongs to an earlier state.
    """

    velocity: AbstractVar[PivotOrder]
    acceleration: AbstractVar[PivotOrder | None]
    ages: ClassVar[bool] = False

    @classmethod
    @abc.abstractmethod
    def chosen(
        cls,
        at: Instant,
        of_coordinates: Float[Array, "mq nq"] | None,
        orders: tuple[PivotOrder, PivotOrder | None],
        solved: Factor,
        quality: Float[Array, "k"],
        scale: Float[Array, "nq"] | None = None,
    ) -> tuple[Self, Float[Array, "k"], Any]:
        """The split with these orders of velocities and accelerations; the quality, with the coordinates included;
        whether the coordinates have lost rank.

        **Arguments:** `of_coordinates`: the coordinates' Jacobian, None if the split does not age; `solved`: the factor
        of the velocities' Jacobian, and its `quality`; `scale` of the coordinates in the search for pivots, by default
        the system's.
        """

    @abc.abstractmethod
    def independent(self, system: AbstractEquation) -> Int[Array, "free"]:
        """The independent coordinates."""

    @abc.abstractmethod
    def correct(self, at: Instant) -> Instant:
        """Coordinates nearer to the constraints, by one correction with the stored matrix."""

    @abc.abstractmethod
    def restore(self, at: Instant, outdated: Any, tol: Any) -> Restored:
        """See `restore_positions`."""

    @abc.abstractmethod
    def push(self, at: Instant, along: Instant, factor: Factor | None) -> Float[Array, "nq"]:
        """The tangent of coordinates on the constraints, from the tangent before the restoration.

        **Arguments:** `factor` of the velocities' Jacobian, if it is known.
        """

    @abc.abstractmethod
    def factor(self, at: Instant) -> Factor:
        """The factor of the coordinates' Jacobian at an instant."""

    def quality(self, at: Instant, of_velocities: Float[Array, "k"]) -> Float[Array, "k"]:
        """The quality at an instant, from the quality of the velocities there."""
        del at
        return of_velocities

    def at_evaluation(self, factor: Factor) -> Self:
        """The split at a state, from the factor of the velocities' Jacobian there."""
        del factor
        return self

    def at_guess(self, at: Instant) -> Self:
        """The split at a state without an evaluation."""
        del at
        return self

    def orders(self) -> Self:
        """The orders of elimination alone."""
        return self


class Independent(AbstractSplit):
    """The split of a system without position constraints and invariants."""

    velocity: PivotOrder
    acceleration: PivotOrder | None

    @classmethod
    def chosen(cls, at, of_coordinates, orders, solved, quality, scale=None):
        return cls(*orders), quality, False

    def independent(self, system):
        return jnp.arange(system.nq, dtype=self.velocity.packed.dtype)

    def correct(self, at):
        return at

    def factor(self, at):
        n = at.q.size
        return Factor(jnp.zeros((n, 0), at.q.dtype), jnp.eye(n, dtype=at.q.dtype), jnp.zeros(0, int))

    def restore(self, at, outdated, tol):
        return at.q, jnp.array(0), jnp.array(False)

    def push(self, at, along, factor):
        return along.q


class Shared(AbstractSplit):
    """The split of velocities, shared by the coordinates: q̇ = u, and no row binds velocities only.

    **Fields:** `right_inverse` of the velocities' Jacobian at the last evaluation.
    """

    velocity: PivotOrder
    acceleration: PivotOrder | None
    right_inverse: Float[Array, "nq mq"]

    @classmethod
    def chosen(cls, at, of_coordinates, orders, solved, quality, scale=None):
        return cls(*orders, solved.right_inverse), quality, False

    def independent(self, system):
        return self.velocity.columns[system.coordinate_rank :]

    def correct(self, at):
        return at.with_(q=at.q - self.right_inverse @ at.coordinate_residual)

    def restore(self, at, outdated, tol):
        # The factor belongs to this time, and is wrong by the first correction only.
        return _newton(at, self.right_inverse, 1.0, tol)

    def push(self, at, along, factor):
        return _pushed(self.factor(at) if factor is None else factor, at, along)

    def factor(self, at):
        return eliminate(at.coordinate_jacobian, self.velocity, at.system.coordinate_rank)

    def at_evaluation(self, factor):
        return Shared(self.velocity, self.acceleration, factor.right_inverse)

    def at_guess(self, at):
        # The stored matrix belongs to the state before the step.
        return self.at_evaluation(self.factor(at))

    def orders(self):
        return eqx.tree_at(lambda split: split.right_inverse, self, None)


class Separate(AbstractSplit):
    """The split of velocities, and another split of coordinates.

    **Fields:** `coordinate`: order of elimination of the coordinates' Jacobian; its `right_inverse`, at a state of this
    step or of an earlier one.
    """

    velocity: PivotOrder
    acceleration: PivotOrder | None
    coordinate: PivotOrder
    right_inverse: Float[Array, "nq mq"]
    ages: ClassVar[bool] = True

    @classmethod
    def chosen(cls, at, of_coordinates: Any, orders, solved, quality, scale=None):
        system = at.system
        scale = system.coordinate_scale() if scale is None else scale
        pivots = full_pivot(of_coordinates, scale=scale)
        split, of_split, _ = cls(*orders, pivots.order, jnp.zeros(())).refreshed(system, of_coordinates)
        return split, quality.at[:-1].max(of_split), pivots.rank < system.coordinate_rank

    def independent(self, system):
        return self.coordinate.columns[system.coordinate_rank :]

    def correct(self, at):
        return at.with_(q=at.q - self.right_inverse @ at.coordinate_residual)

    def restore(self, at, outdated, tol):
        # The error of an older matrix is unknown.
        restored = _newton(at, self.right_inverse, 0.0, tol)

        def with_factor_of_this_state(restored):
            corrected, iterations, failed = _newton(at, self.factor(at).right_inverse, 1.0, tol)
            return corrected, restored[1] + iterations, failed

        return cond_of_lanes(restored[2] | outdated, with_factor_of_this_state, lambda restored: restored, restored)

    def push(self, at, along, factor):
        del factor
        return _pushed(self.factor(at), at, along)

    def factor(self, at):
        return eliminate(at.coordinate_jacobian, self.coordinate, at.system.coordinate_rank)

    def quality(self, at, of_velocities):
        of_split = self.refreshed(at.system, at.coordinate_jacobian)[1]
        return of_velocities.at[:-1].max(of_split)

    def refreshed(
        self, system: AbstractEquation, jacobian: Float[Array, "mq nq"]
    ) -> tuple["Separate", Float[Array, "k"], Factor]:
        """The split with the matrix of a state, from the coordinates' Jacobian there; its quality and its factor."""
        solved = eliminate(jacobian, self.coordinate, system.coordinate_rank)
        quality = quality_of(system, solved, system.coordinate_scale(), self.coordinate, system.coordinate_rank)
        return dataclasses.replace(self, right_inverse=solved.right_inverse), quality, solved

    def orders(self):
        return eqx.tree_at(lambda split: split.right_inverse, self, None)


def kind_of_split(system: AbstractEquation) -> type[AbstractSplit]:
    """The class of the splits of a system."""
    if system.coordinate_rank == 0:
        return Independent
    shared = system.rates_are_velocities and system.velocity_rows == system.position_rows
    return Shared if shared else Separate


@eqx.filter_custom_jvp
def restore_positions(at: Instant, split: AbstractSplit, outdated: Bool[Array, ""], tol: float) -> Restored:
    """Solve `Φ = 0` for the dependent coordinates by the chord method: `(q, iterations, failed)`.

    **Arguments:** `outdated`: whether the stored matrix is known to be useless here.
    """
    return split.restore(at, outdated, tol)


@restore_positions.def_jvp
def _restore_positions_jvp(primals, tangents):
    at, split, *_ = primals
    out = restore_positions(*primals)
    along, at = dense_along(tangents[0], at), at.with_(q=out[0])
    return out, (split.push(at, along, None), None, None)


@eqx.filter_custom_jvp
def solve_positions(at: Instant, split: AbstractSplit) -> tuple[Float[Array, "nq"], Bool[Array, ""]]:
    """Solve `Φ = 0` for the dependent coordinates from a guess that may be far: q, and whether the search failed."""
    scale, small = at.system.coordinate_scale(), jnp.finfo(at.q.dtype).eps ** _LAST

    def correct(q):
        here = at.with_(q=q)
        step = split.factor(here).right_inverse @ here.coordinate_residual
        return q - step, jnp.max(jnp.abs(step) / scale)

    far = lambda q, size: (size > small) & jnp.all(jnp.isfinite(q))
    q, size = newton(correct, far, at.q, most=_MAX_ITERATIONS, dtype=at.q.dtype)
    return q, ~(size <= small)


@solve_positions.def_jvp
def _solve_positions_jvp(primals, tangents):
    at, split = primals
    out = solve_positions(*primals)
    along, at = dense_along(tangents[0], at), at.with_(q=out[0])
    return out, (split.push(at, along, None), None)


def _newton(at, right_inverse, first, tol):
    scale = at.system.coordinate_scale()

    def correct(q):
        step = right_inverse @ at.with_(q=q).coordinate_residual
        return q - step, jnp.max(jnp.abs(step) / scale)

    return chord(correct, at.q, first=jnp.full((), first, at.q.dtype), tol=tol, most=_MAX_ITERATIONS, peel=True)


def _pushed(factor, at, along):
    """The tangent of coordinates on the constraints, from their factor there."""
    return along.q - factor.right_inverse @ push(lambda at: at.coordinate_residual, (at,), (along,))


def quality_of(
    system: AbstractEquation, solved: Factor, scale: Float[Array, "n"], order: PivotOrder, rank: int
) -> Float[Array, "k"]:
    """The quality of a factor: its largest |H| in units of the `scale`; with redundant rows also the largest entry of
    the solution of the others.
    """
    influence = jnp.abs(solved.null_space) * scale[order.columns[rank:]][None, :] / scale[:, None]
    largest = [jnp.max(influence, initial=1.0)]
    if system.velocity_rank < system.velocity_rows:
        largest.append(jnp.max(jnp.abs(solved.right_inverse) / scale[:, None], initial=0.0))
    return jnp.stack(largest)
