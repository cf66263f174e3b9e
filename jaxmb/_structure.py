"""The structure of a compiled scene: numbers of independent rows, and which rows are implied by which joints."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .assembly import nearest, open_joints, residual_size, tolerance
from .elimination import full_pivot
from .system.rigid_bodies import Implied, Ranks, RigidBodySystem


def find_structure(system: RigidBodySystem) -> tuple[Ranks, tuple[Implied, ...]]:
    """Assemble from the given poses on concrete numbers, and eliminate.

    **Raises:** `ValueError` if the constraints cannot be satisfied, or contradict each other in velocities or accelerations.
    """
    t = jnp.zeros((), system.guess.q.dtype)
    q = system.normalize(system.guess.q)
    scale = system.coordinate_scale()
    if system.position_rows:
        q = eqx.filter_jit(nearest)(system, t, q, scale)
        if not float(residual_size(system, t, q)) <= tolerance(q.dtype):
            raise ValueError(
                f"The mechanism cannot be assembled from the given poses: residuals remain in {open_joints(system, t, q)}. "
                "Check lengths, points and axes for joints that contradict each other, or give better poses."
            )
    u = system.guess.u
    jacobian = system.jacobian(t, q, u)
    stage = jnp.arange(system.velocity_rows) >= system.position_rows
    holonomic = full_pivot(jacobian[: system.position_rows], scale=system.velocity_scale())
    everything = full_pivot(jacobian, scale=system.velocity_scale(), stage=stage.astype(int))
    position, velocity = int(holonomic.rank), int(everything.rank)
    coordinate = position + system.coordinate_rows - system.position_rows
    ranks = Ranks(position, coordinate, velocity)
    implied = _implied(system, np.asarray(jacobian), everything, velocity)
    _check_motion(system, t, q, u, np.asarray(jacobian))
    return ranks, implied


def _implied(system, jacobian, pivots, rank):
    """Express each dropped row by the kept ones; joints with a share in it imply it."""
    rows = np.asarray(pivots.rows)
    kept, dropped = rows[:rank], rows[rank:]
    out = []
    for row in dropped:
        share, *_ = np.linalg.lstsq(jacobian[kept].T, jacobian[row], rcond=None)
        weight = np.abs(share) * np.linalg.norm(jacobian[kept], axis=1)
        name, k = system.rows[row]
        by = {system.rows[r][0] for r, w in zip(kept, weight, strict=True) if w > 1e-6 * np.linalg.norm(jacobian[row])}
        out.append(Implied(name, k, tuple(sorted(by - {name})) or (name,)))
    return tuple(sorted(out, key=lambda item: (item.name, item.row)))


def _check_motion(system, t, q, u, jacobian):
    """Implied rows must ask for nothing else than the rows that imply them, in velocities and in accelerations."""
    if system.velocity_rows == 0 or not system.linear:
        return
    start = np.asarray(system.velocity_residual(t, q, jnp.zeros_like(u)))
    step, *_ = np.linalg.lstsq(jacobian, -start, rcond=1e-8)
    _check_left_over(system, jacobian @ step + start, np.abs(start).max(), "velocities")
    u = jnp.asarray(step)
    start = np.asarray(system.acceleration_residual(t, q, u, jnp.zeros_like(u)))
    step, *_ = np.linalg.lstsq(jacobian, -start, rcond=1e-8)
    _check_left_over(system, jacobian @ step + start, np.abs(start).max(), "accelerations")


def _check_left_over(system, left, size, what):
    bad = np.abs(left) > 1e-6 * max(size, 1e-6)
    if np.any(bad):
        names = sorted({name for (name, _), b in zip(system.rows, bad, strict=True) if b})
        raise ValueError(
            f"The {what} asked for by {', '.join(names)} contradict each other (largest residual {np.abs(left).max():.3g}). "
            "Remove one of them, or make their motions agree."
        )
