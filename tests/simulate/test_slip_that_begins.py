"""Slip that begins without an acceleration: where the limit of stick is the friction of slip, the force grows through
it, and the first derivative of the slip that is not zero is the second.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly
from oracles.block_on_belt import Belt, moved, smoothly_moved

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
    return mb.simulate(mb.with_parameters(system, numbers), start, t1=end, saveat=[end], rtol=rtol, max_events=60, throw=throw)


@functools.cache
def compiled():
    """The end of a motion, and its events."""
    scene()

    def run(belt, x, v, end, rtol):
        out = motion(belt, x, v, end, rtol, throw=False)
        end = jnp.stack([out["block"].position[-1, 0], out["block"].velocity[-1, 0]])
        return end, out.events.times, out.events.after[:, 0], out.stats["num_events"], out.result == mb.RESULTS.successful

    return jit_quickly(run)


def run(belt, x, v, end, rtol):
    arguments = jax.tree.map(lambda number: jnp.asarray(number, float), (belt, x, v, end, rtol))
    end, times, after, count, right = map(np.asarray, compiled()(*arguments))
    assert right
    number = int(np.isfinite(times).sum())
    assert count == number
    return end, times[:number], after[:number]


@pytest.mark.long
@pytest.mark.parametrize("rtol", [1e-4, 1e-6, 1e-8, 1e-10])
@pytest.mark.parametrize("name", CASES)
def test_a_block_on_a_belt(name, rtol):
    """Each slip begins once, at the time found by hand."""
    belt, x, v = CASES[name]
    *known, events = moved(belt, x, v, 1.3)
    end, times, after = run(belt, x, v, 1.3, rtol)
    np.testing.assert_allclose(end, known, rtol=0, atol=30 * rtol)
    # A slip that begins at the start is an event just after it.
    late = times > 1e-6
    np.testing.assert_allclose(times[late], [time for time, _ in events], rtol=30 * rtol)
    np.testing.assert_array_equal(after[late] % 2, [abs(mode) for _, mode in events])
    assert times.size <= len(events) + 1


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


@pytest.mark.long
def test_random_belts():
    """Many of them, with one program, against events by hand."""
    chance = np.random.default_rng(0)
    for k in range(200):
        belt, x, v, rtol = _random_case(chance)
        *known, events = moved(belt, x, v, 2.0)
        end, times, _ = run(belt, x, v, 2.0, rtol)
        scale = 1 + np.abs(known)
        np.testing.assert_allclose(end, known, rtol=0, atol=np.max(100 * rtol * scale), err_msg=f"{k}: {belt} {x} {v} {rtol}")
        # Slip that grazes zero may stick for a moment, or not.
        assert times.size <= 2 * len(events) + 3, (k, belt, x, v, rtol)
