"""Contacts and friction that share a moment, and act on each other or not."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly

import jaxmb as mb
from jaxmb import planar
from jaxmb.contacts.groups import HOLDS
from jaxmb.contacts.impact import impact
from jaxmb.contacts.impacting import find_event
from jaxmb.contacts.tolerance import ContactTolerance
from jaxmb.parts import terrain

G, FLAT = 9.81, terrain.Flat()
DOWN, METHOD = mb.Gravity((0.0, -G)), mb.formulations.Multipliers()
TOLERANCE = ContactTolerance(jnp.asarray(1e-10))


def floor(body, **options):
    return mb.RigidContact(f"floor of {body}", body, terrain=FLAT, **options)


def placed(system, places=None, rates=None, modes=None):
    """A state with some coordinates, rates and modes by name, the others as drawn and at rest."""
    at, of_rates, q, u = system.coordinate_names(), system.rate_names(), system.guess.q, jnp.zeros(system.nu)
    q = system.contacts.with_modes(q, 0.0)
    for name, value in (places or {}).items():
        q = q.at[np.array(at[name])].set(value)
    for name, value in (rates or {}).items():
        u = u.at[np.array(of_rates[name])].set(value)
    for name, value in (modes or {}).items():
        q = q.at[system.contacts.places[system.contacts.names.index(name)]].set(value)
    return mb.State(q, u)


def finder(system):
    """The event at a state, as a compiled function of places, rates and modes by name."""
    find = jit_quickly(lambda state: find_event(system, METHOD, TOLERANCE, jnp.zeros(()), state))
    return lambda **at: find(placed(system, **at))


def test_balls_that_strike_together_have_their_own_times():
    """Each has the saltation matrix of its own impact, and the derivative of its own energy."""
    bounces, masses, speeds = {"a": 0.5, "b": 0.8}, {"a": 1.0, "b": 2.0}, {"a": 3.0, "b": 2.0}
    balls = [planar.PointMass(n, mass=masses[n], position=(k, 0.0)) for k, n in enumerate("ab")]
    system = mb.Scene(balls, joints=[floor(n, restitution=bounces[n]) for n in "ab"], forces=[DOWN]).compile()
    names, rates = system.coordinate_names(), system.rate_names()
    here = [names[f"{n}.y"][0] for n in "ab"], [rates[f"{n}.y_rate"][0] for n in "ab"]
    start = placed(system)

    @jit_quickly
    @functools.partial(jax.jacfwd, has_aux=True)
    def after(at):
        state = mb.State(start.q.at[np.array(here[0])].set(at[:2]), start.u.at[np.array(here[1])].set(at[2:]))
        out = impact(system, METHOD, TOLERANCE, jnp.zeros(()), state)
        values = out.after.q[np.array(here[0])], out.after.u[np.array(here[1])], out.impulses, out.energy[None]
        return jnp.concatenate(values), out.energy

    jacobian, energy = after(jnp.array([0.0, 0.0, -speeds["a"], -speeds["b"]]))
    expected = np.zeros((7, 4))
    for k, n in enumerate("ab"):
        e, v, m = bounces[n], -speeds[n], masses[n]
        expected[np.ix_([k, 2 + k], [k, 2 + k])] = [[-e, 0.0], [-(1 + e) * G / v, -e]]
        # The speed at the ground changes with the height, by gravity.
        by_speed = np.array([G / v, 1.0])
        expected[4 + k, [k, 2 + k]] = -m * (1 + e) * by_speed
        expected[6, [k, 2 + k]] = m * v * (1 - e**2) * by_speed
    np.testing.assert_allclose(jacobian, expected, atol=1e-9)
    np.testing.assert_allclose(energy, sum(0.5 * masses[n] * speeds[n] ** 2 * (1 - bounces[n] ** 2) for n in "ab"))


@pytest.mark.slow
def test_each_group_has_its_own_energy_balance():
    """A rod whose rebound by Newton's law would gain energy, beside a ball, at one moment."""
    reach, inertia = (-0.636, -1.331), 0.0675
    rod = planar.Body("rod", mass=1.0, inertia=inertia, position=(0.0, -reach[1]))
    ball = planar.PointMass("ball", mass=1.0, position=(5.0, 0.0))
    contacts = [floor("rod", centre=reach, restitution=0.99), floor("ball", restitution=1.0)]
    rub = mb.DryFriction("rub", "floor of rod", coefficient=0.6)
    whole = mb.Scene([rod, ball], joints=contacts, forces=[rub]).compile()
    fall = {"rod.x_rate": 1.8, "rod.y_rate": -1.0, "ball.y_rate": -1.0}
    at = placed(whole, rates=fall)

    @jit_quickly
    def struck(restitution):
        system = mb.with_parameters(whole, {"floor of ball.restitution": restitution})
        return find_event(system, METHOD, TOLERANCE, jnp.zeros(()), at)

    of = {name: np.array(where) for name, where in whole.rate_names().items()}
    for restitution in (1.0, 0.2):
        out = struck(restitution)
        np.testing.assert_array_equal(out.balance, [0, 1, 0])
        np.testing.assert_allclose(out.u[of["ball.y_rate"]], restitution, rtol=1e-12)
        rod_after = np.asarray(out.u[np.concatenate([of["rod.velocity"], of["rod.angle_rate"]])])
        energy = 0.5 * rod_after @ np.diag([1.0, 1.0, inertia]) @ rod_after
        np.testing.assert_allclose(energy, 0.5 * (1.8**2 + 1.0), rtol=1e-9)
        np.testing.assert_allclose(out.share[0], out.share[2])
        assert out.share[0] < 0.9 and out.share[1] == 1.0


