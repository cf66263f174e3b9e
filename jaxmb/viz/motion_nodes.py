"""One motion as nodes of a scene: bodies, springs and belts, trails, and arrows of forces."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ..parts.base import GROUND
from ..parts.names import unknown
from ..parts.shapes import DARK, AbstractShape, Color, along
from ..system import AbstractSystem
from ..system.picture import Picture, in_space
from ..trajectory import Trajectory, at_rows, picture_of
from . import stage
from .meshes import Triangles, unit_mesh
from .one_motion import check_finite, one_motion
from .solids import COLORS, Placed, color_in, solids

_SPRING: Color = (95, 100, 110)
_REACTION: Color = (200, 30, 45)
_FORCE: Color = (20, 120, 60)


@dataclasses.dataclass(frozen=True)
class Motion:
    """A motion to be shown.

    **Fields:** `name`, "" for a single motion; `trajectory`, with the shown states; `picture` of it; `solids`: shapes
    with their bodies; `tint`: a colour for all bodies, None for a colour each.
    """

    name: str
    trajectory: Trajectory
    picture: Picture
    solids: list[Placed]
    tint: Color | None

    @property
    def times(self) -> Float[np.ndarray, "times"]:
        return np.asarray(self.trajectory.ts)

    @property
    def grounds(self) -> list[Any]:
        """The ground, drawn as far as the motion reaches."""
        return [shape for _, shape in self.solids if shape.primitive == "ground"]

    @functools.cached_property
    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """Least and greatest coordinates [m] that bodies reach."""
        bounded = [solid for solid in self.solids if solid[1].primitive != "ground"]
        position, _ = self._placed(bounded)
        reach = np.array([_reach(shape) for _, shape in bounded])[:, None]
        low, high = [position.min(axis=0) - reach], [position.max(axis=0) + reach]
        for path in self.picture.paths.values():
            low.append(path.points.min(axis=0))
            high.append(path.points.max(axis=0))
        return np.array([np.concatenate(low).min(axis=0), np.concatenate(high).max(axis=0)])

    def _placed(self, placed: Sequence[Placed]):
        """World positions and orientations of shapes, shapes (times, n, 3) and (times, n, 4)."""
        turn = np.stack([self.picture.orientations[body] for body, _ in placed], axis=1)
        place = np.stack([self.picture.positions[body] for body, _ in placed], axis=1)
        positions = np.stack([shape.position for _, shape in placed])
        turned = np.broadcast_to([shape.orientation for _, shape in placed], turn.shape)
        so3 = stage.viser().transforms.SO3
        return place + so3(turn).apply(np.broadcast_to(positions, place.shape)), (so3(turn) @ so3(turned)).wxyz

    # Points and forces

    def point(self, name: str) -> Float[np.ndarray, "times 3"]:
        """World positions of a body, of a frame, or of a part's point on the last of its bodies.

        **Raises:** `ValueError` for an unknown name.
        """
        quantities = self.trajectory.system.quantities()
        if f"{name}.position" in quantities:
            return in_space(self.trajectory.quantity(f"{name}.position"))
        parts = {key: anchors for key, anchors in self.picture.parts.items() if anchors.points[-1] is not None}
        if name in parts:
            return self._anchor(parts[name].bodies[-1], parts[name].points[-1])
        places = [key.removesuffix(".position") for key in quantities if key.endswith(".position")]
        raise unknown("point, a body, frame or joint,", name, [*places, *parts])

    def reaction(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Points and forces [N] of a joint's reaction on the last of its moving bodies, shape (times, 1, 3)."""
        force = in_space(self.trajectory.reactions[name].force)
        part = self.picture.parts[name]
        last = max(k for k, body in enumerate(part.bodies) if body != GROUND)
        return self._anchor(part.bodies[last], part.points[last])[:, None], force[:, None]

    def force(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Points and forces [N] of an applied force on each of its moving bodies, shape (times, bodies, 3)."""
        wrenches, part = np.asarray(self.trajectory.forces[name]), self.picture.parts[name]
        moving = [k for k, body in enumerate(part.bodies) if body != GROUND]
        points = [self._anchor(part.bodies[k], part.points[k]) for k in moving]
        return np.stack(points, axis=1), in_space(wrenches[:, moving, : 2 if self.picture.planar else 3])

    def _anchor(self, body, point):
        turn, place = self.picture.orientations[body], self.picture.positions[body]
        if point is None:
            return place
        return place + stage.viser().transforms.SO3(turn).apply(np.broadcast_to(point, place.shape))

    # Nodes

    def nodes(
        self,
        offset: np.ndarray,
        grain: float,
        *,
        points: Sequence[str],
        arrows: Mapping[str, tuple[np.ndarray, np.ndarray]],
        scale: float,
        thickness: float,
    ) -> list[stage.SceneNode]:
        """All nodes, moved by an offset [m]; `arrows`: points and forces by name, drawn with `scale` [m/N] and with
        shafts of the radius `thickness` [m].
        """
        prefix = f"/{self.name}" if self.name else ""
        out = self._solids(prefix, offset, grain) + self._paths(prefix, offset, grain)
        if self.picture.planar:
            # In front of all bodies.
            offset = offset + np.array([0.0, 0.0, self.bounds[1, 2]])
        for k, name in enumerate(points):
            segments = _trail(self.point(name) + offset)
            out.append(stage.lines(f"{prefix}/trails/{name}", segments, COLORS[(k + 1) % len(COLORS)], 2.5, grain))
        for name, (start, force) in arrows.items():
            color = _REACTION if name.startswith("reactions") else _FORCE
            ends = np.stack([start, start + scale * force], axis=2) + offset
            out.append(stage.arrows(f"{prefix}/{name}", ends, color, thickness, grain))
        return out

    def _solids(self, prefix, offset, grain):
        groups: dict[str, list[Placed]] = {}
        for k, (body, shape) in enumerate(self.solids):
            if shape.primitive != "ground":
                kind = shape.primitive if shape.primitive != "own" else f"mesh {k} of {body}"
                groups.setdefault(f"{kind}{' of the ground' if body == GROUND else ''}", []).append((body, shape))
        out = []
        for name, members in groups.items():
            shape = members[0][1]
            mesh = unit_mesh(shape.primitive) if shape.primitive != "own" else Triangles(shape.vertices, shape.faces)
            position, orientation = self._placed(members)
            scales = np.broadcast_to([shape.scale for _, shape in members], position.shape)
            colors = np.array([shape.color for _, shape in members])
            args = position + offset, orientation, scales, colors
            out.append(stage.instances(f"{prefix}/solids/{name}", mesh, *args, grain))
        return out

    def _paths(self, prefix, offset, grain):
        out = []
        for kind, thickness in {"rod": 0.5, "coil": 1.8, "bar": 1.0}.items():
            lines = {name: path.points for name, path in self.picture.paths.items() if path.kind == kind}
            if not lines:
                continue
            ends = np.concatenate([np.stack([x[:, :-1], x[:, 1:]], axis=2) for x in lines.values()], axis=1)
            line = ends[:, :, 1] - ends[:, :, 0]
            length = np.linalg.norm(line, axis=-1)
            along_z = np.array([0.0, 0.0, 1.0]) * (length == 0)[..., None] + line
            orientation = np.apply_along_axis(along, -1, along_z)
            start = ends[:, :, 0] if kind == "coil" else ends.mean(axis=2)
            radius = np.full_like(length, thickness * self.picture.width)
            scales = np.maximum(np.stack([radius, radius, length], axis=-1), grain)
            of_lines = [_SPRING if kind == "coil" else color_in(self.picture, name, self.tint) for name in lines]
            colors = np.repeat(of_lines, [x.shape[1] - 1 for x in lines.values()], axis=0)
            mesh = unit_mesh("coil" if kind == "coil" else "cylinder")
            args = start + offset, orientation, scales, colors
            out.append(stage.instances(f"{prefix}/solids/{kind}s", mesh, *args, grain))
        for name, path in self.picture.paths.items():
            if path.kind in ("belt", "cord"):
                segments = np.stack([path.points, np.roll(path.points, -1, axis=1)], axis=2) + offset
                segments = segments if path.kind == "belt" else segments[:, :-1]
                out.append(stage.lines(f"{prefix}/solids/{name}", segments, DARK, 5.0, grain))
        return out


def motion(
    name: str,
    trajectory: Trajectory,
    given: Mapping[str, AbstractShape | Sequence[AbstractShape]],
    tint: Color | None,
    deformation: float = 1.0,
) -> Motion:
    """A motion with its shapes; arguments as in `solids` and `picture_of`."""
    shown = picture_of(trajectory, deformation)
    return Motion(name, trajectory, shown, solids(shown, given, tint), tint)


def check_shapes(system: AbstractSystem, given: Mapping[str, AbstractShape | Sequence[AbstractShape]]) -> None:
    """Raise a `ValueError` for shapes of unknown bodies and for other objects than shapes, before a picture is
    computed.
    """
    names = (*system.body_names, GROUND)
    for body, body_shapes in given.items():
        if body not in names:
            raise unknown("body", body, names)
        listed = body_shapes if isinstance(body_shapes, Sequence) else [body_shapes]
        if not all(isinstance(shape, AbstractShape) for shape in listed):
            raise ValueError(f"The shapes of {body!r} must be one or several from jaxmb.shapes, got {body_shapes!r}.")


def chosen(trajectory: Trajectory, frames: int, least: int = 2) -> Trajectory:
    """The motion at up to `frames` of its saved times, in ascending order.

    **Raises:** `ValueError` for a batch, for a motion saved at fewer than `least` times, and for states that are not
    finite.
    """
    trajectory = one_motion(trajectory, "A moving picture", least)
    ts, order = np.unique(np.asarray(trajectory.ts), return_index=True)
    if ts.size < least:
        raise ValueError("A picture needs a motion saved at two times or more; give simulate saveat=…")
    wanted = np.linspace(ts[0], ts[-1], min(frames, ts.size))
    near = np.clip(np.searchsorted(ts, wanted), 1, ts.size - 1)
    near = near - (wanted - ts[near - 1] < ts[near] - wanted)
    rows = order if ts.size <= frames else order[np.unique(near)]
    selection = at_rows(trajectory, rows)
    check_finite(selection)
    return selection


def _reach(shape):
    """The largest distance of a point of a shape from its position."""
    if shape.primitive == "own":
        return float(np.max(np.linalg.norm(shape.vertices, axis=1)))
    if shape.primitive == "sphere":
        return float(np.max(shape.scale))
    half = {"box": (0.5, 0.5, 0.5), "cylinder": (1.0, 0.0, 0.5)}[shape.primitive]
    return float(np.linalg.norm(half * shape.scale))


def _trail(points):
    """Segments of the path up to each time, shape (times, times − 1, 2, 3); later segments have zero length."""
    n = len(points)
    ends = np.minimum(np.arange(n)[None, :], np.arange(n)[:, None])
    return np.stack([points[ends[:, :-1]], points[ends[:, 1:]]], axis=2)
