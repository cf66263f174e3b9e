"""How a simulation ended: whether it failed, why, and warnings."""

import warnings
from typing import Any

import jax
import numpy as np

from .._results import RESULTS
from ..formulations.friction import coupled_most
from ..linalg.arrays import is_traced
from ..manifold import find_jump
from ..states.consistency import contradiction


def about_friction(system, coupling) -> str:
    own = system.friction_rows[coupled_most(np.asarray(coupling))]
    names = ", ".join(dict.fromkeys(repr(system.rows[k][0]) for k in own))
    return (
        f"The friction of {names} came to a singular configuration: its force changes the reaction that it depends on "
        "so much that there is no solution, or more than one (Painlevé's paradox). A smaller coefficient or a "
        "compliant contact has one. With `throw=False` the motion up to there is kept."
    )


def has_failed(result) -> Any:
    return ~((result == RESULTS.successful) | (result == RESULTS.event_occurred))


def warn_of_jumps(system, q, t0, t1) -> None:
    t, row, found = find_jump(system, q, t0, t1)
    if found:
        # The rows of ψ, then those of A.
        name = (*system.rows[: system.velocity_rows], *system.rows)[int(row)][0]
        warnings.warn(
            f"The motion that {name!r} prescribes has a jump or a kink at t = {float(t):.6g}, which an integration "
            f"passes without an impulse or in many steps; simulate(..., jumps=[{float(t):.6g}]) restarts there.",
            stacklevel=3,
        )


def reason_of_failure(system, result, t1, t, y) -> str:
    """Why a simulation ended at a state, in one line, with what is not finite there or just beyond."""
    text = RESULTS[result]
    if is_traced((system, t, y)) or not np.all(np.isfinite(np.concatenate(jax.tree.leaves(y)))):
        return text
    if result == RESULTS.inconsistent_constraints:
        return contradiction(system, t, y)
    system = system.at(y)
    rates = system.rates(t, y.q, y.u)
    for ahead in np.append(0.0, np.logspace(-12, -3, 10)) * (np.clip(t1, t - 1.0, t + 1.0) - t):
        wrong = system.not_finite(t + ahead, y.q + ahead * rates, y.u)
        if wrong:
            return f"{text} Here at t = {float(t + ahead):.6g} {' and '.join(wrong)} is not finite."
    return text
