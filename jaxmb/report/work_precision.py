"""Error against run time and against evaluations, over solvers and tolerances."""

import dataclasses
import functools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import diffrax
import numpy as np

from .._printed import Printed
from .._results import RESULTS
from .._types import State
from .._version import __version__
from ..mechanisms import Mechanism, References
from ..parts.names import names_arguments
from ..simulate import simulate
from ..solvers import Adams
from ..system import AbstractSystem
from ..viz.figure import new_figure
from .evaluations import evaluations
from .reference import MARGIN, reference
from .subject import subject
from .table import aligned
from .timing import interleaved, timed_compile

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)
# More labels of an axis would overlap.
_MOST_TICKS = 7


def default_solvers() -> dict[str, diffrax.AbstractSolver]:
    """Adams on independent coordinates, and Runge–Kutta methods of orders 5 and 8 with projection."""
    return {"Adams": Adams(), "Tsit5": diffrax.Tsit5(), "Dopri8": diffrax.Dopri8()}


@dataclasses.dataclass(frozen=True)
class Run:
    """One solver at one tolerance.

    **Fields:** `solver`; `rtol`; `error`: the largest relative error at the end, NaN if the run failed, and None where
    it is below the accuracy of the reference, so that it is not known; `times` [s] of the warm runs; `compile_time` [s]
    of the solver's program, which serves all its tolerances, or to read it where it is kept on disk; `steps`, accepted
    and rejected together, and `rejected`; `evaluations` of the accelerations, None if unknown; `message`: why the run
    failed, or empty.
    """

    solver: str
    rtol: float
    error: float | None
    times: tuple[float, ...]
    compile_time: float
    steps: int
    rejected: int
    evaluations: int | None
    message: str = ""

    @property
    def shortest(self) -> float:
        """The shortest warm run time [s], the one least disturbed by other load."""
        return min(self.times)

    @property
    def median(self) -> float:
        """The median warm run time [s]."""
        return float(np.median(self.times))


