"""A spanning tree of a scene's joints, and the constraints that close loops."""

import dataclasses
import itertools
from typing import Any
from xml.etree import ElementTree

import jax.numpy as jnp
import numpy as np

from .._types import Coordinates
from ..bodies import RigidBodySystem
from ..parts.base import GROUND, AbstractInertialConstraint
from ..parts.coordinate_parts import turns
from ..parts.spatial.composite import coordinate_names
from ..parts.spatial.kinematics import SPACE
from .description import rotation_of, turn_about, unused
from .notes import Notes

# What MuJoCo calls the fixed world.
_WORLD = "world"


def numbers(values: Any) -> str:
    """Numbers as text, to the last digit."""
    return " ".join(repr(float(value)) for value in np.ravel(values))


@dataclasses.dataclass
class PlacedPart:
    """A part of the scene with concrete numbers, the names of its bodies, the poses that it sees, the coordinates of
    joints that it acts on, the values of its scalar coordinates, and the names in the scene and the file.
    """

    name: str
    kind: str
    part: Any
    bodies: tuple[str, ...]
    poses: np.ndarray
    acts_on: tuple[str, ...]
    scalars: tuple[float, ...]
    names: set[str]

    def named(self, word: str) -> str:
        """A name for an element of the file that the part needs."""
        return _new(f"{self.name} {word}", self.names)

    def point(self, k: int) -> np.ndarray:
        """The part's point on its k-th body, in the world [m]."""
        pose, point = self.poses[k], np.asarray((self.part.point_a, self.part.point_b)[k])
        return pose[:3] + rotation_of(pose[3:7]) @ point

    def direction(self, field: str, k: int = 0) -> np.ndarray:
        """A direction of the part that is fixed in its k-th body, in the world."""
        return rotation_of(self.poses[k][3:7]) @ np.asarray(getattr(self.part, field))

    def is_periodic(self, k: int = 0) -> bool:
        """Whether the k-th coordinate that the part acts on is an angle known up to full turns."""
        return self.acts_on[k].partition(".")[2] in self.part.joints[str(k)].periodic

    def turns(self, value: float, about: Any, k: int = 0) -> float:
        """By how many full turns [rad] a value of its k-th coordinate is ahead of the one that the part sees, of an
        angle the one within half a turn of another.
        """
        return float(turns(jnp.asarray(value - about).reshape(()))) if self.is_periodic(k) else 0.0

    def coordinates(self) -> dict[str, np.ndarray]:
        found = self.part.coordinates(SPACE, jnp.asarray(self.poses))
        return {name: np.asarray(value) for name, value in found.items()}


@dataclasses.dataclass
class TreeJoint:
    """A joint of MuJoCo: its name, type, point and axis in the world, and its value."""

    name: str
    type: str
    point: np.ndarray
    axis: np.ndarray
    value: float = 0.0


@dataclasses.dataclass
class TreeBody:
    """A body of the tree, with its joints from the parent on."""

    body: str
    parent: str
    joints: list[TreeJoint]


@dataclasses.dataclass
class LoopEqualities:
    """Equality constraints: tags, each with its attributes."""

    name: str
    equalities: Any

    def write(self, section: Any) -> None:
        for tag, attributes in self.equalities:
            ElementTree.SubElement(section, tag, attrib=attributes)


@dataclasses.dataclass
class Tree:
    """The bodies in order, parents first; the constraints that close loops; and for each coordinate, `"hip.angle"`, the
    name of MuJoCo's joint. `scalars`: the scalar coordinates of the scene; `names`: those of the scene and of elements
    that have none there; `bodies`: what MuJoCo calls the bodies; `elements`: the XML elements of joints.
    """

    poses: dict[str, np.ndarray]
    scalars: np.ndarray
    names: set[str]
    bodies: dict[str, str]
    nodes: list[TreeBody] = dataclasses.field(default_factory=list)
    loops: list[LoopEqualities] = dataclasses.field(default_factory=list)
    coordinates: dict[str, TreeJoint] = dataclasses.field(default_factory=dict)
    elements: dict[str, Any] = dataclasses.field(default_factory=dict)

    def place(self, body: str) -> np.ndarray:
        """The pose of a body."""
        return self.poses[body]


