"""Checks of the arguments of `simulate`, and their defaults."""

import contextlib
import math
import warnings
from collections.abc import Mapping
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from .._arguments import check_kind, real_array, whole_number
from .._captured import CapturedModule
from .._compat import changed, default_float
from .._traced_functions import is_installed
from .._types import State, VectorLike
from ..formulations import AbstractFormulation
from ..linalg.arrays import ARRAYS, as_array, is_traced
from ..linalg.recent import Recent
from ..manifold import AbstractManifold
from ..parts.names import unknown
from ..solvers import AbstractMultistep, Adams, MultistepController, RunningScales
from ..solvers.events import EventController
from ..solvers.gaps import GapController
from ..solvers.one_step import OneStepController
from ..solvers.tolerances import closer_tolerance
from ..system import AbstractSystem
from ..system.inputs import input_break_times, turning_times
from ..system.parameters import parameters

DEFAULT_RTOL = 1e-8
# What is kept of steps takes this memory at first [bytes], or that of so many steps.
_ROOM, _FEWEST_STEPS = 2**24, 1024
# A motion that takes more steps than there was room for is computed again with so many times as much.
_MORE_ROOM = 8
# Derivatives keep numbers of this many steps, of fewer where they do not fit in this many bytes.
MOST_ROWS, _FEWEST_ROWS, _ROW_BYTES = 2048, 64, 2**27
# A program saves at this number of times, or at a power of 2 of them.
_FEWEST_TIMES = 4
# The least `rtol` with an error estimate, in units of the machine precision: a second run has a tenth.
_CLOSEST = 100

# The stops and the jumps of inputs of the last few runs: a loop of simulations looks for them once.
_stops, _breaks = Recent(8), Recent(8)

