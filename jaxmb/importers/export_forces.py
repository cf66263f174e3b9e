"""Springs, dampers, actuators, tendons and frames of a scene as elements of MJCF."""

from typing import Any
from xml.etree import ElementTree

import numpy as np

from ..bodies import RigidBodySystem
from ..linalg.rotations import from_matrix
from ..parts.actuators import Actuator
from ..parts.base import AbstractInertialConstraint
from ..parts.combinations import FixedTendon, JointInertia, Tendon
from ..parts.coordinate_parts import JointSpring, JointStop
from ..parts.dry_friction import JointFriction
from ..parts.forces import RotationalDamper, SpringDamper
from ..parts.spatial.kinematics import SPACE
from .description import rotation_of
from .export_tree import Tree, numbers, of_class, parts_of
from .notes import Notes

# For this free length of a tendon's spring MuJoCo takes the length in the file's pose.
_LENGTH_OF_POSE = -1.0
_COUNTS = "Here an angle is within half a turn of middle or free; MuJoCo counts it on from the given pose: {}."


def write_forces(
    system: RigidBodySystem, tree: Tree, elements: dict[str, Any], sections: dict[str, Any], notes: Notes
) -> None:
    """Write the forces, inertias of joints, tendons and frames of a system."""
    writer = _Writer(tree, elements, sections, notes)
    inertial = [
        group for group in system.constraints.position if isinstance(group.group.part, AbstractInertialConstraint)
    ]
    sets = {"tendons": system.bodies.tendons, "forces": system.forces.groups, "joints": inertial}
    for kind, groups in sets.items():
        for part in parts_of(system, groups, tree):
            if notes.leaves_out(kind, part.name):
                continue
            write = of_class(_WRITERS, part.part)
            if write is None or write(writer, part) is False:
                notes.refused.append(f"{part.label} cannot be expressed.")
    for turns in writer.turns.values():
        if len({*turns.values()}) > 1:
            notes.say(_COUNTS, *turns)
    for group in system.frames:
        for k, name in enumerate(group.group.names):
            writer.frame(name, group, k, system)


