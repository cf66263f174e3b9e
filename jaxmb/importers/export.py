"""A system as MJCF, so that it can be checked in MuJoCo."""

import dataclasses
from collections.abc import Collection
from typing import Any
from xml.etree import ElementTree

import numpy as np

from .._types import State
from ..bodies import RigidBodySystem
from ..linalg.rotations import conjugate, multiply
from ..parts.base import GROUND
from .description import rotation_of
from .export_forces import write_forces
from .export_tree import Tree, TreeBody, numbers, spanning_tree
from .notes import Notes, checked_ignore


@dataclasses.dataclass(frozen=True)
class Exported:
    """The `text` of an MJCF file, and `notes` on differences in MuJoCo."""

    text: str
    notes: tuple[str, ...]


def to_mjcf(system: RigidBodySystem, state: State | None = None, *, ignore: str | Collection[str] = ()) -> Exported:
    """A spatial scene as MJCF.

    ```python
    arm = spatial.Body("arm", mass=1.0, inertia=spatial.box(1.0, 1.0, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    hinge = spatial.Revolute("hinge", "ground", "arm", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    exported = jaxmb.importers.to_mjcf(jaxmb.Scene([arm], joints=[hinge]).compile())
    exported.text, exported.notes
    ```

    Joints in a spanning tree become joints of MuJoCo, with the names and values of the coordinates here. Joints that
    close loops become equality constraints, which MuJoCo holds softly. Angles are in (−π, π] at the given pose; from
    there MuJoCo counts full turns, by which the numbers of springs, stops and actuators are shifted accordingly.
    Several springs, dampers, frictions or stops of a joint are merged. Frames of bodies are at their mass centres.

    **Arguments:** `system`: a compiled scene; `state` of the machine, default the poses given with the bodies, which
    must satisfy the constraints; `ignore`: names of parts to leave out.

    **Returns:** an `Exported`.

    **Raises:** `ValueError` that lists the parts that MuJoCo cannot express.
    """
    if not system.spatial:
        raise ValueError("to_mjcf needs a spatial scene.")
    if flexible := [system.body_names[body] for body, *_ in system.layout.flexible]:
        raise ValueError(f"to_mjcf: {', '.join(flexible)} is flexible, and MJCF joins rigid bodies; replace it.")
    notes = Notes(checked_ignore(ignore))
    tree = spanning_tree(system, (system.guess if state is None else state).q, notes)
    root = ElementTree.Element("mujoco", model="scene")
    ElementTree.SubElement(root, "compiler", angle="radian", autolimits="true")
    gravity = np.zeros(3) if system.forces.gravity is None else np.asarray(system.forces.gravity)
    ElementTree.SubElement(root, "option", gravity=numbers(gravity))
    world = ElementTree.SubElement(root, "worldbody")
    elements = {GROUND: world}
    inertia, mass = np.asarray(system.moments_of_inertia), np.asarray(system.mass)
    for node in tree.nodes:
        k = system.body_names.index(node.body)
        elements[node.body] = _body(elements[node.parent], node, tree, mass[k], inertia[k])
    sections = {tag: ElementTree.Element(tag) for tag in ("equality", "tendon", "actuator")}
    for name, tag, attributes in tree.loops:
        ElementTree.SubElement(sections["equality"], tag, attributes)
        notes.say("Loops and couplings are held softly by MuJoCo: {}.", name)
    write_forces(system, tree, elements, sections, notes)
    root.extend(section for section in sections.values() if len(section))
    ElementTree.indent(root)
    return Exported(
        ElementTree.tostring(root, encoding="unicode"), tuple(notes.finish("The scene", "MuJoCo cannot express"))
    )


def _body(parent, node: TreeBody, tree: Tree, mass, inertia):
    above: Any = tree.poses[node.parent]
    pose: Any = tree.poses[node.body]
    back = rotation_of(above[3:]).T
    element = ElementTree.SubElement(
        parent, "body", name=tree.bodies[node.body], pos=numbers(back @ (pose[:3] - above[:3]))
    )
    element.set("quat", numbers(multiply(conjugate(above[3:]), pose[3:])))
    full = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]] if np.any(inertia) else np.array([mass] * 3 + [0.0] * 3)
    ElementTree.SubElement(element, "inertial", pos="0 0 0", mass=numbers(mass), fullinertia=numbers(full))
    for joint in node.joints:
        written = ElementTree.SubElement(element, "joint", name=joint.name, type=joint.kind)
        turn = rotation_of(pose[3:]).T
        if joint.kind != "free":
            written.set("pos", numbers(turn @ (joint.point - pose[:3])))
        if joint.kind in ("hinge", "slide"):
            written.set("axis", numbers(turn @ joint.axis))
            written.set("ref", numbers(joint.value))
        tree.elements[joint.name] = written
    return element
