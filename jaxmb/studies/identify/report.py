"""An identification on one page: the table, the fit, the residuals, correlations and profiles."""

import base64
import html
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .fit import Fit
from .prediction import held_out
from .profile import Profile, profile
from .residuals import Outlier

# Largest number of listed outliers.
_MOST = 50

_STYLE = (
    "body{font-family:sans-serif;max-width:60em;margin:2em auto}table{border-collapse:collapse}"
    "td,th{padding:.2em .8em;text-align:right;border-bottom:1px solid #ccc}img{max-width:100%}"
)


def write_report(
    fit: Fit,
    path: str | Path,
    verdict: Sequence[str],
    rows: Sequence[tuple[str, ...]],
    profiles: Sequence[str],
) -> Path:
    """As `Identification.report`; `verdict`: its lines, `rows` of the table of estimates."""
    path = Path(path)
    path = path if path.suffix == ".html" else path / "identification.html"
    path.parent.mkdir(parents=True, exist_ok=True)
    headline, *reasons = map(html.escape, verdict)
    parts = ["<h1>Identification</h1>", f"<p><strong>{headline}</strong></p>"]
    if reasons:
        parts.append("<ul>" + "".join(f"<li>{reason}</li>" for reason in reasons) + "</ul>")
    parts += [
        _table(("parameter", "start", "estimate", "standard deviation", "unit"), rows),
        f"<p>{fit.size_of_residuals}</p>",
    ]
    for direction in fit.combinations:
        text = ", ".join(f"{name} {100 * share:+.3g} %" for name, share in direction.items())
        parts.append(f"<p>The data do not change with {html.escape(text)} together.</p>")
    for name, trial, fitted in zip(fit.problem.names, fit.problem.trials, fit.problem.fitted, strict=True):
        readings = fit.readings[name] if fitted else held_out(fit)[name].readings
        for channel in trial.channels:
            label = " ".join(filter(None, (name, channel.name, "" if fitted else "(held out)")))
            far = [outlier for outlier in fit.outliers if (outlier.experiment, outlier.sensor) == (name, channel.name)]
            predicted = np.asarray(readings[channel.name])
            parts += [f"<h2>{html.escape(label)}</h2>", _fit_figure(trial, channel, predicted, fitted, far)]
    if fit.outliers:
        parts += ["<h2>Residuals beyond 5 σ</h2>", _outliers(fit.outliers)]
    if len(fit.components) > 1:
        parts += ["<h2>Correlations</h2>", _correlations(fit)]
    for component in profiles:
        parts += [f"<h2>Profile of {html.escape(component)}</h2>", _profile_figure(profile(fit, component))]
    page = f"<!doctype html><meta charset='utf-8'><title>Identification</title><style>{_STYLE}</style>"
    path.write_text(page + "\n".join(parts), encoding="utf-8")
    return path


def _table(header, rows) -> str:
    line = lambda tag, cells: "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"
    return "<table>" + line("th", header) + "".join(line("td", row) for row in rows) + "</table>"


def _axes(rows: int, height: float) -> tuple[Any, Any]:
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ImportError("A report needs Matplotlib: pip install jaxmb[plot]") from None
    figure = Figure(figsize=(8, height), layout="constrained")
    return figure, figure.subplots(rows, squeeze=False)[:, 0]


def _image(figure: Any) -> str:
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=120)
    return f"<img src='data:image/png;base64,{base64.b64encode(data.getvalue()).decode()}'>"


def _outliers(outliers: Sequence[Outlier]) -> str:
    """The outliers in a table, the largest first."""
    shown = sorted(outliers, key=lambda outlier: -abs(outlier.residual))[:_MOST]
    rows = [
        (
            " ".join(filter(None, (outlier.experiment, outlier.sensor))),
            ", ".join(map(str, outlier.sample)),
            f"{outlier.t:.6g}",
            f"{outlier.residual:.3g} σ",
        )
        for outlier in shown
    ]
    more = "" if len(shown) == len(outliers) else f"<p>and {len(outliers) - len(shown)} smaller ones</p>"
    return _table(("sensor", "sample", "time [s]", "fitted − measured"), rows) + more


def _fit_figure(trial, channel, predicted, fitted, far: Sequence[Outlier]) -> str:
    """Measured samples and the fit above, their difference below; residuals beyond 5 σ have a ring."""
    figure, (above, below) = _axes(2, 5.0)
    places = np.asarray(channel.places)
    ts = np.asarray(trial.ts)[places]
    measured = np.where(channel.present, channel.values, np.nan)[places].reshape(ts.size, -1)
    predicted = (predicted[places] if fitted else predicted).reshape(ts.size, -1)
    shape = np.shape(channel.values)[1:]
    for outlier in far:
        sample, component = outlier.sample[0], int(np.ravel_multi_index(outlier.sample[1:], shape)) if shape else 0
        ring = {"marker": "o", "markersize": 8, "markerfacecolor": "none", "color": "red", "linestyle": "none"}
        above.plot(ts[sample], measured[sample, component], **ring)
        below.plot(ts[sample], predicted[sample, component] - measured[sample, component], **ring)
    for k in range(measured.shape[1]):
        above.plot(ts, measured[:, k], ".", color=f"C{k}", markersize=3)
        above.plot(ts, predicted[:, k], "-", color=f"C{k}", linewidth=1)
        below.plot(ts, predicted[:, k] - measured[:, k], ".", color=f"C{k}", markersize=3)
    above.set_ylabel("measured and fitted")
    below.set_ylabel("fitted − measured")
    below.set_xlabel("time [s]")
    below.axhline(0, color="0.7", linewidth=0.8)
    return _image(figure)


def _correlations(fit: Fit) -> str:
    deviations = fit.uncertainty.deviations
    # Undetermined components have no correlation: a square without colour.
    sizes = np.where(np.isfinite(deviations) & (deviations > 0), deviations, np.nan)
    correlations = np.where(np.isfinite(fit.covariance), fit.covariance, np.nan) / np.outer(sizes, sizes)
    figure, (axes,) = _axes(1, 1.5 + 0.4 * len(fit.components))
    image = axes.imshow(correlations, vmin=-1, vmax=1, cmap="RdBu")
    axes.set_xticks(range(len(fit.components)), fit.components, rotation=90)
    axes.set_yticks(range(len(fit.components)), fit.components)
    figure.colorbar(image, ax=axes)
    return _image(figure)


def _profile_figure(likelihood: Profile) -> str:
    figure, (axes,) = _axes(1, 3.0)
    axes.plot(likelihood.values, likelihood.ratios, "o-")
    for end in likelihood.interval:
        if np.isfinite(end):
            axes.axvline(end, color="0.6", linestyle="--")
    axes.set_xlabel(likelihood.component)
    axes.set_ylabel("2 log of the likelihood ratio")
    return _image(figure)
