"""Checks that rows implied at the given pose are also implied near it.

Near a regular pose implied rows stay implied, and may be dropped. Near a singular pose they do not, and dropping them
changes the mechanism: a straight truss, a four-bar with all joints on one line, q₀ q₁ = 0 at the origin.
The kept rows are independent, so Newton's method finds nearby states that satisfy them. There the dropped rows must
hold, and their gradients must depend on the gradients of the kept rows.
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
# precision. A row that is implied only at the singular pose differs by the displacement or its square.
_POSES = 3
_DISPLACEMENT = 1 / 8
# The largest relative difference that counts as zero, as a power of eps: 1e-6.
ZERO = 3 / 8
# Rows that depend on time are checked at these times [s], as long as coordinates move less than this.
_TIMES = tuple(10.0**k for k in range(-9, 7))
_NEAR = 0.2
# Largest number of Newton steps.
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
    """A group of rows of A that depend only on each other.

    **Fields:** `rows` and the `independent` rows among them, as indices of rows of A; `positions`: independent rows of
    Φ and of the coordinates' invariants, as indices of rows of `coordinate_residual`.
    """

    rows: Int[np.ndarray, "m"]
    independent: Int[np.ndarray, "r"]
    positions: Int[np.ndarray, "p"]


class Nearby(NamedTuple):
    """The constraints at a displaced configuration.

    **Fields:** `unmet`: Φ and the coordinates' invariants; `step(number, rows)`: the smallest displacement of the group
    with index `number`, to first order, that satisfies these rows of its `positions`; `remains(number, kept, dropped)`:
    the parts of dropped rows of A that kept rows do not explain.
    """

    unmet: Float[np.ndarray, "mq"]
    step: Callable[[int, np.ndarray], np.ndarray]
    remains: Callable[[int, np.ndarray, np.ndarray], "Remains"]


class Remains(NamedTuple):
    """Residuals of dropped rows of unit norm after least squares by kept rows.

    **Fields:** norms of the residuals, `off`; the `sizes` of the rows; `by(bad)`: kept rows that have a share in the
    dropped rows `bad`.
    """

    off: Float[np.ndarray, "d"]
    sizes: Float[np.ndarray, "d"]
    by: Callable[[np.ndarray], np.ndarray]


def smallest_step(jacobian: Float[np.ndarray, "m n"], unmet: Float[np.ndarray, "m"]) -> Float[np.ndarray, "n"]:
    """`Nearby.step` with a dense Jacobian."""
    if not np.all(np.isfinite(jacobian)):
        return np.full(jacobian.shape[1], np.nan, jacobian.dtype)
    return np.linalg.lstsq(jacobian, -unmet, rcond=None)[0]


def dense_remains(
    jacobian: Float[np.ndarray, "m n"], kept: Int[np.ndarray, "r"], dropped: Int[np.ndarray, "d"]
) -> Remains:
    """`Nearby.remains` with a dense Jacobian."""
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
    """Raise a `ValueError` naming the rows that are implied at a configuration on the constraints, but not near it.

    **Arguments:** `groups` with implied rows; `places`: for each group the entries of a displacement that determine its
    rows; `evaluate(t, moved)`: the constraints after a displacement in multiples of scales; `size` and `dtype` of
    displacements; `bodies` of each joint, for messages.
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
    """The constraints near a displaced configuration where the independent rows of Φ hold, and whether each group
    reached such a configuration. An unreachable or distant configuration decides nothing.
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
    """Raise the error if dropped rows of a group do not follow from its independent rows."""
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
    """`check_implied` of all rows as one group, with dense matrices.

    **Arguments:** `q` on the constraints; `positions`: independent rows of Φ; `independent`: independent rows of A.
    """
    rows = np.arange(system.acceleration_rows)
    if independent.size == rows.size:
        return
    dtype = q.dtype

    def evaluate(t, moved):
        unmet, of_coordinates, jacobian = map(np.asarray, _evaluate(system, np.asarray(t, dtype), q, moved))
        step = lambda _, numbers: smallest_step(of_coordinates[numbers], unmet[numbers])
        return Nearby(unmet, step, lambda _, kept, dropped: dense_remains(jacobian, kept, dropped))

    # Rows that keep the coordinates' invariants come last, after the independent rows of Φ.
    coordinate_rows = np.arange(system.coordinate_rows)
    first = np.append(positions, np.arange(system.position_rows, system.coordinate_rows)).astype(int)
    of_coordinates = np.asarray(_evaluate(system, np.zeros((), dtype), q, np.zeros(q.size, dtype))[1])
    kept = independent_in_order(of_coordinates, [*first, *np.setdiff1d(coordinate_rows, first)])
    check_implied(system, [DependentRows(rows, independent, kept)], [np.arange(q.size)], evaluate, q.size, dtype)


@eqx.filter_jit
def _evaluate(system, t, q, moved):
    """Constraints, and Jacobians with scaled columns, after a displacement in multiples of the scales."""
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
