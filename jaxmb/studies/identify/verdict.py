"""Tests of a fit: of the residuals, the estimates, and the ends of several starts.

Every test of residuals rejects a correct fit with normal noise with a probability of about one in a million. A test
rejects only if the misfit is also not small compared with the noise: a significant difference may not matter.

Source: L. Ljung, "System Identification: Theory for the User", 2nd ed., Prentice Hall 1999, chapter 16; J. D. Gibbons
and S. Chakraborti, "Nonparametric Statistical Inference", 5th ed., CRC Press 2011, chapter 3 (runs); R. Leipnik,
"Distribution of the serial correlation coefficient in a circularly correlated universe", Annals of Mathematical
Statistics 18, 1947.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy import special

from ...simulate.arguments import DEFAULT_RTOL
from ..constraint_branches import APART
from .fit import Fit, flat
from .loss import Loss
from .residuals import Outlier, Series

# The significance level of a test.
_LEVEL = 1e-6
# Residuals are beyond σ if their root mean square is larger than this; with a robust loss, if their median is larger,
# relative to the median of normal noise.
_BEYOND, _BEYOND_MEDIAN = 1.25, 2.0
# A smaller fraction of residuals beyond five standard deviations may be outliers.
_FEW = 0.1
# The median of the absolute value of a standard normal variable.
_MEDIAN = 0.6745
# Residuals are not noise if at least this fraction of their mean square is predictable.
_SHARE = 0.2
# Two minima fit equally well if twice the logarithm of their likelihood ratio is less than this; their estimates
# contradict each other if they differ by more than this number of standard deviations.
_AS_WELL, _APART = 10.0, 5.0
# The reason for a missing standard deviation of a component that can change without changing the residuals.
UNDETERMINED = "undetermined"


class Verdict(NamedTuple):
    """Objections to a fit.

    **Fields:** `doubts`: objections to the estimates as a whole; `reasons` for missing standard deviations, in a few
    words, by component; `warnings`: all objections, with remedies.
    """

    doubts: tuple[str, ...]
    reasons: dict[str, str]
    warnings: tuple[str, ...]


class Tried(NamedTuple):
    """The number of `starts` and of `segments` of a fit."""

    starts: int
    segments: int


def judge(fit: Fit) -> Verdict:
    """The objections to the end of an iteration."""
    finite, starts = np.isfinite(fit.ends[0][0]), len(fit.ends)
    doubts = [] if fit.success else ["the iteration did not converge; try another start, or more iterations"]
    if fit.success and fit.continuity > APART:
        doubts.append("its segments end on another branch of the constraints than the next begin; try fewer segments")
    if finite:
        directions, tried = fit.uncertainty.root.shape[1], Tried(starts, fit.segments)
        doubts += of_residuals(fit.series, fit.outliers, directions, fit.problem.loss, tried)
    reasons, warnings = {}, list(doubts)
    if np.any(np.isnan(fit.uncertainty.deviations)):
        reasons |= dict.fromkeys(fit.components, "too few data")
    if fit.undetermined:
        finer = f", or simulate with a smaller rtol than {fit.problem.rtol:g}"
        warnings.append(
            f"the data do not determine {', '.join(fit.undetermined)} separately (`combinations` lists changes that do "
            "not change the residuals): free fewer of them, or measure more" + finer * (fit.problem.rtol > DEFAULT_RTOL)
        )
        reasons |= dict.fromkeys(fit.undetermined, UNDETERMINED)
    for name, words in _at_ends(fit):
        warnings.append(words)
        reasons[name] = "at its end"
    if finite and starts > 1:
        warnings += _of_other_starts(fit)
    if doubts:
        reasons = dict.fromkeys(fit.components, "no fit" if fit.success else "not converged")
    return Verdict(tuple(doubts), reasons, tuple(warnings))


def _at_ends(fit: Fit) -> Iterator[tuple[str, str]]:
    """The components that are at an end of their ranges, with a warning for each."""
    free = fit.problem.free
    reached = free.at_end(fit.z, fit.uncertainty.deviations)
    each = zip(fit.components, reached, flat(fit.start), flat(fit.parameters), free.ends(), strict=True)
    for name, is_reached, start, value, bounds in each:
        if not is_reached:
            continue
        cure = "restrict it to plausible values (bounds=)"
        if bounds is not None:
            cure = "it is held by bounds=({:.6g}, {:.6g}): widen them".format(*bounds)
        yield (
            name,
            f"{name} = {value:.3g} is at an end of its range, from a start at {start:.3g}: {cure}, try other starts "
            "(starts=), or leave it out of free if it has no effect",
        )


def _of_other_starts(fit: Fit) -> Iterator[str]:
    others = [(value, np.asarray(fit.problem.free.flat(z))) for value, z in fit.ends if np.isfinite(value)]
    known_noise, noise = fit.problem.known_noise, fit.uncertainty.noise
    # The estimated noise has a lower bound, since otherwise rounding would distinguish two ends.
    least = max(part.small for part in fit.series) / noise if noise > 0 else np.inf
    least = 1.0 if known_noise and not fit.problem.loss.robust else max(1.0, least)
    count = None if known_noise else fit.residuals.size
    return of_starts(others, fit.components, fit.uncertainty.deviations * least, count, fit.dispersion * least**2)


def of_residuals(
    series: Sequence[Series], far: Sequence[Outlier], directions: int, loss: Loss, tried: Tried
) -> list[str]:
    """The objections of the residuals to a fit, with remedies that were not tried yet.

    **Arguments:** `directions`: the number of fitted combinations of unknowns; `loss`: a robust loss expects some large
    residuals.
    """
    with_known_noise, unknown = (
        [single for single in series if single.known is is_known] for is_known in (True, False)
    )
    out = [
        *(_beyond(with_known_noise, len(far), directions, loss.robust) if with_known_noise else ()),
        *(_explains_nothing(unknown) if unknown else ()),
        *_not_noise(series, directions, loss),
    ]
    return [*out[:-1], f"{out[-1]}. {_cures(tried)}"] if out else []


def _cures(tried: Tried) -> str:
    ended = "the iteration" if tried.starts == 1 else f"the best of {tried.starts} starts"
    starts = "other starts (starts=)" if tried.starts == 1 else "more starts (starts=)"
    pieces = "shorter pieces (segments=)"
    if tried.segments > 1:
        # Multiple shooting has one start, `free`.
        starts, pieces = "another start (free=)", f"shorter pieces than these {tried.segments} (segments=)"
    return (
        f"Either {ended} ended in a local minimum: try {starts}, a range of plausible values (bounds=) and, for a "
        f"fast, unstable or chaotic motion, {pieces}; or the model, the data (a zero, a sign, a unit) or sigma is wrong"
    )


def _beyond(series: list[Series], far: int, directions: int, robust: bool) -> Iterator[str]:
    """The test of the sum of squares against its χ² distribution, for all residuals and for each series; for a robust
    loss the sign test of the median against normal noise.
    """
    whole = np.concatenate([single.residuals for single in series])
    groups = {"": (whole, directions)}
    if len(series) > 1:
        groups |= {f"those of {single.label}": (single.residuals, 0) for single in series}
    worst = None
    for label, (residuals, fitted) in groups.items():
        count, squares = residuals.size - fitted, float(np.sum(residuals**2))
        if robust:
            size = float(np.median(np.abs(residuals))) / _MEDIAN
            above = int(np.sum(np.abs(residuals) > _MEDIAN))
            chance, beyond = _fair_trials(residuals.size - above, residuals.size), size > _BEYOND_MEDIAN
        elif count > 0:
            size = float(np.sqrt(squares / count))
            chance, beyond = chi_squared(squares, count), size > _BEYOND
        else:
            continue
        if beyond and chance * len(groups) < _LEVEL and (worst is None or size > worst[0]):
            worst = size, label
    if worst is None:
        return
    size, label = worst
    what = "median" if robust else "root mean square"
    text = f"the residuals are far beyond sigma, {label or 'all together'} by a factor of {size:.3g} ({what})"
    if far and not robust and far < _FEW * whole.size:
        text += f"; {far} of {whole.size} are beyond 5 σ: if these are outliers, take loss='soft_l1' or 'huber'"
    yield text


def _explains_nothing(series: list[Series]) -> Iterator[str]:
    """Whether constants, one for each series, are closer to the data: an F test."""
    left = right = 0.0
    for single in series:
        measured = single.residuals - single.predicted / single.sigma
        left += float(np.sum(single.residuals**2))
        right += float(np.sum((measured - np.mean(measured)) ** 2))
    small = sum(single.residuals.size * single.small**2 for single in series)
    constants, rest = len(series), sum(single.residuals.size for single in series) - len(series)
    # Both sums of squares are χ² distributed if the residuals are noise and the truth is constant; otherwise the test
    # rejects less often.
    if rest > 0 and left - right > small and special.betainc(rest / 2, constants / 2, right / left) < _LEVEL:
        explained = 1 - left / right if right > 0 else -np.inf
        yield f"the fit explains nothing: constants would be closer to the data (R² = {explained:.3g})"


def _not_noise(series: Sequence[Series], directions: int, loss: Loss) -> Iterator[str]:
    """Whether residuals are predictable: from their signs, from earlier residuals, or from the prediction."""
    told = []
    for single in series:
        # Correlations between outliers do not matter: each counts by its influence on the estimates.
        residuals = loss.influence(single.residuals)[0]
        square = float(np.mean(residuals**2))
        if square <= single.small**2 or residuals.size < 3:
            continue
        for reason, share, chance in dependences(single, residuals, directions):
            # `share` of the mean square is not noise.
            matters = share > _SHARE and share * square > single.small**2
            if matters and chance * len(series) < _LEVEL:
                told.append(f"those of {single.label} {reason}{_offset(single)}")
                break
    hidden = len(told) - 3
    if told:
        more = f", and of {hidden} other series as well" if hidden > 0 else ""
        yield f"the residuals are not noise: {', '.join(told[:3])}{more}"


def dependences(series: Series, r: np.ndarray, directions: int) -> Iterator[tuple[str, float, float]]:
    """By test: how residuals depend on others, the predictable share of their mean square, and its chance in noise."""
    n = r.size
    changes = int(np.sum(np.signbit(r[1:]) != np.signbit(r[:-1])))
    # The probability for normal noise, which the fitted directions may have made slightly smoother.
    yield (
        f"change their sign {changes} times in {n} samples",
        float(np.cos(np.pi * changes / (n - 1))),
        _fair_trials(changes + directions / np.pi, n - 1),
    )
    lags = np.arange(1, max(n // 4, 1) + 1)
    total = float(np.sum(r**2))
    # The correlations at all lags at once, padded with zeros against wrap-around.
    correlations = np.fft.irfft(np.abs(np.fft.rfft(r, 2 * n)) ** 2)[lags] / total
    # A fit correlates its residuals by up to the ratio of fitted directions to samples.
    sizes = np.maximum(np.abs(correlations) - directions / n, 0.0)
    lag = int(np.argmax(sizes))
    yield (
        f"are correlated over {lags[lag]} samples, by {correlations[lag]:.2g}",
        float(sizes[lag]),
        lags.size * _correlation(float(sizes[lag]), n),
    )
    if series.predicted.size:
        follows = (series.predicted - np.mean(series.predicted)) / series.sigma
        norm = float(np.sum(follows**2))
        if norm > 0:
            correlation = float(np.sum(follows * r)) / np.sqrt(norm * total)
            yield (
                f"are correlated with the prediction (correlation {correlation:.2g})",
                correlation**2,
                _correlation(abs(correlation), n),
            )


def _offset(series: Series) -> str:
    """A hint if the residuals are mostly an offset: how to free it."""
    differences = series.residuals * series.sigma
    mean = float(np.mean(differences))
    if not series.ts.size or mean**2 < 0.5 * float(np.mean(differences**2)):
        return ""
    text, bias = f" and are {mean:.3g} on average", f"'{series.sensor}.bias'"
    if not series.bias.free:
        return f"{text} (does the sensor count from another zero? Its offset, {bias}, can be free)"
    if series.bias.components:
        return f"{text} (its offset, {bias}, is one number for all components: start from one for each)"
    if series.bias.experiments:
        return f"{text} (its offset, {bias}, is one for all experiments: name it in their own=, not in free)"
    return f"{text}, though the offset, {bias}, is free"


def chi_squared(value: float, freedoms: int) -> float:
    """The probability that a sum of squares of normal variables is larger."""
    return float(special.chdtrc(freedoms, value))


def _fair_trials(successes: float, trials: int) -> float:
    """The probability of at most this number of successes in fair trials."""
    return float(special.betainc(trials - successes, successes + 1, 0.5)) if successes < trials else 1.0


def _correlation(size: float, count: int) -> float:
    """The probability that noise has a correlation of this size or larger."""
    return float(special.betaincc(0.5, (count - 1) / 2, min(size**2, 1.0)))


def of_starts(
    ends: Sequence[tuple[float, np.ndarray]],
    components: Sequence[str],
    deviations: np.ndarray,
    count: int | None,
    dispersion: float,
) -> Iterator[str]:
    """Whether another start fits equally well, at other estimates.

    **Arguments:** `ends`: objective and components of every start, the best first; `deviations` of the components;
    `count` of residuals if the noise is unknown; `dispersion`: the ratio of twice the differences of the objective to a
    χ² variable.
    """
    best, estimates = ends[0]
    for objective, others in ends[1:]:
        ratio = 2 * (objective - best) / dispersion
        if count is not None:
            # Negligible misfits do not distinguish minima.
            small = 0.5 * count * 1e-6
            ratio = count * np.log((objective + small) / (best + small))
        # An estimate without a deviation decides nothing.
        known = np.isfinite(deviations) & (deviations > 0)
        apart = np.where(known, np.abs(others - estimates), 0.0) / np.where(known, deviations, 1.0)
        k = int(np.argmax(apart))
        if ratio < _AS_WELL and apart[k] > _APART:
            yield (
                f"another start fits as well with {components[k]} = {others[k]:.6g} instead of {estimates[k]:.6g}: the "
                "data do not decide between them; exclude one by bounds=, or take other or longer measurements"
            )
            return
