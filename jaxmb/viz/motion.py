"""Time histories of a motion."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from .._results import RESULTS
from ..bodies.units import named, panel_words
from ..parts.names import names_arguments, unknown
from ..trajectory import Trajectory
from .figure import (
    MOST,
    STYLES,
    Curve,
    Panel,
    color,
    colors_of,
    component,
    draw,
    empty_panels,
    finish_panel,
    share_legends,
)
from .one_motion import one_motion

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# A residual of exactly zero has no logarithm.
_ROUNDING = 1e-17
# Components that vary by less than this, relative to the largest value of their kind, are at rest.
_STILL = 1e-9
# The order of panels.
_UNITS = ("m", "m/s", "rad", "rad/s", "coordinate", "rate of the coordinate", "m/s²", "rad/s²", "N", "N m")
_RATE_OF = {"m/s": "m", "rad/s": "rad", "rate of the coordinate": "coordinate"}
_CHECKS = ("energy", "residuals")


class _Line(NamedTuple):
    """A component of a quantity of the part or coordinate `name` along a motion, with its `word` for a label;
    `component` None for the only one.
    """

    name: str
    component: int | None
    values: Float[np.ndarray, "times"]
    quantity: str
    word: str


@names_arguments
def plot_motion(trajectory: Trajectory, names: str | Sequence[str] | None = None) -> "Figure":
    """Plot a motion against time; `motion.plot("bar.angle", "energy")` is the same.

    ```python
    jaxmb.viz.plot_motion(motion, ["bar.angle", "pin.force", "energy"]).savefig("motion.png")
    ```

    By default the energy, the residuals of constraints and moving quantities are shown:

    - positions and velocities of mass centres; displacements of sliding joints;
    - angles and angular velocities, of bodies in the plane and of joints in space;
    - the coordinates of a system without bodies and their rates q̇.

    A constant component, such as the height of a trolley on a level rail, is left out; of many curves in a panel, the
    parts that move most are shown. Events of contacts and dry friction are vertical lines, solid at impacts, dotted
    without an impulse.

    **Arguments:**

    - `trajectory`: a motion saved at several times.
    - `names` of quantities to show instead, all of them, such as `"piston.position"`, `"slide.displacement"`,
        `"hip.angle_rate"`, `"A.force"`, `"energy"` and `"residuals"`. The name of a body, joint, frame or part with
        internal states selects all quantities of its motion. Components of a vector that are zero are left out.

    **Returns:** a matplotlib `Figure` with one panel for each unit, or several for more than eight curves. A body has
    the colour that it has in `plot_mechanism`; components along x, y and z are solid, dashed and dotted. Large forces
    are in kN, and small lengths in mm. `figure.savefig(path)` writes it; as the last line of a notebook's cell it is
    shown. Times that a run did not reach are left out, and the title says why the run ended.

    **Raises:** `ValueError` for an unknown name, a batch or fewer than two times; `ImportError` without matplotlib.
    """
    trajectory = one_motion(trajectory, "plot_motion")
    if names is None:
        moving = _moving(_lines(trajectory, _default(trajectory.system)))
        panels = {unit: _most(lines) for unit, lines in moving.items()}
        checks = _CHECKS if trajectory.system.velocity_rows else _CHECKS[:1]
    else:
        given = (names,) if isinstance(names, str) else tuple(names)
        checks = [name for name in _CHECKS if name in given]
        panels = _lines(trajectory, _quantities(trajectory.system, [name for name in given if name not in checks]))
    shown = [panel for lines in panels.values() for panel in _panels(trajectory.system, lines)]
    figure, places = empty_panels(len(shown) + len(checks))
    t = np.asarray(trajectory.ts)
    _draw_events(places, t, trajectory)
    for axes, panel in zip(places, shown, strict=False):
        draw(axes, panel, t)
    for axes, name in zip(places[len(shown) :], checks, strict=True):
        (_draw_energy if name == "energy" else _draw_residuals)(axes, t, trajectory)
    share_legends(places)
    if not bool((trajectory.result == RESULTS.successful) | (trajectory.result == RESULTS.event_occurred)):
        why = RESULTS[trajectory.result].split(".")[0]  # pyright: ignore[reportInvalidTypeArguments]
        figure.suptitle(f"The run ended at t = {t[-1]:.4g} s: {why}", fontsize="medium", color="firebrick")
    return figure


# Selection of quantities


def _default(system) -> list[str]:
    """The quantities that describe a motion."""
    quantities = system.quantities()
    # In space a body has no angle: angles of joints are shown.
    flat = any(f"{name}.angle" in quantities for name in system.catalogue.motion_names())
    words = ("displacement",) if flat else ("angle", "displacement")
    of_bodies = _quantities(system, system.catalogue.motion_names())
    of_bodies = [name for name in of_bodies if flat or named(system, name).unit != "rad/s"]
    of_joints = [name for name in system.joint_coordinates() if named(system, name).word in words]
    return [*of_bodies, *(x for name in of_joints for x in (name, f"{name}_rate"))]


def _quantities(system, names: Iterable[str]) -> list[str]:
    """The quantities that names select."""
    quantities = system.quantities()
    out: dict[str, None] = {}
    for name in names:
        of_part = [key for key in quantities if key.startswith(f"{name}.") and not quantities[key].of_forces]
        shown = (name,) if "." in name else (name, f"{name}_rate")
        # Plots of Euler parameters are hard to read.
        selected = [quantity for quantity in shown if quantity in quantities]
        selected += [quantity for quantity in of_part if not quantity.endswith(".orientation")]
        if not selected:
            what = "body, joint or quantity" if system.body_names else "coordinate"
            parts = dict.fromkeys(quantity.split(".")[0] for quantity in quantities)
            raise unknown(what, name, (*parts, *quantities, *_CHECKS))
        out |= dict.fromkeys(selected)
    return list(out)


def _lines(trajectory: Trajectory, quantities: Iterable[str]) -> dict[str, list[_Line]]:
    """The components of quantities that are not zero by unit, or by word where there is none, in the order of their
    panels.
    """
    out: dict[str, list[_Line]] = {}
    for quantity in quantities:
        own = named(trajectory.system, quantity)
        # Several angles of a joint have their whole names.
        name = f"{own.part}.{own.field}" if own.field[-2:-1] == "_" else own.part
        values = np.asarray(trajectory.quantity(quantity))
        of_spans = trajectory.system.quantities()[quantity].of_spans
        lines = [
            _Line(name, k if values.ndim > 1 else None, column, quantity, component(k, of_spans) * (values.ndim > 1))
            for k, column in enumerate(values.reshape(values.shape[0], -1).T)
        ]
        size = _STILL * max(float(np.max(np.abs(line.values))) for line in lines)
        # All of a quantity that is zero.
        kept = [line for line in lines if np.max(np.abs(line.values)) > size] or lines
        out.setdefault(own.unit or own.word, []).extend(kept)
    order = [*_UNITS, *out]
    return dict(sorted(out.items(), key=lambda item: order.index(item[0])))


def _moving(panels: dict[str, list[_Line]]) -> dict[str, list[_Line]]:
    """The panels without constant components and their rates."""
    out, constant = {}, set()
    for unit, lines in panels.items():
        base = _RATE_OF.get(unit, unit)
        size = max(float(np.max(np.abs(line.values))) for line in lines)
        if base == unit:
            constant |= {(base, *line[:2]) for line in lines if np.ptp(line.values) <= _STILL * size}
        out[unit] = [line for line in lines if (base, *line[:2]) not in constant]
    return {unit: lines for unit, lines in out.items() if lines}


def _most(lines: list[_Line]) -> list[_Line]:
    """The lines of the parts that move most, as many as a panel takes."""
    ranges: dict[str, float] = {}
    for line in lines:
        ranges[line.name] = max(ranges.get(line.name, 0.0), float(np.ptp(line.values)))
    count = lambda names: sum(line.name in names for line in lines)
    order = sorted(ranges, key=lambda name: -ranges[name])
    kept = order[: max(1, sum(count(order[: k + 1]) <= MOST for k in range(len(order))))]
    return [line for line in lines if line.name in kept]


# Drawing


def _panels(system, lines: Sequence[_Line]) -> list[Panel]:
    """The panels of lines with one unit; many lines have panels for each component, and for each few bodies."""
    colors = colors_of([line.name for line in lines], system.body_names)
    components = sorted({line.component or 0 for line in lines})
    several, out = len(lines) > MOST, []
    for block in _blocks(lines, colors) if several else [lines]:
        names = [line.name + line.word for line in block]
        labels = [
            name if names.count(name) == 1 else line.quantity + line.word
            for name, line in zip(names, block, strict=True)
        ]
        styles = ["-" if several else STYLES[components.index(line.component or 0) % len(STYLES)] for line in block]
        of_curves = [colors[line.name] for line in block]
        curves = map(Curve, labels, [line.values for line in block], of_curves, styles)
        out.append(Panel(*panel_words([named(system, line.quantity) for line in block]), list(curves)))
    return out


def _blocks(lines: Sequence[_Line], colors: Mapping[str, Any]) -> list[list[_Line]]:
    """Lines of one component and of names with other colours, as many as a panel takes."""
    out: list[list[_Line]] = []
    number = lambda line: line.component or 0
    for _, of_component in itertools.groupby(sorted(lines, key=number), key=number):
        out.append([])
        for line in of_component:
            taken = {colors[other.name] for other in out[-1] if other.name != line.name}
            if len(out[-1]) == MOST or colors[line.name] in taken:
                out.append([])
            out[-1].append(line)
    return out


def _draw_events(places: Sequence["Axes"], t: np.ndarray, trajectory: Trajectory) -> None:
    """Vertical lines in all panels, named by the legend of the first panel."""
    from matplotlib.collections import LineCollection

    events = [] if trajectory.found_events is None else trajectory.events
    for style, struck in (("-", True), (":", False)):
        drawn = [event for event in events if (event.impulse != 0) == struck and t[0] <= event.time <= t[-1]]
        kinds = ", ".join(sorted({event.kind for event in drawn}))
        lines = [[(event.time, 0.0), (event.time, 1.0)] for event in drawn]
        for k, axes in enumerate(places if drawn else ()):
            # In units of the panel's height, so that the limits still follow the motion.
            across = axes.get_xaxis_transform()
            label = kinds if k == 0 else None
            marks = LineCollection(
                lines, transform=across, colors="0.55", linestyles=style, linewidths=0.8, zorder=0.5, label=label
            )
            axes.add_collection(marks, autolim=False)


def _draw_energy(axes: "Axes", t: np.ndarray, trajectory: Trajectory) -> None:
    energies = {"kinetic": trajectory.kinetic_energy, "potential": trajectory.potential_energy}
    curves = [Curve(name, np.asarray(values), color(k)) for k, (name, values) in enumerate(energies.items())]
    draw(axes, Panel("energy", "J", [*curves, Curve("sum", np.asarray(trajectory.energy), "black")]), t)


def _draw_residuals(axes: "Axes", t: np.ndarray, trajectory: Trajectory) -> None:
    violation = trajectory.constraint_violation
    axes.semilogy(t, np.maximum(violation.position, _ROUNDING), color=color(0), label="position")
    axes.semilogy(t, np.maximum(violation.velocity, _ROUNDING), color=color(1), label="velocity [1/s]")
    finish_panel(axes, "constraint residual, scaled")
