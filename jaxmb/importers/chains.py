"""Which joint of the library several elementary joints in succession make, from one link with mass to the next."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..parts.joint_parts import JointDriver
from ..parts.spatial.joints import Cylindrical, Gimbal, Planar, Prismatic, Revolute, Spherical, Universal
from .description import Joint

# Axes that miss each other by less [rad, m] are parallel, perpendicular, or meet.
_CLOSE = 1e-7


@dataclasses.dataclass
class Body:
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
    """The parts that some joints make, and for each joint its coordinate, `"hip.angle"` or None if it has none, and
    what must be added to it to give that of the file.
    """

    parts: list[Any]
    coordinates: dict[str, tuple[str | None, float]]


def joint_of(joints: Sequence[Joint], a: Body, b: Body, name: str) -> Found | None:
    """The parts that joints in succession from body A to body B make; None if the library has none.

    **Arguments:** `name` of the part.
    """
    kinds = "".join(joint.kind[0] for joint in joints)
    axes = [joint.axis for joint in joints]
    if kinds == "f":
        return Found([], {joints[0].name: (None, 0.0)})
    if kinds == "b":
        point = joints[0].point
        return Found([Spherical(name, a.name, b.name, point=point)], {joints[0].name: (f"{name}.rotation", 0.0)})
    if kinds in ("h", "s"):
        make = _hinge if kinds == "h" else _slide
        return make(joints[0], a, b, name)
    if kinds in ("hs", "sh") and _parallel(*axes):
        return _cylindrical(joints, a, b, name)
    if kinds in ("hh", "hhh") and _perpendicular(axes):
        return _cardan(joints, a, b, name)
    if kinds in ("ss", "ssh") and _perpendicular(axes):
        return _planar(joints, a, b, name)
    if kinds in ("ssshhh", "sssb") and _perpendicular(axes[:3]) and (kinds == "sssb" or _perpendicular(axes[3:])):
        return Found([], {joint.name: (None, 0.0) for joint in joints})
    return None


def _perpendicular(axes):
    triad = np.stack(axes)
    return bool(np.max(np.abs(triad @ triad.T - np.eye(len(axes)))) < _CLOSE)


def _parallel(u, v):
    return bool(np.linalg.norm(np.cross(u, v)) < _CLOSE)


def _across(axis):
    u = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    return u / np.linalg.norm(u)


def _turning(joint, a, b, x=None):
    """Axes, and the directions that the angle is measured between, from x, so that it is the file's."""
    x = _across(joint.axis) if x is None else x
    back = np.cos(joint.reference) * x + np.sin(joint.reference) * np.cross(joint.axis, x)
    return {
        "axis_a": a.direction(joint.axis),
        "axis_b": b.direction(joint.axis),
        "x_a": a.direction(x),
        "x_b": b.direction(back),
    }


def _hinge(joint, a, b, name):
    points = {"point_a": a.point(joint.point), "point_b": b.point(joint.point)}
    part = Revolute(name, a.name, b.name, **points, **_turning(joint, a, b))
    return Found([part], {joint.name: (f"{name}.angle", 0.0)})


def _shifted(joint, a, b):
    """Points whose distance along the axis is the displacement of the file."""
    return {"point_a": a.point(joint.point - joint.reference * joint.axis), "point_b": b.point(joint.point)}


def _slide(joint, a, b, name):
    part = Prismatic(name, a.name, b.name, axis_a=a.direction(joint.axis), **_shifted(joint, a, b))
    return Found([part], {joint.name: (f"{name}.displacement", 0.0)})


def _cylindrical(joints, a, b, name):
    hinge, slide = sorted(joints, key=lambda joint: joint.kind)
    along = float(np.sign(hinge.axis @ slide.axis))
    if along < 0:
        # The slide's displacement along the other direction of the axis.
        return None
    on_axis = dataclasses.replace(slide, point=hinge.point)
    part = Cylindrical(name, a.name, b.name, **_shifted(on_axis, a, b), **_turning(hinge, a, b))
    return Found([part], {hinge.name: (f"{name}.angle", 0.0), slide.name: (f"{name}.displacement", 0.0)})


def _cardan(joints, a, b, name):
    """Two or three hinges whose axes meet in a point."""
    rows = [np.eye(3) - np.outer(joint.axis, joint.axis) for joint in joints]
    target = np.concatenate([row @ joint.point for row, joint in zip(rows, joints, strict=True)])
    point, *_ = np.linalg.lstsq(np.concatenate(rows), target, rcond=None)
    if np.max(np.abs(np.concatenate(rows) @ point - target)) > _CLOSE:
        return None
    if len(joints) == 2:
        part = Universal(name, a.name, b.name, point=point, axis_a_W=joints[0].axis, axis_b_W=joints[1].axis)
        fields = ("angle_a", "angle_b")
    else:
        axes = {f"axis_{k}_W": joint.axis for k, joint in enumerate(joints, 1)}
        part = Gimbal(name, a.name, b.name, point=point, **axes)
        fields = ("angle_1", "angle_2", "angle_3")
    own = zip(joints, fields, strict=True)
    return Found([part], {joint.name: (f"{name}.{field}", joint.reference) for joint, field in own})


def _planar(joints, a, b, name):
    """Two slides, and perhaps a hinge across both of them."""
    first, second = joints[:2]
    normal = np.cross(first.axis, second.axis)
    hinge = joints[2] if len(joints) == 3 else Joint("", "hinge", first.parent, first.child, first.point, normal)
    start = hinge.point - first.reference * first.axis - second.reference * second.axis
    # The second component of the displacement is that along `axis × x_a`.
    x = first.axis if hinge.axis @ normal > 0 else second.axis
    points = {"point_a": a.point(start), "point_b": b.point(hinge.point)}
    parts: list[Any] = [Planar(name, a.name, b.name, **points, **_turning(hinge, a, b, x))]
    coordinates: dict[str, tuple[str | None, float]] = {first.name: (None, 0.0), second.name: (None, 0.0)}
    if len(joints) == 3:
        coordinates[hinge.name] = (f"{name}.angle", 0.0)
    else:
        parts.append(JointDriver(f"{name} attitude", f"{name}.angle", value=0.0))
    return Found(parts, coordinates)
