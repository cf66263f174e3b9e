"""Impacts, contacts that close and open, against closed forms: times, kinds, impulses, energies, motions."""

import dataclasses
import functools
import importlib
import itertools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from compiling import jit_quickly
from scenarios import Derived, Scenario
from scipy.optimize import brentq

import jaxmb as mb
from jaxmb import manifold, planar, spatial, terrain
from jaxmb.manifold import Projection
from jaxmb.solvers import Hermite, restarts

G = 9.81
DOWN, DOWN_3D = mb.Gravity((0.0, -G)), mb.Gravity((0.0, 0.0, -G))
FLAT = terrain.Flat()


def rail(body, axis=(1.0, 0.0), name="rail"):
    return planar.Prismatic(name, "ground", body, axis=axis, point_a=(0.0, 0.0), point_b=(0.0, 0.0))


# A ball that falls on the floor, and a force that may lift it.
BALL = mb.Scene(
    [planar.PointMass("ball", mass=2.0, position=(0.0, 1.0))],
    joints=[mb.RigidContact("floor", "ball", terrain=FLAT, restitution=0.5)],
    forces=[DOWN, planar.PointForce("lift", "ball", force=(0.0, 0.0))],
).compile()
FALL = np.sqrt(2 / G)


def height(t, impacts, restitution=0.5, lower=0.0, lift=0.0, start=1.0):
    """Of the ball after a number of impacts."""
    g = G - lift / 2
    time, speed = jnp.sqrt(2 * (start - lower) / g), jnp.sqrt(2 * g * (start - lower))
    for k in range(impacts):
        speed = restitution * speed
        time = time + (2 * speed / g if k + 1 < impacts else 0.0)
    return lower + speed * (t - time) - g * (t - time) ** 2 / 2


def risen(force, duration):
    """The height after a lift from rest, of a ball of 2 kg."""
    return 0.5 * np.maximum(force / 2 - G, 0.0) * duration**2


def changed(restitution=0.5, level=0.0, lift=0.0):
    lift = jnp.stack([0.0 * lift, lift])
    numbers = {"floor.restitution": restitution, "floor.terrain.level": level, "lift.force": lift}
    return mb.with_parameters(BALL, numbers)


def dropped(start=1.0, speed=0.0):
    """From a height, with a speed upwards."""
    return mb.State(BALL.guess.q.at[1].set(start), jnp.zeros(BALL.nu).at[1].set(speed))


@pytest.fixture(scope="module")
def moved():
    """The height of the ball at the end, with its derivatives by the restitution, the floor, the lift, the height at
    the start and the end; the heights at times, the last force of the floor, and the events. One program for all.
    """

    @jit_quickly
    @functools.partial(jax.value_and_grad, has_aux=True)
    def moved(x, ts, rtol):
        restitution, lower, lift, start, t1 = x
        saveat = diffrax.SaveAt(ts=ts, t1=True)
        # A run of few steps, of which all are kept, compiles faster.
        motion = mb.simulate(
            changed(restitution, lower, lift), dropped(start), t1=t1, saveat=saveat, rtol=rtol, max_steps=300,
            max_events=32,
        )  # fmt: skip
        still = jax.lax.stop_gradient(motion)
        heights, force = still["ball"].position[:-1, 1], still.reactions["floor"].force[-1]
        return motion["ball"].position[-1, 1], (heights, force, still.events, still.stats["num_events"])

    def run(restitution=0.5, lower=0.0, lift=0.0, start=1.0, t1=2.0, ts=None, rtol=1e-9):
        ts = np.linspace(0.2, 1.0, 5) * t1 if ts is None else np.asarray(ts)
        return moved(np.array([restitution, lower, lift, start, t1]), ts, rtol)

    return run


def test_bouncing_ball_comes_to_rest(moved):
    """Twenty impacts, and the sum of all that follow."""
    k = np.arange(19)
    times = FALL * (1 + 2 * np.cumsum(np.append(0.0, 0.5 ** k[1:])))
    # In the middle between impacts it is at its highest.
    between = (times[1:6] + times[:5]) / 2
    (end, (heights, force, events, count)), slopes = moved(ts=between, rtol=1e-12)
    np.testing.assert_allclose(heights, 0.25 ** np.arange(1, 6), atol=1e-12)
    events = list(events)
    impacts = [event for event in events if event.kind != "rest"]
    assert len(impacts) >= 18 and count == len(impacts)
    k = np.arange(len(impacts))
    times = FALL * (1 + 2 * np.cumsum(np.append(0.0, 0.5 ** k[1:])))
    np.testing.assert_allclose([event.time for event in impacts], times, atol=1e-9)
    # The last one closes the contact without a rebound.
    size = np.append(np.full(len(k) - 1, 1.5), 1.0)
    np.testing.assert_allclose([event.impulse for event in impacts], 2 * size * G * FALL * 0.5**k, atol=1e-8)
    np.testing.assert_allclose(sum(event.kinetic_energy_lost for event in impacts), 2 * G, rtol=1e-9)
    assert [event.kind for event in events] == ["impact"] * (len(k) - 1) + ["close", "rest"]
    np.testing.assert_allclose(events[-1].time, 3 * FALL, atol=2e-8)
    np.testing.assert_allclose(end, 0.0, atol=1e-9)
    np.testing.assert_allclose(force, [0.0, 2 * G], atol=1e-9)
    # At rest it is where the floor is.
    np.testing.assert_allclose(slopes, [0.0, 1.0, 0.0, 0.0, 0.0], atol=1e-9)


def test_height_after_impacts_has_derivatives(moved):
    (value, (heights, *_)), slopes = moved(0.8, 0.1, 1.0, 1.0, 1.9, ts=[0.1, 0.3, 0.5, 0.7, 0.9])
    exact = lambda x: height(x[4], 3, *x[:4])
    at = jnp.array([0.8, 0.1, 1.0, 1.0, 1.9])
    np.testing.assert_allclose(value, exact(at), atol=1e-9)
    np.testing.assert_allclose(slopes, jax.jit(jax.grad(exact))(at), rtol=1e-7)
    g, lands = G - 0.5, np.sqrt(1.8 / (G - 0.5))
    later = np.array([0.5, 0.7, 0.9]) - lands
    np.testing.assert_allclose(heights[:2], 1 - g / 2 * np.array([0.1, 0.3]) ** 2, atol=1e-9)
    np.testing.assert_allclose(heights[2:], 0.1 + 0.8 * g * lands * later - g / 2 * later**2, atol=1e-9)


