"""The equations of the phases of an impact: their solution is the change of the impulses with the velocities."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar
from jaxmb.contacts.impacting import find_event
from jaxmb.contacts.phases import MovingFrame, Phases
from jaxmb.contacts.tolerance import ContactTolerance
from jaxmb.parts import terrain

RADIUS = 0.1


@pytest.mark.slow("poisson")
@pytest.mark.parametrize("law", ["newton", "poisson"])
def test_changes_are_those_of_another_impact(law):
    """Whose slip ends, or goes on."""
    disc = planar.Body("disc", mass=1.5, inertia=0.01, position=(0.0, RADIUS))
    floor = mb.RigidContact("floor", "disc", terrain=terrain.Flat(), radius=RADIUS, restitution=0.4, impact_law=law)
    rub = mb.DryFriction("rub", "floor", coefficient=0.2)
    system = mb.Scene([disc], joints=[floor], forces=[rub, mb.Gravity((0.0, -9.81))]).compile()
    t, q, method = jnp.zeros(()), system.guess.q, mb.formulations.Multipliers()
    tolerance = ContactTolerance(jnp.asarray(1e-9))

    @jax.jit
    def struck(u, du):
        """The impulses of an event and the velocities after it, and their changes."""
        event = find_event(system, method, tolerance, t, mb.State(q, u))
        still = jax.tree.map(jnp.zeros_like, eqx.filter((system, t, q), eqx.is_inexact_array))
        at, still = (system, t, q), tuple(still)
        return (event.impulses, event.u), Phases.of(event, at, still, du, MovingFrame.of(at, still)).changes()

    h = 1e-6
    for spin in (0.0, -40.0):
        u = np.append([1.0, -2.0, spin], np.zeros(system.nu - 3))
        for du in np.eye(u.size)[:3]:
            ahead, back = struck(u + h * du, du)[0], struck(u - h * du, du)[0]
            for change, after, before in zip(struck(u, du)[1], ahead, back, strict=True):
                np.testing.assert_allclose(change, np.subtract(after, before) / (2 * h), atol=1e-7)
