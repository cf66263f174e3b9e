"""A recorded scene of viser: nodes that move, written as one page that needs no server and no network."""

import dataclasses
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from .meshes import Triangles

if TYPE_CHECKING:
    from viser import SceneApi, ViserServer

# One picture is recorded at a time, since all threads share the console that a recording makes quiet.
_RECORDS = threading.RLock()


@dataclasses.dataclass(frozen=True)
class SceneNode:
    """An object of the scene that is added once and then changes.

    **Fields:** `add(scene, **first)`: adds it with its properties at the first time and returns viser's handle;
    `varying`: for each property by name, its values at the times of the motion.
    """

    add: Callable[..., Any]
    varying: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def viser() -> Any:
    """The package viser, imported when a picture is made.

    **Raises:** `ImportError` that names the extra to install if it is missing.
    """
    try:
        import viser
        import viser.transforms
    except ImportError as error:
        raise ImportError('Moving pictures need viser; install it with: pip install "jaxmb[view]"') from error
    return viser


def page(nodes: Sequence[tuple[Float[np.ndarray, "times"], Sequence[SceneNode]]], camera: "Camera") -> str:
    """A page that plays groups of nodes, each group with the times [s] of its motion, from 0 on."""
    with _quiet():
        own = server(camera)
        try:
            handles = [(times, node, handle) for times, group in nodes for node, handle in placed(own.scene, group)]
            recording = own.get_scene_serializer()
            now = 0.0
            for time in np.unique(np.concatenate([times for times, _ in nodes])):
                recording.insert_sleep(float(time) - now)
                now = float(time)
                for times, node, handle in handles:
                    k = int(np.searchsorted(times, time))
                    if 0 < k < len(times) and times[k] == time:
                        update(node, handle, k, k - 1)
            # The last state is shown for a while as well.
            recording.insert_sleep(now / 100)
            return recording.as_html()
        finally:
            own.stop()


def placed(scene: "SceneApi", nodes: Sequence[SceneNode]) -> list[tuple[SceneNode, Any]]:
    """Nodes with their handles, added to a scene as they are at the first time."""
    return [(node, node.add(scene, **{name: values[0] for name, values in node.varying.items()})) for node in nodes]


def update(node: SceneNode, handle: Any, k: int, before: int) -> None:
    """Let a node be as at the time `k`, where it differs from the time `before`."""
    for name, values in node.varying.items():
        if not np.array_equal(values[k], values[before]):
            setattr(handle, name, values[k])


@dataclasses.dataclass(frozen=True)
class Camera:
    """The view of a picture: vectors in the world [m], the vertical field of view [rad]."""

    position: np.ndarray
    target: np.ndarray
    up: np.ndarray
    field_of_view: float
    shadows: bool

    @property
    def bottom(self) -> np.ndarray:
        """A point near the bottom of the picture."""
        line = self.target - self.position
        right = np.cross(line, self.up)
        upwards = np.cross(right, line)
        height = np.linalg.norm(line) * np.tan(self.field_of_view / 2)
        return self.target - 0.93 * height * upwards / np.linalg.norm(upwards)

    def place(self, camera: Any) -> None:
        """Give these numbers to viser's initial camera."""
        distance = float(np.linalg.norm(self.position - self.target))
        camera.position, camera.look_at, camera.up = self.position, self.target, self.up
        camera.fov, camera.near, camera.far = self.field_of_view, 0.01 * distance, 100.0 * distance


def server(camera: Camera) -> "ViserServer":
    """A server for this machine only, with a view of an empty scene."""
    with _quiet():
        own = viser().ViserServer(host="127.0.0.1", verbose=False)
    own.scene.set_up_direction(camera.up)
    camera.place(own.initial_camera)
    own.scene.configure_default_lights(True, cast_shadow=camera.shadows)
    return own


def stop(own: "ViserServer") -> None:
    """End a server, which does not announce it."""
    with _quiet():
        own.stop()


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep servers from announcing their addresses."""
    import rich

    with _RECORDS:
        console = rich.get_console()
        quiet, console.quiet = console.quiet, True
        try:
            yield
        finally:
            console.quiet = quiet


# Kinds of nodes


def instances(
    name: str,
    mesh: Triangles,
    positions: Float[np.ndarray, "times n 3"],
    orientations: Float[np.ndarray, "times n 4"],
    scales: Float[np.ndarray, "times n 3"],
    colors: np.ndarray,
    grain: float,
) -> SceneNode:
    """Copies of one mesh; `grain` [m]: the length below which their motion is invisible."""

    def add(scene: "SceneApi", batched_positions, batched_wxyzs, batched_scales):
        return scene.add_batched_meshes_simple(
            name,
            mesh.vertices.astype(np.float32),
            mesh.faces.astype(np.uint32),
            batched_wxyzs=batched_wxyzs,
            batched_positions=batched_positions,
            batched_scales=batched_scales,
            batched_colors=colors.astype(np.uint8),
            lod="off",
            flat_shading=not mesh.smooth,
            side="double",
        )

    varying = {
        "batched_positions": rounded(positions, grain),
        "batched_wxyzs": rounded(orientations, 1e-4),
        "batched_scales": rounded(scales, grain),
    }
    return SceneNode(add, varying)


def lines(name: str, segments: Float[np.ndarray, "times n 2 3"], color, thickness: float, grain: float) -> SceneNode:
    """Straight segments; `thickness` in pixels."""

    def add(scene: "SceneApi", points):
        return scene.add_line_segments(name, points, colors=color, thickness=thickness, thickness_units="screen")

    return SceneNode(add, {"points": rounded(segments, grain)})


def arrows(name: str, ends: Float[np.ndarray, "times n 2 3"], color, radius: float, grain: float) -> SceneNode:
    """Arrows between two points each."""

    def add(scene: "SceneApi", points):
        return scene.add_arrows(
            name, points, colors=color, shaft_radius=radius, head_radius=2.6 * radius, head_length=6.5 * radius
        )

    return SceneNode(add, {"points": rounded(ends, grain)})


def label(name: str, texts: Sequence[str], position: np.ndarray, anchor: Any = "bottom-center") -> SceneNode:
    """A line of text that may change."""
    return SceneNode(lambda scene, text: scene.add_label(name, text, position=position, anchor=anchor), {"text": texts})


def rounded(values: np.ndarray, grain: float) -> np.ndarray:
    """Single precision, rounded to the power of two below `grain`, which compresses better."""
    unit = 2.0 ** np.floor(np.log2(grain))
    return (np.round(np.asarray(values) / unit) * unit).astype(np.float32)
