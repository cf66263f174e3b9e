"""Eigenvalues drawn along a parameter."""

from typing import TYPE_CHECKING

import numpy as np

from ..studies.linear.root_locus import RootLocus
from .figure import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_root_locus(locus: RootLocus) -> "Figure":
    """Draw real and imaginary parts of all eigenvalues against the parameter, and in the complex plane.

    **Arguments:** `locus`: from `root_locus`.

    **Returns:** a matplotlib `Figure` [1/s, rad/s]; a mode has one colour, and values where it is unstable are grey.

    **Raises:** `ImportError` without matplotlib.
    """
    figure = new_figure(9.0, 6.0)
    (real, plane), (imaginary, empty) = figure.subplots(2, 2, gridspec_kw={"width_ratios": [3, 2]})
    empty.remove()
    for k, values in enumerate(np.asarray(locus.eigenvalues).T):
        color = f"C{k % 10}"
        real.plot(locus.values, values.real, color=color, linewidth=1.2)
        imaginary.plot(locus.values, values.imag, color=color, linewidth=1.2)
        plane.plot(values.real, values.imag, ".", color=color, markersize=3)
        plane.plot(values.real[:1], values.imag[:1], "o", color=color, markersize=5, fillstyle="none")
    for axes in (real, imaginary):
        low, high = axes.get_ylim()
        axes.fill_between(locus.values, low, high, where=~locus.stable(), color="0.92", zorder=0)
        axes.set_ylim(low, high)
        axes.axhline(0.0, color="0.6", linewidth=0.8)
        axes.set_xlabel(locus.name)
    plane.axvline(0.0, color="0.6", linewidth=0.8)
    real.set_ylabel("Re λ [1/s]")
    imaginary.set_ylabel("Im λ [rad/s]")
    plane.set_xlabel("Re λ [1/s]")
    plane.set_ylabel("Im λ [rad/s]")
    return figure
