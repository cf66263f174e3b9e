"""Dry friction that sticks and slips, against closed forms: times, motions, forces, impulses."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly
from scenarios import Derived, Scenario
from scipy.integrate import quad

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.contacts.impact import impact
from jaxmb.contacts.tolerance import ContactTolerance
from jaxmb.manifold import Projection
from jaxmb.parts import terrain
from jaxmb.parts.modes import CLOSED, STICK
from jaxmb.solvers import Adams, Hermite
from jaxmb.system.instant import Instant

MOST_PROGRAMS = 70

G = 9.81
DOWN, DOWN_3D = mb.Gravity((0.0, -G)), mb.Gravity((0.0, 0.0, -G))
UP, EAST = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
FLAT = terrain.Flat()
METHODS = {
    "Adams": {},
    "Dopri8": {"solver": diffrax.Dopri8()},
    "Tsit5": {"solver": diffrax.Tsit5()},
    "Projection": {"manifold": Projection()},
    "Hermite": {"solver": Hermite()},
}


def rail(axis=(1.0, 0.0), name="rail", a="ground", b="block"):
    return planar.Prismatic(name, a, b, axis=axis, point_a=(0.0, 0.0), point_b=(0.0, 0.0))


def slider(angle=0.0, velocity=3.0, forces=(), **coefficients):
    """A block on an incline, along which it moves."""
    along = np.array([np.cos(angle), np.sin(angle)])
    block = planar.Body("block", mass=2.0, inertia=0.1, velocity=velocity * along)
    rub = mb.DryFriction("rub", "rail", **coefficients)
    return mb.Scene([block], joints=[rail(along)], forces=[DOWN, rub, *forces]).compile()


def test_block_on_a_belt_sticks_and_slips():
    """On a spring: in stick friction answers it, up to the limit; a motion goes on from where another one ended."""
    mass, stiffness, speed, slip, stick = 2.0, 50.0, 0.5, 0.2, 0.35
    block = planar.PointMass("block", mass=mass, velocity=(speed, 0.0))
    spring = planar.SpringDamper("spring", "ground", "block", stiffness=stiffness, free_length=0.0)
    belt = mb.RigidContact("belt", "block", terrain=FLAT)
    rub = mb.DryFriction("rub", "belt", coefficient=slip, static_coefficient=stick, speed=speed)
    system = mb.Scene([block], joints=[belt], forces=[DOWN, spring, rub]).compile()

    @jit_quickly
    def run(state, t0, t1, ts):
        # The table of events would be as large a program as the motion.
        motion = mb.simulate(system, state, t0=t0, t1=t1, saveat=ts, rtol=1e-10, max_steps=300, max_events=8)
        block, rub, mode = motion["block"], motion.reactions["rub"], motion["rub"].mode
        seen = block.position[:, 0], block.velocity[:, 0], rub.force[:, 0], mode
        return jnp.stack(seen), motion.found_events.times, motion.ys

    # It swings about the place at which the friction of slip balances the spring.
    limit, middle, w = stick * mass * G / stiffness, slip * mass * G / stiffness, np.sqrt(stiffness / mass)
    further, first = limit - middle, limit / speed
    slipping = (2 * np.pi - 2 * np.arctan(further * w / speed)) / w
    times = first + np.array([0.0, slipping, slipping + 2 * further / speed])
    ts = np.array([0.2, 0.8, 1.4, 1.5])
    swings = middle + further * np.cos(w * (0.8 - first)) + speed / w * np.sin(w * (0.8 - first))
    known = np.array([0.2 * speed, swings, *(middle - further + speed * (ts[2:] - times[1]))])
    (x, v, force, mode), found, states = jax.tree.map(np.asarray, run(system.guess, 0.0, 1.6, ts))
    np.testing.assert_allclose(x, known, rtol=1e-9)
    np.testing.assert_allclose(v[[0, 2, 3]], speed, rtol=1e-12)
    np.testing.assert_allclose(force, [stiffness * x[0], slip * mass * G, *(stiffness * x[2:])], rtol=1e-9)
    np.testing.assert_array_equal(mode, [STICK, -1.0, STICK, STICK])
    np.testing.assert_allclose(found[np.isfinite(found)], times, rtol=1e-9)
    # From where it sticks, up to the next slip.
    stuck = jax.tree.map(lambda y: y[2], states)
    (x, *_), found, _ = jax.tree.map(np.asarray, run(stuck, 1.4, 1.6, np.array([1.42, 1.44, 1.46, 1.5])))
    np.testing.assert_allclose(x[-1], known[-1], rtol=1e-9)
    np.testing.assert_allclose(found[np.isfinite(found)], times[2:], rtol=1e-9)


@pytest.mark.slow
def test_coefficients_and_forces_follow_their_inputs():
    """The numbers of the laws at each time; stick never has the smaller one."""
    brake = mb.Series([0.0, 1.0], [0.2, 0.6], "linear")
    for static, limit in ((None, [0.3, 0.5]), (0.4, [0.4, 0.5])):
        system = mb.with_inputs(slider(coefficient=0.3, static_coefficient=static), {"rub.coefficient": brake})
        laws = [system.contact_laws(t).slip for t in (0.25, 0.75)]
        np.testing.assert_allclose([x.ask("coefficient", jnp.zeros(1))[0] for x in laws], [0.3, 0.5])
        np.testing.assert_allclose([x.ask("limit")[0] for x in laws], limit)
    laws = [mb.with_inputs(clamped(), {"rub.force": brake}).contact_laws(t).slip for t in (0.25, 0.75)]
    np.testing.assert_allclose([x.ask("resistance", jnp.zeros(1))[0] for x in laws], [0.3, 0.5])
    np.testing.assert_allclose([x.ask("hold")[0] for x in laws], [0.3, 0.5])
    # Without a static force the force of slip holds in stick too.
    assert mb.with_parameters(clamped(), {"rub.force": 0.5}).contact_laws(0.0).slip.ask("hold") == 0.5
    ball = planar.PointMass("ball", mass=1.0, position=(0.0, 0.1))
    floor = mb.RigidContact("floor", "ball", terrain=FLAT, restitution=0.5)
    with pytest.raises(ValueError, match=r"'floor\.restitution' must be constant: .*restitution.*with_parameters"):
        mb.with_inputs(mb.Scene([ball], joints=[floor]).compile(), {"floor.restitution": brake})


# Motions in closed form

SCENARIOS = {}


def scenario(function):
    SCENARIOS[function.__name__] = function
    return function


def case(*arguments):
    """A scenario for each argument."""

    def register(function):
        for own in arguments:
            SCENARIOS[f"{function.__name__}: {own}"] = functools.partial(function, own)
        return function

    return register


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENARIOS)
def test_motion_is_that_of_its_closed_form(name):
    SCENARIOS[name]().check()


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_block_stops_by_all_methods(method):
    """By its weight and by friction of constant size together."""
    rub = mb.JointFriction("clamp", "rail.displacement", force=2.0, static_force=3.0, exact=True)
    system, slow = slider(forces=[rub], coefficient=0.1), 1.0 + 0.1 * G
    motion = mb.simulate(system, mb.assemble(system), t1=3.0, saveat=[3.0], rtol=1e-9, **METHODS[method])
    (stop, *_) = motion.events
    np.testing.assert_allclose(stop.time, 3.0 / slow, rtol=1e-8)
    assert stop.impulse == stop.kinetic_energy_lost == 0
    np.testing.assert_allclose(motion["block"].position[0, 0], 4.5 / slow, rtol=1e-8)
    np.testing.assert_allclose(motion["block"].velocity, 0.0, atol=1e-12)


@case(0.29, 0.31)
def block_on_an_incline(tan):
    """Below the angle of friction nothing moves, above it the block slides down; forces are those of statics."""
    angle, ts = np.arctan(tan), np.array([0.5, 1.0])
    along = np.array([np.cos(angle), np.sin(angle)])
    slides = max(G * (np.sin(angle) - 0.3 * np.cos(angle)), 0.0) if tan > 0.3 else 0.0
    held = 2.0 * G * (0.3 * np.cos(angle) if tan > 0.3 else np.sin(angle))
    values = {"block.position": -0.5 * slides * ts[:, None] ** 2 * along, "rub.force": [held * along] * 2}
    return Scenario(slider(angle, 0.0, coefficient=0.3), 1.0, [], values, ts)


@case("planar", "spatial")
def wheel_on_a_pin(space):
    if space == "planar":
        wheel = planar.Body("wheel", mass=2.0, inertia=0.3, angular_velocity=4.0)
        pin, down = planar.Revolute("pin", "ground", "wheel", point=(0.0, 0.0)), DOWN
    else:
        wheel = spatial.Body("wheel", mass=2.0, inertia=(0.2, 0.3, 0.2), angular_velocity=(0.0, 4.0, 0.0))
        pin = spatial.Revolute("pin", "ground", "wheel", point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
        down = DOWN_3D
    rub, slow = mb.DryFriction("rub", "pin", coefficient=0.4, radius=0.05), 0.4 * 2.0 * G * 0.05 / 0.3
    system = mb.Scene([wheel], joints=[pin], forces=[down, rub]).compile()
    values = {"pin.angle": 0.5 * 4.0**2 / slow, "pin.angle_rate": 0.0}
    return Scenario(system, 4.0, [("rub", "stick", 4.0 / slow)], values, near=1e-8)


@scenario
def discs_side_by_side():
    """They come nearer by rounding errors, which neither close their contact nor end the run."""
    disc = {"mass": 1.0, "inertia": 0.02}
    discs = [
        planar.Body(f"disc{k}", position=(0.4 * k, 0.2), velocity=(v, 0.0), angular_velocity=-5 * v, **disc)
        for k, v in enumerate((0.5, 0.5 - 5e-12))
    ]
    contacts = [mb.RigidContact(f"floor{k}", f"disc{k}", terrain=FLAT, radius=0.2) for k in range(2)]
    contacts.append(mb.RigidBallContact("pair", "disc0", "disc1", radius_a=0.2, radius_b=0.2))
    rubs = [mb.DryFriction(f"rub {part.name}", part.name, coefficient=0.3) for part in contacts]
    system = mb.Scene(discs, joints=contacts, forces=[DOWN, *rubs]).compile()
    values = {f"disc{k}.position": [0.5 + 0.4 * k, 0.2] for k in range(2)}
    return Scenario(system, 1.0, [], values, options={"rtol": 1e-8, "max_events": 10}, near=1e-10)


def disc(coefficient=0.2, height=0.2, velocity=3.0, spin=0.0, restitution=0.0):
    """A disc with the radius 0.2 m above ground."""
    moving = {"velocity": (velocity, 0.0), "angular_velocity": spin}
    body = planar.Body("disc", mass=1.5, inertia=0.5 * 1.5 * 0.2**2, position=(0.0, height), **moving)
    floor = mb.RigidContact("floor", "disc", terrain=FLAT, radius=0.2, restitution=restitution)
    rub = mb.DryFriction("rub", "floor", coefficient=coefficient)
    return mb.Scene([body], joints=[floor], forces=[DOWN, rub]).compile()


@scenario
def disc_that_rolls_after_slipping():
    slow = 0.2 * G
    values = {
        "disc.velocity": [[3.0 - slow * 0.3, 0.0], [2.0, 0.0]],
        "disc.angular_velocity": [-2 * slow * 0.3 / 0.2, -2.0 / 0.2],
        "rub.force": [[-slow * 1.5, 0.0], [0.0, 0.0]],
    }
    return Scenario(disc(), 1.0, [("rub", "stick", 3.0 / (3 * slow))], values, (0.3, 1.0))


@case((0.2, 0.0), (0.05, 0.0), (0.2, -40.0))
def disc_that_bounces(numbers):
    """The impulse of friction is in the cone, against the slip that remains, or such that none remains."""
    coefficient, spin = numbers
    falls = np.sqrt(2 * 0.8 * G)
    normal = 1.5 * 1.5 * falls
    # The slip of the rim is that of the disc and of its spin, and changes by 3 / m for each unit of impulse.
    impulse = np.clip(-1.5 * (2.0 + 0.2 * spin) / 3, -coefficient * normal, coefficient * normal)
    values = {"disc.angular_velocity": spin + 2 * impulse / 1.5 / 0.2}
    values["disc.velocity"] = [2.0 + impulse / 1.5, 0.5 * falls - G * (0.5 - falls / G)]
    events = [("floor", "impact", falls / G), ("rub", "impact", falls / G)]
    return Scenario(disc(coefficient, 1.0, 2.0, spin, 0.5), 0.5, events, values, impulses=[normal, impulse])


@scenario
def block_that_rebounds_from_a_stop():
    """The impact turns the slip around, has no impulse of friction, and it slips back from the impact on."""
    stop = mb.Stop("stop", "rail.displacement", upper=0.5, restitution=0.5)
    block = planar.Body("block", mass=2.0, inertia=0.1, velocity=(3.0, 0.0))
    rub = mb.JointFriction("rub", "rail.displacement", force=2.0, static_force=3.0, exact=True)
    system = mb.Scene([block], joints=[rail(), stop], forces=[rub]).compile()
    hits = 3.0 - np.sqrt(9.0 - 2 * 0.5)
    speed = 0.5 * (3.0 - hits)
    events = [("stop", "impact", hits), ("rub", "slip", hits), ("rub", "stick", hits + speed)]
    return Scenario(system, 3.0, events, {"block.position": [0.5 - 0.5 * speed**2, 0.0]})


@scenario
def friction_of_size_zero():
    block = planar.Body("block", mass=2.0, inertia=0.1, velocity=(3.0, 0.0))
    rub = mb.JointFriction("rub", "rail.displacement", force=0.0, exact=True)
    system = mb.Scene([block], joints=[rail()], forces=[rub]).compile()
    return Scenario(system, 3.0, [], {"block.position": [9.0, 0.0]})


@case("hinge.angle", "cord.length")
def hinge_that_stops_after_full_turns(on):
    """The friction of a cord on a drum of the radius r takes r times its force."""
    inertia, spin, moment, radius = 0.4, 30.0, 0.5, 0.1
    wheel = spatial.Body("wheel", mass=1.0, inertia=(0.2, 0.3, inertia), angular_velocity=(0.0, 0.0, spin))
    hinge = spatial.Revolute("hinge", "ground", "wheel", point=(0.0, 0.0, 0.0), axis=UP)
    cord = mb.FixedTendon("cord", ("hinge.angle",), coefficients=(radius,))
    brake = mb.JointFriction("brake", on, force=moment if on == "hinge.angle" else moment / radius, exact=True)
    system, slow = mb.Scene([wheel], joints=[hinge, cord], forces=[brake]).compile(), moment / inertia
    turned = np.array([spin * 10.0 - 0.5 * slow * 10.0**2, 0.5 * spin**2 / slow])
    moments = [[0.0, 0.0, -moment], [0.0, 0.0, 0.0]]
    values = {"cord.length": radius * turned, "hinge.angle": turned, "brake.moment": moments}
    return Scenario(system, 30.0, [("brake", "stick", spin / slow)], values, (10.0, 30.0))


MASS, RADIUS, COEFFICIENT = 2.0, 0.4, 0.3
# With this moment of inertia slip changes as the velocity of a particle does, along a straight line.
INERTIA = MASS * RADIUS**2


def shaft(rub, forces=(), velocity=0.0, spin=0.0):
    """A shaft in a sleeve, across its weight; it turns and slides."""
    moving = {"velocity": (velocity, 0.0, 0.0), "angular_velocity": (spin, 0.0, 0.0)}
    body = spatial.Body("shaft", mass=MASS, inertia=(INERTIA, 0.3, 0.3), **moving)
    pin = spatial.Cylindrical("pin", "ground", "shaft", point=(0.0, 0.0, 0.0), axis=EAST)
    return mb.Scene([body], joints=[pin], forces=[DOWN_3D, rub, *forces]).compile()


def in_sleeve(**options):
    return mb.DryFriction("rub", "pin", radius=RADIUS, **({"coefficient": COEFFICIENT} | options))


@scenario
def shaft_that_turns_and_slides():
    """It comes to rest at once: friction is against the direction of slip, which stays."""
    slip, slow = np.array([3.0, 5.0 * RADIUS]), COEFFICIENT * G
    speed = np.linalg.norm(slip)
    along = np.outer([speed * 0.5 - slow * 0.125, 0.5 * speed**2 / slow], slip / speed)
    force = -COEFFICIENT * MASS * G * slip / speed
    values = {
        "shaft.position": [[x, 0.0, 0.0] for x in along[:, 0]],
        "pin.angle": along[:, 1] / RADIUS,
        "rub.force": [[force[0], 0.0, 0.0], [0.0, 0.0, 0.0]],
        "rub.moment": [[force[1] * RADIUS, 0.0, 0.0], [0.0, 0.0, 0.0]],
    }
    system = shaft(in_sleeve(), velocity=3.0, spin=5.0)
    return Scenario(system, 2.0, [("rub", "stick", speed / slow)], values, (0.5, 2.0))


@scenario
def shaft_that_a_moment_helps_to_move():
    """It starts when the moment and a force that grows together reach the limit, in their direction."""
    moment, rate = 0.8 * 0.4 * MASS * G * RADIUS, 2.0
    law = lambda x, v, t, p: jnp.zeros((1, 6)).at[0, 0].set(p["rate"] * t)
    push = mb.Force("push", ["shaft"], law, parameters={"rate": rate})
    system = shaft(in_sleeve(static_coefficient=0.4), [mb.JointForce("motor", "pin.angle", force=moment), push])
    starts = 0.6 * 0.4 * MASS * G / rate
    values = {"shaft.position": [[0.0, 0.0, 0.0]], "pin.angle": [0.0]}
    return Scenario(system, starts + 1e-3, [("rub", "slip", starts)], values, (starts - 1e-3,))


@scenario
def friction_along_the_axis_alone():
    """By name friction acts in one coordinate; the shaft goes on turning."""
    rub, slow = mb.DryFriction("rub", "pin.displacement", coefficient=COEFFICIENT), COEFFICIENT * G
    values = {"shaft.angular_velocity": [5.0, 0.0, 0.0], "shaft.position": [4.5 / slow, 0.0, 0.0]}
    return Scenario(shaft(rub, velocity=3.0, spin=5.0), 2.0, [("rub", "stick", 3.0 / slow)], values)


def block_on_a_belt(on):
    """A block that slips on a moving face or terrain."""
    rub = mb.DryFriction("rub", on, coefficient=COEFFICIENT, speed=(0.8, -0.6))
    if on == "face":
        joint = spatial.Planar("face", "ground", "block", point=(0.0, 0.0, 0.0), axis=UP, x_a=EAST, x_b=EAST)
        block = spatial.Body("block", mass=MASS, inertia=(0.1, 0.1, 0.1), velocity=(2.0, 1.0, 0.0))
    else:
        joint = mb.RigidContact("floor", "block", terrain=FLAT)
        block = spatial.PointMass("block", mass=MASS, velocity=(2.0, 1.0, 0.0))
    return mb.Scene([block], joints=[joint], forces=[DOWN_3D, rub]).compile()


@scenario
def ball_that_rolls_after_slipping():
    """The direction of slip stays, and slip ends when two sevenths of it have gone into the motion of the ball."""
    mass, radius, velocity, spin = 0.17, 0.03, np.array([1.0, 0.3]), (5.0, -30.0, 8.0)
    moving = {"velocity": (*velocity, 0.0), "angular_velocity": spin}
    body = spatial.Body("ball", mass=mass, inertia=spatial.sphere(mass, radius), position=(0.0, 0.0, radius), **moving)
    floor = mb.RigidContact("floor", "ball", terrain=FLAT, radius=radius)
    rub = mb.DryFriction("rub", "floor", coefficient=0.2)
    slip = velocity + radius * np.array([-spin[1], spin[0]])
    stops, along = np.linalg.norm(slip) * 2 / (7 * 0.2 * G), slip / np.linalg.norm(slip)
    ts = np.array([0.5 * stops, 1.0])
    slides = np.minimum(ts, stops)[:, None]
    at = velocity * ts[:, None] - 0.2 * G * along * (slides**2 / 2 + (ts[:, None] - slides) * slides)
    values = {
        "ball.position": np.append(at, np.full((2, 1), radius), axis=1),
        "rub.force": [[*(-0.2 * mass * G * along), 0.0], [0.0, 0.0, 0.0]],
    }
    system = mb.Scene([body], joints=[floor], forces=[DOWN_3D, rub]).compile()
    return Scenario(system, 1.0, [("rub", "stick", stops)], values, ts)


@case(0.05, 0.6)
def balls_that_strike_each_other(friction):
    """In any direction: the impulse along the line of the centres is that of restitution; across it, at most that of
    friction, and what ends the slip.
    """
    normal, radius, restitution = np.array([0.48, -0.6, 0.64]), 0.1, 0.7
    velocities, spins = np.array([[1.0, 0.2, 0.1], [-0.3, 0.9, -0.6]]), np.array([[1.0, 4.0, -2.0], [0.5, -3.0, 6.0]])
    # They are as far from each other that they touch when the line of their centres is the normal.
    relative = velocities[1] - velocities[0]
    time = 0.05 / -np.dot(relative, normal)
    start = 2 * radius * normal - relative * time
    bodies = [
        spatial.Body(name, mass=1.0, inertia=spatial.sphere(1.0, radius), position=at, velocity=v, angular_velocity=w)
        for name, at, v, w in zip("ab", (np.zeros(3), start), velocities, spins, strict=True)
    ]
    pair = mb.RigidBallContact("pair", "a", "b", radius_a=radius, radius_b=radius, restitution=restitution)
    rub = mb.DryFriction("rub", "pair", coefficient=friction)
    of_a, of_b = (v + np.cross(w, s * radius * normal) for v, w, s in zip(velocities, spins, (1, -1), strict=True))
    slip = (of_b - of_a) - np.dot(of_b - of_a, normal) * normal
    push = -0.5 * (1 + restitution) * np.dot(relative, normal)
    size = min(friction * push, np.linalg.norm(slip) / 7)
    impulse = push * normal - size * slip / np.linalg.norm(slip)
    turned = np.cross(radius * normal, impulse) / (0.4 * radius**2)
    # Balls turn about their axes at constant rates, in the axes of the ground.
    values = {"a.velocity": velocities[0] - impulse, "b.velocity": velocities[1] + impulse}
    events = [("pair", "impact", time), ("rub", "impact", time)]
    system = mb.Scene(bodies, joints=[pair], forces=[rub]).compile()

    class OfBalls(Scenario):
        def check(self, **options):
            motion = super().check(**options)
            for name, spin in zip("ab", spins, strict=True):
                now = mb.rotations.rotate(motion[name].orientation[-1], motion[name].angular_velocity[-1])
                np.testing.assert_allclose(now, spin - turned, atol=1e-8)
            return motion

    return OfBalls(system, 2 * time, events, values, impulses=[push, size])


@case(0.1, 0.204, 0.3)
def table_on_three_feet(friction):
    """It stands up to the slope of the friction, though some of its feet, which carry less, cannot hold their share,
    and slides beyond.
    """
    slides = 0.125 * G * max(np.sin(0.2) - friction * np.cos(0.2), 0.0)
    values = {"table.position": [slides, 0.0, 0.4]}
    return Scenario(feet(3, friction), 0.5, [], values, options={"rtol": 1e-8}, near=1e-8)


def feet(count, friction=0.3):
    """A table on a slope, whose feet share forces that are not determined."""
    turns = 2 * np.pi * np.arange(count) / count
    feet = {f"foot{k}": (0.5 * np.cos(a), 0.5 * np.sin(a), -0.4) for k, a in enumerate(turns)}
    body = spatial.Body("table", mass=10.0, inertia=(1.0, 1.0, 1.0), position=(0.0, 0.0, 0.4))
    floors = [mb.RigidContact(k, "table", terrain=FLAT, centre=at) for k, at in feet.items()]
    rubs = [mb.DryFriction(f"rub {k}", k, coefficient=friction) for k in feet]
    gravity = mb.Gravity((G * np.sin(0.2), 0.0, -G * np.cos(0.2)))
    return mb.Scene([body], joints=floors, forces=[gravity, *rubs]).compile()


# Stick and slip by turns


@case("a body", "a plate in space")
def block_on_a_spring_on_a_belt(belt):
    """It sticks until the spring is stretched by the limit, and slips back."""
    mass, stiffness, speed, slip, stick = 2.0, 50.0, 0.5, 0.2, 0.35
    along = np.array([1.0, 0.0]) if belt == "a body" else np.array([np.cos(0.5), np.sin(0.5), 0.0])
    numbers = {"coefficient": slip, "static_coefficient": stick}
    spring, down = {"stiffness": stiffness, "free_length": 0.0}, DOWN
    block = planar.Body("block", mass=mass, inertia=0.1, velocity=speed * along[:2])
    bodies, own = [block], planar.SpringDamper("spring", "ground", "block", **spring)
    if belt == "a body":
        bodies.append(planar.Body("belt", mass=mass, inertia=0.1, velocity=speed * along))
        joints = [rail(b="belt"), rail(name="on", a="belt"), mb.JointDriver("drive", "rail.displacement", rate=speed)]
    else:
        bodies = [spatial.Body("plate", mass=1.0, inertia=(1.0, 1.0, 1.0), velocity=speed * along)]
        bodies.append(spatial.PointMass("block", mass=mass, velocity=speed * along))
        slides = spatial.Prismatic("rail", "ground", "plate", axis=along, point=(0.0, 0.0, 0.0))
        drive = mb.JointDriver("drive", "rail.displacement", rate=speed)
        joints = [slides, drive, mb.RigidPlaneContact("on", "plate", "block", normal=UP)]
        own, down = spatial.SpringDamper("spring", "ground", "block", **spring), DOWN_3D
    rub = mb.DryFriction("rub", "on", **numbers)
    system = mb.Scene(bodies, joints=joints, forces=[down, own, rub]).compile()
    further, w = (stick - slip) * mass * G / stiffness, np.sqrt(stiffness / mass)
    first = stick * mass * G / stiffness / speed
    slipping = (2 * np.pi - 2 * np.arctan(further * w / speed)) / w
    slips = first + (2 * further / speed + slipping) * np.arange(3)
    times = np.stack([slips, slips + slipping], axis=1).ravel()[:-1]
    events = [("rub", ("slip", "stick")[k % 2], time) for k, time in enumerate(times)]
    return Scenario(system, times[-1] + 0.05, events, near=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, diffrax.Dopri8()], ids=["Adams", "Dopri8"])
def test_block_that_is_pushed_to_and_fro_slips_at_each_peak(solver):
    """While it sticks nothing moves, so that no error estimate asks for short steps."""
    push = mb.JointForce("push", "rail.displacement", force=0.0)
    rub = mb.DryFriction("rub", "rail", coefficient=0.5)
    block, gravity = planar.Body("block", mass=1.0, inertia=0.1), mb.Gravity((0.0, -10.0))
    system = mb.Scene([block], joints=[rail()], forces=[gravity, rub, push]).compile()
    inputs = {"push.force": lambda t: 5.2 * jnp.sin(2 * jnp.pi * t)}
    motion = mb.simulate(system, mb.assemble(system), t1=3.0, inputs=inputs, solver=solver)
    slips = [event.time for event in motion.events if event.kind == "slip"]
    np.testing.assert_allclose(slips, np.arcsin(5.0 / 5.2) / (2 * np.pi) + 0.5 * np.arange(6), rtol=1e-8)
    assert [event.kind for event in motion.events] == 6 * ["slip", "stick"]
    # It comes back where it was.
    np.testing.assert_allclose(motion["block"].position[-1, 0], 0.0, atol=1e-8)


def clamped(force=1.0, **options):
    """A block of 2 kg on a level rail, with friction of constant size and a push."""
    rub = mb.JointFriction("rub", "rail.displacement", force=force, exact=True, **options)
    push = mb.JointForce("push", "rail.displacement", force=0.0)
    return mb.Scene([planar.Body("block", mass=2.0, inertia=0.1)], joints=[rail()], forces=[rub, push]).compile()


@scenario
def clamp_that_closes_and_fails():
    """It stops the block, holds it against a push, and lets it go when its force falls below that push."""
    force = mb.Series([0.0, 0.5, 1.25, 2.25], [2.0, 6.0, 6.0, 0.0], "linear")
    inputs = {"rub.force": force, "push.force": lambda t: 3.0 + 0.0 * t}
    # 2 v' = 3 - 2 - 8 t until t = 0.5, then 3 - 6; it goes on when 13.5 - 6 t = 3.
    stop, go, end = 0.5 + (1.0 + (0.5 - 4 * 0.5**2) / 2) / 1.5, 1.75, 2.15
    values = {"rail.displacement_rate": 1.5 * (end - go) ** 2}
    events, start = [("rub", "stick", stop), ("rub", "slip", go)], {"rates": {"rail.displacement": 1.0}}
    return Scenario(clamped(), end, events, values, start=start, options={"inputs": inputs}, near=1e-8)


@case("jump", "line", "function")
def brake_that_fails_on_a_slope(way):
    """It holds until the coefficient falls below the slope: at a jump, or at the time at which a line crosses it."""
    slope, end = 0.2, 0.99
    limit = np.tan(slope)
    brake, begins, coefficient = {
        "jump": (mb.Series([0.0, 0.3, 1.0], [0.5, 0.1, 0.1], "held"), 0.3, lambda t: 0.1 + 0 * t),
        "line": (mb.Series([0.0, 1.0], [0.5, 0.0], "linear"), (0.5 - limit) / 0.5, lambda t: 0.5 - 0.5 * t),
        "function": (lambda t: 0.5 * jnp.exp(-t), np.log(0.5 / limit), lambda t: 0.5 * np.exp(-t)),
    }[way]
    times, weights = np.polynomial.legendre.leggauss(20)
    times, weights = begins + (end - begins) * (times + 1) / 2, weights * (end - begins) / 2
    rate = -G * weights @ (np.sin(slope) - coefficient(times) * np.cos(slope))
    values = {"rail.displacement_rate": [0.0, rate]}
    system, events = slider(slope, 0.0, coefficient=0.3), [("rub", "slip", begins)]
    return Scenario(system, end, events, values, (0.25, end), options={"inputs": {"rub.coefficient": brake}}, near=1e-7)


@scenario
def stick_with_the_larger_coefficient():
    """An input that exceeds the static coefficient counts in stick as well."""
    assert np.tan(0.2) < 0.25
    brake = {"rub.coefficient": mb.Series([0.0, 0.5], [0.25, 0.6], "linear")}
    system = slider(0.2, 0.0, coefficient=0.3, static_coefficient=0.3)
    return Scenario(system, 0.5, [], {"rail.displacement": 0.0}, options={"inputs": brake})


@case(1, -1)
def gear_with_losses(sign):
    """A motor drives a loaded shaft, or the load the motor, from where its moment is that of the load through the
    efficiency of the gear.
    """
    loss, ratio, load, ramp, end, of_motor, of_load = 0.1, 0.5, 2.0, 0.4, 1.5, 0.3, 0.8
    inputs = {"drive.force": lambda t: ratio * load + sign * ramp * t}
    efficiency = 1 - sign * loss
    start = sign * ratio * load * (1 / efficiency - 1) / ramp
    assert 0 < start < 0.5 * end
    angle = sign * ramp * (end - start) ** 3 / (6 * (of_motor + ratio**2 * of_load / efficiency))
    return Scenario(
        gearbox(), end, [("loss", "slip", start)], {"motor pin.angle": angle}, options={"inputs": inputs}, near=1e-8
    )


def gearbox(coefficient=0.1, **options):
    """A motor that drives a loaded shaft by a gear, at rest in balance."""
    bodies = [planar.Body(name, mass=1.0, inertia=inertia) for name, inertia in (("motor", 0.3), ("shaft", 0.8))]
    joints = [
        planar.Revolute("motor pin", "ground", "motor", point=(0.0, 0.0)),
        planar.Revolute("shaft pin", "ground", "shaft", point=(0.0, 0.0)),
        mb.JointCoupling("gear", "shaft pin.angle", "motor pin.angle", coefficients=(0.0, 0.5)),
    ]
    forces = [
        mb.DryFriction("loss", "gear", coefficient=coefficient, **options),
        mb.JointForce("load", "shaft pin.angle", force=-2.0),
        mb.JointForce("drive", "motor pin.angle", force=0.0),
    ]
    return mb.Scene(bodies, joints=joints, forces=forces).compile()


def test_reactions_of_dry_friction_are_linear_in_the_multipliers():
    """They are sums over the forces of all laws, which may act either way: those along a coupling have a sign."""
    for system in (gearbox(), slider(coefficient=0.3)):
        at, random = Instant.of(system, jnp.zeros(()), system.guess), np.random.default_rng(0)
        a, b = random.normal(size=(2, system.acceleration_rows))
        reactions = jit_quickly(lambda multipliers, at=at: jax.vmap(at.friction_reactions)(multipliers))
        of_a, of_b, of_both = np.asarray(reactions(np.stack([a, b, 2.0 * a - 3.0 * b])))
        np.testing.assert_allclose(of_both, 2.0 * of_a - 3.0 * of_b, rtol=0, atol=1e-12)
        assert np.max(np.abs(of_a)) > 0


def test_friction_in_a_gear_is_given_by_its_name():
    system = gearbox()
    assert list(system.friction_rows) == [k for k, (name, _) in enumerate(system.rows) if name == "gear"]
    with pytest.raises(ValueError, match="'loss': friction in JointCoupling 'gear' is given by its name, without a"):
        gearbox(radius=0.1)


@case(0.2, 0.05)
def nut_that_climbs(coefficient):
    """It locks itself, or runs down."""
    mass, inertia, pitch, radius, spin = 2.0, 1e-3, 0.005, 0.01, 40.0
    lead = pitch / (2 * np.pi)
    moving = {"velocity": (0.0, 0.0, lead * spin), "angular_velocity": (0.0, 0.0, spin)}
    nut = spatial.Body("nut", mass=mass, inertia=(inertia,) * 3, **moving)
    screw = spatial.Screw("screw", "ground", "nut", point=(0.0, 0.0, 0.0), axis=UP, pitch=pitch)
    thread = mb.DryFriction("thread", "screw.angle", coefficient=coefficient, radius=radius)
    system = mb.Scene([nut], joints=[screw], forces=[thread, DOWN_3D]).compile()
    slowing = lambda arm: arm * mass * G / (inertia + arm * mass * lead)
    stop = spin / slowing(lead + coefficient * radius)
    angle, locks = 0.5 * spin * stop, coefficient * radius > lead
    if not locks:
        angle -= 0.5 * slowing(lead - coefficient * radius) * (4.0 - stop) ** 2
    events, values = [("thread", "stick" if locks else "slip", stop)], {"screw.displacement": lead * angle}
    return Scenario(system, 4.0, events, values, near=1e-7)


# A particle that turns on an incline


def incline(friction, angle=0.3, velocity=(-0.5, 1.0)):
    """A particle on an incline, downhill along x."""
    body = spatial.PointMass("particle", mass=2.0, position=(0.0, 0.0, 0.0), velocity=(*velocity, 0.0))
    rub = mb.DryFriction("rub", "floor", coefficient=friction)
    gravity = mb.Gravity((G * np.sin(angle), 0.0, -G * np.cos(angle)))
    floor = mb.RigidContact("floor", "particle", terrain=FLAT)
    return mb.Scene([body], joints=[floor], forces=[gravity, rub]).compile()


def comes_to_rest(friction, angle=0.3, velocity=(-0.5, 1.0)):
    """When and where a particle on an incline comes to rest, by the tangent z of half the angle of its path downhill:
    its speed is `c z^(k − 1) (1 + z²) / 2`, with k the friction over the slope.
    """
    k, z = friction / np.tan(angle), np.tan(0.5 * np.arctan2(velocity[1], velocity[0]))
    c = 2 * np.hypot(*velocity) / (z ** (k - 1) * (1 + z**2))
    speed = lambda z: 0.5 * c * z ** (k - 1) * (1 + z**2)
    slows = lambda z: 0.5 * c / (G * np.sin(angle)) * z ** (k - 2) * (1 + z**2)
    cosine, sine = lambda z: (1 - z**2) / (1 + z**2), lambda z: 2 * z / (1 + z**2)
    over = lambda part: quad(lambda z: part(z) * slows(z), 0.0, z, epsabs=1e-13, epsrel=1e-12)[0]
    return np.array([over(lambda z: 1.0), over(lambda z: speed(z) * cosine(z)), over(lambda z: speed(z) * sine(z))])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["Adams", "Hermite", "Tsit5", "Projection"])
def test_particle_turns_downhill_and_stops(method):
    """Towards the stop its direction changes ever faster; with friction just above the slope it is stiff there."""
    for friction in (0.35, 0.5, 0.9):
        time, x, y = comes_to_rest(friction)
        values, options = {"particle.position": [x, y, 0.0]}, METHODS[method] | {"rtol": 1e-9}
        Scenario(incline(friction), 1.5, [("rub", "stick", time)], values, options=options, near=1e-7).check()


# Bodies that rock, jam and tip


@pytest.mark.slow
def test_rocking_block():
    """Housner's: between impacts a pendulum about a corner, and at each impact the angular velocity falls by
    `1 - 1.5 sin² α`. Source: G. W. Housner, Bull. Seism. Soc. Am. 53, 1963.
    """
    half, tall, mass = 0.1, 0.4, 2.0
    reach, alpha = np.hypot(half, tall), np.arctan(half / tall)
    own = mass * (half**2 + tall**2) / 3
    about = own + mass * reach**2

    def quarter(angle):
        rate = lambda now: np.sqrt(2 * mass * G * reach / about * (np.cos(alpha - angle) - np.cos(alpha - now)))
        return quad(lambda r: 2 * r / rate(angle - r * r), 0.0, np.sqrt(angle), epsabs=1e-13, epsrel=1e-13)[0]

    start = angle = 0.5 * alpha
    times, now = [], 0.0
    for _ in range(4):
        times.append(now + quarter(angle))
        kinetic = (np.cos(alpha - angle) - np.cos(alpha)) * (1 - 1.5 * np.sin(alpha) ** 2) ** 2
        angle = alpha - np.arccos(np.cos(alpha) + kinetic)
        now = times[-1] + quarter(angle)

    c, s = np.cos(start), np.sin(start)
    position = (c * half - s * tall, s * half + c * tall)
    corners = {"left": (-half, -tall), "right": (half, -tall)}
    floors = [mb.RigidContact(own, "block", terrain=FLAT, centre=at) for own, at in corners.items()]
    rubs = [mb.DryFriction(f"rub {own}", own, coefficient=0.8) for own in corners]
    block = planar.Body("block", mass=mass, inertia=own, position=position, angle=start)
    system = mb.Scene([block], joints=floors, forces=[DOWN, *rubs]).compile()
    state = mb.assemble(system, fix={"left.mode": 1})
    motion = mb.simulate(system, state, t1=now, saveat=[now], rtol=1e-10)
    closes = [event for event in motion.events if event.kind == "close"]
    np.testing.assert_allclose([event.time for event in closes], times, rtol=1e-9)
    assert [event.part for event in closes] == ["right", "left"] * 2
    np.testing.assert_allclose(motion["block"].angle[-1], angle, rtol=1e-9)


def painleve(angle, velocity, coefficient):
    """A rod whose end slides on the ground."""
    centre = (-np.cos(angle), np.sin(angle))
    rod = planar.Body("rod", mass=1.0, inertia=1 / 3, position=centre, angle=-angle, velocity=(velocity, 0.0))
    tip = mb.RigidContact("tip", "rod", terrain=FLAT, centre=(1.0, 0.0))
    rub = mb.DryFriction("rub", "tip", coefficient=coefficient)
    return mb.Scene([rod], joints=[tip], forces=[DOWN, rub]).compile()


@pytest.mark.slow
def test_rod_that_jams():
    """Painlevé's: pushed along its lean it has no solution with much friction; pulled it has one."""
    system = painleve(1.2, 5.0, 2.0)
    with pytest.raises(RuntimeError, match=r"Painlevé's paradox.* These are 'tip', 'rub', at t = 0\."):
        mb.simulate(system, mb.assemble(system, fix={"tip.mode": 1}), t1=0.2)
    state = mb.assemble(painleve(1.2, -5.0, 2.0), fix={"tip.mode": 1})
    motion = mb.simulate(system, state, t1=0.1, saveat=[0.1], rtol=1e-10, solver=Adams())
    # Newton's and Euler's equations of the rod by themselves, with the force at the tip in its cone.
    reaction, angle = motion.reactions["tip"].force[0, 1], -motion["rod"].angle[0]
    assert reaction > 0
    np.testing.assert_allclose(motion.reactions["rub"].force[0], [2.0 * reaction, 0.0], rtol=1e-9, atol=1e-12)
    turn = reaction * np.cos(angle) + 2.0 * reaction * np.sin(angle)
    np.testing.assert_allclose(motion.accelerations[0, 2], 3.0 * turn, rtol=1e-8)


