"""A state that is restored to its constraints has the derivatives of its differences."""

import jax
import jax.numpy as jnp
import numpy as np
from sprung_pendulums import GRAVITY, rod

import jaxmb as mb
from jaxmb import planar
from jaxmb.formulations import Partitioned
from jaxmb.manifold import Partition


def test_restored_states_under_friction_have_derivatives():
    pin = planar.Revolute("pin", "ground", "rod", point_a=(0.0, 0.0), point_b=(-0.5, 0.0))
    rub = planar.Friction("rub", "pin", coefficient=0.3, radius=0.1, transition_speed=0.2)
    bead = planar.PointMass("bead", mass=0.5, position=(0.6, -0.8))
    cord = planar.Distance("cord", "ground", "bead", length=1.0)
    system = mb.Scene([rod(), bead], joints=[cord, pin], forces=[rub, GRAVITY]).compile()
    c, s, random = np.cos(0.3), np.sin(0.3), np.random.default_rng(0)
    y = mb.State(np.array([0.5 * c, 0.5 * s, 0.3, 0.6, -0.8]), np.array([-0.5 * s, 0.5 * c, 1.0, 0.4, 0.3]))
    term, _ = Partition().prepare(system, Partitioned(), mb.solvers.Adams(), 1e-8)
    dq, du = random.normal(size=(2, 5))

    @jax.jit
    def run(steps):
        t, start = jnp.zeros(()), jax.tree.map(jnp.asarray, y)
        chart = term.update_chart(t, start, term.init_chart(t, start, None), None)

        def restored(h):
            found = term.project_cold(t, mb.State(start.q + h * dq, start.u + h * du), chart, None)
            return jnp.concatenate([found.y.q, found.y.u, found.f.u])

        return jax.lax.map(lambda h: jax.jvp(restored, (h,), (jnp.ones(()),)), steps)

    (_, *values), (derivative, *_) = run(np.array([0.0, 1e-3, -1e-3, 2e-3, -2e-3]))
    differences = (8 * (values[0] - values[1]) - (values[2] - values[3])) / 12e-3
    np.testing.assert_allclose(derivative, differences, rtol=1e-7, atol=1e-7)
