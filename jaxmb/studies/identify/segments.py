"""The segments of multiple shooting: charts of the constraint manifold at their starts, and the linearised misfit."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._types import State
from ...manifold import Chart
from ..batch import batch
from ..constraint_branches import distance
from ..minimise import Linearised
from .experiment import ExperimentModel
from .problem import Model, Problem, numbers, values_and_derivatives, weighted


class Lanes(NamedTuple):
    """The segments of one experiment: trials stacked along axis 0, and the number of samples of each."""

    number: int
    trials: ExperimentModel
    static: ExperimentModel
    samples: tuple[int, ...]


class Starts(NamedTuple):
    """The states at the starts of segments, with charts there: the parts of each, stacked along axis 0.

    **Fields:** `parts`: the `indices`, the split and the quality of the charts; the `scales` of their coordinates.
    """

    states: State
    parts: Any
    scales: np.ndarray

    @property
    def indices(self) -> np.ndarray:
        """The places of the charts' coordinates among all coordinates and velocities."""
        return np.asarray(self.parts[0])


class Place(NamedTuple):
    """The vector of the unknowns, and for each experiment the charts at the starts of its segments."""

    z: Array
    charts: tuple["Starts", ...]

    @property
    def size(self) -> int:
        """The number of the unknowns and the coordinates of all charts."""
        return self.z.size + sum(starts.indices.size for starts in self.charts)

    def split(self, vector: Any) -> list[Any]:
        """The charts' coordinates in a vector of unknowns and coordinates, shape (segments, coordinates) for each
        experiment.
        """
        ends = np.cumsum([self.z.size, *(starts.indices.size for starts in self.charts)])
        each = zip(self.charts, ends[:-1], ends[1:], strict=True)
        return [vector[begin:end].reshape(starts.indices.shape) for starts, begin, end in each]


def segmented(name: str, number: int, trial: ExperimentModel, segments: int) -> Lanes:
    """An experiment in segments of nearly equal length, shorter segments filled up with missing samples."""
    where = f" of experiment {name!r}" if name else ""
    if trial.residual is not None:
        raise ValueError(f"The residual function{where} looks at the whole motion; multiple shooting needs measured=.")
    late = [channel.name for channel in trial.channels if channel.delayed]
    if late:
        raise ValueError(f"Sensor {late[0]!r}{where} has a delay, which multiple shooting does not support.")
    if not 1 < segments <= trial.ts.size:
        raise ValueError(f"segments must lie between 1 and the number of times, {trial.ts.size}, got {segments}.")
    groups = np.array_split(np.arange(trial.ts.size), segments)
    longest = max(map(len, groups))
    out, before = [], trial.t0
    for group in groups:
        index = np.append(group, np.full(longest - len(group), group[-1]))
        is_used = np.arange(longest) < len(group)
        channels = [
            eqx.tree_at(
                lambda c: (c.values, c.present, c.sigma),
                channel,
                (
                    channel.values[index],
                    channel.present[index] & _column(is_used, channel.present),
                    channel.sigma[index],
                ),
            )
            for channel in trial.channels
        ]
        out.append(eqx.tree_at(lambda t: (t.ts, t.t0, t.channels), trial, (trial.ts[index], before, tuple(channels))))
        before = trial.ts[group[-1]]
    arrays, static = zip(*(eqx.partition(element, eqx.is_array) for element in out), strict=True)
    return Lanes(number, jax.tree.map(lambda *x: jnp.stack(x), *arrays), static[0], tuple(map(len, groups)))


def _column(mask: np.ndarray, like: Array) -> np.ndarray:
    return mask.reshape(-1, *(1 for _ in like.shape[1:]))


def first_place(problem: Problem, lanes: tuple[Lanes, ...], z: Array) -> Place:
    """The initial state of each experiment, repeated for all its segments."""
    several = lambda x, count: jnp.broadcast_to(x, (count, *x.shape))
    starts = [(problem.start(lane.number, z)[1], len(lane.samples)) for lane in lanes]
    states = [State(several(state.q, count), several(state.u, count)) for state, count in starts]
    return _placed(problem, lanes, z, states)


def moved(problem: Problem, lanes: tuple[Lanes, ...], place: Place, step: np.ndarray) -> Place:
    """The place after a step, with the states projected on the constraints of the new parameters."""
    change = jnp.asarray(step, place.z.dtype)
    z, states = place.z + change[: place.z.size], []
    for lane, starts, move in zip(lanes, place.charts, place.split(change), strict=True):
        trial, flat = problem.trials[lane.number], _values_of(problem, lane, z)
        states.append(_on_constraints(problem.system, trial, flat, lane.trials.t0, starts, move))
    return _placed(problem, lanes, z, states)


def _placed(problem, lanes, z, states) -> Place:
    each = zip(lanes, states, strict=True)
    return Place(z, tuple(_starts(problem, lane, _values_of(problem, lane, z), state) for lane, state in each))


def _values_of(problem, lane, z):
    """The unknowns of one experiment, one after the other."""
    return jnp.asarray(values_and_derivatives(problem, z)[0][problem.columns(lane.number)])


