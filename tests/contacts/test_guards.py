"""The guards of contacts: smooth functions of the state that are zero where an event is."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxmb as mb
from jaxmb import planar
from jaxmb.contacts.guards import contact_guards
from jaxmb.contacts.tolerance import ContactTolerance


def test_guard_of_a_mass_between_two_stops_is_smooth_in_the_middle():
    """It is (p² − x²) / 2p, of the place x beside the middle and half the way p, and its rate is −x v / p."""
    half, speed = 0.5, 3.0
    mass = planar.Body("mass", mass=1.0, inertia=1.0)
    rail = planar.Prismatic("rail", "ground", "mass", axis=(1.0, 0.0), point=(0.0, 0.0))
    ends = mb.Stop("ends", "rail.displacement", lower=-half, upper=half)
    system = mb.Scene([mass], joints=[rail, ends]).compile()
    guards = contact_guards(system, mb.formulations.Multipliers(), ContactTolerance(jnp.asarray(1e-9)))
    places, u = np.array([-0.4, -0.1, 0.1, 0.3]), system.guess.u.at[0].set(speed)
    seen = jax.jit(jax.vmap(lambda x: guards.seen(0.0, mb.State(system.guess.q.at[0].set(x), u))))(places)
    expected = (half**2 - places**2) / (2 * half)
    np.testing.assert_allclose(seen.values[:, 0] * system.length, expected, rtol=1e-12)
    np.testing.assert_allclose(seen.rates[:, 0] * system.length, -places * speed / half, rtol=1e-12)
