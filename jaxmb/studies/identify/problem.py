"""The misfit of all experiments as a function of one vector of unknowns, with its linearisation."""

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._results import RESULTS
from ..._types import State
from ...simulate.arguments import DEFAULT_RTOL
from ...system import AbstractSystem
from ..batch import batch
from ..minimise import Linearised
from ..ranges import FreeParameters
from .experiment import ExperimentModel, Seen
from .loss import Loss
from .sensors import Channel
from .unknowns import Priors


class Problem(eqx.Module):
    """Experiments that share unknowns.

    **Fields:** `names` of the experiments; `sources`: for each experiment the names of its unknowns among all;
    `fitted`: whether each experiment is fitted, not held out; `known_noise`: whether the noise level of every reading
    is known, or an unknown.
    """

    system: AbstractSystem
    free: FreeParameters
    priors: Priors
    names: tuple[str, ...] = eqx.field(static=True)
    sources: tuple[tuple[str, ...], ...] = eqx.field(static=True)
    fitted: tuple[bool, ...] = eqx.field(static=True)
    trials: tuple[ExperimentModel, ...]
    options: dict[str, Any]
    known_noise: bool = eqx.field(static=True)

    @property
    def loss(self) -> Loss:
        """The loss of all experiments."""
        return self.trials[0].loss

    @property
    def rtol(self) -> float:
        """The relative tolerance of the motions, if no step size controller is given."""
        finest = 10 * float(jnp.finfo(jnp.result_type(float)).eps)
        return max(float(np.max(np.asarray(self.options.get("rtol", DEFAULT_RTOL)))), finest)

    def own(self, number: int, values: Mapping[str, Any]) -> dict[str, Any]:
        """The unknowns of one experiment, by their names in it."""
        names = self.trials[number].unknowns
        return {name: values[source] for (name, _), source in zip(names, self.sources[number], strict=True)}

    def start(self, number: int, z: Float[Array, "n"]) -> tuple[AbstractSystem, State]:
        """The system of one experiment and its initial state."""
        return self.trials[number].start(self.system, self.own(number, self.free(z)))

    def objective(self, z: Float[Array, "n"]) -> Float[Array, ""]:
        """Minus the logarithm of likelihood and priors, up to a constant; infinite if a simulation fails."""
        values = self.free(z)
        total = 0.5 * jnp.sum(self.priors(values) ** 2).astype(z.dtype)
        for number, trial in enumerate(self.trials):
            if self.fitted[number]:
                theta = self.own(number, values)
                total = total + trial.seen(*trial.start(self.system, theta), theta, self.options).rows.objective
        return total

    def columns(self, number: int) -> np.ndarray:
        """The indices of an experiment's unknowns among the components of all."""
        ends = np.cumsum([0, *(r.start.size for r in self.free.ranges)])
        places = {name: np.arange(*ends[k : k + 2]) for k, name in enumerate(self.free.names)}
        indices = [places[name] for name in self.sources[number]]
        return np.concatenate(indices) if indices else np.zeros(0, int)


class Model(NamedTuple):
    """A `Linearised` with its parts.

    **Fields:** `linearised`, with residuals weighted by the loss, and `plain`, unweighted; `data`: the number of
    residuals of data, which come first, before priors and noise levels; `results` of the simulations; `readings`:
    predictions by experiment and sensor; `continuity`: the largest gap between segments.
    """

    linearised: Linearised
    plain: Linearised
    data: int
    results: tuple[RESULTS, ...]
    readings: dict[str, dict[str, np.ndarray]]
    continuity: float = 0.0


def linearise(problem: Problem, z: Float[Array, "n"]) -> Model:
    """Residuals of all fitted experiments and their derivatives with respect to the vector.

    Experiments of the same structure share one compiled program, which differentiates in their own unknowns.
    """
    return linearise_batch(problem, [z])[0]


def linearise_batch(problem: Problem, zs: Sequence[Float[Array, "n"]]) -> list[Model]:
    """`linearise` at several points, simulated as one batch."""
    charts = [values_and_derivatives(problem, z) for z in zs]
    outcomes = {}
    for number, trial in enumerate(problem.trials):
        if problem.fitted[number]:
            columns = problem.columns(number)
            flats = [jnp.asarray(values[columns]) for values, *_ in charts]
            outcomes[number] = list(map(numbers, linearised_trials(problem.system, trial, problem.options, flats)))
    return [_joined(problem, chart, {n: seen[k] for n, seen in outcomes.items()}) for k, chart in enumerate(charts)]


def values_and_derivatives(problem: Problem, z: Float[Array, "n"]) -> tuple[np.ndarray, ...]:
    """All values one after the other, their derivatives, and the rows of the priors with their derivatives."""
    return tuple(map(np.asarray, _chart(problem.free, problem.priors, z)))


