"""Charts of the constraint manifold: independent coordinates and velocities, from which the others follow."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from .._types import Scalar, State
from ..formulations import Partitioned
from ..formulations.formulation import row_levels
from ..linalg.arrays import is_traced
from ..linalg.elimination import Factor, PivotOrder, eliminate, full_pivot
from ..parts.names import unknown
from ..system import AbstractSystem
from ..system.equation import AbstractEquation
from ..system.instant import Instant
from ..system.quantities import rates_of, single_names
from .chart_constraints import acceleration
from .split import AbstractSplit, kind_of_split, quality_of, solve_positions

# The preference of named coordinates as independent ones: they take part in pivots with this scale.
_PREFERRED = 1e-6
# Newton's corrections of velocities, if constraints are not linear in them; their last is below this power of eps.
_CORRECTIONS, _SMALL = 6, 0.5
# No state is beyond this quality: a motion that passes the border of a chart comes back on another branch.
_LOST = 100.0
# The largest violation of the constraints at the state of a chart, relative to the system's size and speed.
_TOLERANCE = 1e-5


class Chart(eqx.Module):
    """Independent coordinates of a system near a state, and the equations of motion in them.

    ```python
    chart = jaxmb.manifold.Chart.at(system, 0.0, state)
    x = chart.coordinates(state)
    rates = chart.field(0.0, x)  # SciPy's solve_ivp and diffrax take chart.field as it is.
    ```

    The vector x has independent coordinates, independent velocities and internal states, in the order of `names`. The
    other coordinates and velocities satisfy the constraints to rounding. All functions run under `jit` and `vmap`, and
    have derivatives by the implicit function theorem: by x, the time and the parameters of `system`, which may be
    replaced by one of the same structure (`chart.on(other)`).

    **Fields:** the `system`; the state `origin` where the chart was made, in whose neighbourhood it holds; `indices`:
    the places of x in the vector of all coordinates, velocities and internal states; `split`: the order of elimination;
    `fresh`: its quality at the origin.
    """

    system: AbstractSystem
    origin: State
    indices: Int[Array, "n"]
    split: AbstractSplit
    fresh: Float[Array, "k"]

    @classmethod
    def at(cls, system: AbstractSystem, t: Scalar, state: State, independent: Sequence[str] = ()) -> "Chart":
        """The chart in which dependent coordinates change least with the independent ones, by full pivoting.

        **Arguments:** `independent`: names of coordinates that must be independent, with their rates; the others are
        chosen.

        **Raises:** `ValueError` for a state of another system or off the constraints, at a singular position, and for
        coordinates that are not independent; outside of `jit` and `vmap`.
        """
        _check_sizes(system, state)
        state = State(jnp.asarray(state.q), jnp.asarray(state.u), state.z)
        preferred = _preferred(system, independent)
        parts, singular, violation = _chosen(system, t, state, preferred)
        chart = cls(system, state, *parts)
        if not is_traced((system, t, state)):
            _check(chart, t, float(violation), bool(singular), independent, preferred)
        return chart

    def on(self, system: AbstractSystem) -> "Chart":
        """The chart with the same independent coordinates, of a system with other parameters."""
        return eqx.tree_at(lambda chart: chart.system, self, system)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the entries of x."""
        system = self.system
        coordinates = single_names(system.coordinate_names(), system.nq)
        every = (
            coordinates + single_names(system.rate_names(), system.nu) + single_names(system.state_names(), system.nz)
        )
        return tuple(every[k] for k in np.asarray(self.indices))

    def coordinates(self, state: State) -> Float[Array, "n"]:
        """The independent coordinates x of a state, or the rates of x from the rates of a state."""
        return _joined(state)[0][self.indices]

    def state(self, t: Scalar, x: Float[Array, "n"], near: State | None = None) -> State:
        """The state on the constraints with independent coordinates x.

        **Arguments:** `near`: a state from which the search for the dependent coordinates starts, default the origin.

        **Returns:** the state; NaN where the search fails, where rows that others implied are violated, and beyond a
        `quality` of 100.
        """
        return _state(self, t, x, near)[0].state

    def field(self, t: Scalar, x: Float[Array, "n"], near: State | None = None) -> Float[Array, "n"]:
        """The rates of x by the equations of motion; NaN where no state is found. Arguments as of `state`."""
        return self.moving(t, x, near)[1]

    def moving(self, t: Scalar, x: Float[Array, "n"], near: State | None = None) -> tuple[State, Float[Array, "n"]]:
        """The state on the constraints, as `state`, and the rates of x there, as `field`; both in one computation."""
        return _moving(self, t, x, near)

    def quality(self, t: Scalar, state: State) -> Float[Array, ""]:
        """How much more dependent coordinates change with the independent ones than at the origin: 1 there. From about
        2 on another chart serves better; infinite where the constraints lose rank in this chart.
        """
        return _growth(self, Instant.of(self.system, t, state))


