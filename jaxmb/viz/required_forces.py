"""Forces of actuators and their powers, over time."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..bodies.units import effort
from ..studies.inverse import RequiredForces
from .figure import Curve, Panel, check_single, chosen, colors_of, components, draw, empty_panels


def plot(needed: RequiredForces, names: Sequence[str] = ()) -> Any:
    """As `RequiredForces.plot`."""
    check_single(needed.ts)
    names = chosen("actuator", names, needed.forces)
    colors, curves = colors_of(names, needed.machine.body_names), {}
    for name in names:
        of_name = [Curve(label, x, colors[name], style) for label, x, style in components(name, needed.forces[name])]
        curves.setdefault(effort(needed.machine, name), []).extend(of_name)
    panels = [Panel(word, unit, of_unit) for (word, unit), of_unit in curves.items()]
    powers = [Curve(name, np.asarray(needed.power[name]), colors[name]) for name in names]
    panels.append(Panel("power into the machine", "W", powers))
    figure, places = empty_panels(len(panels))
    for axes, panel in zip(places, panels, strict=True):
        draw(axes, panel, needed.ts)
    return figure
