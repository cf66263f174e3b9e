"""Costs of features that a scene does not use, measured by switching each of them on."""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import diffrax
import equinox as eqx
import numpy as np

from .._printed import Printed
from .._types import State
from ..manifold import Partition, default_manifold
from ..mechanisms import Mechanism
from ..simulate import simulate
from ..solvers import Adams
from ..system import AbstractSystem
from ..system.description import LEFT_OUT
from ..viz.figure import new_figure
from .evaluations import evaluations
from .subject import subject
from .table import aligned
from .timing import interleaved
from .variants import doubled, in_time, nonholonomic, with_damper

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclasses.dataclass(frozen=True)
class Measured:
    """The cost of a motion with one thing put in.

    **Fields:** `what`; times [s]: `trace` of the program, the shortest of three, and `compile`, both of the processor,
    which other programs disturb less than that of a clock; `run`, the shortest warm one, by the clock; `evaluations` of
    the accelerations in it; `lines` of HLO, before XLA optimises.
    """

    what: str
    trace: float
    compile: float
    run: float
    evaluations: int
    lines: int

    @property
    def evaluation(self) -> float:
        """Time of a run per evaluation [s], with all that the solver does besides."""
        return self.run / self.evaluations

    @property
    def shown(self) -> tuple[str, str, str]:
        """The times to trace, to compile and of an evaluation, as in the table."""
        return f"{self.trace:.2f}", f"{self.compile:.2f}", f"{1e6 * self.evaluation:.1f}"


