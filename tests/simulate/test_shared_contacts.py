"""Four ropes and four feet of one body, whose shares of a force the equations leave open."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.contacts.dry_laws import Dry
from jaxmb.contacts.friction import frictional
from jaxmb.contacts.shares import Sharing
from jaxmb.states.consistency import consistent

G = 9.81
CORNERS = np.array([(0.3, 0.2), (0.3, -0.2), (-0.3, 0.2), (-0.3, -0.2)])
INERTIA = np.diag([0.03, 0.04, 0.05])
DOWN = mb.Gravity((0.0, 0.0, -G))


@functools.cache
def on_ropes():
    """A box of 2 kg on four equal ropes of 1 m; its mass centre is 0.1 m below the plane of their ends."""
    box = spatial.Body("box", mass=2.0, inertia=INERTIA, position=(0.0, 0.0, -1.1))
    ropes = [
        mb.Slack(f"rope {k}", "ground", "box", point_a=(*xy, 0.0), point_b=(*xy, 0.1), length=1.0)
        for k, xy in enumerate(CORNERS)
    ]
    return mb.Scene([box], joints=ropes, forces=[DOWN]).compile()


def shares(bodies, joints):
    return isinstance(mb.Scene(bodies, joints=joints).compile().contacts.sharing, Sharing)


def test_disc_inside_one_of_several_boxes_is_refused_by_name():
    """It has no normal there."""
    wheel = planar.Body("wheel", mass=1.0, inertia=planar.disc(1.0, 0.1), position=(2.2, 0.05))
    box = lambda k: mb.RigidBoxContact(
        f"step {k}", "ground", "wheel", size=(1.0, 0.5), point_a=(2.0 + k, 0.0), radius=0.1
    )
    system = mb.Scene([wheel], joints=[box(0), box(1)]).compile()
    with pytest.raises(ValueError, match=r"beyond contacts.*step 0 by 0.1"):
        consistent(system, 0.0, system.guess)


def test_which_contacts_are_known_to_share():
    """Those of one body, also while they are open and tilted."""
    assert isinstance(on_ropes().contacts.sharing, Sharing)
    tilted = [np.cos(0.2), np.sin(0.2), 0.0, 0.0]
    box = spatial.Body("box", mass=2.0, inertia=INERTIA, position=(0.0, 0.0, 1.0), orientation=tilted)
    foot = lambda k, xy: mb.RigidContact(f"foot {k}", "box", terrain=mb.terrain.Flat(), centre=(*xy, -0.1))
    feet = [foot(k, xy) for k, xy in enumerate(CORNERS)]
    assert shares([box], feet) and not shares([box], feet[:3])


@pytest.mark.slow
def test_which_contacts_of_several_bodies_are_known_to_share():
    """Those that are closed. Not walls that face each other, nor balls of which few pairs can touch at once."""

    def cart(height):
        wheels = {"first": -1.0, "second": 0.0, "third": 1.0}
        bodies = [planar.Body("cart", mass=1.0, inertia=0.1, position=(0.0, height))]
        bodies += [planar.Body(k, mass=1.0, inertia=0.1, position=(x, height)) for k, x in wheels.items()]
        pins = [planar.Revolute(f"{k} pin", "cart", k, point=(x, height)) for k, x in wheels.items()]
        rolls = [mb.RigidContact(f"{k} rolls", k, terrain=mb.terrain.Flat(), radius=0.1) for k in wheels]
        return bodies, [*pins, *rolls]

    assert shares(*cart(0.1)) and not shares(*cart(0.2))
    ball = planar.PointMass("ball", mass=1.0)
    walls = [mb.RigidPlaneContact(f"wall {s}", "ground", "ball", normal=(s, 0), point_a=(-s, 0)) for s in (1, -1)]
    assert not shares([ball], walls)
    balls = [planar.PointMass(f"ball {k}", mass=1.0, position=(np.cos(k), np.sin(k))) for k in range(5)]
    pairs = [
        mb.RigidBallContact(f"{i} {k}", f"ball {i}", f"ball {k}", radius_a=0.1, radius_b=0.1)
        for i in range(5)
        for k in range(i)
    ]
    assert not shares(balls, pairs)


@pytest.mark.slow
def test_a_box_swings_on_four_ropes():
    """As a pendulum, since it does not turn: against its equation. At rest each rope has a quarter of the weight."""
    system = on_ropes()
    for speed in (0.0, 1.0):
        state = mb.assemble(system, rates={"box.velocity": (speed, 0.0, 0.0)})
        ts = np.linspace(0.0, 1.0, 6)
        motion = mb.simulate(system, state, t1=1.0, saveat=ts, rtol=1e-9, atol=1e-11)
        known = solve_ivp(
            lambda t, y: [y[1], -G * np.sin(y[0])], (0, 1), [0.0, speed], t_eval=ts, rtol=1e-11, atol=1e-12
        )
        angle, rate = known.y
        where = np.stack([np.sin(angle), 0 * angle, -0.1 - np.cos(angle)], axis=1)
        np.testing.assert_allclose(motion["box"].position, where, atol=1e-8)
        assert len(motion.events) == 0
        assert motion.undetermined_reactions == tuple(f"rope {k}" for k in range(4))
        pulls = np.stack([motion.reactions[f"rope {k}"].force for k in range(4)])
        along = np.stack([-np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
        total = 2.0 * (G * np.cos(angle) + rate**2)
        np.testing.assert_allclose(np.sum(pulls, axis=0), total[:, None] * along, atol=1e-6)
        sizes = np.einsum("kti,ti->kt", pulls, along)
        assert np.all(sizes > 0)
        # The shares of least norm are a plane over the corners.
        np.testing.assert_allclose(sizes[0] - sizes[1] - sizes[2] + sizes[3], 0.0, atol=1e-6)


def feet_problem(twist):
    """The influence of the forces on four feet of a box on each other, accelerations without them, and the velocities
    of the feet at a twist."""
    points = np.concatenate([CORNERS, np.full((4, 1), -0.1)], axis=1)
    row = lambda along, p: np.concatenate([along, np.cross(p, along)])
    z, x, y = np.eye(3)[[2, 0, 1]]
    rows = np.array([*(row(z, p) for p in points), *(row(d, p) for p in points for d in (x, y))])
    inverse = np.diag(1 / np.array([2.0, 2.0, 2.0, *np.diag(INERTIA)]))
    return rows @ inverse @ rows.T, rows @ np.array([0.0, 0.0, -G, 0.0, 0.0, 0.0]), rows @ twist


@functools.cache
def laws_of_feet():
    contact_of, pairs = tuple(np.repeat(np.arange(4), 2).tolist()), (0, 2, 4, 6)

    @jax.jit
    def found(W, b, slips):
        dry = Dry(contact_of, pairs, jnp.full(8, 0.3), slips, jnp.zeros(8))
        return frictional(W, b, dry, jnp.ones(12, bool))

    return found


def test_four_feet_at_rest_stick():
    """All of them, and none slips for rounding errors; as many laws have a force as are independent."""
    W, b, _ = feet_problem(np.zeros(6))
    answers = laws_of_feet()(jnp.asarray(W), jnp.asarray(b), jnp.zeros(8))
    assert answers.solvable and np.sum(answers.closed) == 3
    assert np.all(answers.sticks | answers.implied) and not np.any(answers.slips)
    # A push within the limits of all feet is held as well, and one beyond the sum of them is not.
    for push, sticks in ((0.5, True), (3.0, False)):
        answers = laws_of_feet()(jnp.asarray(W), jnp.asarray(b).at[4::2].add(push), jnp.zeros(8))
        assert answers.solvable and np.all(answers.sticks | answers.implied) == sticks


@functools.cache
def on_feet():
    box = spatial.Body("box", mass=2.0, inertia=INERTIA, position=(0.0, 0.0, 0.1))
    feet = [
        mb.RigidContact(f"foot {k}", "box", terrain=mb.terrain.Flat(), centre=(*xy, -0.1))
        for k, xy in enumerate(CORNERS)
    ]
    rubs = [mb.DryFriction(f"rub {k}", f"foot {k}", coefficient=0.3) for k in range(4)]
    return mb.Scene([box], joints=feet, forces=[DOWN, *rubs]).compile()


@pytest.mark.slow
def test_a_box_slides_on_four_feet():
    """To its stop, and at rest; sliding and spinning at once, its motion is undetermined."""
    system = on_feet()
    state = mb.assemble(system)
    at = lambda speed, spin: dataclasses.replace(state, u=state.u.at[0].set(speed).at[5].set(spin))
    stays = mb.simulate(system, at(0.0, 0.0), t1=0.2)
    assert len(stays.events) == 0
    assert {event.kind for event in stays.events.at_start} == {"closed at start", "stick at start"}
    slides = mb.simulate(system, at(0.5, 0.0), t1=0.2)
    np.testing.assert_allclose(slides["box"].position[-1, 0], 0.5**2 / (2 * 0.3 * G), rtol=1e-8)
    assert slides.undetermined_reactions == tuple(f"foot {k}" for k in range(4))
    turns = mb.simulate(system, at(0.0, 1.0), t1=0.1, rtol=1e-6)
    # The moment of friction about the centre is the same for all shares.
    np.testing.assert_allclose(turns.events.times, [0.05 / (0.3 * 2.0 * G * np.hypot(0.3, 0.2))], rtol=1e-8)
    assert [event.kind for event in turns.events] == ["stick"] * 4
    with pytest.raises(RuntimeError, match="motion is undetermined") as caught:
        mb.simulate(system, at(0.5, 1.0), t1=0.2)
    assert "'foot 0'" in str(caught.value) and "'rub 3'" in str(caught.value)


@pytest.mark.slow
def test_a_box_turns_in_place_to_its_stop():
    """`I ω̇ = −μ m g r` at all tolerances and final times, and rest afterwards. The stop has no impulse and no energy.
    The angle at the stop has its derivatives by the coefficient and the speed, in both modes.
    """
    system, state = on_feet(), mb.assemble(on_feet())
    coefficients = [f"rub {k}.coefficient" for k in range(4)]
    slowing = lambda mu: mu * 2.0 * G * np.hypot(0.3, 0.2) / INERTIA[2, 2]

    def turned(mu, spin, t1, rtol):
        start = dataclasses.replace(state, u=state.u.at[5].set(spin))
        motion = mb.simulate(mb.with_parameters(system, dict.fromkeys(coefficients, mu)), start, t1=t1, rtol=rtol)
        attitude = motion["box"].orientation[-1]
        return 2 * jnp.arctan2(attitude[3], attitude[0]), motion

    cases = [(1.0, 0.05, 1e-4), (1.0, 0.1, 1e-7), (1.0, 0.1, 1e-8), (1.0, 1.0, 1e-10)]
    for spin, t1, rtol in [*cases, (0.37, 0.1, 1e-6), (0.37, 0.0713, 1e-8), (-0.37, 0.05, 1e-9)]:
        angle, motion = turned(0.3, spin, t1, rtol)
        stop = abs(spin) / slowing(0.3)
        np.testing.assert_allclose(angle, spin * stop / 2, rtol=10 * rtol)
        np.testing.assert_allclose(motion.events.times[-1], stop, rtol=10 * rtol)
        np.testing.assert_allclose(motion.ys.u[-1], 0.0, atol=1e-15)
        ends = [event for event in motion.events if event.time == motion.events.times[-1]]
        assert [event.kind for event in ends] == ["stick"] * 4
        assert all(event.impulse == event.kinetic_energy_lost == 0 for event in ends)
    at_stop = lambda x: turned(*x, 0.06, 1e-9)[0]
    known = 1 / (2 * slowing(0.3))
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(mode(at_stop))(jnp.array([0.3, 1.0])), [-known / 0.3, 2 * known], rtol=1e-6)


@pytest.mark.slow
def test_a_box_on_three_feet_slides_and_turns_to_its_stop():
    """Slip and spin vanish together; against the equations of the plane, with loads by statics."""
    points = 0.3 * np.stack([np.cos(2 * np.pi * np.arange(3) / 3), np.sin(2 * np.pi * np.arange(3) / 3)], axis=1)
    box = spatial.Body("box", mass=2.0, inertia=INERTIA, position=(0.0, 0.0, 0.1))
    feet = [
        mb.RigidContact(f"foot {k}", "box", terrain=mb.terrain.Flat(), centre=(*xy, -0.1))
        for k, xy in enumerate(points)
    ]
    rubs = [mb.DryFriction(f"rub {k}", f"foot {k}", coefficient=0.3) for k in range(3)]
    system = mb.Scene([box], joints=feet, forces=[DOWN, *rubs]).compile()
    start = mb.assemble(system)
    start = dataclasses.replace(start, u=start.u.at[0].set(0.2).at[5].set(1.0))

    def rates(t, y):
        (c, s), v, spin = (np.cos(y[2]), np.sin(y[2])), y[3:5], y[5]
        arms = points @ np.array([[c, s], [-s, c]])
        slip = v + spin * np.stack([-arms[:, 1], arms[:, 0]], axis=1)
        against = -0.3 * slip / np.linalg.norm(slip, axis=1, keepdims=True)
        # The weight, and no moment about the horizontal axes through the mass centre.
        balance = [np.ones(3), arms[:, 1] + 0.1 * against[:, 1], arms[:, 0] + 0.1 * against[:, 0]]
        forces = np.linalg.solve(balance, [2.0 * G, 0.0, 0.0])[:, None] * against
        moment = np.sum(arms[:, 0] * forces[:, 1] - arms[:, 1] * forces[:, 0])
        return np.concatenate([y[3:], np.sum(forces, axis=0) / 2.0, [moment / INERTIA[2, 2]]])

    nearly = lambda t, y: np.linalg.norm([*y[3:5], 0.3 * y[5]]) - 1e-6
    nearly.terminal = True
    known = solve_ivp(rates, (0, 1), [0.0, 0.0, 0.0, 0.2, 0.0, 1.0], rtol=1e-11, atol=1e-13, events=nearly)
    assert known.status == 1
    for rtol in (1e-5, 1e-8):
        motion = mb.simulate(system, start, t1=0.3, rtol=rtol)
        attitude = np.asarray(motion["box"].orientation[-1])
        pose = [*motion["box"].position[-1, :2], 2 * np.arctan2(attitude[3], attitude[0])]
        np.testing.assert_allclose(pose, known.y[:3, -1], atol=10 * rtol)
        np.testing.assert_allclose(motion.events.times[-1], known.t[-1], atol=1e-5)
        np.testing.assert_allclose(motion.ys.u[-1], 0.0, atol=1e-15)


@pytest.mark.slow
def test_the_time_at_which_a_box_tips_over_the_last_of_three_feet():
    """A growing force beyond the feet: they share the load until its centre is above the last foot. The time at which
    the others part has its derivative, in both modes and in a batch.
    """
    box = planar.Body("box", mass=2.0, inertia=0.1, position=(0.0, 0.1))
    feet = [
        mb.RigidContact(f"foot {k}", "box", terrain=mb.terrain.Flat(), centre=(x, -0.1))
        for k, x in enumerate((-0.3, 0.0, 0.3))
    ]
    push = planar.PointForce("push", "box", force=(0.0, 0.0), point=(0.5, 0.0))
    system = mb.Scene([box], joints=feet, forces=[mb.Gravity((0.0, -G)), push]).compile()
    assert isinstance(system.contacts.sharing, Sharing)
    start = mb.assemble(system)

    def begins(rate):
        force = mb.Series(jnp.array([0.0, 1.0]), rate * jnp.array([[0.0, 0.0], [0.0, -1.0]]), "linear")
        motion = mb.simulate(system, start, t1=1.0, inputs={"push.force": force}, rtol=1e-10)
        return motion.events.times[0]

    # The moment about the last foot is zero when 0.2 m of the force balance 0.3 m of the weight.
    known, rate = lambda rate: 1.5 * 2.0 * G / rate, 60.0
    np.testing.assert_allclose(begins(rate), known(rate), rtol=1e-8)
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(mode(begins))(rate), -known(rate) / rate, rtol=1e-6)
    rates = jnp.array([60.0, 50.0])
    np.testing.assert_allclose(jax.vmap(begins)(rates), known(rates), rtol=1e-8)
