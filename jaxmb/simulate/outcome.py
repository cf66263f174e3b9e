"""How a simulation ended: whether it failed, why, and warnings."""

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from .._results import RESULTS
from .._types import State
from ..formulations.friction import coupled_most
from ..linalg.arrays import is_traced
from ..linalg.recent import Recent
from ..manifold.impulse import find_jumps
from ..solvers import AbstractMultistep, Adams
from ..states.consistency import contradiction, not_finite
from ..states.headings import about_headings, are_short
from ..states.refusals import LostRank, lost_rank, violated_joints
from ..system.instant import Instant
from .span import Span

# A message about contacts without solution names gaps below this fraction of the system's size.
_TOUCH = 1e-6
# Stiffness is tested after at least this many steps, within this number of further steps.
_ENOUGH, _LOOKED = 200, 512
# A message names at most this many joints of a singular configuration.
_NAMED = 8
# Residuals contradict each other by more than this part of them.
_CONTRADICTED = 1e-6
# Beyond the end of a motion, residuals above this part of the displacement count.
_UNMET = 0.1

# The motion that steps resolve in single precision and, at the default tolerance, in double precision, relative to the
# size of the system.
_MOVED_SINGLE, _MOVED = 1e-6, 1e-11
# The jumps of the last few systems and intervals: a loop of simulations searches for them once.
_jumps = Recent(8)


class Flags(NamedTuple):
    """The flags that are read after a simulation.

    **Fields:** `failed`; `inconsistent`: its start violates the constraints; `stuck`: it got stuck on its way; `whole`:
    every requested state was saved; `ran_out`: there were too few steps; `long`: it took at least as many steps as
    derivatives keep at once.
    """

    failed: Any
    inconsistent: Any
    stuck: Any
    whole: Any
    ran_out: Any
    long: Any


class Outcome(NamedTuple):
    """How a simulation ended, beside its `Trajectory`.

    **Fields:** `flags`, as one array in the order of `Flags`; the last time `t` and state `y`; `step`: the length of
    the next step, None if the controller does not know it; `coupling` of friction with its own reactions if it caused a
    failure, None without friction; `evidence` by which the manifold diagnoses a failure; `reach`: counted angles at the
    start, the least and the largest, shape (3, k), None if none are counted.
    """

    flags: Any
    t: Any
    y: Any
    step: Any
    coupling: Any
    evidence: Any
    reach: Any


def about_friction(system, coupling) -> str:
    coupled_rows = system.friction_rows[coupled_most(np.asarray(coupling))]
    names = ", ".join(dict.fromkeys(repr(system.rows[k][0]) for k in coupled_rows))
    return (
        f"The friction of {names} came to a singular configuration: its force changes the reaction that it depends on "
        "so much that there is no solution, or more than one (Painlevé's paradox). A smaller coefficient or a "
        "compliant contact has one. With `throw=False` the motion up to there is kept."
    )


def about_contacts(system, outcome: Outcome) -> str:
    """The message about touching bodies for which no forces of contacts and friction are possible."""
    contacts = system.contacts
    gaps = Instant.of(system, outcome.t, outcome.y).normalized().gaps
    touch = np.asarray(gaps) <= _TOUCH * float(system.length)
    touch = np.append(touch, [True] * contacts.m)
    names = ", ".join(dict.fromkeys(repr(name) for name, at in zip(contacts.names, touch, strict=True) if at))
    at = f"These are {names}, at t = {float(outcome.t):.6g}."
    return f"{RESULTS[RESULTS.contacts_undetermined]} {at}{contacts.sharing.about()}"


def has_failed(result) -> Any:
    return ~((result == RESULTS.successful) | (result == RESULTS.event_occurred))


def first_of(reasons: Sequence[tuple[Any, Any]], otherwise: Any) -> Any:
    """The result of the first reason that holds.

    **Arguments:** `reasons`: pairs `(holds, result)`; `holds` may be the constant False.
    """
    result = otherwise
    for holds, reason in reversed(reasons):
        if holds is not False:
            result = RESULTS.where(holds, reason, result)
    return result


def warn_of_stiffness(stats) -> None:
    if isinstance(stats["stiff"], Tracer) or not stats["stiff"]:
        return
    warnings.warn(
        f"The motion is stiff: in {stats['stiff_steps']} of {stats['num_steps']} steps of Adams' method stability was "
        "the limit. simulate(..., solver=jaxmb.solvers.Hermite()) takes longer steps.",
        stacklevel=5,
    )