@pytest.mark.slow
def test_rod_has_a_paradox_where_it_was_found():
    """Beyond a friction of 4/3, where `tan θ` is between `(3 μ ± √(9 μ² − 16)) / 2`, the force at the end of a rod that
    is pushed has no value, or two where the rod turns so fast that it may also lift off (F. Génot and B. Brogliato,
    "New results on Painlevé paradoxes", European Journal of Mechanics A/Solids 18, 1999).
    """
    coefficient = 1.6
    angle, turn = (x.ravel() for x in np.meshgrid(np.linspace(0.2, 1.4, 13), np.linspace(0.0, 6.0, 7)))
    system = painleve(1.0, 0.0, coefficient)
    state = mb.assemble(system, fix={"tip.mode": 1})

    def run(angle, turn):
        sin, cos = jnp.sin(angle), jnp.cos(angle)
        q = state.q.at[:3].set(jnp.stack([-cos, sin, -angle]))
        u = state.u.at[:3].set(jnp.stack([5.0 + turn * sin, turn * cos, -turn]))
        motion = mb.simulate(system, mb.State(q, u), t1=1e-4, rtol=1e-8, throw=False)
        return motion.result == mb.RESULTS.contacts_undetermined

    root = np.sqrt(9 * coefficient**2 - 16)
    paradox = np.abs(2 * np.tan(angle) - 3 * coefficient) < root
    lifts = turn**2 * np.sin(angle) > G
    assert all(np.any(paradox & own) and np.any(~paradox & own) for own in (lifts, ~lifts))
    np.testing.assert_array_equal(jit_quickly(jax.vmap(run))(jnp.array(angle), jnp.array(turn)), paradox)