@dataclasses.dataclass(frozen=True, repr=False)
class WorkPrecision(Printed):
    """The result of `work_precision`; `print` and notebooks show a table.

    **Fields:** `mechanism`: its name; `title`: what it is, in words; `t1` [s]; `runs`; `source` of the reference
    values, and `disagreement`, the relative error up to which they can be trusted: as published, or the difference of
    the two methods that computed them.
    """

    mechanism: str
    title: str
    t1: float
    runs: tuple[Run, ...]
    source: str
    disagreement: float

    def __str__(self) -> str:
        lines = [f"{self.mechanism}, {self.t1:g} s; largest relative error at the end, against reference values:"]
        lines += [f"  {self.source}; good to {self.disagreement:.0e}"]
        if any(run.error is None for run in self.runs):
            lines += [f"  small: below the reference's accuracy, {MARGIN * self.disagreement:.0e}"]
        rows = [_HEADER, *map(_cells, self.runs)]
        lines += aligned(rows, words=0)
        return "\n".join(lines + [f"{run.solver} at {run.rtol:.0e}: {run.message}" for run in self.runs if run.message])

    def _repr_html_(self) -> str:
        head = "".join(f"<th>{cell}</th>" for cell in _HEADER)
        body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in _cells(run))}</tr>" for run in self.runs)
        caption = f"{self.mechanism}, {self.t1:g} s; reference: {self.source}, good to {self.disagreement:.1e}"
        return f"<table><caption>{caption}</caption><tr>{head}</tr>{body}</table>"

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, strings and lists, for JSON, with the version of jaxmb."""
        return {"jaxmb": __version__, **dataclasses.asdict(self)}

    def figure(self, path: str | Path) -> None:
        """Write a picture (PNG, SVG or PDF by the path's ending): error against run time and against evaluations.

        Its numbers stand in the file as well, those of `to_dict` as JSON, as the description of a PNG or SVG and the
        subject of a PDF.

        **Raises:** `ImportError` that names the extra to install if matplotlib is missing.
        """
        key = "Subject" if Path(path).suffix.lower() == ".pdf" else "Description"
        _plot(self).savefig(path, dpi=150, metadata={key: json.dumps(self.to_dict())})


_HEADER = ("solver", "rtol", "error", "run [ms]", "median", "compile [s]", "steps", "rejected", "evaluations")


def _cells(run: Run) -> tuple[str, ...]:
    return (
        run.solver,
        f"{run.rtol:.0e}",
        "failed" if run.message else "small" if run.error is None else f"{run.error:.1e}",
        f"{1e3 * run.shortest:.2f}",
        f"{1e3 * run.median:.2f}",
        f"{run.compile_time:.1f}",
        str(run.steps),
        str(run.rejected),
        "–" if run.evaluations is None else str(run.evaluations),
    )


@names_arguments
def work_precision(
    system: AbstractSystem | Mechanism,
    state: State | None = None,
    *,
    t1: float | None = None,
    solvers: Mapping[str, diffrax.AbstractSolver] | None = None,
    tolerances: Sequence[float] | None = None,
    repeats: int = 5,
) -> WorkPrecision:
    """Measure the errors of solvers on a motion, and their cost.

    ```python
    print(jaxmb.report.work_precision(system, state, t1=1.0, tolerances=(1e-4, 1e-7), repeats=3))
    ```

    Errors are those of the quantities that a mechanism observes, relative to their sizes; of other systems those of all
    coordinates, relative to the largest, and of all velocities, in units of the system's size or radians. Reference
    values are the published ones of a mechanism, or computed by two methods. Every run is compiled before it is timed;
    then all of them run in turns `repeats` times. Only the end of the motion is saved, so that no run includes
    interpolation.

    **Arguments:** `system`, `state`, `t1` [s]: as in `simulate`; or a mechanism of the library alone; `solvers` by
    name, default `Adams`, and `Tsit5` and `Dopri8` of diffrax with projection; `tolerances`: values of `rtol`, default
    1e-4 … 1e-10; `repeats`: at least 1.

    **Returns:** a `WorkPrecision`. A failed run keeps its row, with a message.

    **Raises:** `ValueError` for no solvers, no tolerances or no repeats, and for a system without state or `t1`.
    """
    mechanism = subject(system, state, t1)
    solvers = default_solvers() if solvers is None else solvers
    tolerances = TOLERANCES if tolerances is None else tolerances
    if not solvers or not tolerances or repeats < 1:
        raise ValueError("work_precision needs at least one solver, one tolerance and one repeat.")
    if not all(0 < rtol < 1 for rtol in tolerances):
        raise ValueError(f"The tolerances must be between 0 and 1, got {', '.join(f'{x:g}' for x in tolerances)}.")
    known = reference(mechanism, min(tolerances))
    t1 = float(known.times[-1])
    compiled, costs = [], []
    for solver in solvers.values():
        # Tolerances are an argument of one program for each solver.
        start, values = (mechanism.system, mechanism.state), np.asarray(tolerances, mechanism.state.q.dtype)
        fn, seconds = timed_compile(_simulation(solver, t1), *start, values[0])
        compiled += [functools.partial(fn, *start, rtol) for rtol in values]
        costs += [seconds] * len(tolerances)
    times = interleaved(compiled, repeats)
    cases = [(name, rtol) for name in solvers for rtol in tolerances]
    runs = []
    for (name, rtol), run, own, seconds in zip(cases, compiled, times, costs, strict=True):
        trajectory = run()
        ok = bool(trajectory.result == RESULTS.successful)
        runs.append(
            Run(
                solver=name,
                rtol=rtol,
                error=_error(mechanism, known, trajectory) if ok else float("nan"),
                times=own,
                compile_time=seconds,
                steps=int(trajectory.stats["num_steps"]),
                rejected=int(trajectory.stats["num_rejected_steps"]),
                evaluations=evaluations(solvers[name], trajectory.stats),
                message="" if ok else outcome(trajectory.result),
            )
        )
    title = mechanism.description.rstrip(".") or mechanism.name
    return WorkPrecision(mechanism.name, title, t1, tuple(runs), known.source, known.tolerance)


def outcome(result: RESULTS) -> str:
    """The text of a result."""
    return RESULTS[result]  # pyright: ignore[reportInvalidTypeArguments]


def _simulation(solver, t1):
    return lambda system, state, rtol: simulate(system, state, t1=t1, rtol=rtol, solver=solver, throw=False)


def _error(mechanism: Mechanism, known: References, trajectory) -> float | None:
    errors = dataclasses.replace(mechanism, references=known).errors(trajectory)
    largest = max(float(error[-1]) for error in errors.values())
    return None if largest < MARGIN * known.tolerance else largest


def _plot(report: WorkPrecision) -> "Figure":
    """Error against run time and against evaluations, both axes logarithmic; failed runs are not shown."""
    from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter

    figure = new_figure(9.0, 4.0)
    panels = figure.subplots(1, 2, sharey=True)
    quantities = (("run time, warm [ms]", lambda run: 1e3 * run.shortest), ("evaluations", lambda run: run.evaluations))
    for axes, (label, quantity) in zip(panels, quantities, strict=True):
        for k, solver in enumerate(dict.fromkeys(run.solver for run in report.runs)):
            points = [(quantity(run), run.error) for run in report.runs if run.solver == solver and not run.message]
            points = [(x, error) for x, error in points if x is not None and error is not None]
            if points:
                axes.loglog(*zip(*points, strict=True), "osD^v<>"[k % 7] + "-", color=f"C{k % 10}", label=solver)
        if report.disagreement > 0:
            axes.axhline(MARGIN * report.disagreement, color="0.5", linestyle=":", label="accuracy of the reference")
        axes.set_xlabel(label)
        low, high = axes.get_xlim()
        axes.xaxis.set_major_locator(FixedLocator(_ticks(low, high)))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    panels[0].set_ylabel("relative error at the end")
    figure.suptitle(f"{report.title}; {report.t1:g} s")
    return figure


def _ticks(low, high):
    """Round numbers between two limits, as many as have room for their labels."""
    decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    for digits in ((1, 2, 5), (1, 3), (1,)):
        values = np.sort(np.outer(decades, digits).ravel())
        values = values[(values >= low) & (values <= high)]
        if len(values) <= _MOST_TICKS:
            break
    return values.tolist()
