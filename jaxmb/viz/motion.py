"""Time histories of a motion."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..parts.names import names_arguments, unknown
from ..trajectory import Trajectory
from .figure import new_figure
from .one_motion import one_motion

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Largest number of lines with a legend.
_LEGEND = 8
# A residual of exactly zero has no logarithm.
_ROUNDING = 1e-17
# Components that vary by less than this, relative to the largest value of their kind, are at rest.
_STILL = 1e-9

# The kinds of quantities in the order of their panels, with the panels' labels; each kind is followed by its rate.
_LABELS = {
    "position": "position [m]",
    "velocity": "velocity [m/s]",
    "angle": "angle [rad]",
    "angular_velocity": "angular velocity [rad/s]",
    "displacement": "displacement [m]",
    "displacement_rate": "rate of displacement [m/s]",
    "coordinate": "coordinate",
    "rate": "rate of the coordinate",
    "acceleration": "acceleration [m/s²]",
    "angular_acceleration": "angular acceleration [rad/s²]",
    "specific_force": "specific force [m/s²]",
    "force": "force [N]",
    "moment": "moment [N m]",
}
_WITH_RATES = ("position", "angle", "displacement", "coordinate")
_RATES = dict(zip(_LABELS, list(_LABELS)[1:], strict=False))
# The coordinates of joints with several angles.
_ANGLES = ("angle_a", "angle_b", "angle_1", "angle_2", "angle_3")
_CHECKS = ("energy", "residuals")


class _Line(NamedTuple):
    """A component of a quantity of the part or coordinate `name` along a motion; `component` None for the only one."""

    name: str
    component: int | None
    values: Float[np.ndarray, "times"]


@names_arguments
def plot_motion(trajectory: Trajectory, names: str | Sequence[str] | None = None) -> "Figure":
    """Plot a motion against time.

    ```python
    jaxmb.viz.plot_motion(motion, ["bar.angle", "pin.force", "energy"]).savefig("motion.png")
    ```

    By default the energy, the residuals of constraints and all moving quantities are shown:

    - positions and velocities of mass centres; displacements of sliding joints;
    - angles and angular velocities, of bodies in the plane and of joints in space;
    - the coordinates of a system without bodies and their rates q̇.

    A constant component, such as the height of a trolley on a level rail, is left out. Events of contacts and dry
    friction are vertical lines, solid at impacts, dotted without an impulse.

    **Arguments:**

    - `trajectory`: a motion saved at several times.
    - `names` of quantities to show instead, such as `"piston.position"`, `"slide.displacement"`, `"hip.angle_rate"`,
        `"A.force"`, `"energy"` and `"residuals"`. The name of a body, joint, frame or part with internal states selects
        all quantities of its motion.

    **Returns:** a matplotlib `Figure` with one panel for each kind of quantity [s; m, rad and their rates; N, N m; J].
    In a panel the components along x, y and z are solid, dashed and dotted. `figure.savefig(path)` writes it; as the
    last line of a notebook's cell it is shown. Times that a run did not reach are left out.

    **Raises:** `ValueError` for an unknown name, a batch or fewer than two times; `ImportError` without matplotlib.
    """
    trajectory = one_motion(trajectory, "plot_motion")
    if names is None:
        panels = _moving(_panels(trajectory, _default(trajectory.system)))
        checks = _CHECKS if trajectory.system.velocity_rows else _CHECKS[:1]
    else:
        given = (names,) if isinstance(names, str) else tuple(names)
        checks = [name for name in _CHECKS if name in given]
        panels = _panels(trajectory, _quantities(trajectory.system, [name for name in given if name not in checks]))
    figure, places = _places(len(panels) + len(checks))
    t = np.asarray(trajectory.ts)
    _draw_events(places, t, trajectory)
    for axes, (kind, lines) in zip(places, panels.items(), strict=False):
        _draw(axes, t, lines)
        _finish(axes, _LABELS.get(kind, kind.replace("_", " ")))
    for axes, name in zip(places[len(panels) :], checks, strict=True):
        (_draw_energy if name == "energy" else _draw_residuals)(axes, t, trajectory)
    return figure


# Selection of quantities


def _default(system) -> list[str]:
    """The quantities that describe a motion."""
    quantities = system.quantities()
    # In space a body has no angle: angles of joints are shown.
    flat = any(f"{name}.angle" in quantities for name in system.catalogue.motion_names())
    kinds = ("displacement",) if flat else ("angle", "displacement")
    of_bodies = _quantities(system, system.catalogue.motion_names())
    of_bodies = [name for name in of_bodies if flat or _kind(system, name) != _RATES["angle"]]
    of_joints = [name for name in system.joint_coordinates() if _kind(system, name) in kinds]
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


def _split(system, quantity: str) -> tuple[str, str, bool]:
    """The part or coordinate of a quantity, the quantity without it, and whether it is a rate."""
    is_rate = quantity.endswith("_rate") and quantity not in system.coordinate_names()
    part, _, field = (quantity.removesuffix("_rate") if is_rate else quantity).partition(".")
    return part, field or "coordinate", is_rate


def _kind(system, quantity: str) -> str:
    """The kind of a quantity; all angles of bodies and joints are of one kind."""
    _, field, is_rate = _split(system, quantity)
    kind = "angle" if field in _ANGLES else field
    if is_rate:
        return _RATES[kind] if kind in ("angle", "coordinate") else f"{kind}_rate"
    return kind


def _panels(trajectory: Trajectory, quantities: Iterable[str]) -> dict[str, list[_Line]]:
    """The components of quantities by kind, the kinds in the order of their panels."""
    out: dict[str, list[_Line]] = {}
    for quantity in quantities:
        part, field, _ = _split(trajectory.system, quantity)
        # Several angles of a joint have their whole names.
        name = f"{part}.{field}" if field in _ANGLES else part
        values = np.asarray(trajectory.quantity(quantity))
        columns = values.reshape(values.shape[0], -1).T
        lines = [_Line(name, None if values.ndim == 1 else k, column) for k, column in enumerate(columns)]
        out.setdefault(_kind(trajectory.system, quantity), []).extend(lines)
    order = [*_LABELS, *out]
    return dict(sorted(out.items(), key=lambda item: order.index(item[0])))


def _moving(panels: dict[str, list[_Line]]) -> dict[str, list[_Line]]:
    """The panels without constant components and their rates."""
    out = dict(panels)
    for kind in _WITH_RATES:
        if kind in panels:
            size = max(float(np.max(np.abs(line.values))) for line in panels[kind])
            constant = {line[:2] for line in panels[kind] if np.ptp(line.values) <= _STILL * size}
            for group in (kind, _RATES[kind]):
                out[group] = [line for line in panels[group] if line[:2] not in constant]
    return {kind: lines for kind, lines in out.items() if lines}


# Drawing


def _places(number: int) -> tuple["Figure", list["Axes"]]:
    """A figure with axes in two columns; an odd panel at the end is as wide as both."""
    rows = (number + 1) // 2
    figure = new_figure(9.0, max(3.0, 2.6 * rows) if number > 1 else 3.5)
    layout: Any = [[str(2 * row), str(min(2 * row + 1, number - 1))] for row in range(rows)]
    places = list(figure.subplot_mosaic(layout, sharex=True).values())
    for axes in places[-2 + number % 2 :]:
        axes.set_xlabel("t [s]")
    return figure, places


def _draw(axes: "Axes", t: np.ndarray, lines: Sequence[_Line]) -> None:
    colors = {name: f"C{k % 10}" for k, name in enumerate(dict.fromkeys(line.name for line in lines))}
    drawn = sorted({line.component or 0 for line in lines})
    for name, k, values in lines:
        style = ("-", "--", ":")[drawn.index(k or 0) % 3]
        letter = "" if k is None else f" {'xyz'[k] if k < 3 else k + 1}"
        axes.plot(t, values, color=colors[name], linestyle=style, label=name + letter)


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
    axes.plot(t, trajectory.kinetic_energy, label="kinetic")
    axes.plot(t, trajectory.potential_energy, label="potential")
    axes.plot(t, trajectory.energy, "k", label="sum")
    _finish(axes, "energy [J]")


def _draw_residuals(axes: "Axes", t: np.ndarray, trajectory: Trajectory) -> None:
    violation = trajectory.constraint_violation
    axes.semilogy(t, np.maximum(violation.position, _ROUNDING), label="position")
    axes.semilogy(t, np.maximum(violation.velocity, _ROUNDING), label="velocity [1/s]")
    _finish(axes, "constraint residual, scaled")


def _finish(axes: "Axes", label: str) -> None:
    axes.set_ylabel(label)
    axes.grid(alpha=0.3)
    if len(axes.lines) <= _LEGEND:
        axes.legend(fontsize="small")
