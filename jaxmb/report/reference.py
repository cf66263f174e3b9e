"""Reference values for the errors of a report."""

import diffrax
import numpy as np

from ..mechanisms import Mechanism, References
from ..simulate import simulate
from .subject import natural_coordinates

# Least ratio of a known error to the reference's error.
MARGIN = 10.0

# Below this tolerance round-off dominates.
_TIGHTEST = 1e-13
# The number of times at which the sizes of quantities are evaluated.
_TIMES = 21


def reference(mechanism: Mechanism, tolerance: float) -> References:
    """Values at the end of a mechanism's motion: published values, or a run a hundred times tighter than `tolerance`.

    The run is checked by a second method, Dormand–Prince 8, with projection if there are constraints; the largest
    relative difference of the two is the `tolerance` of the result. Sizes are the largest values along the motion.
    """
    if mechanism.references is not None:
        return mechanism.references
    rtol = max(tolerance / 100, _TIGHTEST)
    ts = np.linspace(0.0, mechanism.t1, _TIMES)

    def run(solver):
        return simulate(mechanism.system, mechanism.state, t1=mechanism.t1, rtol=rtol, solver=solver, saveat=ts)

    observed, checked = (mechanism.observe(run(solver)) for solver in (None, diffrax.Dopri8()))
    labels = tuple(label for label, value in observed.items() if value.ndim == 1)
    values, check = (np.stack([np.asarray(seen[label]) for label in labels], 1) for seen in (observed, checked))
    sizes = np.max(np.abs(values), axis=0)
    if mechanism.observe is natural_coordinates:
        # One size for all coordinates, and one for all velocities.
        sizes = np.array(
            [max(size for size, other in zip(sizes, labels, strict=True) if other[0] == x[0]) for x in labels]
        )
    projected = " with projection" if mechanism.system.acceleration_rows else ""
    source = f"Adams at rtol {rtol:.0e}, checked by Dopri8{projected}"
    provisional = References(ts[-1:], labels, values[-1:], source, 0.0, sizes)
    difference = float(np.max(np.abs(values - check)[-1] / provisional.scales))
    return References(provisional.times, labels, provisional.values, source, difference, sizes)
