"""Machines from SDF, the format of Gazebo: links anywhere, joints between any two of them, closed loops included."""

import itertools
import os
import re
from collections import Counter
from collections.abc import Collection
from typing import Any

import numpy as np

from ..linalg.rotations import from_matrix
from .description import WORLD, Joint, Kind, Link, Machine, roll_pitch_yaw, unused
from .geometry import read_shapes
from .model import ImportedModel
from .notes import Notes, checked_ignore
from .source import Resources, file_name, text_of
from .xml_model import model_of
from .xml_tree import Element, parse

_KINDS: dict[str, Kind] = {
    "revolute": "hinge",
    "continuous": "hinge",
    "prismatic": "slide",
    "ball": "ball",
    "fixed": "fixed",
    "universal": "hinge",
}
# The ground's name in joints; some files have a link of this name.
_WORLD = "world"
# A limit of a joint from this size on is ignored.
_UNLIMITED = 1e15
# Default moments and products of inertia [kg m²].
_INERTIA = {"ixx": 1.0, "ixy": 0.0, "ixz": 0.0, "iyy": 1.0, "iyz": 0.0, "izz": 1.0}
_GREY = (128, 128, 128)
# Elements without effect on the motion.
_EFFECTLESS = {"sensor", "light", "material", "self_collide", "allow_auto_disable", "audio_source", "transparency"}


def sdf(
    source: str | os.PathLike[str],
    *,
    gravity: Any = (0.0, 0.0, -9.81),
    ignore: str | Collection[str] = (),
    package_dirs: str | os.PathLike[str] | Collection[str | os.PathLike[str]] = (),
) -> ImportedModel:
    """A machine from SDF: the model of the file, or several models side by side.

    ```python
    model = jaxmb.importers.sdf("arm.sdf", gravity=(0.0, 0.0, -9.81))
    system = model.scene.compile()
    ```

    Links and joints of several models are prefixed by the model's name, `"arm::hand"`. A model is free unless a joint
    binds it to `world`, or it is static. Before version 1.5 of the format, axes of joints are in the frame of the
    model. Angles written with few digits, such as 1.5708, are taken as the multiples of π/12 that they round: hinges of
    a loop are then exactly parallel.

    **Arguments:** `source`: a path, or the text of a file; `gravity` [m/s²], shape (3,), if no world in the file
    defines it; `ignore`: elements to leave out, by words such as `"limits"`, `"collisions"` and `"pictures"`, or by
    names of joints; `package_dirs`: folders of models, or with models, that are searched first for `model://name/`,
    before the folder of the file and its parents.

    **Returns:** an `ImportedModel`; its `notes` list the approximations.

    **Raises:** `ValueError` with file and line for elements that cannot be imported.
    """
    notes, file, files = Notes(checked_ignore(ignore)), file_name(source), Resources.of(source, package_dirs)
    root = parse(text_of(source), file)
    if root.tag != "sdf":
        raise ValueError(f"{root.where}the root of SDF is <sdf>, got <{root.tag}>.")
    version = _version(root)
    holder = root.first("world") or root
    for include in (*holder.all("include"), *root.all("include")):
        raise ValueError(f"{include.where}<include> is not followed: put the model into the file.")
    models = list(holder.all("model"))
    if not models:
        raise ValueError(f"{root.where}the file holds no <model>.")
    weight = holder.first("gravity")
    machine = Machine(models[0].attributes.get("name", "model"), np.asarray(gravity, float))
    if weight is not None:
        machine.gravity = weight.numbers()
    for model, scope in zip(models, _scopes(models, notes), strict=True):
        _read_model(model, scope, machine, version, notes, files)
    return model_of(root, machine, notes, file, _EFFECTLESS)


def _scopes(models, notes):
    """The prefix of the names of each model's links and joints: empty for a single model."""
    if len(models) == 1:
        return [""]
    out: list[str] = []
    for model in models:
        name = model.attributes.get("name", "model")
        tries = itertools.chain([name], (f"{name} {k}" for k in itertools.count(2)))
        unique = next(unique for unique in tries if f"{unique}::" not in out)
        if unique != name:
            notes.say("Models have other names, since the file's names are not unique: {}.", f"{name} → {unique}")
        out.append(f"{unique}::")
    return out