@eqx.filter_jit
def _chosen(system, t, state, preferred):
    at = Instant.of(system, jnp.asarray(t, state.q.dtype), state)
    split, quality, singular = choose(at, at.coordinate_jacobian, preferred)
    violation = _violation(at) if system.velocity_rows else jnp.zeros((), state.q.dtype)
    # In the order of the coordinates and velocities.
    velocities = jnp.sort(split.velocity.columns[system.velocity_rank :]) + system.nq
    states = system.nq + system.nu + np.arange(system.nz)
    indices = [jnp.asarray(x, jnp.int32) for x in (jnp.sort(split.independent(system)), velocities, states)]
    return (jnp.concatenate(indices), split, quality[:-1]), singular, violation


def _violation(at):
    """The largest violation of the constraints, relative to the system's size and speed."""
    return jnp.max(jnp.concatenate(at.violations(at.row_sizes())))


def _joined(state):
    """Coordinates, velocities and internal states in one vector, and the inverse of this function."""
    return ravel_pytree(State(state.q, state.u, state.z))


@eqx.filter_jit
def _state(chart, t, x, near):
    """The instant on the constraints, and whether the search for it failed."""
    system, start = chart.system, lax.stop_gradient(chart.origin if near is None else near)
    joined, state_of = _joined(start)
    at = Instant.of(system, jnp.asarray(t, joined.dtype), state_of(joined.at[chart.indices].set(x)))
    q, failed = solve_positions(at, chart.split)
    at = at.with_(q=q)
    step = jnp.zeros_like(at.u)
    for _ in range(1 if system.linear else _CORRECTIONS):
        jacobian = at.jacobian[: system.velocity_rows]
        factor = eliminate(jacobian, chart.split.velocity, system.velocity_rank)
        step = factor.right_inverse @ at.velocity_residual
        at = at.with_(u=at.u - step)
    if not system.linear:
        small = jnp.finfo(q.dtype).eps ** _SMALL * jnp.max(jnp.abs(at.u), initial=1.0)
        failed = failed | ~(jnp.max(jnp.abs(step), initial=0.0) <= small)
    if system.velocity_rank < system.velocity_rows:
        # Rows that others implied hold only if the parameters agree with each other.
        failed = failed | ~(lax.stop_gradient(_violation(at)) <= _TOLERANCE)
    failed = failed | ~(lax.stop_gradient(_growth(chart, at)) <= _LOST)
    valid = jnp.where(failed, jnp.nan, 1.0).astype(q.dtype)
    return at.with_(q=at.q * valid, u=at.u * valid), failed


def _check_sizes(system, state):
    sizes = [(np.shape(x), n) for x, n in ((state.q, system.nq), (state.u, system.nu))]
    if any(shape != (n,) for shape, n in sizes):
        raise ValueError(
            f"Chart.at: the state is of another system: it has {sizes[0][0]} coordinates and {sizes[1][0]} velocities, "
            f"and the system ({system.nq},) and ({system.nu},)."
        )


def _preferred(system, independent):
    """Which coordinates and velocities must be independent, or None without any."""
    if isinstance(independent, str):
        raise ValueError(f"Chart.at: independent takes a list of names: [{independent!r}].")
    if not independent:
        return None
    known, rates = system.coordinate_names(), rates_of(system.rate_names())
    coordinates, velocities = np.zeros(system.nq, bool), np.zeros(system.nu, bool)
    for name in independent:
        if name not in known:
            raise ValueError(unknown("coordinate", name, known))
        coordinates[known[name]] = True
        velocities[rates.get(f"{name}_rate", [])] = True
    return coordinates, velocities