def parts_of(system: RigidBodySystem, groups: Any, tree: Tree) -> list[PlacedPart]:
    """The parts of some groups, where the tree has the bodies and the scalar coordinates."""
    # Scalar coordinates are no bodies; their numbers are those after the bodies'.
    names, out = dict(enumerate(system.body_names)) | {system.layout.ground: GROUND}, []
    for group in groups:
        for k, name in enumerate(group.group.names):
            own = group.group.single(k, jnp.zeros(()))
            bodies = tuple(names[body] for body in group.group.bodies[k] if body in names)
            values = tuple(
                float(tree.scalars[n - len(system.body_names)]) for n in group.group.bodies[k] if n not in names
            )
            places = np.stack([tree.poses[body] for body in bodies])
            places = np.asarray(own.seen_poses(SPACE, places))
            out.append(
                PlacedPart(name, own.kind, own, bodies, places, _acts_on(group.group, own, k), values, tree.names)
            )
    return out


def _acts_on(group, part, k):
    """The coordinates that a part acts on: stacked parts know their joints by number only."""
    within = getattr(part, "within", ())
    within = (within,) if isinstance(within, str) else within
    names = [own[k] for keys, own in group.inner if len(keys) == 2 and keys[0] == "joints"]
    return tuple(f"{name}.{own}" for name, own in zip(names, within, strict=False))


def spanning_tree(system: RigidBodySystem, q: Coordinates, notes: Notes) -> Tree:
    """The tree of a system's bodies. Joints are taken in their order, those that cannot close a loop before others."""
    poses = np.asarray(system.poses(q))
    scalars = np.asarray(system.bodies.prepared_poses(q))[len(poses) : -1, 0]
    places = dict(zip(system.body_names, poses, strict=True)) | {GROUND: np.array([0.0, 0, 0, 1, 0, 0, 0])}
    groups = (*system.measured, *system.forces.groups, *system.frames)
    names = {*system.body_names, *(name for group in groups for name in group.group.names)}
    tree = Tree(places, scalars, names, _bodies(system, names, notes))
    parts = [
        p
        for p in parts_of(system, (*system.constraints.position, *system.free_joints), tree)
        if not isinstance(p.part, AbstractInertialConstraint) and not notes.leaves_out("joints", p.name)
    ]
    rotates = dict(zip(system.body_names, system.layout.rotates, strict=True))
    waiting = [p for p in parts if p.kind in _JOINTS and all(rotates.get(body, True) for body in p.bodies)]
    closing = [p for p in parts if p not in waiting]
    waiting.sort(key=lambda part: part.kind in _CLOSING)
    reached, left = {GROUND}, list(system.body_names)
    while left:
        part = next((p for p in waiting if len({*p.bodies} & reached) == 1), None)
        if part is None:
            body, joints = left[0], _free(left[0], tree, rotates[left[0]])
            tree.nodes.append(TreeBody(body, GROUND, joints))
        else:
            waiting.remove(part)
            parent, body = sorted(part.bodies, key=lambda own: own not in reached)
            tree.nodes.append(TreeBody(body, parent, _oriented(part, tree, body)))
        reached.add(body)
        left.remove(body)
    constraints = system.constraints
    for velocity in (*constraints.velocity, *constraints.servos, *constraints.nonideal):
        for name in velocity.group.names:
            if not notes.leaves_out("joints", name):
                notes.refused.append(f"{velocity.group.part.kind} {name!r} cannot be expressed.")
    for part in (*waiting, *closing):
        equalities = _CLOSING.get(part.kind, lambda *_: None)(part, tree)
        if equalities is None:
            notes.refused.append(f"{part.kind} {part.name!r} cannot be expressed where it closes a loop.")
        else:
            tree.loops.append(LoopEqualities(part.name, equalities))
    return tree


