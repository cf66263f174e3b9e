"""Parameters by name from measured motion."""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from ..._arguments import whole_number
from ..._results import RESULTS
from ..._types import Scalar, State, VectorLike
from ...parts.names import names_arguments
from ...states.arguments import check_no_states
from ...system import AbstractSystem
from ...trajectory import Trajectory
from ..minimise import Minimum, minimise_together
from ..ranges import Bounds
from .experiment import Experiment, with_times
from .identification import Identification
from .loss import loss_named
from .measurements import have_times
from .problem import Model, Problem, level_mask, linearise, linearise_batch, with_likely_levels
from .sensors import Sensor
from .shooting import shoot
from .unknowns import Prior, experiments_by_name, sensors_by_name, unknowns

# A parameter has no effect if it changes the residuals by less than this, relative to the size of the data.
_NO_EFFECT = 1e-10


@functools.partial(names_arguments, gone={"method": "it is Levenberg–Marquardt; optax needs a user-defined loss"})
def identify(
    system: AbstractSystem,
    measured: Any = None,
    *,
    ts: ArrayLike | Mapping[str, ArrayLike] | None = None,
    free: Mapping[str, VectorLike | None] | Sequence[str] = (),
    state: State | None = None,
    fix: Mapping[str, VectorLike] | None = None,
    rates: Mapping[str, VectorLike] | None = None,
    free_initial: Sequence[str] | Mapping[str, VectorLike] = (),
    t0: Scalar = 0.0,
    sensors: Sequence[Sensor] = (),
    sigma: Mapping[str, VectorLike] | None = None,
    bounds: Mapping[str, Bounds] | None = None,
    prior: Mapping[str, Prior] | None = None,
    residual: Callable[[Trajectory], Array] | None = None,
    loss: str = "linear",
    starts: int | Sequence[Mapping[str, VectorLike]] = 1,
    seed: int = 0,
    segments: int = 1,
    max_iterations: int = 100,
    tol: float = 1e-8,
    **options: Any,
) -> Identification:
    """Estimate parameters by nonlinear least squares, so that the simulated motion fits the measured motion.

    ```python
    ts = np.linspace(0.1, 2.0, 20)
    measured = {"bar.angle": jaxmb.simulate(system, state, t1=2.0, saveat=ts)["bar"].angle}
    fit = jaxmb.identify(system, measured, ts=ts, free={"bar.inertia": 0.2}, state=state)
    fit.parameters["bar.inertia"], fit.converged
    ```

    **Arguments:**

    - `system`: a compiled scene, or another system.
    - `measured`: data at `ts` by name, with time as axis 0: `{"rocker.angle": (times,), "rod.position": (times, 2)}`.
        Names are names of `sensors`, of quantities of `Trajectory[body]` (`position`, `velocity`, `angle`,
        `orientation`, `angular_velocity`) and of reactions (`"A.force"`, `"A.moment"`). A `LagrangianSystem` has
        coordinates and their rates q̇, `"theta"` and `"theta_rate"`, shape (times,), and generalized forces of its
        constraints, `"A.force"`, shape (times, nu). NaN marks a missing sample. Angles are compared without wrapping.
        Also accepted are `Measurements`, which `read_measurements` reads with their times from files and tables; and
        one `Experiment` or a list, each with its own data, times and initial state.
    - `ts`: times [s], shape (times,), increasing, from `t0` on. Different times of sensors are given by measured name:
        `ts={"encoder": (times1,), "gyro": (times2,)}`.
    - `free`: the unknowns: starting values by name, `{"crank.mass": 1.0}`, or names alone, starting from the system's
        values. All experiments share a value, unless an experiment has the name in its `own`: this experiment's unknown
        is then `"exp2/crank.mass"`. The `bias`, `gain`, `delay` and `sigma` of a sensor are named after it,
        `"encoder.bias"`. These unknowns are single numbers, or arrays of the quantity's shape if their starts are.
        Noise levels are estimated by maximum likelihood.

    **The initial state**, at `t0`, is recomputed for every value of the parameters by `assemble(guess=state, fix=fix,
    rates=rates)`; a `state` that satisfies the constraints for all values of the free parameters is therefore
    unchanged. `free_initial` names its unknown coordinates and rates, `("crank.angle", "crank.angle_rate")`, or gives
    their starting values by name; these unknowns are called `"initial.crank.angle"`.

    **Other arguments:**

    - `sensors`: instruments between quantities and data.
    - `sigma`: standard deviation of the noise by name, numbers or arrays that broadcast to the data. Without `sigma`
        every quantity is weighted by its range, and the noise is estimated from the residuals.
    - `bounds`: `(low, high)` by name, either of them None, kept by a change of variables. Parameters that parts declare
        to be positive, such as masses and moments of inertia, stay positive without bounds. Inertia matrices stay
        symmetric and positive definite, with principal moments that satisfy the triangle inequalities; they have six
        unknowns, while `jax.grad` by a matrix is not symmetric (`jaxmb help derivatives`). The parameters of a
        `LagrangianSystem` have no such declaration. Unbounded parameters are scaled by their start.
    - `prior`: `(mean, deviation)` by name, of a normal distribution. A prior needs noise levels that are known or free.
    - `residual`: instead of `measured`, a function from the trajectory at `ts` to an array of residuals in units of
        their noise, with time as axis 0.
    - `loss`: the weight of residuals r, in units of σ. The fit minimises `½ Σ ρ(r²)`, as in
        `scipy.optimize.least_squares`: "linear" is least squares; for data with outliers, "soft_l1" is `2 (√(1 + r²) −
        1)`, and "huber" is `r²` up to one σ and `2 |r| − 1` beyond. The robust losses need `sigma` in numbers, or a
        residual function. A residual beyond about one σ then has the influence of one σ, and deviations are estimated
        from the residuals (Huber's M-estimate).
    - `starts`: the number of starting points. The first is `free`; the others are drawn with `seed`: between two
        bounds, or from a normal distribution of the size of the start (log-normal for positive parameters and a single
        bound). A list gives the other starts instead, one mapping for each. All starts are simulated in one batch, and
        the best minimum is returned.
    - `segments`: more than one is multiple shooting, for chaotic or unstable motions that a simulation over the whole
        time does not follow. Each experiment is cut into this number of segments of nearly equal numbers of samples.
        They are simulated in one batch from separate initial states, which the iteration joins.
    - `max_iterations` of Levenberg–Marquardt's method, with derivatives in forward mode, best up to some dozens of
        parameters; `tol`: change of unknowns and objective, absolute and relative, at which to stop.
    - `options`: passed on to `simulate`: `rtol`, `solver`, `manifold`, `max_steps`, …

    A trial is rejected, and a smaller step tried, if the mechanism cannot be assembled or the simulation fails.

    **Returns:** an `Identification`. It is `converged` only if the iteration converged and all tests passed. The tests
    object, and `warnings` give the reasons and remedies, to

    - residuals far beyond `sigma`, or without `sigma` no closer to the data than a constant;
    - residuals that are not noise by their signs, their autocorrelation or their correlation with the prediction;
    - estimates at an end of their range, or not determined by the data;
    - another of the `starts` with an equal fit elsewhere.

    **Raises:** `ValueError` for unknown names, wrong shapes, starting values out of bounds, fewer data than unknowns,
    and if the simulation with the starting values fails or a free parameter has no effect on the residuals there.
    """
    per_experiment = {
        "ts": ts,
        "state": state,
        "fix": fix,
        "rates": rates,
        "residual": residual,
        "free_initial": free_initial,
    }
    problem = _problem(
        system, measured, per_experiment, t0, sensors, sigma, free, bounds, prior, loss_named(loss), options
    )
    limit, segments = whole_number("max_iterations", max_iterations), whole_number("segments", segments)
    points = _starts(problem, starts, seed)
    if segments > 1:
        if len(points) > 1:
            raise ValueError("Multiple shooting, segments > 1, has one start.")
        check_no_states("identify with segments", system)
        shot = shoot(problem, points[0], segments, tol, limit)
        ends = [(shot.objective, shot.z)]
        return Identification(problem, **shot._asdict(), ends=ends, segments=segments, tol=tol, max_iterations=limit)
    _check_start(problem, linearise(problem, points[0]))
    solutions = sorted(_least_squares(problem, points, tol, limit), key=lambda solution: solution.value)
    best = solutions[0]
    model = linearise(problem, best.z)
    return Identification(
        problem,
        best.z,
        objective=model.linearised.value,
        ends=[(solution.value, solution.z) for solution in solutions],
        residuals=model.plain.residuals[: model.data],
        jacobian=model.plain.jacobian,
        readings=model.readings,
        iterations=best.iterations,
        success=best.success,
        tol=tol,
        max_iterations=limit,
    )


