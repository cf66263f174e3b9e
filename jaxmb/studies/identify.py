"""Parameters by name from measured motion."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, ArrayLike, Float

from .._results import RESULTS
from .._types import Scalar, State, VectorLike
from ..parts.names import unknown
from ..simulate import simulate
from ..states.assembly import assemble
from ..system import AbstractSystem, with_parameters
from ..trajectory import Trajectory
from .minimise import Minimum, descend, levenberg_marquardt
from .ranges import Bounds, FreeParameters, free_parameters

# A parameter that changes the residuals by less than this, relative to the size of what is measured, has no effect.
_NO_EFFECT = 1e-10

# Directions of parameters to which the residuals are less sensitive than this, relative to the strongest direction, are
# not determined.
_UNDETERMINED = 1e-6
# Parameters with at least this share in such a direction are named.
_SHARE = 0.1

_ITERATIONS = {"lm": 100, "optax": 1000}


@dataclasses.dataclass(frozen=True)
class Identification:
    """The result of `identify`; `print` shows a table.

    **Fields:**

    - `parameters`: estimates by name; `start`: where they started from.
    - `deviations`: standard deviations by name, of the same shapes, from the residuals' Jacobian at the solution.
        Without `sigma` the noise is estimated from the residuals. Infinite for parameters that the data do not
        determine, NaN where there are no more residuals than parameters and no `sigma`.
    - `covariance`: of all components, in the order of `components`, the names of all scalar components.
    - `undetermined`: names of components that can change, alone or together, without changing the residuals.
    - `residuals`: weighted, at the solution; `rms`: their root mean square.
    - `iterations`; `success`: whether the iteration converged; `message` says how it ended.
    - `system`, `state`: with the estimated parameters, ready for `simulate`.
    """

    parameters: dict[str, np.ndarray]
    start: dict[str, np.ndarray]
    deviations: dict[str, np.ndarray]
    covariance: np.ndarray
    components: tuple[str, ...]
    undetermined: tuple[str, ...]
    residuals: np.ndarray
    iterations: int
    success: bool
    message: str
    system: AbstractSystem
    state: State

    @property
    def rms(self) -> float:
        """Root mean square of the weighted residuals."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    def __str__(self) -> str:
        columns = (_flat(self.start), _flat(self.parameters), _flat(self.deviations))
        width = max(len("parameter"), *(len(name) for name in self.components))
        lines = [f"{'parameter':{width}}  {'start':>12}  {'estimate':>12}  {'deviation':>10}"]
        for name, start, value, deviation in zip(self.components, *columns, strict=True):
            lines.append(f"{name:{width}}  {start:12.6g}  {value:12.6g}  {deviation:10.2g}")
        count = f"{self.residuals.size} residuals, rms {self.rms:.3g}, {self.iterations} iterations"
        return "\n".join([*lines, f"{count}: {self.message}"])


