"""The moving picture that `jaxmb run --show` writes and opens."""

import os
import sys
import webbrowser
from pathlib import Path

from ..system import AbstractSystem
from ..trajectory import Trajectory
from ..viz import save_html
from ..viz.stage import viser


def check_picture(system: AbstractSystem) -> None:
    """Raise an error, before anything is computed, where no picture can be made."""
    if not system.body_names:
        raise ValueError("--show draws bodies, and this mechanism has none; the figures show its coordinates.")
    try:
        viser()
    except ImportError as error:
        raise RuntimeError(str(error)) from error


def show_motion(out: Path, trajectory: Trajectory) -> None:
    """Write the picture to the folder, and open it where there is a screen."""
    path = save_html(trajectory, out / "motion.html").resolve()
    print(f"Wrote {path}")
    screen = sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if not (screen and webbrowser.open(path.as_uri())):
        print("There is no screen or no browser here; open the file in any browser.")
