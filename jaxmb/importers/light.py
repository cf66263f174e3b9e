"""Links without inertia, with the armature of a joint, or with an inertia that no rigid body has."""

from collections import Counter

import numpy as np

from ..linalg.graphs import connected
from .description import WORLD, Joint, Link, LinkKey, Machine
from .notes import Notes

# The fraction of the largest moment of inertia that counts as rounding.
_ROUNDED = 0.05


def bodies_of(machine: Machine) -> dict[LinkKey, LinkKey]:
    """For each link and the world, the first link of the file that it is fixed to."""
    names: tuple[LinkKey, ...] = (WORLD, *machine.links)
    number = {name: k for k, name in enumerate(names)}
    welds = [(number[joint.parent], number[joint.child]) for joint in machine.joints if joint.kind == "fixed"]
    return {name: names[k] for name, k in zip(names, connected(len(names), welds), strict=True)}


def without_ends(machine: Machine, notes: Notes) -> list[str]:
    """Remove from a machine the massless links that hang at one joint, with all that they carry.

    They take no force, so no force passes their joint. A link stays if it is also held by a loop, a tendon, an
    actuator, or couplings that could transmit a force.

    **Returns:** the names of the removed links.
    """
    before = list(machine.links)
    while True:
        of = bodies_of(machine)
        heavy = {WORLD, *(of[name] for name, link in machine.links.items() if link.mass or np.any(link.inertia))}
        # A free joint holds nothing.
        moving = [joint for joint in machine.joints if joint.kind not in ("fixed", "free")]
        held = Counter(of[link] for joint in moving for link in (joint.parent, joint.child))
        held.update(of[link] for loop in machine.loops for link in (loop.link_a, loop.link_b))
        held.update(of[link] for tendon in machine.tendons for link, _ in tendon.points)
        # Bodies to remove, and the joints at which they hang.
        ends: dict[LinkKey, str | None] = {body: None for body in of.values() if body not in heavy and held[body] == 0}
        for joint in moving:
            for link in (joint.parent, joint.child):
                if of[link] not in heavy and held[of[link]] == 1 and _alone(machine, notes, joint):
                    ends[of[link]] = joint.name
        if not ends:
            return [name for name in before if name not in machine.links]
        _take_out(machine, {name for name, body in of.items() if body in ends}, set(ends.values()) - {None}, notes)


def _alone(machine, notes, joint):
    """Whether no force on a joint can reach another joint."""
    acting = [actuator for actuator in machine.actuators if not actuator.on_tendon and actuator.of == joint.name]
    along = [tendon for tendon in machine.tendons if any(name == joint.name for name, _ in tendon.joints)]
    coupled = [coupling for coupling in machine.couplings if joint.name in _coupled(coupling)]
    if acting or along or len(coupled) > 1:
        return False
    return not coupled or notes.ignore.issuperset(joint.passive)


def _coupled(coupling):
    """The joints of a coupling."""
    return set() if coupling.of_tendons else {coupling.joint, *(name for name, _, _ in coupling.others)}


def _take_out(machine, links, joints, notes):
    notes.say("Links without mass at the ends of the machine take no force and are left out: {}.", *links)
    machine.links = {name: link for name, link in machine.links.items() if name not in links}
    hangs = lambda joint: joint.child in links or (joint.kind != "fixed" and joint.name in joints)
    machine.joints = [element for element in machine.joints if not hangs(element)]
    machine.buoyancy = {name: share for name, share in machine.buoyancy.items() if name not in links}
    machine.couplings = [element for element in machine.couplings if not _coupled(element) & joints]
    machine.marks = [element for element in machine.marks if element.link not in links]
    machine.shapes = [element for element in machine.shapes if element[0] not in links]
    machine.collisions = [element for element in machine.collisions if element[0] not in links]


def with_rotors(machine: Machine, notes: Notes) -> None:
    """Make the armature of free joints, and of ball joints on the ground, a separate link, fixed to the joint's link.

    The velocities of these joints are the link's. The armature is therefore a weightless point mass at the origin of
    the link's frame, and the inertia of a ball about this point. No link moves like a ball joint between two moving
    links.
    """
    of = bodies_of(machine)
    heavy = {of[name] for name, link in machine.links.items() if link.mass}
    for joint in list(machine.joints):
        child = joint.child
        alone = of[joint.parent] is WORLD and of[child] in heavy
        if joint.kind not in ("free", "ball") or not joint.armature or child is WORLD or not alone:
            continue
        armature, joint.armature = joint.armature, 0.0
        if notes.leaves_out("armature", joint.name):
            continue
        beside, mass = machine.links[child], armature if joint.kind == "free" else 0.0
        rotor = f"{joint.name} armature", mass, np.zeros(3), armature * np.eye(3)
        name = machine.add(Link(*rotor, beside.position, beside.rotation, joint.where))
        machine.joints.append(Joint("", "fixed", child, name))
        if mass:
            machine.buoyancy[name] = 1.0
        notes.say("Armature of free joints, and of ball joints on the ground, is part of their bodies: {}.", joint.name)


def rigid(link: Link, notes: Notes) -> np.ndarray:
    """The inertia of a link, shape (3, 3), symmetric; a largest principal moment that exceeds the sum of the others by
    rounding is lowered to this sum.
    """
    inertia = 0.5 * (link.inertia + link.inertia.T)
    moments, axes = np.linalg.eigh(inertia)
    most = moments[0] + moments[1]
    if moments[0] <= 0 or not most < moments[2] <= most * (1 + _ROUNDED):
        return inertia
    notes.say(
        "Moments of inertia that exceed the sum of the other two by rounding, up to 5 %, are lowered to this sum: {}.",
        link.name,
    )
    return axes @ np.diag([*moments[:2], most]) @ axes.T
