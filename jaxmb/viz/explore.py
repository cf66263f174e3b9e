"""A machine with sliders, in a browser or in the cell of a notebook."""

import atexit
import html
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .._types import State
from ..bodies.units import named
from ..parts.names import names_arguments, unknown
from ..states.arguments import check_system
from ..studies.variation import Variation
from ..system import AbstractSystem
from ..trajectory import Trajectory
from . import scenery, stage
from .figure import components, with_unit
from .motion_nodes import motion as motion_of
from .solids import COLORS

# The time [s] between two looks at the sliders, saved times of a motion, steps of a slider, and pixels of a notebook's
# cell, and of a plot with its margins.
_TICK, _TIMES, _STEPS, _HEIGHT, _PLOT, _PADDING = 1 / 30, 201, 400, 620, 190, (14, 8, 0, 0)
_GREY = "rgb(170, 170, 170)"


@names_arguments
def explore(
    system: AbstractSystem,
    sliders: Mapping[str, tuple[float, float]] | None = None,
    *,
    quantities: str | Sequence[str] = (),
    state: State | None = None,
    fix: Mapping[str, Any] | None = None,
    rates: Mapping[str, Any] | None = None,
    t1: float | None = None,
    **options: Any,
) -> "Explorer":
    """Change numbers of a machine by sliders, and turn its joints by hand, while its motion and curves follow.

    ```python
    explorer = jaxmb.viz.explore(system, {"bar.mass": (0.5, 4.0)}, quantities="bar.angle", t1=1.0)
    explorer  # As the last line of a notebook's cell it is seen; elsewhere open `explorer.url` in a browser.
    explorer.close()
    ```

    Every slider changes one number. A change is one run of a program that is compiled once, some seconds at the start,
    and then takes milliseconds for small machines. Curves of the start stay, in grey. Where the mechanism cannot be
    assembled or the run fails, the page says why, and keeps the last picture.

    Use it to look for a design or a fault; use `sweep` and `optimise` to compute, and `show` for a page without Python.

    **Arguments:**

    - `system`: a compiled scene.
    - `sliders`: bounds `(low, high)` by the name of a parameter, as in `with_parameters`, a component of it,
        `"B.point_b[0]"`, a design variable, an input (which is then constant), a coordinate or a rate at the start.
        Further sliders turn the joints: those of `fix`, and the first joints that determine the pose.
    - `quantities`: names as in `motion.quantity`, which are shown as curves, or as numbers of a pose.
    - `state`, `fix`, `rates`: the start, as in `assemble`. Without `rates`, joints start as fast as in the `state`.
    - `t1`: the end of the motion [s]; without it the page shows a pose, positions alone.
    - `options` of `simulate`, such as `solver=`, default `rtol=1e-6` and 201 saved times.

    **Returns:** an `Explorer`, which runs until it is closed or Python ends.

    **Raises:** `ValueError` for unknown names, bounds that are reversed or do not contain the number's value, a system
    without bodies, and a start that cannot be assembled or simulated; `ImportError` without viser, which `jaxmb[view]`
    installs.
    """
    check_system("explore", system)
    if not system.body_names:
        raise ValueError(f"explore shows bodies, and a {type(system).__name__} has none.")
    names = (quantities,) if isinstance(quantities, str) else tuple(quantities)
    for name in names:
        if name not in system.quantities():
            raise unknown("quantity", name, system.quantities(), "explore")
    if t1 is None and options:
        raise ValueError(f"explore: {', '.join(options)} belong to a motion; give its end, t1=…")
    stage.viser()
    given = None if t1 is None else {"t1": t1, "saveat": np.linspace(0.0, t1, _TIMES), "rtol": 1e-6, **options}
    start = {"state": state, "fix": fix, "rates": rates}
    return Explorer(Variation.of(system, sliders or {}, options=given, **start), names)


def curves(motion: Trajectory, names: Sequence[str]) -> dict[str, dict[str, np.ndarray]]:
    """The components of quantities along a motion, by name and label."""
    of_spans = lambda name: motion.system.quantities()[name].of_spans
    values = {name: components("", motion.quantity(name), of_spans(name)) for name in names}
    return {name: {label: column for label, column, _ in of_name} for name, of_name in values.items()}


