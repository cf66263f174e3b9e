"""Every joint with the motions that it admits, every driver, rolling constraint and force, in the plane and in space.

What their kernels return is computed in NumPy as far as it goes, and once for all tests.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from jaxmb import planar, sections, spatial
from jaxmb.parts import AbstractCompound, AbstractVelocityConstraint, contact, terrain
from jaxmb.parts.planar.kinematics import PLANE
from jaxmb.parts.spatial.kinematics import SPACE

SPACES = {"planar": PLANE, "spatial": SPACE}
# Points of A and of B; in the plane their first two numbers.
POINTS = {2: ((0.1, -0.2), (0.4, 0.3)), 3: ((0.1, -0.2, 0.3), (0.4, 0.1, -0.2))}
RATIO, RADIUS, PITCH = -0.4, 0.3, -0.3
# Of beams.
SECTIONS = {
    "planar": sections.Section(bending_stiffness=4.0, axial_stiffness=30.0, shear_stiffness=20.0),
    "spatial": sections.Rectangle(thickness=0.5, width=0.8, modulus=90.0, poisson_ratio=0.3),
}
# A joint is given in one of these ways in the world, which `resolve` turns into numbers fixed in its bodies.
IN_THE_WORLD = ("point", "axes_W", "points_W", "axis", "axis_a_W", "axis_b_W", "axis_1_W", "axis_2_W", "axis_3_W")


# Poses


def random_poses(rng, space, count=2):
    poses = rng.normal(size=(count, space.pose_size))
    if space is SPACE:
        poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    return poses


def random_unit(rng, size=3):
    v = rng.normal(size=size)
    return v / np.linalg.norm(v)


def across(axis, other=(0.3, -0.5, 0.8)):
    """Two unit vectors that make a right-handed triad with `axis`."""
    u = np.cross(axis, other)
    u = u / np.linalg.norm(u)
    return u, np.cross(axis, u)


def turn(axis, angle):
    return np.append(np.cos(angle / 2), np.sin(angle / 2) * axis)


def turn_3(x):
    """Turn by a rotation vector."""
    return turn(x / np.linalg.norm(x), np.linalg.norm(x))


def turned_2d(angle, v):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * v[0] - s * v[1], s * v[0] + c * v[1]])


def rotated(p, v):
    """A vector turned by Euler parameters."""
    return v + 2 * (p[0] * np.cross(p[1:], v) + np.cross(p[1:], np.cross(p[1:], v)))


def product(a, b):
    return np.append(a[0] * b[0] - a[1:] @ b[1:], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))


def move(pose, turned, centre, shift=0.0):
    """The body turned about a world point, by an angle or by Euler parameters, then shifted."""
    if pose.shape == (3,):
        return np.append(centre + turned_2d(turned, pose[:2] - centre) + shift, pose[2] + turned)
    return np.append(centre + rotated(turned, pose[:3] - centre) + shift, product(turned, pose[3:]))


def with_b(q, pose):
    return np.stack([q[0], pose])


def net_wrench(poses, wrenches):
    """Resultant force and moment about the world origin, in NumPy."""
    poses, wrenches = np.asarray(poses), np.asarray(wrenches)
    if poses.shape[1] == 3:
        moments = poses[:, 0] * wrenches[:, 1] - poses[:, 1] * wrenches[:, 0] + wrenches[:, 2]
        return np.array([*np.sum(wrenches[:, :2], axis=0), np.sum(moments)])
    moments = [np.cross(q[:3], w[:3]) + rotated(q[3:], w[3:]) for q, w in zip(poses, wrenches, strict=True)]
    return np.concatenate([np.sum(wrenches[:, :3], axis=0), np.sum(moments, axis=0)])


# Joints


@dataclasses.dataclass
class Case:
    """A joint that holds at given poses, and the motions of its bodies that it admits.

    `build(point, axis, second)` with a random point and two random directions across each other in the world;
    `motion(q, point, axis, second, x)` is a function of as many numbers as the joint leaves free, or of `numbers`.
    """

    rows: int
    build: Callable
    motion: Callable
    bodies: int = 2
    freedoms: int | None = None
    numbers: int | None = None


def world(cls, **options):
    return lambda point, axis, second: cls("J", "a", "b", point=point, axis=axis, **options)


def at_point(cls):
    return lambda point, axis, second: cls("J", "a", "b", point=point)


def between_points(cls, **options):
    def build(point, axis, second):
        a, b = POINTS[len(point)]
        return cls("J", "a", "b", point_a=a, point_b=b, **options)

    return build


def of_b(motion):
    """The poses of both bodies from a motion of B."""
    return lambda q, *args: with_b(q, motion(q[1], *args))


def along(axis, x):
    u, v = across(axis)
    return x[0] * u + x[1] * v


def on_link(q, point, axis, second, x):
    """B turned about its own end of the rod, then the rod about its other end."""
    space = PLANE if q.shape[1] == 3 else SPACE
    A, B = (space.point(pose, np.array(s)) for pose, s in zip(q, POINTS[space.dimension], strict=True))
    if space is PLANE:
        return with_b(q, move(move(q[1], x[0], B), x[1], A))
    u, v = across((B - A) / np.linalg.norm(B - A))
    return with_b(q, move(move(q[1], turn_3(x[2:]), B), product(turn(u, x[0]), turn(v, x[1])), A))


def bent(q, point, axis, second, x):
    """B turned about A by half of a turn, and then about its own end by the other half."""
    space = PLANE if q.shape[1] == 3 else SPACE
    s, t = POINTS[space.dimension]
    half = x[0] / 2 if space is PLANE else turn_3(x / 2)
    moved = move(q[1], half, space.point(q[0], np.array(s)))
    return with_b(q, move(moved, half, space.point(moved, np.array(t))))


def on_circle(q, point, axis, second, x):
    B = PLANE.point(q[1], np.array(POINTS[2][1]))
    return with_b(q, move(move(q[1], x[0], B), x[1], q[0, :2]))


def circle(point, p):
    """About the origin of A through the point of B."""
    return jnp.dot(point, point) - p["radius"] ** 2


def meshed(q, point, axis, second, x):
    """The gear A turned by x[0] on the carrier C, and everything else that the gears leave free."""
    angles = np.array([q[0, 2] + x[0] + x[3], q[1, 2] + RATIO * x[0] + x[3], q[2, 2] + x[3]])
    return np.column_stack([(q + x[1:].reshape(3, 3))[:, :2], angles])


def on_rack(q, point, axis, second, x):
    """The rack turned and shifted, the pinion along with it, off it, and turned while it travels."""
    turned, shift, spin, off = x[0], x[1:3], x[3], x[4]
    ahead = turned_2d(q[1, 2], axis)
    travel = -RADIUS * spin * ahead + off * np.array([-ahead[1], ahead[0]])
    pinion = move(q[0], spin, PLANE.point(q[0], np.array(POINTS[2][0])), travel)
    return np.stack([move(body, turned, np.zeros(2), shift) for body in (pinion, q[1])])


def on_thread(b, point, axis, second, x):
    """Through several turns."""
    angle = 20.0 * x[0]
    return move(b, turn(axis, angle), point, PITCH * angle / (2 * np.pi) * axis)


# Directions that are neither parallel nor perpendicular, and points of hinges that do not meet.
AXES = np.array([[0.6, 0.0, 0.8], [0.36, 0.8, -0.48], [-0.48, 0.36, 0.8], [0.8, 0.6, 0.0], [0.0, 1.0, 0.0]])
APART = np.array([[0.1, 0.2, -0.1], [-0.2, 0.1, 0.3], [0.3, -0.1, 0.1]])


def slid(pose, shift):
    return np.append(pose[:3] + shift, pose[3:])


def composite(*sequence):
    """A joint, and the motion of B that its hinges and slides make, one after the other from the last to the first."""
    hinges, axes = sequence.count("hinge"), AXES[: len(sequence)]

    def build(point, axis, second):
        return spatial.Composite("J", "a", "b", sequence=sequence, axes_W=axes, points_W=APART[:hinges], point=point)

    def motion(pose, point, axis, second, x):
        k = hinges
        for word, own, value in reversed([*zip(sequence, axes, x, strict=True)]):
            k -= word == "hinge"
            pose = move(pose, turn(own, value), APART[k]) if word == "hinge" else slid(pose, value * own)
        return pose

    return Case(6 - len(sequence), build, of_b(motion))


def gimbal(point, axis, second):
    third = np.cross(axis, second)
    return spatial.Gimbal("J", "a", "b", point=point, axis_1_W=axis, axis_2_W=second, axis_3_W=third)


def cardan(point, axis, second):
    return spatial.Universal("J", "a", "b", point=point, axis_a_W=axis, axis_b_W=second)


def ring(point, axis, second):
    return planar.PointOnCurve("J", "a", "b", circle, point_b=POINTS[2][1], parameters={"radius": second})


def gears(point, axis, second):
    return planar.Gear("J", "a", "b", ratio=RATIO, carrier="c")


def rack(point, axis, second):
    return planar.RackAndPinion("J", "a", "b", radius=RADIUS, axis_b=axis, point_a=POINTS[2][0], point_b=POINTS[2][1])


JOINTS = {
    "planar": {
        "Revolute": Case(2, at_point(planar.Revolute), of_b(lambda b, p, a, s, x: move(b, x[0], p))),
        "Fixed": Case(3, at_point(planar.Fixed), lambda q, *args: q),
        "PointOnLine": Case(1, world(planar.PointOnLine), of_b(lambda b, p, a, s, x: move(b, x[0], p, x[1] * a))),
        "Prismatic": Case(2, world(planar.Prismatic), of_b(lambda b, p, a, s, x: move(b, 0.0, p, x[0] * a))),
        "Distance": Case(1, between_points(planar.Distance), on_link),
        "InextensibleBeam": Case(2, between_points(planar.InextensibleBeam, section=SECTIONS["planar"]), bent),
        "PointOnCurve": Case(1, ring, on_circle),
        "Gear": Case(1, gears, meshed, bodies=3, freedoms=8, numbers=10),
        "RackAndPinion": Case(1, rack, on_rack, freedoms=5),
    },
    "spatial": {
        "Spherical": Case(3, at_point(spatial.Spherical), of_b(lambda b, p, a, s, x: move(b, turn_3(x), p))),
        "Revolute": Case(5, world(spatial.Revolute), of_b(lambda b, p, a, s, x: move(b, turn(a, x[0]), p))),
        "Universal": Case(4, cardan, of_b(lambda b, p, a, s, x: move(b, product(turn(a, x[0]), turn(s, x[1])), p))),
        "Gimbal": Case(3, gimbal, of_b(lambda b, p, a, s, x: move(b, turn_3(x), p))),
        "Cylindrical": Case(
            4, world(spatial.Cylindrical), of_b(lambda b, p, a, s, x: move(b, turn(a, x[0]), p, x[1] * a))
        ),
        "Screw": Case(5, world(spatial.Screw, pitch=PITCH), of_b(on_thread)),
        "Prismatic": Case(5, world(spatial.Prismatic), of_b(lambda b, p, a, s, x: slid(b, x[0] * a))),
        "Planar": Case(3, world(spatial.Planar), of_b(lambda b, p, a, s, x: move(b, turn(a, x[2]), p, along(a, x)))),
        "Fixed": Case(6, at_point(spatial.Fixed), lambda q, *args: q),
        "Composite": composite("hinge", "hinge"),
        "Composite of all kinds": composite("hinge", "slide", "hinge", "slide", "hinge"),
        "Distance": Case(1, between_points(spatial.Distance), on_link),
        "InextensibleBeam": Case(3, between_points(spatial.InextensibleBeam, section=SECTIONS["spatial"]), bent),
        "PointOnPlane": Case(
            1, world(spatial.PointOnPlane), of_b(lambda b, p, a, s, x: move(b, turn_3(x[2:]), p, along(a, x)))
        ),
        "PointOnLine": Case(
            2, world(spatial.PointOnLine), of_b(lambda b, p, a, s, x: move(b, turn_3(x[1:]), p, x[0] * a))
        ),
    },
}
DRIVEN = {"planar": ("angle", "x", "y", "distance"), "spatial": ("x", "y", "z", "distance")}


def driver(module, quantity, **options):
    motion = lambda t, p: p["speed"] * t
    return module.Driver("drive", "a", "b", quantity=quantity, motion=motion, parameters={"speed": 3.0}, **options)


ROLLING = {
    "planar": {"KnifeEdge": planar.KnifeEdge("blade", "a", point=(0.2, 0.0))},
    "spatial": {
        "KnifeEdge": spatial.KnifeEdge("blade", "a", point=(0.2, 0.0, 0.0)),
        "RollingDisc": spatial.RollingDisc("wheel", "a", radius=0.5, centre=(0.1, -0.2, 0.05)),
        "RollingSphere": spatial.RollingSphere("ball", "a", radius=0.2, spin=2.5),
    },
}


# Forces


def springs(name, damping):
    """Those with an energy between two bodies, which lose some by damping."""
    module, space = (planar, PLANE) if name == "planar" else (spatial, SPACE)
    points = dict(zip(("point_a", "point_b"), POINTS[space.dimension], strict=True))
    numbers = np.arange(1.0, 1.0 + space.velocity_size)
    loses = damping * np.linspace(0.6, 0.1, space.velocity_size)
    out = {
        "SpringDamper": module.SpringDamper(
            "F", "a", "b", stiffness=30.0, damping=2.0 * damping, free_length=0.4, **points
        ),
        "Bushing": module.Bushing("F", "a", "b", stiffness=numbers, damping=loses, **points),
        "Beam": module.Beam("F", "a", "b", section=SECTIONS[name], damping_time=0.1 * damping, **points),
    }
    if space is SPACE:
        return out
    laws = {
        "normal": contact.Linear(30.0),
        "friction": contact.Coulomb(0.4 * damping, transition_speed=0.5),
        "damping": 0.5 * damping,
        "radius": 2.0,
        "centre": POINTS[2][0],
    }
    ends = {"start": (1.3, -0.4), "end": (2.5, 0.3), "edge": 0.6}
    gear = {
        "stiffness": 30.0,
        "unloading": 1.0 - 0.6 * damping,
        "preload": 2.0,
        "slack": 0.05,
        "travel": 0.2,
        "stop_stiffness": 50.0,
        "damping": 0.5 * damping,
        "transition_speed": 2.0,
        "smoothing": 0.3,
        "free_length": 0.4,
    }
    return out | {
        "TorsionalSpringDamper": planar.TorsionalSpringDamper(
            "F", "a", "b", stiffness=30.0, damping=2.0 * damping, free_angle=0.3
        ),
        "DraftGear": planar.DraftGear("F", "a", "b", **gear, **points),
        "PlateContact": planar.PlateContact("F", ("a", "b"), **ends, **laws),
        "DiscContact": planar.DiscContact("F", ("a", "b"), radii=0.7, centres=POINTS[2][1], **laws),
    }


def pairs(name):
    """Forces between two bodies that come from nowhere else."""
    if name == "planar":
        more = {"Torque": planar.Torque("F", "b", torque=2.0, reaction="a")}
    else:
        moment = {"torque": (1.0, 2.0, 3.0), "reaction": "a"}
        more = {
            "Torque": spatial.Torque("F", "b", **moment),
            "body Torque": spatial.Torque("F", "b", **moment, frame="body"),
        }
    module = planar if name == "planar" else spatial
    return springs(name, 1.0) | {"RotationalDamper": module.RotationalDamper("F", "a", "b", damping=2.0), **more}


def forces(name):
    """Every force with all that it may lose."""
    module, (point, end) = (planar, POINTS[2]) if name == "planar" else (spatial, POINTS[3])
    push = {"force": np.arange(1.0, 1.0 + len(point)), "point": point}
    ground = {"terrain": terrain.Slope(0.2), "normal": contact.Linear(30.0), "radius": 2.0, "damping": 0.5}
    grip = {"coefficient": 0.4, "slip_stiffness": 5.0, "relaxation_length": 0.3, "deflection": 0.1}
    out = pairs(name) | {
        "Damper": module.Damper("F", "a", "b", damping=2.0, point_a=point, point_b=end),
        "PointForce": module.PointForce("F", "b", **push),
        "body PointForce": module.PointForce("F", "b", **push, frame="body"),
        "Contact": module.Contact("F", ("a", "b"), friction=contact.Coulomb(0.4, transition_speed=0.5), **ground),
        "Tyre": module.Tyre("F", "b", **ground, **grip),
    }
    if name == "planar":
        path = [("a", (1.0, 0.2)), ("b", (-0.6, 0.3)), ("a", (0.1, -0.9))]
        out["Track"] = planar.Track("F", path, pretension=2.0, stiffness=30.0, free_length=1.0)
    return out


# What their kernels return, values in NumPy and derivatives by programs of their own


def direction_of(rng, part):
    return jtu.tree_map(lambda x: rng.normal(size=np.shape(x)), part)


def changed(part, direction, size):
    return jtu.tree_map(lambda x, dx: np.asarray(x) + size * dx, part, direction)


def stacked(*trees):
    return jtu.tree_map(lambda *x: np.stack(x), *trees)


# Of the fourth order in the step.
STEPS, WEIGHTS = 1e-4 * np.array([1, -1, 2, -2]), np.array([8, -8, -1, 1]) / 12e-4


@functools.partial(jax.jit, static_argnums=(0, 1))
def derivatives(f, space, parts, direction, poses):
    """Of `f(part, poses)` with respect to velocities of all bodies in turn, and along a change of all numbers of the
    part; of several parts at poses of their own.
    """
    n, v = poses.shape[1], space.velocity_size
    still = jnp.zeros((n * v + 1, n, v)).at[:-1].set(jnp.eye(n * v).reshape(-1, n, v))
    last = jnp.zeros(n * v + 1).at[-1].set(1.0)

    def along(part, q, velocity, share):
        rates = jax.vmap(space.rates)(q, velocity)
        return jax.jvp(f, (part, q), (jtu.tree_map(lambda x: share * x, direction), rates))

    value, slopes = jax.vmap(jax.vmap(along, (None, None, 0, 0)), (0, 0, None, None))(parts, poses, still, last)
    return value[:, 0], jnp.moveaxis(slopes[:, :-1], 1, -1), slopes[:, -1]


@dataclasses.dataclass
class Rows:
    """A constraint between bodies at random poses, and another one with other numbers at other poses.

    `value` and `slope` along the change of all numbers are those of the other one, by a program; `jacobian` by the
    velocities is that of the first, at `moved`.
    """

    space: Any
    part: Any
    other: Any
    direction: Any
    moved: Any
    elsewhere: Any
    residual: Callable
    value: Any = None
    jacobian: Any = None
    slope: Any = None

    def __post_init__(self):
        parts, poses = stacked(self.part, self.other), np.stack([self.moved, self.elsewhere])
        found = derivatives(self.residual, self.space, parts, self.direction, poses)
        self.value, self.jacobian, self.slope = np.asarray(found[0])[1], np.asarray(found[1])[0], found[2][1]

    def differences(self):
        """Of the row's values along the change of numbers, in NumPy."""
        of = lambda size: np.asarray(self.residual(changed(self.other, self.direction, size), self.elsewhere))
        return sum(weight * of(size) for weight, size in zip(WEIGHTS, STEPS, strict=True))