# Derivatives

DERIVED = {}


def derived(function):
    DERIVED[function.__name__] = function
    return function


@pytest.mark.slow
@pytest.mark.parametrize("name", DERIVED)
def test_derivatives_are_those_of_closed_forms(name):
    DERIVED[name]().check()


def last(system, names, x, t1, rtol, **options):
    """The motion with other parameters, saved at its end."""
    own = mb.with_parameters(system, dict(zip(names, x, strict=True)))
    start = options.pop("start", None)
    return mb.simulate(own, start or mb.assemble(system), t1=t1, saveat=[t1], rtol=rtol, max_steps=400, **options)


@derived
def block_that_stops_and_slips_again():
    """Displacement and the times of both events."""
    law = lambda x, v, t, p: jnp.stack([p["rate"] * t, 0 * t, 0 * t])[None]
    push = mb.Force("push", ["block"], law, parameters={"rate": 4.0})
    system = slider(velocity=1.0, forces=[push], coefficient=0.3, static_coefficient=0.4)
    names = ("rub.coefficient", "rub.static_coefficient", "block.mass", "push.rate")

    def end(x, rtol):
        motion = last(system, names, x, 3.0, rtol, max_events=8)
        return jnp.append(motion["block"].position[-1, 0], motion.events.times[:2])

    def exact(x):
        rate, slow = x[3] / x[2], x[0] * G
        stops = (slow - jnp.sqrt(slow**2 - 2 * rate)) / rate
        first, begins = stops + rate * stops**3 / 6 - slow * stops**2 / 2, x[1] * G / rate
        further = rate * ((3.0**3 - begins**3) / 6 - begins**2 * (3.0 - begins) / 2)
        return jnp.stack([first + further - slow * (3.0 - begins) ** 2 / 2, stops, begins])

    return Derived(end, [0.3, 0.4, 2.0, 4.0], exact)


