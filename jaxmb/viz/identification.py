"""A fit beside its data, with residuals and bands of confidence."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..bodies.units import named
from ..studies.identify import Identification
from .figure import chosen, color, finish_panel, new_figure, shown_unit, with_unit

# The largest number of rows, and the residual [σ] beyond which outliers have a ring.
_ROWS, _FAR = 8, 5.0
# Measured values are rings; the sum of the diameters of many [points].
_HOLLOW: dict[str, Any] = {"fillstyle": "none", "markeredgewidth": 0.8}
_RING = 500.0


def plot(fit: Identification, names: Sequence[str] = (), level: float | None = 0.95) -> Any:
    """As `Identification.plot`."""
    series = [one for one in fit.series if one.ts.size]
    if not series:
        raise ValueError("plot: the data were compared by a residual function, so that there are no curves to show.")
    sensors = chosen("sensor", names, dict.fromkeys(one.sensor for one in series))
    rows: dict[tuple[str, str], list[Any]] = {}
    for one in series:
        if one.sensor in sensors:
            rows.setdefault((one.experiment, one.sensor), []).append(one)
    worst = sorted(rows, key=lambda row: -max(one.square for one in rows[row]))[:_ROWS]
    shown = {row: of_row for row, of_row in rows.items() if row in worst}
    figure = new_figure(9.0, 2.1 * len(shown) + 0.9)
    places: Any = figure.subplots(len(shown), 2, squeeze=False, width_ratios=(1.6, 1))
    bands = _bands(fit, shown, level)
    for (left, right), (row, of_row) in zip(places, shown.items(), strict=True):
        _draw_fit(fit, left, row, of_row, bands)
        _draw_residuals(right, of_row)
    for axes in places[-1]:
        axes.set_xlabel("t [s]")
    parts = ["○ measured", "– fitted"] + ([f"shaded: {level:.0%} confidence"] if bands else [])
    more = f"; {len(shown)} of {len(rows)} sensors, those with the largest residuals" if len(shown) < len(rows) else ""
    verdict = "" if fit.converged else "Not to be trusted: see fit.warnings. "
    tint = "firebrick" if verdict else "black"
    figure.suptitle(verdict + ", ".join(parts) + more, fontsize="medium", color=tint)
    return figure


def _draw_fit(fit, axes, row, of_row, bands):
    """Data as rings, and the fit as lines in the same colours."""
    experiment, sensor = row
    channel = _channel(fit, experiment, sensor)
    own = named(fit.problem.system, channel.quantity)
    measured = [one.predicted - one.residuals * one.sigma for one in of_row]
    factor, unit = shown_unit(own.unit, *measured)
    for k, (one, data) in enumerate(zip(of_row, measured, strict=True)):
        # Rings are seen beside a line; many are small, so that they do not merge.
        size = float(np.clip(_RING / data.size, 2.0, 5.0))
        axes.plot(one.ts, factor * data, "o", color=color(k), markersize=size, alpha=0.7, **_HOLLOW)
        axes.plot(one.ts, factor * one.predicted, color=color(k), linewidth=1.4, label=one.label)
        if (experiment, channel.quantity) in bands:
            ts, low, high = bands[experiment, channel.quantity]
            at = (slice(None), *one.component)
            axes.fill_between(ts, factor * low[at], factor * high[at], color=color(k), alpha=0.25, linewidth=0)
        far = np.abs(one.residuals) > _FAR if one.known else np.zeros(one.ts.shape, bool)
        axes.plot(one.ts[far], factor * data[far], "o", color="firebrick", fillstyle="none", markersize=7)
    finish_panel(axes, with_unit(own.word, unit))


def _draw_residuals(axes, of_row):
    """Fitted minus measured, in units of the noise."""
    known = all(one.known for one in of_row)
    for k, one in enumerate(of_row):
        axes.plot(one.ts, one.residuals, ".", color=color(k), markersize=3)
    if known:
        axes.axhspan(-2.0, 2.0, color="0.93", zorder=0)
    axes.axhline(0.0, color="0.6", linewidth=0.8)
    finish_panel(axes, "fitted − measured [σ]" if known else "fitted − measured [of range]")


def _channel(fit, experiment, sensor) -> Any:
    trial = fit.problem.trials[fit.problem.names.index(experiment)]
    return next(channel for channel in trial.channels if channel.name == sensor)


def _bands(fit, shown, level) -> dict[tuple[str, str], tuple[Any, Any, Any]]:
    """Times, and ends of the bands by experiment and quantity, of sensors that show quantities as they are."""
    if level is None or fit.segments > 1 or fit.verdict.doubts:
        return {}
    out = {}
    for experiment in dict.fromkeys(experiment for experiment, _ in shown):
        channels = [_channel(fit, *row) for row in shown if row[0] == experiment]
        plain = [own.quantity for own in channels if _is_plain(fit, own)]
        if plain:
            found = fit.predict(plain, experiment=experiment, level=level)
            out |= {(experiment, name): (found.ts, found.low[name], found.high[name]) for name in plain}
    return out


def _is_plain(fit, channel) -> bool:
    """Whether the readings are the quantity, without gain, bias and delay."""
    free = any(f"{channel.name}.{key}" in fit.parameters for key in ("bias", "gain", "delay"))
    return not free and bool(np.all(channel.bias == 0) and np.all(channel.gain == 1) and np.all(channel.delay == 0))
