"""Joints of the library from chains of elementary joints between links with mass."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..linalg.rotations import from_matrix
from ..parts.spatial.composite import Composite, coordinate_names, degenerate, flat_angle
from ..parts.spatial.joints import Prismatic, Revolute, Spherical
from .description import Joint, turn_about

# Axes that pass each other within this distance [m] meet.
_CLOSE = 1e-12
# Least sine of the angle of three axes that do not lie in one plane.
_FLAT = 1e-6


@dataclasses.dataclass
class PlacedLink:
    """A body of the scene, or the ground: its name, and position and rotation of its frame."""

    name: str
    position: np.ndarray
    rotation: np.ndarray

    def point(self, at: np.ndarray) -> np.ndarray:
        return self.rotation.T @ (at - self.position)

    def direction(self, along: np.ndarray) -> np.ndarray:
        return self.rotation.T @ along


@dataclasses.dataclass
class Found:
    """The part for some joints, if any, and for each joint its coordinate, `"hip.angle"`, or None.

    `half_turn`: the joint whose angle is limited to half a turn, though its range is larger.
    """

    parts: list[Any]
    coordinates: dict[str, str | None]
    half_turn: str = ""


def joint_of(joints: Sequence[Joint], a: PlacedLink, b: PlacedLink, name: str) -> Found:
    """The part for joints in succession from body A to body B.

    **Arguments:** `name` of the part.

    **Raises:** `ValueError` that says why the placement of the bodies does not determine the coordinates of the joints.
    """
    joint = joints[0]
    if len(joints) > 1:
        return _composite(joints, a, b, name)
    if joint.kind == "free":
        return Found([], {joint.name: None})
    if joint.kind == "ball":
        return Found([Spherical(name, a.name, b.name, point=joint.point)], {joint.name: f"{name}.rotation"})
    return _hinge(joint, a, b, name) if joint.kind == "hinge" else _slide(joint, a, b, name)


def _hinge(joint, a, b, name):
    points = {"point_a": a.point(joint.point), "point_b": b.point(joint.point)}
    axes = {"axis_a": a.direction(joint.axis), "axis_b": b.direction(joint.axis)}
    # The angle between these directions is the file's.
    x = np.cross(joint.axis, np.eye(3)[int(np.argmin(np.abs(joint.axis)))])
    x /= np.linalg.norm(x)
    back = np.cos(joint.reference) * x + np.sin(joint.reference) * np.cross(joint.axis, x)
    part = Revolute(name, a.name, b.name, **points, **axes, x_a=a.direction(x), x_b=b.direction(back))
    return Found([part], {joint.name: f"{name}.angle"})


def _slide(joint, a, b, name):
    # The distance of these points along the axis is the displacement of the file.
    points = {"point_a": a.point(joint.point - joint.reference * joint.axis), "point_b": b.point(joint.point)}
    part = Prismatic(name, a.name, b.name, axis_a=a.direction(joint.axis), **points)
    return Found([part], {joint.name: f"{name}.displacement"})


def _composite(joints, a, b, name):
    # Turn and shift, from zero coordinates to the reference pose, of the joints and the body that follow.
    turn, shift = np.eye(3), np.zeros(3)
    axes, points = [], []
    for joint in joints:
        axis, point = turn.T @ joint.axis, turn.T @ (joint.point - shift)
        axes.append(axis)
        points.append(point)
        if joint.kind == "hinge":
            rotation = turn_about(axis, joint.reference)
            turn, shift = turn @ rotation, turn @ (point - rotation @ point) + shift
        elif joint.kind == "slide":
            shift = turn @ (joint.reference * axis) + shift
    sequence = [joint.kind for joint in joints]
    why = degenerate(sequence, np.array(axes), [f"{joint.kind} {joint.name!r}" for joint in joints])
    if why:
        raise ValueError(why)
    b_at_zero = PlacedLink(b.name, turn.T @ (b.position - shift), turn.T @ b.rotation)
    options, half_turn = _second_of_three(joints, axes)
    turning = [k for k, kind in enumerate(sequence) if kind != "slide"] or [0]
    point = _meeting([points[k] for k in turning], [axes[k] for k in turning])
    if point is None:
        point = points[turning[0]]
        options["points"] = [a.point(points[k]) for k in turning]
    part = Composite(
        name,
        a.name,
        b.name,
        sequence=sequence,
        axes=[a.direction(axis) for axis in axes],
        point_a=a.point(point),
        point_b=b_at_zero.point(point),
        orientation=from_matrix(a.rotation.T @ b_at_zero.rotation),
        **options,
    )
    fields = zip(joints, coordinate_names(sequence), strict=True)
    return Found([part], {joint.name: f"{name}.{field}" for joint, field in fields}, half_turn)


def _meeting(points, axes):
    """The common point of lines; None without one."""
    rows = np.concatenate([np.eye(3) - np.outer(axis, axis) for axis in axes])
    target = np.concatenate([rows[3 * k : 3 * k + 3] @ point for k, point in enumerate(points)])
    # Relative to the first point, so that a common point stays unchanged.
    step = np.linalg.lstsq(rows, target - rows @ points[0], rcond=None)[0]
    point = points[0] + step
    return point if np.max(np.abs(rows @ point - target)) <= _CLOSE else None


def _second_of_three(joints, axes):
    """For three hinges: options with the middle of the second angle, and the name of the second hinge if the three axes
    lie in one plane within its range.
    """
    hinges = [(joint, axis) for joint, axis in zip(joints, axes, strict=True) if joint.kind == "hinge"]
    if len(hinges) < 3:
        return {}, ""
    second, flat = hinges[1][0], float(flat_angle(*(axis for _, axis in hinges)))
    middle = second.reference if second.limits is None else 0.5 * (second.limits[0] + second.limits[1])
    if abs(np.sin(middle - flat)) < _FLAT:
        names = ", ".join(repr(joint.name) for joint, _ in hinges)
        raise ValueError(
            f"the axes of the hinges {names} lie in one plane in the middle of the range of {second.name!r}"
        )
    low = flat + np.pi * np.floor((middle - flat) / np.pi)
    within = second.limits is not None and low < second.limits[0] and second.limits[1] < low + np.pi
    return {"middle": middle}, "" if within else second.name
