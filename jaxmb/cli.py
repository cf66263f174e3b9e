"""The command line: `jaxmb mechanisms | run | report | sweep`."""

import argparse
import ast
import dataclasses
import importlib
import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .mechanisms import Mechanism
    from .trajectory import Trajectory

# What `run` does: saved times, tolerances of the table, and the fit of one parameter to every other saved time of the
# first part of the motion, with noise, from a start that is off.
_TIMES = 401
_TOLERANCES = (1e-5, 1e-7, 1e-9)
_FIT_SHARE, _NOISE, _START = 0.2, 1e-3, 1.1

# Variants of a mechanism that a report without --set also covers.
_REPORT_VARIANTS = {"tracked_vehicle": ({"units": 2},)}
# Words before the mechanism of a report, each for one report alone.
_REPORTS = ("formulations", "work_precision", "stability", "left_out")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    **Arguments:** `argv`: the words after `jaxmb`, default those of the process.

    **Returns:** the exit code: 0; with a message on stderr 1 if a simulation failed or a file could not be written, 2
    for a name or value that does not fit, and 130 after Ctrl-C.
    """
    arguments = _parser().parse_args(argv)
    import jax

    jax.config.update("jax_enable_x64", True)
    try:
        arguments.command(arguments)
    except (ValueError, RuntimeError, OSError) as error:
        print(f"jaxmb: {error}", file=sys.stderr)
        return 2 if isinstance(error, ValueError) else 1
    except KeyboardInterrupt:
        print("jaxmb: interrupted", file=sys.stderr)
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxmb", description="Accurate, differentiable dynamics of constrained mechanical systems."
    )
    commands = parser.add_subparsers(required=True, metavar="command")

    listing = commands.add_parser("mechanisms", help="list the mechanisms of the library")
    listing.set_defaults(command=_mechanisms)

    run = commands.add_parser(
        "run", help="simulate a mechanism, compare it with its reference values, and fit one of its parameters"
    )
    run.add_argument("mechanism", help="a name from `jaxmb mechanisms`")
    run.add_argument("--rtol", type=float, default=1e-9, help="relative tolerance of a step (default %(default)g)")
    run.add_argument("--t1", type=float, help="end of the motion [s] (default that of the mechanism)")
    run.add_argument("--out", type=Path, help="folder for the motion and the figures (default jaxmb-output/NAME)")
    run.set_defaults(command=_run)
    _add_parameters(run)

    report = commands.add_parser(
        "report",
        help="measure error against run time, stability, what a scene leaves out, or what formulations cost",
        epilog="Without --set, a report on tracked_vehicle also covers two coupled vehicles.",
    )
    report.add_argument(
        "mechanism",
        nargs="+",
        help="a name from `jaxmb mechanisms`, or your own scene as module:function or file.py:function, which returns "
        "a scene, a mechanism, or system, state and perhaps t1; before it, for one report alone, one of the words "
        + ", ".join(_REPORTS),
    )
    report.add_argument("--tolerances", type=float, nargs="+", metavar="RTOL", help="default 1e-4 1e-6 1e-8 1e-10")
    report.add_argument("--repeats", type=_count, default=5, help="timed runs of each solver (default %(default)d)")
    report.add_argument("--t1", type=float, help="end of the motion [s] (default that of the mechanism)")
    report.add_argument("--out", type=Path, help="folder for the table and the figure (default jaxmb-output/NAME)")
    report.set_defaults(command=_report)
    _add_parameters(report)

    from .studies.sweep import command

    command.add_to(commands)
    return parser


def _add_parameters(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--set",
        action="append",
        default=[],
        type=_assignment,
        metavar="NAME=VALUE",
        help="a keyword argument of the mechanism, such as units=2; may be given more than once",
    )


def _count(text: str) -> int:
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"expected a number of at least 1, got {text!r}")
    return int(text)


def _assignment(text: str) -> tuple[str, object]:
    name, equals, value = text.partition("=")
    if not equals or not name.isidentifier():
        raise argparse.ArgumentTypeError(f"expected NAME=VALUE, got {text!r}")
    try:
        return name, ast.literal_eval(value)
    except (SyntaxError, ValueError):
        # A word, such as the name of a variant.
        return name, value


def _mechanisms(arguments: argparse.Namespace) -> None:
    del arguments
    from . import mechanisms

    width = max(map(len, mechanisms.names()))
    for name in mechanisms.names():
        summary = " ".join((getattr(mechanisms, name).__doc__ or "").split("\n\n")[0].split())
        print(f"{name:{width}}  {summary}")


def _run(arguments: argparse.Namespace) -> None:
    from .report import work_precision
    from .report.work_precision import default_solvers

    _check_out(arguments)
    mechanism = _mechanism(arguments)
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
    precision = work_precision(mechanism, solvers=chosen, tolerances=_TOLERANCES)
    print(precision)

    _fit(mechanism, trajectory)

    out = _folder(arguments)
    trajectory.save(out / "motion.npz")
    print(f"\nWrote {out / 'motion.npz'}")
    _write_figures(out, precision, trajectory)


def _report(arguments: argparse.Namespace) -> None:
    from .report import formulation_costs

    *words, arguments.mechanism = arguments.mechanism
    if words not in ([], *([word] for word in _REPORTS)):
        raise ValueError(
            f"A report is of one mechanism, or of one of the words {', '.join(_REPORTS)} and one; got "
            f"{' '.join(words)!r} before it."
        )
    if words == ["formulations"]:
        print(formulation_costs(_mechanism(arguments), repeats=arguments.repeats))
        return
    _check_out(arguments)
    mechanism, out = _mechanism(arguments), _folder(arguments)
    if words:
        _report_alone(words[0], mechanism, arguments, out)
        return
    _measure(mechanism, arguments, out)
    if not arguments.set:
        for parameters in _REPORT_VARIANTS.get(mechanism.name, ()):
            arguments.set = list(parameters.items())
            shown = ",".join(f"{name}={value}" for name, value in arguments.set)
            print(f"\nThe same with {shown}:\n")
            (out / shown).mkdir(exist_ok=True)
            _measure(_mechanism(arguments), arguments, out / shown)


def _report_alone(name: str, mechanism: "Mechanism", arguments: argparse.Namespace, out: Path) -> None:
    from . import report

    options = {
        "work_precision": {"tolerances": arguments.tolerances, "repeats": arguments.repeats},
        "left_out": {"repeats": arguments.repeats},
    }
    made = getattr(report, name)(mechanism, **options.get(name, {}))
    print(made)
    (out / f"{name}.json").write_text(json.dumps(made.to_dict(), indent=1))
    print(f"\nWrote {out / name}.json")
    try:
        made.figure(out / f"{name}.png")
        print(f"Wrote {out / name}.png")
    except ImportError as error:
        print(error)


def _measure(mechanism: "Mechanism", arguments: argparse.Namespace, out: Path) -> None:
    from .report import method_costs, work_precision

    precision = work_precision(mechanism, tolerances=arguments.tolerances, repeats=arguments.repeats)
    print(precision)
    (out / "work_precision.json").write_text(json.dumps(precision.to_dict(), indent=1))
    written = [out / "work_precision.json"]
    if mechanism.system.acceleration_rows:
        costs = method_costs(mechanism, repeats=arguments.repeats)
        print(f"\n{costs}")
        written.append(out / "method_costs.json")
        written[-1].write_text(json.dumps(costs.to_dict(), indent=1))
    print(f"\nWrote {', '.join(map(str, written))}")
    _write_figures(out, precision, None)


def _mechanism(arguments: argparse.Namespace) -> "Mechanism":
    """The mechanism, ending at `--t1` with the reference values up to there."""
    from . import mechanisms

    parameters = dict(arguments.set)
    own = _function(arguments.mechanism) if ":" in arguments.mechanism else None
    try:
        mechanism = mechanisms.get(arguments.mechanism, **parameters) if own is None else _made(own, arguments)
    except Exception as error:
        if not parameters:
            raise
        # A value of the wrong type may fail anywhere in the mechanism.
        given = ", ".join(f"{name}={value!r}" for name, value in parameters.items())
        reason = str(error).split("\n")[0]
        raise ValueError(f"{arguments.mechanism} cannot be built with --set {given}: {reason}") from error
    if arguments.t1 is None:
        return mechanism
    if not 0 < arguments.t1 < float("inf"):
        raise ValueError(f"--t1 must be positive and finite, got {arguments.t1:g}.")
    return mechanism.until(arguments.t1)


def _function(where: str):
    """A function from `module:function` or `file.py:function`."""
    from .studies.sweep.command import module_from

    source, _, name = where.rpartition(":")
    try:
        if source.endswith(".py"):
            module = module_from(source)
        else:
            sys.path.insert(0, "")
            module = importlib.import_module(source)
        return getattr(module, name)
    except (ImportError, FileNotFoundError, AttributeError) as error:
        raise ValueError(f"{where}: {error}; give module:function or file.py:function.") from error


def _made(function, arguments: argparse.Namespace) -> "Mechanism":
    """The motion of a user's function: a scene, a mechanism, or system, state and perhaps t1."""
    from .report.subject import subject
    from .states.assembly import assemble

    given, *rest = made if isinstance(made := function(**dict(arguments.set)), tuple) else (made,)
    system = given.compile() if hasattr(given, "compile") else given
    if hasattr(system, "references"):
        return system
    state = rest[0] if rest else assemble(system)
    t1 = arguments.t1 if arguments.t1 is not None else rest[1] if len(rest) > 1 else None
    if t1 is None:
        raise ValueError(f"{arguments.mechanism} gives no end of the motion; add --t1 [s].")
    return dataclasses.replace(subject(system, state, t1), name=function.__name__)


