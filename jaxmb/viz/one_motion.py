"""The single motion or state that a picture shows, without times that a run did not reach."""

import functools
from typing import Any

import jax
import numpy as np

from .._arguments import check_kind
from .._compat import changed
from .._results import RESULTS
from .._types import State
from ..simulate.arguments import checked_state
from ..studies.inverse import RequiredForces
from ..system import AbstractSystem
from ..trajectory import Trajectory, states_of, still


def as_motion(shown: Trajectory | State, system: AbstractSystem | None) -> Trajectory:
    """A motion, or a state of a `system` as a motion with one time.

    **Raises:** `ValueError` for a state without its system, and for a motion with a system.
    """
    if not isinstance(shown, State):
        if system is not None:
            raise ValueError("system belongs to a State that is shown; a motion has its own system.")
        return shown
    if system is None:
        raise ValueError("A picture of a State needs its system: give system=system.")
    return still(system, checked_state(system, shown))


@functools.singledispatch
def poses_of(shown: Any, system: AbstractSystem | None) -> Trajectory:
    """As `as_motion`, also the poses of needed forces; other forces of that motion are not those that are needed."""
    return as_motion(shown, system)


@poses_of.register
def _(shown: list, system):
    for state in shown or [None]:
        check_kind("plot_mechanism: each of a list", state, State, "a state", "motions have pictures of their own")
    # Turns of joints, which some states count, are not seen.
    each = [as_motion(State(state.q, state.u, state.z), system) for state in shown]
    joined = lambda *leaves: np.concatenate(leaves)
    return changed(each[0], ts=joined(*(x.ts for x in each)), ys=jax.tree.map(joined, *(x.ys for x in each)))


@poses_of.register
def _(shown: RequiredForces, system):
    return changed(still(shown.machine, shown.ys), ts=shown.ts, ys=shown.ys)


def one_motion(trajectory: Trajectory, name: str, least: int = 2) -> Trajectory:
    """A single motion, without the padding of a run that ended early.

    **Arguments:** `name` of the picture, for messages; `least`: the number of times that it needs.

    **Raises:** `ValueError` for a batch, for a motion without states, and for one that was saved at fewer times.
    """
    if isinstance(trajectory, State):
        raise ValueError(f"{name} shows a motion, got a State, which plot_mechanism and show take.")
    cure = "what load reads from a file has arrays by name, without a system"
    check_kind(f"{name}: trajectory", trajectory, Trajectory, "a motion from simulate", cure)
    states_of(trajectory)
    if trajectory.ts.ndim != 1:
        shape = trajectory.ts.shape[:-1]
        raise ValueError(
            f"{name} shows single motions, but this is a batch of shape {shape}; choose members of it, such as "
            "batch[0], and show them one by one; viz.show takes a list or a dictionary of them."
        )
    trimmed = trajectory.trimmed()
    if trimmed.ts.shape[0] < least:
        count = ("one time", "two times")[least - 1]
        if trimmed.ts.shape[0] < trajectory.ts.shape[0] and not bool(trajectory.result == RESULTS.successful):
            why = RESULTS[trajectory.result]  # pyright: ignore[reportInvalidTypeArguments]
            raise ValueError(f"{name} needs a motion that reached {count} or more at which it is saved: {why}")
        raise ValueError(f"{name} needs a motion saved at {count} or more; give simulate saveat=…")
    return trimmed


def check_finite(trajectory: Trajectory) -> None:
    """Raise a `ValueError` that names the first time at which a state is not finite."""
    good = np.all([np.all(np.isfinite(np.asarray(y)), axis=-1) for y in jax.tree.leaves(trajectory.ys)], axis=0)
    if not good.all():
        t = float(np.asarray(trajectory.ts)[np.argmin(good)])
        raise ValueError(f"The state at {t:g} s is not finite: the simulation failed; see trajectory.result.")