@pytest.mark.slow
def test_a_body_that_lies_on_the_ground_separates_what_strikes_it():
    """Balls on a heavy block at rest on two corners do not see each other; on a block that falls they do."""
    block = planar.Body("block", mass=5.0, inertia=1.0, position=(0.0, 0.5))
    balls = [planar.PointMass(n, mass=1.0, position=(x, 1.0)) for n, x in (("a", -0.3), ("b", 0.4))]
    corners = [
        mb.RigidContact(n, "block", terrain=FLAT, centre=at) for n, at in (("left", (-1, -0.5)), ("right", (1, -0.5)))
    ]
    tops = [
        mb.RigidPlaneContact(
            f"top of {n}", "block", n, point_a=(0.0, 0.5), point_b=(0.0, 0.0), normal=(0.0, 1.0), restitution=0.5
        )
        for n in "ab"
    ]
    system = mb.Scene([block, *balls], joints=[*corners, *tops], forces=[DOWN]).compile()
    fall = {"a.y_rate": -1.0, "b.y_rate": -2.0}
    closed = {"left": 1.0, "right": 1.0}
    event = finder(system)
    np.testing.assert_array_equal(event(rates=fall, modes=closed).group, [HOLDS, HOLDS, 2, 3])
    lifted = {"block.y": 1.5, "a.y": 2.0, "b.y": 2.0}
    np.testing.assert_array_equal(event(places=lifted, rates=fall).group, [0, 1, 2, 2])

    # Each ball has its own saltation matrix, as on the ground.
    names, rates = system.coordinate_names(), system.rate_names()
    heights = np.array([names[f"{n}.y"][0] for n in "ab"])
    speeds = np.array([rates[f"{n}.y_rate"][0] for n in "ab"])
    start = placed(system, rates=fall, modes=closed)

    @jit_quickly
    @jax.jacfwd
    def after(at):
        state = mb.State(start.q.at[heights].set(at[:2]), start.u.at[speeds].set(at[2:]))
        out = impact(system, METHOD, TOLERANCE, jnp.zeros(()), state)
        return jnp.concatenate([out.after.q[heights], out.after.u[speeds], out.impulses])

    jacobian, e = after(jnp.array([1.0, 1.0, -1.0, -2.0])), 0.5
    expected = np.zeros((8, 4))
    for k, (v, x) in enumerate(((-1.0, -0.3), (-2.0, 0.4))):
        expected[np.ix_([k, 2 + k], [k, 2 + k])] = [[-e, 0.0], [-(1 + e) * G / v, -e]]
        impulse = -(1 + e) * np.array([G / v, 1.0])
        for row, share in ((4, (1 - x) / 2), (5, (1 + x) / 2), (6 + k, 1.0)):
            expected[row, [k, 2 + k]] += share * impulse
    np.testing.assert_allclose(jacobian, expected, atol=1e-8)


@pytest.mark.slow
def test_boxes_that_turn_back_together():
    """The slips of both end at one moment, each at its own time, and friction then acts the other way."""
    coefficients, pull = (0.2, 0.5), 8.0
    boxes = [planar.Body(n, mass=m, inertia=1.0, position=(0.0, 0.0)) for n, m in (("a", 1.0), ("b", 3.0))]
    rails = [planar.Prismatic(f"rail {n}", "ground", n, point=(0.0, 0.0), axis=(1.0, 0.0)) for n in "ab"]
    rubs = [mb.DryFriction(f"rub {n}", f"rail {n}", coefficient=c) for n, c in zip("ab", coefficients, strict=True)]
    system = mb.Scene(boxes, joints=rails, forces=[mb.Gravity((-pull, -G)), *rubs]).compile()
    rates = np.array([system.rate_names()[f"{n}.x_rate"][0] for n in "ab"])
    start = placed(system, modes={"rub a": 1.0, "rub b": 1.0})

    @jit_quickly
    @functools.partial(jax.jacfwd, has_aux=True)
    def after(u):
        state = mb.State(start.q, start.u.at[rates].set(u))
        out = impact(system, METHOD, TOLERANCE, jnp.zeros(()), state)
        return out.after.u[rates], out.modes[1]

    jacobian, modes = after(jnp.array([1e-14, 2e-14]))
    np.testing.assert_array_equal(modes, [-1.0, -1.0])
    expected = [(pull - c * G) / (pull + c * G) for c in coefficients]
    np.testing.assert_allclose(jacobian, np.diag(expected), atol=1e-9)


@pytest.mark.slow
def test_groups_of_contacts_of_one_body():
    """A particle in a corner strikes both walls on its own; a disc that rubs on both does not."""
    walls = lambda r: [
        mb.RigidPlaneContact(n, "ground", "p", point_a=(0.0, 0.0), point_b=(0.0, 0.0), normal=at, radius=r)
        for n, at in (("floor", (0.0, 1.0)), ("wall", (1.0, 0.0)))
    ]
    disc = [planar.Body("p", mass=1.0, inertia=0.02, position=(0.2, 0.2))]
    rubs = [mb.DryFriction(f"rub {n}", n, coefficient=0.3) for n in ("floor", "wall")]
    rates = {"p.velocity": jnp.array([-1.0, -2.0])}
    smooth = mb.Scene(disc, joints=walls(0.2), forces=[DOWN]).compile()
    np.testing.assert_array_equal(finder(smooth)(rates=rates).group, [0, 1])
    rough = mb.Scene(disc, joints=walls(0.2), forces=[DOWN, *rubs]).compile()
    np.testing.assert_array_equal(finder(rough)(rates=rates).group, [0, 0, 0, 0])
