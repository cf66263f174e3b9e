"""How often a run evaluated the accelerations."""

from collections.abc import Mapping
from typing import Any

import diffrax

# To choose the first step of an adaptive solve.
_FIRST_STEP = 2


def evaluations(solver: diffrax.AbstractSolver, stats: Mapping[str, Any]) -> int | None:
    """Evaluations of the vector field in a run with adaptive steps and a first step of its own choosing.

    Rejected steps count like accepted ones. A Runge–Kutta method whose first stage is the last of the step before
    evaluates it once. Evaluations that only restore saved states are left out. None for solvers that iterate, which
    count nothing.
    """
    if "num_evaluations" in stats:
        return int(stats["num_evaluations"]) + _FIRST_STEP
    tableau = getattr(solver, "tableau", None)
    if not isinstance(tableau, diffrax.ButcherTableau) or tableau.implicit:
        return None
    return int(stats["num_steps"]) * (tableau.num_stages - tableau.fsal) + int(tableau.fsal) + _FIRST_STEP