def _read_model(model, scope, machine, version, notes, files):
    place = _pose(model, notes)
    for nested in (*model.all("model"), *model.all("include"), *model.all("frame")):
        notes.refused.append(f"{nested.where}<{nested.tag}> within a model is not read; write the model out.")
    if "placement_frame" in model.attributes:
        notes.refused.append(f"{model.where}placement_frame is not read: give the pose of the model's frame.")
    static = model.first("static")
    static = static is not None and _true(static.text)
    for element in model.all("link"):
        _read_link(element, scope, machine, place, notes, files)
        if static:
            name = f"{scope}{element.need('name')}"
            machine.joints.append(Joint("", "fixed", WORLD, name))
    names = Counter(f"{scope}{element.need('name')}" for element in model.all("joint"))
    for element in model.all("joint"):
        _read_joint(element, scope, machine, place[1], version, notes, names)


def _version(root: Element) -> tuple[int, ...]:
    """The version of the format, `(1, 6)`."""
    given = root.need("version").strip()
    if re.fullmatch(r"\d+(\.\d+)*", given) is None:
        raise ValueError(f"{root.where}the version of the format is a number such as 1.9, got {given!r}.")
    return tuple(int(part) for part in given.split("."))


def _true(word: str) -> bool:
    return word.strip().lower() in ("1", "true")


def _pose(element: Element, notes: Notes):
    """Position and rotation of a `<pose>`."""
    pose = element.first("pose")
    if pose is None:
        return np.zeros(3), np.eye(3)
    relative = pose.attributes.get("relative_to", pose.attributes.get("frame", ""))
    if relative not in ("", "__model__"):
        raise ValueError(f"{pose.where}a pose relative to {relative!r}: give it in the model's frame.")
    words = pose.text.split()
    numbers = pose.numbers(count=6)
    angles = [_rounded(word, value, pose, notes) for word, value in zip(words[3:], numbers[3:], strict=True)]
    if _true(pose.attributes.get("degrees", "")):
        angles = [np.deg2rad(value) for value in numbers[3:]]
    return numbers[:3], roll_pitch_yaw(angles)


def _rounded(word, value, element, notes):
    """An angle [rad]; a word that is the rounding of a multiple of π/12 gives this multiple."""
    digits = re.fullmatch(r"[-+]?\d*\.(\d{2,})", word)
    if digits is None:
        return value
    step = np.pi / 12
    exact = step * round(value / step)
    if exact and exact != value and abs(value - exact) <= 0.51 * 10.0 ** -len(digits.group(1)):
        notes.say("Angles such as 1.5708 are taken as the multiples of π/12 that they round.")
        return exact
    return value


def _read_link(element, scope, machine, place, notes, files):
    name = f"{scope}{element.need('name')}"
    if name in machine.links:
        raise ValueError(f"{element.where}link {name!r} occurs twice.")
    position, rotation = _pose(element, notes)
    link = Link(name, where=element.where)
    link.position, link.rotation = place[0] + place[1] @ position, place[1] @ rotation
    inertial = element.first("inertial")
    if inertial is not None:
        link.centre, turn = _pose(inertial, notes)
        link.mass = inertial.number("mass", 1.0)
        moments = inertial.first("inertia")
        xx, xy, xz, yy, yz, zz = (
            default if moments is None else moments.number(moment, default) for moment, default in _INERTIA.items()
        )
        link.inertia = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
        if _true(inertial.attributes.get("auto", "")):
            notes.refused.append(f"{inertial.where}the inertia of link {name!r} comes from its shapes: write it out.")
    elif name == f"{scope}{_WORLD}":
        machine.joints.append(Joint("", "fixed", WORLD, name))
    else:
        link.mass, link.inertia = 1.0, np.eye(3)
        notes.say("Links without <inertial> have the mass 1 kg and moments of inertia of 1 kg m²: {}.", name)
    weighs = element.first("gravity")
    if weighs is not None and not _true(weighs.text):
        machine.buoyancy[name] = 1.0
    if inertial is not None and name == f"{scope}{_WORLD}":
        notes.say(
            "A link called world that has an <inertial> is not the ground, and moves as its joints allow: {}.", name
        )
    machine.links[name] = link

    def seen(element):
        position, rotation = _pose(element, notes)
        return {"position": position, "orientation": from_matrix(rotation), "color": _GREY}

    read_shapes(element, name, machine, notes, files, seen)


