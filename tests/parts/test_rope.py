"""Ropes over pulleys: tangents, tensions and motions against closed forms and equations of motion by hand."""

import re

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
from at_instants import instants, point
from trajectories import motion_of

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.bodies.reactions import lifted_ropes
from jaxmb.parts.planar.kinematics import PLANE
from jaxmb.parts.spatial.kinematics import SPACE

MOST_PROGRAMS = 90

G = 9.81
GRAVITY = mb.Gravity((0.0, -G))
# Compiled sooner than the default; any method will do.
METHOD = {"solver": diffrax.Dopri8(), "manifold": mb.manifold.Projection(), "max_steps": 4096}


def disc(name, mass, radius, *position):
    return planar.Body(name, mass=mass, inertia=planar.disc(mass, radius), position=position)


# Geometry

# Seen against it x points to the right and z up, as x and y do in the plane.
AXIS = (0.0, -1.0, 0.0)
CIRCLES = {"centres": np.array([(-0.7, 0.1), (0.6, -0.2)]), "radii": np.array([0.3, 0.5])}
ENDS = np.array([(-2.0, 0.3), (2.2, -0.4)])
SENSES = {"left, left": (1, 1), "left, right": (1, -1)}


def at(*places):
    """Poses in the plane of the ground and of bodies."""
    return np.array([(0.0, 0.0, 0.0), *((*place, 0.0) for place in places)])


def over_two_circles(name):
    centres, radii = CIRCLES.values()
    path = [mb.Pulley("ground", r, turn, c) for r, turn, c in zip(radii, name.split(", "), centres, strict=True)]
    return [("ground", ENDS[0]), *path, ("load", (0.0, 0.0))], at(ENDS[1]), {}


def through_an_eye(dimension):
    """Over a pulley as well, with loads that swing in one plane."""
    flat = lambda *x: x if dimension == 2 else (x[0], 0.0, x[1])
    axis = {} if dimension == 2 else {"axis": AXIS}
    path = [("left", flat(0.0, 0.0)), ("ground", flat(-0.5, 0.0)), mb.Pulley("ground", 0.2, "right", **axis)]
    poses = np.stack([flat(-1.2, -0.9), flat(0.0, 0.0), flat(0.8, -1.1)])
    way = np.stack([flat(0.7, -0.4), flat(0.0, 0.0), flat(0.9, 0.8)])
    return [*path, ("right", flat(0.0, 0.0))], padded(poses, dimension), {"swing": padded(way, dimension, still=0.0)}


def padded(places, dimension, still=1.0):
    """Poses without turns, or their changes."""
    turns = [[0.0]] if dimension == 2 else [[still, 0.0, 0.0, 0.0]]
    return np.concatenate([places, np.repeat(turns, len(places), axis=0)], axis=1)


TACKLE = [
    ("ground", (-0.25, 0.0)),
    mb.Pulley("block", 0.1, "left", (-0.15, 0.0)),
    mb.Pulley("ground", 0.05, "right", (0.0, 0.0)),
    mb.Pulley("block", 0.1, "left", (0.15, 0.0)),
    mb.Pulley("ground", 0.2, "right", (0.45, 0.0)),
    ("weight", (0.0, 0.0)),
]
BELT = [mb.Pulley("small", 0.1, "right", turns=2.5), mb.Pulley("large", 0.3, "left", turns=1.5)]
OVER_A_WHEEL = [("ground", (-1.0, 0.0)), mb.Pulley("wheel", 0.2, "right"), ("end", (0.0, 0.0))]
OUT_OF_PLANE = [("ground", (-0.5, 0.0, 0.1)), mb.Pulley("ground", 0.1, "right", axis=AXIS), ("load", (0.0, 0.0, 0.0))]
LIFTED = [("ground", (-1.0, -0.2)), mb.Pulley("ground", 0.1, "right", lifts=True), ("load", (0.0, 0.0))]
# Paths with the poses of their bodies in order, and changes of these by name.
PATHS = {name: over_two_circles(name) for name in SENSES} | {
    "eye": through_an_eye(2),
    "eye in space": through_an_eye(3),
    "tackle": (
        TACKLE,
        at((0.0, -2.0), (0.65, -1.0)),
        {"together": at((0.0, 0.1), (0.0, -0.4)), "block": at((0.0, 0.1), (0.0, 0.0))},
    ),
    "belt": (
        BELT,
        np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)]),
        {"drive": np.array([(0.0, 0.0, -3.0), (0.0, 0.0, 1.0)])},
    ),
    "wheel": (OVER_A_WHEEL, at((0.1, 0.2), (0.9, -0.4)), {}),
    "out of plane": (OUT_OF_PLANE, padded(np.array([(0.0, 0.0, 0.0), (0.1, 0.3, -1.0)]), 3), {}),
    "lifted": (LIFTED, at((1.0, 0.5)), {}),
}


def resolved(name):
    path, poses, ways = PATHS[name]
    space = PLANE if poses.shape[1] == 3 else SPACE
    own = {"length": 1.9, "stiffness": 50.0} if name == "lifted" else {}
    # Angles are those next to the given ones.
    return mb.Rope("rope", path, **own).resolve(space, poses).with_fields(counts=False), space, poses, ways