@dataclasses.dataclass(frozen=True, repr=False)
class LeftOut(Printed):
    """The result of `left_out`; `print` shows a table.

    **Fields:** `cases`: first the motion as it is, then with one thing put in; `specialised`: sentences of the system's
    description; `remarks`: what was not put in, and why.
    """

    mechanism: str
    t1: float
    cases: tuple[Measured, ...]
    specialised: tuple[str, ...]
    remarks: tuple[str, ...]

    def __str__(self) -> str:
        head = ("put in", "lines of HLO", "trace [s]", "compile [s]", "evaluation [µs]", "evaluations", "run [ms]")
        cells = [(c.what, str(c.lines), *c.shown, str(c.evaluations), f"{1e3 * c.run:.2f}") for c in self.cases]
        title = f"{self.mechanism}, {self.t1:g} s: what the motion costs with parts that it does not need"
        notes = [f"not needed: {text}" for text in self.specialised]
        return "\n".join([title, *aligned([head, *cells]), *notes, *self.remarks])

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, strings and lists, for JSON."""
        return dataclasses.asdict(self)

    def figure(self, path: str | Path) -> None:
        """Write a picture (PNG, SVG or PDF by the path's ending): costs relative to the motion as it is.

        **Raises:** `ImportError` that names the extra to install if matplotlib is missing.
        """
        _plot(self).savefig(path, dpi=150)


def left_out(
    system: AbstractSystem | Mechanism, state: State | None = None, *, t1: float | None = None, repeats: int = 5
) -> LeftOut:
    """Measure what it saves that a motion has nothing traced that it does not need.

    ```python
    print(jaxmb.report.left_out(system, state, t1=1.0, repeats=3))
    ```

    Each thing that the motion does not need is put in, in a form that does not change the motion: a joint twice, a
    term in time of amplitude zero, rows between velocities that a joint implies, a damper of zero, an event that does
    not occur, dense output, and a dense Jacobian with charts where blocks do. Only what is put in is measured. A
    persistent cache of compiled programs shortens the compile times of a second report.

    **Arguments:** `system`, `state`, `t1` [s]: as in `simulate`, or a mechanism of the library alone; `repeats`: timed
    runs, in turns.
    """
    mechanism = subject(system, state, t1)
    own, start, end = mechanism.system, mechanism.state, mechanism.t1
    without_charts = own.acceleration_rows > 0 and not default_manifold(own, Adams(), None).uses_charts
    events: dict[str, Any] = {"event": diffrax.Event(lambda t, y, args, **kwargs: t - 2 * end)}
    # What is put in, whether the motion does without it, the system that has it, and options of `simulate`.
    possible: list[tuple[str, bool, Callable[..., Any] | None, dict[str, Any]]] = [
        ("nothing", True, None, {}),
        ("a joint twice", own.acceleration_rank == own.acceleration_rows, doubled, {}),
        ("a term in time", own.drift_free, in_time, {}),
        ("rows between velocities", own.velocity_rows == own.position_rows, nonholonomic, {}),
        ("a damper of zero", True, with_damper, {}),
        ("an event", True, None, events),
        ("dense output", True, None, {"saveat": diffrax.SaveAt(t1=True, dense=True)}),
        ("charts, a dense Jacobian", without_charts, None, {"manifold": Partition()}),
    ]
    remarks, compiled, programs = [], [], []
    for what, free, change, options in possible:
        if not free:
            remarks.append(f"{what}: the motion has that, or has no use for it.")
            continue
        try:
            changed = own if change is None else change(own, start)
        except ValueError as reason:
            remarks.append(f"{what}: not put in, {str(reason).splitlines()[0].rstrip('.')}.")
            continue
        program, *cost = _compiled(changed, start, end, options)
        compiled.append(lambda program=program, changed=changed: program(changed, start))
        programs.append((what, *cost))
    # Each twice in a row: the second does not find the memory as dense output left it.
    twice = iter(interleaved([run for run in compiled for _ in range(2)], repeats))
    times = [next(twice) + next(twice) for _ in compiled]
    cases = []
    for (what, trace, seconds, lines), run, seen in zip(programs, compiled, times, strict=True):
        count = evaluations(Adams(), run().stats)
        assert count is not None
        cases.append(Measured(what, trace, seconds, min(seen), count, lines))
    return LeftOut(mechanism.name, end, tuple(cases), own.describe().remarks[LEFT_OUT], tuple(remarks))


def _compiled(system, state, t1, options) -> tuple[Callable[..., Any], float, float, int]:
    """A program, the times to trace and to compile it, and its lines."""
    lowered, traces = None, []
    for _ in range(3):
        # The first time JAX also traces functions that it keeps for other programs.
        motion = lambda system, state: simulate(system, state, t1=t1, throw=False, **options)
        begin = time.process_time()
        lowered = eqx.filter_jit(motion).lower(system, state)  # pyright: ignore[reportFunctionMemberAccess]
        traces.append(time.process_time() - begin)
    assert lowered is not None
    begin = time.process_time()
    program = lowered.compile()
    return program, min(traces), time.process_time() - begin, len(lowered.as_text().splitlines())


def _plot(report: LeftOut) -> "Figure":
    """Costs with one thing put in, relative to the motion as it is."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    figure = new_figure(7.5, 1.6 + 0.4 * len(report.cases))
    axes = figure.subplots()
    base, *cases = report.cases
    quantities = {"trace": lambda c: c.trace, "compile": lambda c: c.compile, "evaluation": lambda c: c.evaluation}
    places = np.arange(len(cases))
    for k, (label, quantity) in enumerate(quantities.items()):
        ratios = np.array([quantity(c) / quantity(base) for c in cases])
        axes.barh(places + 0.25 * (k - 1), ratios - 1, 0.23, left=1.0, color=f"C{k}", label=label)
    axes.set_xscale("log")
    axes.axvline(1.0, color="0.3", linewidth=1.0)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlim(min(0.45, axes.get_xlim()[0]), max(2.2, axes.get_xlim()[1]))
    axes.set_yticks(places, [c.what for c in cases])
    axes.invert_yaxis()
    axes.set_xlabel("time with this put in, relative to the motion as it is")
    axes.grid(alpha=0.3, axis="x")
    figure.legend(loc="outside lower center", ncols=4, fontsize="small")
    figure.suptitle(f"{report.mechanism}, {report.t1:g} s")
    return figure