def identify(
    system: AbstractSystem,
    measured: Mapping[str, VectorLike] | None = None,
    *,
    ts: ArrayLike,
    free: Mapping[str, VectorLike] | Sequence[str],
    state: State | None = None,
    fix: Mapping[str, VectorLike] | None = None,
    rates: Mapping[str, VectorLike] | None = None,
    t0: Scalar = 0.0,
    sigma: Mapping[str, VectorLike] | None = None,
    bounds: Mapping[str, Bounds] | None = None,
    residual: Callable[[Trajectory], Array] | None = None,
    method: str | optax.GradientTransformation = "lm",
    max_iterations: int | None = None,
    tol: float = 1e-8,
    **options: Any,
) -> Identification:
    """Estimate parameters so that the simulated motion fits a measured one, by nonlinear least squares.

    **Arguments:**

    - `system`: a compiled scene, or another system.
    - `measured`: what was measured at `ts`, by name, with time as axis 0: `{"rocker.angle": (times,), "rod.position":
        (times, 2)}`. Names are those of `Trajectory[body]` (`position`, `velocity`, `angle`, `orientation`,
        `angular_velocity`) and of its reactions (`"A.force"`, `"A.moment"`). A `LagrangianSystem` has coordinates and
        their rates q̇, `"theta"` and `"theta.rate"`, shape (times,), and generalized forces of its constraints,
        `"A.force"`, shape (times, nu). NaN marks a sample that is missing. Angles are compared without wrapping.
    - `ts`: times [s], shape (times,), increasing, from `t0` on.
    - `free`: what to estimate: starting values by name, `{"crank.mass": 1.0}`, or names alone, starting from the
        system's values.

    **The initial state**, at `t0`, is found anew for every value of the parameters by `assemble(guess=state, fix=fix,
    rates=rates)`; a `state` that satisfies the constraints whatever the free parameters is therefore kept as it is.

    **Other arguments:**

    - `sigma`: standard deviation of the noise by name, numbers or arrays that broadcast to the measured ones. Without
        it every quantity is weighted by its own range, and the noise is estimated from the residuals.
    - `bounds`: `(low, high)` by name, either of them None, kept by a change of variables. Parameters that parts declare
        to be positive, such as masses and moments of inertia, stay so without bounds, and inertia matrices stay
        positive definite; the parameters of a `LagrangianSystem` have no such declaration. Unbounded parameters are
        scaled by their start.
    - `residual`: instead of `measured`, a function from the trajectory at `ts` to an array of weighted residuals.
    - `method`: `"lm"`, Levenberg–Marquardt with forward-mode derivatives, best up to some dozens of parameters; or an
        optax optimiser with reverse-mode derivatives of half the mean square residual, such as `optax.adam(0.02)`.
    - `max_iterations`: default 100 for `"lm"`, 1000 for optax; `tol`: change of unknowns and residuals, absolute and
        relative, or size of an optax step, at which to stop.
    - `options`: passed on to `simulate`: `rtol`, `solver`, `manifold`, `max_steps`, …

    A trial at which the mechanism cannot be assembled or the simulation fails is rejected, and a smaller step is tried.

    **Returns:** an `Identification`.

    **Raises:** `ValueError` for unknown names, wrong shapes, starting values out of bounds, and if the simulation with
    the starting values fails or a free parameter has no effect on the residuals there.
    """
    names = free_parameters(system, free, bounds)
    ts = _times(ts, t0)
    problem = _Problem(
        system=system,
        free=names,
        state=system.guess if state is None else state,
        fix=_arrays(fix),
        rates=_arrays(rates),
        t0=jnp.asarray(t0, ts.dtype),
        ts=ts,
        fit=_fit(system, measured, sigma, residual, ts),
        options=_checked(options),
    )
    if method != "lm" and not isinstance(method, optax.GradientTransformation):
        raise ValueError(f"method must be 'lm' or an optax optimiser, got {method!r}.")

    start = jnp.zeros(names.size, ts.dtype)
    _check_start(problem, start)
    kind = "lm" if method == "lm" else "optax"
    limit = _ITERATIONS[kind] if max_iterations is None else max_iterations
    if isinstance(method, str):
        solution = levenberg_marquardt(lambda z: _linearised(problem, z)[:2], start, tol, limit)
    else:
        solution = descend(method, problem.residuals, start, tol, limit)
    return _summary(problem, solution, known_noise=sigma is not None or residual is not None)


class _Measured(eqx.Module):
    """Weighted residuals of measured quantities; missing samples are left out."""

    values: dict[str, Array]
    weights: dict[str, Array]
    present: dict[str, Array]

    def __call__(self, trajectory: Trajectory) -> Float[Array, "residuals"]:
        out = []
        for name, value in self.values.items():
            difference = (trajectory.quantity(name) - value) * self.weights[name]
            out.append(difference.reshape(-1)[self.present[name]])
        return jnp.concatenate(out)

    @property
    def size(self) -> Array:
        """The size of what is measured, weighted."""
        largest = [jnp.max(jnp.abs(self.values[name] * self.weights[name])) for name in self.values]
        return 1 + jnp.max(jnp.stack(largest))


class _Residual(eqx.Module):
    """Residuals of the user."""

    fn: Callable[[Trajectory], Array]
    size: Array

    def __call__(self, trajectory: Trajectory) -> Float[Array, "residuals"]:
        return jnp.asarray(self.fn(trajectory)).reshape(-1)


