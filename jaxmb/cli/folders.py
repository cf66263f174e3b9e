"""The output folder of a command, with figures and the moving picture of `jaxmb run --show`."""

import argparse
import os
import sys
import webbrowser
from pathlib import Path

from ..report import Table
from ..system import AbstractSystem
from ..trajectory import Trajectory
from ..viz import plot_mechanism, plot_motion, save_html
from ..viz.stage import viser


def output_folder(arguments: argparse.Namespace) -> Path:
    """The requested folder, or the default."""
    return Path("jaxmb-output") / arguments.mechanism.split(":")[-1] if arguments.out is None else arguments.out


def check_folder(arguments: argparse.Namespace) -> None:
    """Raise a `ValueError` for a folder that is not writable, before anything is computed."""
    out = output_folder(arguments)
    existing = next(path for path in (out, *out.absolute().parents) if path.exists())
    if not existing.is_dir():
        raise ValueError(f"--out {out}: {existing} is a file and not a folder; give another folder.")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise ValueError(f"--out {out}: {existing} is not writable; give another folder.")


def made_folder(arguments: argparse.Namespace) -> Path:
    """The folder, created if necessary."""
    out = output_folder(arguments)
    out.mkdir(parents=True, exist_ok=True)
    return out


def write_figures(out: Path, precision: Table, trajectory: Trajectory) -> None:
    """Write the figures of a report and of a motion; without Matplotlib print a message."""
    try:
        precision.figure(out / "work_precision.png")
        written = [out / "work_precision.png"]
        figures = {"motion.png": plot_motion(trajectory)}
        if trajectory.system.body_names:
            figures["mechanism.png"] = plot_mechanism(trajectory)
        for name, figure in figures.items():
            figure.savefig(out / name, dpi=150)
            written.append(out / name)
    except ImportError as error:
        print(error)
        return
    print("Wrote " + ", ".join(map(str, written)))


def check_picture(system: AbstractSystem) -> None:
    """Raise an error if no picture can be made, before anything is computed."""
    if not system.body_names:
        raise ValueError("--show draws bodies, and this mechanism has none; the figures show its coordinates.")
    try:
        viser()
    except ImportError as error:
        raise RuntimeError(str(error)) from error


def show_motion(out: Path, trajectory: Trajectory) -> None:
    """Write the picture to the folder, and open it if there is a screen."""
    path = save_html(trajectory, out / "motion.html").resolve()
    print(f"Wrote {path}")
    screen = sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if not (screen and webbrowser.open(path.as_uri())):
        print("There is no screen or browser here; open the file in any browser.")
