"""How often a run evaluated the accelerations."""

from collections.abc import Mapping
from typing import Any

import diffrax

# Of `MultistepController`, to choose the first step.
_FIRST_STEP = 2


def evaluations(solver: diffrax.AbstractSolver, stats: Mapping[str, Any]) -> int | None:
    """Evaluations of the vector field in a run with adaptive steps and a first step of its own choosing.

    Rejected steps count like accepted ones. A Runge–Kutta method whose first stage is the last of the step before
    evaluates it once; evaluations to choose the first step, and again of its first stage if it is rejected, are left
    out for these, which flatters them by one or two. None for solvers that iterate, which count nothing.
    """
    if "num_evaluations" in stats:
        return int(stats["num_evaluations"]) + _FIRST_STEP
    tableau = getattr(solver, "tableau", None)
    if not isinstance(tableau, diffrax.ButcherTableau) or tableau.implicit:
        return None
    return int(stats["num_steps"]) * (tableau.num_stages - tableau.fsal) + int(tableau.fsal)