@derived
def block_that_a_force_of_constant_size_holds():
    """Displacement after it has begun to slip."""
    system, names = clamped(2.0, static_force=3.0), ("rub.force", "rub.static_force", "block.mass")

    def end(x, rtol):
        inputs = {"push.force": lambda t: 4.0 * t}
        return last(system, names, x, 2.0, rtol, inputs=inputs, max_events=8)["block"].position[0, :1]

    def exact(x):
        starts = x[1] / 4.0
        speed = 2.0 * starts**2 - x[0] * starts
        moved = 4.0 * (8.0 - starts**3) / 6 - x[0] * (4.0 - starts**2) / 2 - speed * (2.0 - starts)
        return (moved / x[2])[None]

    return Derived(end, [2.0, 3.0, 2.0], exact)


@derived
def blocks_that_stop_at_other_times():
    """In a batch, of which one does not move at all, and one does not stop; by their speed."""
    system, slow = slider(coefficient=0.3), 0.3 * G
    state = mb.assemble(system)

    def end(x, rtol):
        start = mb.State(state.q, state.u.at[0].set(x[0]))
        return last(system, (), (), 1.0, rtol, start=start)["block"].position[-1, :1]

    # At rest the displacement grows with the square of the speed.
    exact = lambda x: jnp.where(jnp.abs(x) < slow, x * jnp.abs(x) / (2 * slow), x - jnp.sign(x) * slow / 2)
    return Derived(end, [1.0], exact, many=[[1.0], [0.0], [-2.0], [5.0]])