@pytest.mark.parametrize("force", [0.0, 19.0, 19.621, 30.0, 1000.0])
def test_ball_that_is_lifted_from_the_start(moved, force):
    """The error of the first step is larger than the height that it reaches."""
    (value, _), slopes = moved(lower=0.2, lift=force, start=0.2, t1=0.3, rtol=1e-8)
    np.testing.assert_allclose(value, 0.2 + risen(force, 0.3), atol=1e-8)
    np.testing.assert_allclose(slopes[2], 0.25 * 0.09 if force > 2 * G else 0.0, atol=1e-8)


def end(x, t1, **options):
    """The height at a time by the restitution and the floor."""
    options = {"rtol": 1e-9, "max_steps": 300, "max_events": 16} | options
    return mb.simulate(changed(*x), dropped(), t1=t1, **options)["ball"].position[-1, 1]


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"solver": diffrax.Tsit5()}, {"manifold": Projection()}], ids=["Tsit5", "sparse"])
def test_height_after_impacts_by_other_solvers_and_manifolds(options):
    at, t1 = jnp.array([0.8, 0.1]), 1.9
    value, slope = jit_quickly(jax.value_and_grad(lambda at: end(at, t1, **options)))(at)
    exact = lambda at: height(t1, 3, *at)
    np.testing.assert_allclose(value, exact(at), atol=1e-8)
    np.testing.assert_allclose(slope, jax.grad(exact)(at), rtol=1e-6)


@pytest.mark.slow("jit")
@pytest.mark.parametrize("around", [lambda f: f, jax.jit], ids=["eager", "jit"])
def test_second_derivatives_through_impacts_are_refused(around, monkeypatch):
    if around is not jax.jit:
        # Before anything is traced.
        monkeypatch.setattr(importlib.import_module("jaxmb.simulate.run"), "solved", None)
    with pytest.raises(ValueError, match="Second derivatives through impacts are not supported"):
        jax.hessian(around(lambda at: end(at, 0.6)))(jnp.array([0.8, 0.1]))


# Motions in closed form

SCENARIOS = {}


def scenario(function):
    SCENARIOS[function.__name__] = function
    return function


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENARIOS)
def test_motion_is_that_of_its_closed_form(name):
    SCENARIOS[name]().check()


@scenario
def mass_between_two_stops():
    """Without forces the speed is the restitution to the number of impacts."""
    mass = planar.Body("mass", mass=3.0, inertia=1.0, velocity=(2.0, 0.0))
    ends = mb.Stop("ends", "rail.displacement", lower=-0.5, upper=0.5, restitution=0.9)
    system, k = mb.Scene([mass], joints=[rail("mass"), ends]).compile(), np.arange(12)
    times = 0.25 + np.cumsum(np.append(0.0, 0.5 / 0.9 ** k[1:]))
    k = k[times < 5.0]
    events = [("ends", "impact", time) for time in times[k]]
    values = {"mass.velocity": [2 * 0.9 ** len(k) * (-1) ** len(k), 0.0]}
    return Scenario(system, 5.0, events, values, impulses=6 * 1.9 * 0.9**k)


@scenario
def cradle():
    """Five balls almost touch: the last one takes all of the velocity of the first."""
    at = [-0.2, *(0.1 * k + 1e-6 * k for k in range(1, 5))]
    bodies = [
        planar.Body(f"b{k}", mass=1.0, inertia=1e-3, position=(x, 0.0), velocity=(float(k == 0), 0.0))
        for k, x in enumerate(at)
    ]
    near = {"radius_a": 0.05, "radius_b": 0.05, "restitution": 1.0}
    contacts = [mb.RigidBallContact(f"c{k}", f"b{k}", f"b{k + 1}", **near) for k in range(4)]
    # Each moves by what it lacks to touch the next one.
    times = np.cumsum([0.2 + 1e-6, 1e-6, 1e-6, 1e-6])
    events = [(f"c{k}", "impact", time) for k, time in enumerate(times)]
    values = {f"b{k}.velocity": [float(k == 4), 0.0] for k in range(5)}
    values["b4.position"] = [at[4] + 1.0 - (0.2 + 4e-6), 0.0]
    return Scenario(mb.Scene(bodies, joints=contacts).compile(), 1.0, events, values)


@scenario
def edge_of_a_box():
    """A ball is reflected along the line from the edge to its centre."""
    radius, beyond, restitution = 0.1, 0.06, 0.7
    body = planar.Body("ball", mass=1.3, inertia=0.01, position=(0.5 + beyond, 1.0))
    box = mb.RigidBoxContact("c", "ground", "ball", size=(1.0, 0.4), radius=radius, restitution=restitution)
    height = 0.2 + np.sqrt(radius**2 - beyond**2)
    time, normal = np.sqrt(2 * (1.0 - height) / G), np.array([beyond, height - 0.2]) / radius
    before, left = np.array([0.0, -G * time]), 0.5 - time
    after = before - (1 + restitution) * (before @ normal) * normal
    values = {"ball.position": np.array([0.5 + beyond, height]) + after * left - np.array([0.0, G / 2]) * left**2}
    system = mb.Scene([body], joints=[box], forces=[DOWN]).compile()
    return Scenario(system, 0.5, [("c", "impact", time)], values)


