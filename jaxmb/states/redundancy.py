"""Checks that rows that others imply at the given pose are implied near it as well.

Where rows lose rank, some of them are implied by the others. Near a regular pose they stay so, and may be left out; at
a singular one (a straight truss, a four-bar with all joints on one line, q₀ q₁ = 0 at the origin) they do not, and the
mechanism without them is another one. The kept rows are independent, so nearby states of them are found by Newton's
method: there the rows left out must hold, and their gradients must depend on those of the kept rows.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from .._types import Coordinates
from ..linalg.independent_rows import independent_in_order
from ..system import AbstractSystem

# Number of displaced poses, and the displacement in scales of the coordinates as a power of eps: 1e-2 in double
# precision. A row that is implied at a singular pose only differs by the displacement or its square.
_POSES = 3
_DISPLACEMENT = 1 / 8
# The largest relative difference that counts as zero, as a power of eps: 1e-6.
ZERO = 3 / 8
# Rows that depend on time are followed to these times [s], as far as the coordinates move less than this.
_TIMES = tuple(10.0**k for k in range(-9, 7))
_NEAR = 0.2
# Largest number of steps of Newton's method.
_ITERATIONS = 10


def check_gradients(system: AbstractSystem, sizes: Float[np.ndarray, "m"]) -> None:
    """Raise a `ValueError` naming the rows of A that are zero, from the norms of all rows."""
    zero = sizes <= np.finfo(sizes.dtype).eps ** 0.75 * np.max(sizes, initial=0.0)
    if np.any(zero):
        listed = ", ".join(f"row {k} of {name}" for (name, k), z in zip(system.rows, zero, strict=True) if z)
        raise ValueError(
            f"At the given poses and velocities the gradient of {listed} is zero, so it binds nothing there: they are "
            "singular. Give others, or write the constraint without products or powers that vanish with it."
        )


class DependentRows(NamedTuple):
    """Rows of A that depend on each other only.

    **Fields:** the `rows`; `independent` ones among them; `positions`: independent rows of Φ, also those that keep
    invariants of the coordinates; all by their numbers among the rows of A, or of the coordinates.
    """

    rows: Int[np.ndarray, "m"]
    independent: Int[np.ndarray, "r"]
    positions: Int[np.ndarray, "p"]


class Nearby(NamedTuple):
    """What is known at a displaced configuration.

    **Fields:** `unmet`: Φ, and the coordinates' invariants; `step(number, rows)`: the smallest displacement of a group,
    to first order, to where these of its positions are met; `remains(number, kept, dropped)`: what remains of rows of A
    that are no sum of others.
    """

    unmet: Float[np.ndarray, "mq"]
    step: Callable[[int, np.ndarray], np.ndarray]
    remains: Callable[[int, np.ndarray, np.ndarray], "Remains"]


class Remains(NamedTuple):
    """Residuals of rows of unit norm after least squares by other rows.

    **Fields:** its norms `off`; the `sizes` of the rows; `by(bad)`: the others that have a share in some of them.
    """

    off: Float[np.ndarray, "d"]
    sizes: Float[np.ndarray, "d"]
    by: Callable[[np.ndarray], np.ndarray]


def smallest_step(jacobian: Float[np.ndarray, "m n"], unmet: Float[np.ndarray, "m"]) -> Float[np.ndarray, "n"]:
    """`Nearby.step`, with a full matrix of derivatives."""
    if not np.all(np.isfinite(jacobian)):
        return np.full(jacobian.shape[1], np.nan, jacobian.dtype)
    return np.linalg.lstsq(jacobian, -unmet, rcond=None)[0]


def dense_remains(
    jacobian: Float[np.ndarray, "m n"], kept: Int[np.ndarray, "r"], dropped: Int[np.ndarray, "d"]
) -> Remains:
    """`Nearby.remains`, with a full matrix."""
    (kept_rows, _), (dropped_rows, sizes) = (_unit_rows(jacobian[rows]) for rows in (kept, dropped))
    share, *_ = np.linalg.lstsq(kept_rows.T, dropped_rows.T, rcond=None)
    zero = np.finfo(jacobian.dtype).eps ** ZERO
    by = lambda bad: kept[np.any(np.abs(share[:, bad]) > zero, axis=1)]
    return Remains(np.linalg.norm(dropped_rows - share.T @ kept_rows, axis=1), sizes, by)


def check_implied(
    system: AbstractSystem,
    groups: Sequence[DependentRows],
    places: Sequence[Int[np.ndarray, "n"]],
    evaluate: Callable[[float, Float[np.ndarray, "n"]], Nearby],
    size: int,
    dtype: Any,
    bodies: Mapping[str, Iterable[str]] = MappingProxyType({}),
) -> None:
    """Raise a `ValueError` naming the rows that others imply at a configuration on the constraints, but not near it.

    **Arguments:** `groups` with implied rows; `places`: for each the entries of a displacement that determine its rows;
    `evaluate(t, moved)`: after a displacement of this `size` in multiples of scales; `bodies` of each joint, for
    messages.
    """
    if not groups:
        return
    eps = float(np.finfo(dtype).eps)
    zero = eps**ZERO
    shifts = np.random.default_rng(0).uniform(-1.0, 1.0, (_POSES, size)) * eps**_DISPLACEMENT
    times = () if system.drift_free else _TIMES
    for t, shift in [*((0.0, shift) for shift in shifts), *((t, np.zeros(size)) for t in times)]:
        for number, (near, reached) in enumerate(_settled(groups, places, evaluate, t, shift.astype(dtype))):
            if reached:
                _check_near(system, t, groups[number], number, near, zero, bodies)


def _settled(groups, places, evaluate, t, moved):
    """A state near a displaced one that satisfies the independent rows of Φ, and for each group whether it was found.

    Places that cannot be reached, or only far away, say nothing.
    """
    small = np.finfo(moved.dtype).eps ** 0.75
    going, reached = set(range(len(groups))), set()
    near = evaluate(t, moved)
    for _ in range(_ITERATIONS):
        if not going:
            break
        moved = moved.copy()
        for k in sorted(going):
            step = near.step(k, groups[k].positions)
            if not (np.all(np.isfinite(step)) and np.max(np.abs(moved[places[k]]), initial=0.0) <= _NEAR):
                going.discard(k)
                continue
            moved[places[k]] += step
            if np.max(np.abs(step), initial=0.0) <= small:
                going.discard(k)
                reached.add(k)
        near = evaluate(t, moved)
    return [(near, k in reached) for k in range(len(groups))]


def _check_near(system, t, group, number, near, zero, bodies):
    """Raise the error where rows of a group that are not independent do not follow from the others."""
    dropped = np.setdiff1d(group.rows, group.independent)
    off, sizes, by = near.remains(number, group.independent, dropped)
    of_positions = near.unmet[: system.position_rows]
    left = np.abs(np.pad(of_positions, (0, system.acceleration_rows - system.position_rows))[dropped]) / sizes
    bad = np.maximum(off, left) > zero
    if np.any(bad):
        raise ValueError(_not_implied(system, t, dropped[bad], by(bad), bodies))


def _unit_rows(jacobian):
    sizes = np.maximum(np.linalg.norm(jacobian, axis=1), np.finfo(jacobian.dtype).tiny)
    return jacobian / sizes[:, None], sizes


def check_implied_as_one(
    system: AbstractSystem, q: Coordinates, positions: Int[np.ndarray, "p"], independent: Int[np.ndarray, "r"]
) -> None:
    """`check_implied` of all rows as one group, by full matrices.

    **Arguments:** `q` on the constraints; `positions`: independent rows of Φ; `independent`: those of A.
    """
    rows = np.arange(system.acceleration_rows)
    if independent.size == rows.size:
        return
    dtype = q.dtype

    def evaluate(t, moved):
        unmet, of_coordinates, jacobian = map(np.asarray, _evaluate(system, np.asarray(t, dtype), q, moved))
        step = lambda _, numbers: smallest_step(of_coordinates[numbers], unmet[numbers])
        return Nearby(unmet, step, lambda _, kept, dropped: dense_remains(jacobian, kept, dropped))

    # Coordinates may need more rows than velocities: those that keep invariants of the coordinates come last.
    coordinate_rows = np.arange(system.coordinate_rows)
    first = np.append(positions, np.arange(system.position_rows, system.coordinate_rows)).astype(int)
    of_coordinates = np.asarray(_evaluate(system, np.zeros((), dtype), q, np.zeros(q.size, dtype))[1])
    kept = independent_in_order(of_coordinates, [*first, *np.setdiff1d(coordinate_rows, first)])
    check_implied(system, [DependentRows(rows, independent, kept)], [np.arange(q.size)], evaluate, q.size, dtype)


@eqx.filter_jit
def _evaluate(system, t, q, moved):
    """Constraints, and their Jacobians with scaled columns, after coordinates have changed by multiples of a scale."""
    scale = system.coordinate_scale()
    q = q + scale * moved
    jacobian = system.jacobian(t, q, system.guess.u) * system.velocity_scale()[None, :]
    return system.coordinate_residual(t, q), system.coordinate_jacobian(t, q) * scale[None, :], jacobian


def _not_implied(system, t, rows, by, bodies):
    rows = [system.rows[r] for r in rows]
    first = dict.fromkeys(name for name, _ in rows)
    implying = dict.fromkeys(name for name, _ in (system.rows[r] for r in by) if name not in first)
    listed = ", ".join(f"row {k} of {name}" for name, k in rows) + (" is" if len(rows) == 1 else " are") + " implied"
    if implying:
        listed += f" by {', '.join(implying)}"
    if t != 0:
        return f"{listed} at t = 0, but no more at t = {t:g}. Remove one of these, or make their motions agree."
    moving = ", ".join(dict.fromkeys(body for name in (*first, *implying) for body in bodies.get(name, ())))
    return (
        f"The given pose{f' of {moving}' if moving else ''} is singular: {listed} there, but not near it. Give a pose "
        "off this position; if there is none, the dimensions allow no motion."
    )