_KINDS: dict[str, tuple[type, str]] = {
    "solver": (diffrax.AbstractSolver, "jaxmb.solvers.Adams() or diffrax.Tsit5()"),
    "formulation": (AbstractFormulation, "jaxmb.formulations.Multipliers()"),
    "manifold": (AbstractManifold, "jaxmb.manifold.Partition()"),
    "stepsize_controller": (diffrax.AbstractStepSizeController, "jaxmb.solvers.MultistepController(rtol, atol)"),
    "adjoint": (diffrax.AbstractAdjoint, "diffrax.ForwardMode()"),
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
    """Refuse steps without error estimates for a method that chooses its order by them, unless it has tolerances."""
    estimates = stepsize_controller is None or isinstance(
        stepsize_controller, diffrax.AbstractAdaptiveStepSizeController
    )
    if not estimates and isinstance(solver, AbstractMultistep) and not solver.tolerances.fixed:
        own, steps = type(solver).__name__, type(stepsize_controller).__name__
        raise ValueError(
            f"{own} chooses its order by tolerances, which {steps} does not have: give them to the solver, as in "
            f"solver=jaxmb.solvers.{own}(rtol=1e-8, atol=1e-10), or take a method of one order, as diffrax.Tsit5(). "
            "Steps that are only bounded have simulate(..., dtmax=0.01)."
        )


def default_controller(solver: Any, rtol: Any, atol: Any, scales: RunningScales | None, dtmax: Any) -> Any:
    if isinstance(solver, AbstractMultistep):
        return MultistepController(rtol, atol, scales=scales, dtmax=dtmax)
    return OneStepController.around(diffrax.PIDController(rtol, atol, dtmax=dtmax), scales)


def adapts(controller: Any) -> bool:
    """Whether a controller, None for the default, chooses steps by their errors."""
    return controller is None or isinstance(controller, diffrax.AbstractAdaptiveStepSizeController)


def may_stop(controller: Any) -> bool:
    """Whether steps of a controller, None for the default, may be cut at times that it does not know of."""
    return adapts(controller) and not isinstance(controller, diffrax.ClipStepSizeController)


def stops_of(system: AbstractSystem, state: State, times: Mapping[str, Any], controller: Any, traced: bool) -> Any:
    """Times that no step of a run may pass, or None; `traced`: whether anything of the run is."""
    if not may_stop(controller):
        return None
    own = system, state, times["t0"], times["t1"]
    return turning_times(*own) if traced else _stops.found(own, lambda: turning_times(*own))


def breaks_of(system: AbstractSystem, times: Mapping[str, Any]) -> np.ndarray:
    """Times [s] at which inputs of a run jump, or their rates where these count; see `input_break_times`."""
    own = system, times["t0"], times["t1"]
    return _breaks.found(own, lambda: input_break_times(*own))


def with_restarts(controller: Any, restarts: Any, stops: Any, events: int | None, gaps: bool) -> Any:
    """A controller that restarts at some times, steps to others, and restarts at as many events of contacts; None where
    there are none. Where forces have `gaps`, its steps hide none of these.
    """
    controller = controller if events is None else EventController(controller, events)
    controller = GapController(controller) if gaps else controller
    if restarts is None and stops is None:
        return controller
    return diffrax.ClipStepSizeController(controller, step_ts=stops, jump_ts=restarts)


def check_error_estimate(steps: Any, stepsize_controller: Any, event: Any, rtol: Any) -> None:
    """Refuse runs whose times a second run would not share, and tolerances that leave it no room.

    **Arguments:** `steps`: whether states are saved at the ends of steps.
    """
    if stepsize_controller is not None:
        raise ValueError(
            "error=True repeats the run at tighter tolerances: give rtol and atol, no stepsize_controller."
        )
    if event is not None or steps:
        what = "an event" if event is not None else "SaveAt(steps=True)"
        raise ValueError(
            f"error=True compares two runs at the same times, which {what} does not have; give saveat=times."
        )
    least = _CLOSEST * float(jnp.finfo(rtol.dtype).eps)
    if not is_traced(rtol) and rtol < least:
        raise ValueError(
            f"error=True repeats the run at tighter tolerances, which rtol={float(rtol):g} leaves no room for in a "
            f"precision of {rtol.dtype}; give at least {_rounded_up(least)}."
        )


def closer_tolerances(solver: Any, rtol: Any, atol: Any) -> tuple[Any, Any]:
    """The tolerances of the second run of an error estimate, whose steps may err a hundredth as much; a tenth where the
    order is fixed, and a hundredth may take many times the steps.
    """
    is_multistep = isinstance(solver, AbstractMultistep)
    closer = closer_tolerance(rtol, solver.finest, rtol.dtype) if is_multistep else rtol / 10
    return closer, None if atol is None else atol * (closer / rtol)


def parameter_changes(system: AbstractSystem, direction: Mapping[str, VectorLike]) -> dict[str, tuple[Any, Any]]:
    """Values of parameters and their changes, by name."""
    known = parameters(system)
    if not isinstance(direction, Mapping):
        raise ValueError(f"direction must be a dictionary of parameters by name, got {direction!r}.")
    for name in direction:
        if name not in known:
            raise unknown("parameter", name, known)
    array = lambda name, x: real_array(f"direction[{name!r}]", x, known[name].dtype, (known[name].shape,))
    return {name: (known[name], array(name, x)) for name, x in direction.items()}


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
            stacklevel=3,
        )
        relative = as_array(least, dtype)
    return relative, absolute


def _rounded_up(bound: float) -> str:
    """Two digits of a lower bound that are not below it, so that the value that a message names is accepted."""
    return f"{1.05 * bound:.1e}"


def checked_saveat(saveat: Any, start: Any, end: Any) -> diffrax.SaveAt:
    if saveat is None:
        return _END
    if isinstance(saveat, diffrax.SaveAt):
        if not isinstance(saveat.subs, diffrax.SubSaveAt) and saveat.subs is not None:
            raise ValueError("simulate saves one series; use SaveAt without subs, or diffrax.diffeqsolve directly.")
        for name in ("solver_state", "controller_state", "made_jump"):
            if getattr(saveat, name):
                raise ValueError(f"simulate does not return what SaveAt({name}=True) saves; leave it out.")
        if saveat.subs is not None and saveat.subs.ts is not None:
            times = _check_saved_times(saveat.subs.ts, start, end)
            return changed(saveat, subs=changed(saveat.subs, ts=times))
        return saveat
    times = _check_saved_times(saveat, start, end)
    return changed(_END, subs=changed(_AT_END, t1=False, ts=times))