def rows_of(space, part, rng, moved, elsewhere, residual):
    direction = direction_of(rng, part)
    return Rows(space, part, changed(part, direction, 0.1), direction, moved, elsewhere, residual)


@dataclasses.dataclass
class Joint:
    case: Case
    rows: Rows
    poses: Any
    motion: Callable
    x: Any
    freedoms: int


@functools.cache
def joint(name, key) -> Joint:
    """A joint that holds at random poses because it is given there; `moved` by a large motion that it admits."""
    space, case, rng = SPACES[name], JOINTS[name][key], np.random.default_rng(7)
    d, poses = space.dimension, random_poses(rng, space, case.bodies)
    point, axis = rng.normal(size=d), random_unit(rng, d)
    if space is SPACE:
        second, carried = across(axis, rng.normal(size=3))[0], (turn_3(rng.normal(size=3)), rng.normal(size=3))
    else:
        # The radius of the circle through the point of B. All bodies are carried along by several turns.
        second = np.linalg.norm(PLANE.body_point(poses[0], PLANE.point(poses[1], np.array(POINTS[2][1]))))
        carried = 9.0, np.ones(2)
    part = case.build(point, axis, second).resolve(space, poses)
    freedoms = space.velocity_size - case.rows if case.freedoms is None else case.freedoms
    x = rng.uniform(0.3, 1.0, size=freedoms if case.numbers is None else case.numbers)
    motion = lambda x: case.motion(poses, point, axis, second, x)
    moved = np.stack([move(q, carried[0], np.zeros(d), carried[1]) for q in motion(x)])
    if space is SPACE:
        # The other sign of Euler parameters is the same attitude.
        moved[1, 3:] *= -1.0
    elsewhere = random_poses(rng, space, case.bodies)
    rows = rows_of(space, part, rng, moved, elsewhere, lambda part, q: part.residual(space, q, 0.0))
    return Joint(case, rows, poses, motion, x, freedoms)


