"""Kinematics and compliance of suspensions, against the geometry of their points."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiled
from oracles import suspensions

import jaxmb as mb
from jaxmb import mechanisms, planar, spatial

RADIUS, TRAVEL, RACK = 0.32, np.linspace(-0.08, 0.08, 9), np.linspace(-0.04, 0.04, 5)
STEP = 1e-5
AXIS = ("caster", "kingpin_inclination", "scrub_radius", "caster_trail")


@functools.cache
def library(name, **parameters):
    return mechanisms.get(name, **parameters)


def curves_of(system, carrier="upright", **changes):
    chosen = {"radius": RADIUS, "travel": TRAVEL, "steer": {"tie_rod.point_a[1]": RACK}} | changes
    return mb.kinematics_and_compliance(system, carrier, **chosen)


def slope(function, x):
    """By central differences."""
    return (function(x + STEP) - function(x - STEP)) / (2 * STEP)


def locked(position, points, travel, steer, length):
    """The travel that a spring of a length has with another steer."""
    for _ in range(8):
        of_travel = lambda z: position(points, z, steer)[2]
        travel = travel - (of_travel(travel) - length) / slope(of_travel, travel)
    return travel


def steering_axis(position, points, travel, steer):
    """Caster, kingpin inclination, scrub radius and caster trail from the turn of the carrier about a locked spring."""
    length = position(points, travel, steer)[2]
    at = lambda s: position(points, locked(position, points, travel, steer + s, length), steer + s)
    velocity, turning = suspensions.rigid_twist(at, STEP)
    centre, R, _ = at(0.0)
    up = turning * np.sign(turning[2])
    *_, patch = suspensions.angles(centre, R, RADIUS)
    point = centre + np.cross(turning, velocity) / (turning @ turning)
    ground = point + up * (patch - point)[2] / up[2]
    outward = suspensions.unit(R[:, 1] * [1, 1, 0])
    ahead = np.cross(outward, [0, 0, 1])
    return np.arctan2(-up[0], up[2]), np.arctan2(-up[1], up[2]), (patch - ground) @ outward, (ground - patch) @ ahead


def by_geometry(position, points, travel, steer):
    """All that is found of a left wheel at one place, by the geometry of its points."""
    seen = lambda z: np.hstack(
        [*suspensions.angles(*position(points, z, steer)[:2], RADIUS), position(points, z, steer)[2]]
    )
    (toe, camber, x, y, _, _), rates = seen(travel), slope(seen, travel)
    wheel = np.array(points["wheel"])
    values = {"toe": toe, "camber": camber, "wheelbase": x - wheel[0], "track": y - wheel[1]}
    values |= {"bump_steer": rates[0], "bump_camber": rates[1], "roll_centre": y * rates[3] / rates[4]}
    values |= dict(zip(AXIS, steering_axis(position, points, travel, steer), strict=True))
    return values, -rates[5]


def check(found, position, points, places, sign=1.0):
    """`places`: index and values of travel and steer; `sign` of the steer on a right wheel."""
    for (i, j), (travel, steer) in places.items():
        values, ratio = by_geometry(position, points, travel, sign * steer)
        for name, expected in values.items():
            value = getattr(found, name)[i, j]
            np.testing.assert_allclose(value, expected, rtol=1e-6, atol=1e-8, err_msg=f"{name} at {i}, {j}")
        np.testing.assert_allclose(found.motion_ratio["spring"][i, j], ratio, rtol=1e-7, atol=1e-8)
    assert all(np.max(np.abs(value)) < 1e-15 for value in found.compliance["lateral_force"].values())


def constant(side=1.0):
    """A spring of the lower arm whose upper end is above its axis, and whose lower end is on the axis."""
    P, mirror = suspensions.arrays(suspensions.WISHBONE), np.array([1.0, side, 1.0])
    on_axis = 0.5 * (P["lower_front"] + P["lower_rear"])
    of_arm = (P["lower_front"] + P["lower_rear"] + P["lower_ball"]) / 3
    ends = {"point_a": mirror * (on_axis + np.array([0.0, 0.0, 0.2])), "point_b": mirror * (on_axis - of_arm)}
    return spatial.SpringDamper("constant", "ground", "lower", stiffness=100.0, **ends)


def anti_roll(side=1.0):
    """A spring that steering stretches, since it is on the upright."""
    at = {"point_a": (-0.2, side * 0.55, 0.1), "point_b": (-0.15, side * -0.1, -0.05)}
    return spatial.SpringDamper("anti_roll", "ground", "upright", stiffness=2e4, **at)


def test_curves_of_a_right_wheel_are_those_of_the_geometry_of_the_left():
    """With a spring at a dead centre and one on the upright, which keep no travel, before that of the arm."""
    mirrored = {name: (x, -y, z) for name, (x, y, z) in suspensions.WISHBONE.items()}
    scene = mechanisms.double_wishbone(points=mirrored).scene
    forces = [anti_roll(-1.0), constant(-1.0), *scene.forces]
    system = mb.Scene(scene.bodies, joints=scene.joints, forces=forces).compile()
    travel, steer = np.array([-0.05, 0.02]), np.array([-0.01, 0.0, 0.03])
    found = curves_of(system, travel=travel, steer={"tie_rod.point_a[1]": steer})
    assert list(found.motion_ratio) == ["anti_roll", "constant", "spring"] and found.freedoms == 0
    assert np.max(np.abs(found.motion_ratio["constant"])) < 1e-12
    places = {(i, j): (travel[i], steer[j]) for i in (0, 1) for j in (0, 2)}
    check(found, suspensions.wishbone, suspensions.WISHBONE, places, sign=-1.0)
    # Other numbers have the same programs.
    stiffer = mb.with_parameters(system, {"spring.stiffness": 5e4})
    with compiled() as programs:
        curves_of(stiffer, travel=travel + 0.01, steer={"tie_rod.point_a[1]": steer})
    assert not programs


@pytest.mark.slow
def test_curves_of_five_links_are_those_of_the_geometry():
    """The wheel spins freely."""
    found = curves_of(library("five_link").system, "carrier")
    places = {(i, j): (TRAVEL[i], RACK[j]) for i, j in ((0, 2), (4, 2), (8, 4))}
    check(found, suspensions.five_link, suspensions.FIVE_LINK, places)
    assert found.freedoms == 1 and np.ptp(found.toe) > 0.1 and np.ptp(found.camber) > 0.05


def steered_by(forces, joints="ideal", **changes):
    """Curves of the left double wishbone with other forces, at three travels."""
    scene = library("double_wishbone", **({} if joints == "ideal" else {"joints": joints})).scene
    system = mb.Scene(scene.bodies, joints=scene.joints, forces=forces(scene.forces)).compile()
    small = {"travel": np.linspace(-0.05, 0.05, 3), "steer": {"tie_rod.point_a[1]": np.array([-0.01, 0.0, 0.01])}}
    return curves_of(system, **(small | changes))


# Forces of the double wishbone with hinges, and the springs that are named, None for all.
ORDERS = {
    "only a constant spring": (lambda forces: [constant(), *forces[1:]], None),
    "the anti-roll spring last": (lambda forces: [*forces, anti_roll()], None),
    "no spring": (lambda forces: forces[1:], None),
    "a torsion bar": (
        lambda forces: [mb.JointSpring("bar", "lower_hinge.angle", stiffness=1e3), *forces[1:]],
        ["lower_hinge.angle"],
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ORDERS)
def test_steering_axis_goes_through_the_balls_whatever_the_springs_are(name):
    forces, springs = ORDERS[name]
    found, P = steered_by(forces, springs=springs), suspensions.arrays(suspensions.WISHBONE)
    for i, z in enumerate((-0.05, 0.0, 0.05)):
        for j, s in enumerate((-0.01, 0.0, 0.01)):
            _, R, _ = suspensions.wishbone(suspensions.WISHBONE, z, s)
            up = R @ (P["upper_ball"] - P["lower_ball"])
            np.testing.assert_allclose(found.caster[i, j], np.arctan2(-up[0], up[2]), rtol=1e-9)
            np.testing.assert_allclose(found.kingpin_inclination[i, j], np.arctan2(-up[1], up[2]), rtol=1e-9)


@pytest.mark.slow
def test_bushings_are_no_springs():
    """Whatever the order, and with bushings alone, which hold the wheel about as hinges do."""
    last = steered_by(lambda forces: forces[::-1], "bushings")
    alone = steered_by(lambda forces: [part for part in forces if part.name != "spring"], "bushings")
    assert list(last.motion_ratio) == ["spring"] and not alone.motion_ratio and last.freedoms == 10
    rigid = steered_by(list)
    for own in AXIS:
        np.testing.assert_allclose(getattr(last, own), getattr(alone, own), rtol=0, atol=2e-3)
        np.testing.assert_allclose(getattr(alone, own), getattr(rigid, own), rtol=0, atol=2e-3)


def on_a_rack():
    """The double wishbone with a rack that slides."""
    scene, P = library("double_wishbone").scene, suspensions.arrays(suspensions.WISHBONE)
    rack = spatial.Body("rack", mass=2.0, inertia=0.01 * np.eye(3), position=P["rack"])
    slide = spatial.Prismatic("slide", "ground", "rack", point=P["rack"], axis=(0.0, 1.0, 0.0))
    rod = spatial.Distance("tie_rod", "rack", "upright", point_b=P["steering_arm"] - P["wheel"])
    return scene.extended(without=["tie_rod"], bodies=[rack], joints=[slide, rod])


@pytest.mark.slow
def test_a_rack_steers_as_the_end_of_the_tie_rod():
    system, places = on_a_rack().compile(), {(0, 1): (TRAVEL[0], RACK[1]), (8, 4): (TRAVEL[8], RACK[4])}
    for name in ("slide.displacement", "rack.y"):
        check(curves_of(system, steer={name: RACK}), suspensions.wishbone, suspensions.WISHBONE, places)


def test_a_table_of_numbers():
    names = ["toe", "camber", "bump_steer", "bump_camber", "track", "wheelbase", "roll_centre"]
    values = {name: np.linspace(0.0, 0.01, 3) for name in names}
    loads = {name: {"toe": np.full(3, 1e-6), "camber": np.zeros(3)} for name in LOADS}
    made = mb.KinematicsAndCompliance(
        travel=np.linspace(-0.08, 0.08, 3),
        steer=None,
        **values,
        motion_ratio={"spring": np.full(3, 0.6)},
        **dict.fromkeys(AXIS),
        compliance=loads,
        q=np.zeros((3, 7)),
        freedoms=11,
    )
    lines = str(made).splitlines()
    assert "11 freedoms" in lines[0] and "camber [°]" in lines[1] and "ratio spring" in lines[1]
    assert lines[-1].split()[:2] == ["80", "0.573"] and len(lines) == 5
    assert "<pre>" in made._repr_html_() and "5 lines" in repr(made)


# Derivatives and compliances

LOADS = ("longitudinal_force", "lateral_force", "aligning_moment")


def wishbone_curves(x):
    """Of the double wishbone without its spring, with hard points changed along a direction."""
    system, random = springless(), np.random.default_rng(0)
    known = mb.parameters(system)
    names = ["tie_rod.point_a", "tie_rod.point_b", "upper_ball.point_a", "lower_ball.point_b", "lower_hinge.point_a"]
    changed = {name: known[name] + x * jnp.asarray(random.normal(size=3)) for name in names}
    steer = {"tie_rod.point_a[1]": jnp.array([0.02])}
    found = curves_of(mb.with_parameters(system, changed), travel=jnp.array([-0.06, 0.05]), steer=steer)
    names = ("toe", "camber", "track", "roll_centre", "bump_steer", *AXIS)
    return jnp.stack([getattr(found, name) for name in names])


@functools.cache
def springless():
    return library("double_wishbone").scene.extended(without=["spring"]).compile()


@functools.cache
def bushed():
    """A wheel on a swing arm with two bushings and a spring."""
    bushing = lambda name, x: spatial.Bushing(
        name, "ground", "arm", point=(x, 0.3, 0.3 + 0.1 * x), stiffness=(1e6, 2e6, 1e6, 20.0, 30.0, 40.0)
    )
    spring = spatial.SpringDamper(
        "spring", "ground", "arm", stiffness=3e4, free_length=0.5, point_a=(0.0, 0.4, 0.7), point_b=(0.0, -0.2, 0.0)
    )
    gravity = mb.Gravity((0.0, 0.0, -9.81))
    return mb.Scene([arm()], forces=[bushing("front", 0.2), bushing("rear", -0.15), spring, gravity]).compile()


def bushed_curves(x, loads=None):
    """Of this arm, with points and stiffnesses changed along a direction."""
    system = bushed()
    known = mb.parameters(system)
    along = {
        "front.point_a": jnp.array([1.0, 2.0, -1.0]),
        "rear.stiffness": jnp.arange(1.0, 7.0) * known["rear.stiffness"],
    }
    changed = {name: known[name] + x * change for name, change in along.items()}
    system = mb.with_parameters(system, changed)
    found = mb.kinematics_and_compliance(system, "arm", radius=0.3, travel=jnp.array([-0.05, 0.04]), loads=loads)
    assert found.freedoms == 5
    compliances = [found.compliance[load][name] for load in LOADS for name in ("toe", "camber", "track", "wheelbase")]
    shown = jnp.stack([found.toe, found.camber, found.track, found.wheelbase, found.roll_centre, found.bump_steer])
    return jnp.concatenate([shown, 1e4 * jnp.stack(compliances)])


@pytest.mark.slow
@pytest.mark.parametrize("value", [wishbone_curves, bushed_curves])
def test_derivatives_by_hard_points(value):
    """Forward and reverse, under jit and vmap, against central differences."""
    springless(), bushed()  # Compiled outside of traces.
    step = 1e-5
    both = jax.jit(jax.vmap(lambda x: jax.jvp(value, (x,), (jnp.ones_like(x),))))
    values, slopes = both(step * jnp.array([-2.0, -1.0, 0.0, 1.0, 2.0]))
    values, forward = values.reshape(*values.shape[:2], -1), slopes[2].reshape(values.shape[1], -1)
    weights = jnp.asarray(np.random.default_rng(1).normal(size=forward.shape))
    backward = jax.jit(jax.grad(lambda x: jnp.sum(weights * value(x).reshape(weights.shape))))(0.0)
    expected = (8 * (values[3] - values[1]) - (values[4] - values[0])) / (12 * step)
    size = np.max(np.abs(expected), axis=1, keepdims=True)
    assert np.all(size > 1e-4)
    np.testing.assert_allclose(forward / size, expected / size, rtol=0, atol=1e-6)
    np.testing.assert_allclose(backward, jnp.sum(weights * forward), rtol=1e-9)


@pytest.mark.slow
def test_compliances_are_derivatives_of_equilibria():
    bushed()
    at, size = jax.jit(lambda loads: bushed_curves(0.0, loads)), 2.0
    nothing = dict.fromkeys(LOADS, 0.0)
    found = at(nothing)
    for k, load in enumerate(LOADS):
        ahead, behind = (at(nothing | {load: sign * size}) for sign in (1.0, -1.0))
        expected = 1e4 * (ahead - behind)[:4] / (2 * size)
        largest = np.max(np.abs(expected))
        np.testing.assert_allclose(found[6 + 4 * k : 10 + 4 * k] / largest, expected / largest, rtol=0, atol=1e-6)


# A wheel on a swing arm, and refusals


def arm():
    return spatial.Body("arm", mass=5.0, inertia=np.eye(3), position=(0.0, 0.7, 0.3))


def swing(*stops):
    hinge = spatial.Revolute("hinge", "ground", "arm", point=(0.0, 0.3, 0.3), axis=(1.0, 0.0, 0.0))
    return mb.Scene([arm()], joints=[hinge, *stops]).compile()


REFUSED = [
    ({"carrier": "am"}, "carrier.*'arm'"),
    ({"axis": (0.0, 0.0, 2.0)}, "parallel to the travel"),
    ({"axis": (0.0, 0.0, 0.0)}, "a direction"),
    ({"radius": -0.3}, "positive"),
    ({"side": "port"}, "'left' or 'right'"),
    ({"centre": (0.0, -0.7, 0.0)}, "plane y = 0"),
    ({"travel": np.zeros((2, 2))}, "number or a vector"),
    ({"steer": ("hinge.angle", 0.1)}, "by name"),
    ({"steer": {"hinge.angel": 0.1}}, r"hinge\.angle"),
    ({"steer": {"hinge.point_a": 0.1}}, r"hinge.point_a\[0\]"),
    ({"steer": {"hinge.angle": 0.1}}, r"too few for travel and hinge\.angle"),
    ({"springs": ["coil"]}, "spring"),
    ({"springs": "coil"}, "sequence"),
    ({"loads": {"side_force": 1.0}}, "lateral_force"),
    ({"loads": 3.0}, "by name"),
]


def test_what_kinematics_and_compliance_refuses():
    given, system = {"radius": 0.3, "travel": 0.05}, swing()
    for changes, message in REFUSED:
        options = {"carrier": "arm"} | given | changes
        with pytest.raises(ValueError, match=message):
            mb.kinematics_and_compliance(system, options.pop("carrier"), **options)
    with pytest.raises(ValueError, match="remove floor"):
        mb.kinematics_and_compliance(swing(mb.Stop("floor", "hinge.angle", lower=-0.2, upper=0.4)), "arm", **given)
    flat = mb.Scene([planar.Body("bar", mass=1.0, inertia=1.0)]).compile()
    with pytest.raises(ValueError, match="in space"):
        mb.kinematics_and_compliance(flat, "bar", **given)


@pytest.mark.slow
def test_a_wheel_on_a_swing_arm():
    """On a circle about the hinge, whose place is the roll centre of the wheel alone."""
    curves = functools.partial(mb.kinematics_and_compliance, swing(), "arm", radius=0.3)
    found = curves(travel=TRAVEL, springs=["hinge.angle"])
    angle = np.arcsin(TRAVEL / 0.4)
    np.testing.assert_allclose(found.camber, -angle, atol=1e-12)
    np.testing.assert_allclose(found.motion_ratio["hinge.angle"], -1 / (0.4 * np.cos(angle)), rtol=1e-12)
    patch = np.stack([0.3 + 0.4 * np.cos(angle) + 0.3 * np.sin(angle), 0.3 + TRAVEL - 0.3 * np.cos(angle)])
    height = patch[0] * (patch[1] - 0.3) / (0.3 - patch[0])
    np.testing.assert_allclose(found.roll_centre, height, rtol=1e-10)
    with pytest.raises(ValueError, match=r"travel = \+0\.5 m.*out of reach.*hinge"):
        curves(travel=0.5)
    missed = curves(travel=np.array([0.1, 0.5]), throw=False)
    assert np.isfinite(missed.camber[0]) and np.isnan(missed.camber[1])


@pytest.mark.slow
def test_steers_and_freedoms_that_nothing_moves_or_holds():
    """A rack that nothing holds; a spring would, since steering at a given height moves its ends."""
    with pytest.raises(ValueError, match=r"spring.point_a\[0\]' does not move 'upright'"):
        curves_of(library("double_wishbone").system, steer={"spring.point_a[0]": RACK})
    scene = on_a_rack()
    free = mb.Scene(scene.bodies, joints=scene.joints)
    with pytest.raises(ValueError, match=r"no force resists.*rack\.y.*steer"):
        curves_of(free.compile(), travel=0.0, steer=None)
