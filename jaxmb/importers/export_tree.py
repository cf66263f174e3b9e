"""A spanning tree of a scene's joints, and the constraints that close loops."""

import dataclasses
import functools
import itertools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._types import Coordinates
from ..bodies import RigidBodySystem
from ..parts.base import GROUND, AbstractConstraint, AbstractInertialConstraint
from ..parts.combinations import JointCoupling
from ..parts.coordinate_parts import JointDriver, turns
from ..parts.spatial.axes import ElementaryJoint
from ..parts.spatial.kinematics import SPACE
from .description import rotation_of, unused
from .notes import Notes

# MuJoCo's name of the fixed world.
_WORLD = "world"
# The methods by which a class defines its laws.
_LAWS = {"residual", "coordinates", "wrenches", "energy", "state_rates", "length", "force"}


def numbers(values: Any) -> str:
    """Numbers as text, to the last digit."""
    return " ".join(repr(float(value)) for value in np.ravel(values))


def of_class(table: Mapping[type, Any], part: Any) -> Any:
    """The entry of a table for the class of a part, or for the class that defines its laws; None without one."""
    for cls in type(part).__mro__:
        if cls in table or _LAWS & vars(cls).keys():
            return table.get(cls)
    return None


@dataclasses.dataclass
class PlacedPart:
    """A part of the scene with concrete numbers.

    **Fields:** names of its `bodies`; the `poses` that it sees; the coordinates that it `acts_on`; values of its
    `scalars`, the scalar coordinates; the `names` used in the scene and the file.
    """

    name: str
    part: Any
    bodies: tuple[str, ...]
    poses: np.ndarray
    acts_on: tuple[str, ...]
    scalars: tuple[float, ...]
    names: set[str]

    @property
    def label(self) -> str:
        """The type and name of the part, for messages."""
        return f"{self.part.kind} {self.name!r}"

    @functools.cached_property
    def joints(self) -> list[ElementaryJoint] | None:
        """The part as hinges, slides and balls in succession; None if it is not such a joint."""
        is_known = isinstance(self.part, AbstractConstraint) and self.part.declares("elementary_joints", "coordinates")
        return jax.device_get(self.part.elementary_joints(SPACE, self.poses)) if is_known else None

    def named(self, word: str) -> str:
        """A name for an element of the file that the part needs."""
        return _new(f"{self.name} {word}", self.names)

    def point(self, k: int) -> np.ndarray:
        """The part's point on its k-th body, in the world [m]."""
        pose, point = self.poses[k], np.asarray((self.part.point_a, self.part.point_b)[k])
        return pose[:3] + rotation_of(pose[3:7]) @ point

    def turns(self, value: float, about: Any, k: int = 0) -> float:
        """The full turns [rad] by which a value exceeds the part's k-th coordinate, an angle wrapped to within half a
        turn of `about`.
        """
        return float(turns(jnp.asarray(value - about).reshape(()))) if self.part.is_periodic(k) else 0.0


@dataclasses.dataclass
class TreeBody:
    """A body of the tree, with its joints from the parent on, under their names in MuJoCo."""

    body: str
    parent: str
    joints: list[ElementaryJoint]


@dataclasses.dataclass
class Tree:
    """The bodies in order, parents first; the constraints that close loops, each with the name of the part, a tag and
    attributes; and for each coordinate, `"hip.angle"`, MuJoCo's joint. `scalars`: the scalar coordinates of the scene;
    `names` used in the scene and the file; `bodies`: MuJoCo's names of the bodies; `elements`: the XML elements of
    joints.
    """

    poses: dict[str, np.ndarray]
    scalars: np.ndarray
    names: set[str]
    bodies: dict[str, str]
    nodes: list[TreeBody] = dataclasses.field(default_factory=list)
    loops: list[Any] = dataclasses.field(default_factory=list)
    coordinates: dict[str, ElementaryJoint] = dataclasses.field(default_factory=dict)
    elements: dict[str, Any] = dataclasses.field(default_factory=dict)


def parts_of(system: RigidBodySystem, groups: Any, tree: Tree) -> list[PlacedPart]:
    """The parts of some groups, at the tree's poses and scalar coordinates."""
    # Scalar coordinates are not bodies; they are numbered after the bodies.
    names, out = dict(enumerate(system.body_names)) | {system.layout.ground: GROUND}, []
    for group in groups:
        for k, name in enumerate(group.group.names):
            single = group.group.single(k, jnp.zeros(()))
            bodies = tuple(names[body] for body in group.group.bodies[k] if body in names)
            values = tuple(
                float(tree.scalars[n - len(system.body_names)]) for n in group.group.bodies[k] if n not in names
            )
            places = np.stack([tree.poses[body] for body in bodies])
            places = np.asarray(single.seen_poses(SPACE, places))
            out.append(PlacedPart(name, single, bodies, places, _acts_on(group.group, single, k), values, tree.names))
    return out


def _acts_on(group, part, k):
    """The coordinates that a part acts on: stacked parts know their joints by index only."""
    names = [joints[k] for keys, joints in group.inner if len(keys) == 2 and keys[0] == "joints"]
    return tuple(f"{name}.{coordinate}" for name, coordinate in zip(names, getattr(part, "within", ()), strict=False))