class _Writer:
    def __init__(self, tree: Tree, elements: dict[str, Any], sections: dict[str, Any], notes: Notes):
        self.tree, self.elements, self.sections, self.notes = tree, elements, sections, notes
        self.tendons: dict[str, Any] = {}
        # MuJoCo's lengths of tendons minus the lengths here, which may have wound up by full turns.
        self.lengths: dict[str, float] = {}
        self.springs: dict[str, tuple[float, float]] = {}
        # By names of joints: the range between stops; and for each part MuJoCo's coordinate minus the part's.
        self.ranges: dict[str, tuple[float, float]] = {}
        self.turns: dict[str, dict[str, float]] = {}

    def site(self, name: str, body: str, position: np.ndarray, rotation: np.ndarray | None = None) -> None:
        """A site at a place and attitude in the world."""
        place = self.tree.poses[body]
        back = rotation_of(place[3:]).T
        element = ElementTree.SubElement(
            self.elements[body], "site", name=name, pos=numbers(back @ (position - place[:3]))
        )
        if rotation is not None:
            element.set("quat", numbers(from_matrix(back @ rotation)))

    def ahead(self, part, about):
        """MuJoCo's coordinate minus the part's. For an angle, which the part wraps to within half a turn of `about`, it
        is a number of full turns [rad]; for a tendon, the length wound up by such turns.
        """
        (coordinate,) = part.acts_on
        joint = self.tree.coordinates.get(coordinate)
        if joint is None:
            return self.lengths.get(coordinate, 0.0)
        turns = part.turns(joint.value, about)
        self.turns.setdefault(joint.name, {})[part.name] = turns
        return turns

    def frame(self, name, group, k, system):
        number = group.group.bodies[k][0]
        body = system.body_names[number] if number < len(system.body_names) else "ground"
        pose = np.asarray(group.group.single(k, 0.0).pose(SPACE, self.tree.poses[body]))
        self.site(name, body, pose[:3], rotation_of(pose[3:7]))

    def tendon(self, part):
        element = ElementTree.SubElement(self.sections["tendon"], "spatial", name=part.name)
        for k, (owner, point) in enumerate(zip(part.part.owners, np.asarray(part.part.points), strict=True)):
            site = part.named(str(k))
            self.site(site, part.bodies[owner], np.asarray(SPACE.point(part.poses[owner], point)))
            ElementTree.SubElement(element, "site", site=site)
        self.tendons[f"{part.name}.length"] = element

    def fixed_tendon(self, part):
        joints: list[Any] = [self.tree.coordinates.get(name) for name in part.acts_on]
        if None in joints:
            return False
        element = ElementTree.SubElement(self.sections["tendon"], "fixed", name=part.name)
        counts, ahead = iter(part.scalars), 0.0
        for k, (joint, coefficient) in enumerate(zip(joints, np.asarray(part.part.coefficients), strict=True)):
            ElementTree.SubElement(element, "joint", joint=joint.name, coef=numbers(coefficient))
            if part.part.is_periodic(k):
                ahead += float(coefficient) * part.turns(joint.value, next(counts), k)
        self.lengths[f"{part.name}.length"] = ahead
        self.tendons[f"{part.name}.length"] = element
        return None

    def inertia(self, part):
        (coordinate,) = part.acts_on
        tendon, joint = self.tendons.get(coordinate), self.tree.coordinates.get(coordinate)
        element: Any = tendon if joint is None else self.tree.elements[joint.name]
        if element is None:
            return False
        _add(element, "armature", part.part.inertia)
        return None

    def spring(self, part):
        law = part.part
        (coordinate,) = part.acts_on
        tendon, joint = self.tendons.get(coordinate), self.tree.coordinates.get(coordinate)
        if tendon is None and (joint is None or joint.kind == "ball"):
            return False
        element: Any = tendon if joint is None else self.tree.elements[joint.name]
        _add(element, "damping", law.damping)
        stiffness, free = float(law.stiffness), float(np.reshape(law.free, ()))
        if stiffness == 0:
            return None
        if joint is not None and law.is_periodic() and law.middle is None:
            self.notes.say(_COUNTS, part.name)
        free += self.ahead(part, free if law.middle is None else law.middle)
        before, its_free = self.springs.get(coordinate, (0.0, 0.0))
        total = before + stiffness
        free = (before * its_free + stiffness * free) / total
        self.springs[coordinate] = total, free
        element.set("stiffness", numbers(total))
        if joint is None and free == _LENGTH_OF_POSE:
            free = np.nextafter(free, 0.0)
        element.set("springlength" if joint is None else "springref", numbers(free))
        return None

    def spring_damper(self, part):
        law = part.part
        element = ElementTree.SubElement(self.sections["tendon"], "spatial", name=part.name)
        for k, body in enumerate(part.bodies):
            site = part.named("ab"[k])
            self.site(site, body, part.point(k))
            ElementTree.SubElement(element, "site", site=site)
        element.set("stiffness", numbers(law.stiffness))
        element.set("damping", numbers(law.damping))
        element.set("springlength", numbers(law.free_length))

    def rotational_damper(self, part):
        balls = [
            joint
            for node in self.tree.nodes
            if {node.body, node.parent} == {*part.bodies}
            for joint in node.joints
            if joint.kind == "ball"
        ]
        if len(balls) != 1:
            return False
        _add(self.tree.elements[balls[0].name], "damping", part.part.damping)
        return None

    def actuator(self, part):
        law = part.part
        (coordinate,) = part.acts_on
        joint = self.tree.coordinates.get(coordinate)
        if joint is None and coordinate not in self.tendons:
            return False
        gain, bias = np.array(law.gain), np.array(law.bias)
        if gain[1] or bias[1]:
            ahead = float(law.gear) * self.ahead(part, law.middle)
            gain[0] -= ahead * gain[1]
            bias[0] -= ahead * bias[1]
        target = {"tendon": coordinate.split(".")[0]} if joint is None else {"joint": joint.name}
        element = ElementTree.SubElement(self.sections["actuator"], "general", attrib=target | {"name": part.name})
        element.set("gear", numbers(law.gear))
        element.set("gaintype", "affine")
        element.set("gainprm", numbers(gain))
        element.set("biastype", "affine")
        element.set("biasprm", numbers(bias))
        if law.lag is not None:
            element.set("dyntype", "filterexact")
            element.set("dynprm", numbers(law.lag))
        for name, given in (("ctrlrange", law.control_range), ("forcerange", law.force_range)):
            if given is not None:
                element.set(name, numbers(given))
        return None

    def stop(self, part):
        law, joint = part.part, self.tree.coordinates.get(part.acts_on[0])
        if joint is None:
            return False
        lower, upper = float(law.lower), float(law.upper)
        ahead = self.ahead(part, 0.5 * (lower + upper))
        least, most = self.ranges.get(joint.name, (-np.inf, np.inf))
        lower, upper = max(least, lower + ahead), min(most, upper + ahead)
        if lower >= upper:
            return False
        self.ranges[joint.name] = lower, upper
        self.tree.elements[joint.name].set("range", numbers((lower, upper)))
        self.notes.say("Stops are MuJoCo's limits, with its stiffness: {}.", part.name)
        return None

    def friction(self, part):
        law, joint = part.part, self.tree.coordinates.get(part.acts_on[0])
        if joint is None:
            return False
        _add(self.tree.elements[joint.name], "frictionloss", law.force)
        self.notes.say("Dry friction is MuJoCo's frictionloss: {}.", part.name)
        return None


def _add(element, name, value):
    """Add to a number of an element, to which several parts may contribute."""
    element.set(name, numbers(float(element.get(name, 0.0)) + float(value)))


_WRITERS = {
    Tendon: _Writer.tendon,
    FixedTendon: _Writer.fixed_tendon,
    JointInertia: _Writer.inertia,
    JointSpring: _Writer.spring,
    SpringDamper: _Writer.spring_damper,
    RotationalDamper: _Writer.rotational_damper,
    Actuator: _Writer.actuator,
    JointStop: _Writer.stop,
    JointFriction: _Writer.friction,
}
