"""The segments of multiple shooting: charts of the constraint manifold at their starts, and the linearised misfit."""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._types import State
from ...states.assembly import assemble
from ...system import AbstractSystem
from ..batch import batch
from ..minimise import Linearised
from .experiment import ExperimentModel
from .problem import Problem, numbers, values_and_derivatives, weighted


class Lanes(NamedTuple):
    """The segments of one experiment: trials stacked along axis 0, and how many samples each has."""

    number: int
    trials: ExperimentModel
    static: ExperimentModel
    samples: tuple[int, ...]


class Point(NamedTuple):
    """The unknowns, and the linearised problem there; infinite where a simulation failed.

    `residuals` and `jacobian` are weighted by the loss, those of `plain` are as they are.
    """

    z: Array
    states: tuple[State, ...]
    charts: tuple[Any, ...]
    objective: float
    data: int
    residuals: np.ndarray
    jacobian: np.ndarray
    plain: Linearised
    gaps: np.ndarray
    continuity: np.ndarray
    readings: dict[str, dict[str, np.ndarray]]
    alone: tuple[Any, ...]


def segmented(name: str, number: int, trial: ExperimentModel, segments: int) -> Lanes:
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
    return Lanes(number, jax.tree.map(lambda *x: jnp.stack(x), *arrays), static[0], tuple(map(len, groups)))


def _column(mask: np.ndarray, like: Array) -> np.ndarray:
    return mask.reshape(-1, *(1 for _ in like.shape[1:]))


def _own_values(problem, lane, z):
    values, derivatives, *_ = values_and_derivatives(problem, z)
    columns = problem.columns(lane.number)
    return jnp.asarray(values[columns]), derivatives[columns]


def initial_everywhere(problem, lane, z) -> State:
    """The initial state of the experiment, once for every segment."""
    state = problem.start(lane.number, z)[1]
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (len(lane.samples), *x.shape)), state)


def evaluated(problem: Problem, lanes: tuple[Lanes, ...], z, states) -> Point:
    _, derivatives, prior_rows, prior_jacobian = values_and_derivatives(problem, z)
    sizes = [len(lane.samples) * _freedoms(problem.system) for lane in lanes]
    first = np.cumsum([z.size, *sizes])
    total, freedoms = int(first[-1]), _freedoms(problem.system)
    residuals, jacobian, scores, score_rows, gaps, continuity = [], [], [], [], [], []
    readings, alone, all_charts, objective = {}, [], [], 0.5 * prior_rows @ prior_rows
    for lane, state, begin in zip(lanes, states, first, strict=False):
        trial = problem.trials[lane.number]
        flat, inward = jnp.asarray(_own_values(problem, lane, z)[0]), derivatives[problem.columns(lane.number)]
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
    plain = Linearised(*whole, objective)
    model = weighted(problem, plain, data)
    return Point(
        z=z,
        states=tuple(states),
        charts=tuple(all_charts),
        objective=objective,
        data=data,
        residuals=model.residuals,
        jacobian=model.jacobian,
        plain=plain,
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


def moved(problem, lanes, point: Point, step: np.ndarray):
    """The unknowns after a step, the states back on the constraints of the new parameters."""
    z = point.z + jnp.asarray(step[: point.z.size], point.z.dtype)
    states, begin, freedoms = [], point.z.size, _freedoms(problem.system)
    for lane, state, charts in zip(lanes, point.states, point.charts, strict=True):
        size = len(lane.samples) * freedoms
        move = step[begin : begin + size].reshape(len(lane.samples), freedoms)
        flat = _own_values(problem, lane, z)[0]
        states.append(retracted(lane, (problem.system, flat, problem.trials[lane.number]), state, charts, move))
        begin += size
    return z, tuple(states)


def retracted(lane, system, state, charts, move) -> State:
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
            seen = trial.seen(changed, start, theta, options)
            vector = lambda y: jnp.concatenate([y.q, y.u])
            out = seen.rows.residuals, seen.rows.scores, vector(start), vector(seen.end)
            return out, (seen, out)

        w = jnp.zeros(sum(basis.shape[1] for basis in along), flat.dtype)
        jacobians, (seen, out) = jax.jacfwd(fn, argnums=(0, 1), has_aux=True)(flat, w)
        return seen, [(value, *both) for value, both in zip(out, jacobians, strict=True)]

    return batch(lane)(trials, states, tangents)
