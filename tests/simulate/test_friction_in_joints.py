"""Dry friction in joints that slide in two directions, in one of several coordinates, and on belts, against closed
forms.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.parts import terrain

pytestmark = pytest.mark.slow

G, MASS, RADIUS, COEFFICIENT = 9.81, 2.0, 0.4, 0.3
DOWN = mb.Gravity((0.0, 0.0, -G))
UP, EAST = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
# With this moment of inertia slip changes as the velocity of a particle does, along a straight line.
INERTIA = MASS * RADIUS**2


def shaft(rub, forces=(), velocity=0.0, spin=0.0):
    """A shaft in a sleeve, across its weight; it turns and slides."""
    body = spatial.Body(
        "shaft",
        mass=MASS,
        inertia=(INERTIA, 0.3, 0.3),
        velocity=(velocity, 0.0, 0.0),
        angular_velocity=(spin, 0.0, 0.0),
    )
    pin = spatial.Cylindrical("pin", "ground", "shaft", point=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0))
    return mb.Scene([body], joints=[pin], forces=[DOWN, rub, *forces]).compile()


def in_sleeve(**options):
    return mb.DryFriction("rub", "pin", radius=RADIUS, **({"coefficient": COEFFICIENT} | options))


SLOWING = shaft(in_sleeve(), velocity=3.0, spin=5.0)


def test_a_shaft_that_turns_and_slides_comes_to_rest_at_once():
    """Friction is against the direction of slip, which stays."""
    motion = mb.simulate(SLOWING, mb.assemble(SLOWING), t1=2.0, saveat=[0.5, 2.0], rtol=1e-10)
    slip = np.array([3.0, 5.0 * RADIUS])
    speed, slow = np.linalg.norm(slip), COEFFICIENT * G
    (stop,) = motion.events
    assert (stop.part, stop.kind) == ("rub", "stick")
    np.testing.assert_allclose(stop.time, speed / slow, rtol=1e-10)
    along = np.array([speed * 0.5 - slow * 0.125, 0.5 * speed**2 / slow])
    np.testing.assert_allclose(motion["shaft"].position[:, 0], along * slip[0] / speed, rtol=1e-9)
    np.testing.assert_allclose(motion["pin"].angle, along * slip[1] / speed / RADIUS, rtol=1e-9)
    wrench = motion.reactions["rub"]
    force = -COEFFICIENT * MASS * G * slip / speed
    np.testing.assert_allclose(wrench.force[:, 0], [force[0], 0.0], atol=1e-9)
    np.testing.assert_allclose(wrench.moment[:, 0], [force[1] * RADIUS, 0.0], atol=1e-9)


def stopped(p):
    """Displacement and turn of the shaft at rest, added up."""
    system = mb.with_parameters(SLOWING, {"rub.coefficient": p[0], "rub.radius": p[1], "shaft.mass": p[2]})
    motion = mb.simulate(system, mb.assemble(system), t1=2.0, saveat=[2.0], rtol=1e-10)
    return motion["shaft"].position[0, 0] + motion["pin"].angle[0]


def test_derivatives_up_to_rest():
    """With another radius or mass the direction of slip changes."""
    p, along = jnp.array([COEFFICIENT, RADIUS, MASS]), jnp.array([0.3, -0.2, 1.0])
    value, slope = jit_quickly(jax.value_and_grad(stopped))(p)
    np.testing.assert_allclose(value, 0.5 * np.sqrt(13.0) / (COEFFICIENT * G) * (3.0 + 5.0), rtol=1e-9)
    np.testing.assert_allclose(slope[0], -value / COEFFICIENT, rtol=1e-8)
    forward = jit_quickly(lambda p: jax.jvp(stopped, (p,), (along,))[1])(p)
    np.testing.assert_allclose(forward, slope @ along, rtol=1e-11)
    h = 1e-4
    difference = (stopped(p + h * along) - stopped(p - h * along)) / (2 * h)
    np.testing.assert_allclose(forward, difference, rtol=1e-6)


def test_a_moment_helps_a_force_to_move_a_shaft():
    """It starts when both together reach the limit, in their direction."""
    moment, rate = 0.8 * 0.4 * MASS * G * RADIUS, 2.0
    push = mb.Force(
        "push", ["shaft"], lambda x, v, t, p: jnp.zeros((1, 6)).at[0, 0].set(p["rate"] * t), parameters={"rate": rate}
    )
    system = shaft(in_sleeve(static_coefficient=0.4), [mb.JointForce("motor", "pin.angle", force=moment), push])
    motion = mb.simulate(system, mb.assemble(system), t1=3.3, saveat=[3.0, 3.3], rtol=1e-9)
    (start,) = motion.events
    starts = 0.6 * 0.4 * MASS * G / rate
    assert start.kind == "slip" and starts < 3.0
    np.testing.assert_allclose(start.time, starts, rtol=1e-9)


def test_friction_along_the_axis_alone():
    """By name friction acts in one coordinate; the shaft goes on turning."""
    rub = mb.DryFriction("rub", "pin.displacement", coefficient=COEFFICIENT)
    system = shaft(rub, velocity=3.0, spin=5.0)
    motion = mb.simulate(system, mb.assemble(system), t1=2.0, saveat=[2.0], rtol=1e-9)
    (stop,) = motion.events
    np.testing.assert_allclose(stop.time, 3.0 / (COEFFICIENT * G), rtol=1e-9)
    np.testing.assert_allclose(motion["shaft"].angular_velocity[0, 0], 5.0, rtol=1e-12)
    np.testing.assert_allclose(motion["shaft"].position[0, 0], 4.5 / (COEFFICIENT * G), rtol=1e-9)


def test_a_block_on_a_face_comes_to_rest_on_a_belt():
    """The face moves; the block slips along a straight line until it moves with it."""
    speed = np.array([0.8, -0.6])
    block = spatial.Body("block", mass=MASS, inertia=(0.1, 0.1, 0.1), velocity=(2.0, 1.0, 0.0))
    face = spatial.Planar("face", "ground", "block", point=(0.0, 0.0, 0.0), axis=UP, x_a=EAST, x_b=EAST)
    rub = mb.DryFriction("rub", "face", coefficient=COEFFICIENT, speed=speed)
    system = mb.Scene([block], joints=[face], forces=[DOWN, rub]).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=1.0, saveat=[1.0], rtol=1e-9)
    slip = np.array([2.0, 1.0]) - speed
    (stop,) = motion.events
    np.testing.assert_allclose(stop.time, np.linalg.norm(slip) / (COEFFICIENT * G), rtol=1e-9)
    at = speed + 0.5 * slip * np.linalg.norm(slip) / (COEFFICIENT * G)
    np.testing.assert_allclose(motion["block"].position[0, :2], at, rtol=1e-9)
    np.testing.assert_allclose(motion["block"].velocity[0, :2], speed, rtol=1e-9)


def block_on_a_belt(on):
    """A block that slips on a moving face or terrain."""
    rub = mb.DryFriction("rub", on, coefficient=COEFFICIENT, speed=(0.8, -0.6))
    if on == "face":
        joint = spatial.Planar("face", "ground", "block", point=(0.0, 0.0, 0.0), axis=UP, x_a=EAST, x_b=EAST)
        block = spatial.Body("block", mass=MASS, inertia=(0.1, 0.1, 0.1), velocity=(2.0, 1.0, 0.0))
    else:
        joint = mb.RigidContact("floor", "block", terrain=terrain.Flat())
        block = spatial.PointMass("block", mass=MASS, velocity=(2.0, 1.0, 0.0))
    return mb.Scene([block], joints=[joint], forces=[DOWN, rub]).compile()


@pytest.mark.parametrize("on", ["face", "floor"])
def test_derivatives_on_a_belt_with_two_directions(on):
    """With respect to the friction and both components of the belt's speed, of the time at which slip ends and of where
    the block is after that.
    """
    system = block_on_a_belt(on)

    def comes_to_rest(p):
        moved = mb.with_parameters(system, {"rub.coefficient": p[0], "rub.speed": p[1:]})
        motion = mb.simulate(moved, mb.assemble(moved), t1=1.0, saveat=[1.0], rtol=1e-10)
        return jnp.append(motion["block"].position[0, :2], motion.events.times[0])

    def exact(p):
        slip = jnp.array([2.0, 1.0]) - p[1:]
        time = jnp.linalg.norm(slip) / (p[0] * G)
        return jnp.append(p[1:] + 0.5 * slip * time, time)

    p = jnp.array([COEFFICIENT, 0.8, -0.6])
    np.testing.assert_allclose(jit_quickly(comes_to_rest)(p), exact(p), rtol=1e-9)
    forward = jit_quickly(jax.jacfwd(comes_to_rest))(p)
    np.testing.assert_allclose(forward, jax.jacfwd(exact)(p), atol=1e-8)
    np.testing.assert_allclose(jit_quickly(jax.jacrev(comes_to_rest))(p), forward, atol=1e-11)


SPRING, SPEED, STICK, SLIP = 50.0, 0.5, 0.35, 0.2


@pytest.mark.parametrize("on", ["slide", "floor"])
def test_stick_and_slip_on_a_belt_that_is_no_body(on):
    """The period of a block on a spring, in a joint and on a terrain that move."""
    if on == "slide":
        joint = planar.Prismatic("slide", "ground", "block", axis=(1.0, 0.0), point_a=(0.0, 0.0), point_b=(0.0, 0.0))
        block = planar.Body("block", mass=MASS, inertia=0.1, velocity=(SPEED, 0.0))
    else:
        joint = mb.RigidContact("floor", "block", terrain=terrain.Flat())
        block = planar.PointMass("block", mass=MASS, velocity=(SPEED, 0.0))
    rub = mb.DryFriction("rub", on, coefficient=SLIP, static_coefficient=STICK, speed=SPEED)
    spring = planar.SpringDamper("spring", "ground", "block", stiffness=SPRING, free_length=0.0)
    system = mb.Scene([block], joints=[joint], forces=[mb.Gravity((0.0, -G)), spring, rub]).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=6.0, rtol=1e-10)
    further, w = (STICK - SLIP) * MASS * G / SPRING, np.sqrt(SPRING / MASS)
    first = STICK * MASS * G / SPRING / SPEED
    period = 2 * further / SPEED + (2 * np.pi - 2 * np.arctan(further * w / SPEED)) / w
    rubs = [event for event in motion.events if event.part == "rub"]
    assert [event.kind for event in rubs][-9:] == ["slip", "stick"] * 4 + ["slip"]
    np.testing.assert_allclose([event.time for event in rubs][-9::2], first + period * np.arange(5.0), rtol=1e-10)


def test_derivatives_by_the_speed_of_a_belt():
    """A block at rest is taken along until it is as fast as the belt."""
    slide = planar.Prismatic("slide", "ground", "block", axis=(1.0, 0.0), point_a=(0.0, 0.0), point_b=(0.0, 0.0))
    rub = mb.DryFriction("rub", "slide", coefficient=COEFFICIENT, speed=SPEED)
    block = planar.Body("block", mass=MASS, inertia=0.1)
    system = mb.Scene([block], joints=[slide], forces=[mb.Gravity((0.0, -G)), rub]).compile()
    state = mb.assemble(system)

    def place(p):
        changed = mb.with_parameters(system, {"rub.speed": p[0], "rub.coefficient": p[1]})
        return mb.simulate(changed, state, t1=1.0, saveat=[1.0], rtol=1e-10)["block"].position[0, 0]

    p = jnp.array([SPEED, COEFFICIENT])
    exact = lambda p: p[0] - p[0] ** 2 / (2 * p[1] * G)
    value, slope = jit_quickly(jax.value_and_grad(place))(p)
    np.testing.assert_allclose(value, exact(p), rtol=1e-9)
    np.testing.assert_allclose(slope, jax.grad(exact)(p), rtol=1e-8)
    forward = jit_quickly(lambda p: jax.jvp(place, (p,), (jnp.array([0.3, -0.2]),))[1])(p)
    np.testing.assert_allclose(forward, slope @ np.array([0.3, -0.2]), rtol=1e-11)
