"""Floquet's multipliers in the complex plane."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..studies.linear import Floquet
from .figure import check_single, color, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Multipliers beyond the unit circle by less than this are on it, up to errors of integration.
_ROUNDING = 1e-6


def plot(periodic: Floquet) -> "Figure":
    """As `Floquet.plot`."""
    check_single(periodic.monodromy[..., 0])
    values: Any = np.asarray(periodic.multipliers)
    figure = new_figure(5.5, 4.8)
    axes = figure.add_subplot()
    around: Any = np.exp(1j * np.linspace(0.0, 2 * np.pi, 200))
    axes.fill(around.real, around.imag, facecolor="0.94", edgecolor="0.5", linewidth=0.9, zorder=0)
    outside = np.abs(values) > 1 + _ROUNDING
    for kind, chosen, k in (("stable", ~outside, 0), ("unstable", outside, 1)):
        if chosen.any():
            label = f"{kind}, {int(chosen.sum())} multipliers" if chosen.sum() > 1 else kind
            axes.plot(values.real[chosen], values.imag[chosen], "os"[k], color=color(k), label=label, zorder=3)
    for value in values[outside]:
        place = {"xytext": (6, 6), "textcoords": "offset points", "fontsize": "small"}
        axes.annotate(f"{abs(value):.3g}", (value.real, value.imag), **place)
    axes.set(xlabel="Re μ", ylabel="Im μ", aspect="equal")
    axes.set_title(f"Floquet multipliers, period {float(periodic.period):.4g} s", fontsize="medium")
    axes.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=2, fontsize="small", frameon=False)
    return figure
