"""Moving pictures of motions, as pages that need no network."""

import dataclasses
import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._arguments import whole_number
from .._types import State
from ..parts.names import names_arguments
from ..parts.shapes import AbstractShape
from ..system import AbstractSystem
from ..trajectory import Trajectory
from . import scenery
from .motion_nodes import Motion, check_shapes, chosen, motion
from .one_motion import as_motion
from .solids import COLORS
from .stage import SceneNode, page

Shown = Trajectory | State
Motions = Shown | Sequence[Shown] | Mapping[str, Shown]
Shapes = Mapping[str, AbstractShape | Sequence[AbstractShape]]

# Shortest and longest motion [s] that is shown in real time.
_SHORTEST, _LONGEST = 2.0, 60.0
# The playing time [s] for which an event's name is shown, and the largest number of simultaneous names.
_SEEN, _AT_ONCE = 0.5, 3


@dataclasses.dataclass(frozen=True)
class MovingPicture:
    """A moving picture, which notebooks show.

    **Fields:** `html`: a page that needs no network; `height` [pixels] in a notebook; `frames`: the number of times
    shown.
    """

    html: str = dataclasses.field(repr=False)
    height: int
    frames: int

    def save(self, path: str | Path) -> Path:
        """Write the page to a file, which any browser opens."""
        path = Path(path)
        path.write_text(self.html, encoding="utf-8")
        return path

    def _repr_html_(self) -> str:
        # A frame within the output, which an exported or sent notebook keeps, unlike separate files.
        style = f"width: 100%; height: {self.height}px; border: 1px solid #ddd"
        return f'<iframe srcdoc="{html.escape(self.html)}" style="{style}"></iframe>'


@names_arguments
def show(
    trajectory: Motions,
    *,
    points: str | Sequence[str] = (),
    reactions: str | Sequence[str] = (),
    forces: str | Sequence[str] = (),
    shapes: Shapes | None = None,
    frames: int = 400,
    speed: float | None = None,
    overlay: bool = False,
    height: int = 480,
    deformation: float = 1.0,
    system: AbstractSystem | None = None,
) -> MovingPicture:
    """Make a moving picture of one or several motions, for a notebook or saved as a page.

    ```python
    picture = jaxmb.viz.show(motion, points="bar", reactions="pin")  # In a notebook it is seen.
    ```

    The picture has a time slider, a button that plays and pauses, a choice of speeds, and a list of the objects; the
    mouse turns, shifts and zooms it. Only the saved states are shown, at their times: save the motion at 30 or more
    times a second, by `saveat=`.

    Bodies are drawn in the shapes of their parts, such as wheels, or as bars from the mass centre to the points where
    parts act. Without such points a body is the cuboid with its inertia. Springs, rods and tracks are drawn between
    their points, terrain and planes as far as the motion reaches. Shapes have no effect on the motion.

    **Arguments:**

    - `trajectory`: a motion of a scene; a list of motions, or a dictionary by name, such as motions before and after a
        change, or members of a sweep.
    - `points`: the names of bodies (mass centres), frames or joints that leave a trail, or a single name.
    - `reactions`, `forces`: names of joints and of force elements whose forces are drawn as arrows, all to one scale.
        Arrows act on the last body of a joint, and on each body of a force element.
    - `shapes`: by name of a body, or `"ground"`, one or several shapes from `jaxmb.shapes` instead of the default and
        of blocks of joints, each placed in the frame of the body.
    - `frames`: the largest number of saved times that are shown.
    - `speed` of playing, 1 for real time. By default motions play in real time, but for at least 2 s and at most a
        minute. The slider shows the playing time, the picture the time of the motion.
    - `overlay`: show several motions in one place, each in a colour, instead of side by side.
    - `height` [pixels], in a notebook; `deformation` as in `plot_mechanism`.
    - `system`: of states, which are shown in place of motions: `show(state, system=system)`.

    **Returns:** a `MovingPicture`, of about 0.8 MB and more for long motions of many bodies.

    **Raises:** `ValueError` for unknown names, batches, motions saved at fewer than two times, states that are not
    finite, and systems without bodies; `ImportError` without viser, which `jaxmb[view]` installs.
    """
    frames = whole_number("frames", frames, 2)
    for value, name in ((height, "height"), (1.0 if speed is None else speed, "speed")):
        if not (isinstance(value, int | float | np.number) and np.isfinite(value) and value > 0):
            raise ValueError(f"{name} must be a positive number, got {value!r}.")
    points, reactions, forces = (_listed(names) for names in (points, reactions, forces))
    shapes = shapes or {}
    named, least = _named(trajectory), 1 if system is not None else 2
    named = {name: as_motion(single, system) for name, single in named.items()}
    for single in named.values():
        check_shapes(single.system, shapes)
    motions = [
        motion(name, chosen(single, frames, least), shapes, COLORS[k % len(COLORS)] if overlay else None, deformation)
        for k, (name, single) in enumerate(named.items())
    ]
    forces_of = [_arrows(single, reactions, forces) for single in motions]
    view = scenery.View.of(motions, overlay)
    strength = _strength(forces_of)
    # The side of a square of the grid is then a round force [N].
    square = scenery.round_number(4 * strength * view.cell / view.size) if strength > 0 else 0.0
    scale = view.cell / square if square else 0.0
    first, last = min(single.times[0] for single in motions), max(single.times[-1] for single in motions)
    # A state has no duration.
    speed = speed or float((last - first) / np.clip(last - first, _SHORTEST, _LONGEST)) or 1.0
    played: list[tuple[np.ndarray, Sequence[SceneNode]]] = []
    for single, offset, arrows in zip(motions, view.offsets, forces_of, strict=True):
        drawn = {"points": points, "arrows": arrows, "scale": scale, "thickness": 0.0035 * view.size}
        nodes = single.nodes(offset, view.grain, **drawn)
        played.append(((single.times - first) / speed, nodes))
    background, clock = scenery.nodes(motions, view), np.unique(np.concatenate([single.times for single in motions]))
    notes = [f"{speed:.3g} × real time"] if speed != 1 else []
    notes += [f"arrows {square:g} N a square"] if square else []
    notes += dict.fromkeys(note for single in motions for note in single.picture.notes)
    played += [
        (np.zeros(1), background),
        ((clock - first) / speed, [scenery.clock(clock, notes, _marks(motions, clock, speed), view)]),
    ]
    return MovingPicture(page(played, view.camera), height, max(single.times.size for single in motions))


