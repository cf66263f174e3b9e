"""Derivatives of motions with impacts and dry friction by all their parameters: forward mode is reverse mode, and both
are differences of a tighter solution.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly
from jax.flatten_util import ravel_pytree

import jaxmb as mb
from jaxmb import planar, spatial, terrain

pytestmark = pytest.mark.slow

MOST_PARAMETERS = 20
RTOL, TIGHTER, STEP = 1e-10, 1e-11, 1e-4
# Relative to the largest derivative of the same output. The direction of slip that comes to rest has rounding errors,
# and with it the time of rest; differences have the errors of `TIGHTER` over `STEP`.
SAME, NEAR = 1e-8, 2e-6
DOWN, BELOW = mb.Gravity((0.0, -9.81)), mb.Gravity((0.0, 0.0, -9.81))
TILTED = tuple(np.array([0.8, 0.5, 0.2, 0.1]) / np.linalg.norm([0.8, 0.5, 0.2, 0.1]))
SCENES = {}


def scene(*names, t1):
    """Register a scene, with the parameters that keep its events, or with all."""

    def registered(function):
        SCENES[function.__name__] = function, names, t1
        return function

    return registered


def disc(name, x, y, **rates):
    return planar.Body(name, mass=0.8, inertia=planar.disc(0.8, 0.2), position=(x, y), **rates)


def ball(name, *position, **rates):
    return spatial.Body(name, mass=1.3, inertia=(0.1, 0.12, 0.15), position=position, **rates)


@scene(t1=0.9)
def pendulum_that_strikes_a_stop():
    rod = planar.Body("rod", mass=1.2, inertia=planar.rod(1.2, 1.0), position=(0.5, 0.0))
    stop = mb.Stop("stop", "pin.angle", lower=-1.0, restitution=0.6)
    return mb.Scene([rod], joints=[planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0)), stop], forces=[DOWN])


@scene(t1=0.5)
def disc_that_falls_slides_and_rolls_on_a_slope():
    floor = mb.RigidContact("floor", "disc", terrain=terrain.Slope(0.2), radius=0.2)
    rub = mb.DryFriction("rub", "floor", coefficient=0.25)
    body = disc("disc", 0.0, 0.3, velocity=(0.5, 0.0), angular_velocity=2.0)
    return mb.Scene([body], joints=[floor], forces=[DOWN, rub])


@scene(t1=1.5)
def rod_that_slips_in_its_pin_and_sticks():
    rod = planar.Body("rod", mass=1.2, inertia=planar.rod(1.2, 1.0), position=(0.3, -0.4))
    rub = mb.DryFriction("rub", "pin", coefficient=0.6, radius=0.3)
    return mb.Scene([rod], joints=[planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0))], forces=[DOWN, rub])


@scene(t1=0.6)
def discs_that_strike_each_other_and_the_floor():
    bodies = [disc("a", 0.0, 0.6, velocity=(0.8, 0.0)), disc("b", 0.7, 0.7, velocity=(-0.6, 0.1))]
    joints = [
        mb.RigidContact("floor a", "a", terrain=terrain.Flat(), radius=0.2, restitution=0.5),
        mb.RigidBallContact("both", "a", "b", radius_a=0.2, radius_b=0.2, restitution=0.7),
    ]
    rub = mb.DryFriction("rub", "both", coefficient=0.2)
    return mb.Scene(bodies, joints=joints, forces=[DOWN, rub])


@scene("bar.mass", "bar.inertia", "gravity.acceleration", "left.restitution", t1=0.45)
def bar_that_falls_on_both_of_its_ends():
    """At one time, along parameters that keep it so: impulses at the ends change each other."""
    bar = planar.Body("bar", mass=1.0, inertia=0.15, position=(0.0, 0.6), velocity=(0.3, 0.0))
    ends = [
        mb.RigidContact(name, "bar", terrain=terrain.Flat(), radius=0.1, centre=(x, 0.0), restitution=0.5)
        for name, x in (("left", -0.5), ("right", 0.5))
    ]
    return mb.Scene([bar], joints=ends, forces=[DOWN])


@scene(t1=0.5)
def balls_that_strike_the_floor_at_one_time():
    """Which do not touch each other: each has derivatives by its parameters."""
    bodies = [ball("a", 0.0, 0.0, 0.6), ball("b", 2.0, 0.0, 0.6, velocity=(0.4, 0.2, 0.0))]
    floors = [
        mb.RigidContact(f"floor {name}", name, terrain=terrain.Flat(), radius=0.2, restitution=0.5) for name in "ab"
    ]
    rub = mb.DryFriction("rub", "floor b", coefficient=0.3)
    return mb.Scene(bodies, joints=floors, forces=[BELOW, rub])


@scene(t1=0.5)
def ball_that_bounces_slides_and_rolls():
    body = ball("ball", 0.0, 0.0, 0.25, velocity=(0.6, 0.2, 0.0), angular_velocity=(0.6, -0.3, 0.2))
    floor = mb.RigidContact("floor", "ball", terrain=terrain.Flat(), radius=0.2, restitution=0.0)
    return mb.Scene([body], joints=[floor], forces=[BELOW, mb.DryFriction("rub", "floor", coefficient=0.25)])


@scene(t1=0.21)
def eccentric_ball_on_waves():
    body = ball("ball", 0.1, 0.0, 0.32, velocity=(0.3, 0.2, 0.0), angular_velocity=(0.6, -0.3, 0.2), orientation=TILTED)
    waves = terrain.Sinusoid(amplitude=0.1, wavelength=2.0)
    floor = mb.RigidContact("floor", "ball", terrain=waves, radius=0.2, centre=(0.02, 0.0, 0.03), restitution=0.3)
    return mb.Scene([body], joints=[floor], forces=[BELOW, mb.DryFriction("rub", "floor", coefficient=0.3)])


@scene(t1=0.3)
def ball_that_strikes_a_turning_box():
    bodies = [
        ball("box", 0.0, 0.0, 0.0, velocity=(0.1, 0.0, 0.0), angular_velocity=(0.1, 0.2, 0.3)),
        ball("ball", 0.05, 0.0, 0.45, velocity=(0.2, 0.1, -1.0)),
    ]
    hits = mb.RigidBoxContact("hits", "box", "ball", size=(0.4, 0.3, 0.5), radius=0.1, restitution=0.3)
    return mb.Scene(bodies, joints=[hits], forces=[mb.DryFriction("rub", "hits", coefficient=0.3)])


@scene(t1=0.6)
def door_with_friction_that_strikes_its_stop():
    door = spatial.Body("door", mass=2.0, inertia=(0.1, 0.2, 0.25), position=(0.4, 0.0, 0.0))
    hinge = spatial.Revolute("hinge", "ground", "door", point=(0.0, 0.0, 0.0), axis=(0.48, 0.64, 0.6))
    joints = [hinge, mb.Stop("stop", "hinge.angle", lower=-0.3, upper=1.0, restitution=0.5)]
    forces = [BELOW, mb.DryFriction("rub", "hinge", coefficient=0.2, radius=0.05)]
    return mb.Scene([door], joints=joints, forces=forces)


def may_change(system, key, value):
    """Whether a parameter may be less: a restitution of zero may not."""
    try:
        mb.with_parameters(system, {key: np.asarray(value) - 2 * STEP})
    except ValueError:
        return False
    return True


@pytest.mark.parametrize("name", SCENES)
def test_derivatives_through_events_by_all_parameters(name):
    made, names, t1 = SCENES[name]
    system = made().compile()
    motion = mb.simulate(system, mb.assemble(system), t1=t1, rtol=RTOL)
    count = int(motion.stats["num_events"])
    assert count > 0
    known = {key: value for key, value in mb.parameters(system).items() if not names or key in names}
    flat, restored = ravel_pytree({key: value for key, value in known.items() if may_change(system, key, value)})
    assert flat.size >= len(names)
    free = np.arange(min(flat.size, MOST_PARAMETERS))
    weights = np.random.default_rng(0).normal(size=(3, system.nq + system.nu))

    def outputs(changes, rtol):
        moved = mb.with_parameters(system, restored(flat.at[free].add(changes)))
        motion = mb.simulate(moved, mb.assemble(moved), t1=t1, rtol=rtol)
        ends, events = jnp.concatenate([motion.ys.q[-1], motion.ys.u[-1]]), motion.events
        return jnp.concatenate([weights @ ends, events.times[:count], events.kinetic_energy_lost[:count]])

    still = jnp.zeros(free.size)
    forward = jit_quickly(jax.jacfwd(lambda x: outputs(x, RTOL)))(still)
    pull = jit_quickly(lambda w: jax.vjp(lambda x: outputs(x, RTOL), still)[1](w)[0])
    reverse = np.stack([pull(w) for w in np.eye(len(forward))])
    value = jit_quickly(lambda x: outputs(x, TIGHTER))
    differences = [
        (8 * (value(still + step) - value(still - step)) - (value(still + 2 * step) - value(still - 2 * step)))
        / (12 * STEP)
        for step in STEP * np.eye(free.size)
    ]
    size = np.max(np.abs(forward), axis=1, keepdims=True) + 1e-3
    assert np.max(np.abs(forward - reverse) / size) < SAME
    far = np.abs(forward - np.stack(differences, axis=1)) / size
    assert np.max(far) < NEAR, (np.argwhere(far >= NEAR), far.max())