@scenario
def rope_that_tightens():
    """A free fall until the rope is tight, with the impulse along it, and the speed at the end by the energy."""
    particle = planar.PointMass("p", mass=1.5, position=(0.6, 0.0))
    rope = mb.Slack("rope", "ground", "p", length=1.0, restitution=1.0)
    system, time = mb.Scene([particle], joints=[rope], forces=[DOWN]).compile(), np.sqrt(2 * 0.8 / G)
    along = np.array([0.6, -0.8])
    velocity = np.array([0.0, -G * time]) + 2 * 0.8 * G * time * -along
    left = 0.5 - time
    values = {"p.position": along + velocity * left - np.array([0.0, G / 2]) * left**2}
    return Scenario(system, 0.5, [("rope", "impact", time)], values, impulses=[2 * 1.5 * 0.8 * G * time], lost=[0.0])


@scenario
def stop_that_is_only_just_reached():
    """Steps are long where a spring turns round: the stop is in the middle of one."""
    mass = planar.Body("mass", mass=1.0, inertia=1.0, position=(1.0, 0.0))
    stop = mb.Stop("end", "rail.displacement", lower=-0.9999, restitution=1.0)
    spring = mb.JointSpring("spring", "rail.displacement", stiffness=1.0, free=0.0)
    system = mb.Scene([mass], joints=[rail("mass"), stop], forces=[spring]).compile()
    events = [("end", "impact", np.arccos(-0.9999))]
    return Scenario(system, 4.0, events, options={"rtol": 1e-6}, near=5e-6)


@scenario
def hammer_that_is_driven():
    """The driver keeps it at its speed v, and the ball leaves at (1 + e) v: a loss below zero."""
    bodies = [
        planar.Body(name, mass=2.0, inertia=1.0, position=(x, 0.0)) for name, x in (("hammer", 0.0), ("ball", 0.3))
    ]
    drive = mb.JointDriver("drive", "rail.displacement", rate=2.0)
    meet = mb.RigidBallContact("meet", "hammer", "ball", radius_a=0.1, radius_b=0.1, restitution=0.5)
    system = mb.Scene(bodies, joints=[rail("hammer"), drive, meet]).compile()
    values = {"ball.velocity": [3.0, 0.0]}
    return Scenario(system, 0.1, [("meet", "impact", 0.05)], values, impulses=[6.0], lost=[-9.0])


@scenario
def block_that_passes_an_impulse_on():
    """A ball strikes a block on the floor: the impulse of a contact that stays closed is an event."""
    bodies = [
        planar.PointMass("block", mass=3.0, position=(0.0, 0.0)),
        planar.PointMass("ball", mass=1.0, position=(0.0, 1.0)),
    ]
    floor = mb.RigidContact("floor", "block", terrain=FLAT)
    hit = mb.RigidBallContact("hit", "block", "ball", radius_a=0.1, radius_b=0.1, restitution=0.5)
    system, time = mb.Scene(bodies, joints=[floor, hit], forces=[DOWN]).compile(), np.sqrt(2 * 0.8 / G)
    events = [("floor", "impulse", time), ("hit", "impact", time)]
    impulses = np.full(2, 1.5 * G * time)
    return Scenario(system, 0.6, events, impulses=impulses, start={"fix": {"floor.mode": 1}}, near=1e-8)


@scenario
def stop_that_vibrates():
    """Nothing of the motion towards it asks for short steps."""
    body = planar.Body("body", mass=2.0, inertia=0.1, velocity=(1.0, 0.0))
    stop = mb.Stop("stop", "rail.displacement", upper=2.0, restitution=0.5)
    system = mb.Scene([body], joints=[rail("body"), stop]).compile()
    # The motion up to there is uniform.
    fine = np.linspace(1.5, 2.5, 100_001)
    first = fine[np.argmax(fine > 2.0 + 0.2 * np.sin(20.0 * fine))]
    inputs = {"stop.upper": lambda t: 2.0 + 0.2 * jnp.sin(20.0 * t)}
    options = {"inputs": inputs, "rtol": 1e-8}
    return Scenario(system, first + 0.05, [("stop", "impact", first)], options=options, near=1e-5)


@scenario
def particle_at_rest_that_is_pulled():
    """Where everything rests no error estimate asks for short steps, and the pull is over at the end of a long one."""
    floor = mb.RigidContact("floor", "ball", terrain=FLAT, restitution=0.5)
    forces = [mb.Gravity((0.0, -10.0)), planar.PointForce("pull", "ball", force=(0.0, 0.0))]
    system = mb.Scene([planar.PointMass("ball", mass=1.0)], joints=[floor], forces=forces).compile()
    inputs = {"pull.force": lambda t: jnp.stack([0.0 * t, 15.0 * jnp.sin(2 * jnp.pi * t)])}
    leaves, w = np.arcsin(2 / 3) / (2 * np.pi), 2 * np.pi
    left = 0.4 - leaves
    # Twice the integral of the acceleration.
    rises = 15 / w * np.cos(w * leaves) * left - 15 / w**2 * (np.sin(w * 0.4) - 2 / 3) - 5 * left**2
    values = {"ball.position": [0.0, rises]}
    return Scenario(
        system, 0.4, [("floor", "open", leaves)], values, options={"inputs": inputs, "rtol": 1e-8}, near=1e-7
    )


@scenario
def ball_that_is_lifted_after_an_event():
    """It falls on the ground without a rebound, rests, and is lifted by a force that jumps."""
    body = planar.Body("ball", mass=2.0, inertia=0.1, position=(0.0, 1.2))
    floor = mb.RigidContact("floor", "ball", terrain=FLAT, radius=0.2)
    lift = mb.Force("lift", "ball", lambda x, v, t, p: jnp.stack([0.0 * t, jnp.where(t > 1, 30.0, 0.0), 0.0 * t]))
    system = mb.Scene([body], joints=[floor], forces=[DOWN, lift]).compile()
    events = [("floor", "close", np.sqrt(2 / G)), ("floor", "open", 1.0)]
    values = {"ball.position": [0.0, 0.2 + risen(30.0, 0.3)]}
    return Scenario(system, 1.3, events, values, options={"jumps": [1.0], "rtol": 1e-8}, near=1e-7)


