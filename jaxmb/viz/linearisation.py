"""Frequency responses and eigenvalues of small motions."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import ArrayLike

from ..studies.linear import Linearisation
from .figure import MOST, check_single, chosen, color, draw_legend, finish_panel, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# The ends of the frequency axis beside the smallest and the largest eigenvalue, the number of frequencies, and the
# eigenvalues that count as zero, relative to the largest.
_BEYOND, _COUNT, _ZERO = 10.0, 1000, 1e-6
_RATIOS = (0.1, 0.3, 0.5, 0.7)


def plot(
    linear: Linearisation,
    inputs: str | Sequence[str] = (),
    outputs: str | Sequence[str] = (),
    omega: ArrayLike | None = None,
) -> "Figure":
    """As `Linearisation.plot`."""
    check_single(linear.A[..., 0])
    several = lambda names: (names,) if isinstance(names, str) else tuple(names)
    inputs, outputs = several(inputs), several(outputs)
    if not (linear.inputs and linear.outputs) and not inputs and not outputs:
        return _eigenvalues(linear)
    pairs = [(i, o) for i in chosen("input", inputs, linear.inputs) for o in chosen("output", outputs, linear.outputs)]
    if len(pairs) > MOST:
        raise ValueError(
            f"plot: {len(pairs)} frequency responses are too many for a picture; name inputs and outputs, at most "
            f"{MOST} pairs: {', '.join(linear.inputs)} and {', '.join(linear.outputs)}."
        )
    sizes = np.abs(np.asarray(linear.eigenvalues))
    sizes = sizes[sizes > _ZERO * sizes.max(initial=0.0)] if sizes.size else np.ones(1)
    sizes = sizes if sizes.size else np.ones(1)
    given = np.geomspace(sizes.min() / _BEYOND, sizes.max() * _BEYOND, _COUNT) if omega is None else np.asarray(omega)
    response = np.asarray(linear.frequency_response(given))
    figure = new_figure(9.0, 5.0)
    gain, phase = figure.subplots(2, sharex=True)
    for k, (i, o) in enumerate(pairs):
        values = response[:, linear.outputs.index(o), linear.inputs.index(i)]
        gain.loglog(given, np.abs(values), color=color(k), label=f"{i} → {o}")
        phase.semilogx(given, np.degrees(np.unwrap(np.angle(values))), color=color(k))
    finish_panel(gain, "gain, SI units")
    finish_panel(phase, "phase [°]")
    phase.yaxis.set_major_locator(_degrees(phase))
    phase.set_xlabel("ω [rad/s]")
    return figure


def _degrees(axes) -> Any:
    from matplotlib.ticker import MultipleLocator

    low, high = axes.get_ylim()
    return MultipleLocator(next(step for step in (15.0, 45.0, 90.0, 180.0, np.inf) if (high - low) / step <= 8))


def _eigenvalues(linear) -> "Figure":
    """The eigenvalues in the complex plane, with lines of constant damping."""
    figure = new_figure(9.0, 4.8)
    axes = figure.add_subplot()
    values: Any = np.asarray(linear.eigenvalues)
    size = float(np.max(np.abs(values), initial=0.0)) or 1.0
    unstable = values.real > _ZERO * size
    axes.axhline(0.0, color="0.6", linewidth=0.8)
    axes.axvline(0.0, color="0.6", linewidth=0.8)
    for k, (kind, of_kind) in enumerate((("decaying or neutral", ~unstable), ("growing", unstable))):
        if of_kind.any():
            axes.plot(values.real[of_kind], values.imag[of_kind], "ox"[k], color=color(k), label=kind, zorder=3)
    low, high = axes.get_xlim()
    reach = 1.1 * float(np.max(np.abs(values.imag), initial=0.0))
    for ratio in _RATIOS if reach > 0 and low < -_ZERO * size else ():
        slope = np.sqrt(1 - ratio**2) / ratio
        end = min(-low, reach / slope)
        axes.plot([-end, 0.0, -end], [end * slope, 0.0, -end * slope], color="0.8", linewidth=0.8, zorder=1)
        axes.annotate(f"ζ = {ratio:g}", (-end, end * slope), fontsize="x-small", color="0.4", ha="center", va="bottom")
    axes.set(xlabel="Re λ [1/s]", ylabel="Im λ [rad/s]")
    axes.set_xlim(low, high)
    axes.grid(alpha=0.3)
    draw_legend(axes)
    return figure
