"""Machines from URDF, the format of ROS."""

import os
from collections import Counter
from collections.abc import Collection
from typing import Any, Literal

import numpy as np

from ..linalg.rotations import from_matrix
from ..parts.names import unknown
from .description import WORLD, Coupling, Joint, Kind, Link, Machine, roll_pitch_yaw, unused
from .geometry import color_of, read_shapes
from .model import ImportedModel
from .notes import Notes, checked_ignore
from .source import Resources, file_name, text_of
from .xml_model import model_of
from .xml_tree import Element, parse

_KINDS: dict[str, Kind] = {
    "revolute": "hinge",
    "continuous": "hinge",
    "prismatic": "slide",
    "fixed": "fixed",
    "floating": "free",
    # A kind of joint of Bullet and MuJoCo, not of the format.
    "spherical": "ball",
}
# Elements without effect on the motion.
_EFFECTLESS = {"material", "transmission", "verbose", "name"}


def urdf(
    source: str | os.PathLike[str],
    *,
    base: Literal["fixed", "free"] = "fixed",
    gravity: Any = (0.0, 0.0, -9.81),
    ignore: str | Collection[str] = (),
    package_dirs: str | os.PathLike[str] | Collection[str | os.PathLike[str]] = (),
) -> ImportedModel:
    """A machine from URDF.

    ```python
    model = jaxmb.importers.urdf("arm.urdf", base="fixed", ignore="limits")
    system = model.scene.compile()
    ```

    **Arguments:**

    - `source`: a path, or the text of a file.
    - `base`: whether the root link is fixed to the ground, or free. A root link called `world` is the ground.
    - `gravity` [m/s²], shape (3,), which the format does not define.
    - `ignore`: elements to leave out, by words such as `"limits"`, `"collisions"` and `"pictures"`, or by names of
        joints.
    - `package_dirs`: folders of packages, or with packages, that are searched first for `package://name/`, before the
        folder of the file and its parents.

    **Returns:** an `ImportedModel`; its `notes` list the approximations.

    **Raises:** `ValueError` with file and line for elements that cannot be imported.
    """
    notes, file, files = Notes(checked_ignore(ignore)), file_name(source), Resources.of(source, package_dirs)
    if base not in ("fixed", "free"):
        raise ValueError(f"base must be 'fixed' or 'free', got {base!r}.")
    root = parse(text_of(source), file)
    if root.tag != "robot":
        raise ValueError(f"{root.where}the root of URDF is <robot>, got <{root.tag}>.")
    if any(child.tag.startswith("xacro:") for child in root.children):
        raise ValueError(f"{root.where}the file has xacro macros: run xacro on it first.")
    machine = Machine(root.attributes.get("name", "robot"), np.asarray(gravity, float))
    for element in root.all("link"):
        _read_link(element, machine, notes, files)
    joints = [_read_joint(element, machine, notes) for element in root.all("joint")]
    _place(machine, joints, base, root, notes)
    for joint, element, _ in joints:
        machine.joints.append(joint)
        _read_mimic(joint, element, machine, [other.name for other, _, _ in joints], notes)
    if any(element.first("limit") is not None for element in root.all("joint")):
        notes.say("Limits of efforts and speeds are not read: the joints have no actuators.")
    return model_of(root, machine, notes, file, _EFFECTLESS)


def _origin(element: Element | None):
    """Position and rotation of an `<origin>`."""
    origin = None if element is None else element.first("origin")
    if origin is None:
        return np.zeros(3), np.eye(3)
    position = origin.numbers(origin.attributes.get("xyz", "0 0 0"))
    return position, roll_pitch_yaw(origin.numbers(origin.attributes.get("rpy", "0 0 0")))


