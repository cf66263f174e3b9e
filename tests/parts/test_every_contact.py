"""Every unilateral constraint by itself: its gap, the derivatives of it, its force, its numbers, its words."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from every_contact import CONTACTS, system_of

import jaxmb as mb
from jaxmb.formulations import Multipliers, accelerations
from jaxmb.parts.modes import CLOSED, OPEN
from jaxmb.parts.planar.kinematics import PLANE
from jaxmb.system.instant import Instant


@pytest.mark.slow(but=("a contact of a user",))
@pytest.mark.parametrize("name", CONTACTS)
def test_gap_and_its_derivatives(name):
    """Rates and second derivatives are those of the gap along a motion; the row of a closed contact is its gradient."""
    system = system_of(name)
    state = mb.assemble(system)
    t, q, u = jnp.zeros(()), state.q, state.u
    of = system.contacts
    gap = of.gaps(system, t, q)
    assert gap.shape == (1,) and gap[0] > 0 and of.names == of.contact_names == ("c",)

    @jax.jit
    def ahead(s):
        q_s = Instant(system, t, q, u).moved(s * u).q
        return of.gaps(system, t, q_s)[0], of.rates(system, t, q_s, u)[0]

    h = 1e-5
    slope = [(a - b) / (2 * h) for a, b in zip(ahead(h), ahead(-h), strict=True)]
    np.testing.assert_allclose(of.rates(system, t, q, u)[0], slope[0], rtol=1e-7, atol=1e-9)
    none = jnp.zeros_like(u)
    np.testing.assert_allclose(of.accelerations(system, t, q, u, none)[0], slope[1], rtol=1e-6, atol=1e-8)
    gradient = of.gradients(system, t, q, u)
    np.testing.assert_allclose(gradient @ u, of.rates(system, t, q, u), rtol=1e-12, atol=1e-15)
    closed = of.with_modes(q, CLOSED)
    rows = system.jacobian(t, closed, u)[np.array(of.rows)]
    np.testing.assert_allclose(rows, gradient, rtol=1e-12, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Stop in the plane", "RigidContact in space", "RigidBallContact"])
def test_an_open_contact_does_nothing_and_a_closed_one_pushes_or_pulls(name):
    system = system_of(name)
    state = mb.assemble(system)
    # Balls that fall side by side would neither push nor pull.
    t, u = jnp.zeros(()), jnp.linspace(0.5, -0.7, state.u.size)
    of = system.contacts
    at = lambda mode: accelerations(system, Multipliers(), t, of.with_modes(state.q, mode), u)
    (free, none), (held, forces) = at(OPEN), at(CLOSED)
    (row,) = of.rows
    assert none[row] == 0
    left = of.accelerations(system, t, state.q, u, held)
    np.testing.assert_allclose(left, 0.0, atol=1e-12)
    assert abs(forces[row]) > 1e-3
    assert (forces[row] > 0) == (of.accelerations(system, t, state.q, u, free)[0] < 0)


@pytest.mark.parametrize("name", CONTACTS)
def test_words_and_numbers(name):
    system = system_of(name)
    text = str(system.describe())
    assert "contacts" in text and "where closed 1 row each" in text
    assert "c.mode" in system.coordinate_names() and "c.restitution" in mb.parameters(system)
    assert mb.with_parameters(system, {"c.restitution": 0.5}).contact_numbers(0.0).restitution == 0.5


def test_one_of_two_balls_may_be_a_point():
    bodies = [mb.planar.PointMass("a", mass=1.0), mb.planar.PointMass("b", mass=1.0, position=(1.0, 0.0))]
    meet = lambda radius: mb.RigidBallContact("meet", "a", "b", radius_a=0.0, radius_b=radius)
    mb.Scene(bodies, joints=[meet(0.1)]).compile()
    with pytest.raises(ValueError, match="'meet': only one of radius_a and radius_b may be zero; give the other"):
        mb.Scene(bodies, joints=[meet(0.0)]).compile()


def test_the_gap_of_a_taut_rope_is_the_length_that_it_lacks():
    rope = mb.Slack("rope", "ground", "a", length=2.0)
    at = lambda distance: jnp.array([[0.0, 0.0, 0.0], [0.6 * distance, -0.8 * distance, 0.0]])
    part = rope.resolve(PLANE, at(2.0))
    gap, rate = jax.value_and_grad(lambda distance: part.gap(PLANE, at(distance)))(2.0)
    np.testing.assert_allclose([gap, rate, part.gap(PLANE, at(1.2))], [0.0, -1.0, 0.64], atol=1e-15)