@scenario
def particle_that_leaves_a_sphere():
    """Without friction, at two thirds of its height at the start; then it is in free flight."""
    start = 0.1
    leaves = 2 / 3 * np.cos(start)
    system = mb.Scene(
        [planar.PointMass("p", mass=0.7, position=(np.sin(start), np.cos(start)))],
        joints=[mb.RigidBallContact("sphere", "ground", "p", radius_a=1.0, radius_b=0.0)],
        forces=[DOWN],
    ).compile()
    # The time from the energy; by the root of the angle that it has turned, the integrand has no singularity.
    x, weights = np.polynomial.legendre.leggauss(60)
    last = np.sqrt(np.arccos(leaves) - start)
    r = last * (x + 1) / 2
    rate = np.sqrt(4 * G * np.sin(start + r**2 / 2) * np.sin(r**2 / 2))
    time = weights @ (2 * r / rate) * last / 2
    at, speed, late = np.arccos(leaves), np.sqrt(G * leaves), 0.2
    flight = np.array([np.sin(at), leaves]) + late * speed * np.array([leaves, -np.sin(at)]) - [0.0, G * 0.02]
    return Scenario(system, time + late, [("sphere", "open", time)], {"p.position": flight})


# Derivatives

DERIVED = {}


def derived(function):
    DERIVED[function.__name__] = function
    return function


@pytest.mark.slow
@pytest.mark.parametrize("name", DERIVED)
def test_derivatives_are_those_of_closed_forms(name):
    DERIVED[name]().check()


@derived
def bounces():
    """Height, speed and events by the restitution, the floor, the state at the start and the end; the members of a
    batch have two to six impacts.
    """

    def end(x, rtol):
        options = {"rtol": rtol, "max_steps": 300, "max_events": 16}
        motion = mb.simulate(changed(x[0], x[1]), dropped(x[2], x[3]), t1=x[4], **options)
        events = motion.events
        return jnp.concatenate(
            [motion.ys.q[-1, 1:2], motion.ys.u[-1, 1:2], events.times[:2], events.impulses[:2, 0],
             events.kinetic_energy_lost[:2]]
        )  # fmt: skip

    def exact(x):
        restitution, lower, start, speed, t1 = x
        falls = jnp.sqrt(speed**2 + 2 * G * (start - lower))
        time, found = (speed + falls) / G, []
        for _ in range(16):
            found.append((time, 2.0 * (1 + restitution) * falls, falls**2 * (1 - restitution**2)))
            after, left = restitution * falls, t1 - time
            y, v = lower + after * left - G / 2 * left**2, after - G * left
            # It has not yet come down again.
            falls, time = after, time + 2 * after / G
            if time > t1:
                return jnp.concatenate([jnp.stack([y, v]), *(jnp.stack(own) for own in zip(*found[:2], strict=True))])

    many = [[0.8, 0.1, 1.0, -0.4, 1.9], [0.95, -0.5, 1.0, -0.4, 1.9], [0.7, 0.3, 1.0, -0.4, 1.87]]
    return Derived(end, many[0], exact, many=many)


@derived
def particle_that_falls_on_a_sphere():
    """It closes the contact, slides down and leaves: the place, and the times of both events."""
    system = mb.Scene(
        [planar.PointMass("p", mass=0.7, position=(0.3, 1.3))],
        joints=[mb.RigidBallContact("sphere", "ground", "p", radius_a=1.0, radius_b=0.0)],
        forces=[DOWN],
    ).compile()
    start = mb.assemble(system)

    def end(x, rtol):
        own = mb.with_parameters(system, {"sphere.radius_a": x[0]})
        state = dataclasses.replace(start, q=start.q.at[0].set(x[1]))
        motion = mb.simulate(own, state, t1=0.9, rtol=rtol, max_steps=400, max_events=16)
        return jnp.concatenate([motion.ys.q[-1, :2], motion.events.times[:2]])

    return Derived(end, [1.0, 0.3], near=1e-6)


@derived
def particle_that_is_pushed_off_its_floor():
    """By more and more: it leaves when nothing acts on it altogether."""
    forces = [mb.Gravity((0.0, -10.0)), planar.PointForce("push", "ball", force=(0.0, 0.0))]
    floor = mb.RigidContact("floor", "ball", terrain=FLAT)
    system = mb.Scene([planar.PointMass("ball", mass=1.0)], joints=[floor], forces=forces).compile()
    state = mb.assemble(system)

    def end(x, rtol):
        push = {"push.force": lambda t: jnp.stack([0.0 * t, 10.0 * t / x[0]])}
        motion = mb.simulate(system, state, t1=2.0, inputs=push, rtol=rtol, max_steps=300, max_events=8)
        return motion.events.times[:1]

    return Derived(end, [1.0], lambda x: x)


@derived
def pull_that_sets_in_and_ends():
    """While a ball falls onto the floor, and after the impact: by its size, both times and the restitution."""
    system = mb.with_parameters(BALL, {"gravity.acceleration": (0.0, -10.0)})
    state = dropped(0.2)

    def end(x, rtol):
        pull = {"lift.force": lambda t: jnp.where((t < x[1]) | (t >= x[2]), 0.0, jnp.stack([0.0, x[0]]))}
        own, options = mb.with_parameters(system, {"floor.restitution": x[3]}), {"max_steps": 400, "max_events": 8}
        motion = mb.simulate(own, state, t1=0.4, inputs=pull, jumps=x[1:3], rtol=rtol, **options)
        own = motion["ball"]
        return jnp.concatenate([own.position[-1, 1:], own.velocity[-1, 1:], motion.events.times[:1]])

    def exact(x):
        less = 10.0 - x[0] / 2.0
        y, v = 0.2 - 5.0 * x[1] ** 2, -10.0 * x[1]
        falls = (v + jnp.sqrt(v**2 + 2 * less * y)) / less
        v, back = x[3] * (less * falls - v), x[2] - x[1] - falls
        y, v, left = v * back - less / 2 * back**2, v - less * back, 0.4 - x[2]
        return jnp.stack([y + v * left - 5.0 * left**2, v - 10.0 * left, x[1] + falls])

    return Derived(end, [8.0, 0.1, 0.3, 0.5], exact)


