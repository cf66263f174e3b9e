"""The number of evaluations of the accelerations in a run."""

from collections.abc import Mapping
from typing import Any

import diffrax


def evaluations(solver: diffrax.AbstractSolver, stats: Mapping[str, Any]) -> int | None:
    """Evaluations of the vector field in a run with adaptive steps whose first step the controller chooses.

    Rejected steps count like accepted ones. The first stage of a Runge–Kutta method that is the last stage of the
    previous step counts once. Evaluations for the choice of these methods' first step, and its repetition after a
    rejection, are not counted, which favours them by one or two. The trial of a `MultistepController` is counted. The
    result is None for implicit Runge–Kutta methods, which do not report their iterations.
    """
    if "num_evaluations" in stats:
        return int(stats["num_evaluations"])
    tableau = getattr(solver, "tableau", None)
    if not isinstance(tableau, diffrax.ButcherTableau) or tableau.implicit:
        return None
    return int(stats["num_steps"]) * (tableau.num_stages - tableau.fsal) + int(tableau.fsal)