def _read_link(element, machine, notes, files):
    name = element.need("name")
    if name in machine.links:
        raise ValueError(f"{element.where}link {name!r} occurs twice.")
    link = Link(name, where=element.where)
    inertial = element.first("inertial")
    if inertial is not None:
        link.centre, turn = _origin(inertial)
        mass, inertia = inertial.first("mass"), inertial.first("inertia")
        if mass is None or inertia is None:
            raise ValueError(f"{inertial.where}<inertial> of link {name!r} needs <mass> and <inertia>.")
        link.mass = float(mass.numbers(mass.need("value"), 1)[0])
        xx, xy, xz, yy, yz, zz = (inertia.attribute_number(i) for i in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
        link.inertia = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
    machine.links[name] = link
    read_shapes(element, name, machine, notes, files, _seen)


def _seen(element):
    """Place and color of a shape."""
    position, rotation = _origin(element)
    material = element.first("material")
    given = None if material is None else material.first("color")
    rgba = (0.5, 0.5, 0.5, 1.0) if given is None else given.numbers(given.attributes.get("rgba", "0.5 0.5 0.5 1"), 4)
    return {"position": position, "orientation": from_matrix(rotation), "color": color_of(rgba)}


def _read_joint(element, machine, notes):
    """A joint, its element, and place and rotation of its frame in the parent link."""
    name, kind = element.need("name"), element.need("type")
    if kind not in (*_KINDS, "planar"):
        kinds = ", ".join((*_KINDS, "planar"))
        raise ValueError(f"{element.where}joint {name!r} has the unknown type {kind!r}; there are {kinds}.")
    ends = []
    for tag in ("parent", "child"):
        end = element.first(tag)
        link = None if end is None else end.need("link")
        if link not in machine.links:
            raise ValueError(f"{element.where}joint {name!r} has the {tag} {link!r}, but there is no such link.")
        ends.append(link)
    axis = element.first("axis")
    direction = np.array([1.0, 0.0, 0.0]) if axis is None else axis.numbers(axis.attributes.get("xyz", "1 0 0"))
    length = np.linalg.norm(direction)
    if length == 0 and kind not in ("fixed", "floating"):
        raise ValueError(f"{element.where}the axis of joint {name!r} is zero.")
    joint = Joint(name, _KINDS.get(kind, "hinge"), ends[0], ends[1], where=element.where)
    joint.axis = direction / length if length else direction
    dynamics, limit = element.first("dynamics"), element.first("limit")
    if dynamics is not None:
        joint.damping = dynamics.attribute_number("damping")
        joint.friction = dynamics.attribute_number("friction")
    if limit is not None and kind in ("revolute", "prismatic"):
        joint.limits = _limits(limit, name, notes)
    return joint, element, _origin(element)


def _limits(limit, name, notes):
    try:
        lower, upper = limit.attribute_number("lower"), limit.attribute_number("upper")
    except ValueError as error:
        notes.refuse("limits", name, str(error))
        return None
    if lower > upper:
        where = f"{limit.where}the limits of joint {name!r}"
        notes.refuse("limits", name, f"{where} must increase, got {lower} and {upper}")
        return None
    if lower == upper:
        notes.say("Limits without a range are ignored: {}.", name)
        return None
    return lower, upper


def _place(machine, joints, base, root, notes):
    """Place the links at zero coordinates."""
    names = Counter(joint.name for joint, _, _ in joints)
    for joint, _, _ in joints:
        if names[joint.name] > 1:
            raise ValueError(f"{joint.where}joint {joint.name!r} occurs twice.")
    children = [joint.child for joint, _, _ in joints]
    twice = [name for name, number in Counter(children).items() if number > 1]
    if twice:
        raise ValueError(f"{root.where}link {twice[0]!r} is the child of several joints; URDF holds trees only.")
    roots = [name for name in machine.links if name not in children]
    if len(roots) != 1:
        raise ValueError(
            f"{root.where}the links do not form a tree: roots are {', '.join(map(repr, roots)) or 'none'}."
        )
    if base == "free" and roots[0] == "world" and machine.links["world"].mass:
        notes.say("The root link 'world' is the ground, whatever its mass, despite base='free': give it another name.")
    if base == "fixed" or roots[0] == "world":
        machine.joints.append(Joint("", "fixed", WORLD, roots[0]))
    else:
        machine.joints.append(Joint(unused("base", names.__contains__), "free", WORLD, roots[0]))
    of_parent: dict[str, list[Any]] = {}
    for each in joints:
        of_parent.setdefault(each[0].parent, []).append(each)
    queue, unreached = [roots[0]], set(machine.links)
    while queue:
        parent = machine.links[queue.pop()]
        unreached.remove(parent.name)
        for joint, element, (position, rotation) in of_parent.get(parent.name, ()):
            child = machine.links[joint.child]
            child.position = parent.position + parent.rotation @ position
            child.rotation = parent.rotation @ rotation
            joint.point, joint.axis = child.position, child.rotation @ joint.axis
            queue.append(child.name)
            if element.attributes["type"] == "planar":
                _spread(machine, joint, names)
    if unreached:
        listed = ", ".join(map(repr, sorted(unreached)))
        raise ValueError(f"{root.where}the links do not form a tree: no joints lead from {roots[0]!r} to {listed}.")


def _spread(machine, joint, names):
    """A planar joint as two slides and a hinge, with massless links between them."""
    child = machine.links[joint.child]
    u = child.rotation[:, int(np.argmin(np.abs(child.rotation.T @ joint.axis)))]
    u = np.cross(np.cross(joint.axis, u), joint.axis)
    u /= np.linalg.norm(u)
    place = {"position": child.position, "rotation": child.rotation, "where": joint.where}
    for way, axis in (("x", u), ("y", np.cross(joint.axis, u))):
        name = unused(f"{joint.name} {way}", names.__contains__)
        between = machine.add(Link(name, **place))
        machine.joints.append(Joint(name, "slide", joint.parent, between, joint.point, axis))
        joint.parent = between


def _read_mimic(joint, element, machine, names, notes):
    mimic = element.first("mimic")
    if mimic is None:
        return
    factor, offset = mimic.attribute_number("multiplier", 1.0), mimic.attribute_number("offset")
    other, name = mimic.need("joint"), f"{joint.name} mimic"
    if joint.kind == "fixed":
        notes.say("Fixed joints do not move, so their <mimic> has no effect: {}.", joint.name)
    elif other not in names:
        notes.refuse("couplings", name, f"{mimic.where}<mimic> of {joint.name!r}: {unknown('joint', other, names)}")
    else:
        machine.couplings.append(Coupling(name, joint.name, offset, [(other, np.array([factor]), 0.0)]))