def evaluated(problem: Problem, lanes: tuple[Lanes, ...], place: Place) -> Model:
    """The linearised problem at a place, in the unknowns and the coordinates of all charts."""
    _, derivatives, prior_rows, prior_jacobian = values_and_derivatives(problem, place.z)
    n, total = place.z.size, place.size
    residuals, jacobian, scores, score_rows, gaps, closing = [], [], [], [], [], []
    readings, objective, continuity, nq = {}, 0.5 * prior_rows @ prior_rows, 0.0, problem.system.nq
    columns = place.split(np.arange(total))
    for lane, charts, lane_columns in zip(lanes, place.charts, columns, strict=True):
        trial, flat = problem.trials[lane.number], _values_of(problem, lane, place.z)
        inward = derivatives[problem.columns(lane.number)]
        outcome = _linearised_lanes(problem.system, lane.trials, lane.static, problem.options, flat, charts)
        seen, (rows, levels, starts, ends) = numbers(outcome)

        def whole(by_unknowns, by_states, inward=inward, lane_columns=lane_columns):
            """Derivatives in all unknowns, from derivatives in the experiment's unknowns and in each segment's
            state.
            """
            out = np.zeros((*by_unknowns.shape[:2], total))
            out[..., :n] = by_unknowns @ inward
            for k, these in enumerate(lane_columns):
                out[k][:, these] = by_states[k]
            return out

        present = seen.rows.present
        residuals.append(seen.rows.residuals[present])
        jacobian.append(whole(*rows[1:])[present])
        scores.append(seen.rows.scores.reshape(-1))
        score_rows.append(whole(*levels[1:]).reshape(-1, total))
        start, end = whole(*starts[1:]), whole(*ends[1:])
        initial, of_initial = (np.asarray(x) for x in _initial(problem.system, trial, flat))
        first = np.pad(of_initial @ inward, ((0, 0), (0, total - n)))
        arrival, change = np.stack([initial, *ends[0][:-1]]), np.stack([first, *end[:-1]])
        places, scales = charts.indices, charts.scales
        # Charts do not tell the branches of the constraints apart.
        each = zip(arrival, starts[0], strict=True)
        continuity = max(continuity, *(distance(problem.system, a[:nq], b[:nq]) for a, b in each))
        gaps.append((np.take_along_axis(arrival - starts[0], places, 1) / scales).reshape(-1))
        of_gaps = np.take_along_axis(change - start, places[..., None], 1)
        closing.append((of_gaps / scales[..., None]).reshape(-1, total))
        objective = objective + np.sum(seen.rows.objective)
        readings[problem.names[lane.number]] = {
            name: np.concatenate([x[k][:count] for k, count in enumerate(lane.samples)])
            for name, x in seen.readings.items()
        }
    prior_whole = np.pad(prior_jacobian, ((0, 0), (0, total - n)))
    whole_rows = np.concatenate([*residuals, prior_rows, *scores])
    plain = Linearised(whole_rows, np.vstack([*jacobian, prior_whole, *score_rows]), objective)
    data = sum(part.size for part in residuals)
    linearised = weighted(problem, plain, data)._replace(gaps=np.concatenate(gaps), closing=np.vstack(closing))
    continuity = max(continuity, float(np.max(np.abs(linearised.gaps))))
    return Model(linearised, plain, data, (), readings, continuity)


@eqx.filter_jit
def _on_constraints(system, trial, flat, ts, starts, moves) -> State:
    changed = trial.changed_system(system, trial.named(flat))
    return eqx.filter_vmap(lambda t, start, w: _moved(changed, t, start, w))(ts, starts, moves)


def _moved(system, t, start, w) -> State:
    """The state whose independent coordinates differ by w, in units of the scales, from those of a start."""
    chart = Chart(system, start.states, *start.parts)
    return chart.state(t, chart.coordinates(start.states) + start.scales * w)


@eqx.filter_jit
def _initial(system, trial, flat):
    """The initial state as one vector, and its derivative."""

    def fn(flat):
        state = trial.start(system, trial.named(flat))[1]
        return jnp.concatenate([state.q, state.u])

    return fn(flat), jax.jacfwd(fn)(flat)


def _starts(problem, lane, flat, states) -> Starts:
    parts = _charts(problem.system, problem.trials[lane.number], flat, lane.trials.t0, states)
    return Starts(states, parts[:3], np.asarray(parts[3]))


@eqx.filter_jit
def _charts(system, trial, flat, ts, states):
    changed = trial.changed_system(system, trial.named(flat))
    scales = jnp.concatenate([changed.coordinate_scale(), changed.velocity_scale()])

    def parts(t, state):
        chart = Chart.at(changed, t, state)
        return chart.indices, chart.split, chart.fresh, scales[chart.indices]

    return jax.vmap(parts)(ts, states)


@eqx.filter_jit
def _linearised_lanes(system, trials, static, options, flat, starts):
    """The outcome of every segment; and residuals, scores, start and end with their derivatives, in one batch."""

    def lane(trial, place):
        trial = eqx.combine(trial, static)

        def fn(flat, w):
            theta = trial.named(flat)
            changed = trial.changed_system(system, theta)
            start = _moved(changed, trial.t0, place, w)
            seen = trial.seen(changed, start, theta, options)
            vector = lambda y: jnp.concatenate([y.q, y.u])
            out = seen.rows.residuals, seen.rows.scores, vector(start), vector(seen.end)
            return out, (seen, out)

        w = jnp.zeros_like(place.scales)
        jacobians, (seen, out) = jax.jacfwd(fn, argnums=(0, 1), has_aux=True)(flat, w)
        return seen, [(value, *both) for value, both in zip(out, jacobians, strict=True)]

    return batch(lane)(trials, starts)
