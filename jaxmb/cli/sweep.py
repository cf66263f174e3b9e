"""`jaxmb sweep file.py --out runs.zarr`."""

import argparse
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ..parts.names import unknown
from ..studies.sweep import sweep
from ..studies.sweep.outputs import OK
from .subject import module_from

_OPTIONS = ("dims", "coords", "units", "version")


def add_to(commands: Any) -> None:
    """Add the command to a parser's commands."""
    command = commands.add_parser(
        "sweep",
        help="compute your function for many cases",
        description="Compute your function for many cases, and write the results to a zarr store. The same command "
        "resumes an interrupted sweep.",
    )
    command.add_argument(
        "source",
        help="file.py, which defines `function` and `cases` as jaxmb.sweep takes them, and perhaps `dims`, `coords`, "
        "`units` and `version`; or file.py:function:cases with other names",
    )
    command.add_argument("--out", type=Path, required=True, help="folder of the store, such as runs.zarr")
    command.add_argument("--processes", type=int, default=1, help="processes on this machine (default %(default)d)")
    command.add_argument("--chunk", type=int, help="members computed together (default 512, or 128 for each core)")
    command.add_argument("--overwrite", action="store_true", help="replace a store that holds another sweep")
    command.set_defaults(command=_sweep)


def _sweep(arguments: argparse.Namespace) -> None:
    source, *names = arguments.source.split(":")
    if len(names) not in (0, 2):
        raise ValueError(f"The source must be file.py or file.py:function:cases, got {arguments.source!r}.")
    if not Path(source).is_file():
        raise ValueError(f"There is no file {source}.")
    module = module_from(source)
    function, cases = (_named(module, source, name) for name in (names or ("function", "cases")))
    found = sweep(
        function,
        cases,
        arguments.out,
        **{name: getattr(module, name) for name in _OPTIONS if hasattr(module, name)},
        chunk=arguments.chunk,
        processes=arguments.processes,
        overwrite=arguments.overwrite,
    )
    status = found["status"].to_numpy()
    print(f"Wrote {arguments.out}: {status.size} members, {int(np.sum(status != OK))} of them failed.")
    words = found["status"].attrs["flag_meanings"].split()
    for code in np.unique(status[status != OK]):
        print(f"  {int(np.sum(status == code))} {words[code]}: {found['message'].to_numpy()[status == code][0]}")


def _named(module: ModuleType, source: str, name: str) -> Any:
    if not hasattr(module, name):
        raise unknown(f"name in {source}", name, [known for known in vars(module) if not known.startswith("_")])
    return getattr(module, name)
