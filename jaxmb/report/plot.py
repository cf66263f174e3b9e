"""The picture of a work–precision report."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ..viz.figure import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_work_precision(title: str, runs: Sequence[Any], disagreement: float) -> "Figure":
    """Error against run time and against evaluations, both axes logarithmic; failed runs are not shown.

    **Arguments:** `runs` of the report; `disagreement`: the relative error up to which its reference can be trusted.
    """
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    figure = new_figure(9.0, 4.0)
    panels = figure.subplots(1, 2, sharey=True)
    quantities = (("run time, warm [ms]", lambda run: 1e3 * run.shortest), ("evaluations", lambda run: run.evaluations))
    for axes, (label, quantity) in zip(panels, quantities, strict=True):
        for k, solver in enumerate(dict.fromkeys(run.solver for run in runs)):
            points = [(quantity(run), run.error) for run in runs if run.solver == solver and not run.message]
            points = [(x, error) for x, error in points if x is not None]
            if points:
                axes.loglog(*zip(*points, strict=True), "osD^v<>"[k % 7] + "-", color=f"C{k % 10}", label=solver)
        if disagreement > 0:
            axes.axhline(disagreement, color="0.5", linestyle=":", label="accuracy of the reference")
        axes.set_xlabel(label)
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize="small")
    panels[0].set_ylabel("relative error at the end")
    figure.suptitle(title)
    return figure
