"""Whether rows that others imply at the given pose are implied near it as well.

Where rows lose rank, some of them are implied by the others. Near a regular pose they stay so, and may be left out; at
a singular one (a straight truss, a four-bar with all joints on one line, q₀ q₁ = 0 at the origin) they do not, and the
mechanism without them is another one. The kept rows are independent, so nearby states of them are found by Newton's
method: there the rows left out must hold, and their gradients must depend on those of the kept rows.
"""

from collections.abc import Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..system import AbstractSystem

# Number of displaced poses, and the displacement in scales of the coordinates as a power of eps: 1e-2 in double
# precision. A row that is implied at a singular pose only differs by the displacement or its square.
_POSES = 3
_DISPLACEMENT = 1 / 8
# The largest relative difference that counts as zero, as a power of eps: 1e-6.
_ZERO = 3 / 8
# Rows that depend on time are followed to these times [s], as far as the coordinates move less than this.
_TIMES = tuple(10.0**k for k in range(-9, 7))
_NEAR = 0.2
# Largest number of steps of Newton's method.
_ITERATIONS = 10


def check_gradients(system: AbstractSystem, jacobian: Float[np.ndarray, "m nu"]) -> None:
    """Raise a `ValueError` naming the rows of A, its columns scaled, that are zero."""
    sizes = np.linalg.norm(jacobian, axis=1)
    zero = sizes <= np.finfo(jacobian.dtype).eps ** 0.75 * np.max(sizes, initial=0.0)
    if np.any(zero):
        listed = ", ".join(f"row {k} of {name}" for (name, k), z in zip(system.rows, zero, strict=True) if z)
        raise ValueError(
            f"At the given poses and velocities the gradient of {listed} is zero, so it binds nothing there: they are "
            "singular. Give others, or write the constraint without products or powers that vanish with it."
        )


def check_implied(
    system: AbstractSystem,
    q: Float[Array, "nq"],
    positions: np.ndarray,
    independent: np.ndarray,
    bodies: Mapping[str, Iterable[str]] = MappingProxyType({}),
) -> None:
    """Raise a `ValueError` naming the rows that others imply at a configuration on the constraints, but not near it.

    **Arguments:** `positions`: independent rows of Φ; `independent`: those of A; `bodies` of each joint, for messages.
    """
    dropped = np.setdiff1d(np.arange(system.acceleration_rows), independent)
    if not dropped.size:
        return
    for t, unmet, jacobian in _nearby(system, np.asarray(q), positions):
        zero = float(np.finfo(jacobian.dtype).eps) ** _ZERO
        sizes = np.maximum(np.linalg.norm(jacobian, axis=1), np.finfo(jacobian.dtype).tiny)
        rows = jacobian / sizes[:, None]
        share, *_ = np.linalg.lstsq(rows[independent].T, rows[dropped].T, rcond=None)
        off = np.linalg.norm(rows[dropped] - share.T @ rows[independent], axis=1)
        left = np.abs(np.pad(unmet, (0, sizes.size - unmet.size)) / sizes)
        bad = np.maximum(off, left[dropped]) > zero
        if np.any(bad):
            by = independent[np.any(np.abs(share[:, bad]) > zero, axis=1)]
            raise ValueError(_not_implied(system, t, dropped[bad], by, bodies))


def _nearby(system, q, positions) -> Iterator[tuple[float, Any, Any]]:
    """States near a configuration that satisfy the independent rows of Φ: time, Φ, and A with its columns scaled.

    Places that cannot be reached, or only far away, say nothing and are left out.
    """
    shifts = np.random.default_rng(0).uniform(-1.0, 1.0, (_POSES, q.size)) * np.finfo(q.dtype).eps ** _DISPLACEMENT
    times = () if system.drift_free else _TIMES
    _, of_coordinates, _ = map(np.asarray, _evaluate(system, np.asarray(0.0, q.dtype), q, np.zeros_like(q)))
    # Coordinates may need more rows than velocities: those that keep invariants of the coordinates come last.
    own = np.append(positions, np.arange(system.position_rows, system.coordinate_rows))
    kept = _independent_rows(of_coordinates, [*own, *np.setdiff1d(np.arange(system.coordinate_rows), own)])
    small = np.finfo(q.dtype).eps ** 0.75
    for t, shift in [*((0.0, shift) for shift in shifts), *((t, 0.0) for t in times)]:
        at = lambda moved, t=t: map(np.asarray, _evaluate(system, np.asarray(t, q.dtype), q, moved))
        moved = np.full_like(q, shift)
        unmet, of_coordinates, jacobian = at(moved)
        for _ in range(_ITERATIONS):
            if not (np.all(np.isfinite(of_coordinates)) and np.max(np.abs(moved)) <= _NEAR):
                break
            step = np.linalg.lstsq(of_coordinates[kept], -unmet[kept], rcond=None)[0]
            moved = moved + step
            unmet, of_coordinates, jacobian = at(moved)
            if np.max(np.abs(step)) <= small:
                yield t, unmet[: system.position_rows], jacobian
                break


def _independent_rows(jacobian, order):
    """Rows that do not depend on those before them, in an order."""
    kept, basis = [], np.zeros((0, jacobian.shape[1]), jacobian.dtype)
    for k in order:
        own = jacobian[k] - basis.T @ (basis @ jacobian[k])
        if np.linalg.norm(own) > np.finfo(jacobian.dtype).eps ** 0.5 * np.linalg.norm(jacobian[k]):
            kept, basis = [*kept, k], np.vstack([basis, own / np.linalg.norm(own)])
    return np.array(kept, int)


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
    others = dict.fromkeys(name for name, _ in (system.rows[r] for r in by) if name not in first)
    listed = ", ".join(f"row {k} of {name}" for name, k in rows) + (" is" if len(rows) == 1 else " are") + " implied"
    if others:
        listed += f" by {', '.join(others)}"
    if t != 0:
        return f"{listed} at t = 0, but no more at t = {t:g}. Remove one of these, or make their motions agree."
    moving = ", ".join(dict.fromkeys(body for name in (*first, *others) for body in bodies.get(name, ())))
    return (
        f"The given pose{f' of {moving}' if moving else ''} is singular: {listed} there, but not near it. Give a pose "
        "off this position; if there is none, the dimensions allow no motion."
    )
