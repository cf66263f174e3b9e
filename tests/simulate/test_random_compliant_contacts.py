"""Random compliant contacts of every kind, driven and free, beside runs whose steps are too short to miss one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar, spatial

pytestmark = pytest.mark.slow

Linear = mb.contact.Linear
# Random cases of each kind, and the number of steps of a run that misses nothing.
CASES, STEPS = 6, 2000


def discs():
    """Two free discs that meet or pass each other."""
    disc = {"mass": 1.0, "inertia": 0.01}
    bodies = [planar.Body("a", **disc), planar.Body("b", position=(1.0, 0.0), **disc)]
    meet = planar.DiscContact("meet", ("a", "b"), normal=Linear(1e4), radius=0.1, radii=0.1, smoothing=1e-4)

    def case(draw):
        radius, speed = 10 ** draw(-2.5, -1), 10 ** draw(-1, 1.5)
        numbers = {
            "meet.radius": radius,
            "meet.radii": radius,
            "meet.normal.stiffness": 10 ** draw(1, 5) * speed**2,
            "meet.smoothing": radius * 10 ** draw(-4, -1),
        }
        there = [speed * draw(0.2, 0.8), draw(-2.2, 2.2) * radius]
        return numbers, {"b": there}, {"b.velocity": [-speed, 0.0]}, 1.0

    return mb.Scene(bodies, forces=[meet]).compile(), case


def plate():
    """A ball that flies through, against or past a free plate, which may turn."""
    bodies = [planar.Body("ball", mass=0.1, inertia=1e-4), planar.Body("plate", mass=2.0, inertia=0.1)]
    ends = {"start": (-0.5, 0.0), "end": (0.5, 0.0), "edge": 0.01}
    hit = planar.PlateContact("hit", ("ball", "plate"), normal=Linear(1e4), radius=0.01, smoothing=1e-4, **ends)

    def case(draw):
        radius, speed, angle = 10 ** draw(-3, -1), 10 ** draw(-1, 2), draw(-1.3, 1.3)
        along = np.array([np.sin(angle), -np.cos(angle)])
        numbers = {
            "hit.radius": radius,
            "hit.normal.stiffness": 10 ** draw(-2, 2) * 0.1 * (speed / radius) ** 2,
            "hit.smoothing": radius * 10 ** draw(-4, -1),
        }
        there = np.array([draw(-0.7, 0.7), 0.0]) - speed * draw(0.2, 0.8) * along
        rates = {"ball.velocity": speed * along, "plate.angular_velocity": draw(-3, 3) * (draw(0, 1) > 0.5)}
        return numbers, {"ball": there}, rates, 1.0

    return mb.Scene(bodies, forces=[hit]).compile(), case


def bump():
    """A ball that flies over a lone bump, or against it."""
    ball = spatial.Body("ball", mass=1.0, inertia=0.01 * np.eye(3))
    ground = mb.terrain.Bump(start=5.0, length=0.5, peak=0.1)
    hit = spatial.Contact("hit", "ball", terrain=ground, normal=Linear(1e4), radius=0.1, smoothing=1e-4)

    def case(draw):
        radius, speed, length = 10 ** draw(-2, -0.5), 10 ** draw(0, 2), 10 ** draw(-2, 0)
        peak = length * draw(0.05, 0.3)
        numbers = {
            "hit.radius": radius,
            "hit.normal.stiffness": 10 ** draw(1, 4) * speed**2,
            "hit.smoothing": min(peak, radius) * 10 ** draw(-4, -1),
            "hit.terrain.start": speed * draw(0.2, 0.8),
            "hit.terrain.length": length,
            "hit.terrain.peak": peak,
        }
        there = [0.0, 0.0, radius + peak * draw(0.3, 1.2)]
        return numbers, {"ball": there}, {"ball.velocity": [speed, 0.0, 0.0]}, 1.0

    return mb.Scene([ball], forces=[hit]).compile(), case


def tyre():
    """A wheel that rolls over a lone kerb or ditch."""
    wheel = planar.Body("wheel", mass=20.0, inertia=1.0)
    numbers = {"coefficient": 0.8, "slip_stiffness": 10.0, "relaxation_length": 0.3, "damping": 500.0}
    ground = mb.terrain.Bump(start=5.0, length=0.5, peak=0.1)
    rolls = planar.Tyre("tyre", "wheel", radius=0.3, terrain=ground, normal=Linear(1e5), **numbers)

    def case(draw):
        speed, length = 10 ** draw(0.5, 1.5), 10 ** draw(-1, 0)
        numbers = {
            "tyre.terrain.start": speed * draw(0.2, 0.7),
            "tyre.terrain.length": length,
            "tyre.terrain.peak": length * draw(0.05, 0.25) * (1.0 if draw(0, 1) > 0.5 else -0.5),
            "tyre.smoothing": 10 ** draw(-5, -3),
        }
        rates = {"wheel.velocity": [speed, 0.0], "wheel.angular_velocity": -speed / 0.3}
        return numbers, {"wheel": [0.0, 0.3 - 20 * 9.81 / 1e5]}, rates, 1.0

    return mb.Scene([wheel], forces=[mb.Gravity((0.0, -9.81)), rolls]).compile(), case


def joint_stop():
    """A bar in space that turns back from its stops."""
    bar = spatial.Body("bar", mass=1.0, inertia=0.1 * np.eye(3))
    pin = spatial.Revolute("pin", "ground", "bar", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    stop = mb.JointStop("stop", "pin.angle", lower=-2.0, upper=2.0, stiffness=10.0)

    def case(draw):
        rate, lower, upper = 10 ** draw(-0.5, 1.5), -draw(2.5, 3.1), draw(2.5, 3.1)
        half = np.pi - 0.5 * (upper - lower)
        numbers = {
            "stop.lower": lower,
            "stop.upper": upper,
            "stop.stiffness": 0.1 * (rate / half) ** 2 * 10 ** draw(0.1, 2),
            "stop.smoothing": 10 ** draw(-5, -2),
        }
        return numbers, {"pin.angle": draw(-2, 2)}, {"pin.angle": rate}, draw(4, 10) / rate

    return mb.Scene([bar], joints=[pin], forces=[stop]).compile(), case


def draft_gear():
    """Two cars that run through the slack of their coupler again and again."""
    cars = [planar.Body("a", mass=1.0, inertia=1.0), planar.Body("b", mass=2.0, inertia=1.0, position=(5.0, 0.0))]
    numbers = {"stiffness": 1e3, "unloading": 1.0, "preload": 0.0, "travel": 1.0, "stop_stiffness": 0.0}
    gear = planar.DraftGear("gear", "a", "b", slack=0.1, smoothing=1e-3, **numbers)

    def case(draw):
        speed, slack = 10 ** draw(-1, 1), 10 ** draw(-2, -0.5)
        numbers = {
            "gear.slack": slack,
            "gear.stiffness": 10 ** draw(3, 6) * speed**2,
            "gear.smoothing": slack * 10 ** draw(-4, -1),
        }
        return numbers, {"b": [5.0, 0.0]}, {"b.velocity": [speed, 0.0]}, draw(2, 6) * slack / speed

    return mb.Scene(cars, forces=[gear]).compile(), case


def layer():
    """A ball that flies through a thin layer of a user's force."""

    def push(poses, velocities, t, p):
        inside = jnp.maximum(p["width"] ** 2 - (poses[0, 0] - p["place"]) ** 2, 0.0)
        return jnp.zeros_like(velocities).at[0, 0].set(-p["strength"] * inside**2)

    gap = lambda poses, t, p: jnp.abs(poses[0, 0] - p["place"]) - p["width"]
    ball = spatial.Body("ball", mass=1.0, inertia=0.01 * np.eye(3))
    numbers = {"width": 0.1, "place": 1.0, "strength": 1.0}
    own = mb.Force("layer", "ball", push, parameters=numbers, gap=gap)

    def case(draw):
        speed, width = 10 ** draw(-1, 2), 10 ** draw(-5, -1.3)
        numbers = {
            "layer.place": speed * draw(0.1, 0.9),
            "layer.width": width * speed,
            "layer.strength": 10 ** draw(-2, -0.5) / speed**3 / width**5,
        }
        return numbers, {"ball": [0.0, 0.0, 0.0]}, {"ball.velocity": [speed, 0.0, 0.0]}, 1.0

    return mb.Scene([ball], forces=[own]).compile(), case


