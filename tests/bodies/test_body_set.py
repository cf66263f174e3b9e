"""Moments and reactions of turned bodies."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

import jaxmb as mb
from jaxmb import spatial

J = np.array([[2.0, 0.1, 0.3], [0.1, 1.5, 0.2], [0.3, 0.2, 1.0]])


def test_body_set_has_the_derivatives_of_gyroscopic_moments():
    """Of −ω × J ω, by differences."""
    system = mb.Scene([spatial.Body("top", mass=3.0, inertia=J)]).compile()
    u = np.random.default_rng(0).normal(size=6)
    found = system.bodies.gyroscopic_damping(
        SimpleNamespace(poses=jnp.zeros((2, 16)), velocities=jnp.asarray([u, 0 * u]))
    )
    moment = lambda w: -np.cross(w, J @ w)
    # A quadratic function has exact differences.
    expected = np.stack([0.5 * (moment(u[3:] + e) - moment(u[3:] - e)) for e in np.eye(3)], axis=1)
    np.testing.assert_allclose(found[0, 3:, 3:], expected, rtol=1e-12)
    assert not np.any(found[0, :3]) and not np.any(found[0, :, :3])


def test_reaction_holds_a_turned_body_at_its_joint():
    """The weight of a body that is welded elsewhere, with the moment about the point of the weld."""
    turn = mb.rotations.from_axis_angle(np.array([0.6, 0.0, 0.8]), 0.9)
    place, point, weight = np.array([0.4, 0.1, -0.3]), np.array([0.1, -0.5, 0.2]), np.array([0.0, 0.0, -2.0 * 9.81])
    body = spatial.Body("body", mass=2.0, inertia=J, position=place, orientation=turn)
    weld = spatial.Fixed("weld", "ground", "body", point=point)
    system = mb.Scene([body], joints=[weld], forces=[mb.Gravity((0.0, 0.0, -9.81))]).compile()
    q, u = system.guess.q, np.zeros(6)

    @jax.jit
    def held(q, u):
        return system.jacobian(0.0, q, u), system.force(0.0, q, u)

    rows, force = map(np.asarray, held(q, u))
    multipliers = np.linalg.solve(rows.T, -force)
    ys = mb.State(q[None], u[None])
    reaction = system.catalogue.reaction("weld", jnp.zeros(1), ys, multipliers[None])
    np.testing.assert_allclose(reaction.force[0], -weight, rtol=0, atol=1e-12)
    np.testing.assert_allclose(reaction.moment[0], -np.cross(place - point, weight), rtol=0, atol=1e-12)
