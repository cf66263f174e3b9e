"""Frequency responses, eigenvalues and Floquet's multipliers of small motions."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import ArrayLike

from ..bodies.units import effort, named
from ..studies.linear import Floquet, Linearisation
from .figure import MOST, check_single, chosen, color, draw_legend, finish_panel, new_figure

# The ends of the frequency axis beside the smallest and the largest eigenvalue, the number of frequencies, and the
# eigenvalues that count as zero, relative to the largest.
_BEYOND, _COUNT, _ZERO = 10.0, 1000, 1e-6
_RATIOS = (0.1, 0.3, 0.5, 0.7)
# Multipliers beyond the unit circle by less than this are on it, up to errors of integration.
_ROUNDING = 1e-6


def linearisation(
    linear: Linearisation,
    inputs: str | Sequence[str] = (),
    outputs: str | Sequence[str] = (),
    omega: ArrayLike | None = None,
) -> Any:
    """As `Linearisation.plot`."""
    check_single(linear.A[..., 0])
    if not (linear.inputs and linear.outputs) and not inputs and not outputs:
        return _eigenvalues(linear)
    pairs = [(i, o) for i in chosen("input", inputs, linear.inputs) for o in chosen("output", outputs, linear.outputs)]
    if len(pairs) > MOST:
        raise ValueError(f"plot shows {MOST} frequency responses, not {len(pairs)}; name fewer inputs or outputs.")
    sizes = np.abs(np.asarray(linear.eigenvalues))
    sizes = sizes[sizes > _ZERO * sizes.max(initial=0.0)]
    sizes = sizes if sizes.size else np.ones(1)
    given = np.geomspace(sizes.min() / _BEYOND, sizes.max() * _BEYOND, _COUNT) if omega is None else np.asarray(omega)
    response = np.asarray(linear.frequency_response(given))
    figure = new_figure(9.0, 5.0)
    gain, phase = figure.subplots(2, sharex=True)
    for k, (i, o) in enumerate(pairs):
        values = response[:, linear.outputs.index(o), linear.inputs.index(i)]
        gain.loglog(given, np.abs(values), color=color(k), label=f"{i} → {o}")
        phase.semilogx(given, np.degrees(np.unwrap(np.angle(values))), color=color(k))
    base = lambda name: name.split("[")[0]
    per = {f"{named(linear.system, base(o)).unit}/({effort(linear.system, base(i))[1]})" for i, o in pairs}
    is_known = len(per) == 1 and not any(x.startswith("/") or "()" in x for x in per)
    finish_panel(gain, f"gain [{per.pop()}]" if is_known else "gain, SI units")
    finish_panel(phase, "phase [°]")
    low, high = phase.get_ylim()
    step = next(step for step in (15.0, 45.0, 90.0, 180.0, 360.0) if high - low <= 8 * step or step == 360)
    phase.set_yticks(np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step)
    phase.set_xlabel("ω [rad/s]")
    return figure


def _eigenvalues(linear) -> Any:
    """The eigenvalues in the complex plane, with lines of constant damping."""
    figure = new_figure(9.0, 4.8)
    axes = figure.add_subplot()
    values: Any = np.asarray(linear.eigenvalues)
    size = float(np.max(np.abs(values), initial=0.0)) or 1.0
    unstable = values.real > _ZERO * size
    axes.axhline(0.0, color="0.6", linewidth=0.8)
    axes.axvline(0.0, color="0.6", linewidth=0.8)
    axes.margins(0.1)
    for k, (kind, of_kind) in enumerate((("stable or neutral", ~unstable), ("unstable", unstable))):
        if of_kind.any():
            axes.plot(values.real[of_kind], values.imag[of_kind], "ox"[k], color=color(k), label=kind, zorder=3)
    low, high = axes.get_xlim()
    reach = 1.1 * float(np.max(np.abs(values.imag), initial=0.0))
    for ratio in _RATIOS if reach > 0 and low < -_ZERO * size else ():
        slope = np.sqrt(1 - ratio**2) / ratio
        end = min(-low, reach / slope)
        beside = {"fontsize": "x-small", "color": "0.4", "xytext": (3, 2), "textcoords": "offset points"}
        axes.plot([-end, 0.0, -end], [end * slope, 0.0, -end * slope], color="0.8", linewidth=0.8, zorder=1)
        axes.annotate(f"ζ = {ratio:g}", (-end, end * slope), **beside)
    axes.set(xlabel="Re λ [1/s]", ylabel="Im λ [rad/s]")
    axes.set_xlim(low, high)
    axes.grid(alpha=0.3)
    draw_legend(axes)
    return figure


def floquet(periodic: Floquet) -> Any:
    """As `Floquet.plot`."""
    check_single(periodic.monodromy[..., 0])
    values: Any = np.asarray(periodic.multipliers)
    figure = new_figure(5.5, 4.8)
    axes = figure.add_subplot()
    around: Any = np.exp(1j * np.linspace(0.0, 2 * np.pi, 200))
    axes.fill(around.real, around.imag, facecolor="0.94", edgecolor="0.5", linewidth=0.9, zorder=0)
    outside = np.abs(values) > 1 + _ROUNDING
    for kind, these, k in (("stable", ~outside, 0), ("unstable", outside, 1)):
        if these.any():
            label = f"{kind}: {int(these.sum())}, |μ| up to {np.abs(values[these]).max():.4g}"
            axes.plot(values.real[these], values.imag[these], "os"[k], color=color(k), label=label, zorder=3)
    axes.set(xlabel="Re μ", ylabel="Im μ", aspect="equal")
    axes.locator_params(nbins=5)
    axes.set_title(f"Floquet multipliers, period {float(periodic.period):.4g} s", fontsize="medium")
    axes.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=2, fontsize="small", frameon=False)
    return figure