def warn_of_parts(system, motion, reach) -> None:
    """Warn of parts that a concrete motion uses beyond their model, if it saves states; `reach` as in `Outcome`."""
    cautions = system.catalogue.cautions(motion, reach) if isinstance(motion.ys, State) else ()
    for caution in cautions:
        warnings.warn(caution, stacklevel=5)


def warn_of_wrong_derivative(stats: dict[str, Any]) -> None:
    """Warn if differences contradict the derivative of the vector field, as far as this is known."""
    wrong = stats.get("wrong_derivative", False)
    if is_traced(wrong) or not np.any(wrong):
        return
    warnings.warn(
        "The derivative of the vector field contradicts its differences, so the results of `Hermite` may be wrong: "
        "look for `stop_gradient`, rounding and integers in the functions of parts.",
        stacklevel=5,
    )


def warn_of_jumps(system, outcome: Outcome, span: Span, restarts, announced) -> None:
    """Warn of jumps of prescribed rates between the restarts of a concrete motion.

    **Arguments:** `announced`: the jumps that the user gave, or None.
    """
    q, t0, t1 = outcome.y.q, span.t0, span.t1
    restarts = np.zeros(0) if restarts is None else np.asarray(restarts)
    # Prescribed rates jump at the same times for all coordinates.
    jumps = _jumps.found((system, t0, t1, restarts), lambda: find_jumps(system, q, t0, t1, restarts))
    if not jumps:
        return
    # The rows of ψ, then the rows of A.
    rows = (*system.rows[: system.velocity_rows], *system.rows)
    names = " and ".join(dict.fromkeys(repr(rows[jump.row][0]) for jump in jumps))
    times = list(dict.fromkeys(jump.t for jump in jumps))
    announced_times = [] if announced is None else list(np.asarray(announced, times[0].dtype))
    every = ", ".join(str(t) for t in sorted({*announced_times, *times}))
    warnings.warn(
        f"The motion that {names} prescribes has a jump or a kink at t = {' and '.join(str(t) for t in times)}, which "
        "an integration passes without an impulse or in many steps; "
        f"simulate(..., jumps=[{every}]) restarts there.",
        stacklevel=6,
    )


def message_of_failure(system, result, span: Span, outcome: Outcome, stats, solver, probe) -> str:
    """Why and where a simulation failed; `probe` as in `is_stiff_at_end`."""
    if is_traced((system, outcome, span)):
        return RESULTS[result]
    if np.any(outcome.coupling):
        return f"{how_far(outcome, span)} {about_friction(system, outcome.coupling)}"
    if result == RESULTS.contacts_undetermined:
        return about_contacts(system, outcome)
    if system.catalogue.lost_headings and (lost := about_headings(system, are_short(system, outcome.t, outcome.y.q))):
        return (
            f"{how_far(outcome, span)} There {lost}, so the motion beyond is not determined. With `throw=False` the "
            "motion up to there is kept."
        )
    is_finite = bool(np.all(np.isfinite(np.concatenate(jax.tree.leaves(outcome.y)))))
    reached = system.catalogue.limits(outcome.t, outcome.y.q) if is_finite else ()
    if reached:
        kept = "With `throw=False` the motion up to there is kept."
        return f"{how_far(outcome, span)} There {' and '.join(reached)}. {kept}"
    if not system.body_names and (wrong := about_residuals(system.at(outcome.y), outcome.t, outcome.y)):
        return f"{how_far(outcome, span)} {wrong}"
    if result == RESULTS.max_steps_reached:
        return about_steps(outcome, span, stats, is_stiff_at_end(probe, stats, solver))
    if not is_finite:
        return RESULTS[result] + about_entries(system, outcome.y)
    if result == RESULTS.inconsistent_constraints:
        return contradiction(system, outcome.t, outcome.y)
    shares = system.contacts.sharing.where_stuck(system.contacts)
    return f"{how_far(outcome, span)} {reason_of_failure(system, result, span, outcome)}{shares}"


