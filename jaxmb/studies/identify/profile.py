"""Profile likelihood: the fit of the data for every value of one parameter.

Source: D. M. Bates and D. G. Watts, "Nonlinear Regression Analysis and Its Applications", Wiley 1988, chapter 6.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtri

from ..._arguments import probability
from ...parts.names import unknown
from ..minimise import Minimum, levenberg_marquardt
from .fit import Fit
from .problem import linearise

# Largest number of values on either side of the estimate in the search for the ends of the interval.
_MOST = 24


@dataclasses.dataclass(frozen=True)
class Profile:
    """The likelihood of one parameter, with all others refitted for each of its values.

    **Fields:**

    - `component`: its name; `values` of the component, in ascending order.
    - `ratios`: twice the logarithm of the ratio of the largest likelihood to the likelihood with each value.
    - `interval`: the values within `level`, by the χ² distribution with one degree of freedom; infinite on a side where
        the data exclude no value.
    - `fits`: whether each fit converged; `parameters`: the values of all parameters, by name, along the first axis.
    """

    component: str
    values: np.ndarray
    ratios: np.ndarray
    interval: tuple[float, float]
    level: float
    fits: np.ndarray
    parameters: dict[str, np.ndarray]


def profile(fit: Fit, component: str, *, level: float = 0.95, values=None) -> Profile:
    """As `Identification.profile`."""
    level = probability("level", level)
    if component not in fit.components:
        raise unknown("component", component, fit.components)
    fit.whole_motions("A profile")
    held, limit = _Held(fit, component), float(ndtri((1 + level) / 2)) ** 2
    points = [(held.best, 0.0, Minimum(fit.z, 0, fit.success, fit.objective))]
    if values is None:
        for sign in (1, -1):
            points += held.along(held.best + sign * held.step * np.arange(1, _MOST + 1), 1.2 * limit)
    else:
        values = np.sort(np.asarray(values, float))
        points += held.along(values[values >= held.best]) + held.along(values[values < held.best][::-1])
    points = sorted(points, key=lambda point: point[0])
    places, ratios = (np.array([point[k] for point in points]) for k in (0, 1))
    low, high = (_end(places, ratios, held.best, limit, sign) for sign in (-1, 1))
    keep = np.ones(places.size, bool) if values is None else np.isin(places, values)
    minima = [minimum for (*_, minimum), is_kept in zip(points, keep, strict=True) if is_kept]
    each = [fit.problem.free(minimum.z) for minimum in minima]
    return Profile(
        component=component,
        values=places[keep],
        ratios=ratios[keep],
        interval=(low, high),
        level=level,
        fits=np.array([minimum.success for minimum in minima]),
        parameters={name: np.stack([np.asarray(fitted[name]) for fitted in each]) for name in fit.parameters},
    )


class _Held:
    """Fits with one component held at a value."""

    def __init__(self, fit: Fit, component: str):
        free, row = fit.problem.free, fit.components.index(component)
        self.fit, self.name = fit, component.split("[")[0]
        self.range = free.ranges[free.names.index(self.name)]
        if not self.range.componentwise:
            raise ValueError(
                f"{self.name!r} is a matrix whose components cannot be held alone; profile another parameter."
            )
        self.number = [other for other in fit.components if other.split("[")[0] == self.name].index(component)
        self.mask = np.zeros(free.size, bool)
        self.mask[free.place(self.name).start + self.number] = True
        self.best = float(np.ravel(fit.parameters[self.name])[self.number])
        step = 0.5 * float(fit.uncertainty.deviations[row])
        self.step = step if np.isfinite(step) and step > 0 else 0.1 * (abs(self.best) or 1.0)

    def along(self, values, limit: float = np.inf) -> list[tuple[float, float, Minimum]]:
        """Values, ratios and fits, each started from the previous fit, up to a ratio beyond the limit.

        **Raises:** `ValueError` for a value out of bounds if there is no limit; otherwise the search ends there.
        """
        out, z = [], self.fit.z
        for value in values:
            place = self._located(value)
            if not np.isfinite(place) and np.isinf(limit):
                raise ValueError(f"{self.name} = {value:g} is out of its bounds.")
            if not np.isfinite(place):
                break
            ratio, minimum = self._fitted(jnp.where(self.mask, place, z))
            if not np.isfinite(ratio) and np.isfinite(limit):
                break
            out.append((float(value), ratio, minimum))
            z = minimum.z
            if ratio > limit:
                break
        return out

    def _located(self, value: float) -> float:
        """The component of the vector for a value."""
        like = np.array(self.fit.parameters[self.name], float)
        like.reshape(-1)[self.number] = value
        return float(self.range.locate(jnp.asarray(like, self.fit.z.dtype))[self.number])

    def _fitted(self, start) -> tuple[float, Minimum]:
        """Twice the logarithm of the likelihood ratio, and the fit."""
        fit, problem = self.fit, self.fit.problem
        linearised = lambda z: linearise(problem, z).linearised
        if self.mask.all():
            value = linearised(start).value
            minimum = Minimum(start, 1, bool(np.isfinite(value)), value)
        else:
            minimum = levenberg_marquardt(linearised, start, fit.tol, fit.max_iterations, self.mask)
        if problem.known_noise:
            return float(2 * (minimum.value - fit.objective) / fit.dispersion), minimum
        return float(fit.residuals.size * np.log(2 * minimum.value / np.sum(fit.residuals**2))), minimum


def _end(values, ratios, best, limit, sign) -> float:
    """The value at which the ratio reaches a limit on one side, by interpolating the root of the ratio, which is nearly
    linear.
    """
    side = (values - best) * sign >= 0
    distance, root = (values[side] - best) * sign, np.sqrt(np.maximum(ratios[side], 0.0))
    order = np.argsort(distance)
    distance, root = distance[order], root[order]
    beyond = np.flatnonzero(root > np.sqrt(limit))
    if beyond.size == 0:
        return sign * np.inf
    k = beyond[0]
    # Three neighbours make the error of interpolation small against the interval.
    near = slice(max(k - 2, 0), k + 1)
    fit = np.polynomial.Polynomial.fit(root[near], distance[near], min(2, k))
    return best + sign * float(fit(np.sqrt(limit)))