@pytest.fixture(scope="module")
def paths():
    """Of each path its length and wraps, the slope of its length; along each change the length's first and second
    derivative, and all of it after the change.
    """

    def seen(part, space, poses, ways):
        length = lambda q: part.coordinates(space, q)["length"]

        def along(way):
            rate = lambda q: jax.jvp(length, (q,), (way,))[1]
            return *jax.jvp(rate, (poses,), (way,)), part.coordinates(space, poses + way)

        own = part.coordinates(space, poses)
        return own, jax.grad(length)(poses), {name: along(way) for name, way in ways.items()}

    spaces = {name: resolved(name)[1] for name in PATHS}
    numbers = {name: (part, poses, ways) for name in PATHS for part, _, poses, ways in [resolved(name)]}
    every = jax.jit(lambda numbers: {k: seen(x[0], spaces[k], *x[1:]) for k, x in numbers.items()})
    return jax.tree.map(np.asarray, every(numbers))


def length_of_path(angles, senses):
    """From a point over two circles to another point, by the places where the rope meets and leaves the circles."""
    centres, radii = CIRCLES.values()
    on = lambda k, angle: centres[k] + radii[k] * np.stack([np.cos(angle), np.sin(angle)])
    arcs = sum(radii[k] * senses[k] * (angles[2 * k + 1] - angles[2 * k]) for k in (0, 1))
    places = [ENDS[0], on(0, angles[0]), on(0, angles[1]), on(1, angles[2]), on(1, angles[3]), ENDS[1]]
    return arcs + sum(np.sqrt(np.sum((places[k + 1] - places[k]) ** 2)) for k in (0, 2, 4))


@pytest.mark.parametrize("name", SENSES)
def test_rope_length_is_stationary(paths, name):
    """Of all ropes over the two circles the path is that which a tight rope takes."""
    senses, (found, _, _) = SENSES[name], paths[name]
    # Derivatives by complex steps.
    gradient = lambda x: np.array([length_of_path(x + 1e-30j * e, senses).imag for e in np.eye(4)]) / 1e-30
    # A rope that turns left has its pulley on the left.
    angles = scipy.optimize.root(gradient, -0.5 * np.pi * np.repeat(senses, 2), tol=1e-13).x
    assert found["length"] == pytest.approx(length_of_path(angles, senses), rel=1e-12)
    # The angles are double roots.
    np.testing.assert_allclose(found["wrap"], np.array(senses) * (angles[1::2] - angles[::2]), rtol=0, atol=1e-7)


def test_rope_length_changes_along_its_straight_parts(paths):
    """Also where the pulley moves; in space out of the plane of a pulley but for a share (1 − cos α) R / l."""

    def tangent(a, c, turn):
        """The unit vector from a point along its tangent to the circle."""
        d = np.array(c) - a
        angle = turn * np.arcsin(0.2 / np.linalg.norm(d))
        turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ d
        return turned / np.linalg.norm(d)

    first = tangent(np.array([-1.0, 0.0]), (0.1, 0.2), 1)
    last = tangent(np.array([0.9, -0.4]), (0.1, 0.2), -1)
    _, slope, _ = paths["wheel"]
    expected = [(0.0, 0.0, 0.0), (*(first + last), 0.0), (*-last, 0.0)]
    np.testing.assert_allclose(slope[1:], expected[1:], rtol=0, atol=1e-14)
    # The straight part of length 1 m in the plane of the pulley swings 0.3 m out of it.
    own, slope, _ = paths["out of plane"]
    straight = np.hypot(1.0, 0.3)
    assert own["length"] == pytest.approx(0.5 + 0.05 * np.pi + straight, rel=1e-12)
    expected = np.array([-0.1 * (1.0 - 1.0 / straight), 0.3 / straight, -1.0 / straight])
    np.testing.assert_allclose(slope[1, :3], expected, rtol=0, atol=1e-13)


def test_rope_length_in_space_is_that_in_the_plane(paths):
    (flat, _, plane), (tall, _, space) = paths["eye"], paths["eye in space"]
    same = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12)
    jax.tree.map(same, (tall, space["swing"]), (flat, plane["swing"]))
    assert np.all(np.abs(plane["swing"][:2]) > 0.1)


def test_rope_of_a_tackle_moves_its_block_by_a_quarter(paths):
    own, _, ways = paths["tackle"]
    np.testing.assert_allclose([*ways["together"][:2], *ways["block"][:2]], [0.0, 0.0, -0.4, 0.0], rtol=0, atol=1e-13)
    for name, more in (("together", 0.0), ("block", -0.4)):
        assert ways[name][2]["length"] - own["length"] == pytest.approx(more, abs=1e-13)


def test_rope_from_drum_to_drum_winds_up_what_it_unwinds(paths):
    """Crossed, it holds the angles in the ratio of the radii, of opposite sign."""
    own, _, ways = paths["belt"]
    rate, bend, after = ways["drive"]
    np.testing.assert_allclose([rate, bend, after["length"] - own["length"]], 0.0, atol=1e-13)
    np.testing.assert_allclose(own["wrap"], [5 * np.pi, 3 * np.pi], rtol=1e-12)
    np.testing.assert_allclose(after["wrap"], [5 * np.pi - 3.0, 3 * np.pi + 1.0], rtol=1e-12)