def _read_joint(element, scope, machine, of_model, version, notes, names):
    name, kind = f"{scope}{element.need('name')}", element.need("type")
    if kind not in _KINDS:
        kinds = ", ".join(_KINDS)
        if kind in ("gearbox", "screw", "revolute2"):
            element.skip()
            notes.refuse("gearboxes", name, f"{element.where}joint {name!r} is of type {kind!r}")
            return
        raise ValueError(f"{element.where}joint {name!r} has the unknown type {kind!r}; there are {kinds}.")
    if names[name] > 1:
        raise ValueError(f"{element.where}joint {name!r} occurs twice.")
    ends = []
    for tag in ("parent", "child"):
        reference = element.first(tag)
        given = "" if reference is None else reference.text.strip()
        link = f"{scope}{given}"
        if link not in machine.links:
            if given != _WORLD:
                raise ValueError(f"{element.where}joint {name!r} has the {tag} {given!r}, but there is no such link.")
            link = WORLD
        ends.append(link)
    if ends[0] == ends[1]:
        raise ValueError(f"{element.where}parent and child of joint {name!r} are the same, {given!r}.")
    child = machine.links.get(ends[1], Link(_WORLD))
    position, rotation = _pose(element, notes)
    frame = child.rotation @ rotation
    point = child.position + child.rotation @ position
    axes = [axis_element for tag in ("axis", "axis2") if (axis_element := element.first(tag)) is not None]
    if kind == "universal" and len(axes) == 2:
        between = machine.add(Link(f"{name} cross", position=point, rotation=frame, where=element.where))
        one, two = (unused(f"{name} {k}", names.__contains__) for k in (1, 2))
        first = Joint(one, "hinge", ends[0], between, point, where=element.where)
        second = Joint(two, "hinge", between, ends[1], point, where=element.where)
        pairs = list(zip((first, second), axes, strict=True))
    else:
        joint = Joint(name, _KINDS[kind], ends[0], ends[1], point, where=element.where)
        pairs = [(joint, axes[0] if axes else None)]
    for joint, axis in pairs:
        if axis is not None:
            _read_axis(joint, axis, frame, of_model, scope, machine, version, notes, kind)
        elif joint.kind in ("hinge", "slide"):
            raise ValueError(f"{element.where}joint {name!r} needs an <axis>.")
        machine.joints.append(joint)


def _read_axis(joint, axis, frame, of_model, scope, machine, version, notes, kind):
    xyz = axis.first("xyz")
    direction = np.array([0.0, 0.0, 1.0]) if xyz is None else xyz.numbers()
    expressed = "" if xyz is None else xyz.attributes.get("expressed_in", "")
    in_model = axis.first("use_parent_model_frame")
    # Before version 1.5 axes are in the frame of the model; 1.5 and 1.6 have an element for it.
    if (version < (1, 5) if in_model is None else _true(in_model.text)) or expressed == "__model__":
        frame = of_model
    elif expressed:
        if f"{scope}{expressed}" not in machine.links:
            raise ValueError(
                f"{axis.where}the axis of {joint.name!r} is expressed in {expressed!r}, which is not a link."
            )
        frame = machine.links[f"{scope}{expressed}"].rotation
    length = np.linalg.norm(direction)
    if length == 0:
        raise ValueError(f"{axis.where}the axis of joint {joint.name!r} is zero.")
    joint.axis = frame @ (direction / length)
    dynamics, limit = axis.first("dynamics"), axis.first("limit")
    if dynamics is not None:
        joint.damping, joint.friction = dynamics.number("damping"), dynamics.number("friction")
        joint.stiffness = dynamics.number("spring_stiffness")
        free = dynamics.number("spring_reference")
        joint.free = None if joint.kind == "ball" else free
    if limit is not None:
        lower, upper = limit.number("lower", -np.inf), limit.number("upper", np.inf)
        for child in limit.children:
            if not child.read and child.tag in ("effort", "velocity"):
                child.read = True
                notes.say("Limits of efforts and speeds are not read: the joints have no actuators.")
        if kind != "ball" and lower > -_UNLIMITED and upper < _UNLIMITED:
            if lower < upper:
                joint.limits = (lower, upper)
            else:
                where = f"{limit.where}the limits of joint {joint.name!r}"
                notes.refuse("limits", joint.name, f"{where} must increase, got {lower} and {upper}")
        elif kind != "ball" and (lower > -_UNLIMITED or upper < _UNLIMITED):
            notes.refuse("limits", joint.name, f"{limit.where}joint {joint.name!r} is limited on one side")