def _check_saved_times(times: Any, start: Any, end: Any) -> Any:
    ts = real_array("saveat", times, jnp.result_type(float), None)
    if ts.ndim != 1 or ts.shape[0] == 0:
        raise ValueError(
            f"saveat must be a vector of times or a diffrax.SaveAt, got shape {ts.shape}; for 11 equally spaced states "
            "saveat=numpy.linspace(t0, t1, 11)."
        )
    if is_traced((ts, start, end)):
        return ts
    if not (min(start, end) <= ts.min() and ts.max() <= max(start, end)):
        raise ValueError(
            f"saveat must lie between t0 = {start:g} and t1 = {end:g}, got times from {ts.min():g} to {ts.max():g}."
        )
    if np.any(np.diff(ts) * (1 if start <= end else -1) < 0):
        raise ValueError(f"saveat must run from t0 to t1 without turning back, got {ts}.")
    return ts


# What diffrax gives a function of an event besides the time, the state and the arguments.
_OF_EVENTS = ("terms", "solver", "t0", "t1", "dt0", "saveat", "stepsize_controller", "max_steps")


def captured_event(event: diffrax.Event | None, t: Any, state: State) -> diffrax.Event | None:
    """An event whose functions are told apart by what they compute now."""
    if event is None:
        return None
    own = jax.tree.map(lambda f: _captured_call(f, t, state, None, **dict.fromkeys(_OF_EVENTS)), event.cond_fn)
    return changed(event, cond_fn=own)


def _captured_call(function: Any, *args: Any, **named: Any) -> Any:
    """A function of the user's, told apart from others by what it computes now of such arguments; anything else, and a
    function of a package, as it is.
    """
    if not callable(function) or is_installed(getattr(getattr(function, "__code__", None), "co_filename", None)):
        return function
    own = CapturedModule(function)
    # One that needs other arguments is told apart as a function.
    with contextlib.suppress(Exception):
        own.trace(*args, **named)
    own.known.keep()
    return own


def checked_jumps(jumps: Any, of_inputs: np.ndarray) -> Any:
    """Times at which to restart: those that the user announces and those of inputs; None if there are none."""
    if jumps is None:
        return jnp.asarray(of_inputs) if of_inputs.size else None
    times = real_array("jumps", jumps, jnp.result_type(float), None)
    if times.ndim != 1 or times.shape[0] == 0 or not (is_traced(times) or np.all(np.isfinite(times))):
        raise ValueError(f"jumps must be a vector of finite times, got {jumps!r}; leave it out if there are none.")
    return jnp.sort(jnp.concatenate([jnp.asarray(times), jnp.asarray(of_inputs, times.dtype)]))


# The state at the end, and what `with_end` makes of that.
_AT_END = diffrax.SubSaveAt(t1=True)
_END = diffrax.SaveAt(subs=_AT_END)
_ENDS = diffrax.SaveAt(subs=(_AT_END, _AT_END), solver_state=True, controller_state=True)


def with_end(saveat: diffrax.SaveAt, t: Any, state: State) -> diffrax.SaveAt:
    """The user's series and, for statistics and diagnosis, the end state."""
    if saveat is _END:
        return _ENDS
    first = _AT_END if saveat.subs is None else saveat.subs
    return changed(
        _ENDS, subs=(changed(first, fn=_captured_call(first.fn, t, state, None)), _AT_END), dense=saveat.dense
    )


def padded(saveat: diffrax.SaveAt, start: Any, end: Any) -> diffrax.SaveAt:
    """The same with times behind the end of the run, which are not saved: one program serves several numbers."""
    first, last = saveat.subs
    if first.ts is None or first.ts.shape[0] == 0 or start == end:
        # In no time at all every time would be saved.
        return saveat
    more = max(_FEWEST_TIMES, 2 ** math.ceil(math.log2(first.ts.shape[0]))) - first.ts.shape[0]
    never = np.full(more, np.inf if end > start else -np.inf, first.ts.dtype)
    times = np.concatenate([np.asarray(first.ts), never])
    return changed(saveat, subs=(changed(first, ts=times), last))


