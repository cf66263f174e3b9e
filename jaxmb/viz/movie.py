"""Motions as files of moving pictures, drawn as by `plot_mechanism`."""

import io
import shutil
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._arguments import whole_number
from ..parts.shapes import AbstractShape
from ..system.picture import Picture
from ..trajectory import Trajectory, picture_of
from .mechanism import drawn, faded, finish, in_world
from .motion_nodes import check_shapes, chosen
from .silhouettes import area, edges
from .solids import COLORS, Placed, solids

# A motion takes at least and at most so many seconds, if no speed is given. A frame takes a multiple of `_TICK` s.
_SHORTEST, _LONGEST, _TICK = 2.0, 20.0, 0.01
# Pixels per inch; colours of a frame; the margin of a picture, relative to its size; most bodies with trails.
_DPI, _PALETTE, _MARGIN, _FEW = 80, 64, 0.05, 8


def save_movie(
    trajectory: Trajectory,
    path: str | Path,
    *,
    frames: int = 100,
    speed: float | None = None,
    trails: bool = True,
    shapes: Mapping[str, AbstractShape | Sequence[AbstractShape]] | None = None,
    deformation: float = 1.0,
) -> Path:
    """Write a motion as an animated GIF, which pages, slides and chats show, or as a film in MP4.

    ```python
    motion = jaxmb.simulate(system, state, t1=1.0, saveat=np.linspace(0.0, 1.0, 21))
    jaxmb.viz.save_movie(motion, "swing.gif")
    ```

    Only saved states are drawn, at their times: save the motion at 20 or more times a second, by `saveat=`.

    **Arguments:**

    - `trajectory`: a motion of a planar or spatial scene.
    - `path` of the file, `.gif` or `.mp4`.
    - `frames`: the largest number of saved times that are drawn.
    - `speed` of playing, 1 for real time; by default a motion plays in real time, but for 2 to 20 s.
    - `trails`: whether the mass centres of up to 8 bodies leave a trail; `shapes` and `deformation` as in
        `plot_mechanism`.

    **Returns:** the path.

    **Raises:** `ValueError` for another kind of file, a batch, a motion saved at fewer than two times, states that are
    not finite, unknown bodies, and a system without bodies; `RuntimeError` for a film without the program `ffmpeg`;
    `ImportError` without matplotlib.
    """
    path = Path(path)
    if path.suffix not in _WRITERS:
        raise ValueError(f"save_movie writes .gif and .mp4, got {path.name!r}.")
    if path.suffix == ".mp4" and shutil.which("ffmpeg") is None:
        raise RuntimeError("An .mp4 needs the program ffmpeg, which is not found; a .gif needs none.")
    frames = whole_number("frames", frames, 2)
    if speed is not None and not (np.isfinite(speed) and speed > 0):
        raise ValueError(f"speed must be a positive number, got {speed!r}.")
    if not trajectory.system.body_names:
        raise ValueError(f"A moving picture shows bodies, and a {type(trajectory.system).__name__} has none.")
    check_shapes(trajectory.system, shapes or {})
    motion = chosen(trajectory, frames)
    picture, times = picture_of(motion, deformation), np.asarray(motion.ts)
    lasts = float(times[-1] - times[0])
    lasts = float(np.clip(lasts, _SHORTEST, _LONGEST)) if speed is None else lasts / speed
    _WRITERS[path.suffix](
        path, _drawn(picture, solids(picture, shapes or {}, None), times, trails), lasts / (times.size - 1)
    )
    return path


def _write_gif(path, images, duration):
    # matplotlib brings Pillow.
    from PIL import Image

    pages = [Image.open(image).convert("P", palette=Image.Palette.ADAPTIVE, colors=_PALETTE) for image in images]
    ticks = max(2, round(duration / _TICK))
    options: dict[str, Any] = {"append_images": pages[1:], "duration": 1000 * _TICK * ticks, "loop": 0}
    pages[0].save(path, "GIF", save_all=True, optimize=True, **options)


def _write_mp4(path, images, duration):
    given = ["-f", "image2pipe", "-framerate", f"{1 / duration:.6g}", "-i", "-"]
    # Most players need an even number of pixels, and this format of colours.
    written = ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p", str(path)]
    data = b"".join(image.getvalue() for image in images)
    subprocess.run(["ffmpeg", "-y", "-loglevel", "error", *given, *written], input=data, check=True)


_WRITERS = {".gif": _write_gif, ".mp4": _write_mp4}


def _drawn(picture: Picture, shapes: list[Placed], times: np.ndarray, trails: bool) -> Iterator[io.BytesIO]:
    low, high = _bounds(picture, shapes, times.size)
    dimension = 2 if picture.planar else 3
    for k, t in enumerate(times):
        figure, axes = drawn(picture, shapes, [k])
        if trails and len(picture.bodies) <= _FEW:
            for color, name in zip(COLORS, picture.bodies, strict=False):
                trail = picture.positions[name][: k + 1, :dimension]
                axes.plot(*trail.T, color=faded(color, 1.0), linewidth=0.8, alpha=0.6, zorder=1)
        limits = dict(zip(("xlim", "ylim", "zlim")[:dimension], zip(low, high, strict=True), strict=False))
        axes.set(**limits)
        title = "  ·  ".join([f"t = {t - times[0]:.2f} s", *picture.notes])
        finish(figure, axes, picture, shapes, title, family="monospace")
        axes.set(**limits)
        file = io.BytesIO()
        figure.savefig(file, dpi=_DPI)
        file.seek(0)
        yield file


def _bounds(picture, shapes, count):
    """Least and greatest coordinates [m] of all frames, with a margin."""
    points = [line.points.reshape(-1, 3) for line in picture.paths.values()]
    for body, shape in shapes:
        if shape.primitive == "ground":
            continue
        own = area(shape) if picture.planar else np.concatenate([shape.position[None], *edges(shape)])
        points += [in_world(picture, body, own, k) for k in range(count)]
    joined = np.concatenate(points)[:, : 2 if picture.planar else 3]
    low, high = joined.min(axis=0), joined.max(axis=0)
    margin = _MARGIN * np.max(high - low)
    return low - margin, high + margin