@derived
def ball_with_spin_that_bounces_twice():
    """In space: slip remains in both bounces, or ends in them."""
    mass, radius, top = 0.17, 0.03, 0.5
    inertia, spin = spatial.sphere(mass, radius), jnp.array([5.0, -30.0])
    moving = {"velocity": (1.0, 0.3, 0.0), "angular_velocity": (5.0, -30.0, 8.0)}
    body = spatial.Body("ball", mass=mass, inertia=inertia, position=(0.0, 0.0, top), **moving)
    floor = mb.RigidContact("floor", "ball", terrain=FLAT, radius=radius, restitution=0.6)
    rub = mb.DryFriction("rub", "floor", coefficient=0.2)
    system = mb.Scene([body], joints=[floor], forces=[DOWN_3D, rub]).compile()

    def end(x, rtol):
        own = mb.with_parameters(system, {"rub.coefficient": x[0], "floor.restitution": x[1]})
        options = {"saveat": [0.5, 0.9], "max_steps": 400, "max_events": 8}
        return mb.simulate(own, mb.assemble(system), t1=0.9, rtol=rtol, **options)["ball"].position[:, :2].reshape(-1)

    def exact(x):
        time = jnp.sqrt(2 * (top - radius) / G)
        velocity, turns, down = jnp.array([1.0, 0.3]), spin, G * time
        ends, velocities = [0.0, time], [velocity]
        for _ in range(2):
            slip = velocity + radius * jnp.stack([-turns[1], turns[0]])
            speed = jnp.linalg.norm(slip)
            impulse = jnp.minimum(x[0] * mass * down * (1 + x[1]), 2 / 7 * mass * speed) * -slip / speed
            velocity = velocity + impulse / mass
            turns = turns + radius * jnp.stack([impulse[1], -impulse[0]]) / inertia[0, 0]
            down = x[1] * down
            ends.append(ends[-1] + 2 * down / G)
            velocities.append(velocity)
        pieces = list(zip(velocities, ends, ends[1:], strict=False))
        at = lambda t: sum(v * (jnp.clip(t, a, b) - a) for v, a, b in pieces)
        return jnp.concatenate([at(0.5), at(0.9)])

    return Derived(end, [0.05, 0.6], exact, many=[[0.05, 0.6], [0.2, 0.6]])


