"""Stiff and extreme variants of a motion, with the true error of each or the reason why it is refused."""

import dataclasses
import functools
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._results import RESULTS
from .._types import State, VectorLike
from ..mechanisms import Mechanism
from ..parts.names import names_arguments, unknown
from ..simulate import simulate
from ..solvers import Adams, Hermite
from ..states.assembly import assemble
from ..system import AbstractSystem, parameters, with_parameters
from ..viz.figure import new_figure
from .reference import MARGIN
from .subject import subject
from .table import Table
from .variants import doubled, scaled_lengths, units
from .work_precision import outcome

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Tolerances of references, the second if round-off rules out the first; and the number of saved times.
_TIGHT = (1e-13, 1e-11)
_TIMES = 21


_WORDS = {
    "small": "small: below the reference's accuracy, ten times the difference of its two methods",
    "unknown": "unknown: fewer than two of Adams, Dopri8 and Hermite reached the end at a tight tolerance",
}
_COLUMNS = {"variant": "", "": "", "error": ".1e", "known to": ".0e", "steps": "d"}


class _Case(NamedTuple):
    """A variant: its error, or a word instead; the accuracy of the reference; the reason why it is refused, or ""."""

    kind: str
    case: str
    error: float | str
    known_to: float | None
    steps: int
    message: str = ""


class _Trial(NamedTuple):
    """A variant: `build()` returns system, state and t1.

    `truth`: the given system's `_truth` in a tuple, if its exact motion is also the variant's.
    """

    case: str
    build: Callable[[], tuple[Any, State, float]]
    rtol: float
    truth: tuple[Any] | None = None


@names_arguments
def stress_test(
    system: AbstractSystem | Mechanism,
    state: State | None = None,
    *,
    t1: float | None = None,
    rtol: float = 1e-8,
    solver: diffrax.AbstractSolver | None = None,
    singular: Mapping[str, VectorLike] | None = None,
    only: Collection[str] | None = None,
) -> Table:
    """Simulate stiff and extreme variants of a motion, and measure the true error of each.

    ```python
    print(jaxmb.report.stress_test(system, state, t1=1.0, only=("rtol", "mass")))
    ```

    For other tolerances, other lengths (by dimensional analysis) and doubled joints, the reference is the motion of the
    given system. For other variants, two of the methods `Adams`, `Dopri8` and `Hermite` at a tight tolerance give a
    reference; errors below ten times their difference are "small". Variants that differ only in numbers share a
    compiled program.

    **Arguments:** `system`, `state`, `t1` [s]: as in `simulate`, or a mechanism of the library alone; `rtol`; `solver`,
    default `Adams()`; `singular`: coordinates of a singular position by name, as `fix` of `assemble`, near which a
    variant starts; `only`: the kinds of variants to try, default all: "rtol", "long horizon", "stiffness", "mass",
    "alternating masses", "lengths", "initial speed", "near-singular", "doubled joint".

    **Returns:** a `Table` of variants. `error` is the largest error at the end of coordinates, velocities and internal
    states, each relative to their largest value. Words replace it: "small" if it is below the accuracy of the reference
    ("known to"), "unknown" without a reference, "refused" if the variant cannot be built or its run fails. Notes give
    the reasons.
    """
    mechanism = subject(system, state, t1)
    solver = Adams() if solver is None else solver
    wrong = [name for name in only or () if name not in _KINDS]
    if wrong:
        raise unknown("kind of variant", wrong[0], _KINDS)
    base = _Base(mechanism, rtol, singular or {}, _truth(mechanism.system, mechanism.state, mechanism.t1))
    cases, remarks = [], []
    for kind, trials in _KINDS.items():
        if only is not None and kind not in only:
            continue
        try:
            for trial in trials(base):
                cases.append(_judge(kind, trial, solver))
        except _NotApplicableError as reason:
            remarks.append(f"{kind}: {reason}.")
    words = {case.error for case in cases}
    notes = [text for word, text in _WORDS.items() if word in words]
    refused: dict[str, list[str]] = {}
    for case in cases:
        if case.message:
            refused.setdefault(case.message, []).append(f"{case.kind} {case.case}")
    notes += [f"{', '.join(variants)}: {text}" for text, variants in refused.items()]
    name = f"{mechanism.name}, {mechanism.t1:g} s, {type(solver).__name__} at rtol {rtol:g}"
    draw = functools.partial(_plot, title=name, rtol=rtol)
    return Table(f"{name}: relative error at the end", _COLUMNS, [case[:5] for case in cases], notes + remarks, draw)


class _NotApplicableError(Exception):
    """The reason why a kind of variant does not apply."""


class _Base(NamedTuple):
    mechanism: Mechanism
    rtol: float
    singular: Mapping[str, VectorLike]
    truth: Any

    def trial(self, case, *, system=None, state=None, t1=None, rtol=None, build=None, truth=None) -> _Trial:
        mechanism = self.mechanism
        given = (
            mechanism.system if system is None else system,
            mechanism.state if state is None else state,
            mechanism.t1 if t1 is None else t1,
        )
        return _Trial(case, build or (lambda: given), self.rtol if rtol is None else rtol, truth)


