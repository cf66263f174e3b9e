"""Multiple shooting on the constraint manifold: long motions that are chaotic or unstable, in short segments.

The states at the starts of segments are unknowns, each in independent coordinates: a chart of the constraint manifold
takes w to the state closest to `x + T w`, with T a basis of the tangent space at x. That each segment begins where the
last one ends are equality constraints `c = 0`. Each step solves

    minimise ½ |r + J s|² + ½ μ |D s|²  subject to  c + C s = 0

by orthogonal factorisation of C, which a recursion over the segments would be without its growth; its length is chosen
such that `f + ν |c|₁` decreases. Charts are then moved to the new states.

Source: H. G. Bock, "Recent Advances in Parameter Identification Techniques for O.D.E.", in: Numerical Treatment of
Inverse Problems in Differential and Integral Equations, Birkhäuser 1983.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import State
from ..states.assembly import assemble
from ..system import AbstractSystem
from .experiment import Trial
from .problem import Problem, numbers, values_and_derivatives, with_likely_levels

# Steps of each segment towards its own data, before they are joined.
_ALONE = 12
# The largest gap, in scaled coordinates, of a motion that counts as continuous.
_CONTINUOUS = 1e-9
# Damping of the first step, its bounds, and halvings of a step before the damping grows.
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING, _HALVINGS = 1e-6, 1e-12, 1e8, 6


class Shot(NamedTuple):
    """Where multiple shooting ended.

    **Fields:** `z`; `data`: weighted residuals of data; `jacobian` of all rows along the directions that keep the
    motion continuous, and `along`: how z changes along them; `objective`; `readings` by experiment and sensor;
    `continuity`: the largest gap; `iterations`; `success`.
    """

    z: Array
    data: np.ndarray
    jacobian: np.ndarray
    along: np.ndarray
    objective: float
    readings: dict[str, dict[str, np.ndarray]]
    continuity: float
    iterations: int
    success: bool


class _Lanes(NamedTuple):
    """The segments of one experiment: trials stacked along axis 0, and how many samples each has."""

    number: int
    trials: Trial
    static: Trial
    samples: tuple[int, ...]


class _Point(NamedTuple):
    """The unknowns, and the linearised problem there; infinite where a simulation failed."""

    z: Array
    states: tuple[State, ...]
    charts: tuple[Any, ...]
    objective: float
    data: int
    residuals: np.ndarray
    jacobian: np.ndarray
    gaps: np.ndarray
    continuity: np.ndarray
    readings: dict[str, dict[str, np.ndarray]]
    alone: tuple[Any, ...]


def shoot(problem: Problem, z: Float[Array, "n"], segments: int, tol: float, limit: int) -> Shot:
    """Fit all experiments in segments.

    **Arguments:** `segments` of each experiment; `tol`: change of unknowns and objective at which to stop; `limit`:
    largest number of steps.

    **Raises:** `ValueError` for sensors with a delay, residual functions, more segments than samples, and if the
    simulations with the starting values fail.
    """
    lanes = tuple(
        _segmented(problem.names[number], number, trial, segments)
        for number, trial in enumerate(problem.trials)
        if problem.fitted[number]
    )
    evaluate = lambda z, states: _evaluated(problem, lanes, z, states)
    states = tuple(_initial_everywhere(problem, own, z) for own in lanes)
    point = evaluate(z, states)
    if not np.isfinite(point.objective):
        raise ValueError("The simulation of the segments fails with the starting values.")
    point = _each_to_its_data(lanes, evaluate, point)
    likely = with_likely_levels(problem, point.z, point.readings)
    if not np.array_equal(likely, point.z):
        point = evaluate(likely, point.states)
    point, iterations, success = _join(problem, lanes, evaluate, point, tol, limit)
    basis = _null_basis(point.continuity)[2]
    return Shot(
        point.z,
        point.residuals[: point.data],
        point.jacobian @ basis,
        basis[: z.size],
        point.objective,
        point.readings,
        float(np.max(np.abs(point.gaps))),
        iterations,
        success,
    )


def _join(problem, lanes, evaluate: Callable, point: _Point, tol: float, limit: int) -> tuple[_Point, int, bool]:
    """Steps of the constrained problem, until the motion is continuous and nothing changes."""
    damping, weight = _FIRST_DAMPING, 0.0
    for iteration in range(1, limit + 1):
        step, multipliers = _step(point, damping)
        weight = max(weight, 2 * float(np.max(np.abs(multipliers), initial=0.0)))
        change = point.residuals @ (point.jacobian @ step)
        expected = weight * np.sum(np.abs(point.gaps)) - change
        for halving in range(_HALVINGS):
            length = 0.5**halving
            trial = evaluate(*_moved(problem, lanes, point, length * step))
            small = np.all(np.abs(length * step[: point.z.size]) <= tol * (1 + np.abs(np.asarray(point.z))))
            still = abs(trial.objective - point.objective) <= tol * (1 + abs(point.objective))
            continuous = np.max(np.abs(trial.gaps)) <= _CONTINUOUS
            if halving == 0 and small and still and continuous:
                return trial, iteration, True
            if _merit(trial, weight) <= _merit(point, weight) - 1e-4 * length * max(expected, 0.0):
                break
        else:
            damping = max(10 * damping, _FIRST_DAMPING)
            if damping > _MOST_DAMPING:
                return point, iteration, False
            continue
        damping = max(damping / 10, _LEAST_DAMPING) if length == 1 else damping
        point = trial
    return point, limit, False


def _merit(point: _Point, weight: float) -> float:
    """The objective, and the gaps as they weigh against it."""
    return point.objective + weight * np.sum(np.abs(point.gaps)) if np.isfinite(point.objective) else np.inf


def _null_basis(matrix: Float[np.ndarray, "m n"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bases of the row space and of the null space of a matrix of full row rank, and its triangular factor."""
    whole, upper = np.linalg.qr(matrix.T, mode="complete")
    m = matrix.shape[0]
    return whole[:, :m], upper[:m], whole[:, m:]