@derived
def shaft_that_turns_and_slides_to_rest():
    """With another radius or mass the direction of slip changes."""
    system = shaft(in_sleeve(), velocity=3.0, spin=5.0)

    def end(x, rtol):
        motion = last(system, ("rub.coefficient", "rub.radius", "shaft.mass"), x, 2.0, rtol)
        return jnp.stack([motion["shaft"].position[0, 0], motion["pin"].angle[0]])

    return Derived(end, [COEFFICIENT, RADIUS, MASS], near=1e-6)


def slips_to_rest_on_a_belt(on):
    """Of the friction and both components of the belt's speed."""
    system = block_on_a_belt(on)

    def end(x, rtol):
        own = mb.with_parameters(system, {"rub.coefficient": x[0], "rub.speed": x[1:]})
        motion = last(own, (), (), 1.0, rtol, start=mb.assemble(own, throw=False))
        return jnp.append(motion["block"].position[0, :2], motion.events.times[0])

    def exact(x):
        slip = jnp.array([2.0, 1.0]) - x[1:]
        time = jnp.linalg.norm(slip) / (x[0] * G)
        return jnp.append(x[1:] + 0.5 * slip * time, time)

    return Derived(end, [COEFFICIENT, 0.8, -0.6], exact)


DERIVED |= {f"block_on_a_{on}_that_moves": functools.partial(slips_to_rest_on_a_belt, on) for on in ("face", "floor")}