def _simulate(mechanism: "Mechanism", rtol: float) -> "tuple[Trajectory, float]":
    import diffrax
    import jax
    import numpy as np

    from .simulate import simulate

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


def _residuals(trajectory: "Trajectory") -> str:
    if not trajectory.system.velocity_rows:
        return "no constraints"
    position, velocity = (float(values.max()) for values in trajectory.constraint_violation)
    return f"largest constraint residuals {position:.1e} of positions, {velocity:.1e} 1/s of velocities"


def _compare(mechanism: "Mechanism", trajectory: "Trajectory") -> None:
    known = mechanism.references
    if known is None:
        print("There are no reference values for this motion.")
        return
    print(f"Relative error at {known.times[-1]:g} s against reference values:")
    print(f"  {known.source}; good to {known.tolerance:.0e}")
    errors = mechanism.errors(trajectory)
    width = max(map(len, errors))
    for k, (label, error) in enumerate(errors.items()):
        print(f"  {label:{width}}  {known.values[-1, k]:20.12g}  {error[-1]:.1e}")


def _fit(mechanism: "Mechanism", trajectory: "Trajectory") -> None:
    """Estimate the parameter to which the motion is most sensitive from a noisy sample of it."""
    import numpy as np

    from .studies.identify import identify
    from .system import parameters

    system = mechanism.system
    saved = np.asarray(trajectory.ts)
    own = np.flatnonzero((saved > 0) & (saved <= _FIT_SHARE * mechanism.t1))[1::2]
    ts = saved[own]
    name = _most_sensitive(mechanism, ts)
    if name is None:
        print("\nNo single number among the parameters has an effect on the motion; there is nothing to identify.")
        return
    random = np.random.default_rng(0)
    measured, sigma = {}, {}
    for place in system.position_quantities():
        exact = np.asarray(trajectory.quantity(place))[own]
        noise = _NOISE * np.ptp(exact)
        if noise > 0:
            measured[place] = exact + noise * random.standard_normal(exact.shape)
            sigma[place] = noise
    true = float(parameters(system)[name])
    what = "positions" if system.has_bodies else "coordinates"
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


