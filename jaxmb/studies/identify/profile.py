"""Profile likelihood: how well the data hold up against every value of one parameter.

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

# Values on either side of the estimate before the search for the ends of the interval is given up.
_MOST = 24


@dataclasses.dataclass(frozen=True)
class Profile:
    """The likelihood of one parameter, all others fitted anew to each of its values.

    **Fields:** `component`; `values`, in order; `ratios`: twice the logarithm of the ratio between the largest
    likelihood and that with each value; `interval`: the values within `level`, by the χ² distribution with one degree
    of freedom, infinite on a side where the data exclude nothing; `fits`: whether each fit converged; `parameters`: the
    values of all parameters, by name, along the first axis.
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
    walk = _Walk(fit, component)
    limit = float(ndtri((1 + level) / 2)) ** 2
    found = [walk.estimate]
    if values is not None:
        values = np.asarray(values, float)
        for side in (np.sort(values[values >= walk.best]), np.sort(values[values < walk.best])[::-1]):
            found += walk.along(side)
    else:
        for sign in (1, -1):
            found += walk.until(sign, limit)
    found = sorted(found, key=lambda own: own[0])
    places = np.array([value for value, *_ in found])
    ratios = np.array([ratio for _, ratio, _ in found])
    low, high = (_end(places, ratios, walk.best, limit, sign) for sign in (-1, 1))
    if values is not None:
        keep = np.isin(places, values)
        places, ratios, found = (
            places[keep],
            ratios[keep],
            [own for own, there in zip(found, keep, strict=True) if there],
        )
    each = [fit.problem.free(minimum.z) for *_, minimum in found]
    return Profile(
        component=component,
        values=places,
        ratios=ratios,
        interval=(low, high),
        level=level,
        fits=np.array([minimum.success for *_, minimum in found]),
        parameters={name: np.stack([np.asarray(own[name]) for own in each]) for name in fit.parameters},
    )


class _Walk:
    """Fits with one component held, each started from the last."""

    def __init__(self, fit: Fit, component: str):
        self.fit = fit
        free = self.fit.problem.free
        name = component.split("[")[0]
        place = free.place(name)
        self.range = free.ranges[free.names.index(name)]
        if not self.range.componentwise:
            raise ValueError(f"{name!r} is a matrix whose components cannot be held alone; profile another parameter.")
        own = [c for c in fit.components if c == name or c.startswith(f"{name}[")]
        self.number = own.index(component)
        self.index = place.start + self.number
        self.row = fit.components.index(component)
        self.held = np.zeros(free.size, bool)
        self.held[self.index] = True
        self.best = float(np.ravel(fit.parameters[name])[self.number])
        self.deviation = float(np.sqrt(fit.covariance[self.row, self.row]))
        self.squares = float(np.sum(fit.residuals**2))
        self.estimate = (self.best, 0.0, Minimum(self.fit.z, 0, fit.success, self.fit.objective))

    def at(self, value: float, start):
        """The fit with the component at a value."""
        like = np.array(self.fit.parameters[self._name()], float)
        like.reshape(-1)[self.number] = value
        z = float(self.range.locate(jnp.asarray(like, start.dtype))[self.number])
        if not np.isfinite(z):
            raise ValueError(f"{self.fit.components[self.row]} = {value:g} is out of its bounds.")
        start = start.at[self.index].set(z)
        problem, fit = self.fit.problem, self.fit
        linearised = lambda z: linearise(problem, z).linearised
        if self.held.all():
            model = linearised(start)
            minimum = Minimum(start, 1, bool(np.isfinite(model.value)), model.value)
        else:
            minimum = levenberg_marquardt(linearised, start, fit.tol, fit.max_iterations, self.held)
        ratio = 2 * (minimum.value - fit.objective) / fit.dispersion
        if not fit.problem.known_noise:
            ratio = self.fit.residuals.size * np.log(2 * minimum.value / self.squares)
        return value, float(ratio), minimum

    def _name(self):
        return self.fit.components[self.row].split("[")[0]

    def along(self, values):
        out, z = [], self.fit.z
        for value in values:
            out.append(self.at(float(value), z))
            z = out[-1][-1].z
        return out

    def until(self, sign: int, limit: float):
        """Steps to one side until the ratio is beyond a limit, or the bound is near."""
        step = 0.5 * self.deviation
        if not np.isfinite(step) or step == 0:
            step = 0.1 * (abs(self.best) or 1.0)
        out, z, value = [], self.fit.z, self.best
        for _ in range(_MOST):
            value = value + sign * step
            try:
                out.append(self.at(value, z))
            except ValueError:
                break
            if not np.isfinite(out[-1][1]):
                out.pop()
                break
            z = out[-1][-1].z
            if out[-1][1] > 1.2 * limit:
                break
        return out


def _end(values, ratios, best, limit, sign) -> float:
    """Where the ratio reaches a limit on one side: the root of the signed root of the ratio, which is nearly linear."""
    side = (values - best) * sign >= 0
    distance, root = (values[side] - best) * sign, np.sqrt(np.maximum(ratios[side], 0.0))
    order = np.argsort(distance)
    distance, root = distance[order], root[order]
    beyond = np.flatnonzero(root > np.sqrt(limit))
    if beyond.size == 0:
        return sign * np.inf
    k = beyond[0]
    # Through three neighbours, so that the error of interpolation is small against the interval.
    near = slice(max(k - 2, 0), k + 1)
    fit = np.polynomial.Polynomial.fit(root[near], distance[near], min(2, k))
    return best + sign * float(fit(np.sqrt(limit)))