def _new(name, names):
    """A name that no element of the file has, to be one of them."""
    out = unused(name, names.__contains__)
    names.add(out)
    return out


def _bodies(system, names, notes):
    """What MuJoCo calls the bodies: it keeps one name for the fixed world."""
    out = {name: name for name in system.body_names}
    if _WORLD in out:
        out[_WORLD] = _new(f"{_WORLD} body", names)
        notes.say("Bodies have other names, since MuJoCo has these: {}.", f"{_WORLD} → {out[_WORLD]}")
    return out


def _free(body, tree, rotates):
    place, named = tree.place(body), lambda word: _new(f"{body} {word}", tree.names)
    if rotates:
        return [TreeJoint(named("free"), "free", place[:3], np.zeros(3))]
    return [TreeJoint(named(way), "slide", place[:3], axis) for way, axis in zip("xyz", np.eye(3), strict=True)]


def _oriented(part, tree, child):
    """The joints of MuJoCo that a joint is, from the parent to the child."""
    found = _JOINTS[part.kind](part)
    for coordinate, joint in found:
        tree.coordinates[coordinate] = joint
    joints = [joint for _, joint in found]
    if child == part.bodies[0]:
        for joint in joints:
            joint.axis = -joint.axis
        joints.reverse()
    return joints


def _hinges(part, **axes):
    """Joints by the names of their coordinates, each with its type and its axis in the world."""
    values, out = part.coordinates(), []
    for field, (kind, axis) in axes.items():
        name = part.name if len(axes) == 1 else part.named(field)
        joint = TreeJoint(name, kind, part.point(1), axis, float(values[field].reshape(-1)[0]))
        out.append((f"{part.name}.{field}", joint))
    return out


# The types of the joints that a part has about axes of its own, by the names of its coordinates, each with the axis and
# the number of the body that this is fixed in.
_OWN_AXES = {
    "Revolute": {"angle": ("hinge", "axis_a", 0)},
    "Prismatic": {"displacement": ("slide", "axis_a", 0)},
    "Cylindrical": {"displacement": ("slide", "axis_a", 0), "angle": ("hinge", "axis_a", 0)},
    "Universal": {"angle_a": ("hinge", "axis_a", 0), "angle_b": ("hinge", "axis_b", 1)},
}


def _about_own_axes(part):
    return _hinges(part, **{name: (kind, part.direction(*at)) for name, (kind, *at) in _OWN_AXES[part.kind].items()})


def _gimbal(part):
    own = part.part
    values = part.coordinates()
    first, second = np.asarray(own.axis_1), np.asarray(own.axis_2)
    to_world, angle = rotation_of(part.poses[0][3:7]), float(values["angle_1"])
    axis_2 = np.cos(angle) * second + np.sin(angle) * np.cross(first, second)
    back = rotation_of(np.asarray(own.orientation)).T @ np.asarray(own.axis_3)
    return _hinges(
        part,
        angle_1=("hinge", to_world @ first),
        angle_2=("hinge", to_world @ axis_2),
        angle_3=("hinge", rotation_of(part.poses[1][3:7]) @ back),
    )


def _composite(part):
    """From the first joint on, which is fixed in A, each where the coordinates of those before it put it."""
    own, values, out = part.part, part.coordinates(), []
    start = np.asarray(own.point_a)
    points = itertools.repeat(start) if own.points is None else iter(np.asarray(own.points))
    place, turn = part.poses[0][:3], rotation_of(part.poses[0][3:7])
    for word, axis, field in zip(own.sequence, np.asarray(own.axes), coordinate_names(own.sequence), strict=True):
        value, point = values[field], next(points) if word == "hinge" else start
        joint = TreeJoint(part.named(field), word, place + turn @ point, turn @ axis)
        if word == "ball":
            size = float(np.linalg.norm(value))
            axis, angle = (value / size, size) if size > 0 else (axis, 0.0)
        else:
            joint.value = angle = float(value)
        if word == "slide":
            place = place + turn @ (joint.value * axis)
        else:
            own_turn = turn_about(axis, angle)
            place, turn = place + turn @ (point - own_turn @ point), turn @ own_turn
        out.append((f"{part.name}.{field}", joint))
    return out


