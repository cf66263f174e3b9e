"""From the description of a machine to a scene."""

import dataclasses
import itertools
from typing import Any, NamedTuple, cast

import numpy as np

from ..bodies.scene import Scene
from ..linalg.rotations import from_matrix
from ..parts.actuators import Actuator
from ..parts.base import GROUND
from ..parts.combinations import FixedTendon, JointCoupling, JointInertia, Tendon
from ..parts.coordinate_parts import JointDriver, JointSpring, JointStop
from ..parts.dry_friction import JointFriction
from ..parts.forces import Damper, Gravity, PointForce, RotationalDamper
from ..parts.shapes import AbstractShape
from ..parts.spatial.bodies import Body
from ..parts.spatial.frames import Frame
from ..parts.spatial.joints import Fixed, Spherical
from . import chains
from .description import WORLD, Joint, Machine
from .fuse import Fused, fuse
from .light import rigid, with_rotors, without_ends
from .notes import Notes

# The time in which a compliant stop stops a joint [s], if the file gives none: MuJoCo's default.
STOP_TIME = 0.02
# The fraction of a joint's range over which a stop sets in.
_ROUNDING = 1e-3
# A loop is open as drawn if its ends are farther apart than this fraction of the machine's size, or this angle [rad].
_OPEN = 1e-6


class Scalar(NamedTuple):
    """A scalar coordinate of the scene: the `name` of the file's joint, or tendon if it is `of_tendon`; and whether it
    `moves`, see `ScalarCoordinate` of `jaxmb.parts`.
    """

    name: str
    of_tendon: bool = False
    moves: bool = True


@dataclasses.dataclass
class Built:
    """A scene, with the coordinates and the bodies of the file's joints and links.

    **Fields:** `coordinates`: for each joint the name of its coordinate, which has the file's values, or None;
    `controls`: for each actuator the name of its control; `fused`: the links as bodies; `scalars`: the scalar
    coordinates of the scene in order; `shapes` and `collision_shapes` of bodies by name.
    """

    scene: Scene
    coordinates: dict[str, str | None]
    controls: dict[str, str]
    fused: Fused
    scalars: list[Scalar]
    shapes: dict[str, tuple[AbstractShape, ...]]
    collision_shapes: dict[str, tuple[AbstractShape, ...]]


def build_scene(machine: Machine, notes: Notes) -> Built:
    """The scene of a machine. Unsupported elements are refused in `notes`, which the caller finishes."""
    left_out = without_ends(machine, notes)
    with_rotors(machine, notes)
    return _Builder(machine, notes, left_out).build()


