"""The state after an event, at the time at which it was asked for, and the time of the event."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly

import jaxmb as mb
from jaxmb import planar
from jaxmb.contacts.impact import impact
from jaxmb.contacts.tolerance import ContactTolerance
from jaxmb.parts import terrain
from jaxmb.parts.modes import CLOSED, OPEN

MASS, G, RESTITUTION, LIFT, RATE = 2.0, 10.0, 0.5, 3.0, 7.0


@pytest.fixture(scope="module")
def struck():
    """An impact of a ball that is lifted by a force LIFT t, with a controller that adds up RATE times its speed."""
    ball = planar.Body("ball", mass=MASS, inertia=0.1)
    rail = planar.Prismatic("rail", "ground", "ball", point=(0.0, 0.0), axis=(0.0, 1.0))
    floor = mb.RigidContact("floor", "ball", terrain=terrain.Flat(), restitution=RESTITUTION)
    sums = lambda t, measured, states, p: (0.0, {"sum": RATE * measured["speed"]})
    watcher = mb.Controller(
        "watcher", sums, {"speed": "rail.displacement_rate"}, "rail.displacement", states={"sum": 0.0}
    )
    lift = mb.Force("lift", "ball", lambda x, v, t, p: jnp.array([0.0, LIFT * t, 0.0]))
    system = mb.Scene([ball], joints=[rail, floor], forces=[mb.Gravity((0.0, -G)), lift, watcher]).compile()

    @jit_quickly
    def at(t, mode, height, rise, z):
        q = system.contacts.with_modes(system.guess.q, mode).at[1].set(height)
        u = jnp.zeros(system.nu).at[1].set(rise)
        z = jax.tree.map(lambda x: x + z, system.guess.z)

        def event(mass):
            changed = mb.with_parameters(system, {"ball.mass": mass}).with_states(z)
            tolerance = ContactTolerance(jnp.asarray(1e-6))
            return impact(changed, mb.formulations.Multipliers(), tolerance, t, mb.State(q, u, z), True)

        out = event(jnp.asarray(MASS))
        return out, jax.jacfwd(lambda mass: event(mass).late)(jnp.asarray(MASS))

    return at


def test_impact_that_is_soon_leaves_the_state_as_if_it_had_been(struck):
    """The ball is where it would have come from, at its new speed; so is what the controller adds up."""
    height, speed = 2e-5, 3.0
    out, _ = struck(0.0, OPEN, height, -speed, 0.25)
    late = (np.sqrt(speed**2 + 2 * G * height) - speed) / G
    after = RESTITUTION * (speed + G * late)
    np.testing.assert_allclose(out.late, late, rtol=1e-9)
    np.testing.assert_allclose(out.impulses, MASS * (1 + RESTITUTION) * (speed + G * late), rtol=1e-9)
    # Back in time at the new speed, which is larger then.
    np.testing.assert_allclose(out.after.q[1], -after * late - 0.5 * G * late**2, rtol=1e-7)
    np.testing.assert_allclose(out.after.u[1], after + G * late, rtol=1e-9)
    (found,) = jax.tree.leaves(out.after.z)
    np.testing.assert_allclose(found, 0.25 + RATE * late * (-(speed + G * late) - after), rtol=1e-12)


def test_impact_of_a_ball_that_is_lifted_has_the_time_at_which_its_weight_is(struck):
    """LIFT t = MASS G; a heavier ball opens later."""
    out, by_mass = struck(MASS * G / LIFT, CLOSED, 0.0, 0.0, 0.0)
    assert out.modes[1] == OPEN and np.abs(out.late) < 1e-12
    np.testing.assert_allclose(by_mass, G / LIFT, rtol=1e-9)
