"""Consistency of a state with the constraints of its system, before the start of a motion."""

from collections.abc import Iterable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax

from .._compat import used_inputs
from .._types import State
from ..linalg.arrays import is_traced
from ..linalg.failure import nan_where
from ..linalg.jitted import jitted
from ..manifold.implied import drops_accelerations
from ..system import AbstractSystem, parameters, with_parameters
from ..system.instant import Instant

# The largest violation of a consistent state, relative to the system's size and to the largest velocity; at least this
# power of eps, 3e-4 in single precision.
_TOLERANCE = 1e-5
_ROUNDING = 0.5
# The largest number of names in a message.
_NAMED = 8
# The independent part of a row that is not implied, as a power of eps: 1e-7.
_IMPLIED = 0.45


def consistent(system: AbstractSystem, t: Any, state: State) -> State:
    """The state, after a check that it satisfies the constraints.

    **Raises:** `ValueError` naming the violated joints with their residuals. Under a trace a bad state becomes NaN
    instead, so that a simulation from it fails.
    """
    if system.velocity_rows == 0:
        return state
    rows = _violated(*lax.stop_gradient((system, t, state)))
    if is_traced(rows):
        off = jnp.any(rows[0]) | jnp.any(rows[1]) | jnp.any(rows[2])
        return nan_where(off, state, (system, t, state))
    if not any(np.any(violated) for violated in rows):
        return state
    if is_traced((system, t, state)):
        # Under a derivative the checks are concrete although the state is traced.
        return nan_where(jnp.array(True), state, (system, t, state))
    positions, velocities, overlaps = map(np.asarray, rows)
    if np.any(overlaps):
        names = [name for name, off in zip(system.contacts.contact_names, overlaps, strict=True) if off]
        depths = -np.asarray(Instant.of(system, t, state).gaps)[overlaps]
        listing = ", ".join(f"{name} by {depth:.3g}" for name, depth in zip(names, depths, strict=True))
        raise ValueError(
            "The state is beyond contacts, with bodies inside each other, joints beyond their stops or ropes too long, "
            f"at t0 = {float(t):g}: {listing}. Give another state, or "
            f'close the contact: state = jaxmb.assemble(system, state, fix={{"{names[0]}.mode": 1}}).'
        )
    cure = (
        f"at t0 = {float(t):g}. Other parameters, another system or another time need another state: "
        "state = jaxmb.assemble(system, state, t=t0) makes this one consistent."
    )
    if np.any(positions):
        names = listed(system, positions, system.position_residual(t, state.q))
        raise ValueError(f"The state violates the constraints {names} {cure}")
    names = listed(system, velocities, system.velocity_residual(t, state.q, state.u))
    raise ValueError(f"The velocities of the state violate the constraints {names} {cure}")


def constraints_depend_on(system: AbstractSystem, t: Any, state: State, names: Iterable[str]) -> bool:
    """Whether constraints depend on some of the named parameters, for any values."""
    start = parameters(system)

    def rows(values):
        at = Instant.of(with_parameters(system, values), t, state)
        return at.position_residual, at.velocity_residual

    return any(used_inputs(rows, {name: start[name] for name in names}).values())


def contradiction(system: AbstractSystem, t: Any, state: State) -> str:
    """A message about violated implied rows at the end of a motion."""
    at = Instant.of(system, t, state)
    positions, velocities = (np.asarray(x) for x in (at.position_residual, at.velocity_residual))
    jacobian = np.asarray(at.jacobian) * np.asarray(system.velocity_scale())
    jacobian = jacobian / np.maximum(np.linalg.norm(jacobian, axis=1, keepdims=True), np.finfo(jacobian.dtype).tiny)
    residual = np.abs(np.append(positions, velocities[system.position_rows :]))
    what = "are violated"
    if drops_accelerations(system) and np.max(residual, initial=0.0) <= np.finfo(residual.dtype).eps ** 0.5:
        what, residual = "ask for other accelerations", _unmet_accelerations(at)
    names = listed(system, residual > 1e-3 * np.max(residual, initial=0.0), residual)
    text = (
        f"At t = {float(t):g} the constraints {names} contradict the others: rows of them, which others implied when "
        f"the system was compiled, {what}. Remove them, or make dimensions and prescribed motions agree."
    )
    rows = jacobian[: system.position_rows]
    if np.linalg.matrix_rank(rows, np.finfo(rows.dtype).eps ** _IMPLIED) <= system.position_rank:
        return text
    return (
        f"{text} If they agree, the compiled pose is a bifurcation: beside it, as here, these rows are independent, so "
        "the other rows admit motions that all rows together do not. Compile the scene at a pose beside it."
    )


def _unmet_accelerations(at):
    """The residuals of rows of A after least squares, just after a time."""
    later = float(at.t) + 64 * np.finfo(float).eps * max(abs(float(at.t)), 1.0)
    at = Instant(at.system, jnp.asarray(later, at.q.dtype), at.q, at.u, at.z)
    jacobian, gamma = np.asarray(at.jacobian), np.asarray(at.gamma)
    return np.abs(jacobian @ np.linalg.lstsq(jacobian, gamma, rcond=None)[0] - gamma)


def is_consistent(system: AbstractSystem, t: Any, state: State) -> Any:
    """Whether a state satisfies the constraints; True without constraints."""
    if system.velocity_rows == 0:
        return True
    positions, velocities, overlaps = _violated(*lax.stop_gradient((system, t, state)))
    return ~(jnp.any(positions) | jnp.any(velocities) | jnp.any(overlaps))


@jitted
def _violated(system, t, y) -> Any:
    near = system.closing()
    at = Instant.of(near, t, y).normalized()
    tol = max(_TOLERANCE, float(jnp.finfo(y.q.dtype).eps) ** _ROUNDING)
    positions, velocities = at.violations(at.row_sizes())
    depths = -at.gaps / system.length
    return (positions > tol) | near.half_turned(at.q), velocities > tol, depths > tol


def not_finite(system: AbstractSystem, **vectors: Any) -> str:
    """The first entries of vectors `q`, `u` and `z` of a state that are not finite, by name with their values."""
    names = {"q": system.coordinate_names(), "u": system.rate_names(), "z": system.state_names()}
    out = []
    for key, vector in vectors.items():
        values = np.zeros(0) if vector is None else np.asarray(vector)
        wrong = set(np.flatnonzero(~np.isfinite(values)).tolist())
        # The names of numbers come before those of vectors that contain them.
        for name, index in sorted(names[key].items(), key=lambda item: len(item[1])):
            if wrong & set(index):
                wrong -= set(index)
                out.append(f"{name} ({', '.join(f'{values[k]:g}' for k in index)})")
    return ", ".join(out[:_NAMED]) + (f" and {len(out) - _NAMED} more" if len(out) > _NAMED else "")


def listed(system: AbstractSystem, violated: Any, residual: Any) -> str:
    """The names of at most eight violated constraints with their largest residuals, the largest first, for messages."""
    worst: dict[str, float] = {}
    for (name, _), bad, value in zip(system.rows, violated, np.abs(np.asarray(residual)), strict=False):
        if bad:
            worst[name] = max(worst.get(name, 0.0), float(value))
    return ", ".join(f"{name} ({value:.3g})" for name, value in sorted(worst.items(), key=lambda item: -item[1])[:8])
