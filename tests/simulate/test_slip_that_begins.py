"""Slip that begins without an acceleration: where the limit of stick is the friction of slip, the force grows through
it, and the first derivative of the slip that is not zero is the second.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly
from oracles.block_on_belt import Belt, moved
from scipy.integrate import solve_ivp

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.parts import terrain

G = 9.81
BELT = Belt(
    mass=2.0,
    stiffness=50.0,
    damping=0.0,
    speed=0.5,
    slip=0.2,
    stick=0.2,
    weight=2.0 * G,
    push=0.0,
    rate=0.0,
    fall=0.0,
    width=0.1,
)
LIMIT = 0.2 * 2.0 * G
# Cases: the belt, the displacement and the velocity at the start.
CASES = {
    "spring": (BELT, 0.0, 0.5),
    "falling friction": (BELT._replace(fall=0.1 * 2.0 * G), 0.0, 0.5),
    "a larger limit": (BELT._replace(stick=0.3), 0.0, 0.5),
    "at the limit": (BELT, LIMIT / 50.0, 0.5),
    "at the other limit": (BELT, -LIMIT / 50.0, 0.5),
    "ramp": (BELT._replace(stiffness=0.0, speed=0.0, rate=4.0), 0.0, 0.0),
    "ramp from the limit": (BELT._replace(stiffness=0.0, speed=0.0, rate=4.0, push=LIMIT), 0.0, 0.0),
    "ramp back from the limit": (BELT._replace(stiffness=0.0, speed=0.0, rate=-4.0, push=LIMIT), 0.0, 0.0),
    "at rest at the limit": (BELT._replace(stiffness=0.0, speed=0.0, push=LIMIT), 0.0, 0.0),
}


def _others(x, v, t, p):
    """A push that grows with time, damping, and by how much friction falls with the velocity of slip."""
    slip = v[0, 0] - p["speed"]
    less = p["fall"] * (1 - jnp.exp(-jnp.abs(slip) / p["width"])) * jnp.sign(slip)
    along = p["push"] + p["rate"] * t - p["damping"] * v[0, 0] + less
    return jnp.stack([along, 0.0 * along, 0.0 * along])[None]


@functools.cache
def scene():
    slide = planar.Prismatic("slide", "ground", "block", axis=(1.0, 0.0), point=(0.0, 0.0))
    spring = planar.SpringDamper("spring", "ground", "block", stiffness=50.0, free_length=0.0)
    rub = mb.DryFriction("rub", "slide", coefficient=0.2, static_coefficient=0.2, speed=0.5)
    numbers = dict.fromkeys(("push", "rate", "damping", "fall", "width", "speed"), 0.1)
    others = mb.Force("others", ["block"], _others, parameters=numbers)
    block = planar.Body("block", mass=2.0, inertia=0.1)
    system = mb.Scene([block], joints=[slide], forces=[mb.Gravity((0.0, -G)), spring, rub, others]).compile()
    return system, mb.assemble(system)


def motion(belt, x, v, end, rtol, throw=True):
    numbers = {
        "block.mass": belt.mass,
        "spring.stiffness": belt.stiffness,
        "rub.coefficient": belt.slip,
        "rub.static_coefficient": belt.stick,
        "rub.speed": belt.speed,
    }
    numbers |= {f"others.{name}": getattr(belt, name) for name in ("push", "rate", "damping", "fall", "width", "speed")}
    system, state = scene()
    start = mb.State(state.q.at[0].set(x), state.u.at[0].set(v))
    changed = mb.with_parameters(system, numbers)
    return mb.simulate(changed, start, t1=end, saveat=[end], rtol=rtol, max_events=60, throw=throw)


@functools.cache
def compiled():
    """The end of a motion, and its events."""
    scene()

    def run(belt, x, v, end, rtol):
        out = motion(belt, x, v, end, rtol, throw=False)
        end = jnp.stack([out["block"].position[-1, 0], out["block"].velocity[-1, 0]])
        right = out.result == mb.RESULTS.successful
        return end, out.events.times, out.events.after[:, 0], out.stats["num_events"], right

    return jit_quickly(run)


def run(belt, x, v, end, rtol):
    arguments = jax.tree.map(lambda number: jnp.asarray(number, float), (belt, x, v, end, rtol))
    end, times, after, count, right = map(np.asarray, compiled()(*arguments))
    assert right
    number = int(np.isfinite(times).sum())
    assert count == number
    return end, times[:number], after[:number]


@pytest.mark.slow
def test_block_on_a_belt_slips_when_its_force_grows_through_the_limit():
    """Each slip begins once, at the time found by hand."""
    for name, (belt, x, v) in CASES.items():
        *known, events = moved(belt, x, v, 1.3)
        for rtol in (1e-4, 1e-7, 1e-10):
            end, times, after = run(belt, x, v, 1.3, rtol)
            np.testing.assert_allclose(end, known, rtol=0, atol=30 * rtol, err_msg=name)
            # A slip that begins at the start is an event just after it.
            late = times > 1e-6
            np.testing.assert_allclose(times[late], [time for time, _ in events], rtol=30 * rtol, err_msg=name)
            np.testing.assert_array_equal(after[late] % 2, [abs(mode) for _, mode in events], err_msg=name)
            assert times.size <= len(events) + 1, name


def _random_case(chance):
    """A belt, a start that sticks, is at the limit or slips, and a tolerance."""
    sometimes = lambda share, number: number if chance.random() < share else 0.0
    mass, slip = chance.uniform(0.5, 5.0), chance.uniform(0.05, 0.6)
    stick = slip * (1 + sometimes(0.5, chance.uniform(0.001, 0.8)))
    belt = Belt(
        mass=mass,
        stiffness=np.exp(chance.uniform(np.log(5.0), np.log(200.0))),
        damping=sometimes(0.5, chance.uniform(0.0, 1.0)),
        speed=chance.choice([-1, 1]) * chance.uniform(0.02, 1.0),
        slip=slip,
        stick=stick,
        weight=mass * G,
        push=0.0,
        rate=sometimes(0.3, chance.uniform(-4.0, 4.0)),
        fall=sometimes(0.5, chance.uniform(0.0, 0.7) * slip * mass * G),
        width=chance.uniform(0.05, 0.3),
    )
    start = chance.choice(["sticks", "at the limit", "slips"])
    limit = stick * belt.weight
    x, v = chance.uniform(-0.9, 0.9) * limit / belt.stiffness, belt.speed
    if start == "slips":
        v = v + chance.uniform(-1.0, 1.0)
    if start == "at the limit":
        belt = belt._replace(push=chance.choice([-1, 1]) * limit - belt.other_force(0.0, x, v))
    return belt, x, v, 10.0 ** chance.integers(-10, -3)


@pytest.mark.slow
def test_random_belts():
    """Many of them, with one program, against events by hand."""
    chance = np.random.default_rng(0)
    for k in range(80):
        belt, x, v, rtol = _random_case(chance)
        *known, events = moved(belt, x, v, 2.0)
        end, times, _ = run(belt, x, v, 2.0, rtol)
        case = f"{k}: {belt} {x} {v} {rtol}"
        np.testing.assert_allclose(end, known, rtol=0, atol=100 * rtol * (1 + np.max(np.abs(known))), err_msg=case)
        # Slip that grazes zero may stick for a moment, or not.
        assert times.size <= 2 * len(events) + 3, case


def _slips_once(belt, end):
    """Displacement, velocity and the time of the slip in closed form: it swings about where it began to slip."""
    first, w = belt.slip * belt.mass * G / belt.stiffness, jnp.sqrt(belt.stiffness / belt.mass)
    angle = w * (end - first / belt.speed)
    return jnp.stack([first + belt.speed / w * jnp.sin(angle), belt.speed * jnp.cos(angle), first / belt.speed])


# Numbers that change together, so that the limit of stick stays the friction of slip.
ALONG = jax.tree.map(jnp.zeros_like, BELT)._replace(slip=0.1, stick=0.1, mass=0.7, stiffness=-20.0, speed=0.2, fall=0.3)


@functools.cache
def derivatives():
    """Of displacement, velocity and the time of the first event along a direction, and in reverse of one of these."""
    scene()

    def ended(belt, end):
        out = motion(belt, 0.0, belt.speed, end, 1e-9, throw=False)
        return jnp.stack([out["block"].position[-1, 0], out["block"].velocity[-1, 0], out.events.times[0]])

    forward = lambda belt, along, end: jax.jvp(lambda belt: ended(belt, end), (belt,), (along,))
    reverse = lambda belt, weights, end: jax.grad(lambda belt: weights @ ended(belt, end))(belt)
    return jit_quickly(forward), jit_quickly(reverse)


@pytest.mark.slow
@pytest.mark.parametrize("name, end", [("spring", 1.2), ("falling friction", 2.0)])
def test_slip_that_begins_has_derivatives(name, end):
    """Forward, in reverse and by differences; its time moves with the numbers. Where friction falls with the velocity,
    the block sticks and slips again.
    """
    forward, reverse = derivatives()
    direction = ALONG if CASES[name][0].fall > 0 else ALONG._replace(fall=0.0 * ALONG.fall)
    numbers = lambda step: jax.tree.map(lambda at, change: jnp.asarray(at + step * change), CASES[name][0], direction)
    value, slope = forward(numbers(0.0), direction, end)
    h, ends = 1e-4, []
    for step in (h, -h):
        belt = numbers(step)
        at, times, _ = run(belt, 0.0, belt.speed, end, 1e-11)
        ends.append(np.append(at, times[0]))
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / (2 * h), rtol=1e-5)
    if name == "spring":
        exact, change = jax.jvp(lambda belt: _slips_once(belt, end), (numbers(0.0),), (direction,))
        np.testing.assert_allclose(value, exact, rtol=1e-8)
        np.testing.assert_allclose(slope, change, rtol=1e-7)
    for k, weights in enumerate(np.eye(3)):
        back = reverse(numbers(0.0), weights, end)
        along = sum(jax.tree.leaves(jax.tree.map(jnp.multiply, back, direction)))
        np.testing.assert_allclose(along, slope[k], rtol=1e-9)


def _swings(end, weight, rate, radius=0.05, slip=0.3, mass=2.0, length=0.4, inertia=0.1):
    """The angle and rate at the time `end` of a pendulum that a moment `rate t` pushes through the friction of its pin,
    which is in proportion to the size of the force there.
    """
    first = slip * radius * weight / rate

    def field(t, y):
        angle, speed = y
        turn = 0.0
        for _ in range(60):
            across = mass * length * turn + weight * np.sin(angle)
            force = np.hypot(across, mass * length * speed**2 + weight * np.cos(angle))
            moment = rate * t - weight * length * np.sin(angle) - slip * radius * force
            turn = moment / (inertia + mass * length**2)
        return speed, turn

    run = solve_ivp(field, (first, end), (0.0, 0.0), "DOP853", rtol=1e-12, atol=1e-14)
    return first, run.y[:, -1]


@pytest.mark.slow
def test_pin_that_rubs_begins_to_turn():
    """Its friction depends on the force of the pin, which depends on the motion."""
    mass, length, rate = 2.0, 0.4, 2.0
    moment = lambda x, v, t, p: jnp.stack([0.0 * t, 0.0 * t, p["rate"] * t])[None]
    bob = planar.Body("bob", mass=mass, inertia=0.1, position=(0.0, -length))
    pin = planar.Revolute("pin", "ground", "bob", point=(0.0, 0.0))
    rub = mb.DryFriction("rub", "pin", coefficient=0.3, radius=0.05)
    push = mb.Force("push", ["bob"], moment, parameters={"rate": rate})
    system = mb.Scene([bob], joints=[pin], forces=[mb.Gravity((0.0, -G)), rub, push]).compile()
    first, known = _swings(1.2, mass * G, rate)
    for rtol in (1e-5, 1e-8):
        out = mb.simulate(system, mb.assemble(system), t1=1.2, saveat=[1.2], rtol=rtol, max_events=10)
        assert [event.kind for event in out.events] == ["slip"]
        np.testing.assert_allclose(out.events.times, [first], rtol=10 * rtol)
        np.testing.assert_allclose([out["bob"].angle[0], out["bob"].angular_velocity[0]], known, atol=30 * rtol)


@functools.cache
def _in_space(on):
    force = lambda t, p: (p["start"] + p["rate"] * t) * jnp.array([0.6, 0.8])
    push = lambda x, v, t, p: jnp.zeros_like(v).at[0, :2].set(force(t, p))
    if on == "face":
        joint = spatial.Planar(
            "face", "ground", "block", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), x_a=(1.0, 0.0, 0.0), x_b=(1.0, 0, 0)
        )
        block = spatial.Body("block", mass=2.0, inertia=(0.1, 0.1, 0.1))
    else:
        joint = mb.RigidContact("floor", "block", terrain=terrain.Flat())
        block = spatial.PointMass("block", mass=2.0)
    rub = mb.DryFriction("rub", on, coefficient=0.2, speed=(0.3, 0.4))
    spring = spatial.SpringDamper("spring", "ground", "block", stiffness=50.0, free_length=0.0)
    push = mb.Force("push", ["block"], push, parameters={"start": 0.0, "rate": 0.0})
    return mb.Scene([block], joints=[joint], forces=[mb.Gravity((0.0, 0.0, -G)), rub, spring, push]).compile()


@pytest.mark.slow
@pytest.mark.parametrize("on", ["face", "floor"])
def test_block_in_a_plane_in_space(on):
    """On a belt, and under a ramp of force, it slips along a line."""
    system = _in_space(on)
    along = np.array([0.6, 0.8])
    for name in ("spring", "ramp", "ramp from the limit", "ramp back from the limit"):
        belt, x, v = CASES[name]
        numbers = {"push.rate": belt.rate, "push.start": belt.push, "rub.speed": belt.speed * along}
        numbers["spring.stiffness"] = belt.stiffness
        changed = mb.with_parameters(system, jax.tree.map(jnp.asarray, numbers))
        guess = mb.State(system.guess.q.at[:2].set(x * along), system.guess.u.at[:2].set(v * along))
        start = mb.assemble(changed, guess, fix={"floor.mode": 1} if on == "floor" else None)
        out = mb.simulate(changed, start, t1=1.3, saveat=[1.3], rtol=1e-6, max_events=10)
        *known, events = moved(belt, x, v, 1.3)
        np.testing.assert_allclose(out["block"].position[0, :2], known[0] * along, atol=1e-5)
        np.testing.assert_allclose(out["block"].velocity[0, :2], known[1] * along, atol=1e-5)
        late = out.events.times > 1e-6
        np.testing.assert_allclose(out.events.times[late], [time for time, _ in events], rtol=1e-5)