def linearised_trials(system, trial, options, flats: Sequence[Array]) -> list[tuple[Seen, Any]]:
    """The outcomes of one experiment for several values of its unknowns, with the derivatives of the misfit's rows."""
    if len(flats) == 1:
        return [_linearised(system, trial, options, flats[0])]
    batch = _linearised_batch(system, trial, options, jnp.stack(flats))
    arrays, static = eqx.partition(batch, eqx.is_array)
    return [eqx.combine(jax.tree.map(lambda x, k=k: x[k], arrays), static) for k in range(len(flats))]


@eqx.filter_jit
def _linearised(system, trial, options, flat):
    return _with_jacobian(system, trial, options, flat)


@eqx.filter_jit
def _linearised_batch(system, trial, options, flats):
    return batch(functools.partial(_with_jacobian, system, trial, options))(flats)


def _with_jacobian(system, trial, options, flat):
    def fn(flat):
        theta = trial.named(flat)
        seen = trial.seen(*trial.start(system, theta), theta, options)
        return (seen.rows.residuals, seen.rows.scores), seen

    jacobians, seen = jacobian_and_value(fn, flat)
    return seen, jacobians


def jacobian_and_value(fn: Callable[[Array], tuple[Any, Any]], flat: Float[Array, "n"]) -> tuple[Any, Any]:
    """The derivatives of the first result of `fn`, also without unknowns, and its second result."""
    if flat.size:
        return jax.jacfwd(fn, has_aux=True)(flat)
    out, value = fn(flat)
    return jax.tree.map(lambda x: jnp.zeros((*x.shape, 0)), out), value


@eqx.filter_jit
def _chart(free, priors, z):
    rows = lambda z: priors(free(z)).astype(z.dtype)
    return free.flat(z), jax.jacfwd(free.flat)(z), rows(z), jax.jacfwd(rows)(z)


def numbers(tree: Any) -> Any:
    """A tree with arrays of NumPy."""
    return jax.tree.map(lambda x: np.asarray(x) if eqx.is_array(x) else x, tree)


def _joined(problem, chart, outcomes) -> Model:
    _, derivatives, prior_rows, prior_jacobian = chart
    residuals, jacobians, scores, score_jacobians, objective = [], [], [], [], 0.5 * prior_rows @ prior_rows
    for number, (seen, (of_residuals, of_scores)) in outcomes.items():
        inward, rows = derivatives[problem.columns(number)], seen.rows
        residuals.append(rows.residuals[rows.present])
        jacobians.append(of_residuals[rows.present] @ inward)
        scores.append(rows.scores)
        score_jacobians.append(of_scores @ inward)
        objective = objective + rows.objective
    plain = Linearised(
        np.concatenate([*residuals, prior_rows, *scores]),
        np.vstack([*jacobians, prior_jacobian, *score_jacobians]),
        objective,
    )
    data = sum(part.size for part in residuals)
    results = tuple(seen.result for seen, _ in outcomes.values())
    readings = {problem.names[n]: seen.readings for n, (seen, _) in outcomes.items()}
    return Model(weighted(problem, plain, data), plain, data, results, readings)


def weighted(problem: Problem, plain: Linearised, data: int) -> Linearised:
    """The linearised objective, with the rows of data, which come first, weighted by the loss."""
    residuals, jacobian = problem.loss.weighted(plain.residuals[:data], plain.jacobian[:data])
    return Linearised(
        np.concatenate([residuals, plain.residuals[data:]]),
        np.vstack([jacobian, plain.jacobian[data:]]),
        plain.objective,
    )


def with_likely_levels(
    problem: Problem, z: Float[Array, "n"], readings: Mapping[str, Mapping[str, np.ndarray]]
) -> Float[Array, "n"]:
    """The vector with the most likely noise levels for predicted readings, by experiment and sensor."""
    values = {name: np.asarray(value) for name, value in problem.free(z).items()}
    squares: dict[str, list] = {}
    for number, source, channel in _levels(problem):
        if problem.fitted[number]:
            level = channel.level(readings[problem.names[number]][channel.name], values[source])
            squares.setdefault(source, []).append((level**2, int(np.sum(channel.present))))
    for source, terms in squares.items():
        total = sum(count for _, count in terms)
        level = np.sqrt(sum(square * count for square, count in terms) / total)
        if np.all(level > 0) and np.all(np.isfinite(level)):
            place, number = problem.free.place(source), problem.free.names.index(source)
            z = z.at[place].set(problem.free.ranges[number].locate(jnp.asarray(level, z.dtype)))
    return z


def level_mask(problem: Problem) -> np.ndarray:
    """The mask of noise levels among the components of the vector."""
    mask = np.zeros(problem.free.size, bool)
    for _, source, _ in _levels(problem):
        mask[problem.free.place(source)] = True
    return mask


def _levels(problem: Problem) -> Iterator[tuple[int, str, Channel]]:
    """The unknown noise levels: the number of the experiment, the name among all unknowns, and the sensor."""
    for number, trial in enumerate(problem.trials):
        channels = {f"{channel.name}.sigma": channel for channel in trial.channels}
        for name, source in zip(dict(trial.unknowns), problem.sources[number], strict=True):
            if name in channels:
                yield number, source, channels[name]