def _step(point: _Point, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """The step, and the multipliers of the gaps."""
    rows, upper, null = _null_basis(point.continuity)
    restored = rows @ np.linalg.solve(upper.T, -point.gaps)
    norms = np.linalg.norm(point.jacobian, axis=0)
    weights = np.sqrt(damping) * np.where(norms > 0, norms, 1.0)
    whole = np.vstack([point.jacobian, np.diag(weights)])
    target = np.append(-point.residuals, np.zeros(weights.size)) - whole @ restored
    step = restored + null @ np.linalg.lstsq(whole @ null, target, rcond=None)[0]
    gradient = point.jacobian.T @ (point.residuals + point.jacobian @ step) + weights**2 * step
    return step, np.linalg.solve(upper, -rows.T @ gradient)


def _each_to_its_data(lanes, evaluate, point: _Point) -> _Point:
    """The states from which each segment alone fits its data, with the parameters as they are, by damped steps."""
    dampings = [np.full(len(own.samples), 1e-3) for own in lanes]
    for _ in range(_ALONE):
        moves = []
        for lane, (_, residuals, jacobians), damping in zip(lanes, point.alone, dampings, strict=True):
            steps = []
            for k in range(len(lane.samples)):
                norms = np.linalg.norm(jacobians[k], axis=0)
                weights = np.sqrt(damping[k]) * np.where(norms > 0, norms, 1.0)
                rows = np.vstack([jacobians[k], np.diag(weights)])
                steps.append(np.linalg.lstsq(rows, np.append(-residuals[k], 0 * weights), rcond=None)[0])
            moves.append(np.stack(steps))
        states = tuple(
            _retracted(lane, system, state, charts, move)
            for lane, (system, *_), state, charts, move in zip(
                lanes, point.alone, point.states, point.charts, moves, strict=True
            )
        )
        trial = evaluate(point.z, states)
        better = []
        for (_, before, _), (_, after, _), damping in zip(point.alone, trial.alone, dampings, strict=True):
            size = lambda rows: np.sum(np.where(np.isfinite(rows), rows, np.inf) ** 2, axis=1)
            better.append(size(after) < size(before))
            damping *= np.where(better[-1], 0.2, 5.0)
        if not any(own.any() for own in better):
            break
        pick = lambda own, new, old: jnp.where(jnp.asarray(own)[:, None], new, old)
        states = tuple(
            State(pick(own, new.q, old.q), pick(own, new.u, old.u))
            for own, new, old in zip(better, states, point.states, strict=True)
        )
        point = evaluate(point.z, states)
    return point


def _segmented(name: str, number: int, trial: Trial, segments: int) -> _Lanes:
    """An experiment in segments of nearly as many samples, shorter ones filled up with missing samples."""
    where = f" of experiment {name!r}" if name else ""
    if trial.residual is not None:
        raise ValueError(f"The residual function{where} looks at the whole motion; multiple shooting needs measured=.")
    late = [channel.name for channel in trial.channels if channel.delayed]
    if late:
        raise ValueError(f"Sensor {late[0]!r}{where} has a delay, which multiple shooting cannot have.")
    if not 1 < segments <= trial.ts.size:
        raise ValueError(f"segments must lie between 1 and the number of times, {trial.ts.size}, got {segments}.")
    groups = np.array_split(np.arange(trial.ts.size), segments)
    longest = max(map(len, groups))
    out, before = [], trial.t0
    for group in groups:
        index = np.append(group, np.full(longest - len(group), group[-1]))
        there = np.arange(longest) < len(group)
        channels = [
            eqx.tree_at(
                lambda c: (c.values, c.present, c.sigma),
                channel,
                (channel.values[index], channel.present[index] & _column(there, channel.present), channel.sigma[index]),
            )
            for channel in trial.channels
        ]
        out.append(eqx.tree_at(lambda t: (t.ts, t.t0, t.channels), trial, (trial.ts[index], before, tuple(channels))))
        before = trial.ts[group[-1]]
    arrays, static = zip(*(eqx.partition(own, eqx.is_array) for own in out), strict=True)
    return _Lanes(number, jax.tree.map(lambda *x: jnp.stack(x), *arrays), static[0], tuple(map(len, groups)))


def _column(mask: np.ndarray, like: Array) -> np.ndarray:
    return mask.reshape(-1, *(1 for _ in like.shape[1:]))


def _own_values(problem, lane, z):
    values, ahead, *_ = values_and_derivatives(problem, z)
    columns = problem.columns(lane.number)
    return jnp.asarray(values[columns]), ahead[columns]


def _initial_everywhere(problem, lane, z) -> State:
    """The initial state of the experiment, once for every segment."""
    state = problem.start(lane.number, z)[1]
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (len(lane.samples), *x.shape)), state)