@derived
def particles_that_turn_downhill():
    """Towards their stops, at other times in each member of a batch."""
    system = incline(0.5)

    def end(x, rtol):
        motion = last(system, ("rub.coefficient",), x, 1.5, rtol)
        return jnp.append(motion.events.times[:1], motion["particle"].position[-1, :2])

    exact = lambda x: comes_to_rest(float(x[0]))
    return Derived(end, [0.5], exact, traced=False, many=[[0.5], [0.4], [0.9]], values=1e-8, near=1e-6)


@derived
def brake_whose_series_has_other_values():
    """The way to the stop, and its time."""
    system = slider(velocity=2.0, coefficient=0.3)

    def end(x, rtol):
        inputs = {"rub.coefficient": mb.Series([0.0, 0.2, 1.5], x[jnp.array([0, 1, 1])], "held")}
        motion = last(system, (), (), 1.5, rtol, inputs=inputs)
        return jnp.append(motion["block"].position[-1, :1], motion.events.times[:1])

    def exact(x):
        later = 2.0 - x[0] * G * 0.2
        way = 0.4 - 0.5 * x[0] * G * 0.04 + later**2 / (2 * x[1] * G)
        return jnp.stack([way, 0.2 + later / (x[1] * G)])

    return Derived(end, [0.3, 0.4], exact)