KINDS = {
    "discs": discs,
    "plate": plate,
    "bump": bump,
    "tyre": tyre,
    "joint stop": joint_stop,
    "draft gear": draft_gear,
    "layer": layer,
}


def start(system, places, rates):
    """A state with positions of bodies and their rates, or with coordinates of joints and theirs."""
    if system.velocity_rows:
        return mb.assemble(system, fix=places, rates=rates)
    q, u = np.array(system.guess.q), np.array(system.guess.u)
    nq, nu = (size // len(system.body_names) for size in (system.nq, system.nu))
    for body, place in places.items():
        k = nq * system.body_names.index(body)
        q[k : k + len(place)] = place
    for name, rate in rates.items():
        body, _, kind = name.partition(".")
        k = nu * system.body_names.index(body) + 2 * (kind == "angular_velocity")
        u[k : k + np.size(rate)] = rate
    return mb.State(jnp.asarray(q), jnp.asarray(u), system.guess.z)


def test_a_bar_turns_through_weak_stops():
    """Opposite of their middle the angle wraps, and the force jumps from that of one stop to that of the other."""
    system, _ = joint_stop()
    numbers = {"stop.lower": -2.985, "stop.upper": 2.809, "stop.stiffness": 20.0, "stop.smoothing": 1e-5}
    own = mb.with_parameters(system, numbers)
    y = start(own, {"pin.angle": -0.4665}, {"pin.angle": 12.88})
    with pytest.warns(UserWarning, match=r"'stop' jumps where 'pin\.angle' is half a turn from -0\.088 rad"):
        runs = [mb.simulate(own, y, t1=0.5, rtol=rtol, dtmax=dtmax) for rtol, dtmax in ((1e-11, 1e-4), (1e-8, None))]
    assert runs[1].stats["num_steps"] + runs[1].stats["num_rejected_steps"] < 1000
    for found, known in zip(*(jax.tree.leaves(run.ys) for run in runs), strict=True):
        np.testing.assert_allclose(found, known, rtol=0, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_random_contacts_are_not_passed_over(kind):
    system, case = KINDS[kind]()
    rng = np.random.default_rng(5)
    for k in range(CASES):
        numbers, places, rates, t1 = case(rng.uniform)
        rtol = 10 ** rng.uniform(-9, -4)
        own = mb.with_parameters(system, numbers)
        y = start(own, places, rates)

        def end(rtol, dtmax=None, own=own, y=y, t1=t1):
            motion = mb.simulate(own, y, t1=t1, rtol=rtol, dtmax=dtmax)
            return motion.ys.q[-1], motion.ys.u[-1]

        exact, short, found = end(1e-11, t1 / STEPS), end(rtol, t1 / STEPS), end(rtol)
        sizes = [np.abs(x).max() + 1e-9 for x in exact]

        def off(z, exact=exact, sizes=sizes):
            return max(np.abs(x - e).max() / size for x, e, size in zip(z, exact, sizes, strict=True))

        assert off(found) < max(300 * rtol, 30 * off(short)), (k, numbers, places, rates, t1, rtol)