@derived
def slider_that_is_let_go():
    """Time and speed by the time at which a brake is let go, and by gravity."""
    slider = planar.Body("slider", mass=1.3, inertia=1.0)
    rail = planar.Prismatic("rail", "ground", "slider", point=(0.0, 0.0), axis=(0.0, 1.0))
    brake = mb.JointFriction("brake", "rail.displacement", force=20.0, static_force=20.0, exact=True)
    system = mb.Scene([slider], joints=[rail], forces=[DOWN, brake]).compile()
    start = mb.assemble(system)

    def end(x, rtol):
        let_go = lambda t: jnp.where(t < x[0], 20.0, 0.0)
        own = mb.with_parameters(system, {"gravity.acceleration": x[1] * jnp.array([0.0, -1.0])})
        inputs = {"brake.force": let_go, "brake.static_force": let_go}
        motion = mb.simulate(own, start, t1=1.0, inputs=inputs, jumps=x[:1], rtol=rtol, max_steps=200, max_events=4)
        return jnp.stack([motion.events.times[0], motion["slider"].velocity[-1, 1]])

    return Derived(end, [0.3, G], lambda x: jnp.stack([x[0], -x[1] * (1.0 - x[0])]))


@derived
def ball_on_a_floor_that_vibrates():
    """It lands without a rebound, rides, and lifts off where the floor falls as gravity does."""
    floor = mb.RigidContact("floor", "ball", terrain=FLAT)
    ball = planar.PointMass("ball", mass=1.3, position=(0.0, 0.25))
    system = mb.Scene([ball], joints=[floor], forces=[DOWN]).compile()
    start = mb.assemble(system)

    def end(x, rtol):
        amplitude, frequency, gravity = x
        wave = {"floor.terrain.level": lambda t: amplitude * jnp.sin(frequency * t)}
        own = mb.with_parameters(system, {"gravity.acceleration": jnp.stack([0.0 * gravity, -gravity])})
        motion = mb.simulate(own, start, t1=0.5, inputs=wave, rtol=rtol, max_steps=400, max_events=8)
        events = motion.events
        return jnp.concatenate([motion.ys.q[-1, 1:2], motion.ys.u[-1, 1:2], events.times[:2], events.impulses[:1, 0]])

    def exact(x):
        amplitude, frequency, gravity = x
        gap = lambda t: 0.25 - gravity / 2 * t**2 - amplitude * np.sin(frequency * t)
        lands = brentq(gap, 0.2, 0.27, xtol=1e-15, rtol=1e-14)
        leaves = (2 * np.pi + np.arcsin(gravity / (amplitude * frequency**2))) / frequency
        impulse = 1.3 * (amplitude * frequency * np.cos(frequency * lands) + gravity * lands)
        v, left = amplitude * frequency * np.cos(frequency * leaves), 0.5 - leaves
        y = amplitude * np.sin(frequency * leaves) + v * left - gravity / 2 * left**2
        return np.array([y, v - gravity * left, lands, leaves, impulse])

    return Derived(end, [0.05, 18.0, G], exact, traced=False, values=1e-8, near=1e-6)


@derived
def particle_on_a_slope_that_rises():
    """Dry friction on it is that under a gravity which is larger by the acceleration of the ground."""
    gradient = 0.6
    floor = mb.RigidContact("floor", "p", terrain=terrain.Slope(-gradient))
    rub = mb.DryFriction("rub", "floor", coefficient=0.3)
    system = mb.Scene([planar.PointMass("p", mass=1.3)], joints=[floor], forces=[DOWN, rub]).compile()
    start = mb.assemble(system, fix={"floor.mode": 1})

    def end(x, rtol):
        wave = {"floor.terrain.level": lambda t: x[0] * (1 - jnp.cos(x[1] * t))}
        own = mb.with_parameters(system, {"rub.coefficient": x[2]})
        motion = mb.simulate(own, start, t1=0.5, inputs=wave, rtol=rtol, max_steps=400, max_events=8)
        return jnp.concatenate([motion.ys.q[-1, :2], motion.ys.u[-1, :2]])

    def exact(x):
        height, rate = jax.jvp(lambda t: x[0] * (1 - jnp.cos(x[1] * t)), (0.5,), (1.0,))
        cos, sin = np.array([1.0, gradient]) / np.hypot(1.0, gradient)
        share = sin - x[2] * cos
        way, speed = share * (G * 0.5**2 / 2 + height), share * (G * 0.5 + rate)
        return jnp.stack([way * cos, height - way * sin, speed * cos, rate - speed * sin])

    return Derived(end, [0.02, 9.0, 0.3], exact, values=1e-8)


@derived
def block_between_stops_that_move():
    """Each impact is with the stop as fast as it moves."""
    block = planar.Body("block", mass=2.0, inertia=0.1, velocity=(1.5, 0.0))
    stops = mb.Stop("stops", "rail.displacement", lower=-0.2, upper=0.3, restitution=0.6)
    system = mb.Scene([block], joints=[rail("block"), stops]).compile()
    start = mb.assemble(system)

    def end(x, rtol):
        wave = lambda t: x[0] * jnp.sin(x[1] * t)
        inputs = {"stops.lower": lambda t: -0.2 + wave(t), "stops.upper": lambda t: 0.3 - 0.5 * wave(t)}
        own = mb.with_parameters(system, {"stops.restitution": x[2]})
        motion = mb.simulate(own, start, t1=0.8, inputs=inputs, rtol=rtol, max_steps=400, max_events=8)
        events = motion.events
        return jnp.concatenate([motion.ys.q[-1, :1], motion.ys.u[-1, :1], events.times[:2], events.impulses[:2, 0]])

    def exact(x):
        wave = lambda t: (x[0] * np.sin(x[1] * t), x[0] * x[1] * np.cos(x[1] * t))
        gap = lambda t, start, speed, middle, share: middle + share * wave(t)[0] - start - speed * t
        time, place, speed, found = 0.0, 0.0, 1.5, []
        for middle, share in ((0.3, -0.5), (-0.2, 1.0)):
            own = place - speed * time, speed, middle, share
            fine = np.linspace(time + 1e-6, 0.8, 1000)
            first = np.flatnonzero(np.diff(np.sign(gap(fine, *own))))[0]
            hit = brentq(gap, fine[first], fine[first + 1], own, xtol=1e-15, rtol=1e-14)
            rate = share * wave(hit)[1]
            after = rate - x[2] * (speed - rate)
            found.append((hit, 2.0 * abs(after - speed)))
            time, place, speed = hit, middle + share * wave(hit)[0], after
        (first, one), (second, other) = found
        return np.array([place + speed * (0.8 - time), speed, first, second, one, other])

    return Derived(end, [0.04, 6.0, 0.6], exact, traced=False, values=1e-8, near=1e-6)


