"""Reference values that the errors of a report are relative to."""

import diffrax
import numpy as np

from ..mechanisms import Mechanism, References
from ..simulate import simulate

# Below this tolerance round-off dominates.
_TIGHTEST = 1e-13


def reference(mechanism: Mechanism, tolerance: float) -> References:
    """Values at the end of a mechanism's motion: published ones, or those of a run two orders tighter than `tolerance`.

    The run is checked by a second method, Dormand–Prince 8, with projection if there are constraints; the largest
    relative difference of the two is the `tolerance` of the result.
    """
    if mechanism.references is not None:
        return mechanism.references
    rtol = max(tolerance / 100, _TIGHTEST)
    run = lambda solver: simulate(mechanism.system, mechanism.state, t1=mechanism.t1, rtol=rtol, solver=solver)
    observed, checked = (mechanism.observe(run(solver)) for solver in (None, diffrax.Dopri8()))
    labels = tuple(label for label, value in observed.items() if value.ndim == 1)
    values = np.array([[float(observed[label][-1]) for label in labels]])
    check = np.array([[float(checked[label][-1]) for label in labels]])
    projected = " with projection" if mechanism.system.acceleration_rows else ""
    source = f"Adams at rtol {rtol:.0e}, checked by Dopri8{projected}"
    own = References(np.array([mechanism.t1]), labels, values, source, 0.0)
    difference = float(np.max(np.abs(values - check) / own.scales))
    return References(own.times, labels, values, source, difference)