@functools.cache
def driven(name, quantity) -> tuple[Rows, Any, float]:
    """A driver, its poses, and the quantity that it drives."""
    space, rng = SPACES[name], np.random.default_rng(2)
    a, b = (np.array(s) for s in POINTS[space.dimension])
    poses, points = random_poses(rng, space), {} if quantity == "angle" else {"point_a": a, "point_b": b}
    part = driver(planar if space is PLANE else spatial, quantity, **points).resolve(space, poses)
    rows = rows_of(space, part, rng, poses, poses, lambda part, q: part.residual(space, q, 0.4))
    if quantity == "angle":
        return rows, poses, poses[1, 2] - poses[0, 2]
    d = space.point(poses[1], b) - space.point(poses[0], a)
    if quantity == "distance":
        return rows, poses, np.linalg.norm(d)
    return rows, poses, space.direction(poses[0], np.eye(space.dimension)["xyz".index(quantity)]) @ d


@functools.cache
def rolling(name, key) -> Rows:
    space, rng = SPACES[name], np.random.default_rng(3)
    poses, velocities = random_poses(rng, space, 1), rng.normal(size=(1, space.velocity_size))

    def rows(part, q):
        if isinstance(part, AbstractCompound):
            return jnp.concatenate([rows(component, q) for component in part.components()])
        if isinstance(part, AbstractVelocityConstraint):
            return part.residual(space, q, velocities, 0.0)
        return part.residual(space, q, 0.0)

    return rows_of(space, ROLLING[name][key].resolve(space, poses), rng, poses, poses, rows)