@pytest.mark.slow
def test_derivatives_of_events_are_finite_in_a_member_without_events():
    """In space, where zeros are no attitude; one member of the batch meets the floor, the other does not."""
    ball = spatial.Body("ball", mass=1.0, inertia=(0.1, 0.1, 0.1), position=(0.0, 0.0, 1.0))
    floor = mb.RigidContact("floor", "ball", terrain=FLAT, restitution=0.8)
    system = mb.Scene([ball], joints=[floor], forces=[DOWN_3D]).compile()
    state = mb.assemble(system)

    def first(height):
        start = mb.State(state.q.at[2].set(height), state.u)
        times = mb.simulate(system, start, t1=0.6, rtol=1e-9, max_steps=200, max_events=8).events.times
        return jnp.where(jnp.isfinite(times[0]), times[0], 0.0)

    times, slopes = jit_quickly(jax.vmap(jax.value_and_grad(first)))(jnp.array([1.0, 5.0]))
    np.testing.assert_allclose(times, [FALL, 0.0], rtol=1e-9)
    np.testing.assert_allclose(slopes, [FALL / 2, 0.0], rtol=1e-7)


@pytest.mark.slow
def test_tangents_after_impacts_by_a_matrix_and_one_at_a_time(monkeypatch):
    def last(gravity):
        own = mb.with_parameters(BALL, {"gravity.acceleration": gravity})
        motion = mb.simulate(own, dropped(), t1=0.8, rtol=1e-9, max_steps=300, max_events=8)
        return jnp.append(motion.ys.q[-1], motion.events.times[0])

    at = mb.parameters(BALL)["gravity.acceleration"]
    found = {}
    for most in (256, 0):
        monkeypatch.setattr(restarts, "_MOST_COLUMNS", most)
        jax.clear_caches()
        found[most] = jit_quickly(jax.jacfwd(last))(at), jit_quickly(jax.jacrev(last))(at)
    (forward, reverse), others = found[256], found[0]
    assert np.max(np.abs(forward)) > 0.01
    for other in (reverse, *others):
        np.testing.assert_allclose(other, forward, rtol=1e-10, atol=1e-13)


@pytest.mark.slow
def test_events_are_found_once_in_a_program():
    """Derivatives have them from the motion."""
    found = lambda function: str(jax.make_jaxpr(function)(jnp.array([0.8, 0.1]))).count("name=find_event")
    value = lambda at: end(at, 0.6)
    assert found(value) == found(jax.grad(value)) == found(jax.jacfwd(value)) == 1


# Lifts


