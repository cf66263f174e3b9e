"""Checks of the arguments of `simulate`, and their defaults."""

import warnings
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from .._arguments import check_kind, real_array, whole_number
from .._compat import canonical
from .._types import State
from ..formulations import AbstractFormulation
from ..linalg.arrays import ARRAYS, as_array, is_traced
from ..manifold import AbstractManifold
from ..solvers import AbstractMultistep, Adams
from ..solvers.tolerances import closer_tolerance
from ..system import AbstractSystem

DEFAULT_RTOL = 1e-8
# The least `rtol` with an error estimate, in units of the machine precision: the second run has a tenth of it.
_CLOSEST = 100

_KINDS: dict[str, tuple[type, str]] = {
    "solver": (diffrax.AbstractSolver, "jaxmb.solvers.Adams() or diffrax.Tsit5()"),
    "formulation": (AbstractFormulation, "jaxmb.formulations.Multipliers()"),
    "manifold": (AbstractManifold, "jaxmb.manifold.Partition()"),
    "stepsize_controller": (diffrax.AbstractStepSizeController, "jaxmb.solvers.MultistepController(rtol, atol)"),
    "event": (diffrax.Event, "diffrax.Event(function)"),
    "progress_meter": (diffrax.AbstractProgressMeter, "diffrax.TqdmProgressMeter()"),
}


def check_steps(number: Any, name: str = "max_steps") -> None:
    whole_number(name, number)


def check_kinds(*given: Any) -> None:
    """Raise a `ValueError` for an argument of the wrong kind, in the order of `_KINDS`; None is the default."""
    for (name, (kind, example)), value in zip(_KINDS.items(), given, strict=True):
        if value is not None:
            check_kind(name, value, kind, f"an object such as {example}", "leave it out for the default")


def check_fixed_steps(solver: Any, stepsize_controller: Any) -> None:
    """Refuse steps without error estimates for a method that chooses its order by tolerances, unless it has its own."""
    estimates = stepsize_controller is None or isinstance(
        stepsize_controller, diffrax.AbstractAdaptiveStepSizeController
    )
    if not estimates and isinstance(solver, AbstractMultistep) and not solver.tolerances.fixed:
        method, steps = type(solver).__name__, type(stepsize_controller).__name__
        raise ValueError(
            f"{method} chooses its order by tolerances, which {steps} does not have: give them to the solver, as in "
            f"solver=jaxmb.solvers.{method}(rtol=1e-8, atol=1e-10), or take a method of one order, as diffrax.Tsit5(). "
            "To bound steps only, use simulate(..., dtmax=0.01)."
        )


def check_error_estimate(steps: Any, stepsize_controller: Any, event: Any, rtol: Any) -> None:
    """Refuse runs whose times a second run would not share, and tolerances too close to rounding for a second run.

    **Arguments:** `steps`: whether states are saved at the ends of steps.
    """
    if stepsize_controller is not None:
        raise ValueError(
            "error=True repeats the run at tighter tolerances: give rtol and atol, no stepsize_controller."
        )
    if event is not None or steps:
        what = "an event" if event is not None else "SaveAt(steps=True)"
        raise ValueError(
            f"error=True compares two runs at the same times, which {what} does not give; use saveat=times."
        )
    least = _CLOSEST * float(jnp.finfo(rtol.dtype).eps)
    if not is_traced(rtol) and rtol < least:
        raise ValueError(
            f"error=True repeats the run at tighter tolerances, which rtol={float(rtol):g} leaves no room for in a "
            f"precision of {rtol.dtype}; give at least {_rounded_up(least)}."
        )


def closer_tolerances(solver: Any, rtol: Any, atol: Any) -> tuple[Any, Any]:
    """The tolerances of the second run of an error estimate.

    Its steps may err a hundredth as much. With a fixed order they may err a tenth as much, since a hundredth may take
    many times the steps.
    """
    is_multistep = isinstance(solver, AbstractMultistep)
    closer = closer_tolerance(rtol, solver.finest, rtol.dtype) if is_multistep else rtol / 10
    return closer, None if atol is None else atol * (closer / rtol)


