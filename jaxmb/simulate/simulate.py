"""From a system and a state to a motion."""

import contextlib
import functools
from collections.abc import Mapping
from typing import Literal

import diffrax
from jaxtyping import ArrayLike

from .._types import Scalar, State, VectorLike
from ..formulations import AbstractFormulation
from ..linalg.jitted import computed_at_once
from ..manifold import AbstractManifold
from ..parts.names import names_arguments
from ..system import AbstractSystem
from ..system.inputs import Signals
from ..trajectory import Trajectory
from .arguments import DEFAULT_RTOL
from .run import Asked, Run

# Arguments of other versions.
_GONE = {"adjoint": "every mode differentiates the steps of the run; jaxmb.solvers.integrate does so for other terms"}


@functools.partial(names_arguments, gone=_GONE)
def simulate(
    system: AbstractSystem,
    state: State,
    *,
    t1: Scalar,
    t0: Scalar = 0.0,
    dt0: Scalar | None = None,
    saveat: diffrax.SaveAt | ArrayLike | None = None,
    solver: diffrax.AbstractSolver | Literal["auto", "switch"] | None = None,
    formulation: AbstractFormulation | None = None,
    manifold: AbstractManifold | None = None,
    rtol: Scalar = DEFAULT_RTOL,
    atol: ArrayLike | None = None,
    dtmax: Scalar | None = None,
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    inputs: Signals | None = None,
    jumps: ArrayLike | None = None,
    event: diffrax.Event | None = None,
    direction: Mapping[str, VectorLike] | None = None,
    error: bool = False,
    max_steps: int = 65536,
    max_events: int = 1024,
    throw: bool | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
) -> Trajectory:
    """Integrate the motion of a system.

    ```python
    state = jaxmb.assemble(system, fix={"bar.angle": 0.5})
    motion = jaxmb.simulate(system, state, t1=1.0, saveat=np.linspace(0.0, 1.0, 11))
    motion["bar"].angle, motion.energy, motion.reactions["pin"].force
    ```

    The first call for a system compiles a program, which takes seconds. Later calls with other numbers, times and
    tolerances reuse it. `jax.jit` is not needed: it compiles the motion again, as a part of its function.

    `jaxmb help` has more on `tolerances`, `derivatives`, `contacts`, `inputs`, `throw` (motions that fail) and
    `large-scenes`.

    **Main arguments:**

    - `system`, `state`: a compiled scene and a consistent state of it, from `assemble`.
    - `t0`, `t1`: the interval [s]; `t1 < t0` runs backwards.
    - `saveat`: times to save at [s], or a `diffrax.SaveAt`; default only `t1`. `SaveAt(dense=True)` allows
        `Trajectory.at(t)`. A function, `SaveAt(ts=times, fn=function)`, sees states on the constraints.
    - `rtol`, `atol`: tolerances of the errors of steps. The error of the result, relative to the largest coordinates
        and velocities, is mostly below `rtol`. `atol` is a number or a vector (nq + nu + nz,) in SI units; its default
        follows the motion.
    - `inputs`: parameters as functions of time [s], by name: `{"motor.torque": jaxmb.Series(ts, torques)}`, or a
        function; see `with_inputs`.

    **Other arguments, rarely needed:**

    - `solver`: default `Adams()`; for stiff motions `Hermite()`; any diffrax Runge–Kutta solver. `"auto"` is `Adams`
        with a warning for stiff motions; `"switch"` simulates stiff motions again with `Hermite`, not under a trace.
    - `formulation`: how accelerations are solved for, `Partitioned()`, `Multipliers()`, `NullSpace()`, …; default by
        the scene.
    - `manifold`: how the state stays on the constraints, `Partition()`, `Projection()` or others; default by the scene.
    - `dt0`: first step [s], default chosen from the motion. `dtmax`: longest step [s], default none.
    - `stepsize_controller`: instead of `rtol` and `atol`; a `MultistepController` for `Adams` and `Hermite`.
    - `direction`: changes of parameters by name; in a differentiated run, steps resolve the effect of these changes.
        Default: all parameters with derivatives. `{}` leaves the steps of the motion alone.
    - `error`: whether to estimate the global error of the result, `Trajectory.error`, by a second run.
    - `jumps`: times [s] at which drivers or forces have kinks or jumps, a vector; the solver restarts there.
    - `event`: as in `diffrax.diffeqsolve`. Its function sees the time [s], also in a run backwards, and interpolated
        states between the ends of steps, off the constraints by about `rtol`.
    - `progress_meter`: as in `diffrax.diffeqsolve`, such as `diffrax.TqdmProgressMeter()`.
    - `max_steps`: the largest number of steps. `max_events`: the largest number of impacts and other events of
        contacts.
    - `throw`: whether a motion that fails is an error. By default it is, but under `jit`, `vmap` or a derivative the
        motion is NaN instead.

    **Returns:** a `Trajectory`, which can be `continued`. With `throw=False` it has the part of the motion before a
    failure, and `result` says why it failed; under a trace it is NaN. Ctrl-C ends a long run: the `KeyboardInterrupt`
    has the motion so far, `motion`.

    **Raises:** `ValueError` for arguments of the wrong type or out of range, and for combinations that cannot work.
    Also for a state that violates the constraints, unless the manifold lets states drift. `RuntimeError` if the
    integration fails, unless `throw=False`.
    """
    asked = Asked(
        system,
        state,
        t1=t1,
        t0=t0,
        dt0=dt0,
        saveat=saveat,
        solver=solver,
        formulation=formulation,
        manifold=manifold,
        rtol=rtol,
        atol=atol,
        dtmax=dtmax,
        stepsize_controller=stepsize_controller,
        inputs=inputs,
        jumps=jumps,
        event=event,
        direction=direction,
        error=error,
        max_steps=max_steps,
        max_events=max_events,
        throw=throw,
        progress_meter=progress_meter,
    )
    run = Run.checked(asked)
    with contextlib.nullcontext() if run.problem.traced else computed_at_once():
        return run.finished(run.solved())