def _evaluated(problem: Problem, lanes: tuple[_Lanes, ...], z, states) -> _Point:
    _, ahead, prior_rows, prior_jacobian = values_and_derivatives(problem, z)
    sizes = [len(lane.samples) * _freedoms(problem.system) for lane in lanes]
    first = np.cumsum([z.size, *sizes])
    total, freedoms = int(first[-1]), _freedoms(problem.system)
    residuals, jacobian, scores, score_rows, gaps, continuity = [], [], [], [], [], []
    readings, alone, all_charts, objective = {}, [], [], 0.5 * prior_rows @ prior_rows
    for lane, state, begin in zip(lanes, states, first, strict=False):
        trial = problem.trials[lane.number]
        flat, inward = jnp.asarray(_own_values(problem, lane, z)[0]), ahead[problem.columns(lane.number)]
        charts = _charts(problem.system, trial, lane, flat, state)
        found = _linearised_lanes(problem.system, lane.trials, lane.static, problem.options, flat, state, charts[:2])
        seen, (rows, levels, starts, ends) = numbers(found)
        initial, of_initial = (np.asarray(x) for x in _initial(problem.system, trial, flat))
        rows_alone, jacobian_alone = [], []
        for k in range(len(lane.samples)):
            place = slice(begin + k * freedoms, begin + (k + 1) * freedoms)
            placed = functools.partial(_placed, k, inward, place, total)
            present = seen.rows.present[k]
            residuals.append(seen.rows.residuals[k][present])
            jacobian.append(placed(rows[1:])[present])
            scores.append(seen.rows.scores[k])
            score_rows.append(placed(levels[1:]))
            rows_alone.append(seen.rows.residuals[k])
            jacobian_alone.append(rows[2][k])
            start = placed(starts[1:])
            if k == 0:
                arrival, change = initial, np.zeros_like(start)
                change[:, : z.size] = of_initial @ inward
            else:
                arrival, before = ends[0][k - 1], slice(place.start - freedoms, place.start)
                change = np.zeros_like(start)
                change[:, : z.size], change[:, before] = ends[1][k - 1] @ inward, ends[2][k - 1]
            onto = charts[2][k]
            gaps.append(onto @ (arrival - starts[0][k]))
            continuity.append(onto @ (change - start))
        objective = objective + np.sum(seen.rows.objective)
        several = seen.readings.items()
        own = {name: np.concatenate([x[k][:n] for k, n in enumerate(lane.samples)]) for name, x in several}
        readings[problem.names[lane.number]] = own
        alone.append(((problem.system, flat, trial), np.stack(rows_alone), np.stack(jacobian_alone)))
        all_charts.append(charts)
    data = sum(own.size for own in residuals)
    prior_whole = np.hstack([prior_jacobian, np.zeros((prior_rows.size, total - z.size))])
    whole = np.concatenate([*residuals, prior_rows, *scores]), np.vstack([*jacobian, prior_whole, *score_rows])
    finite = np.isfinite(objective) and all(np.all(np.isfinite(x)) for x in (*whole, *gaps, *continuity))
    objective = float(objective) if finite else np.inf
    return _Point(
        z=z,
        states=tuple(states),
        charts=tuple(all_charts),
        objective=objective,
        data=data,
        residuals=whole[0],
        jacobian=whole[1],
        gaps=np.concatenate(gaps),
        continuity=np.vstack(continuity),
        readings=readings,
        alone=tuple(alone),
    )