def test_rope_that_is_off_its_pulley_is_straight(paths):
    """Also in pictures."""
    own, slope, _ = paths["lifted"]
    assert own["length"] == pytest.approx(np.hypot(2.0, 0.7), rel=1e-14) and own["wrap"][0] == 0
    np.testing.assert_allclose(slope[1, :2], np.array([2.0, 0.7]) / np.hypot(2.0, 0.7), rtol=1e-14)
    part, space, poses, _ = resolved("lifted")
    line = np.asarray(jax.jit(lambda q: part.path(space, q))(poses))
    np.testing.assert_allclose((line + np.array([1.0, 0.2])) @ np.array([-0.7, 2.0]), 0.0, rtol=0, atol=1e-14)


# Tensions and accelerations


def atwood(left=1.0, right=2.0, *, grips=True, again=(), **options):
    """Two loads on a wheel; ropes `again` stand beside the first."""
    over = mb.Pulley("wheel", radius=0.1, turn="right", grips=grips)
    bodies = [disc("wheel", 0.5, 0.1, 0.0, 0.0), point("left", left, -0.1, -1.0), point("right", right, 0.1, -1.2)]
    rope = mb.Rope("rope", [("left", (0.0, 0.0)), over, ("right", (0.0, 0.0))], **options)
    joints = [planar.Revolute("axle", "ground", "wheel", point=(0.0, 0.0)), rope, *map(rope.named, again)]
    return mb.Scene(bodies, joints=joints, forces=[GRAVITY]).compile()


@pytest.mark.parametrize("grips, again", [(True, []), (False, ["again"])], ids=["grips", "slips and stands twice"])
def test_rope_of_atwoods_machine(grips, again):
    """A wheel that turns with the rope has inertia; a wheel without friction has none."""
    system, rolling = atwood(grips=grips, again=again), 0.25 * grips
    own = instants(system, system.guess)
    acceleration = G / (3.0 + rolling)
    assert own("left.acceleration")[0, 1] == pytest.approx(acceleration, rel=1e-12)
    assert own("wheel.angular_acceleration")[0] == pytest.approx(-10.0 * acceleration * grips, rel=1e-12)
    tensions = np.array([G + acceleration, 2.0 * (G - acceleration)])
    found = sum(own(f"{name}.tension")[0] for name in ("rope", *again))
    np.testing.assert_allclose(found, tensions if grips else tensions[0], rtol=1e-12)
    if grips:
        q, u = (np.stack([y, y]) for y in (system.guess.q, system.guess.u))
        (axes,) = motion_of(system, np.array([0.0, 1.0]), q, u).plot("rope.tension").axes
        assert [line.get_label() for line in axes.lines] == ["rope span 1", "rope span 2"]
    implied = [(item.name, item.by) for item in system.implied]
    assert implied in ([("again", ("rope",))], [("rope", ("again",))]) if again else not implied


def test_rope_that_is_elastic_only_pulls():
    # How far below the pulley a load is, its speed downwards, and the tension of its rope.
    cases = {"taut": (1.3, 0.0, 30.0), "fast": (1.3, -2.0, 10.0), "faster": (1.3, -4.0, 0.0), "slack": (0.9, 3.0, 0.0)}
    loads = [point(name, 1.0, 0.1, -below, velocity=(0.0, -v)) for name, (below, v, _) in cases.items()]
    # The rope runs a quarter of a turn about the pulley, of length π/20, and 0.5 m before it.
    options = {"stiffness": 100.0, "damping": 10.0, "length": 1.5 + 0.05 * np.pi}
    over = [("ground", (-0.5, 0.1)), mb.Pulley("ground", 0.1, "right")]
    ropes = [mb.Rope(f"{name} rope", [*over, (name, (0.0, 0.0))], **options) for name in cases]
    system = mb.Scene(loads, joints=ropes).compile()
    own = instants(system, system.guess)
    for name, (_, _, tension) in cases.items():
        assert own(f"{name} rope.tension")[0] == pytest.approx(tension, abs=1e-10)
        np.testing.assert_allclose(own(f"{name}.acceleration")[0], [0.0, tension], rtol=0, atol=1e-10)
    energy = jax.jit(lambda q: system.potential_energy(0.0, q))(system.guess.q)
    assert energy == pytest.approx(3 * 50.0 * 0.3**2, abs=1e-12)


@pytest.mark.slow
def test_rope_counts_turns_in_the_plane():
    """They are coordinates without a velocity, and change nothing but what happens after a turn."""
    plain, counting = atwood(), atwood(count_turns=True)
    assert (counting.nq, counting.nu) == (plain.nq + 2, plain.nu)
    both = jax.jit(
        lambda q: (
            jax.jacfwd(lambda q: counting.coordinate_residual(0.0, q))(q),
            counting.prepared().coordinate_jacobian(0.0, q),
        )
    )
    q = np.array(counting.guess.q)
    q[counting.coordinate_names()["wheel.angle"]] += 0.4
    expected, found = both(q)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    motions = [instants(own, own.guess)("left.acceleration") for own in (plain, counting)]
    np.testing.assert_allclose(motions[1], motions[0], rtol=1e-12)