def save_html(trajectory: Motions, path: str | Path, **options: Any) -> Path:
    """Write a moving picture as a page that any browser opens, also without a network; options as in `show`.

    ```python
    path = jaxmb.viz.save_html(motion, "swing.html", points="bar")
    ```
    """
    return show(trajectory, **options).save(path)


def _listed(names: str | Sequence[str]) -> tuple[str, ...]:
    """Names without repetitions, from one or several."""
    return tuple(dict.fromkeys((names,) if isinstance(names, str) else names))


def _named(trajectory: Motions) -> dict[str, Shown]:
    if isinstance(trajectory, Mapping):
        motions = {str(name): single for name, single in trajectory.items()}
    elif isinstance(trajectory, Sequence):
        motions = {str(k): single for k, single in enumerate(trajectory, 1)}
    else:
        motions = {"": trajectory}
    if not motions:
        raise ValueError("There is no motion to show.")
    for single in motions.values():
        if not (isinstance(single, State) or (hasattr(single, "system") and hasattr(single, "ts"))):
            raise ValueError(f"show takes motions returned by simulate, or states, got {type(single).__name__}.")
    return motions


def _marks(motions: Sequence[Motion], clock: np.ndarray, speed: float) -> list[str]:
    """The names of events at each time."""
    events = [
        (event.time, f"{single.name} {event.part}: {event.kind}".strip())
        for single in motions
        if single.trajectory.found_events is not None
        for event in single.trajectory.events
    ]
    out = []
    for t in clock:
        names = dict.fromkeys(text for time, text in events if time <= t < time + _SEEN * speed)
        out.append(", ".join(list(names)[-_AT_ONCE:]))
    return out


def _arrows(
    single: Motion, reactions: Sequence[str], forces: Sequence[str]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    out = {f"reactions/{name}": single.reaction(name) for name in reactions}
    return out | {f"forces/{name}": single.force(name) for name in forces}


def _strength(forces_of: Sequence[Mapping[str, tuple[np.ndarray, np.ndarray]]]) -> float:
    """The force [N] that the largest arrow exceeds for a tenth of the time."""
    largest = [
        np.max([np.linalg.norm(force, axis=-1).max(axis=-1) for _, force in arrows.values()], axis=0)
        for arrows in forces_of
        if arrows
    ]
    return float(np.quantile(np.concatenate(largest), 0.9)) if largest else 0.0
