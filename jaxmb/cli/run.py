"""`jaxmb run NAME`: simulate a mechanism, compare it with its reference values, and fit one of its parameters."""

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..mechanisms import Mechanism
from ..report import work_precision
from ..report.work_precision import default_solvers
from ..simulate import simulate
from ..states.assembly import assemble
from ..studies.identify import identify
from ..system import parameters, with_parameters
from ..trajectory import Trajectory
from .folders import check_folder, check_picture, made_folder, show_motion, write_figures
from .subject import add_parameters, mechanism_of

# Settings of `run`: saved times, and the fit of a parameter to every other saved time of the first part of the motion,
# with noise, from a wrong start.
_TIMES = 401
_FIT_SHARE, _NOISE, _START = 0.2, 1e-3, 1.1
# The relative change of a parameter for its sensitivity.
_CHANGE = 1e-3


def add_to(commands: Any) -> None:
    """Add the command to a parser's commands."""
    command = commands.add_parser(
        "run", help="simulate a mechanism, compare it with its reference values, and fit one of its parameters"
    )
    command.add_argument("mechanism", help="a name from `jaxmb mechanisms`")
    command.add_argument("--rtol", type=float, default=1e-9, help="relative tolerance of a step (default %(default)g)")
    command.add_argument("--t1", type=float, help="end of the motion [s] (default from the mechanism)")
    tolerances = "tolerances at which error is measured against run time (default 1e-5 1e-7 1e-9)"
    command.add_argument(
        "--tolerances", type=float, nargs="+", metavar="RTOL", default=(1e-5, 1e-7, 1e-9), help=tolerances
    )
    command.add_argument("--out", type=Path, help="folder for the motion and the figures (default jaxmb-output/NAME)")
    command.add_argument("--show", action="store_true", help="write a moving picture as well, and open it in a browser")
    command.set_defaults(command=_run)
    add_parameters(command)


def _run(arguments: argparse.Namespace) -> None:
    check_folder(arguments)
    mechanism = mechanism_of(arguments)
    if arguments.show:
        check_picture(mechanism.system)
    print(f"{mechanism.name}: {mechanism.description}\n\n{mechanism.system}\n")

    trajectory, seconds = _simulate(mechanism, arguments.rtol)
    stats = {name: int(trajectory.stats[name]) for name in ("num_steps", "num_rejected_steps", "num_evaluations")}
    print(
        f"Motion over {mechanism.t1:g} s at rtol {arguments.rtol:g}: {stats['num_steps']} steps "
        f"({stats['num_rejected_steps']} rejected), {stats['num_evaluations']} evaluations, "
        f"{seconds:.1f} s with compiling; {_residuals(trajectory)}."
    )
    _compare(mechanism, trajectory)

    print("\nError against run time:")
    chosen = {name: solver for name, solver in default_solvers().items() if name != "Tsit5"}
    precision = work_precision(mechanism, solvers=chosen, tolerances=arguments.tolerances)
    print(precision)

    _fit(mechanism, trajectory)

    out = made_folder(arguments)
    trajectory.save(out / "motion.npz")
    print(f"\nWrote {out / 'motion.npz'}")
    write_figures(out, precision, trajectory)
    if arguments.show:
        show_motion(out, trajectory)


def _simulate(mechanism: Mechanism, rtol: float) -> tuple[Trajectory, float]:
    ts = np.linspace(0.0, mechanism.t1, _TIMES)
    if mechanism.references is not None:
        times = mechanism.references.times
        apart = np.min(np.abs(ts[:, None] - times[None, :]), axis=1) > 1e-9 * mechanism.t1
        ts = np.sort(np.concatenate([ts[apart], times[times <= mechanism.t1]]))
    meter = diffrax.TqdmProgressMeter() if sys.stderr.isatty() else diffrax.NoProgressMeter()
    begin = time.perf_counter()
    trajectory = simulate(mechanism.system, mechanism.state, t1=ts[-1], rtol=rtol, saveat=ts, progress_meter=meter)
    jax.block_until_ready(trajectory.ys)
    return trajectory, time.perf_counter() - begin