def _check(chart, t, violation, singular, independent, preferred):
    system = chart.system
    if not violation <= _TOLERANCE:
        raise ValueError(
            f"Chart.at: the state violates the constraints by {violation:.3g}, relative to the system's size and "
            f"speed, at t = {float(t):g}. state = jaxmb.assemble(system, state, t=t) makes it consistent."
        )
    if singular:
        raise ValueError(
            f"Chart.at: the constraints lose rank at the state, at t = {float(t):g}: a singular position, such as a "
            "linkage that lies flat, has no chart. Take a state beside it."
        )
    if preferred is not None:
        wanted = np.flatnonzero(np.concatenate(preferred))
        dependent = np.setdiff1d(wanted, np.asarray(chart.indices))
        if dependent.size:
            free = chart.indices.size - system.nz
            raise ValueError(
                f"Chart.at: the coordinates {', '.join(independent)} or their rates are not independent. The system "
                f"has {free} independent coordinates and velocities, here {', '.join(chart.names[:free])}."
            )


def choose(at: Instant, of_coordinates: Any, preferred: Any = None) -> tuple[AbstractSplit, Array, Any]:
    """A split by full pivoting, its quality, and whether the rank is less than when the scene was compiled.

    The rank may be higher: at a state within Newton's tolerance, redundant rows are only nearly redundant.

    **Arguments:** `of_coordinates`: the coordinates' Jacobian, None if coordinates and velocities share a split;
    `preferred`: which coordinates and velocities should be independent, default none.
    """
    system, jacobian, rows = at.system, at.jacobian, at.system.velocity_rows
    scale, levels = system.velocity_scale(), row_levels(system)
    of_pivots = None, scale
    if preferred is not None:
        pairs = zip((system.coordinate_scale(), scale), preferred, strict=True)
        of_pivots = tuple(jnp.where(wanted, _PREFERRED * x, x) for x, wanted in pairs)
    velocity = full_pivot(jacobian[:rows], scale=of_pivots[1], level=levels[:rows])
    singular = velocity.rank < system.velocity_rank
    solved = eliminate(jacobian[:rows], velocity.order, system.velocity_rank)
    quality = velocity_quality(system, solved, velocity.order)
    acceleration = None
    if system.acceleration_rows > rows:
        every = full_pivot(jacobian, scale=of_pivots[1], level=levels)
        acceleration, singular = every.order, singular | (every.rank < system.acceleration_rank)
    orders = velocity.order, acceleration
    split, quality, lost = kind_of_split(system).chosen(at, of_coordinates, orders, solved, quality, of_pivots[0])
    return split, quality, singular | lost


@eqx.filter_jit
def _moving(chart, t, x, near):
    at, failed = _state(chart, t, x, near)
    out = acceleration(at, Partitioned(), chart.split)
    at = at.with_(u=out.u)
    rates = chart.coordinates(at.motion(out.udot))
    return at.state, rates * jnp.where(failed | out.failed, jnp.nan, 1.0).astype(rates.dtype)


def _growth(chart, at):
    """The quality of a chart at an instant, relative to its quality at the origin."""
    system, split = at.system, chart.split
    solved = eliminate(at.jacobian[: system.velocity_rows], split.velocity, system.velocity_rank)
    now = split.quality(at, velocity_quality(system, solved, split.velocity))[:-1]
    return jnp.max(jnp.where(jnp.isfinite(now), now / jnp.maximum(chart.fresh, 1.0), jnp.inf))


def velocity_quality(system: AbstractEquation, solved: Factor, order: PivotOrder) -> Float[Array, "k"]:
    """The quality of velocities in a chart, as of `quality_of`, and the nearness to a loss of rank.

    This is the largest diagonal entry of the inverse in the elimination.
    """
    solved, rank = lax.stop_gradient(solved), system.velocity_rank
    diagonal = solved.right_inverse.at[order.columns[:rank], order.rows[:rank]]
    nearness = jnp.max(jnp.abs(diagonal.get(mode="promise_in_bounds", wrap_negative_indices=False)), initial=0.0)
    return jnp.append(quality_of(system, solved, system.velocity_scale(), order, rank), nearness)