def _tolerances(base: _Base) -> Iterator[_Trial]:
    for rtol in 10.0 ** -np.arange(3.0, 13.0):
        yield base.trial(f"{rtol:.0e}", rtol=rtol, truth=(base.truth,))


def _horizon(base: _Base) -> Iterator[_Trial]:
    yield base.trial("10 t1", t1=10 * base.mechanism.t1)


def _scaled(base: _Base, names: Collection[str], factors: Collection[float]) -> Iterator[_Trial]:
    """Some parameters times several factors."""
    system = base.mechanism.system
    values = {name: np.asarray(value) for name, value in parameters(system).items() if name in names}
    for factor in factors:
        changed = {name: factor * value for name, value in values.items()}
        yield base.trial(f"× {factor:.0e}", build=lambda numbers=changed: _with(base, with_parameters(system, numbers)))


def _with(base: _Base, system: Any) -> tuple[Any, State, float]:
    return system, base.mechanism.state, base.mechanism.t1


def _stiffness(base: _Base) -> Iterator[_Trial]:
    values = parameters(base.mechanism.system)
    springs = [
        n for n, unit in units(base.mechanism.system).items() if n.endswith("stiffness") and (unit or "")[:1] == "N"
    ]
    if not any(np.any(values[name]) for name in springs):
        raise _NotApplicableError("left out, there are no springs")
    yield from _scaled(base, springs, 10.0 ** np.arange(2, 15, 2))


def _masses(base: _Base) -> Iterator[_Trial]:
    body = base.mechanism.system.catalogue.motion_names()[0]
    masses = _inertial(base, [body])
    if not masses:
        raise _NotApplicableError("left out, there is no body whose mass is a parameter")
    for trial in _scaled(base, masses, 10.0 ** np.array([-8, -4, -2, 2, 4, 8])):
        yield trial._replace(case=f"{body} {trial.case}")


def _alternating_masses(base: _Base) -> Iterator[_Trial]:
    every_other = _inertial(base, base.mechanism.system.catalogue.motion_names()[1::2])
    if not every_other:
        raise _NotApplicableError("left out, there are no two bodies whose masses are parameters")
    yield from _scaled(base, every_other, 10.0 ** np.array([-8, -6, -3, 3, 6, 8]))


def _inertial(base: _Base, bodies: Collection[str]) -> list[str]:
    """The parameters of bodies that are masses or moments of inertia."""
    named = units(base.mechanism.system)
    return [n for n, unit in named.items() if n.split(".")[0] in bodies and "kg" in (unit or "").split()]


def _lengths(base: _Base) -> Iterator[_Trial]:
    mechanism = base.mechanism
    for factor in (1e-9, 1e-6, 1e-3, 1e3, 1e6):
        try:
            scaled = scaled_lengths(mechanism.system, mechanism.state, factor)
        except ValueError as reason:
            raise _NotApplicableError(f"left out, {str(reason).rstrip('.')}") from None
        yield base.trial(f"× {factor:.0e}", system=scaled[0], state=scaled[1], truth=(base.truth,))


def _speeds(base: _Base) -> Iterator[_Trial]:
    mechanism = base.mechanism
    if not (np.any(np.asarray(mechanism.state.u)) and mechanism.system.linear and mechanism.system.drift_free):
        raise _NotApplicableError("left out, the motion starts from rest, or velocities are prescribed")
    for factor in (1e-6, 1e-3, 10.0, 1e3):
        fast = dataclasses.replace(mechanism.state, u=factor * mechanism.state.u)
        yield base.trial(f"× {factor:.0e}", state=fast, t1=mechanism.t1 / max(factor, 1.0))


def _near_singular(base: _Base) -> Iterator[_Trial]:
    mechanism = base.mechanism
    if not base.singular:
        raise _NotApplicableError("left out, no singular position was named, as by singular={'crank.angle': …}")
    for off in 10.0 ** -np.arange(3.0, 13.0, 3.0):
        fix = {name: np.asarray(value) + off for name, value in base.singular.items()}
        build = lambda fix=fix: (mechanism.system, assemble(mechanism.system, mechanism.state, fix=fix), mechanism.t1)
        yield base.trial(f"{off:.0e} off", build=build)


def _doubled(base: _Base) -> Iterator[_Trial]:
    mechanism = base.mechanism
    if not (mechanism.system.body_names and mechanism.system.velocity_rows):
        raise _NotApplicableError("left out, there are no joints of bodies")
    yield base.trial(
        "the same", build=lambda: _with(base, doubled(mechanism.system, mechanism.state)), truth=(base.truth,)
    )
    joint = mechanism.system.constraints.groups[0].group
    if getattr(joint.part, "point_a", None) is None:
        raise _NotApplicableError(
            f"a nearly redundant joint is left out, {joint.names[0]!r} has no points of two bodies"
        )
    off = 1e-6 * float(mechanism.system.length)
    yield base.trial("1e-06 off", build=lambda: _with(base, doubled(mechanism.system, mechanism.state, off)))