class Explorer:
    """A page with sliders, from `explore`; notebooks show it, and `url` is its address on this machine.

    ```python
    explorer = jaxmb.viz.explore(system, {"bar.mass": (0.5, 4.0)})
    explorer.set({"bar.mass": 2.0})
    explorer.close()
    ```

    **Fields:** `motion`: the last that was shown, of the numbers in `values`; `problem`: why there is none for the
    present numbers, or "". A notebook that is exported or read on another machine shows nothing, since its cell needs
    this process.
    """

    def __init__(self, variation: Variation, quantities: Sequence[str]):
        self._variation, self._quantities, self.problem = variation, quantities, ""
        self.motion = variation.motion({})
        self._start = curves(self.motion, quantities)
        drawn = motion_of("", self.motion, {}, None)
        self._view = scenery.View.of([drawn], False)
        self._server = stage.server(self._view.camera)
        stage.placed(self._server.scene, scenery.nodes([drawn], self._view))
        # What the page shows: nodes, the index of their state, and the time, between two states while it plays.
        self._nodes: list[tuple[stage.SceneNode, Any]] = []
        self._shown, self._now = 0, 0.0
        self._add_controls()
        self._show(self.motion)
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._follow, daemon=True, name="explore")
        self._thread.start()
        # A thread that computes while Python ends would crash it.
        atexit.register(self.close)

    @property
    def url(self) -> str:
        """The address of the page, for a browser on this machine."""
        return f"http://127.0.0.1:{self._server.get_port()}"

    @property
    def values(self) -> dict[str, float]:
        """The numbers of the sliders, by name."""
        return {name: float(control.value) for name, control in self._controls.items()}

    def set(self, values: Mapping[str, float]) -> None:
        """Move sliders; the page follows at once.

        **Raises:** `ValueError` for an unknown name, and a value out of bounds.
        """
        bounds = {slider.name: (slider.low, slider.high) for slider in self._variation.sliders}
        for name, value in values.items():
            if name not in bounds:
                raise unknown("slider", name, bounds)
            if not bounds[name][0] <= value <= bounds[name][1]:
                raise ValueError(f"The slider {name!r} has the bounds {bounds[name]}, got {value!r}.")
            self._controls[name].value = float(value)

    def close(self) -> None:
        """End the page and its server."""
        if not self._closed.is_set():
            self._closed.set()
            self._thread.join()
            stage.stop(self._server)
            atexit.unregister(self.close)

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {_HEIGHT}px; border: 1px solid #ddd"
        return f'<iframe src="{html.escape(self.url)}" style="{style}"></iframe>'

    # The page

    def _add_controls(self) -> None:
        gui, ts, sliders = self._server.gui, np.asarray(self.motion.ts), self._variation.sliders
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._said = gui.add_markdown("")
        if ts.size > 1:
            self._playing = gui.add_checkbox("play", False)
            self._time = gui.add_slider("t [s]", *map(float, (ts[0], ts[-1], (ts[-1] - ts[0]) / 1000, ts[0])))
        scale = lambda s: (s.low, s.high, (s.high - s.low) / _STEPS, s.start)
        self._controls = {s.name: gui.add_slider(with_unit(s.name, s.unit), *scale(s)) for s in sliders}
        self._of, self._plots = self.values, {}
        gui.add_button("back to the start").on_click(lambda _: self.set({s.name: s.start for s in sliders}))
        for name, first in self._start.items() if ts.size > 1 else ():
            lines = [{"label": f"start{label}", "stroke": _GREY} for label in first]
            lines += [
                {"label": f"now{label}", "stroke": f"rgb{COLORS[k % len(COLORS)]}", "width": 2}
                for k, label in enumerate(first)
            ]
            title = with_unit(name, named(self._variation.system, name).unit)
            series: Any = ({"label": "t [s]"}, *lines)
            table = self._table(name, self._start)
            options: Any = {"title": title, "height": _PLOT, "padding": _PADDING, "scales": {"x": {"time": False}}}
            self._plots[name] = gui.add_uplot(table, series, **options)

    def _table(self, name: str, curves: Mapping[str, Mapping[str, np.ndarray]]) -> tuple[np.ndarray, ...]:
        return (np.asarray(self.motion.ts), *self._start[name].values(), *curves[name].values())

    def _follow(self) -> None:
        """Look at the sliders again and again, until the page is closed."""
        last = time.monotonic()
        while not self._closed.wait(_TICK):
            if (values := self.values) != self._of:
                self._of = values
                try:
                    self._show(self._variation.motion(values))
                except Exception as error:
                    # The thread must live on, whatever the machine did with the numbers.
                    self.problem = str(error)
                    self._tell()
            span, last = time.monotonic() - last, time.monotonic()
            if self.motion.ts.size > 1:
                self._advance(span)

    def _show(self, motion: Any) -> None:
        """Show another motion, at the same time."""
        drawn = motion_of("", motion, {}, None)
        nodes = drawn.nodes(np.zeros(3), self._view.grain, points=(), arrows={}, scale=0.0, thickness=0.0)
        with self._server.atomic():
            for _, handle in self._nodes:
                handle.remove()
            self._nodes = stage.placed(self._server.scene, nodes)
        self.motion, self.problem, self._shown = motion, "", 0
        self._curves = curves(motion, self._quantities)
        for name, plot in self._plots.items():
            plot.data = self._table(name, self._curves)
        self._place()

    def _advance(self, span: float) -> None:
        """Play on, or go where the slider of the time was moved to."""
        first, last = float(self.motion.ts[0]), float(self.motion.ts[-1])
        if self._time.value != self._now:
            self._now = float(self._time.value)
        elif self._playing.value:
            self._now = self._time.value = first + (self._now - first + span) % (last - first)
        else:
            return
        self._place()

    def _place(self) -> None:
        """Show the state at the present time."""
        k = int(np.argmin(np.abs(np.asarray(self.motion.ts) - self._now)))
        with self._server.atomic():
            for node, handle in self._nodes:
                stage.update(node, handle, k, self._shown)
        self._shown = k
        self._tell()

    def _tell(self) -> None:
        """Write the time, the quantities, and why there is no motion for the present numbers."""
        lines = [f"**No motion:** {self.problem}"] if self.problem else []
        lines.append(f"t = {float(self.motion.ts[self._shown]):.3f} s")
        for name, each in self._curves.items():
            unit = named(self._variation.system, name).unit
            lines += [f"{name}{label} = {x[self._shown]:.4g} {unit}" for label, x in each.items()]
        self._said.content = "  \n".join(lines)
