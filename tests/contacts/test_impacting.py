"""The pieces of an event: when it is, what an impact leaves, what bounces too low to be seen, the share of rebounds."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar
from jaxmb.contacts.impacting import Impacting, Trial, next_trial
from jaxmb.contacts.tolerance import ContactTolerance
from jaxmb.parts import terrain
from jaxmb.solvers.events import Bracket
from jaxmb.system.instant import Instant

G, TOUCH = 10.0, 1e-6


@functools.cache
def ball(coefficient=0.0):
    body = planar.Body("ball", mass=2.0, inertia=0.3, position=(0.0, 0.5))
    floor = mb.RigidContact("floor", "ball", terrain=terrain.Flat(), restitution=0.5)
    rubs = [mb.DryFriction("rub", "floor", coefficient=coefficient)] if coefficient else []
    return mb.Scene([body], joints=[floor], forces=[mb.Gravity((0.0, -G)), *rubs]).compile()


def impacting(system, height, rise, along=0.0, modes=0.0):
    """An event of a point at a height, that rises and moves along the ground."""
    q = system.contacts.with_modes(system.guess.q, modes).at[1].set(height)
    u = jnp.zeros(system.nu).at[:2].set(jnp.array([along, rise]))
    tolerance = ContactTolerance(jnp.asarray(TOUCH))
    return Impacting.of(Instant(system, jnp.zeros(()), q, u), mb.formulations.Multipliers(), tolerance)


@functools.cache
def pieces():
    """When a ball strikes, and whether its next bounce is too low to be seen, by its height and its velocity upwards:
    one program.
    """

    system = ball()

    @jax.jit
    def found(height, rise):
        event = impacting(system, height, rise)
        udot, curve, _ = event.accelerated(event.at.u)
        start = event.start()
        struck = start.struck._replace(rate=jnp.array([-0.5]) * rise)
        at = start._replace(when=start.when._replace(touching=jnp.array([True])), struck=struck)
        when = event.at_event(udot, curve)
        return when, event.low_bounces(at, jnp.array([-G]), True), event.closing(when)

    return found


def test_time_of_an_event_is_that_of_a_parabola():
    """A gap that is far does not close here, and one that opens does not bounce."""
    height = 50 * TOUCH
    for rise, hits in ((-1.0, True), (1.0, False)):
        when, _, closing = pieces()(height, rise)
        late = (rise + np.sqrt(rise**2 + 2 * G * height)) / G if hits else 0.0
        assert when.hits == hits and when.touching == hits
        np.testing.assert_allclose(when.late, late, rtol=1e-12)
        np.testing.assert_allclose(when.at, rise - G * late, rtol=1e-12)
        np.testing.assert_allclose(closing, G * late - rise if hits else 0.0, rtol=1e-12)
    assert not pieces()(200 * TOUCH, -1.0)[0].hits


def test_low_bounces_and_how_long_they_take():
    """Of those that would rise to less than a thousand times the gap that counts as zero."""
    for speed in (1e-3, 1.0):
        low, rest = pieces()(0.0, -speed)[1]
        assert low == ((0.5 * speed) ** 2 / (2 * G) <= 1e3 * TOUCH) == (speed < 0.1)
        # Each bounce takes half of the time of the one before.
        np.testing.assert_allclose(rest, 2 * (2 * 0.5 * speed / G) if low else 0.0, rtol=1e-12)


@pytest.mark.slow
def test_an_impact_opens_the_gap_at_its_share_of_the_rebound():
    event = impacting(ball(), 0.0, -2.0)
    start = event.start()
    begun = event.begin(1, start._replace(struck=start.struck._replace(udot=event.at.u)), None, jnp.zeros(1))
    assert begun.when.touching
    for share in (1.0, 0.4):
        problem = event.impulse_of(begun.when, start.low, share, None)
        impulses = event.laws.solved(problem, event.laws.answers(problem))
        struck = event.strike(event.turns, begun, event.laws.answers(problem), impulses).struck
        np.testing.assert_allclose(impulses, 2.0 * 2.0 * (1 + 0.5 * share), rtol=1e-12)
        np.testing.assert_allclose(struck.rate, 0.5 * share * 2.0, rtol=1e-12)
        np.testing.assert_allclose(struck.gained[0], impulses * (struck.rate - 2.0), rtol=1e-12)
        assert not struck.resting[0]


@pytest.mark.slow
def test_slip_that_is_not_to_be_seen_has_ended():
    event = impacting(ball(coefficient=0.2), 0.0, -1.0, along=1.0, modes=jnp.array([0.0, 1.0]))
    ended, slips = jax.vmap(event.slips_left, (0, None))(jnp.array([[1.0], [-1.0], [10 * TOUCH]]), jnp.ones(1))
    np.testing.assert_array_equal(ended[:, 0], [False, False, True])
    np.testing.assert_array_equal(slips[:, 0], [1, -1, 0])


@pytest.mark.slow
def test_the_share_of_the_rebounds_is_found_by_trials():
    """That at which no energy is gained, of a gain that is a parabola; a gain that is none needs no trial."""
    one, zero = jnp.ones(()), jnp.zeros(())
    trial = Trial(one, Bracket(zero, one, zero, one, jnp.array(0)), jnp.array(False))
    gain = lambda share: share**2 + share - 0.75
    for k in range(40):
        trial = next_trial(trial, gain(trial.share), one, jnp.array(k))
        if not trial.again:
            break
    np.testing.assert_allclose(trial.share, 0.5, atol=1e-11)
    assert not next_trial(trial._replace(share=one), -one, one, jnp.array(0)).again