# Bad input


def of_path(*path, **options):
    body = disc("wheel", 1.0, 0.2, 1.0, 0.0)
    return mb.Scene([body], joints=[mb.Rope("rope", path, **options)]).compile()


def over(radius=0.2, turn="left", **options):
    return mb.Pulley("wheel", radius, turn, **options)


def fixed(x, radius, turn="left", **options):
    return mb.Pulley("ground", radius, turn, (x, 0.0), **options)


END, FAR, WHEEL, PULLS = ("ground", (0.0, 0.0)), ("ground", (2.0, 0.0)), ("wheel", (0.0, 0.0)), {"stiffness": 1.0}
REFUSED = {
    "one place": ((END,), {}, "Rope 'rope': path must hold at least two places, got 1"),
    "no pair": ((END, "wheel"), {}, r"path\[1\] must be a pair \(body, point\) or a Pulley, got 'wheel'"),
    "no side": ((END, over(turn="up"), WHEEL), {}, r"path\[1\]: turn must be 'left' or 'right', got 'up'"),
    "no body": ((END, ("whel", (0.0, 0.0))), {}, "Rope 'rope': Unknown body 'whel'; did you mean 'wheel'"),
    "no radius": ((END, over(0.0)), {}, "Rope 'rope': radii must be positive"),
    "in the circle": (
        (("ground", (0.9, 0.0)), over()),
        {},
        r"point path\[0\] lies in the circle of the pulley path\[1\].* move the point out",
    ),
    "crossing": ((END, fixed(0.7, 0.2, "right"), over()), {}, r"path\[1\] and path\[2\] overlap, and the rope crosses"),
    "one in another": ((END, fixed(0.9, 0.5), over()), {}, r"path\[1\] and path\[2\] one lies in the other"),
    "coincident": ((("ground", (1.0, 0.0)), WHEEL), {}, r"the neighbours path\[0\] and path\[1\] coincide"),
    "an axis in the plane": (
        (END, over(centre=(0.0, 0.0), axis=(0.0, 0.0, 1.0))),
        {},
        "axes belongs to spatial scenes|points must have shape",
    ),
    "too short": ((END, WHEEL), {"length": 0.9, "slack": True}, r"length \[0.9\] m is less than that of its path"),
    "shorter than on the drum": (
        (END, over(turns=3.0)),
        {"length": 3.0},
        r"length \[3.0\] m is less than that of the rope on its pulleys .* \[3.76",
    ),
    "turns of a pulley": ((END, over(turns=0.5), FAR), {}, r"turns of path\[1\], .* must be a whole number"),
    "slack spans": ((END, over(grips=True), FAR), {"slack": True}, "with slack it has one span"),
    "lengths": ((END, WHEEL), {"length": (1.0, 1.0)}, r"length must have shape \(\), one for each of its spans"),
    "slack and elastic": ((END, WHEEL), PULLS | {"slack": True}, "an elastic rope goes slack by itself"),
    "off a drum": ((END, over(lifts=True)), PULLS, r"path\[1\] holds the rope, which cannot lift off it"),
    "off by a constant length": ((END, over(lifts=True), FAR), {}, r"lifts off path\[1\]; give its stiffness"),
    "off two neighbours": (
        (END, fixed(0.5, 0.1, lifts=True), fixed(1.0, 0.1, lifts=True), FAR),
        PULLS,
        r"it may lift off path\[1\] and path\[2\], which are neighbours",
    ),
    "off with full turns": ((END, over(turns=1.0, lifts=True), FAR), PULLS, "full turns of rope; leave lifts or turns"),
    "damping alone": ((END, WHEEL), {"damping": 1.0}, "damping belongs to an elastic rope"),
    "restitution alone": ((END, WHEEL), {"restitution": 0.5}, "restitution belongs to a rope with slack=True"),
}


@pytest.mark.parametrize("path, options, message", REFUSED.values(), ids=REFUSED)
def test_rope_that_is_refused(path, options, message):
    with pytest.raises(ValueError, match=message):
        of_path(*path, **options)


@pytest.mark.parametrize(
    "axes, message",
    [
        ((None, None), "in space give the axis of every pulley"),
        (((0.0, 1.0, 0.0), (0.0, 0.6, 0.8)), r"the axes of the neighbours path\[0\] and path\[1\] must be parallel"),
    ],
)
def test_rope_with_axes_that_are_refused(axes, message):
    wheel = spatial.Body("wheel", mass=1.0, inertia=spatial.disc(1.0, 0.2, "y"), position=(1.0, 0.0, 0.0))
    path = [
        mb.Pulley(body, 0.2, "left", np.zeros(3), axis) for body, axis in zip(("ground", "wheel"), axes, strict=True)
    ]
    with pytest.raises(ValueError, match=message):
        mb.Scene([wheel], joints=[mb.Rope("rope", path)]).compile()


# Motions


