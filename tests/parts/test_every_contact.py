"""Every unilateral constraint by itself: its gap, the derivatives of it, its force, its numbers, its words."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from every_contact import CONTACTS, system_of

import jaxmb as mb
from jaxmb import spatial
from jaxmb.formulations import Multipliers, accelerations
from jaxmb.parts import terrain
from jaxmb.parts.modes import CLOSED, OPEN
from jaxmb.parts.planar.kinematics import PLANE
from jaxmb.parts.spatial.kinematics import SPACE
from jaxmb.system.instant import Instant

A, B, R, S = np.array([0.4, 0.9]), np.array([1.5, 2.0]), 0.1, 0.25
# On a body at A that is turned by 0.2, and on one at B that is turned by −0.4.
ON_A, ON_B = np.array([0.3, -0.2]), np.array([-0.1, 0.2])


def turned(angle, v):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * v[0] - s * v[1], s * v[0] + c * v[1]])


BETWEEN = B + turned(-0.4, ON_B) - A - turned(0.2, ON_A)
IN_A = turned(-0.2, BETWEEN)
POINTS = {"point_a": ON_A, "point_b": ON_B}
# Contacts, and their gaps by hand.
GAPS = {
    "balls": (mb.RigidBallContact("c", "a", "b", radius_a=R, radius_b=S, **POINTS), np.linalg.norm(BETWEEN) - R - S),
    "plane": (mb.RigidPlaneContact("c", "a", "b", normal=(0.6, 0.8), radius=R, **POINTS), BETWEEN @ [0.6, 0.8] - R),
    "corner": (
        mb.RigidBoxContact("c", "a", "b", size=(0.6, 0.8), radius=R, **POINTS),
        np.hypot(*(IN_A - [0.3, 0.4])) - R,
    ),
    "face": (mb.RigidBoxContact("c", "a", "b", size=(0.6, 9.0), radius=R, **POINTS), IN_A[0] - 0.3 - R),
    "slack": (mb.Slack("c", "a", "b", length=3.0, **POINTS), (9.0 - BETWEEN @ BETWEEN) / 6.0),
    # To first order in its curvature the distance from the ground is that along the normal.
    "ground": (
        mb.RigidContact("c", "a", terrain=terrain.Slope(0.75, level=-2.0), centre=ON_A, radius=R),
        0.8 * ((A + turned(0.2, ON_A)) @ [-0.75, 1.0] + 2.0) - R,
    ),
}


def test_gap_of_a_slack_rope_is_the_length_that_it_lacks():
    poses = np.array([(*A, 0.2), (*B, -0.4)])
    rope = mb.Rope("c", [("a", ON_A), ("b", ON_B)], length=3.0, slack=True).resolve(PLANE, poses)
    _, law = rope.components()
    np.testing.assert_allclose(law.gap(PLANE, poses), 3.0 - np.linalg.norm(BETWEEN), rtol=1e-12)


@pytest.mark.parametrize("part, gap", GAPS.values(), ids=GAPS)
def test_gap_by_hand(part, gap):
    poses = np.array([(*A, 0.2), (*B, -0.4)])[: len(part.bodies)]
    found = part.resolve(PLANE, poses).gap(PLANE, poses)
    np.testing.assert_allclose(found, gap, rtol=1e-12)
    assert gap > 0.1


def test_gap_of_stops_in_space_is_that_to_the_nearer_stop():
    """Also where the angle of the hinge, in (−π, π], has jumped."""
    axis, angles = np.array([0.0, 0.6, 0.8]), np.array([2.4, 3.0, 3.6, 4.1])
    hinge = {"axis_a": axis, "axis_b": axis, "x_a": (1.0, 0.0, 0.0), "x_b": (1.0, 0.0, 0.0)}
    hinge = spatial.Revolute("hinge", "ground", "b", point_a=np.zeros(3), point_b=np.zeros(3), **hinge)
    part = mb.Stop("c", "hinge.angle", lower=2.5, upper=4.0).of_sources([hinge], [(0, 1)])
    poses = np.zeros((4, 2, 7))
    poses[:, 0, 3] = 1.0
    poses[:, 1, 3], poses[:, 1, 4:] = np.cos(angles / 2), np.sin(angles / 2)[:, None] * axis
    gaps = jax.jit(jax.vmap(lambda q: part.gap(SPACE, q)))(poses)
    np.testing.assert_allclose(gaps, [-0.1, 0.5, 0.4, -0.1], rtol=0, atol=1e-14)


def test_slip_between_bodies_is_relative():
    """Bodies that move as one do not slip; otherwise the slip is along the normal turned clockwise."""
    poses = np.array([(*A, 0.2), (*B, -0.4)])
    part = GAPS["balls"][0].resolve(PLANE, poses)
    as_one = np.array([[0.3 - 0.7 * y, -0.2 + 0.7 * x, 0.7] for x, y, _ in poses])
    normal = BETWEEN / np.linalg.norm(BETWEEN)
    slip = jax.jit(lambda u: part.slip(PLANE, poses, u))
    np.testing.assert_allclose(slip(as_one), 0.0, rtol=0, atol=1e-15)
    shifted = as_one + np.array([[0.0] * 3, [0.5, 0.9, 0.0]])
    np.testing.assert_allclose(slip(shifted), [normal @ [-0.9, 0.5]], rtol=1e-12)


@pytest.mark.slow(but=("a contact of a user", "a ring of a user", "a drum of a user", "Stop in the plane"))
@pytest.mark.parametrize("name", CONTACTS)
def test_gap_and_its_derivatives(name):
    """Rates and second derivatives are those of the gap along a motion; the row of a closed contact is its gradient."""
    system = system_of(name)
    of, t, u = system.contacts, jnp.zeros(()), system.guess.u
    rows = np.array(of.rows)

    @jax.jit
    def seen(q):
        at, gap = Instant(system, t, q, u), lambda q: Instant(system, t, q, u).gaps
        ahead = lambda q: jax.jvp(gap, (q,), (system.rates(t, q, u),))[1]
        gap_rate, bend = jax.jvp(ahead, (q,), (system.rates(t, q, u),))
        own = at.contact_motion.rates, at.contact_accelerations(jnp.zeros_like(u))
        gradients = at.contact_place.gradients, system.jacobian(t, of.with_modes(q, CLOSED), u)[rows]
        return gap(q), own, (gap_rate, bend), gradients

    gap, own, along, (gradient, closed) = jax.tree.map(np.asarray, seen(system.guess.q))
    assert gap.shape == (1,) and gap[0] > 0 and of.names == of.contact_names == ("c",)
    np.testing.assert_allclose(own, along, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(gradient @ u, own[0], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(closed, gradient, rtol=1e-12, atol=1e-14)

    text = str(system.describe())
    assert "contacts" in text and "where closed 1 row each" in text
    assert "c.mode" in system.coordinate_names() and "c.restitution" in mb.parameters(system)
    assert mb.with_parameters(system, {"c.restitution": 0.5}).contact_laws(0.0).normal.ask("ratio", jnp.ones(1)) == 0.5


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Stop in the plane", "RigidContact in space", "RigidBallContact"])
def test_contact_that_is_open_does_nothing_and_one_that_is_closed_pushes(name):
    system = system_of(name)
    state = mb.assemble(system)
    # Balls that fall side by side would neither push nor pull.
    t, u = jnp.zeros(()), jnp.linspace(0.5, -0.7, state.u.size)
    of = system.contacts
    at = lambda mode: accelerations(system, Multipliers(), t, of.with_modes(state.q, mode), u)
    (free, none), (held, forces) = at(OPEN), at(CLOSED)
    (row,) = of.rows
    assert none[row] == 0
    left = Instant(system, t, state.q, u).contact_accelerations(held)
    np.testing.assert_allclose(left, 0.0, atol=1e-12)
    assert abs(forces[row]) > 1e-3
    assert (forces[row] > 0) == (Instant(system, t, state.q, u).contact_accelerations(free)[0] < 0)


def test_one_of_two_balls_may_be_a_point():
    meet = lambda radius: mb.RigidBallContact("meet", "a", "b", radius_a=0.0, radius_b=radius)
    poses = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)])
    np.testing.assert_allclose(meet(0.1).resolve(PLANE, poses).gap(PLANE, poses), 0.9, rtol=1e-15)
    with pytest.raises(ValueError, match="'meet': only one of radius_a and radius_b may be zero; give the other"):
        meet(0.0).resolve(PLANE, poses)
