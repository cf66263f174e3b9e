"""Controls of a plan with their bounds, and quantities of its motion, over time."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..bodies.units import effort, named
from ..studies.plan import Plan
from .figure import Curve, Panel, chosen, colors_of, components, draw, empty_panels


def plot(plan: Plan, names: Sequence[str] = ()) -> Any:
    """As `Plan.plot`."""
    motion, panels = plan.trajectory, []
    colors = colors_of((*plan.controls, *names), motion.system.body_names)
    for name, values in plan.along.items():
        held = plan.controls[name].interpolation == "held"
        curves = [Curve(label, x, colors[name], style, held) for label, x, style in components(name, values)]
        panels.append(Panel(*effort(plan.system, name), curves))
    quantities = plan.system.quantities()
    for name in chosen("quantity", names, quantities) if names else ():
        of_name = components(name, motion.quantity(name), quantities[name].of_spans)
        curves = [Curve(label, x, colors[name], style) for label, x, style in of_name]
        panels.append(Panel(*named(plan.system, name)[2:], curves))
    figure, places = empty_panels(len(panels))
    for axes, panel, name in zip(places, panels, (*plan.controls, *names), strict=True):
        factor = draw(axes, panel, motion.ts)
        for bound in np.unique(plan.bounds.get(name, ())):
            if np.isfinite(bound):
                axes.axhline(factor * bound, linestyle=":", color="gray")
    return figure