def _most_sensitive(mechanism: "Mechanism", ts) -> str | None:
    """The scalar parameter, in relative terms, that moves positions or coordinates most; None if none does."""
    import diffrax
    import equinox as eqx
    import jax
    import jax.numpy as jnp
    import numpy as np

    from .simulate import simulate
    from .states.assembly import assemble
    from .system import parameters, with_parameters

    known = {name: v for name, v in parameters(mechanism.system).items() if v.ndim == 0 and float(v) != 0.0}
    if not known:
        return None

    @eqx.filter_jit
    def sensitivities(system, state):
        def positions(scale):
            values = {name: value * factor for (name, value), factor in zip(known.items(), scale, strict=True)}
            changed = with_parameters(system, values)
            start = assemble(changed, state, fix=mechanism.fix, rates=mechanism.rates, throw=False)
            adjoint = diffrax.ForwardMode()
            motion = simulate(changed, start, t1=ts[-1], saveat=ts, rtol=1e-6, adjoint=adjoint, throw=False)
            return jnp.concatenate([motion.quantity(name).reshape(-1) for name in system.position_quantities()])

        return jax.jacfwd(positions)(jnp.ones(len(known)))

    moved = np.linalg.norm(sensitivities(mechanism.system, mechanism.state), axis=0)
    size = float(mechanism.system.length)
    return list(known)[int(np.argmax(moved))] if np.max(moved) > 1e-6 * size else None


def _out(arguments: argparse.Namespace) -> Path:
    return Path("jaxmb-output") / arguments.mechanism.split(":")[-1] if arguments.out is None else arguments.out


def _check_out(arguments: argparse.Namespace) -> None:
    """Raise a `ValueError`, before anything is computed, for a folder that cannot be written to."""
    out = _out(arguments)
    existing = next(path for path in (out, *out.absolute().parents) if path.exists())
    if not existing.is_dir():
        raise ValueError(f"--out {out}: {existing} is a file and not a folder; give another folder.")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise ValueError(f"--out {out}: {existing} is not writable; give another folder.")


def _folder(arguments: argparse.Namespace) -> Path:
    out = _out(arguments)
    out.mkdir(parents=True, exist_ok=True)
    return out


def _write_figures(out: Path, precision, trajectory: "Trajectory | None") -> None:
    from .viz import plot_mechanism, plot_motion

    try:
        precision.figure(out / "work_precision.png")
        written = [out / "work_precision.png"]
        if trajectory is not None:
            figures = {"motion.png": plot_motion(trajectory)}
            if trajectory.system.has_bodies:
                figures["mechanism.png"] = plot_mechanism(trajectory)
            for name, figure in figures.items():
                figure.savefig(out / name, dpi=150)
                written.append(out / name)
    except ImportError as error:
        print(error)
        return
    print("Wrote " + ", ".join(map(str, written)))
