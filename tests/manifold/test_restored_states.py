"""A state that is restored to its constraints has the derivatives of its differences."""

import jax
import jax.numpy as jnp
import numpy as np
from sprung_pendulums import GRAVITY, rod

import jaxmb as mb
from jaxmb import planar
from jaxmb.formulations import Partitioned
from jaxmb.manifold import Partition


def test_restored_velocities_and_accelerations_under_friction():
    pin = planar.Revolute("pin", "ground", "rod", point_a=(0.0, 0.0), point_b=(-0.5, 0.0))
    rub = planar.Friction("rub", "pin", coefficient=0.3, radius=0.1, transition_speed=0.2)
    bead = planar.PointMass("bead", mass=0.5, position=(0.6, -0.8))
    cord = planar.Distance("cord", "ground", "bead", length=1.0)
    system = mb.Scene([rod(), bead], joints=[cord, pin], forces=[rub, GRAVITY]).compile()
    y = mb.assemble(system, fix={"rod.angle": 0.3}, rates={"rod.angle": 1.0})
    term, _ = Partition().prepare(system, Partitioned(), mb.solvers.Adams(), 1e-8)
    t, random = jnp.zeros(()), np.random.default_rng(0)
    chart = jax.jit(lambda: term.update_chart(t, y, term.init_chart(t, y, None), None))()

    def restored(q, u):
        found = term.project_cold(t, mb.State(q, u), chart, None)
        return jnp.concatenate([found.y.q, found.y.u, found.f.u])

    dq, du = (jnp.asarray(random.normal(size=5)) for _ in range(2))
    moved = jax.jit(lambda h: restored(y.q + h * dq, y.u + h * du))
    derivative = jax.jit(lambda: jax.jvp(lambda h: moved(h), (jnp.zeros(()),), (jnp.ones(()),))[1])()
    differences = (8 * (moved(1e-3) - moved(-1e-3)) - (moved(2e-3) - moved(-2e-3))) / 12e-3
    np.testing.assert_allclose(derivative, differences, rtol=1e-7, atol=1e-7)
