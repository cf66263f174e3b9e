"""Starts of an optimisation: the best of several points, or a feasible point near a start that fails."""

from collections.abc import Callable, Mapping

import jax.numpy as jnp
import numpy as np

from .evaluation import Limits, Program, rows_of_batch
from .trials import HOLDS, Trial, constraint_scales, evaluate

# Number of local optimisations, from the best of several starts.
_LOCAL = 4


def starting_points(
    program: Program,
    limits: Limits,
    first: Trial,
    shapes: Mapping[str, tuple[int, ...]],
    starts: int,
    seed: int,
    most: int,
) -> tuple[list[np.ndarray], int]:
    """The vectors to start from, and the number of trials that led to a feasible start if every start failed.

    **Arguments:** `first`: the trial at the given start; `shapes` of outputs; `starts`: their number; `most`: largest
    number of trials.

    **Raises:** `ValueError` if nothing leads away from starts that fail.
    """
    chosen = [first.z] if first.good else []
    if starts > 1:
        chosen = _best(program, limits, starts, seed)
    if chosen:
        return chosen, 0
    trial, spent = _feasible_start(program, limits, shapes, first, most)
    return [trial.z], spent


def _best(program: Program, limits: Limits, starts: int, seed: int) -> list[np.ndarray]:
    """The best of several starts, evaluated at once; none if all fail."""
    others = program.space.sample(starts - 1, seed)
    z = jnp.concatenate([jnp.zeros((1, program.space.size), others.dtype), others])
    rows = np.asarray(rows_of_batch(program, z))
    good = np.all(np.isfinite(rows), axis=1)
    if not good.any():
        return []
    typical = np.median(np.abs(rows[good, 1:]), axis=0)
    scales = np.tile(np.where(typical > 0, typical, 1.0), (2, 1))
    excess = np.array([np.max(limits.excess(r, scales), initial=0.0) for r in rows[:, 1:]])
    order = np.lexsort((rows[:, 0], np.where(excess > HOLDS, excess, 0.0), ~good))
    return [np.asarray(z[k], float) for k in order[:_LOCAL] if good[k]]


def _feasible_start(program: Program, limits: Limits, shapes, first: Trial, most: int) -> tuple[Trial, int]:
    """A feasible trial from a start that fails, by the constraints that are finite there."""
    finite = [name for name in limits.names if name in first.outputs and np.all(np.isfinite(first.outputs[name]))]
    lost = [name for name in program.names if name not in finite]
    named = f"{', '.join(map(repr, lost))} {'is' if len(lost) == 1 else 'are'}" if lost else "derivatives are"
    what = f"At the start {named} not finite"
    cure = (
        "Start elsewhere, or return an output that measures the distance from a feasible start, such as "
        "jaxmb.assembly_gap(...), with a constraint: constraints={'gap': (None, 0)}."
    )
    if not finite:
        raise ValueError(f"{what}. {cure}")
    mask = np.concatenate([np.full(int(np.prod(shapes[name])), name in finite) for name in limits.names])
    components = tuple(c for c, k in zip(limits.components, mask, strict=True) if k)
    kept = Limits(tuple(finite), components, limits.low[mask], limits.high[mask])
    # In forward mode, since a reverse pass through a NaN is NaN, whatever its weight.
    part = Program(program.function, program.space, tuple(finite), True)
    start = evaluate(part, first.z)
    if not start.good or not kept.excess(start.rows, np.ones((2, start.rows.size))).any():
        raise ValueError(f"{what}, and no violated constraint leads away from it. {cure}")
    found, spent = _first_feasible(part, lambda z: evaluate(program, z), kept, start, most)
    if found is None:
        raise ValueError(
            f"{what}, and {spent} trials that made {', '.join(finite)} small found no finite start. {cure}"
        )
    return found, spent


def _first_feasible(
    program: Program,
    whole: Callable[[np.ndarray], Trial],
    limits: Limits,
    here: Trial,
    most: int,
) -> tuple[Trial | None, int]:
    """A trial with finite values, from a trial whose objective is NaN.

    Gauss–Newton steps reduce the violation of finite constraints, such as a gap of assembly. They then go beyond the
    bounds by a fraction of the way, since a mechanism is singular at the bounds themselves.

    **Arguments:** `program` of the constraints that are finite at the start, with their `limits` and their trial
    `here`; `whole(z)`: a trial of all outputs; `most`: largest number of trials.

    **Returns:** the trial, or None; and the number of trials.
    """
    low, high = program.space.box
    start = here.z
    scales = constraint_scales(limits, Trial(here.z, np.append(0.0, here.rows), _padded(here.jacobian), {}))
    beyond = np.zeros_like(start)
    count = 1
    while count < most:
        excess = limits.excess(here.rows, scales)
        violated = excess > 0
        if not violated.any():
            break
        slope = np.where(here.rows < limits.low, -1 / scales[0], 1 / scales[1])[:, None] * here.jacobian
        step = -np.linalg.lstsq(slope[violated], excess[violated], rcond=1e-8)[0]
        # No step is longer than half the scale of a parameter.
        step *= min(1.0, 0.5 / max(np.max(np.abs(step)), 1e-300))
        length, better = 1.0, None
        while length > 1e-3 and count < most:
            trial = evaluate(program, np.clip(here.z + length * step, low, high))
            count += 1
            smaller = np.linalg.norm(limits.excess(trial.rows, scales)) < (1 - 1e-3 * length) * np.linalg.norm(excess)
            if trial.good and smaller:
                better = trial
                break
            length *= 0.5
        if better is None:
            break
        beyond = better.z - here.z
        here = better
        if np.max(limits.excess(here.rows, scales)) < 1e-2:
            break
    # The last steps, lengthened until the objective has a value.
    way = here.z - start if np.any(here.z != start) else beyond
    for share in (0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8):
        for direction in (beyond, way):
            trial = whole(np.clip(here.z + share * direction, low, high))
            count += 1
            if trial.good:
                return trial, count
    return None, count


def _padded(jacobian: np.ndarray) -> np.ndarray:
    return np.vstack([np.zeros((1, jacobian.shape[1])), jacobian])