def lifted(place=0.2, level=0.0, space=planar):
    """A ball of 2 kg at rest on level ground, with its centre at this height, and a force on it."""
    up = (0.0, 1.0) if space is planar else (0.0, 0.0, 1.0)
    along = lambda size: tuple(size * x for x in up)
    inertia = 0.1 if space is planar else (0.1, 0.1, 0.1)
    floor = mb.RigidContact("floor", "ball", terrain=terrain.Flat(level), radius=place - level)
    forces = [mb.Gravity(along(-G)), space.PointForce("lift", "ball", force=along(0.0))]
    ball = space.Body("ball", mass=2.0, inertia=inertia, position=along(place))
    return mb.Scene([ball], joints=[floor], forces=forces).compile()


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, Hermite(), diffrax.Tsit5()], ids=str)
def test_lift_from_closed_and_open_contacts(solver):
    system = mb.with_parameters(lifted(), {"lift.force": (0.0, 30.0)})
    for closed in (True, False):
        state = mb.assemble(system, fix={"floor.mode": 1} if closed else {})
        motion = mb.simulate(system, state, t1=0.3, solver=solver, max_steps=3000)
        np.testing.assert_allclose(motion["ball"].position[-1, 1], 0.2 + risen(30.0, 0.3), atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("space", [planar, spatial], ids=["planar", "spatial"])
def test_lift_at_all_places(space):
    """Errors of integration scale with the place, and rounding errors of the gap as well."""
    up = 2 if space is spatial else 1
    for place, on_a_level in itertools.product((1e-3, 7.0, 1e3, 1e6), (False, True)):
        system = lifted(place + 0.5 * on_a_level, place if on_a_level else 0.0, space)
        for force in (19.7, 30.0, 1000.0):
            forced = mb.with_parameters(system, {"lift.force": (0.0,) * up + (force,)})
            motion = mb.simulate(forced, forced.guess, t1=0.3, max_steps=1000)
            height, near = motion["ball"].position[-1, up] - system.guess.q[up], 1e-8 * max(place, 1.0)
            np.testing.assert_allclose(height, risen(force, 0.3), atol=near, err_msg=f"{place} {on_a_level} {force}")


@pytest.mark.slow
def test_stops_and_ropes_that_open_at_the_start():
    """A slide is pulled off its stop, and a ball up to the point from which it hangs, at all places."""
    for place in (1e-3, 0.7, 123.4, 1e6):
        near = 1e-8 * max(place, 1.0)
        body = planar.Body("body", mass=2.0, inertia=0.1, position=(place, 0.0))
        slide = planar.Prismatic("slide", "ground", "body", point=(0.0, 0.0), axis=(1.0, 0.0))
        stop = mb.Stop("stop", "slide.displacement", lower=0.0)
        push = planar.PointForce("push", "body", force=(3.0, 0.0))
        system = mb.Scene([body], joints=[slide, stop], forces=[push]).compile()
        moved = mb.simulate(system, mb.assemble(system), t1=0.3, max_steps=1000)["body"].position[-1, 0] - place
        np.testing.assert_allclose(moved, 0.5 * 1.5 * 0.09, atol=near, err_msg=str(place))

        ball = planar.PointMass("ball", mass=2.0, position=(0.0, -place))
        rope = mb.Rope("rope", [("ground", (0.0, 0.0)), ("ball", (0.0, 0.0))], length=place, slack=True)
        lift = planar.PointForce("lift", "ball", force=(0.0, 30.0))
        system = mb.Scene([ball], joints=[rope], forces=[DOWN, lift]).compile()
        t1 = min(0.3, 0.5 * np.sqrt(place))
        moved = mb.simulate(system, mb.assemble(system), t1=t1, max_steps=1000)["ball"].position[-1, 1] + place
        np.testing.assert_allclose(moved, risen(30.0, t1), atol=near, err_msg=str(place))


# Several contacts


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, diffrax.Dopri8()], ids=["Adams", "Dopri8"])
def test_ball_among_pegs_meets_the_first_on_its_way(solver):
    """Steps are long, and gaps close and open again within them; the one that it hits need not be the nearest at the
    end of a step.
    """
    pegs = np.array([(0.3 * (k - row / 2), -0.3 * row) for row in range(4) for k in range(row + 1)])
    contacts = [
        mb.RigidBallContact(f"peg{k}", "ground", "ball", radius_a=0.05, radius_b=0.05, point_a=at, restitution=0.6)
        for k, at in enumerate(pegs)
    ]
    ball = planar.PointMass("ball", mass=1.0, position=(0.0, 0.6))
    system = mb.Scene([ball], joints=contacts, forces=[DOWN]).compile()
    start = mb.assemble(system)

    @jax.jit
    def run(x, v, t1, rtol):
        state = dataclasses.replace(start, q=start.q.at[0].set(x), u=start.u.at[0].set(v))
        motion = mb.simulate(system, state, t1=t1, rtol=rtol, solver=solver, max_events=16, throw=False)
        return motion.events.times[0], motion.stats["num_events"], motion["ball"].position[-1]

    # From the roots of the distances, which are polynomials of degree four of the time.
    known = {
        (-0.07344423617020886, -0.2900834186828825): (1, (-1.7390333603, -1.2669948206)),
        (0.00697999863446766, 0.2610434542726609): (2, (1.9465855, -1.4138574)),
    }
    for (x, v), (number, last) in known.items():
        _, count, end = run(x, v, 1.0, 1e-10)
        assert count == number
        np.testing.assert_allclose(end, last, atol=1e-7)

    def meets(x, v):
        """When it first comes to the distance of a peg, by the roots of a polynomial."""
        found = []
        for a, b in pegs:
            across, down = np.poly1d([v, x - a]), np.poly1d([-G / 2, 0.0, 0.6 - b])
            found += [t.real for t in (across**2 + down**2 - 0.01).roots if abs(t.imag) < 1e-6 and 0 < t.real < 0.9]
        return min(found, default=np.inf)

    rng = np.random.default_rng(0)
    for x, v in zip(rng.uniform(-0.3, 0.3, 60), rng.uniform(-0.5, 0.5, 60), strict=True):
        for rtol in (1e-3, 1e-6, 1e-10):
            near = 1e-6 + 10 * rtol
            np.testing.assert_allclose(run(x, v, 0.9, rtol)[0], meets(x, v), rtol=near, err_msg=f"{x}, {v}, {rtol}")


@pytest.mark.slow
def test_block_comes_to_rest_on_its_corners():
    """Its corners strike in turn, infinitely often in a short time; energy is never gained."""
    block = planar.Body("block", mass=2.0, inertia=0.3, position=(0.0, 0.6), angle=0.05)
    corners = [
        mb.RigidContact(name, "block", terrain=FLAT, centre=(x, -0.4)) for name, x in (("left", -0.2), ("right", 0.2))
    ]
    system = mb.Scene([block], joints=corners, forces=[DOWN]).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=1.0, saveat=np.linspace(0.0, 1.0, 41), rtol=1e-8)
    np.testing.assert_allclose(motion["block"].position[-1], [0.0, 0.4], atol=1e-10)
    assert np.all(np.diff(motion.energy) <= 1e-7) and np.all(np.asarray(motion.events.kinetic_energy_lost) >= 0)
    gaps = np.stack([motion[name].gap for name in ("left", "right")])
    assert np.min(gaps) >= -1e-10
    forces = [motion.reactions[name].force[-1, 1] for name in ("left", "right")]
    np.testing.assert_allclose(forces, [G, G], rtol=1e-9)


@pytest.mark.slow
def test_steps_between_impacts_are_as_long_as_they_can_be():
    """A rattling mass takes three steps from one stop to the other, and a fourth that was too long: the step after an
    impact is as long as it could be after the last one, and one that passes the middle is not too coarse.
    """
    mass = planar.Body("mass", mass=1.0, inertia=1.0, velocity=(10.0, 0.0))
    stop = mb.Stop("stop", "rail.displacement", lower=-0.005, upper=0.005, restitution=0.9999)
    spring = mb.JointSpring("spring", "rail.displacement", stiffness=3.0)
    system = mb.Scene([mass], joints=[rail("mass"), stop], forces=[spring]).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=0.03, rtol=1e-6, error=False)
    assert len(motion.events) == 30
    assert motion.stats["num_rejected_steps"] <= 32
    assert int(motion.stats["num_steps"]) <= 4.2 * 30


# Starts, ends and refusals