def _residuals(trajectory: Trajectory) -> str:
    if not trajectory.system.velocity_rows:
        return "no constraints"
    position, velocity = (float(values.max()) for values in trajectory.constraint_violation)
    return f"largest constraint residuals {position:.1e} of positions, {velocity:.1e} 1/s of velocities"


def _compare(mechanism: Mechanism, trajectory: Trajectory) -> None:
    references = mechanism.references
    if references is None:
        print("There are no reference values for this motion.")
        return
    print(f"Relative error at {references.times[-1]:g} s against reference values:")
    print(f"  {references.source}; good to {references.tolerance:.0e}")
    errors = mechanism.errors(trajectory)
    width = max(map(len, errors))
    for k, (label, error) in enumerate(errors.items()):
        print(f"  {label:{width}}  {references.values[-1, k]:20.12g}  {error[-1]:.1e}")


def _fit(mechanism: Mechanism, trajectory: Trajectory) -> None:
    """Estimate the parameter to which the motion is most sensitive, from a noisy sample of the motion."""
    system = mechanism.system
    saved = np.asarray(trajectory.ts)
    indices = np.flatnonzero((saved > 0) & (saved <= _FIT_SHARE * mechanism.t1))[1::2]
    ts = saved[indices]
    name = _most_sensitive(mechanism, ts)
    if name is None:
        print("\nNo single number among the parameters has an effect on the motion; there is nothing to identify.")
        return
    random = np.random.default_rng(0)
    measured, sigma = {}, {}
    for place in system.catalogue.position_quantities():
        exact = np.asarray(trajectory.quantity(place))[indices]
        noise = _NOISE * np.ptp(exact)
        if noise > 0:
            measured[place] = exact + noise * random.standard_normal(exact.shape)
            sigma[place] = noise
    true = float(parameters(system)[name])
    what = "positions" if system.body_names else "coordinates"
    print(
        f"\nIdentifying {name} from {what} at {ts.size} times up to {ts[-1]:g} s, "
        f"with noise of {_NOISE:.1%} of their range, from a start {_START - 1:.0%} off:"
    )
    start = {name: _START * true}
    fit = identify(
        system,
        measured,
        ts=ts,
        free=start,
        state=mechanism.state,
        fix=mechanism.fix,
        rates=mechanism.rates,
        sigma=sigma,
    )
    print(f"{fit}\ntrue value {true:.6g}")


def _most_sensitive(mechanism: Mechanism, ts) -> str | None:
    """The scalar parameter whose relative change moves positions or coordinates most; None without any effect."""
    scalars = {name: v for name, v in parameters(mechanism.system).items() if v.ndim == 0 and float(v) != 0.0}
    if not scalars:
        return None

    @eqx.filter_jit
    def positions(system, state, factors):
        values = {name: value * factor for (name, value), factor in zip(scalars.items(), factors, strict=True)}
        changed = with_parameters(system, values)
        start = assemble(changed, state, fix=mechanism.fix, rates=mechanism.rates, throw=False)
        motion = simulate(changed, start, t1=ts[-1], saveat=ts, rtol=1e-8, throw=False)
        return jnp.concatenate([motion.quantity(name).reshape(-1) for name in system.catalogue.position_quantities()])

    # Differences suffice for a choice, and compile in a third of the time of derivatives.
    factors = 1 + _CHANGE * np.eye(len(scalars) + 1, len(scalars), -1)
    of_all = jax.vmap(positions, in_axes=(None, None, 0))
    first, *others = np.asarray(of_all(mechanism.system, mechanism.state, factors))
    changes = np.linalg.norm(np.stack(others) - first, axis=1) / _CHANGE
    size = float(mechanism.system.length)
    return list(scalars)[int(np.nanargmax(changes))] if np.nanmax(changes, initial=0.0) > 1e-4 * size else None