class _Problem(eqx.Module):
    """Everything that the residuals depend on besides the free parameters."""

    system: AbstractSystem
    free: FreeParameters
    state: State
    fix: dict[str, Array]
    rates: dict[str, Array]
    t0: Array
    ts: Float[Array, "times"]
    fit: _Measured | _Residual
    options: dict[str, Any]

    def initial(self, z: Float[Array, "n"]) -> tuple[AbstractSystem, State]:
        system = with_parameters(self.system, self.free(z))
        state = assemble(system, self.state, fix=self.fix, rates=self.rates, t=self.t0, throw=False)
        return system, state

    def simulate(self, z: Float[Array, "n"], adjoint: diffrax.AbstractAdjoint | None) -> Trajectory:
        system, state = self.initial(z)
        return simulate(
            system, state, t0=self.t0, t1=self.ts[-1], saveat=self.ts, adjoint=adjoint, throw=False, **self.options
        )

    def residuals(self, z: Float[Array, "n"], adjoint: diffrax.AbstractAdjoint | None) -> Float[Array, "residuals"]:
        return self.residuals_and_result(z, adjoint)[0]

    def residuals_and_result(
        self, z: Float[Array, "n"], adjoint: diffrax.AbstractAdjoint | None
    ) -> tuple[Float[Array, "residuals"], RESULTS]:
        """Residuals, infinite if anything failed, and how the simulation ended."""
        trajectory = self.simulate(z, adjoint)
        residuals = self.fit(trajectory)
        ok = (trajectory.result == RESULTS.successful) & jnp.all(jnp.isfinite(residuals))
        return jnp.where(ok, residuals, jnp.inf), trajectory.result


def _times(ts: ArrayLike, t0: Scalar) -> Float[Array, "times"]:
    times = np.asarray(ts, dtype=float)
    if times.ndim != 1 or times.size == 0 or not np.all(np.isfinite(times)) or np.any(np.diff(times) <= 0):
        raise ValueError("ts must be a vector of increasing times.")
    if times[0] < t0 or times[-1] <= t0:
        raise ValueError(f"ts must lie after t0 = {t0}, got times from {times[0]:g} to {times[-1]:g}.")
    return jnp.asarray(times, dtype=jnp.result_type(float))


def _arrays(values: Mapping[str, VectorLike] | None) -> dict[str, Array]:
    return {name: jnp.asarray(value, jnp.result_type(float)) for name, value in (values or {}).items()}


def _checked(options: dict[str, Any]) -> dict[str, Any]:
    for name in ("saveat", "t1", "adjoint", "throw", "event"):
        if name in options:
            raise ValueError(f"identify sets {name!r} of simulate itself; leave it out.")
    return options


def _fit(system, measured, sigma, residual, ts) -> "_Measured | _Residual":
    if (measured is None) == (residual is None):
        raise ValueError("Give either measured quantities by name or a residual function.")
    if measured is None:
        if sigma is not None:
            raise ValueError("sigma belongs to measured quantities; a residual function does its own weighting.")
        return _Residual(residual, jnp.ones((), ts.dtype))
    if not measured:
        raise ValueError("measured is empty: give at least one quantity by name.")
    known = {name: (ts.shape[0], *own.shape) for name, own in system.quantities().items()}
    for name in (*measured, *(sigma or {})):
        if name not in known:
            raise unknown("quantity", name, known)
    values, weights, present = {}, {}, {}
    for name, data in measured.items():
        data = np.asarray(data, dtype=ts.dtype)
        if data.shape != known[name]:
            raise ValueError(
                f"Measured {name!r} must have shape {known[name]} for {ts.shape[0]} times, got {data.shape}."
            )
        there = np.isfinite(data)
        if not there.any():
            raise ValueError(f"Measured {name!r} holds no number.")
        values[name] = jnp.asarray(np.where(there, data, 0.0))
        weights[name] = jnp.asarray(_weights(name, data, sigma))
        present[name] = jnp.asarray(np.flatnonzero(there))
    for name in sigma or {}:
        if name not in measured:
            raise ValueError(f"sigma is given for {name!r}, which is not measured.")
    return _Measured(values, weights, present)