DOWN_3D = mb.Gravity((0.0, 0.0, -G))


def crane(dimension):
    """A load that swings under a pulley, on a rope from a drum with a motor."""
    own, axis = (planar, {}) if dimension == 2 else (spatial, {"axis": AXIS})
    at = lambda x, z: (x, z) if dimension == 2 else (x, 0.0, z)
    inertia = planar.disc if dimension == 2 else lambda m, r: spatial.disc(m, r, "y")
    wheel = lambda name, m, r, *x: own.Body(name, mass=m, inertia=inertia(m, r), position=at(*x))
    bodies = [
        wheel("drum", 5.0, 0.2, -1.0, 0.5),
        wheel("sheave", 1.0, 0.1, 0.0, 0.0),
        own.PointMass("load", mass=2.0, position=at(0.6, -1.2)),
    ]
    axles = [own.Revolute(f"{x.name} axle", "ground", x.name, point=x.position, **axis) for x in bodies[:2]]
    sheave = mb.Pulley("sheave", 0.1, "right", grips=True, **axis)
    path = [mb.Pulley("drum", 0.2, "right", turns=3.0, **axis), sheave, ("load", at(0.0, 0.0))]
    motor = mb.JointForce("motor", "drum axle.angle", force=2.0)
    gravity = GRAVITY if dimension == 2 else DOWN_3D
    return mb.Scene(bodies, joints=[*axles, mb.Rope("rope", path)], forces=[motor, gravity]).compile()


@pytest.mark.slow
def test_rope_of_a_planar_scene_in_space():
    """The drum turns more than once. The motor does all the work."""
    found, ts = [], np.linspace(0.0, 1.6, 9)
    for dimension in (2, 3):
        system = crane(dimension)
        motion = mb.simulate(system, mb.assemble(system), t1=ts[-1], saveat=ts, rtol=1e-10, **METHOD)
        work = 2.0 * motion["drum axle"].angle
        np.testing.assert_allclose(motion.energy - work, motion.energy[0] - work[0], rtol=0, atol=1e-6)
        assert np.ptp(motion["rope"].wrap[:, 0]) > 2 * np.pi
        x = motion["load"].position
        found.append([x[:, 0], x[:, -1], motion["rope"].wrap, motion["rope"].length, motion["rope"].tension])
    for plane, space in zip(*found, strict=True):
        np.testing.assert_allclose(space, plane, rtol=0, atol=1e-6)


def around_a_pole(**options):
    ball = point("ball", 1.0, 1.0, -0.05, velocity=(0.0, 1.0))
    path = [mb.Pulley("ground", 0.05, "left"), ("ball", (0.0, 0.0))]
    return mb.Scene([ball], joints=[mb.Rope("rope", path, **options)]).compile()


@pytest.mark.slow
def test_rope_that_winds_up_around_a_pole():
    """The speed of a ball on it is constant, and its path the involute of the circle: l² = l₀² − 2 R v t."""
    r, speed = 0.05, 1.0
    system = around_a_pole(count_turns=True)
    ts = np.linspace(0.0, 9.1, 8)
    motion = mb.simulate(system, mb.assemble(system), t1=ts[-1], saveat=ts, rtol=1e-10)
    free = np.sqrt(1.0 - 2 * r * speed * ts)
    angle = (1.0 - free) / r
    np.testing.assert_allclose(motion["rope"].wrap[:, 0], angle, rtol=0, atol=1e-6)
    e = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    expected = free[:, None] * e + r * np.stack([e[:, 1], -e[:, 0]], axis=1)
    np.testing.assert_allclose(motion["ball"].position[:, :2], expected, rtol=0, atol=1e-7)
    np.testing.assert_allclose(motion["rope"].tension, speed**2 / free, rtol=1e-6)