def _spherical(part):
    return [(f"{part.name}.rotation", TreeJoint(part.name, "ball", part.point(1), np.zeros(3)))]


def _planar(part):
    axis, x = part.direction("axis_a"), part.direction("x_a")
    values = part.coordinates()
    ways = zip("xy", (x, np.cross(axis, x)), values["displacement"], strict=True)
    slides = [TreeJoint(part.named(w), "slide", part.point(1), a, float(v)) for w, a, v in ways]
    hinge = TreeJoint(part.named("angle"), "hinge", part.point(1), axis, float(values["angle"]))
    # Nothing acts on one of the two displacements.
    own = {f"{part.name}.displacement {way}": slide for way, slide in zip("xy", slides, strict=True)}
    return [*own.items(), (f"{part.name}.angle", hinge)]


_JOINTS = {
    **dict.fromkeys(_OWN_AXES, _about_own_axes),
    "Gimbal": _gimbal,
    "Composite": _composite,
    "Spherical": _spherical,
    "Planar": _planar,
    "Fixed": lambda part: [],
}


# Loops


def _ends(part, tree):
    """Attributes that name the bodies, a moving one first, and the number of that."""
    k = 0 if part.bodies[0] != GROUND else 1
    other = part.bodies[1 - k]
    return {"body1": tree.bodies[part.bodies[k]]} | ({} if other == GROUND else {"body2": tree.bodies[other]}), k


def _connect(part, tree, name, point):
    bodies, k = _ends(part, tree)
    place = tree.place(part.bodies[k])
    anchor = rotation_of(place[3:]).T @ (point - place[:3])
    return "connect", {"name": name, **bodies, "anchor": numbers(anchor)}


def _close_spherical(part, tree):
    return [_connect(part, tree, part.name, part.point(1))]


def _close_revolute(part, tree):
    """Two points of the axis coincide."""
    point = part.point(1)
    second = point + part.direction("axis_a")
    return [_connect(part, tree, part.name, point), _connect(part, tree, part.named("axis"), second)]


def _close_fixed(part, tree):
    bodies, _ = _ends(part, tree)
    return [("weld", {"name": part.name, **bodies})]


def _close_coupling(part, tree):
    own = part.part
    joints = [tree.coordinates.get(name) for name in part.acts_on]
    if None in joints or own.coefficients.ndim > 1 or own.coefficients.size > 5:
        return None
    x, y = joints
    seen = y.value - float(own.other_zero)
    shift = np.polynomial.Polynomial([seen - part.turns(seen, 0.0, 1), 1.0])
    polynomial = np.polynomial.Polynomial(np.asarray(own.coefficients))(shift)
    powers = np.pad(polynomial.coef, (0, 5 - len(polynomial.coef)))
    powers[0] += float(own.zero) - x.value
    # The row is taken up to full turns of x as well.
    powers[0] -= part.turns(powers[0], 0.0)
    return [("joint", {"name": part.name, "joint1": x.name, "joint2": y.name, "polycoef": numbers(powers)})]


def _close_driver(part, tree):
    own = part.part
    joint = tree.coordinates.get(part.acts_on[0])
    if joint is None or joint.type == "ball" or np.any(np.asarray(own.rate)):
        return None
    off = float(np.reshape(own.value, -1)[0]) - joint.value
    constant = [off - part.turns(off, 0.0), *itertools.repeat(0.0, 4)]
    return [("joint", {"name": part.name, "joint1": joint.name, "polycoef": numbers(constant)})]


_CLOSING = {
    "Spherical": _close_spherical,
    "Revolute": _close_revolute,
    "Fixed": _close_fixed,
    "JointCoupling": _close_coupling,
    "JointDriver": _close_driver,
}
