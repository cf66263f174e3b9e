"""Eigenvalues drawn along a parameter."""

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..studies.linear.root_locus import RootLocus
from .figure import color as color_of, draw_legend, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Eigenvalues below this, relative to the largest, count as zero.
_ZERO = 1e-6


def plot_root_locus(locus: RootLocus, labels: Sequence[str] = ()) -> "Figure":
    """Draw real and imaginary parts of all eigenvalues against the parameter, and in the complex plane.

    ```python
    jaxmb.viz.plot_root_locus(locus, labels=["swing"]).savefig("locus.png")  # `locus` from `jaxmb.root_locus`.
    ```

    Each mode has a colour; a pair of conjugate eigenvalues is one mode, and modes that stay at zero are left out.
    Circles mark the first value, and a grey background an unstable system.

    **Arguments:** `locus`: from `root_locus`; `labels` of the modes in the order of their eigenvalues at the last
    value, by falling imaginary and then by falling real part, default "mode 1", ….

    **Returns:** a matplotlib `Figure` [1/s, rad/s].

    **Raises:** `ValueError` for another number of labels than of modes; `ImportError` without matplotlib.
    """
    modes = _modes(np.asarray(locus.eigenvalues))
    if labels and len(labels) != len(modes):
        raise ValueError(f"plot_root_locus: there are {len(modes)} modes, got {len(labels)} labels.")
    labels = tuple(labels) or tuple(f"mode {k}" for k in range(1, len(modes) + 1))
    figure = new_figure(9.0, 5.5)
    places = figure.subplot_mosaic([["real", "plane"], ["imaginary", "plane"]], width_ratios=[3, 2])
    real, plane, imaginary = places.values()
    for k, (label, mode) in enumerate(zip(labels, modes, strict=True)):
        for order, values in enumerate(mode):
            color, name = color_of(k), None if order else label
            real.plot(locus.values, values.real, color=color, linewidth=1.5, label=name)
            imaginary.plot(locus.values, values.imag, color=color, linewidth=1.5)
            plane.plot(values.real, values.imag, ".", color=color, markersize=3)
            plane.plot(values.real[:1], values.imag[:1], "o", color=color, markersize=6, fillstyle="none")
    ends = np.concatenate([locus.values[:1], locus.boundaries(_ZERO), locus.values[-1:]])
    for axes, label in ((real, "Re λ [1/s]"), (imaginary, "Im λ [rad/s]")):
        for low, high in list(itertools.pairwise(ends))[int(locus.stable(_ZERO)[0]) :: 2]:
            axes.axvspan(low, high, color="0.92", linewidth=0, zorder=0)
        axes.axhline(0.0, color="0.6", linewidth=0.8)
        axes.set(xlabel=locus.name, ylabel=label)
        axes.margins(x=0.0)
    draw_legend(real)
    plane.axvline(0.0, color="0.6", linewidth=0.8)
    plane.axhline(0.0, color="0.6", linewidth=0.8)
    plane.set(xlabel="Re λ [1/s]", ylabel="Im λ [rad/s]")
    return figure


def _modes(eigenvalues):
    """The eigenvalues along the parameter of each mode that does not stay at zero, conjugates together."""
    size, left, out = np.max(np.abs(eigenvalues)), list(eigenvalues.T), []
    left = [values for values in left if np.max(np.abs(values)) > _ZERO * size]
    while left:
        first = left.pop(0)
        mirrored = [k for k, values in enumerate(left) if np.allclose(values[-1], first[-1].conj(), rtol=1e-9)]
        paired = abs(first[-1].imag) > _ZERO * size and mirrored
        out.append([first, left.pop(mirrored[0])] if paired else [first])
    return sorted(out, key=lambda mode: (-abs(mode[0][-1].imag), -mode[0][-1].real))
