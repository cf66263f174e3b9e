"""Error against run time and against evaluations, over solvers and tolerances."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import diffrax
import numpy as np

from .._results import RESULTS
from .._types import State
from ..mechanisms import Mechanism, References
from ..parts.names import names_arguments
from ..simulate import simulate
from ..solvers import Adams
from ..system import AbstractSystem
from ..viz.figure import new_figure
from .evaluations import evaluations
from .reference import MARGIN, reference
from .subject import subject
from .table import Table
from .timing import interleaved, timed_compile

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)
# Largest number of labels of an axis without overlap.
_MOST_TICKS = 7


def default_solvers() -> dict[str, diffrax.AbstractSolver]:
    """Adams on independent coordinates, and Runge–Kutta methods of orders 5 and 8 with projection."""
    return {"Adams": Adams(), "Tsit5": diffrax.Tsit5(), "Dopri8": diffrax.Dopri8()}


_COLUMNS = {
    "solver": "",
    "rtol": ".0e",
    "error": ".1e",
    "run [ms]": ".2f",
    "median [ms]": ".2f",
    "compile [s]": ".1f",
    "steps": "d",
    "rejected": "d",
    "evaluations": "d",
}


@names_arguments
def work_precision(
    system: AbstractSystem | Mechanism,
    state: State | None = None,
    *,
    t1: float | None = None,
    solvers: Mapping[str, diffrax.AbstractSolver] | None = None,
    tolerances: Sequence[float] | None = None,
    repeats: int = 5,
) -> Table:
    """Measure the errors of solvers on a motion, and their cost.

    ```python
    print(jaxmb.report.work_precision(system, state, t1=1.0, tolerances=(1e-4, 1e-7), repeats=3))
    ```

    Errors of a mechanism are errors of the quantities that it observes, relative to their sizes. Errors of other
    systems are errors of all coordinates and of all velocities, each relative to the largest, in units of the system's
    size or radians. Reference values are published values of a mechanism, or computed by two methods. All runs are
    compiled before they are timed, in turns, `repeats` times. Only the end of the motion is saved, so that no run
    includes interpolation.

    **Arguments:** `system`, `state`, `t1` [s]: as in `simulate`; or a mechanism of the library alone; `solvers` by
    name, default `Adams`, and `Tsit5` and `Dopri8` of diffrax with projection; `tolerances`: values of `rtol`, default
    1e-4 … 1e-10; `repeats`: at least 1.

    **Returns:** a `Table` with a row for each solver and tolerance. `error` is the largest error, "small" if it is
    below the accuracy of the reference, and "failed" for a failed run, with a note on the reason. Times are the
    shortest and the median of warm runs, and the time to compile the solver's program (or to read it from disk), which
    all tolerances share. `steps` includes rejected steps; `evaluations` of the accelerations are None if unknown.

    **Raises:** `ValueError` for no solvers, no tolerances or no repeats, and for a system without state or `t1`.
    """
    mechanism = subject(system, state, t1)
    solvers = default_solvers() if solvers is None else solvers
    tolerances = TOLERANCES if tolerances is None else tolerances
    if not solvers or not tolerances or repeats < 1:
        raise ValueError("work_precision needs at least one solver, one tolerance and one repeat.")
    if not all(0 < rtol < 1 for rtol in tolerances):
        raise ValueError(f"The tolerances must be between 0 and 1, got {', '.join(f'{x:g}' for x in tolerances)}.")
    references = reference(mechanism, min(tolerances))
    t1 = float(references.times[-1])
    compiled, costs = [], []
    for solver in solvers.values():
        # Tolerances are an argument of one program for each solver.
        start, values = (mechanism.system, mechanism.state), np.asarray(tolerances, mechanism.state.q.dtype)
        fn, seconds = timed_compile(_simulation(solver, t1), *start, values[0])
        compiled += [functools.partial(fn, *start, rtol) for rtol in values]
        costs += [seconds] * len(tolerances)
    times = interleaved(compiled, repeats)
    cases = [(name, rtol) for name in solvers for rtol in tolerances]
    rows, notes = [], []
    for (name, rtol), run, durations, seconds in zip(cases, compiled, times, costs, strict=True):
        trajectory = run()
        error: Any = "failed"
        if bool(trajectory.result == RESULTS.successful):
            error = _error(mechanism, references, trajectory)
        else:
            notes.append(f"{name} at {rtol:.0e}: {outcome(trajectory.result)}")
        steps, rejected = (int(trajectory.stats[key]) for key in ("num_steps", "num_rejected_steps"))
        spans = 1e3 * min(durations), 1e3 * float(np.median(durations)), seconds
        rows.append((name, float(rtol), error, *spans, steps, rejected, evaluations(solvers[name], trajectory.stats)))
    accuracy = MARGIN * references.tolerance
    source = [f"reference: {references.source}; good to {references.tolerance:.0e}"]
    if "small" in [row[2] for row in rows]:
        source.append(f"small: below the reference's accuracy, {accuracy:.0e}")
    title = f"{mechanism.name}, {t1:g} s: largest relative error at the end"
    shown = f"{mechanism.description.rstrip('.') or mechanism.name}; {t1:g} s"
    draw = functools.partial(_plot, title=shown, accuracy=accuracy)
    return Table(title, _COLUMNS, rows, source + notes, draw)


def outcome(result: RESULTS) -> str:
    """The text of a result."""
    return RESULTS[result]  # pyright: ignore[reportInvalidTypeArguments]


def _simulation(solver, t1):
    return lambda system, state, rtol: simulate(system, state, t1=t1, rtol=rtol, solver=solver, throw=False)


def _error(mechanism: Mechanism, references: References, trajectory) -> float | str:
    errors = dataclasses.replace(mechanism, references=references).errors(trajectory)
    largest = max(float(error[-1]) for error in errors.values())
    return "small" if largest < MARGIN * references.tolerance else largest


def _plot(table: Table, title: str, accuracy: float) -> "Figure":
    """Error against run time and against evaluations, both axes logarithmic; failed runs are not shown."""
    from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter

    figure = new_figure(9.0, 4.0)
    panels = figure.subplots(1, 2, sharey=True)
    quantities = (("run time, warm [ms]", "run [ms]"), ("evaluations", "evaluations"))
    for axes, (label, quantity) in zip(panels, quantities, strict=True):
        rows = list(zip(table["solver"], table[quantity], table["error"], strict=True))
        for k, solver in enumerate(dict.fromkeys(table["solver"])):
            own = [(x, error) for name, x, error in rows if name == solver]
            points = [(x, error) for x, error in own if x is not None and not isinstance(error, str)]
            if points:
                axes.loglog(*zip(*points, strict=True), "osD^v<>"[k % 7] + "-", color=f"C{k % 10}", label=solver)
        if accuracy > 0:
            axes.axhline(accuracy, color="0.5", linestyle=":", label=f"{MARGIN:g} times the error of the reference")
        axes.set_xlabel(label)
        axes.xaxis.set_major_locator(FixedLocator(_ticks(*axes.get_xlim())))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    panels[0].set_ylabel("relative error at the end")
    figure.suptitle(title)
    return figure


def _ticks(low, high):
    """Round numbers between two limits, as many as their labels allow."""
    decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    for digits in ((1, 2, 5), (1, 3), (1,)):
        values = np.sort(np.outer(decades, digits).ravel())
        values = values[(values >= low) & (values <= high)]
        if len(values) <= _MOST_TICKS:
            break
    return values.tolist()