def _weights(name: str, data: np.ndarray, sigma: Mapping[str, VectorLike] | None) -> np.ndarray:
    if sigma is None:
        size = np.nanmax(data) - np.nanmin(data)
        return np.full(data.shape, 1.0 / size if size > 0 else 1.0, data.dtype)
    if name not in sigma:
        raise ValueError(f"sigma is given for other quantities but not for {name!r}; give all or none.")
    deviation = np.asarray(sigma[name], data.dtype)
    if not np.all(deviation > 0):
        raise ValueError(f"sigma of {name!r} must be positive.")
    try:
        return np.broadcast_to(1.0 / deviation, data.shape)
    except ValueError:
        raise ValueError(f"sigma of {name!r} has shape {deviation.shape}, which does not fit {data.shape}.") from None


@eqx.filter_jit
def _linearised(problem: _Problem, z: Float[Array, "n"]):
    """Residuals, their Jacobian, and how the simulation ended."""

    def fn(z):
        residuals, result = problem.residuals_and_result(z, diffrax.ForwardMode())
        return residuals, (residuals, result)

    jacobian, (residuals, result) = jax.jacfwd(fn, has_aux=True)(z)
    return residuals, jacobian, result


def _check_start(problem: _Problem, z: Float[Array, "n"]) -> None:
    residuals, jacobian, result = _linearised(problem, z)
    if not bool(result == RESULTS.successful):
        text = RESULTS[result]  # pyright: ignore[reportInvalidTypeArguments]
        raise ValueError(f"The simulation fails with the starting values: {text}")
    if not bool(jnp.all(jnp.isfinite(residuals))):
        raise ValueError("The residuals are not finite with the starting values.")
    ahead = np.asarray(jnp.max(jnp.abs(jacobian), axis=0) / problem.fit.size)
    position = 0
    for name, r in zip(problem.free.names, problem.free.ranges, strict=True):
        if not np.any(ahead[position : position + r.size] > _NO_EFFECT):
            raise ValueError(f"{name!r} has no effect on what was measured; leave it out of free, or measure more.")
        position += r.size


def _summary(problem: _Problem, solution: Minimum, *, known_noise: bool) -> Identification:
    z = solution.z
    residuals, jacobian, _ = (np.asarray(x) if eqx.is_array(x) else x for x in _linearised(problem, z))
    free = problem.free
    values = {name: np.asarray(value) for name, value in free(z).items()}
    components = tuple(component for name, value in values.items() for component in _components(name, value.shape))
    ahead = np.asarray(jax.jacfwd(free.flat)(z))

    _, sizes, directions = np.linalg.svd(jacobian, full_matrices=True)
    sizes = np.pad(sizes, (0, z.size - sizes.size))
    weak = sizes <= _UNDETERMINED * sizes[0]
    strong = directions[~weak] / sizes[~weak][:, None]
    covariance = ahead @ (strong.T @ strong) @ ahead.T
    surplus = residuals.size - int(np.sum(~weak))
    if not known_noise:
        covariance = covariance * (np.sum(residuals**2) / surplus if surplus > 0 else np.nan)
    moved = np.max(np.abs(ahead @ directions[weak].T), axis=1, initial=0.0)
    scale = np.max(np.abs(ahead), axis=1)
    lost = moved > _SHARE * scale
    covariance[lost, :] = covariance[:, lost] = 0.0
    covariance[lost, lost] = np.inf
    undetermined = tuple(np.array(components)[lost].tolist())

    message = (
        "converged" if solution.success else "the iteration did not converge; try another start, or more iterations"
    )
    if undetermined:
        message += f"; the data do not determine {', '.join(undetermined)} separately"
    system, state = problem.initial(z)
    return Identification(
        parameters=values,
        start={name: np.asarray(r.start) for name, r in zip(free.names, free.ranges, strict=True)},
        deviations=_unflatten(np.sqrt(np.diag(covariance)), values),
        covariance=covariance,
        components=components,
        undetermined=undetermined,
        residuals=residuals,
        iterations=solution.iterations,
        success=solution.success,
        message=message,
        system=system,
        state=state,
    )


def _components(name: str, shape: tuple[int, ...]) -> list[str]:
    return [name + (f"[{', '.join(map(str, index))}]" if index else "") for index in np.ndindex(shape)]


def _flat(values: dict[str, np.ndarray]) -> np.ndarray:
    return np.concatenate([np.ravel(value) for value in values.values()])


def _unflatten(flat: np.ndarray, like: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    out, position = {}, 0
    for name, value in like.items():
        out[name] = flat[position : position + value.size].reshape(value.shape)
        position += value.size
    return out
