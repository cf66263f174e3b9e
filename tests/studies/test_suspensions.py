"""Kinematics and compliance of suspensions, against the geometry of their points."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import suspensions

import jaxmb as mb
from jaxmb import mechanisms, planar, spatial

RADIUS, TRAVEL, RACK = 0.32, np.linspace(-0.08, 0.08, 9), np.linspace(-0.04, 0.04, 5)
STEP = 1e-5
CASES = {
    "double_wishbone": ("upright", suspensions.wishbone, suspensions.WISHBONE, "tie_rod.point_a[1]"),
    "five_link": ("carrier", suspensions.five_link, suspensions.FIVE_LINK, "tie_rod.point_a[1]"),
}


@functools.cache
def library(name, **parameters):
    return mechanisms.get(name, **parameters)


def curves_of(system, carrier="upright", **changes):
    chosen = {"radius": RADIUS, "travel": TRAVEL, "steer": {"tie_rod.point_a[1]": RACK}} | changes
    return mb.kinematics_and_compliance(system, carrier, **chosen)


@functools.cache
def curves(name, **parameters):
    return curves_of(library(name, **parameters).system, CASES[name][0])


def slope(function, x):
    """By central differences."""
    return (function(x + STEP) - function(x - STEP)) / (2 * STEP)


def on_grid(function):
    """Values of `function(travel, steer)` on the grid."""
    return np.array([[function(z, s) for s in RACK] for z in TRAVEL])


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_positions_as_by_geometry(name):
    _, position, points, _ = CASES[name]
    found = curves(name)
    seen = lambda z, s: np.hstack(suspensions.angles(*position(points, z, s)[:2], RADIUS))
    toe, camber, x, y, _ = np.moveaxis(on_grid(seen), -1, 0)
    wheel = np.array(points["wheel"])
    for value, expected in (
        (found.toe, toe),
        (found.camber, camber),
        (found.wheelbase, x - wheel[0]),
        (found.track, y - wheel[1]),
    ):
        np.testing.assert_allclose(value, expected, rtol=0, atol=1e-9)
    assert np.ptp(toe) > 0.1 and np.ptp(camber) > 0.05
    # The wheel of the five links spins freely.
    assert found.freedoms == (1 if name == "five_link" else 0)
    assert all(np.max(np.abs(value)) < 1e-15 for value in found.compliance["lateral_force"].values())


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_slopes_as_by_differences_of_geometry(name):
    _, position, points, _ = CASES[name]
    found = curves(name)
    seen = lambda z, s: np.hstack([*suspensions.angles(*position(points, z, s)[:2], RADIUS), position(points, z, s)[2]])
    toe, camber, _, y, z, length = np.moveaxis(on_grid(lambda z, s: slope(lambda z: seen(z, s), z)), -1, 0)
    outward = on_grid(lambda z, s: seen(z, s)[3])
    for value, expected in (
        (found.bump_steer, toe),
        (found.bump_camber, camber),
        (found.motion_ratio["spring"], -length),
        (found.roll_centre, outward * y / z),
    ):
        np.testing.assert_allclose(value, expected, rtol=1e-7, atol=1e-8)


def locked(position, points, travel, steer, length):
    """The travel that a spring of a length has with another steer."""
    for _ in range(8):
        of_travel = lambda z: position(points, z, steer)[2]
        travel = travel - (of_travel(travel) - length) / slope(of_travel, travel)
    return travel


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_steering_axes_as_by_differences_of_geometry(name):
    _, position, points, _ = CASES[name]
    found = curves(name)
    for i, j in ((0, 2), (4, 2), (8, 4)):
        length = position(points, TRAVEL[i], RACK[j])[2]
        at = lambda s, i=i, j=j, length=length: position(
            points, locked(position, points, TRAVEL[i], RACK[j] + s, length), RACK[j] + s
        )
        velocity, turning = suspensions.rigid_twist(at, STEP)
        centre, R, _ = at(0.0)
        up = turning * np.sign(turning[2])
        *_, patch = suspensions.angles(centre, R, RADIUS)
        point = centre + np.cross(turning, velocity) / (turning @ turning)
        ground = point + up * (patch - point)[2] / up[2]
        outward = suspensions.unit(R[:, 1] * [1, 1, 0])
        expected = [
            np.arctan2(-up[0], up[2]),
            np.arctan2(-up[1], up[2]),
            (patch - ground) @ outward,
            (ground - patch) @ np.cross(outward, [0, 0, 1]),
        ]
        names = ("caster", "kingpin_inclination", "scrub_radius", "caster_trail")
        np.testing.assert_allclose([getattr(found, own)[i, j] for own in names], expected, rtol=1e-6, atol=1e-8)


@pytest.mark.slow
def test_steering_axis_of_a_wishbone_goes_through_its_balls():
    found, P = curves("double_wishbone"), suspensions.arrays(suspensions.WISHBONE)
    for i, j in ((0, 2), (4, 0), (8, 4)):
        centre, R, _ = suspensions.wishbone(suspensions.WISHBONE, TRAVEL[i], RACK[j])
        low, high = (centre + R @ (P[f"{arm}_ball"] - P["wheel"]) for arm in ("lower", "upper"))
        x, y, z = high - low
        np.testing.assert_allclose(found.caster[i, j], np.arctan2(-x, z), rtol=1e-10)
        np.testing.assert_allclose(found.kingpin_inclination[i, j], np.arctan2(-y, z), rtol=1e-10)


def constant():
    """A spring of the lower arm whose upper end is above its axis, and whose lower end is on the axis."""
    P = suspensions.arrays(suspensions.WISHBONE)
    on_axis = 0.5 * (P["lower_front"] + P["lower_rear"])
    of_arm = (P["lower_front"] + P["lower_rear"] + P["lower_ball"]) / 3
    ends = {"point_a": on_axis + np.array([0.0, 0.0, 0.2]), "point_b": on_axis - of_arm}
    return spatial.SpringDamper("constant", "ground", "lower", stiffness=100.0, **ends)


def anti_roll(body="upright"):
    """A spring that steering stretches if it is on the upright."""
    at = {"point_a": (-0.2, 0.55, 0.1), "point_b": (-0.15, -0.1, -0.05)}
    return spatial.SpringDamper("anti_roll", "ground", body, stiffness=2e4, **at)


def steered_by(forces, joints="ideal", **changes):
    """Curves of the double wishbone with other forces, at three travels."""
    scene = library("double_wishbone", **({} if joints == "ideal" else {"joints": joints})).scene
    system = mb.Scene(scene.bodies, joints=scene.joints, forces=forces(scene.forces)).compile()
    small = {"travel": np.linspace(-0.05, 0.05, 3), "steer": {"tie_rod.point_a[1]": np.array([-0.01, 0.0, 0.01])}}
    return curves_of(system, **(small | changes))


AXIS = ("caster", "kingpin_inclination", "scrub_radius", "caster_trail")


def ball_axis(travel, steer):
    """Caster and kingpin inclination of the line through both ball joints."""
    P = suspensions.arrays(suspensions.WISHBONE)
    _, R, _ = suspensions.wishbone(suspensions.WISHBONE, travel, steer)
    x, y, z = R @ (P["upper_ball"] - P["lower_ball"])
    return np.arctan2(-x, z), np.arctan2(-y, z)


def test_steering_axis_of_springs_at_a_dead_centre_and_on_the_upright():
    """The first springs keep no travel: the axis goes through the ball joints all the same."""
    with_others = lambda forces: [anti_roll(), constant(), *forces]
    found = steered_by(with_others, travel=0.02, steer={"tie_rod.point_a[1]": 0.01})
    assert list(found.motion_ratio) == ["anti_roll", "constant", "spring"]
    expected = ball_axis(0.02, 0.01)
    np.testing.assert_allclose([found.caster, found.kingpin_inclination], expected, rtol=1e-9)
    assert abs(found.motion_ratio["constant"]) < 1e-12


# Forces of the double wishbone with hinges, and the springs that are named, None for all.
ORDERS = {
    "the constant spring first": (lambda forces: [constant(), *forces], None),
    "the constant spring last": (lambda forces: [*forces, constant()], None),
    "only a constant spring": (lambda forces: [constant(), *forces[1:]], None),
    "the anti-roll spring first": (lambda forces: [anti_roll(), *forces], None),
    "the anti-roll spring last": (lambda forces: [*forces, anti_roll()], None),
    "two springs of one arm": (lambda forces: [anti_roll("lower"), *forces], None),
    "no spring": (lambda forces: forces[1:], None),
    "a torsion bar": (
        lambda forces: [mb.JointSpring("bar", "lower_hinge.angle", stiffness=1e3), *forces[1:]],
        ["lower_hinge.angle"],
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ORDERS)
def test_steering_axis_does_not_depend_on_springs_between_rigid_arms(name):
    forces, springs = ORDERS[name]
    found, expected = steered_by(forces, springs=springs), steered_by(list)
    for own in (*AXIS, "toe", "camber"):
        np.testing.assert_allclose(getattr(found, own), getattr(expected, own), rtol=0, atol=1e-10)
    balls = [[ball_axis(z, s) for s in (-0.01, 0.0, 0.01)] for z in (-0.05, 0.0, 0.05)]
    np.testing.assert_allclose(np.stack([found.caster, found.kingpin_inclination], axis=-1), balls, rtol=1e-9)


@pytest.mark.slow
def test_bushings_are_no_springs():
    """In any order; and with bushings alone."""
    first = steered_by(list, "bushings")
    last = steered_by(lambda forces: forces[::-1], "bushings")
    assert list(first.motion_ratio) == list(last.motion_ratio) == ["spring"]
    alone = steered_by(lambda forces: [part for part in forces if part.name != "spring"], "bushings")
    assert not alone.motion_ratio
    rigid = steered_by(list)
    for own in AXIS:
        np.testing.assert_allclose(getattr(last, own), getattr(first, own), rtol=0, atol=1e-9)
        np.testing.assert_allclose(getattr(alone, own), getattr(rigid, own), rtol=0, atol=2e-3)


@pytest.mark.slow
def test_derivatives_of_a_steering_axis_without_springs():
    scene = library("double_wishbone").scene
    system = scene.extended(without=["spring"]).compile()
    ball = mb.parameters(system)["upper_ball.point_b"]

    def axis(x):
        changed = mb.with_parameters(system, {"upper_ball.point_b": ball + x * jnp.array([0.3, -0.2, 0.1])})
        steer = {"tie_rod.point_a[1]": jnp.asarray(0.01)}
        found = curves_of(changed, travel=jnp.array([0.0, 0.04]), steer=steer)
        return jnp.stack([getattr(found, own) for own in AXIS])

    values, slopes = jax.jit(jax.vmap(lambda x: jax.jvp(axis, (x,), (jnp.ones_like(x),))))(1e-4 * np.arange(-2.0, 3.0))
    weights = jnp.asarray(np.random.default_rng(0).normal(size=slopes.shape[1:]))
    reverse = jax.jit(jax.grad(lambda x: jnp.vdot(weights, axis(x))))(0.0)
    np.testing.assert_allclose(reverse, jnp.vdot(weights, slopes[2]), rtol=1e-10)
    differences = (8 * (values[3] - values[1]) - (values[4] - values[0])) / 12e-4
    np.testing.assert_allclose(slopes[2], differences, rtol=1e-7, atol=1e-9)


# Arms and tie rod turn about x, the tie rod as the lower arm.
FLAT = {
    "lower_front": (0.15, 0.36, 0.24),
    "lower_rear": (-0.2, 0.36, 0.24),
    "upper_front": (0.1, 0.43, 0.5),
    "upper_rear": (-0.15, 0.43, 0.5),
    "upper_ball": (0.0, 0.69, 0.53),
    "rack": (-0.12, 0.36, 0.24),
    "steering_arm": (-0.12, 0.74, 0.21),
}


@pytest.mark.slow
def test_roll_centre_as_by_construction_in_the_front_view():
    """From the contact patch to the pole of the wheel, to the middle of the car."""
    points = suspensions.WISHBONE | FLAT
    P = suspensions.arrays(points)
    found = curves_of(mechanisms.double_wishbone(points=FLAT).system)
    for i in (0, 3, 4, 8):
        centre, R, _ = suspensions.wishbone(points, TRAVEL[i])
        lines = []
        for arm in ("lower", "upper"):
            ball = centre + R @ (P[f"{arm}_ball"] - P["wheel"])
            pivot = P[f"{arm}_front"]
            lines.append(np.cross([*pivot[1:], 1.0], [*ball[1:], 1.0]))
        pole = np.cross(*lines)
        *_, patch = suspensions.angles(centre, R, RADIUS)
        middle = np.cross(np.cross([*patch[1:], 1.0], pole), [1.0, 0.0, 0.0])
        height = middle[1] / middle[2] - patch[2]
        np.testing.assert_allclose(found.roll_centre[i, 2], height, rtol=1e-9)
        np.testing.assert_allclose(found.toe[i, 2], 0.0, atol=1e-12)


@pytest.mark.slow
def test_the_right_wheel_mirrors_the_left():
    mirrored = {name: (x, -y, z) for name, (x, y, z) in suspensions.WISHBONE.items()}
    right, left = mechanisms.double_wishbone(points=mirrored), curves("double_wishbone")
    found = curves_of(right.system, steer={"tie_rod.point_a[1]": -RACK})
    names = ["toe", "camber", "track", "wheelbase", "roll_centre", "bump_steer", "caster", "kingpin_inclination"]
    for name in (*names, "scrub_radius", "caster_trail"):
        np.testing.assert_allclose(getattr(found, name), getattr(left, name), rtol=0, atol=1e-9)


def on_a_rack(**bushings):
    """The double wishbone with a rack that slides."""
    machine, P = library("double_wishbone", **bushings), suspensions.arrays(suspensions.WISHBONE)
    scene = machine.scene
    rack = spatial.Body("rack", mass=2.0, inertia=0.01 * np.eye(3), position=P["rack"])
    slide = spatial.Prismatic("slide", "ground", "rack", point=P["rack"], axis=(0.0, 1.0, 0.0))
    rod = spatial.Distance("tie_rod", "rack", "upright", point_b=P["steering_arm"] - P["wheel"])
    joints = [joint for joint in scene.joints if joint.name != "tie_rod"]
    return mb.Scene([*scene.bodies, rack], joints=[*joints, slide, rod], forces=scene.forces)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["slide.displacement", "rack.y"])
def test_a_rack_steers_as_the_end_of_the_tie_rod(name):
    found, expected = curves_of(on_a_rack().compile(), steer={name: RACK}), curves("double_wishbone")
    for field in ("toe", "camber", "roll_centre", "caster", "scrub_radius", "bump_steer"):
        np.testing.assert_allclose(getattr(found, field), getattr(expected, field), rtol=0, atol=1e-9)
    assert found.freedoms == 0


def test_a_table_of_numbers():
    names = ["toe", "camber", "bump_steer", "bump_camber", "track", "wheelbase", "roll_centre"]
    values = {name: np.linspace(0.0, 0.01, 3) for name in names}
    loads = {name: {"toe": np.full(3, 1e-6), "camber": np.zeros(3)} for name in ("lateral_force", "aligning_moment")}
    loads["longitudinal_force"] = loads["lateral_force"]
    made = mb.KinematicsAndCompliance(
        travel=np.linspace(-0.08, 0.08, 3),
        steer=None,
        **values,
        motion_ratio={"spring": np.full(3, 0.6)},
        caster=None,
        kingpin_inclination=None,
        scrub_radius=None,
        caster_trail=None,
        compliance=loads,
        q=np.zeros((3, 7)),
        freedoms=11,
    )
    lines = str(made).splitlines()
    assert "11 freedoms" in lines[0] and "camber [°]" in lines[1] and "ratio spring" in lines[1]
    assert lines[-1].split()[:2] == ["80", "0.573"] and len(lines) == 5
    assert "<pre>" in made._repr_html_() and "5 lines" in repr(made)


# Derivatives


def wishbone_curves(x):
    """Of the double wishbone, with hard points changed along a direction."""
    system, random = library("double_wishbone").system, np.random.default_rng(0)
    known = mb.parameters(system)
    names = ["tie_rod.point_a", "tie_rod.point_b", "upper_ball.point_a", "lower_ball.point_b", "lower_hinge.point_a"]
    changed = {name: known[name] + x * jnp.asarray(random.normal(size=3)) for name in names}
    steer = {"tie_rod.point_a[1]": jnp.array([0.02])}
    found = curves_of(mb.with_parameters(system, changed), travel=jnp.array([-0.06, 0.0, 0.05]), steer=steer)
    shown = [found.toe, found.camber, found.track, found.roll_centre, found.bump_steer, found.motion_ratio["spring"]]
    return jnp.stack([*shown, found.caster, found.kingpin_inclination, found.scrub_radius, found.caster_trail])


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


LOADS = ("longitudinal_force", "lateral_force", "aligning_moment")


@pytest.mark.slow
@pytest.mark.parametrize("value", [wishbone_curves, bushed_curves])
def test_derivatives_by_hard_points(value):
    """Forward and reverse, under jit and vmap, against central differences."""
    # Compiled outside of traces.
    library("double_wishbone"), bushed()
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


@pytest.mark.slow
def test_bump_steer_removed_by_the_height_of_the_rack():
    system, P = library("double_wishbone").system, suspensions.arrays(suspensions.WISHBONE)

    def toe(height):
        rack = jnp.asarray(P["rack"]).at[2].set(height)
        rod = jnp.linalg.norm(rack - P["steering_arm"])
        raised = mb.with_parameters(system, {"tie_rod.point_a": rack, "tie_rod.length": rod})
        return curves_of(raised, travel=TRAVEL, steer=None).toe

    change = jax.jit(lambda height: (toe(height), jax.jacfwd(toe)(height)))
    height, before = 0.29, np.ptp(change(0.29)[0])
    for _ in range(6):
        residual, slopes = change(height)
        height = height - slopes @ residual / (slopes @ slopes)
    residual, slopes = change(height)
    assert np.ptp(residual) < 0.4 * before and abs(slopes @ residual) < 1e-8
    points = suspensions.WISHBONE | {"rack": (*suspensions.WISHBONE["rack"][:2], float(height))}
    expected = [suspensions.angles(*suspensions.wishbone(points, z)[:2], RADIUS)[0] for z in TRAVEL]
    np.testing.assert_allclose(residual, expected, rtol=0, atol=1e-9)


# Bushings


@pytest.mark.slow
def test_stiff_bushings_tend_to_hinges():
    """By the inverse of their stiffness, as do the compliances to zero."""
    rigid, errors, compliances = curves("double_wishbone"), [], []
    for stiffness in (1e8, 1e9):
        soft = curves("double_wishbone", joints="bushings", bushing=(stiffness, 0.0))
        assert soft.freedoms == 10
        names = ("toe", "camber", "track", "roll_centre")
        errors.append([float(np.max(np.abs(getattr(soft, name) - getattr(rigid, name)))) for name in names])
        compliances.append(np.asarray(soft.compliance["lateral_force"]["toe"]))
    np.testing.assert_allclose(np.divide(*errors), 10.0, rtol=0.05)
    np.testing.assert_allclose(compliances[0] / compliances[1], 10.0, rtol=0.05)


# Refusals


@functools.cache
def small():
    """A wheel on a swing arm."""
    return swing().compile()


def arm():
    return spatial.Body("arm", mass=5.0, inertia=np.eye(3), position=(0.0, 0.7, 0.3))


def swing():
    hinge = spatial.Revolute("hinge", "ground", "arm", point=(0.0, 0.3, 0.3), axis=(1.0, 0.0, 0.0))
    return mb.Scene([arm()], joints=[hinge])


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"carrier": "am"}, "carrier.*'arm'"),
        ({"axis": (0.0, 0.0, 2.0)}, "parallel to the travel"),
        ({"axis": (0.0, 0.0, 0.0)}, "a direction"),
        ({"radius": -0.3}, "positive"),
        ({"side": "port"}, "'left' or 'right'"),
        ({"centre": (0.0, -0.7, 0.0)}, "plane y = 0"),
        ({"travel": np.zeros((2, 2))}, "number or a vector"),
        ({"steer": ("hinge.angle", 0.1)}, "by name"),
        ({"steer": {"hinge.angel": 0.1}}, "hinge.angle"),
        ({"steer": {"hinge.point_a": 0.1}}, r"hinge.point_a\[0\]"),
        ({"steer": {"hinge.angle": 0.1}}, "too few for travel and hinge.angle"),
        ({"springs": ["coil"]}, "spring"),
        ({"springs": "coil"}, "sequence"),
        ({"loads": {"side_force": 1.0}}, "lateral_force"),
        ({"loads": 3.0}, "by name"),
    ],
)
def test_arguments_are_checked(changes, message):
    given = {"carrier": "arm", "radius": 0.3, "travel": 0.05} | changes
    with pytest.raises(ValueError, match=message):
        mb.kinematics_and_compliance(small(), given.pop("carrier"), **given)


def test_systems_are_checked():
    floor = mb.Stop("floor", "hinge.angle", lower=-0.2, upper=0.4)
    with pytest.raises(ValueError, match="remove floor"):
        mb.kinematics_and_compliance(small_with(floor), "arm", radius=0.3, travel=0.0)
    flat = mb.Scene([planar.Body("bar", mass=1.0, inertia=1.0)]).compile()
    with pytest.raises(ValueError, match="in space"):
        mb.kinematics_and_compliance(flat, "bar", radius=0.3, travel=0.0)


def small_with(stop):
    return swing().extended(joints=[stop]).compile()


@pytest.mark.slow
def test_a_wheel_on_a_swing_arm():
    """On a circle about the hinge, whose place is the roll centre of the wheel alone."""
    found = mb.kinematics_and_compliance(small(), "arm", radius=0.3, travel=TRAVEL, springs=["hinge.angle"])
    angle = np.arcsin(TRAVEL / 0.4)
    np.testing.assert_allclose(found.camber, -angle, atol=1e-12)
    np.testing.assert_allclose(found.motion_ratio["hinge.angle"], -1 / (0.4 * np.cos(angle)), rtol=1e-12)
    patch = np.stack([0.3 + 0.4 * np.cos(angle) + 0.3 * np.sin(angle), 0.3 + TRAVEL - 0.3 * np.cos(angle)])
    height = patch[0] * (patch[1] - 0.3) / (0.3 - patch[0])
    np.testing.assert_allclose(found.roll_centre, height, rtol=1e-10)
    with pytest.raises(ValueError, match=r"travel = \+0\.5 m.*out of reach.*hinge"):
        mb.kinematics_and_compliance(small(), "arm", radius=0.3, travel=0.5)
    missed = mb.kinematics_and_compliance(small(), "arm", radius=0.3, travel=np.array([0.1, 0.5]), throw=False)
    assert np.isfinite(missed.camber[0]) and np.isnan(missed.camber[1])


@pytest.mark.slow
def test_a_steer_must_move_the_wheel():
    system = library("double_wishbone").system
    with pytest.raises(ValueError, match=r"spring.point_a\[0\]' does not move 'upright'"):
        curves_of(system, steer={"spring.point_a[0]": RACK})


@pytest.mark.slow
def test_a_freedom_without_forces_is_named():
    """A rack that nothing holds; a spring would, since steering at a given height moves its ends."""
    scene = on_a_rack()
    free = mb.Scene(scene.bodies, joints=scene.joints)
    with pytest.raises(ValueError, match=r"no force resists.*rack\.y.*steer"):
        curves_of(free.compile(), travel=0.0, steer=None)