@functools.partial(jax.jit, static_argnums=0)
def _force(space, parts, poses, velocities, part, direction, keeping):
    wrenches = lambda part, q, v: part.wrenches(space, q, v, 0.0)
    along = lambda part: wrenches(part, poses[0], velocities[0])
    values = jax.vmap(wrenches)(parts, poses, velocities), jax.jvp(along, (part,), (direction,))[1]
    if keeping is None:
        return *values, None
    rates = jax.vmap(space.rates)(poses[0], velocities[0])
    return *values, jax.vmap(lambda part: jax.jvp(lambda q: part.energy(space, q, 0.0), (poses[0],), (rates,)))(keeping)


@dataclasses.dataclass
class Pushes:
    """Wrenches of a force at random poses and velocities; where all bodies are `carried` along; with the other sign of
    Euler parameters; `lossless`, of the same without damping; `slope` and `difference` along a change of all numbers.
    """

    poses: Any
    velocities: Any
    given: Any
    carried: Any
    same: Any
    lossless: Any
    slope: Any
    difference: Any
    energies: Any


@functools.cache
def push(name, key) -> Pushes:
    space, rng, d = SPACES[name], np.random.default_rng(9), SPACES[name].dimension
    part, none = forces(name)[key], springs(name, 0.0).get(key)
    n = len(part.bodies)
    given, poses = (random_poses(rng, space)[:n] for _ in range(2))
    velocities = rng.normal(size=(2, space.velocity_size))[:n]
    part = part.resolve(space, given)
    none = part if none is None else none.resolve(space, given)
    turned, shift = 1.3 if d == 2 else turn_3(np.array([0.4, -0.8, 0.5])), rng.normal(size=d)
    carried = np.stack([move(q, turned, np.zeros(d), shift) for q in poses])
    turn_of = turned_2d if d == 2 else rotated
    moving = np.stack([np.append(turn_of(turned, v[:d]), v[d:]) for v in velocities])
    flipped = poses.copy()
    if d == 3:
        flipped[-1, 3:] *= -1.0
    direction = direction_of(rng, part)
    parts = stacked(part, part, part, none, *(changed(part, direction, size) for size in STEPS))
    at = [poses, carried, flipped, *[poses] * 5]
    speeds = [velocities, moving, *[velocities] * 6]
    keeping = stacked(part, none) if key in springs(name, 0.0) else None
    wrenches, slope, energies = _force(space, parts, np.stack(at), np.stack(speeds), part, direction, keeping)
    wrenches = np.asarray(wrenches)
    difference = np.tensordot(WEIGHTS, wrenches[4:], 1)
    return Pushes(poses, velocities, wrenches[0], wrenches[1], wrenches[2], wrenches[3], slope, difference, energies)