def _placed(k, inward, place, total, derivatives) -> np.ndarray:
    """Derivatives of one segment, in its unknowns and its own state, as those in all unknowns."""
    in_unknowns, in_state = derivatives
    out = np.zeros((in_unknowns.shape[1], total))
    out[:, : inward.shape[1]], out[:, place] = in_unknowns[k] @ inward, in_state[k]
    return out


def _freedoms(system: AbstractSystem) -> int:
    """Independent coordinates and velocities."""
    return system.nq - system.coordinate_rank + system.nu - system.velocity_rank


def _moved(problem, lanes, point: _Point, step: np.ndarray):
    """The unknowns after a step, the states back on the constraints of the new parameters."""
    z = point.z + jnp.asarray(step[: point.z.size], point.z.dtype)
    states, begin, freedoms = [], point.z.size, _freedoms(problem.system)
    for lane, state, charts in zip(lanes, point.states, point.charts, strict=True):
        size = len(lane.samples) * freedoms
        move = step[begin : begin + size].reshape(len(lane.samples), freedoms)
        flat = _own_values(problem, lane, z)[0]
        states.append(_retracted(lane, (problem.system, flat, problem.trials[lane.number]), state, charts, move))
        begin += size
    return z, tuple(states)


def _retracted(lane, system, state, charts, move) -> State:
    own, flat, trial = system
    return _on_constraints(own, trial, flat, lane.trials.t0, state, charts[:2], jnp.asarray(move, state.q.dtype))


