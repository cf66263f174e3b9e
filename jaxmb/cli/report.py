"""`jaxmb report NAME`: error against run time, a stress test, unused features, and costs of formulations."""

import argparse
import json
from pathlib import Path
from typing import Any

from .. import report
from ..mechanisms import Mechanism
from .folders import check_folder, made_folder, write_figures
from .options import add_parameters, count
from .subject import mechanism_of

# Variants of a mechanism that a report without --set also covers.
_VARIANTS = {"tracked_vehicle": ({"units": 2},)}
# Words before the mechanism of a report, each for one report alone.
_WORDS = ("formulations", "work_precision", "stress_test", "left_out")


def add_to(commands: Any) -> None:
    """Add the command to a parser's commands."""
    command = commands.add_parser(
        "report",
        help="measure error against run time, stiff and extreme variants, unused features, or costs of formulations",
        epilog="Without --set, a report on tracked_vehicle also covers two coupled vehicles.",
    )
    command.add_argument(
        "mechanism",
        nargs="+",
        help="a name from `jaxmb mechanisms`, or your own scene as module:function or file.py:function, which returns "
        "a scene, a mechanism, or system, state and perhaps t1; before it, for one report alone, one of the words "
        + ", ".join(_WORDS),
    )
    command.add_argument("--tolerances", type=float, nargs="+", metavar="RTOL", help="default 1e-4 1e-6 1e-8 1e-10")
    command.add_argument("--repeats", type=count, default=5, help="timed runs of each solver (default %(default)d)")
    command.add_argument("--t1", type=float, help="end of the motion [s] (default that of the mechanism)")
    command.add_argument("--out", type=Path, help="folder for the table and the figure (default jaxmb-output/NAME)")
    command.set_defaults(command=_report, compile_anew=True)
    add_parameters(command)


def _report(arguments: argparse.Namespace) -> None:
    *words, arguments.mechanism = arguments.mechanism
    if words not in ([], *([word] for word in _WORDS)):
        raise ValueError(
            f"A report is of one mechanism, or of one of the words {', '.join(_WORDS)} and one; got "
            f"{' '.join(words)!r} before it."
        )
    if words == ["formulations"]:
        print(report.formulation_costs(mechanism_of(arguments), repeats=arguments.repeats))
        return
    check_folder(arguments)
    mechanism, out = mechanism_of(arguments), made_folder(arguments)
    if words:
        _report_alone(words[0], mechanism, arguments, out)
        return
    _measure(mechanism, arguments, out)
    if not arguments.set:
        for parameters in _VARIANTS.get(mechanism.name, ()):
            arguments.set = list(parameters.items())
            shown = ",".join(f"{name}={value}" for name, value in arguments.set)
            print(f"\nThe same with {shown}:\n")
            (out / shown).mkdir(exist_ok=True)
            _measure(mechanism_of(arguments), arguments, out / shown)


def _report_alone(name: str, mechanism: Mechanism, arguments: argparse.Namespace, out: Path) -> None:
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


def _measure(mechanism: Mechanism, arguments: argparse.Namespace, out: Path) -> None:
    precision = report.work_precision(mechanism, tolerances=arguments.tolerances, repeats=arguments.repeats)
    print(precision)
    (out / "work_precision.json").write_text(json.dumps(precision.to_dict(), indent=1))
    written = [out / "work_precision.json"]
    if mechanism.system.acceleration_rows:
        costs = report.method_costs(mechanism, repeats=arguments.repeats)
        print(f"\n{costs}")
        written.append(out / "method_costs.json")
        written[-1].write_text(json.dumps(costs.to_dict(), indent=1))
    print(f"\nWrote {', '.join(map(str, written))}")
    write_figures(out, precision, None)
