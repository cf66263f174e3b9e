"""`jaxmb run NAME`: simulate a mechanism, draw it, and compare it with its reference values."""

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import diffrax
import jax
import numpy as np

from ..mechanisms import Mechanism
from ..simulate import simulate
from ..trajectory import Trajectory
from .folders import check_folder, check_picture, made_folder, show_motion, write_figures
from .subject import add_parameters, mechanism_of

# Saved times.
_TIMES = 401


def add_to(commands: Any) -> None:
    """Add the command to a parser's commands."""
    command = commands.add_parser("run", help="simulate a mechanism, draw it, and compare it with its reference values")
    command.add_argument("mechanism", help="a name from `jaxmb mechanisms`")
    command.add_argument("--rtol", type=float, default=1e-9, help="relative tolerance of a step (default %(default)g)")
    command.add_argument("--t1", type=float, help="end of the motion [s] (default from the mechanism)")
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

    out = made_folder(arguments)
    trajectory.save(out / "motion.npz")
    print(f"\nWrote {out / 'motion.npz'}, which jaxmb.load reads")
    write_figures(out, trajectory)
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