@eqx.filter_jit
def _on_constraints(system, trial, flat, ts, states, tangents, moves) -> State:
    changed = trial.changed_system(system, trial.named(flat))
    return eqx.filter_vmap(lambda t, state, along, w: _near(changed, t, state, along, w))(ts, states, tangents, moves)


def _near(system, t, state, tangents, w) -> State:
    """The state closest to a chart's point; the chart's coordinates are first those of q, then those of u."""
    positions, velocities = tangents
    split = positions.shape[1]
    guess = State(state.q + positions @ w[:split], state.u + velocities @ w[split:])
    return assemble(system, guess, t=t, throw=False)


@eqx.filter_jit
def _initial(system, trial, flat):
    """The initial state as one vector, and its derivative."""

    def fn(flat):
        state = trial.start(system, trial.named(flat))[1]
        return jnp.concatenate([state.q, state.u])

    return fn(flat), jax.jacfwd(fn)(flat)


def _charts(system, trial, lane, flat, states) -> tuple[Any, Any, np.ndarray]:
    """Bases of the tangent spaces at the states, of q and of u, and the map from changes of both to coordinates."""
    positions, velocities = map(np.asarray, _constraint_jacobians(system, trial, flat, lane.trials.t0, states))
    sizes = np.asarray(system.coordinate_scale()), np.asarray(system.velocity_scale())
    bases, inverses = [], []
    for jacobians, size, rank in zip(
        (positions, velocities), sizes, (system.coordinate_rank, system.velocity_rank), strict=True
    ):
        if not np.all(np.isfinite(jacobians)):
            jacobians = np.zeros_like(jacobians)
        null = np.stack([_kernel(jacobian * size, rank) for jacobian in jacobians])
        bases.append(size[:, None] * null)
        inverses.append(np.swapaxes(null, 1, 2) / size)
    onto = np.zeros((len(lane.samples), sum(b.shape[2] for b in bases), system.nq + system.nu))
    split = inverses[0].shape[1]
    onto[:, :split, : system.nq], onto[:, split:, system.nq :] = inverses
    return jnp.asarray(bases[0]), jnp.asarray(bases[1]), onto


def _kernel(matrix: np.ndarray, rank: int) -> np.ndarray:
    return np.linalg.svd(matrix, full_matrices=True)[2][rank:].T if matrix.size else np.eye(matrix.shape[1])


@eqx.filter_jit
def _constraint_jacobians(system, trial, flat, ts, states):
    changed = trial.changed_system(system, trial.named(flat))
    position = lambda t, state: changed.coordinate_jacobian(t, state.q)
    velocity = lambda t, state: changed.velocity_jacobian(t, state.q, state.u)
    return jax.vmap(position)(ts, states), jax.vmap(velocity)(ts, states)


@eqx.filter_jit
def _linearised_lanes(system, trials, static, options, flat, states, tangents):
    """What every segment shows; and residuals, scores, start and end with their derivatives, in one batch."""

    def lane(trial, state, along):
        trial = eqx.combine(trial, static)

        def fn(flat, w):
            theta = trial.named(flat)
            changed = trial.changed_system(system, theta)
            start = _near(changed, trial.t0, state, along, w)
            seen = trial.seen(changed, start, theta, options, diffrax.ForwardMode())
            vector = lambda y: jnp.concatenate([y.q, y.u])
            out = seen.rows.residuals, seen.rows.scores, vector(start), vector(seen.end)
            return out, (seen, out)

        w = jnp.zeros(sum(basis.shape[1] for basis in along), flat.dtype)
        jacobians, (seen, out) = jax.jacfwd(fn, argnums=(0, 1), has_aux=True)(flat, w)
        return seen, [(value, *both) for value, both in zip(out, jacobians, strict=True)]

    return eqx.filter_vmap(lane)(trials, states, tangents)