def named_solver(name: str) -> Adams:
    if name not in ("auto", "switch"):
        raise ValueError(
            "solver must be an object, such as jaxmb.solvers.Adams(), jaxmb.solvers.Hermite() or diffrax.Tsit5(), or "
            f"one of the words 'auto' and 'switch'; got {name!r}."
        )
    return Adams(stiffness="count" if name == "auto" else "stop")


def checked_tolerances(rtol: Any, atol: Any, state: State) -> tuple[Any, Any]:
    """`rtol`, and `atol` or None."""
    dtype = state.q.dtype
    least = 10 * float(np.finfo(dtype).eps)
    relative = real_array("rtol", rtol, dtype)
    size = sum(x.size for x in jax.tree.leaves(state))
    absolute = None if atol is None else real_array("atol", atol, dtype, ((), (size,)))
    for name, value in (("rtol", relative), ("atol", absolute)):
        if value is not None and not is_traced(value) and not ((value >= 0) & (value < 1)).all():
            raise ValueError(f"{name} must be between 0 and 1, got {value}.")
    if not is_traced(relative) and relative < least:
        if dtype != jnp.float32:
            raise ValueError(f"rtol={rtol:g} is below what double precision can do; use at least {_rounded_up(least)}.")
        whose = "The default rtol" if rtol == DEFAULT_RTOL else "rtol"
        warnings.warn(
            f"{whose}={rtol:g} is below what single precision can do; {least:.1e} is used instead. Switch double "
            'precision on before anything else: import jax; jax.config.update("jax_enable_x64", True).',
            # The caller of `simulate`, which calls `Run.checked`.
            stacklevel=5,
        )
        relative = as_array(least, dtype)
    return relative, absolute


def _rounded_up(bound: float) -> str:
    """A lower bound with two digits, rounded up, so that the value in a message is accepted."""
    return f"{1.05 * bound:.1e}"


def checked_state(system: AbstractSystem, state: Any) -> State:
    cure = "jaxmb.assemble(system) makes one, and so does jaxmb.State(q, u) or, with internal states, State(q, u, z)"
    # A concrete class: a state consists of its fields.
    check_kind("state", state, State, "a jaxmb.State", cure)
    nq, nu, nz = system.nq, system.nu, system.nz
    if (state.z is None) != (nz == 0):
        has = f"has {nz} internal states" if nz else "has no internal states"
        raise ValueError(f"The system {has}, but the state has {'none' if state.z is None else 'some, in z'}; {cure}.")
    of_states = [] if state.z is None else [("z", state.z, nz)]
    if state.angles is not None:
        count = len(system.wrapped_angle_names())
        if np.shape(state.angles) != (count,):
            shape = np.shape(state.angles)
            raise ValueError(
                f"The system has {count} angles known up to full turns, got state.angles of shape {shape}."
            )
        of_states.append(("angles", state.angles, count))
    for name, value, size in (("q", state.q, nq), ("u", state.u, nu), *of_states):
        kind = value.dtype if isinstance(value, ARRAYS) else type(value)
        if np.result_type(kind).kind not in "fiub":
            raise ValueError(f"state.{name} must be an array of real numbers, got {value!r}; {cure}.")
        if np.shape(value) != (size,):
            raise ValueError(
                f"The state must have {nq} coordinates and {nu} velocities"
                f"{f' and {nz} internal states' if nz else ''}, got state.{name} of shape "
                f"{np.shape(value)}."
            )
    dtype = canonical()
    if all(isinstance(x, jax.Array) and x.dtype == dtype for x in jax.tree.leaves(state)):
        return state
    return jax.tree.map(lambda x: jnp.asarray(x, dtype=dtype), state)


def checked_longest_step(dtmax: Any, stepsize_controller: Any, solver: Any, dtype: Any) -> Any:
    """`dtmax`, or None."""
    if dtmax is None:
        return None
    if stepsize_controller is not None:
        raise ValueError(
            "dtmax bounds the steps that rtol and atol choose: give it to the stepsize_controller, or leave that out."
        )
    if isinstance(solver, AbstractMultistep) and solver.tolerances.fixed:
        raise ValueError(
            f"dtmax needs the tolerances of simulate: leave out the tolerances of {type(solver).__name__}."
        )
    longest = real_array("dtmax", dtmax, dtype)
    if not is_traced(longest) and not longest > 0:
        raise ValueError(f"dtmax must be positive, got {dtmax}; leave it out for steps of any length.")
    return longest