@pytest.mark.slow
def test_ball_starts_and_ends_in_all_ways():
    """In contact, beyond it by its last digits, and up to an event of the user's."""
    # The nearer of the two ends closes.
    closed = mb.assemble(BALL, dropped(0.7), fix={"floor.mode": 1})
    np.testing.assert_allclose(closed.q[1], 0.0, atol=1e-15)
    motion = mb.simulate(BALL, closed, t1=0.1, saveat=[0.0, 0.1])
    np.testing.assert_allclose(motion.reactions["floor"].force[:, 1], 2 * G)
    # A motion goes on from a state with its modes.
    np.testing.assert_allclose(motion["floor"].mode, 1.0)
    upwards = mb.assemble(BALL, closed, fix={"floor.mode": 0}, rates={"ball.y": 1.0})
    motion = mb.simulate(BALL, upwards, t1=0.1)
    np.testing.assert_allclose(motion["ball"].position[-1, 1], 0.1 - G * 0.005, atol=1e-9)
    for gap, speed in itertools.product((-1e-6, -1e-8, -1e-10), (1.0, -1.0)):
        motion = mb.simulate(BALL, dropped(gap, speed), t1=0.05, rtol=1e-8)
        rebound = 1.0 if speed > 0 else 0.5
        np.testing.assert_allclose(motion["ball"].velocity[-1, 1], rebound - 0.05 * G, atol=1e-4)
    event = diffrax.Event(lambda t, y, args, **_: t - 0.4, optimistix.Newton(1e-10, 1e-10))
    motion = mb.simulate(BALL, dropped(), t1=2.0, event=event, rtol=1e-10)
    np.testing.assert_allclose(motion.ts[-1], 0.4)
    assert len(motion.events) == 0 and motion.stats["num_events"] == 0


def test_given_steps_with_contacts_are_refused():
    steps = {"solver": diffrax.Dopri8(), "stepsize_controller": diffrax.ConstantStepSize(), "dt0": 0.01}
    with pytest.raises(ValueError, match=r"With contacts .* end at events, which ConstantStepSize does not allow"):
        mb.simulate(BALL, BALL.guess, t1=0.1, **steps)


@pytest.mark.slow
def test_motions_with_contacts_that_cannot_be_are_refused():
    state = mb.assemble(BALL)
    run = lambda start=state, t1=1.0, **options: mb.simulate(BALL, start, t1=t1, **options)
    pendulum = mb.mechanisms.pendulum()
    # Seconds since 1970: the next number is a quarter of a microsecond away.
    late = {"t0": 1.7e9, "t1": 1.7e9 + 1}
    few = r"came to t = 1\.12.* more impacts and other events of contacts than"
    for error, call, message in (
        (ValueError, lambda: run(mb.assemble(BALL, fix={"ball.y": -0.1})), r"beyond contacts, .*t0 = 0: floor by 0\.1"),
        (ValueError, lambda: mb.assemble(BALL, fix={"floor.mode": 3}), r"'floor\.mode' is 1 to close .*; got 3"),
        (ValueError, lambda: run(t1=-1.0), "Impacts cannot be undone"),
        (ValueError, lambda: run(max_events=0), "max_events must be an integer of at least 1"),
        (RuntimeError, lambda: run(t1=2.0, max_events=2), few),
        (RuntimeError, lambda: run(**late), r"numbers next to t = 1.7e\+09 are 2.4e-07 s away.*begin at zero"),
        (ValueError, lambda: run(manifold=mb.manifold.Baumgarte()), r"Partition\(\) or Projection\(\)"),
        (ValueError, lambda: mb.simulate(pendulum.system, pendulum.state, t1=0.1).events, "has neither contacts"),
    ):
        with pytest.raises(error, match=message):
            call()

    @jax.jit
    def ended(restitution):
        return mb.simulate(changed(restitution), dropped(), t1=0.1).result._value

    # Numbers that do not agree where they are traced.
    assert ended(1.0) == mb.RESULTS.successful._value
    assert ended(1.5) == mb.RESULTS.invalid_parameters._value


# What counts as closed


@pytest.mark.slow
def test_gaps_that_count_as_closed():
    """A thousandth of the tolerance with every manifold, and no less than positions are found to."""

    def touch(policy, solver, rtol):
        term, prepared = policy.prepare(
            BALL, policy.default_formulation(BALL), solver, policy.accuracy(np.float64(rtol))
        )
        return float((term if isinstance(solver, mb.solvers.Adams) else prepared).guards.touch)

    ways = [
        (manifold.Partition, mb.solvers.Adams()),
        (manifold.Projection, mb.solvers.Adams()),
        (manifold.Projection, diffrax.Dopri8()),
    ]
    for (policy, solver), rtol in itertools.product(ways, (1e-3, 1e-6, 1e-9)):
        for newton_tol in (None, 1e-13):
            np.testing.assert_allclose(touch(policy(newton_tol=newton_tol), solver, rtol), 1e-3 * rtol)
        np.testing.assert_allclose(touch(policy(newton_tol=1e-5), solver, rtol), 1e-5)


@pytest.mark.slow
def test_what_counts_as_closed_does_not_depend_on_the_size_of_a_scene():
    """A ball beside bars whose rows are eliminated along the joints, with the steps of a dense matrix."""
    lone = planar.Body("ball", mass=1.0, inertia=planar.disc(1.0, 0.1), position=(-3.0, 0.5))
    floor = mb.RigidContact("floor", "ball", terrain=FLAT, radius=0.1, restitution=0.5)
    bars = [planar.Body(f"bar{k}", mass=1.0, inertia=0.1, position=(3.0 * k, 2.0)) for k in range(15)]
    pins = [planar.Revolute(f"pin{k}", "ground", f"bar{k}", point=(3.0 * k, 3.0)) for k in range(15)]
    system = mb.Scene([lone, *bars], joints=[floor, *pins], forces=[DOWN]).compile()
    assert system.elimination is not None
    start = mb.assemble(system)
    for rtol, count in ((1e-3, 3), (1e-6, 8)):
        runs = [mb.simulate(system, start, t1=1.2, rtol=rtol, manifold=own) for own in (None, manifold.Partition())]
        kinds = [[(event.kind, event.part) for event in motion.events] for motion in runs]
        assert kinds[0] == kinds[1] and len(kinds[0]) == count
        times = [[event.time for event in motion.events] for motion in runs]
        np.testing.assert_allclose(*times, atol=10 * rtol)