@pytest.mark.slow
def test_rope_unwinds_by_forty_turns():
    """In space, where Euler parameters count no turns. The load falls with a constant acceleration."""
    r, mass, inertia, turns = 0.05, 2.0, 0.01, 40.0
    drum = spatial.Body("drum", mass=1.0, inertia=(0.01, inertia, 0.01))
    load = spatial.PointMass("load", mass=mass, position=(r, 0.0, -1.0))
    axle = spatial.Revolute("axle", "ground", "drum", point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    wound = mb.Pulley("drum", r, "left", axis=(0.0, 1.0, 0.0), turns=turns + 1.0)
    rope = mb.Rope("rope", [wound, ("load", (0.0, 0.0, 0.0))])
    system = mb.Scene([drum, load], joints=[axle, rope], forces=[DOWN_3D]).compile()
    acceleration = mass * G / (mass + inertia / r**2)
    ts = np.linspace(0.0, np.sqrt(4 * np.pi * r * turns / acceleration), 9)
    motion = mb.simulate(system, mb.assemble(system), t1=ts[-1], saveat=ts, rtol=1e-10, **METHOD)
    fallen = 0.5 * acceleration * ts**2
    np.testing.assert_allclose(motion["load"].position[:, 2], -1.0 - fallen, rtol=0, atol=1e-8)
    np.testing.assert_allclose(motion["rope"].wrap[:, 0], 2 * np.pi * (turns + 1) - fallen / r, rtol=0, atol=1e-6)
    np.testing.assert_allclose(motion["rope"].tension, mass * (G - acceleration), rtol=1e-7)
    np.testing.assert_allclose(motion.energy, motion.energy[0], rtol=0, atol=1e-7 * np.ptp(motion.kinetic_energy))


@pytest.mark.slow
def test_rope_whose_turns_are_not_counted_ends_the_motion():
    system = around_a_pole()
    motion = mb.simulate(system, mb.assemble(system), t1=9.1, throw=False, **METHOD)
    assert motion.result != mb.RESULTS.successful


# Winches, slack ropes, derivatives


def thrown_up():
    load = planar.PointMass("load", mass=1.0, position=(1.0, 0.1), velocity=(0.0, 3.0))
    over = mb.Pulley("ground", radius=0.1, turn="right")
    rope = mb.Rope("rope", [("ground", (-1.0, -0.2)), over, ("load", (0.0, 0.0))])
    system = mb.Scene([load], joints=[rope]).compile()
    return system, system.guess


OFF = r"Rope 'rope' is off its pulley path\[1\] at t = 0\.2: its angle there is -0"


def test_rope_that_lifts_off_is_told():
    """From the first saved state in which it is off."""
    system, start = thrown_up()
    motion = motion_of(system, [0.05, 0.2], [[1.0, 0.1], [1.0, 0.7]], np.stack([start.u] * 2))
    (told,) = lifted_ropes(system, motion)
    assert re.match(OFF, told)


@pytest.mark.slow
def test_rope_that_lifts_off_is_warned_of():
    """Where states are saved."""
    with pytest.warns(UserWarning, match=OFF):
        mb.simulate(*thrown_up(), t1=0.2, saveat=np.array([0.05, 0.2]), **METHOD)
    mb.simulate(*thrown_up(), t1=0.2, saveat=diffrax.SaveAt(t1=True, fn=lambda t, y, args: y.q[1]))


def over_a_peg(counts):
    """An elastic rope from the ground over a pulley to a load that is thrown up, so that it lifts off the pulley."""
    load = planar.PointMass("load", mass=1.0, position=(1.0, -0.3))
    over = mb.Pulley("ground", radius=0.1, turn="right", lifts=True)
    path = [("ground", (-1.0, -0.2)), over, ("load", (0.0, 0.0))]
    rope = mb.Rope("rope", path, length=1.6, stiffness=15.0, damping=0.5, count_turns=counts)
    return mb.Scene([load], joints=[rope], forces=[GRAVITY]).compile()


def length_over_a_peg(x):
    """The length of the shortest way from the point (-1, -0.2) over a circle about the origin, and its arc."""
    fixed, r = jnp.array([-1.0, -0.2]), 0.1
    d = x - fixed
    height = (d[0] * -fixed[1] - d[1] * -fixed[0]) / jnp.linalg.norm(d)
    a, b = jnp.linalg.norm(fixed), jnp.linalg.norm(x)
    angle = jnp.arccos(fixed @ x / (a * b))
    angle = jnp.where(fixed[0] * x[1] - fixed[1] * x[0] > 0, 2 * jnp.pi - angle, angle)
    arc = angle - jnp.arccos(r / a) - jnp.arccos(r / b)
    touches = jnp.sqrt(a**2 - r**2) + jnp.sqrt(b**2 - r**2) + r * arc
    return jnp.where(height > -r, touches, jnp.linalg.norm(d)), jnp.where(height > -r, arc, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("counts", [False, True])
def test_rope_that_is_elastic_lifts_off_and_comes_back(counts):
    """The motion by hand, with the way over the pulley or past it. Derivatives are those of a tighter solution."""
    system = over_a_peg(counts)
    known = {"rope.stiffness": jnp.asarray(15.0), "load.mass": jnp.asarray(1.0)}
    ts = np.linspace(0.0, 0.9, 19)

    def run(values, rtol=1e-10):
        changed = mb.with_parameters(system, values)
        start = mb.assemble(changed, rates={"load.x": 2.0, "load.y": 4.5})
        return mb.simulate(changed, start, t1=ts[-1], saveat=ts, rtol=rtol, **METHOD)

    motion = run(known)
    slope = jax.jit(jax.value_and_grad(lambda x: length_over_a_peg(x)[0]))

    def field(t, y):
        length, along = slope(y[:2])
        stretch = float(length) - 1.6
        spring = 15.0 * max(stretch, 0.0)
        pull = spring + np.clip(0.5 * float(along @ y[2:]), -spring, spring)
        return [*y[2:], *(-pull * np.asarray(along) + [0.0, -G])]

    by_hand = scipy.integrate.solve_ivp(
        field, (0.0, ts[-1]), (1.0, -0.3, 2.0, 4.5), t_eval=ts, method="DOP853", rtol=1e-11, atol=1e-12
    )
    np.testing.assert_allclose(motion["load"].position, by_hand.y[:2].T, rtol=0, atol=1e-7)
    lengths, arcs = jax.vmap(length_over_a_peg)(jnp.asarray(by_hand.y[:2].T))
    np.testing.assert_allclose(motion["rope"].length, lengths, rtol=0, atol=1e-7)
    np.testing.assert_allclose(motion["rope"].wrap[:, 0], arcs, rtol=0, atol=1e-6)
    # It is off the pulley in between, and taut there for a while.
    assert arcs[0] > 0 and arcs[-1] > 0 and np.any((arcs == 0) & (lengths > 1.6))

    end = lambda values, rtol=1e-10: run(values, rtol)["load"].position[-1]
    forward, reverse = jax.jit(jax.jacfwd(end))(known), jax.jit(jax.jacrev(end))(known)
    tight = jax.jit(lambda values: end(values, 1e-12))
    for name, value in known.items():
        h = 1e-4 * value
        difference = (tight(known | {name: value + h}) - tight(known | {name: value - h})) / (2 * h)
        np.testing.assert_allclose(reverse[name], forward[name], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(forward[name], difference, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_rope_of_a_crane_that_swings_while_it_hoists():
    """Lagrange's equation by hand, l θ̈ + 2 V θ̇ + R θ̇² + g sin θ = 0 with the free length l, l̇ = R θ̇ + V, of a rope
    that passes a pulley of radius R and is paid out at the rate V.
    """
    r, rate, angle, free, speed, mass = 0.2, -0.6, 0.4, 1.5, 0.8, 3.0
    axes = lambda x: (np.array([np.cos(x), np.sin(x)]), np.array([np.sin(x), -np.cos(x)]))
    normal, along = axes(angle)
    load = point("load", mass, *(r * normal + free * along))
    path = [("ground", (-2.0, r)), mb.Pulley("ground", r, "right"), ("load", (0.0, 0.0))]
    system = mb.Scene([load], joints=[mb.Rope("rope", path)], forces=[GRAVITY]).compile()
    length = float(mb.parameters(system)["rope.length"])
    inputs, ts = {"rope.length": lambda t: length + rate * t}, np.linspace(0.0, 1.5, 16)
    first = float((rate * along + free * speed * normal)[0])
    start = mb.assemble(mb.with_inputs(system, inputs), rates={"load.x": first})
    motion = mb.simulate(system, start, t1=ts[-1], saveat=ts, inputs=inputs, rtol=1e-11, **METHOD)

    def field(t, y):
        x, v, l = y
        return v, -(2 * rate * v + r * v**2 + G * np.sin(x)) / l, r * v + rate

    own = scipy.integrate.solve_ivp(
        field, (0.0, ts[-1]), (angle, speed, free), t_eval=ts, method="DOP853", rtol=1e-12, atol=1e-13
    )
    x, v, l = own.y
    normal, along = (values.T for values in axes(x))
    np.testing.assert_allclose(motion["load"].position, r * normal + l[:, None] * along, rtol=0, atol=1e-8)
    np.testing.assert_allclose(motion["rope"].wrap[:, 0], np.pi / 2 - x, rtol=0, atol=1e-8)
    np.testing.assert_allclose(motion["rope"].tension, mass * (G * np.cos(x) + l * v**2), rtol=1e-7)


@pytest.mark.slow
def test_rope_that_is_slack_tightens_and_goes_slack():
    """A load falls 0.8 m until the rope is tight, and rebounds: its height after the impact, the gap and the time, and
    their derivatives by length and restitution, as of the closed forms.
    """
    load, length = point("load", 1.0, 0.1, -0.2), 1.5 + 0.05 * np.pi
    path = [("ground", (-0.5, 0.1)), mb.Pulley("ground", 0.1, "right"), ("load", (0.0, 0.0))]
    rope = mb.Rope("rope", path, length=length, slack=True, restitution=0.5)
    system = mb.Scene([load], joints=[rope], forces=[GRAVITY]).compile()
    start, at = mb.assemble(system), {"rope.length": jnp.asarray(length), "rope.restitution": jnp.asarray(0.5)}

    def end_of_run(values):
        motion = mb.simulate(mb.with_parameters(system, values), start, t1=0.5, rtol=1e-10, max_events=4)
        out = [motion["load"].position[-1, -1], motion["rope"].gap[-1], motion.events.times[0]]
        return jnp.stack([*out, motion["rope"].tension[-1]])

    def by_hand(values):
        depth, back = 0.8 + values["rope.length"] - length, values["rope.restitution"]
        fall = jnp.sqrt(2.0 * depth / G)
        after = 0.5 - fall
        gap = back * G * fall * after - 0.5 * G * after**2
        return jnp.stack([gap - 0.2 - depth, gap, fall, 0.0 * gap])

    twice = lambda function: lambda values: (function(values),) * 2
    expected, values = jax.jacfwd(twice(by_hand), has_aux=True)(at)
    for derivative in (jax.jacfwd, jax.jacrev):
        found, own = jax.jit(derivative(twice(end_of_run), has_aux=True))(at)
        np.testing.assert_allclose(own, values, rtol=1e-8, atol=1e-8)
        for name, value in expected.items():
            np.testing.assert_allclose(found[name], value, rtol=1e-7, atol=1e-8)


def drum_with_a_moving_end():
    """A drum that is held, and a rope on it whose other end goes round the drum with 1 rad/s."""
    wheel = planar.Body("wheel", mass=1.0, inertia=1.0)
    axle = planar.Revolute("axle", "ground", "wheel", point=(0.0, 0.0))
    hold = planar.Driver("hold", "ground", "wheel", quantity="angle", motion=lambda t, p: 0.0 * t)
    drum = mb.Pulley("wheel", radius=0.1, turn="left", turns=3.0)
    rope = mb.Rope("rope", [drum, ("ground", (1.0, 0.0))], stiffness=1.0, length=2.5, count_turns=True)
    circle = lambda t: jnp.array([[0.0, 0.0], [jnp.cos(t), jnp.sin(t)]])
    return mb.Scene([wheel], joints=[axle, hold, rope]).compile(), circle


@pytest.mark.slow
def test_rope_counts_turns_at_a_time():
    """The exact count of turns belongs to the place of the rope's end at the time."""
    system, circle = drum_with_a_moving_end()
    moving = mb.system.with_inputs(system, {"rope.points": circle})
    normalized = jax.jit(lambda t, q: moving.normalize(t, q))
    for t, near in ((1.0, 0.9), (4.0, 4.1), (9.0, 8.8)):
        q = moving.guess.q.at[-1].add(near)
        np.testing.assert_allclose(abs(normalized(t, q) - moving.guess.q), [0.0, 0.0, 0.0, t], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    "manifold", [mb.manifold.Partition(), mb.manifold.Projection()], ids=["Partition", "Projection"]
)
def test_rope_about_a_drum_with_a_moving_end(manifold):
    """The rope on the drum is longer by the radius times the angle."""
    system, circle = drum_with_a_moving_end()
    options = {"t1": 4.0, "saveat": np.linspace(0.0, 4.0, 9), "inputs": {"rope.points": circle}, "manifold": manifold}
    length = mb.simulate(system, mb.assemble(system), **options)["rope"].length
    np.testing.assert_allclose(length[-1] - length[0], 0.4, atol=1e-8)


# Limits


def hoist(**ropes):
    """A load of 1 kg, beside the tangent, that 2 kg on the other end of the ropes pull up to the pulley."""
    over = mb.Pulley("ground", radius=0.1, turn="right", centre=(0.0, 0.0))
    loads = [point("left", 1.0, -0.15, -1.0), point("right", 2.0, 0.1, -1.0)]
    path = [("left", (0.0, 0.0)), over, ("right", (0.0, 0.0))]
    joints = [mb.Rope(name, path, **options) for name, options in ropes.items()]
    return mb.Scene(loads, joints=joints, forces=[GRAVITY]).compile()


LIMITS = {
    "far": ((-0.1, -0.5), ""),
    "near": ((-0.1, -0.1), ""),
    "at the circle": (
        (-0.1 * np.cos(0.3) - 1e-7, -0.1 * np.sin(0.3)),
        r"path\[0\] is at the circle of the pulley path",
    ),
    "in the circle": ((-0.05, 0.0), r"the point path\[0\] is at the circle of the pulley path\[1\]"),
    "turned too far": ((0.06, 0.19), r"changed by 0\.9 half turns since the given poses; with count_turns=True"),
}


@pytest.mark.slow
def test_rope_limits_are_told():
    kinds = {"taut": {}, "elastic": {"stiffness": 1e4}, "slack": {"slack": True}}
    system = hoist(**kinds)
    for place, text in LIMITS.values():
        q = np.array(system.guess.q)
        q[:2] = place
        found = system.catalogue.limits(0.0, jnp.asarray(q))
        assert len(found) == (len(kinds) if text else 0)
        for kind, told in zip(sorted(kinds), sorted(found), strict=False):
            assert re.search(f"^Rope '{kind}' is at its limit: .*{text}", told)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rope", "solver"),
    [
        ({"stiffness": 1e4}, "auto"),
        ({"slack": True}, "auto"),
        ({"count_turns": True}, "auto"),
        ({}, mb.solvers.Hermite()),
    ],
)
def test_rope_whose_load_reaches_its_pulley_ends_the_motion(rope, solver):
    system = hoist(rope=rope)
    state = mb.assemble(system)
    motion = mb.simulate(system, state, t1=2.0, solver=solver, throw=False)
    assert motion.result != mb.RESULTS.successful and motion.stats["num_steps"] < 1000
    # The load rises by a metre at about a third of g, and then is at the circle.
    end = motion.ts[-1]
    assert 0.7 < end < 0.8 and abs(np.hypot(*motion.ys.q[-1][:2]) - 0.1) < 1e-3
    message = r"came to t = (0\.7\d*) of 2\. There Rope 'rope' is at its limit: the point path\[0\] is at the circle"
    with pytest.raises(RuntimeError, match=message) as error:
        mb.simulate(system, state, t1=2.0, solver=solver)
    assert float(re.search(message, str(error.value))[1]) == pytest.approx(float(end), rel=1e-5)
    ends = mb.simulate(system, state, t1=float(end) - 0.01, solver=solver)
    np.testing.assert_allclose(ends.energy, ends.energy[0], rtol=1e-4)
