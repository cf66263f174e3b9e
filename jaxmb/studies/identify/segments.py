"""The segments of multiple shooting: charts of the constraint manifold at their starts, and the linearised misfit."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._types import State
from ...states.assembly import assemble
from ...system.instant import Instant
from ..batch import batch
from ..minimise import Linearised
from .experiment import ExperimentModel
from .problem import Model, Problem, numbers, values_and_derivatives, weighted


class Lanes(NamedTuple):
    """The segments of one experiment: trials stacked along axis 0, and the number of samples of each."""

    number: int
    trials: ExperimentModel
    static: ExperimentModel
    samples: tuple[int, ...]


class Place(NamedTuple):
    """The vector of the unknowns, and for each experiment the initial states of its segments with charts.

    A chart has bases of the tangent spaces, of q and of u, and the map from changes of both to its coordinates.
    """

    z: Array
    states: tuple[State, ...]
    charts: tuple[Any, ...]

    @property
    def size(self) -> int:
        """The number of the unknowns and the coordinates of all charts."""
        return self.z.size + sum(onto[..., 0].size for *_, onto in self.charts)

    def split(self, vector: Any) -> list[Any]:
        """The charts' coordinates in a vector of unknowns and coordinates, shape (segments, coordinates) for each
        experiment.
        """
        ends = np.cumsum([self.z.size, *(onto[..., 0].size for *_, onto in self.charts)])
        each = zip(self.charts, ends[:-1], ends[1:], strict=True)
        return [vector[begin:end].reshape(onto.shape[:2]) for (*_, onto), begin, end in each]


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
    each = zip(lanes, place.states, place.charts, place.split(change), strict=True)
    for lane, state, charts, move in each:
        trial, flat = problem.trials[lane.number], _values_of(problem, lane, z)
        states.append(_on_constraints(problem.system, trial, flat, lane.trials.t0, state, charts[:2], move))
    return _placed(problem, lanes, z, states)


def _placed(problem, lanes, z, states) -> Place:
    each = zip(lanes, states, strict=True)
    charts = tuple(_charts(problem, lane, _values_of(problem, lane, z), state) for lane, state in each)
    return Place(z, tuple(states), charts)


def _values_of(problem, lane, z):
    """The unknowns of one experiment, one after the other."""
    return jnp.asarray(values_and_derivatives(problem, z)[0][problem.columns(lane.number)])


def evaluated(problem: Problem, lanes: tuple[Lanes, ...], place: Place) -> Model:
    """The linearised problem at a place, in the unknowns and the coordinates of all charts."""
    _, derivatives, prior_rows, prior_jacobian = values_and_derivatives(problem, place.z)
    n, total = place.z.size, place.size
    residuals, jacobian, scores, score_rows, gaps, closing = [], [], [], [], [], []
    readings, objective = {}, 0.5 * prior_rows @ prior_rows
    columns = place.split(np.arange(total))
    for lane, state, charts, lane_columns in zip(lanes, place.states, place.charts, columns, strict=True):
        trial, flat = problem.trials[lane.number], _values_of(problem, lane, place.z)
        inward = derivatives[problem.columns(lane.number)]
        outcome = _linearised_lanes(problem.system, lane.trials, lane.static, problem.options, flat, state, charts[:2])
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
        gaps.append((charts[2] @ (arrival - starts[0])[..., None]).reshape(-1))
        closing.append((charts[2] @ (change - start)).reshape(-1, total))
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
    return Model(linearised, plain, data, (), readings)


@eqx.filter_jit
def _on_constraints(system, trial, flat, ts, states, tangents, moves) -> State:
    changed = trial.changed_system(system, trial.named(flat))
    return eqx.filter_vmap(lambda t, state, along, w: _near(changed, t, state, along, w))(ts, states, tangents, moves)


def _near(system, t, state, tangents, w) -> State:
    """The state closest to the chart's point w, which has coordinates first of q, then of u."""
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


def _charts(problem, lane, flat, states) -> tuple[Any, Any, np.ndarray]:
    system, trial = problem.system, problem.trials[lane.number]
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
    velocity = lambda t, state: Instant.of(changed, t, state).velocity_jacobian
    return jax.vmap(position)(ts, states), jax.vmap(velocity)(ts, states)


@eqx.filter_jit
def _linearised_lanes(system, trials, static, options, flat, states, tangents):
    """The outcome of every segment; and residuals, scores, start and end with their derivatives, in one batch."""

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
