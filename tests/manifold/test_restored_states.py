"""A state that is restored to its constraints has the derivatives of its differences."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxmb as mb
from jaxmb.formulations import Partitioned
from jaxmb.lagrangian import CoulombFriction, Holonomic, LagrangianSystem
from jaxmb.manifold import Partition


def test_restored_states_under_friction_have_derivatives():
    """Of a bead in a rough ring, whose position another mass follows."""
    system = LagrangianSystem(
        kinetic=lambda t, q, v, p: 0.5 * v @ v,
        potential=lambda t, q, p: 9.81 * q[1],
        constraints=[
            Holonomic("follow", lambda t, q, p: q[2] - 0.5 * q[0] ** 2),
            Holonomic("ring", lambda t, q, p: 0.5 * (q[:2] @ q[:2] - 1.0)),
        ],
        nonideal=[CoulombFriction("ring", "mu", slip=lambda t, q, v, p: v[:2], transition_speed=0.2)],
        q=(0.6, 0.8, 0.18),
        u=(-0.8, 0.6, -0.48),
        parameters={"mu": 0.3},
    )
    policy = Partition()
    term, _ = policy.prepare(system, Partitioned(), mb.solvers.Adams(), policy.accuracy(1e-8))
    dq, du = np.random.default_rng(0).normal(size=(2, 3))

    @jax.jit
    def run(steps):
        t, start = jnp.zeros(()), system.guess
        chart = term.update_chart(t, start, term.init_chart(t, start, None), None)

        def restored(h):
            found = term.project_cold(t, mb.State(start.q + h * dq, start.u + h * du), chart, None)
            return jnp.concatenate([found.y.q, found.y.u, found.f.u])

        return jax.lax.map(lambda h: jax.jvp(restored, (h,), (jnp.ones(()),)), steps)

    (_, *values), (derivative, *_) = jax.device_get(run(np.array([0.0, 1e-3, -1e-3, 2e-3, -2e-3])))
    differences = (8 * (values[0] - values[1]) - (values[2] - values[3])) / 12e-3
    assert np.max(np.abs(derivative)) > 0.1
    np.testing.assert_allclose(derivative, differences, rtol=1e-7, atol=1e-7)