def _problem(system, measured, per_experiment, t0, sensors, sigma, free, bounds, prior, loss, options) -> Problem:
    for argument, value in (("sigma", sigma), ("bounds", bounds), ("prior", prior)):
        if value is not None and not isinstance(value, Mapping):
            raise ValueError(f"identify: {argument} is given by name, such as {{'crank.angle': …}}; got {value!r}.")
    several = [measured] if hasattr(measured, "held_out") else measured
    if have_times(measured) or not isinstance(several, list | tuple):
        experiments = {"": with_times(Experiment(measured, **per_experiment, t0=t0))}
    else:
        given = [name for name, value in per_experiment.items() if value is not None and name != "free_initial"]
        given += [name for name, value in (("free_initial", per_experiment["free_initial"]), ("t0", t0)) if value]
        if given:
            arguments = ", ".join(f"{name}=…" for name in dict.fromkeys(("ts", given[0])))
            raise ValueError(f"{given[0]} belongs to each experiment: jaxmb.Experiment(measured, {arguments}).")
        experiments = experiments_by_name(several)
    named = sensors_by_name(system, sensors)
    free, trials, sources, priors = unknowns(system, experiments, named, free, bounds, prior, sigma, loss)
    problem = Problem(
        system=system,
        free=free,
        priors=priors,
        names=tuple(experiments),
        sources=sources,
        fitted=tuple(not experiment.held_out for experiment in experiments.values()),
        trials=trials,
        options=_checked(options),
        known_noise=_known_noise(experiments, named, sigma, trials),
    )
    if loss.robust and not (problem.known_noise and np.all(~level_mask(problem))):
        raise ValueError(f"loss={loss.name!r} needs the size of a large residual: give sigma, as numbers.")
    if priors.names and not problem.known_noise:
        raise ValueError(
            f"The prior of {priors.names[0]!r} is weighed against noise of a known size: give sigma, or free the noise "
            "levels of the sensors, such as 'encoder.sigma'."
        )
    return problem