class _Builder:
    def __init__(self, machine: Machine, notes: Notes, left_out: list[str]):
        self.machine, self.notes, self.left_out = machine, notes, left_out
        self.of_name = {joint.name: joint for joint in machine.joints if joint.kind != "fixed"}
        before = len(notes.refused)
        self.fused = fuse(machine, notes)
        self.unplaced = len(notes.refused) > before
        self.bodies: list[Any] = []
        self.joints: list[Any] = []
        self.forces: list[Any] = []
        self.frames: list[Any] = []
        self.coordinates: dict[str, str | None] = {}
        self.controls: dict[str, str] = {}
        self.scalars: list[Scalar] = []
        self.counted: dict[str, str] = {}
        self.names: set[str] = {GROUND}
        self.given = _names(machine)
        self.tendons: dict[str, str | None] = {}

    def build(self) -> Built:
        machine, none = self.machine, cast(Any, None)
        if self.unplaced:
            return Built(none, {}, {}, self.fused, [], {}, {})
        for carrier in self.fused.carriers.values():
            carrier.name = self._named(carrier.name, "link")
            self._body(carrier)
            if carrier.moved:
                self._moved(carrier)
        # Joints are named before other elements.
        for chain in self.fused.chains:
            self._chain(chain)
        for step in (self._loops, self._tendons, self._couplings, self._actuators, self._marks):
            step()
        for name, share in machine.buoyancy.items():
            self._buoyancy(name, share)
        if np.any(machine.gravity):
            self.forces.append(Gravity(machine.gravity, name=self._named("gravity")))
        if self.notes.refused or not self.bodies:
            if not self.fused.carriers:
                text = "There is no moving link (base='free' sets the root link of URDF free)."
                if self.left_out:
                    names = ", ".join(map(repr, self.left_out))
                    text += f" Massless links were left out: {names}. Give them an <inertial>."
                self.notes.refused.append(text)
            scene = none
        else:
            scene = Scene(self.bodies, joints=self.joints, forces=self.forces, frames=self.frames)
        collisions = self._of_bodies(machine.collisions)
        shapes = collisions | self._of_bodies(machine.shapes)
        return Built(scene, self.coordinates, self.controls, self.fused, self.scalars, shapes, collisions)

    def _named(self, name, kind=""):
        """A name that is unused in the scene: the file's, or a name that no other element of this kind has in the
        file.
        """
        plain = name.replace(".", "_") or kind
        tries = itertools.chain([plain, f"{plain} {kind}".strip()], (f"{plain} {k}" for k in itertools.count(2)))
        is_free = lambda each: each not in self.names and (each == name or each not in self.given.get(kind, ()))
        out = next(each for each in tries if is_free(each))
        self.names.add(out)
        if name and out != name:
            self.notes.say("Elements have other names, since names are unique in a scene: {}.", f"{name} → {out}")
        return out

    def _body(self, carrier):
        place = {"position": carrier.position, "orientation": from_matrix(carrier.rotation)}
        inertia = rigid(carrier, self.notes)
        try:
            body = Body(carrier.name, mass=carrier.mass, inertia=inertia, centre=carrier.centre, **place)
            body.check()
        except ValueError as error:
            self.notes.refused.append(f"{carrier.where}{error}")
        else:
            self.bodies.append(body)

    # Joints

    def _chain(self, chain):
        joints = chain.joints
        a, b = self.fused.placed(chain.parent), self.fused.placed(chain.child)
        name = self._named(" ".join(joint.name for joint in joints), "joint")
        try:
            result = chains.joint_of(joints, a, b, name)
        except ValueError as why:
            self.notes.refused.append(
                f"{joints[0].where}Joints in succession to {b.name!r} are degenerate, {why}: put a link with mass "
                "between them."
            )
            return
        if len(joints) > 1:
            listed = ", ".join(f"{joint.name!r}" for joint in joints)
            self.notes.say(f"Joints {listed} in succession are the {result.parts[0].kind} {name!r}.")
        if result.half_turn:
            self.notes.say(
                "The second of three hinges in succession is limited to half a turn, between the angles at which the "
                "three axes lie in one plane: {}.",
                result.half_turn,
            )
        self.joints += result.parts
        self.coordinates |= result.coordinates
        for joint in joints:
            self._passive(joint, a.name, b)

    def _moved(self, link):
        """A joint that prescribes the motion of a body."""
        place = {"point_a": link.position, "point_b": np.zeros(3), "orientation": from_matrix(link.rotation)}
        self.joints.append(Fixed(self._named(f"{link.name} motion"), GROUND, link.name, **place))

    def _passive(self, joint: Joint, a: str, b: chains.PlacedLink):
        """Springs, dampers, armature, friction and limits of a joint."""
        coordinate = self.coordinates[joint.name]
        wanted = {kind for kind in joint.passive if not self.notes.leaves_out(kind, joint.name)}
        if coordinate is None or joint.kind == "ball":
            self._of_ball(joint, a, b, coordinate, wanted)
            return
        if wanted & {"springs", "damping"}:
            self.forces.append(
                JointSpring(
                    self._named(f"{joint.name} spring"),
                    self._counted(joint.name, coordinate) if "springs" in wanted else coordinate,
                    stiffness=joint.stiffness if "springs" in wanted else 0.0,
                    damping=joint.damping if "damping" in wanted else 0.0,
                    free=joint.free,
                    middle=None if _near(joint, joint.free) else self._middle(joint.name),
                )
            )
        if "armature" in wanted:
            self._inertia(joint.name, coordinate, joint.armature)
        if "friction" in wanted:
            self._friction(joint.name, coordinate, joint.friction)
        if "limits" in wanted:
            inertia, time = joint.stop or (self.fused.moved_inertia(joint) + joint.armature, STOP_TIME)
            self._stop(joint.name, coordinate, joint.limits, inertia, time, turns=joint.kind == "hinge")

    def _counted(self, name, coordinate):
        """The coordinate of a joint for springs and servos: for a hinge without limits the length of a cord that it
        winds up, which counts full turns.
        """
        joint = self.of_name[name]
        if joint.kind != "hinge" or _range(joint) is not None:
            return coordinate
        if name not in self.counted:
            cord = self._named(f"{name} turns")
            self.joints.append(FixedTendon(cord, coordinate, coefficients=(1.0,)))
            self.scalars.append(Scalar(name, moves=False))
            self.counted[name] = f"{cord}.length"
        return self.counted[name]

    def _of_ball(self, joint, a, b, coordinate, wanted):
        if joint.kind == "free" and "damping" in wanted:
            origin = {"point_b": np.zeros(3)}
            self.forces.append(Damper(self._named(f"{joint.name} drag"), a, b.name, damping=joint.damping, **origin))
        if "damping" in wanted:
            self.forces.append(RotationalDamper(self._named(f"{joint.name} damper"), a, b.name, damping=joint.damping))
        if "springs" in wanted and joint.kind == "ball":
            free = np.zeros(3) if joint.free is None else joint.free
            self.forces.append(
                JointSpring(self._named(f"{joint.name} spring"), coordinate, stiffness=joint.stiffness, free=free)
            )
        left = wanted - {"damping"} - ({"springs"} if joint.kind == "ball" else set())
        for kind in sorted(left):
            self.notes.refuse(kind, joint.name, f"{joint.where}{kind} of the {joint.kind} joint {joint.name!r}")

    def _inertia(self, name, coordinate, armature, *, of_tendon=False):
        self.joints.append(JointInertia(self._named(f"{name} armature"), coordinate, inertia=armature))
        self.scalars.append(Scalar(name, of_tendon))

    def _friction(self, name, coordinate, force):
        self.forces.append(JointFriction(self._named(f"{name} friction"), coordinate, force=force))
        self.notes.say("Dry friction is force · tanh(rate / transition_speed), so that joints at rest creep: {}.", name)

    def _stop(self, name, coordinate, limits, inertia, time, *, turns):
        lower, upper = limits
        if turns and upper - lower >= 2 * np.pi:
            self.notes.say("Limits that allow more than a full turn are left out: {}.", name)
            return
        law: dict[str, Any] = {"stiffness": inertia / time**2, "damping": 2 * inertia / time}
        self.forces.append(
            JointStop(
                self._named(f"{name} stop"),
                coordinate,
                lower=lower,
                upper=upper,
                smoothing=_ROUNDING * (upper - lower),
                **law,
            )
        )
        self.notes.say(
            "Limits are compliant stops with the stiffness moved inertia / time², by default with time = "
            f"{STOP_TIME} s: {{}}.",
            name,
        )

    # Loops and couplings

    def _loops(self):
        for loop in self.machine.loops:
            if self.notes.leaves_out("loops", loop.name):
                continue
            (a, point_a), (b, point_b) = (
                self.fused.point(link, point)
                for link, point in ((loop.link_a, loop.point_a), (loop.link_b, loop.point_b))
            )
            if a == b:
                self.notes.say("Loops between links that are already fixed to each other are left out: {}.", loop.name)
                continue
            self._say_if_open(loop)
            name = self._named(loop.name, "loop")
            if loop.rotation is None:
                self.joints.append(Spherical(name, a, b, point_a=point_a, point_b=point_b))
            else:
                turn_a, turn_b = self.fused.rotation(loop.link_a), self.fused.rotation(loop.link_b)
                attitude = from_matrix(turn_a @ loop.rotation @ turn_b.T)
                self.joints.append(Fixed(name, a, b, point_a=point_a, point_b=point_b, orientation=attitude))

    def _say_if_open(self, loop):
        """Note a loop that does not close in the file's pose."""
        a, b = self.fused.links[loop.link_a], self.fused.links[loop.link_b]
        ends = [link.position + link.rotation @ at for link, at in ((a, loop.point_a), (b, loop.point_b))]
        off = np.zeros((3, 3)) if loop.rotation is None else a.rotation @ loop.rotation - b.rotation
        gap, angle = np.linalg.norm(ends[1] - ends[0]), 2 * np.arcsin(min(np.linalg.norm(off) / np.sqrt(8), 1.0))
        size = max(float(np.linalg.norm(link.position)) for link in self.fused.links.values())
        shown = [f"{gap:.3g} m"] * bool(gap > _OPEN * max(size, np.linalg.norm(ends))) + [f"{angle:.3g} rad"] * bool(
            angle > _OPEN
        )
        if shown:
            self.notes.say(
                "Loops are open as drawn, and assemble moves the bodies to close them: {}.",
                f"{loop.name} by {' and '.join(shown)}",
            )

    def _couplings(self):
        for coupling in self.machine.couplings:
            if self.notes.leaves_out("couplings", coupling.name):
                continue
            table = self.tendons if coupling.of_tendons else self.coordinates
            ends = coupling.joint, *(other for other, _, _ in coupling.others)
            resolved = [self._coordinate(end, "couplings", coupling.name, table) for end in ends]
            names = [name for name in resolved if name is not None]
            if len(names) < len(ends):
                continue
            name = self._named(coupling.name, "coupling")
            if len(ends) == 1:
                self.joints.append(JointDriver(name, names[0], value=coupling.zero + coupling.constant))
                continue
            size = max(len(np.trim_zeros(powers, "b")) for _, powers, _ in coupling.others)
            coefficients = np.zeros((len(coupling.others), 1 + size))
            coefficients[0, 0] = coupling.constant
            for row, (_, powers, _) in zip(coefficients, coupling.others, strict=True):
                row[1 : 1 + len(powers)] = powers[:size]
            zeros = [zero for _, _, zero in coupling.others]
            numbers: dict[str, Any] = {"coefficients": coefficients, "other_zero": zeros}
            if len(ends) == 2:
                numbers = {field: values[0] for field, values in numbers.items()}
            self.joints.append(
                JointCoupling(name, coordinate=names[0], other=tuple(names[1:]), zero=coupling.zero, **numbers)
            )
            for other, powers, zero in coupling.others:
                if not coupling.of_tendons and not self._turns_without_end(coupling.joint, powers):
                    self._seen_up_to_half_a_turn(other, coupling.name, zero)

    def _turns_without_end(self, joint, powers):
        """Whether full turns of another hinge give full turns of a joint."""
        return self.of_name[joint].kind == "hinge" and not np.any(powers[1:]) and float(powers[0]).is_integer()

    def _coordinate(self, what, kind, of, table=None):
        """The coordinate of a joint, or of another element in `table`."""
        name = (self.coordinates if table is None else table).get(what)
        if name is None:
            self.notes.refuse(kind, of, f"{of!r} acts on {what!r}, which has no coordinate")
        return name

    # Tendons and actuators

    def _tendons(self):
        for tendon in self.machine.tendons:
            if self.notes.leaves_out("tendons", tendon.name):
                continue
            if tendon.points:
                name = self._named(tendon.name, "tendon")
                self.joints.append(Tendon(name, [self.fused.point(link, point) for link, point in tendon.points]))
            else:
                along = [self._coordinate(joint, "tendons", tendon.name) for joint, _ in tendon.joints]
                if None in along:
                    continue
                name = self._named(tendon.name, "tendon")
                hinges = [joint for joint, _ in tendon.joints if self.of_name[joint].kind == "hinge"]
                self.scalars += [Scalar(joint, moves=False) for joint in hinges]
                self.joints.append(FixedTendon(name, along, coefficients=[c for _, c in tendon.joints]))
            self.tendons[tendon.name] = f"{name}.length"
            self._of_tendon(tendon, f"{name}.length")

    def _of_tendon(self, tendon, coordinate):
        if tendon.stiffness or tendon.damping:
            numbers: dict[str, Any] = {
                "stiffness": tendon.stiffness,
                "damping": tendon.damping,
                "free": tendon.free,
            }
            self.forces.append(JointSpring(self._named(f"{tendon.name} spring"), coordinate, **numbers))
        if tendon.armature and not self.notes.leaves_out("armature", tendon.name):
            self._inertia(tendon.name, coordinate, tendon.armature, of_tendon=True)
        if tendon.friction and not self.notes.leaves_out("friction", tendon.name):
            self._friction(tendon.name, coordinate, tendon.friction)
        if tendon.limits is not None and not self.notes.leaves_out("limits", tendon.name):
            inertia, time = tendon.stop or (1.0, STOP_TIME)
            self._stop(tendon.name, coordinate, tendon.limits, inertia, time, turns=False)

    def _actuators(self):
        for actuator in self.machine.actuators:
            if self.notes.leaves_out("actuators", actuator.name):
                continue
            table = self.tendons if actuator.on_tendon else self.coordinates
            coordinate = self._coordinate(actuator.of, "actuators", actuator.name, table)
            if coordinate is None:
                continue
            if not actuator.on_tendon and (actuator.gain[1] or actuator.bias[1]):
                coordinate = self._counted(actuator.of, coordinate)
            ranges = {name: getattr(actuator, name) for name in ("control_range", "force_range")}
            name = self._named(actuator.name, "actuator")
            self.controls[actuator.name] = f"{name}.control"
            self.forces.append(
                Actuator(
                    name,
                    coordinate,
                    control=actuator.control,
                    gear=actuator.gear,
                    gain=actuator.gain,
                    bias=actuator.bias,
                    middle=0.0 if actuator.on_tendon else self._middle(actuator.of),
                    lag=actuator.lag,
                    **ranges,
                )
            )
            if any(given is not None for given in ranges.values()):
                self.notes.say(
                    "Controls or forces are clipped to their ranges; at the ends of the ranges the motion has kinks "
                    "and steps are short: {}.",
                    actuator.name,
                )

    def _middle(self, name):
        """The middle of a hinge's range, about which its angle is wrapped; zero without limits."""
        joint = self.of_name[name]
        limits = _range(joint)
        return 0.0 if limits is None or joint.kind != "hinge" else 0.5 * (limits[0] + limits[1])

    def _seen_up_to_half_a_turn(self, name, of, zero=0.0):
        """Add a note if a coupled joint's angle may go beyond half a turn from its zero, which couplings do not see."""
        joint = self.of_name[name]
        if joint.kind == "hinge" and (_range(joint) is None or not _near(joint, zero)):
            self.notes.say("Couplings see angles of hinges only up to half a turn from their zeros: {}.", of)

    # Frames, weights and pictures

    def _marks(self):
        for name, (carrier, position, rotation) in self.fused.frames().items():
            place = {"position": position, "orientation": from_matrix(rotation)}
            self.frames.append(Frame(self._named(name, "link"), carrier, **place))
        for mark in self.machine.marks:
            carrier, position = self.fused.point(mark.link, mark.position)
            rotation = self.fused.rotation(mark.link) @ mark.rotation
            place = {"position": position, "orientation": from_matrix(rotation)}
            self.frames.append(Frame(self._named(mark.name, "frame"), carrier, **place))

    def _buoyancy(self, name, share):
        link = self.machine.links[name]
        carrier, centre = self.fused.point(name, link.centre)
        if self.fused.of[name] is not WORLD:
            force = -share * link.mass * self.machine.gravity
            self.forces.append(PointForce(self._named(f"{name} buoyancy"), carrier, force=force, point=centre))
            self.notes.say(
                "Weight is compensated by constant forces, which do not follow a change of gravity: {}.", name
            )

    def _of_bodies(self, shapes):
        """Shapes of links by the name of their body."""
        out: dict[str, tuple[AbstractShape, ...]] = {}
        for link, shape in shapes:
            body, position = self.fused.point(link, np.zeros(3))
            placed = shape.moved(position, from_matrix(self.fused.rotation(link)))
            out[body] = (*out.get(body, ()), placed)
        return out


def _names(machine: Machine):
    """The names in a file, by kinds of elements."""
    elements = {
        "link": machine.links.values(),
        "joint": machine.joints,
        "loop": machine.loops,
        "coupling": machine.couplings,
        "tendon": machine.tendons,
        "actuator": machine.actuators,
        "frame": machine.marks,
    }
    return {kind: {element.name for element in of_kind} for kind, of_kind in elements.items()}


def _range(joint: Joint):
    """The limits of a joint; None for a hinge whose limits allow a full turn."""
    limits = joint.limits
    return None if limits is None or (joint.kind == "hinge" and limits[1] - limits[0] >= 2 * np.pi) else limits


def _near(joint: Joint, zero: Any):
    """Whether no limits of a hinge let it go beyond half a turn from a zero."""
    limits = _range(joint)
    return joint.kind != "hinge" or limits is None or max(abs(limit - zero) for limit in limits) <= np.pi
