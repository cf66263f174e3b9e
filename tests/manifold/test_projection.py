"""Projections in the metric of the mass matrix, and their derivatives with respect to every coordinate."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.formulations import Multipliers
from jaxmb.manifold.projection import Projection, ProjectionTerm

J = np.diag([0.01, 0.018, 0.014])


def test_projection_of_a_state_off_a_circle():
    """The nearest state in the metric of the masses, and the accelerations there; its corrections are counted."""
    bob = planar.PointMass("bob", mass=2.0, position=(1.0, 0.0))
    rod = planar.Distance("rod", "ground", "bob", length=1.0)
    system = mb.Scene([bob], joints=[rod], forces=[mb.Gravity((0.0, -9.81))]).compile()
    term, q, u = (
        ProjectionTerm(system, Multipliers(), Projection().accuracy(1e-9)),
        np.array([1.1, 0.2]),
        np.array([0.3, -0.7]),
    )

    @jax.jit
    def run(q, u):
        found = term.project_cold(jnp.zeros(()), mb.State(q, u), jnp.array(0), None)
        near = term.project_near(jnp.zeros(()), mb.State(found.y.q + 1e-6, found.y.u), found, None)
        return found.y, found.f, found.chart, near.y, near.chart

    y, f, corrections, near, further = run(q, u)
    along = q / np.linalg.norm(q)
    across = np.array([-along[1], along[0]])
    np.testing.assert_allclose(y.q, along, rtol=1e-10)
    np.testing.assert_allclose(y.u, across * (across @ u), rtol=1e-10)
    np.testing.assert_allclose(f.u, -9.81 * across[1] * across - along * (across @ u) ** 2, rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(near.q), 1.0, rtol=1e-12)
    assert 1 <= corrections < further


def links(inertial):
    """Two links on hinges that are not parallel, and drives with inertia on each, or none."""
    axes = (0.0, 0.96, 0.28), (0.0, 0.96, -0.28)
    bodies = [spatial.Body(f"link{k}", mass=1.0, inertia=J, position=(0.4 * k + 0.2, 0.0, 0.0)) for k in range(2)]
    joints = [
        spatial.Revolute("hinge0", "ground", "link0", point=(0.0, 0.0, 0.0), axis=axes[0]),
        spatial.Revolute("hinge1", "link0", "link1", point=(0.4, 0.0, 0.0), axis=axes[1]),
    ]
    if inertial:
        joints += [mb.JointInertia(f"drive{k}", f"hinge{k}.angle", inertia=0.1 * (k + 1)) for k in range(2)]
    return mb.Scene(bodies, joints=joints, forces=[mb.Gravity((0.0, 0.0, -9.81))]).compile()


@pytest.mark.slow
@pytest.mark.parametrize("inertial", [False, True])
def test_the_field_changes_as_its_differences_say_in_every_direction(inertial):
    """Also with the norm of a quaternion, which the constraints say nothing of."""
    system = links(inertial)
    start = mb.assemble(system, rates={"hinge0.angle": 0.5, "hinge1.angle": -0.8})
    term = ProjectionTerm(system, Multipliers(), Projection(newton_tol=1e-10).accuracy(1e-8))
    y, state_of = ravel_pytree(start)

    @jax.jit
    def at(y):
        out = term.project_cold(jnp.zeros(()), state_of(y), jnp.array(0), None)
        return jnp.stack([ravel_pytree(own)[0] for own in (out.y, out.f)])

    exact, step = jax.jit(jax.jacfwd(at))(y), 1e-5
    for k, unit in enumerate(np.eye(y.size)):
        change = (at(y + step * unit) - at(y - step * unit)) / (2 * step)
        np.testing.assert_allclose(exact[:, :, k], change, rtol=0, atol=1e-6 * np.max(np.abs(exact)))


@pytest.mark.slow
def test_velocities_far_from_constraints_that_are_not_linear_in_them():
    """Three corrections bring them near, the others farther to rounding; derivatives are those of all corrections."""
    system = mb.mechanisms.benenti().system
    q = jnp.array([0.01, -0.01, 1.05, 0.04])
    near, far = jnp.array([1.0, 2.0, 0.52, 1.01]), jnp.array([1.1, 1.9, -0.07, 0.97])
    project = lambda u: mb.manifold.project(system, jnp.zeros(()), mb.State(q, u)).u

    @jax.jit
    @jax.vmap
    def found(u):
        return project(u), system.velocity_residual(0.0, q, project(u)), jax.jacfwd(project)(u), jax.jacrev(project)(u)

    starts = jnp.stack([near, far])
    u, residual, forward, reverse = found(starts)
    np.testing.assert_allclose(residual, 0.0, atol=1e-14)
    assert np.max(np.abs(u - starts)[1]) > 0.3
    np.testing.assert_allclose(forward, reverse, rtol=0, atol=1e-13)
    step = 1e-5
    for k, unit in enumerate(np.eye(4)):
        change = (found(starts + step * unit[None])[0] - found(starts - step * unit[None])[0]) / (2 * step)
        np.testing.assert_allclose(forward[:, :, k], change, rtol=0, atol=1e-9)