def about_entries(system, y) -> str:
    """The entries of a state that are not finite. Euler parameters of length zero are told apart."""
    return about_zero_attitudes(system, y.q) or f" Not finite: {not_finite(system, q=y.q, u=y.u, z=y.z)}."


def about_residuals(system, t, y: State) -> str:
    """How residuals that a class of the user's gives contradict each other, or what it declares; else empty."""
    if not system.velocity_rows or not np.all(np.isfinite(y.q)):
        return ""
    scale, t = system.velocity_scale(), jnp.asarray(t, y.q.dtype)
    # At any velocities and accelerations.
    u, udot = (scale * jnp.cos(k + jnp.arange(y.u.size, dtype=y.q.dtype)) for k in (1.0, 2.0))
    along = jnp.ones_like(t), system.rates(t, y.q, u)
    at = lambda u: system.velocity_residual(t, y.q, u)
    velocity, still = at(u), at(0 * u)
    pairs = {
        "velocity_residual is not the derivative of position_residual by time, with its terms in t": (
            velocity[: system.position_rows],
            jax.jvp(system.position_residual, (t, y.q), along)[1],
        ),
        "acceleration_residual is not the derivative of velocity_residual by time, with its terms in t": (
            system.acceleration_residual(t, y.q, u, udot)[: system.velocity_rows],
            jax.jvp(system.velocity_residual, (t, y.q, u), (*along, udot))[1],
        ),
    }
    if system.drift_free:
        pairs["velocity_residual does not vanish at rest, although drift_free = True"] = velocity, velocity - still
    if system.linear:
        pairs["velocity_residual is not linear, although linear = True"] = at(2 * u) - velocity, velocity - still
    for text, (value, expected) in pairs.items():
        size = float(jnp.max(jnp.abs(expected), initial=0.0) + jnp.max(jnp.abs(velocity)))
        off = ~(np.abs(np.asarray(value - expected)) <= _CONTRADICTED * size)
        if np.any(off):
            names = ", ".join(dict.fromkeys(repr(system.rows[k][0]) for k in np.flatnonzero(off)))
            return f"The residuals of {names} contradict each other: {text}."
    return ""


def about_zero_attitudes(system, q) -> str:
    """The bodies whose Euler parameters alone are not finite after normalisation; empty if there are none."""
    wrong = ~np.isfinite(np.asarray(q))
    attitudes = {n: index for n, index in system.coordinate_names().items() if n.endswith(".orientation")}
    zero = [name for name, index in attitudes.items() if np.all(wrong[index])]
    if not zero or np.sum(wrong) > sum(len(attitudes[name]) for name in zero):
        return ""
    return f" Euler parameters that are all zero have no direction: give {', '.join(zero[:_NAMED])}."


def how_far(outcome: Outcome, span: Span) -> str:
    """The time that was reached and the time to be reached, with six digits of their difference from the start."""
    t0, t, t1 = float(span.t0), float(outcome.t), float(span.t1)
    digits = 6 + max(0, int(np.log10(max(abs(t0), 1e-300) / max(abs(t1 - t0), 1e-300))))
    return f"The motion came to t = {t:.{digits}g} of {t1:.{digits}g}."


def about_steps(outcome: Outcome, span: Span, stats, stiff) -> str:
    """How far a motion came in the largest number of steps, and the cure.

    **Arguments:** `stiff`: whether it is stiff at its end, None if unknown, and False with a solver for stiff motions.
    """
    steps = int(stats["num_steps"])
    length = "" if outcome.step is None else f", with steps of about {abs(float(outcome.step)):.2g} in the end"
    text = f"{how_far(outcome, span).rstrip('.')} in max_steps = {steps} steps{length}. "
    if stiff:
        return text + (
            "It is stiff there: stability is the limit of its steps. simulate(..., solver=jaxmb.solvers.Hermite()) "
            "takes longer steps."
        )
    cure = "A larger max_steps or a coarser rtol takes it further"
    if stiff is None:
        cure += (
            '; or it may be stiff, which solver="auto" detects: solver=jaxmb.solvers.Hermite() then takes longer steps'
        )
    return text + cure + "."