# Derivatives of an impact, and of an end of stick


@pytest.mark.slow
def test_time_of_release_has_a_derivative():
    """Of a disc that rolls until the force on it is too large for stick, also where a closed contact has a rounding
    error for a rate.
    """
    push = mb.Force("push", ["disc"], lambda x, v, t, p: jnp.stack([10.0 * t, 0 * t, 0 * t])[None])
    body = planar.Body("disc", mass=1.5, inertia=0.5 * 1.5 * 0.2**2, position=(0.0, 0.2))
    floor = mb.RigidContact("floor", "disc", terrain=FLAT, radius=0.2)
    rub = mb.DryFriction("rub", "floor", coefficient=0.2, static_coefficient=0.3)
    system = mb.Scene([body], joints=[floor], forces=[DOWN, rub, push]).compile()
    # Stick takes a third of the force, which the disc has gathered until then.
    time = 3 * 0.3 * 1.5 * G / 10.0
    speed, way = 10.0 * time**2 / 2 / (1.5 * 1.5), 10.0 * time**3 / 6 / (1.5 * 1.5)
    modes = system.contacts.with_modes(system.guess.q, jnp.array([CLOSED, STICK]))
    q = modes.at[:3].set(jnp.array([way, 0.2, -way / 0.2]))
    u = jnp.zeros(system.nu).at[:3].set(jnp.array([speed, 0.0, -speed / 0.2]))

    @jit_quickly
    def slope(rounding):
        def after(limit):
            own = mb.with_parameters(system, {"rub.static_coefficient": limit})
            y, touch = mb.State(q, u.at[1].add(rounding)), ContactTolerance(jnp.asarray(1e-11))
            return impact(own, mb.formulations.Multipliers(), touch, jnp.asarray(time), y).after.u[0]

        return jax.jvp(after, (jnp.asarray(0.3),), (jnp.asarray(1.0),))[1]

    # Velocities before and after differ by their accelerations times the time by which it is later.
    later, slower = 3 * 1.5 * G / 10.0, (0.3 - 0.2) * G
    for rounding in (0.0, -1e-16, 1e-16, -1e-14):
        np.testing.assert_allclose(slope(rounding), -slower * later, rtol=1e-7)


@pytest.mark.slow
def test_impact_gives_no_energy_back():
    """A double pendulum whose end meets the floor with much friction, Kane's and Levinson's example: where the whole
    rebound would, it is less, and the derivative of the state after it is that of this rule.
    """
    links = [
        planar.Body(name, mass=1.0, inertia=0.03, position=(x, 0.7)) for name, x in (("upper", 0.3), ("lower", 0.9))
    ]
    joints = [
        planar.Revolute("hip", "ground", "upper", point=(0.0, 0.7)),
        planar.Revolute("knee", "upper", "lower", point=(0.6, 0.7)),
        mb.RigidContact("floor", "lower", terrain=FLAT, centre=(0.3, 0.0), restitution=0.9),
    ]
    rub = mb.DryFriction("rub", "floor", coefficient=0.5)
    system = mb.Scene(links, joints=joints, forces=[DOWN, rub]).compile()
    state = mb.assemble(system, rates={"upper.angle": -1.5, "lower.angle": -3.0})
    motion = mb.simulate(system, state, t1=0.5, rtol=1e-9)
    floor, rub = list(motion.events)[:2]
    assert (floor.kind, rub.kind) == ("impact", "impact") and abs(floor.kinetic_energy_lost) < 1e-8
    found, nq, names = motion.found_events, system.nq, ("lower.mass", "rub.coefficient", "floor.restitution")
    t, q, u = found.times[0], found.states[0][:nq], found.states[0][nq : nq + system.nu]

    def after(x):
        own, tolerance = mb.with_parameters(system, dict(zip(names, x, strict=False))), ContactTolerance(found.touch)
        return impact(own, motion.formulation, tolerance, t, mb.State(q, u * (1 + x[3]))).after.u

    at, h = jnp.array([1.0, 0.5, 0.9, 0.0]), 1e-6
    # Less than the whole rebound, of which the energy would be more than before.
    value, rate = jax.jit(after), lambda u: Instant(system, t, q, u).contact_motion.rates[0]
    assert 0 < rate(value(at)) < 0.9 * -rate(u) * (1 - 1e-3)
    differences = np.stack([(value(at + h * e) - value(at - h * e)) / (2 * h) for e in jnp.eye(4)], axis=1)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(after))(at), differences, atol=1e-6 * np.max(np.abs(value(at))))


# Words and refusals of friction of constant size


def test_friction_of_constant_size_has_names():
    system = clamped(2.0, static_force=3.0)
    assert "ExactFriction  rub  of rail, where it sticks 1 row each" in str(system.describe())
    assert {"rub.force", "rub.static_force"} <= set(mb.parameters(system)) and not system.friction_rows.size


BLOCK = planar.Body("block", mass=2.0, inertia=0.1)
BALL = spatial.Body("block", mass=1.0, inertia=(1.0, 1.0, 1.0))
PLANE = spatial.Planar("rail", "ground", "block", point=(0.0, 0.0, 0.0), axis=UP)
FLOOR = mb.RigidContact("rail", "block", terrain=FLAT, radius=0.1)
BAD = [
    (BLOCK, rail(), {"transition_speed": 0.1}, "exact friction has no transition_speed"),
    (BLOCK, rail(), {"static_force": 2.0, "exact": False}, "static_force needs friction that sticks; give exact=True"),
    (BLOCK, rail(), {"force": -1.0}, "force must be non-negative, got -1.0"),
    (BLOCK, rail(), {"static_force": 0.5}, "static_force must not be less than force, got 0.5 and 1.0"),
    (BLOCK, rail(), {"coordinate": "rail.angel"}, "rail.displacement"),
    (BALL, PLANE, {}, "'rail.displacement' must be a number"),
    (BLOCK, FLOOR, {"coordinate": "rail.gap"}, "is not a joint; friction of bodies that touch is DryFriction"),
]


def test_friction_of_constant_size_that_makes_no_sense_is_refused():
    for body, joint, options, message in BAD:
        given = {"coordinate": "rail.displacement", "exact": True, "force": 1.0} | options
        with pytest.raises(ValueError, match="JointFriction 'rub'") as caught:
            mb.Scene([body], joints=[joint], forces=[mb.JointFriction("rub", **given)]).compile()
        assert message in str(caught.value)
    rub = mb.JointFriction("rub", "rail.displacement", force=1.0, exact=True)
    with pytest.raises(ValueError, match="joints must hold constraints, got JointFriction 'rub'; it belongs in force"):
        mb.Scene([BLOCK], joints=[rail(), rub])