def _known_noise(experiments, sensors, sigma, trials) -> bool:
    for experiment, trial in zip(experiments.values(), trials, strict=True):
        given = {*(sigma or {}), *(experiment.sigma or {}), *(n for n, s in sensors.items() if s.sigma is not None)}
        free = {name for name, _ in trial.unknowns}
        if not all(name in given or f"{name}.sigma" in free for name in (experiment.measured or {})):
            return False
    return True


def _checked(options: dict[str, Any]) -> dict[str, Any]:
    for name in ("saveat", "t1", "throw", "event", "inputs"):
        if name in options:
            where = "give it to an Experiment" if name == "inputs" else "leave it out"
            raise ValueError(f"identify sets {name!r} of simulate itself; {where}.")
    return options


def _starts(problem: Problem, starts: int | Sequence[Mapping[str, VectorLike]], seed: int) -> list[Array]:
    """The vectors to start from."""
    free = problem.free
    first = jnp.zeros(free.size, problem.trials[0].ts.dtype)
    if isinstance(starts, Sequence) and not isinstance(starts, str):
        points = [first]
        for given in starts:
            for name in given:
                if name not in free.names:
                    raise ValueError(f"starts has {name!r}, which is not free.")
            values = free(first) | {name: jnp.asarray(value, first.dtype) for name, value in given.items()}
            point = free.locate(values)
            if point.shape != first.shape or not np.all(np.isfinite(point)):
                raise ValueError(f"The start {dict(given)} has wrong shapes or lies out of the bounds.")
            points.append(point)
        return points
    starts = whole_number("starts", starts, 1, ", or starting values by name, in a list")
    random = np.random.default_rng(seed)
    draw = lambda: jnp.concatenate([r.draw(random) for r in free.ranges])
    return [first, *(draw() for _ in range(starts - 1))]


def _least_squares(problem: Problem, points: list[Array], tol: float, limit: int) -> list[Minimum]:
    linearised = lambda zs: [model.linearised for model in linearise_batch(problem, zs)]
    levels = level_mask(problem)
    if not levels.any():
        return minimise_together(linearised, points, tol, limit)
    # First the motion is fitted with fixed noise levels, then both, from the levels that the first fit shows.
    coarse = 1e-3 if levels.sum() < levels.size else np.inf
    coarse_minima = minimise_together(linearised, points, coarse, limit, levels) if np.isfinite(coarse) else None
    starts = points if coarse_minima is None else [minimum.z for minimum in coarse_minima]
    starts = [with_likely_levels(problem, z, linearise(problem, z).readings) for z in starts]
    refined = minimise_together(linearised, starts, tol, limit)
    before = [0] * len(points) if coarse_minima is None else [minimum.iterations for minimum in coarse_minima]
    return [result._replace(iterations=result.iterations + more) for result, more in zip(refined, before, strict=True)]


def _check_start(problem: Problem, model: Model) -> None:
    fitted = [number for number, is_fitted in enumerate(problem.fitted) if is_fitted]
    for number, result in zip(fitted, model.results, strict=True):
        if not bool(result == RESULTS.successful):
            text = RESULTS[result]  # pyright: ignore[reportInvalidTypeArguments]
            name = problem.names[number]
            where = f" of experiment {name!r}" if name else ""
            try:
                problem.trials[number].start(problem.system, problem.own(number, problem.free.start), throw=None)
            except ValueError as error:
                # The message names the coordinates of fix, rates and free_initial together.
                text = str(error)
            raise ValueError(f"The simulation{where} fails with the starting values: {text}")
    residuals, jacobian = model.plain.residuals, model.plain.jacobian
    if not np.all(np.isfinite(residuals)):
        raise ValueError("The residuals are not finite with the starting values.")
    size = max(trial.size for trial in problem.trials)
    effect = np.max(np.abs(jacobian), axis=0) / size
    for name in problem.free.names:
        if not np.any(effect[problem.free.place(name)] > _NO_EFFECT):
            raise ValueError(
                f"{name!r} has no effect on the data; leave it out of free, or measure more. If the motion starts at "
                "rest in an equilibrium, give another start by state=, fix= or rates=."
            )
    data = model.data + sum(int(np.size(mean)) for mean in problem.priors.means)
    if data < problem.free.size:
        raise ValueError(
            f"There are {data} measured numbers for {problem.free.size} unknowns; measure more, or free fewer."
        )