def is_stiff_at_end(probe, stats, solver) -> bool | None:
    """Whether a motion that took the largest number of steps is stiff at its end; None if it took too few steps to
    tell, or if Adams' method cannot go on from there.

    **Arguments:** `probe(solver, steps)`: the trajectory from there with a solver, in at most `steps` steps.
    """
    if isinstance(solver, AbstractMultistep) and solver.solves_implicitly:
        return False
    if "stiff" in stats:
        return bool(stats["stiff"])
    if stats["num_steps"] < _ENOUGH:
        return None
    with warnings.catch_warnings():
        # The motion's own warnings have been given.
        warnings.simplefilter("ignore")
        try:
            return bool(probe(Adams(stiffness="count"), _LOOKED).stats["stiff"])
        except ValueError:
            return None


def reason_of_failure(system, result, span: Span, outcome: Outcome) -> str:
    """Why a simulation ended at a finite state. The reasons are numbers that are not finite there or just beyond,
    joints whose constraints lose rank or cannot be met, and times that are too coarse.
    """
    t, y = outcome.t, outcome.y
    system = system.at(y)
    rates = system.rates(t, y.q, y.u)
    ahead = np.append(0.0, np.logspace(-12, -3, 10)) * (np.clip(span.t1, t - 1.0, t + 1.0) - t)
    for step in ahead:
        wrong = system.catalogue.not_finite(t + step, y.q + step * rates, y.u)
        if wrong:
            names = f"{' and '.join(wrong)} {'is' if len(wrong) == 1 else 'are'} not finite"
            return f"At t = {float(t + step):.6g} {names}. With `throw=False` the motion up to there is kept."
    if result not in (RESULTS.newton_failed, RESULTS.singular_configuration):
        return RESULTS[result]
    lost = lost_rank(system, t, y)
    if lost is not None:
        return about_lost_rank(lost)
    coarse = about_coarse_times(system, span, t, y)
    if coarse:
        return f"{coarse} Or: {RESULTS[result]}"
    unmet = about_unmet(system, outcome, ahead, rates)
    return " ".join((RESULTS[result] + unmet, *system.catalogue.jumps_of_rows(t, y.q)))


def about_lost_rank(lost: LostRank) -> str:
    """The message about joints that make a configuration singular, and about drives that lead beyond it."""
    text = (
        "The mechanism came to a singular configuration there (toggle, lock-up or bifurcation): the constraints of "
        f"{', '.join(lost.joints[:_NAMED])} are no longer independent"
    )
    if lost.drives:
        names = " and ".join(repr(name) for name in lost.drives)
        leaves = "leaves its reach" if len(lost.drives) == 1 else "leave their reach"
        text += f", and the motion that {names} prescribes {leaves}: the mechanism cannot follow it beyond"
    else:
        text += ", and the motion beyond is not determined by them"
    return f"{text}. With `throw=False` the motion up to there is kept."


def about_unmet(system, outcome: Outcome, ahead, rates) -> str:
    """The joints with the largest residuals after the next step, or a shorter one, taken without constraints. Empty if
    residuals are small beside the displacement, as for smooth constraints.
    """
    t, y = outcome.t, outcome.y
    speed = np.max(np.abs(y.u) / system.velocity_scale(), initial=0.0)
    next_step = [] if outcome.step is None else [float(outcome.step)]
    for step in [*next_step, *ahead]:
        q = system.normalize(t + step, y.q + step * rates)
        unmet = violated_joints(system, t + step, q, least=max(1e-9, _UNMET * abs(step) * speed))
        if unmet:
            units = " [m, rad]" if system.body_names else ""
            return f" At t = {float(t + step):.6g}, just beyond, the largest residuals{units} are of {unmet}."
    return ""


def about_coarse_times(system, span: Span, t, y) -> str:
    """The cure if a motion changes by more than it resolves between two adjacent numbers for the time; else empty."""
    coarse = float(np.spacing(np.abs(np.asarray(t))))
    speed = np.max(np.abs(y.u) / system.velocity_scale(), initial=1 / abs(span.t1 - span.t0))
    moved = coarse * float(speed)
    single = np.finfo(y.q.dtype).bits < 64
    if moved < (_MOVED_SINGLE if single else _MOVED):
        return ""
    cure = "Switch double precision on, or let the time begin at zero." if single else "Let the time begin at zero."
    return (
        f"The time is too coarse for steps of this accuracy: the numbers next to t = {float(t):.6g} are {coarse:.1e} s "
        f"away, in which bodies move by {moved:.1e} of the size of the system. {cure}"
    )