def spanning_tree(system: RigidBodySystem, q: Coordinates, notes: Notes) -> Tree:
    """The tree of a system's bodies. Joints are taken in their order, but first all that cannot close a loop."""
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
    waiting = [p for p in parts if p.joints is not None and all(rotates.get(body, True) for body in p.bodies)]
    closing = [p for p in parts if p not in waiting]
    waiting.sort(key=lambda part: _closing(part) is not None)
    reached, left = {GROUND}, list(system.body_names)
    while left:
        part = next((p for p in waiting if len({*p.bodies} & reached) == 1), None)
        if part is None:
            body, joints = left[0], _free(left[0], tree, rotates[left[0]])
            tree.nodes.append(TreeBody(body, GROUND, joints))
        else:
            waiting.remove(part)
            parent, body = sorted(part.bodies, key=lambda body_name: body_name not in reached)
            tree.nodes.append(TreeBody(body, parent, _oriented(part, tree, body)))
        reached.add(body)
        left.remove(body)
    constraints = system.constraints
    for velocity in (*constraints.velocity, *constraints.servos, *constraints.nonideal):
        for name in velocity.group.names:
            if not notes.leaves_out("joints", name):
                notes.refused.append(f"{velocity.group.part.kind} {name!r} cannot be expressed.")
    for part in (*waiting, *closing):
        close = _closing(part)
        equalities = None if close is None else close(part, tree)
        if equalities is None:
            notes.refused.append(f"{part.label} cannot be expressed where it closes a loop.")
        else:
            tree.loops += [(part.name, *equality) for equality in equalities]
    return tree


def _new(name, names):
    """A new name, unused in the file, which is added to the names."""
    out = unused(name, names.__contains__)
    names.add(out)
    return out


def _bodies(system, names, notes):
    """MuJoCo's names of the bodies; a name is reserved for the fixed world."""
    out = {name: name for name in system.body_names}
    if _WORLD in out:
        out[_WORLD] = _new(f"{_WORLD} body", names)
        notes.say("Bodies have other names, since MuJoCo reserves these: {}.", f"{_WORLD} → {out[_WORLD]}")
    return out


def _free(body, tree, rotates):
    place, named = tree.poses[body], lambda word: _new(f"{body} {word}", tree.names)
    if rotates:
        return [ElementaryJoint("free", named("free"), place[:3], np.zeros(3), 0.0)]
    ways = zip("xyz", np.eye(3), strict=True)
    return [ElementaryJoint("slide", named(way), place[:3], axis, 0.0) for way, axis in ways]


def _oriented(part, tree, child):
    """A joint as joints of MuJoCo, from the parent to the child."""
    back, single = child == part.bodies[0], len(part.joints) == 1
    joints = []
    for elementary in part.joints:
        joint = elementary._replace(
            name=part.name if single else part.named(elementary.name),
            axis=-elementary.axis if back else elementary.axis,
        )
        tree.coordinates[f"{part.name}.{elementary.name}"] = joint
        joints.append(joint)
    return joints[::-1] if back else joints


# Loops


def _ends(part, tree):
    """Attributes that name the bodies, a moving body first, and the index of this body."""
    k = 0 if part.bodies[0] != GROUND else 1
    other = part.bodies[1 - k]
    return {"body1": tree.bodies[part.bodies[k]]} | ({} if other == GROUND else {"body2": tree.bodies[other]}), k


def _connect(part, tree, name, point):
    bodies, k = _ends(part, tree)
    place = tree.poses[part.bodies[k]]
    anchor = rotation_of(place[3:]).T @ (point - place[:3])
    return "connect", {"name": name, **bodies, "anchor": numbers(anchor)}


def _close_ball(part, tree):
    return [_connect(part, tree, part.name, part.point(1))]


def _close_hinge(part, tree):
    """Two points of the axis coincide."""
    (hinge,) = part.joints
    second = _connect(part, tree, part.named("axis"), hinge.point + hinge.axis)
    return [_connect(part, tree, part.name, hinge.point), second]


def _close_weld(part, tree):
    bodies, _ = _ends(part, tree)
    return [("weld", {"name": part.name, **bodies})]


def _close_coupling(part, tree):
    coupling = part.part
    joints = [tree.coordinates.get(name) for name in part.acts_on]
    if None in joints or coupling.coefficients.ndim > 1 or coupling.coefficients.size > 5:
        return None
    x, y = joints
    seen = y.value - float(coupling.other_zero)
    shift = np.polynomial.Polynomial([seen - part.turns(seen, 0.0, 1), 1.0])
    polynomial = np.polynomial.Polynomial(np.asarray(coupling.coefficients))(shift)
    powers = np.pad(polynomial.coef, (0, 5 - len(polynomial.coef)))
    powers[0] += float(coupling.zero) - x.value
    # The row is taken up to full turns of x as well.
    powers[0] -= part.turns(powers[0], 0.0)
    return [("joint", {"name": part.name, "joint1": x.name, "joint2": y.name, "polycoef": numbers(powers)})]


def _close_driver(part, tree):
    driver = part.part
    joint = tree.coordinates.get(part.acts_on[0])
    if joint is None or joint.kind == "ball" or np.any(np.asarray(driver.rate)):
        return None
    off = float(np.reshape(driver.value, -1)[0]) - joint.value
    constant = [off - part.turns(off, 0.0), *itertools.repeat(0.0, 4)]
    return [("joint", {"name": part.name, "joint1": joint.name, "polycoef": numbers(constant)})]


# How loops are closed, by the kinds of the joints in succession, and by the classes of parts on their coordinates.
_CLOSING_JOINTS = {("ball",): _close_ball, ("hinge",): _close_hinge, (): _close_weld}
_CLOSING_PARTS = {JointCoupling: _close_coupling, JointDriver: _close_driver}


def _closing(part):
    """The function that writes a part as equality constraints; None without one."""
    if part.joints is None:
        return of_class(_CLOSING_PARTS, part.part)
    return _CLOSING_JOINTS.get(tuple(joint.kind for joint in part.joints))