def rooms_for(max_steps: int, saveat: diffrax.SaveAt, state: State, traced: bool, tries: bool) -> list[int]:
    """How many steps programs have room for, of which the next is used where a motion takes more steps than the last.

    If nothing is kept of each step, the next power of 4 from `max_steps`, so that one program serves several numbers.
    Derivatives keep numbers of each step; a derivative of more steps than `kept_steps` has a program that finds them
    again, so where one `tries`, as it can where values are known, the first has room for no more.

    If states are kept, `max_steps` in a program that is traced, and else first as many as take little memory.
    """
    # Of dense output as many numbers for each of the state as a multistep method has in its history.
    kept = 16 if saveat.dense else int(saveat.subs[0].steps)
    if not kept:
        room, fewer = 4 ** math.ceil(math.log(max(max_steps, 4), 4) - 1e-9), kept_steps(state)
        if room <= fewer:
            return [room]
        if max_steps <= fewer:
            return [fewer]
        return [fewer, room] if traced and tries and fewer == MOST_ROWS else [room]
    if traced:
        return [max_steps]
    size = sum(x.nbytes for x in jax.tree.leaves(state))
    rooms = [max(2 ** int(math.log2(_ROOM / (kept * size))), _FEWEST_STEPS)]
    while rooms[-1] < max_steps:
        rooms.append(_MORE_ROOM * rooms[-1])
    return [*rooms[:-1], max_steps]


def kept_steps(state: State) -> int:
    """Of how many steps derivatives keep numbers at once."""
    size = 2 * sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state))
    return max(min(MOST_ROWS, _ROW_BYTES // max(size, 1)), _FEWEST_ROWS)


def checked_state(system: AbstractSystem, state: Any) -> State:
    cure = "jaxmb.assemble(system) makes one, and so does jaxmb.State(q, u) or, with internal states, State(q, u, z)"
    # A concrete class: a state is nothing but its fields.
    check_kind("state", state, State, "a jaxmb.State", cure)
    nq, nu, nz = system.nq, system.nu, system.nz
    if (state.z is None) != (nz == 0):
        has = f"has {nz} internal states" if nz else "has no internal states"
        raise ValueError(f"The system {has} and the state {'none' if state.z is None else 'some, in z'}; {cure}.")
    of_states = [] if state.z is None else [("z", state.z, nz)]
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
    dtype = default_float()
    if all(isinstance(x, jax.Array) and x.dtype == dtype for x in jax.tree.leaves(state)):
        return state
    return jax.tree.map(lambda x: jnp.asarray(x, dtype=dtype), state)


def checked_times(t0: Any, t1: Any, dt0: Any, dtype: Any) -> dict[str, Any]:
    start, end = real_array("t0", t0, dtype), real_array("t1", t1, dtype)
    for name, time in (("t0", start), ("t1", end)):
        if not is_traced(time) and not np.isfinite(time):
            raise ValueError(f"{name} must be finite, got {time}.")
    if dt0 is None:
        return {"t0": start, "t1": end, "dt0": None}
    step = real_array("dt0", dt0, dtype)
    if not is_traced((start, end, step)) and not (np.isfinite(step) and step * (1 if end >= start else -1) > 0):
        raise ValueError(
            f"dt0 must be a finite step from t0 = {t0} towards t1 = {t1}, got {dt0}; leave it out for the default."
        )
    return {"t0": start, "t1": end, "dt0": step}


def checked_longest_step(dtmax: Any, stepsize_controller: Any, solver: Any, dtype: Any) -> Any:
    """`dtmax`, or None."""
    if dtmax is None:
        return None
    if stepsize_controller is not None:
        raise ValueError(
            "dtmax bounds the steps that rtol and atol choose: give it to the stepsize_controller, or leave that out."
        )
    if isinstance(solver, AbstractMultistep) and solver.tolerances.fixed:
        raise ValueError(f"dtmax needs the tolerances of simulate: leave those of {type(solver).__name__} out.")
    longest = real_array("dtmax", dtmax, dtype)
    if not is_traced(longest) and not longest > 0:
        raise ValueError(f"dtmax must be positive, got {dtmax}; leave it out for steps of any length.")
    return longest
