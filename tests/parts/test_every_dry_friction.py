"""Dry friction in every kind of joint and contact by itself: its constraint, its force, its numbers, its words."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from every_dry_friction import FRICTIONS, friction_scene

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.formulations import Multipliers, accelerations
from jaxmb.parts import terrain
from jaxmb.parts.modes import FREE, STICK
from jaxmb.parts.planar.kinematics import PLANE
from jaxmb.system.instant import Instant

# The velocities of the bodies are any: those in the closest state are used.
pytestmark = pytest.mark.filterwarnings("ignore:The velocities given with the bodies")


def state_of(system):
    """A state with velocities, in which contacts are closed."""
    return mb.assemble(system, fix={"joint.mode": 1} if system.contacts.n else {})


def test_slip_counts_from_the_belt():
    system = friction_scene("disc on a belt")
    t = jnp.zeros(())
    at = lambda q, u: Instant(system, t, q, u)
    both = jax.jit(lambda q, u: (at(q, u).contact_motion.rates[-1], at(q, u).contact_place.gradients[-1] @ u))
    slip, moves = both(system.guess.q, system.guess.u)
    np.testing.assert_allclose(slip, moves - FRICTIONS["disc on a belt"][2].speed, rtol=1e-12)


def test_slip_in_a_pin_is_its_radius_times_the_relative_rate():
    pin = planar.Revolute("pin", "a", "b", point_a=(0.1, 0.2), point_b=(0.3, 0.0))
    rub = mb.DryFriction("rub", "pin", coefficient=0.3, radius=0.1).of_sources([pin], [(0, 1)])
    rub = rub.resolve(PLANE, np.zeros((2, 3)))
    turning = np.array([[0.2, 0.1, 0.6], [0.4, -0.3, -0.4]])
    slip = jax.jit(lambda u: rub.slip(PLANE, jnp.zeros((2, 3)), u))(turning)
    np.testing.assert_allclose(slip, [0.1 * (-0.4 - 0.6)], rtol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("name", FRICTIONS)
def test_stick_is_a_constraint_and_slip_a_force(name):
    system = friction_scene(name)
    state = state_of(system)
    t, q, u = jnp.zeros(()), state.q, state.u
    of, directions = system.contacts, system.contacts.m
    at = lambda mode: of.with_modes(q, of.modes(q).numbers.at[-directions:].set(mode))
    slip = np.asarray(Instant(system, t, q, u).contact_motion.rates[-directions:])
    speed = np.linalg.norm(slip)
    assert directions == (2 if "ball" in name or name in ("sleeve", "face") else 1) and speed > 1e-3

    # Where it sticks, its rows are those of the slip.
    udot, multipliers = accelerations(system, Multipliers(), t, at(STICK), u)
    np.testing.assert_allclose(Instant(system, t, q, u).contact_accelerations(udot)[-directions:], 0.0, atol=1e-11)
    rows = np.array(of.rows)[of.n :]
    moves = Instant(system, t, q, u).contact_place.gradients[-directions:] @ u
    friction = FRICTIONS[name][2]
    constant = isinstance(friction, mb.JointFriction)
    belt = None if constant else friction.speed
    np.testing.assert_allclose(moves, slip if belt is None else slip + belt, rtol=1e-11)
    touching = (
        "pin",
        "brake on a pin",
        "two discs",
        "point on a plane that moves",
        "two balls",
        "ball on a plane that moves",
    )
    assert name in touching or np.all(multipliers[rows] != 0)

    # Where it slips, it takes μ N |s|, and N is the force of the joint, or one; in space also where its mode is another
    # direction, on the same side.
    mode = slip / speed
    if directions == 2:
        mode = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]]) @ mode
    udot, multipliers = accelerations(system, Multipliers(), t, at(mode), u)
    assert np.all(multipliers[rows] == 0)
    times, states = t[None], mb.State(at(mode)[None], u[None])
    reaction = system.catalogue.reaction("joint", times, states, multipliers[None])
    normal = 1.0 if constant else np.linalg.norm(reaction.force[0])
    if of.n:
        # That of a contact has a sign, so that the law is smooth where an iteration passes through zero.
        normal = normal * np.sign(multipliers[of.rows[0]])
    power = jnp.dot(system.nonideal_force(t, at(mode), u, multipliers), u)
    np.testing.assert_allclose(power, -0.3 * normal * np.dot(slip, moves) / speed, rtol=1e-10)
    reactions = system.friction_reactions(t, q, u, multipliers)
    np.testing.assert_allclose(jnp.linalg.norm(reactions, axis=1), np.full(directions, abs(normal)), rtol=1e-10)
    residual = system.inertia(t, q, u).product(udot) - system.force(t, q, u)
    force = system.constraint_force(t, at(mode), u, multipliers) + system.nonideal_force(t, at(mode), u, multipliers)
    np.testing.assert_allclose(residual, force, atol=1e-10)

    # And otherwise nothing.
    assert jnp.all(system.nonideal_force(t, at(FREE), u, multipliers) == 0)


@pytest.mark.slow
def test_the_direction_of_slip_has_a_sense_at_rest_and_beyond():
    """Slip that has begun has the direction of its modes; that of slip which has passed through zero does not jump."""
    system = friction_scene("ball on an edge")
    state = state_of(system)
    t, q, u, of = jnp.zeros(()), state.q, state.u, system.contacts
    slip = np.asarray(Instant(system, t, q, u).contact_motion.rates[-2:])
    at = lambda mode: of.with_modes(q, of.modes(q).numbers.at[-2:].set(mode))
    rows = Instant(system, t, q, u).contact_place.gradients[-2:]

    def direction(mode):
        _, multipliers = accelerations(system, Multipliers(), t, at(mode), u)
        force = system.nonideal_force(t, at(mode), u, multipliers)
        load = 0.3 * np.linalg.norm(system.friction_reactions(t, q, u, multipliers)[0])
        return -np.linalg.lstsq(np.asarray(rows).T, np.asarray(force))[0] / load

    along = slip / np.linalg.norm(slip)
    other = np.array([0.6, -0.8])
    np.testing.assert_allclose(np.abs(direction(0.5 * other)), np.abs(other), rtol=1e-9)
    np.testing.assert_allclose(direction(along), -direction(-along), rtol=1e-9)
    np.testing.assert_allclose(np.abs(direction(along)), np.abs(along), rtol=1e-9)


@pytest.mark.slow
def test_words_and_numbers():
    system = friction_scene("pin")
    text = str(system.describe())
    assert "DryFriction  rub  of joint, where it sticks 1 row each" in text
    assert "3 coordinates, 3 velocities" not in text and "4 coordinates, 4 velocities" in text
    assert "rub.mode" in system.coordinate_names()
    assert {"rub.coefficient", "rub.static_coefficient", "rub.radius"} <= set(mb.parameters(system))
    changed = mb.with_parameters(system, {"rub.coefficient": 0.1, "rub.static_coefficient": 0.2})
    law = changed.contact_laws(0.0).slip
    assert law.ask("coefficient", jnp.zeros(1)) == 0.1 and law.ask("limit") == 0.2
    # Without a coefficient of stick that of slip holds.
    changed = mb.with_parameters(friction_scene("slide"), {"rub.coefficient": 0.1})
    assert changed.contact_laws(0.0).slip.ask("limit") == 0.1


BODY = planar.Body("a", mass=1.0, inertia=1.0)
SLIDE = planar.Prismatic("joint", "ground", "a", axis=(1.0, 0.0), point=(0.0, 0.0))
PIN = planar.Revolute("joint", "ground", "a", point=(0.0, 0.5))
BODY_3D = spatial.Body("a", mass=1.0, inertia=(1.0, 1.0, 1.0))
SLEEVE = spatial.Cylindrical("joint", "ground", "a", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
CARDAN = spatial.Universal(
    "joint", "ground", "a", point=(0.0, 0.0, 0.0), axis_a_W=(1.0, 0.0, 0.0), axis_b_W=(0.0, 1.0, 0.0)
)
FLOOR = mb.RigidContact("joint", "a", terrain=terrain.Flat(), radius=0.1)
TWIN = planar.Prismatic("twin", "ground", "a", axis=(1.0, 0.0), point=(0.0, 0.0))
BALL = spatial.Spherical("joint", "ground", "a", point=(0.0, 0.0, 0.0))
STOP = mb.Stop("joint", "pin.angle", lower=-1.0)
# Joints, options besides the coefficient, and the message.
BAD = {
    "a negative coefficient": ([SLIDE], {"coefficient": -0.1}, "coefficient must be non-negative, got -0.1"),
    "a limit below it": ([SLIDE], {"static_coefficient": 0.2}, "must not be less than coefficient, got 0.2 and 0.3"),
    "a pin without radius": ([PIN], {}, "turns: give the radius of its pin"),
    "a slide with radius": ([SLIDE], {"radius": 0.1}, "slides and has no radius"),
    "a floor with radius": ([FLOOR], {"radius": 0.1}, "slides and has no radius"),
    "a sleeve without radius": ([SLEEVE], {}, "turns: give the radius of its pin"),
    "a ball joint": ([BALL], {}, "has no coordinate that is a number, as a pin or a slide has; it has"),
    "several angles": ([CARDAN], {"radius": 0.1}, "several coordinates: give 'joint.angle_a' or 'joint.angle_b' as"),
    "one speed of two": (
        [SLEEVE],
        {"radius": 0.1, "speed": 1.0},
        "two directions, and speed must have shape (2,), got",
    ),
    "two speeds of one": ([SLIDE], {"speed": (1.0, 0.0)}, "one direction, and speed must have shape (), got (2,)"),
    "a rope": ([mb.Slack("joint", "ground", "a", length=2.0)], {}, "has no point at which"),
    "a stop": ([PIN.named("pin"), STOP], {}, "Stop 'joint' has no point at which"),
    "no such joint": ([PIN.named("other")], {}, "joint"),
    "a redundant joint": ([SLIDE, TWIN], {}, "needs the force of 'joint', which is not determined"),
}


@pytest.mark.parametrize(
    "joint, message",
    [
        ("joint.angel", "joint.angle"),
        ("joint.displacement", "slides and has no radius"),
        ("face.displacement", "'face.displacement' must be a number"),
        ("floor.gap", "friction in RigidContact 'floor' is given by its name, 'floor'"),
    ],
)
def test_bad_coordinates(joint, message):
    face = spatial.Planar("face", "ground", "b", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    floor = mb.RigidContact("floor", "b", terrain=terrain.Flat())
    rub = mb.DryFriction("rub", joint, coefficient=0.3, radius=None if "floor" in joint else 0.1)
    with pytest.raises(ValueError, match="DryFriction 'rub'") as caught:
        mb.Scene([BODY_3D, BODY_3D.named("b")], joints=[SLEEVE, face, floor], forces=[rub]).compile()
    assert message in str(caught.value)


@pytest.mark.slow(
    but=("a sleeve without radius", "a ball joint", "several angles", "one speed of two", "two speeds of one", "a stop")
)
@pytest.mark.parametrize("name", BAD)
def test_bad_input(name):
    joints, options, message = BAD[name]
    body = BODY_3D if isinstance(joints[0], spatial.Cylindrical | spatial.Spherical | spatial.Universal) else BODY
    options = {"coefficient": 0.3} | options
    with pytest.raises(ValueError, match="DryFriction 'rub'") as caught:
        mb.Scene([body], joints=joints, forces=[mb.DryFriction("rub", "joint", **options)]).compile()
    assert message in str(caught.value)


@pytest.mark.slow
def test_what_needs_smooth_forces_refuses_it():
    system = friction_scene("slide")
    with pytest.raises(ValueError, match="rub may stick or slip"):
        mb.linearise(system, mb.assemble(system))
    with pytest.raises(ValueError, match="remove friction"):
        mb.equilibrium(system)
    with pytest.raises(ValueError, match="joints must hold constraints"):
        mb.Scene([BODY], joints=[SLIDE, mb.DryFriction("rub", "joint", coefficient=0.3)])


@pytest.mark.slow
def test_ball_rubs_on_a_surface_of_the_user_as_on_the_slope_that_it_is():
    """Also where its normal is known only by automatic differentiation."""
    ball = spatial.Body("ball", mass=1.0, inertia=(0.1, 0.1, 0.1), position=(0.0, 0.0, 0.3))
    q, u = np.array([0.1, 0.2, 0.4, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), np.linspace(-1.0, 1.0, 9)

    def seen(ground):
        floor = mb.RigidContact("floor", "ball", terrain=ground, radius=0.2)
        system = mb.Scene([ball], joints=[floor], forces=[mb.DryFriction("rub", "floor", coefficient=0.3)]).compile()
        at = lambda q, u: Instant(system, jnp.zeros(()), q, u)
        return jax.jit(lambda q, u: (*at(q, u).contact_place[:2], *at(q, u).contact_motion))(q, u)

    surface = mb.terrain.Surface(lambda place, p: p["rise"] * place[0], parameters={"rise": 0.5})
    for own, known in zip(seen(surface), seen(mb.terrain.Slope(0.5)), strict=True):
        np.testing.assert_allclose(own, known, rtol=0, atol=1e-14)


class HalfSlip(mb.DryFriction):
    """Friction of a user, by half of the slip."""

    def slip(self, space, poses, velocities):
        return 0.5 * super().slip(space, poses, velocities)


def test_slip_that_a_user_defines_counts_on_every_surface():
    disc = planar.Body("disc", mass=1.0, inertia=0.1, position=(0.0, 0.2))
    floor = mb.RigidContact("floor", "disc", terrain=terrain.Flat(), radius=0.2)
    system = mb.Scene([disc], joints=[floor], forces=[HalfSlip("rub", "floor", coefficient=0.3)]).compile()
    seen = jax.jit(lambda q, u: Instant(system, jnp.zeros(()), q, u).contact_motion.rates)
    rates = seen(system.guess.q, np.array([1.0, 2.0, 3.0, 0.0, 0.0]))
    np.testing.assert_allclose(rates, [2.0, 0.5 * (1.0 + 0.2 * 3.0)], rtol=1e-14)
