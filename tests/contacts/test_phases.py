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
    """Whose slip ends, or goes on; also where two rebounds by Newton's law would gain energy."""
    disc = planar.Body("disc", mass=1.5, inertia=0.01, position=(0.0, RADIUS))
    floor = mb.RigidContact("floor", "disc", terrain=terrain.Flat(), radius=RADIUS, restitution=0.4, impact_law=law)
    other = mb.RigidContact("other", "disc", terrain=terrain.Flat(), radius=RADIUS, restitution=0.2)
    rub = mb.DryFriction("rub", "floor", coefficient=0.2)
    system = mb.Scene([disc], joints=[floor, other], forces=[rub, mb.Gravity((0.0, -9.81))]).compile()
    t, start, method = jnp.zeros(()), system.guess.q, mb.formulations.Multipliers()
    tolerance = ContactTolerance(jnp.asarray(1e-9))

    @jax.jit
    def struck(values, height, u, du):
        """The impulses of an event and the velocities after it, their changes, and the share of the rebound."""
        changed = mb.with_parameters(system, values)
        q = start.at[1].set(height)
        event = find_event(changed, method, tolerance, t, mb.State(q, u))
        still = jax.tree.map(jnp.zeros_like, eqx.filter((changed, t, q), eqx.is_inexact_array))
        frame = MovingFrame.of((changed, t, q), still)
        return (event.impulses, event.u), Phases.of(event, (changed, t, q), still, du, frame).changes(), event.share

    names = "floor.centre", "other.centre", "floor.restitution", "rub.coefficient", "disc.inertia"
    plain = dict(zip(names, (np.zeros(2), np.array([0.0, 9.0]), 0.4, 0.2, 0.01), strict=True))
    feet = np.array([[-0.636, RADIUS - 1.331], [0.3, RADIUS - 1.331]])
    gains = dict(zip(names, (*feet, 0.99, 0.6, 0.10125), strict=True))
    cases = [(plain, [1.0, -2.0, spin], True) for spin in (0.0, -40.0)]
    # Both feet rebound, by different coefficients, as much as energy allows.
    cases += [(gains, [0.5, -1.0, 0.0], False)] * (law == "newton")
    h = 1e-6
    for values, velocities, whole in cases:
        height = RADIUS - values["floor.centre"][1]
        u = np.append(velocities, np.zeros(system.nu - 3))
        for du in np.eye(u.size)[:3]:
            ahead, back = (struck(values, height, u + step * du, du)[0] for step in (h, -h))
            _, changes, share = struck(values, height, u, du)
            assert np.all(share == 1) == whole
            for change, after, before in zip(changes, ahead, back, strict=True):
                np.testing.assert_allclose(change, np.subtract(after, before) / (2 * h), atol=1e-7)