_KINDS: dict[str, Callable[[_Base], Iterator[_Trial]]] = {
    "rtol": _tolerances,
    "long horizon": _horizon,
    "stiffness": _stiffness,
    "mass": _masses,
    "alternating masses": _alternating_masses,
    "lengths": _lengths,
    "initial speed": _speeds,
    "near-singular": _near_singular,
    "doubled joint": _doubled,
}


def _judge(kind: str, trial: _Trial, solver: diffrax.AbstractSolver) -> _Case:
    refused = lambda message, steps=0: _Case(kind, trial.case, "refused", None, steps, message)
    try:
        system, state, t1 = trial.build()
    except ValueError as error:
        return refused(str(error).split("\n")[0])
    trajectory = _run(system, state, t1, trial.rtol, solver)
    steps = int(trajectory.stats["num_steps"])
    if not bool(trajectory.result == RESULTS.successful):
        return refused(outcome(trajectory.result), steps)
    reference = _truth(system, state, t1) if trial.truth is None else trial.truth[0]
    if reference is None:
        return _Case(kind, trial.case, "unknown", None, steps)
    truth, difference = reference
    error, known_to = _distance(_natural(system, trajectory.ys), truth), MARGIN * difference
    return _Case(kind, trial.case, "small" if error < known_to else error, known_to, steps)


def _truth(system: Any, state: State, t1: float) -> Any:
    """The motion in natural units and the difference of two methods; None if fewer than two reach the end."""
    for rtol in _TIGHT:
        motions = []
        for solver in (Adams(), diffrax.Dopri8(), Hermite()):
            trajectory = _run(system, state, t1, rtol, solver)
            if bool(trajectory.result == RESULTS.successful):
                motions.append(_natural(system, trajectory.ys))
            if len(motions) == 2:
                return motions[0], _distance(*motions)
    return None


def _run(system, state, t1, rtol, solver):
    # Arrays, so that other numbers do not compile again.
    t1, rtol = (jnp.asarray(x, state.q.dtype) for x in (t1, rtol))
    return _compiled(system, state, t1, rtol, solver)


@eqx.filter_jit
def _compiled(system, state, t1, rtol, solver):
    saved = t1 * jnp.linspace(0.0, 1.0, _TIMES, dtype=t1.dtype)
    return simulate(system, state, t1=t1, rtol=rtol, solver=solver, saveat=saved, throw=False)


def _natural(system: Any, ys: State) -> tuple[np.ndarray, ...]:
    scaled = lambda values, scale: np.asarray(values) / np.asarray(scale)
    natural = scaled(ys.q, system.coordinate_scale()), scaled(ys.u, system.velocity_scale())
    return natural if ys.z is None else (*natural, scaled(ys.z, system.state_scale()))


def _distance(motion: Any, truth: Any) -> float:
    """The largest difference at the end, relative to the largest value along the motion."""
    size = lambda x: max(float(np.max(np.abs(x), initial=0.0)), np.finfo(float).tiny)
    return max(float(np.max(np.abs((x - y)[-1]), initial=0.0)) / size(y) for x, y in zip(motion, truth, strict=True))


def _plot(table: Table, title: str, rtol: float) -> "Figure":
    """The error of every variant, from top to bottom; refusals and unknown errors at the right."""
    figure = new_figure(7.5, 1.4 + 0.2 * len(table.rows))
    axes = figure.subplots()
    styles = {"error": "C0o", "small, at most": "C2<", "unknown": "C1D", "refused": "C3x"}
    points: dict[str, list[tuple[float, int]]] = {name: [] for name in styles}
    numbers = [x for x in (*table["error"], *table["known to"]) if isinstance(x, float) and x]
    right = 10 * max([1.0, *numbers])
    for k, (error, known_to) in enumerate(zip(table["error"], table["known to"], strict=True)):
        small = max(known_to or 0.0, np.finfo(float).eps)
        if error == "small":
            points["small, at most"].append((small, k))
        else:
            points[error if error in styles else "error"].append((error if isinstance(error, float) else right, k))
    for name, style in styles.items():
        if points[name]:
            axes.semilogx(*zip(*points[name], strict=True), style, label=name)
    axes.axvline(rtol, color="0.5", linestyle=":", label="rtol")
    axes.set_yticks(range(len(table.rows)), [f"{kind}  {case}" for kind, case, *_ in table.rows], fontsize="small")
    axes.set_ylim(len(table.rows) - 0.5, -0.5)
    axes.set_xlabel("relative error at the end")
    axes.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=5, fontsize="small")
    figure.suptitle(title)
    return figure
