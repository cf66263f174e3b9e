"""Batches: `vmap` equals the loop, and a member that fails does not spoil the others."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxmb as mb


def test_vmap_over_lengths_equals_the_loop():
    mechanism = mb.mechanisms.get("four_bar")

    def crank_angle(length):
        half = jnp.stack([length / 2, jnp.zeros_like(length)])
        values = {"A.point_b": -half, "B.point_a": half, "crank.inertia": length**2 / 12}
        system = mb.with_parameters(mechanism.system, values)
        state = mb.assemble(system, mechanism.state, fix=mechanism.fix, rates=mechanism.rates, throw=False)
        return mb.simulate(system, state, t1=0.5, rtol=1e-12, throw=False)["crank"].angle[-1]

    lengths = jnp.linspace(0.8, 1.1, 256)
    together = jax.jit(jax.vmap(crank_angle))(lengths)
    single = jax.jit(crank_angle)
    np.testing.assert_allclose(together, [single(length) for length in lengths], rtol=1e-9)


def test_failed_members_leave_the_others_alone():
    mechanism = mb.mechanisms.get("four_bar")

    def run(length):
        half = jnp.stack([length / 2, jnp.zeros_like(length)])
        system = mb.with_parameters(mechanism.system, {"C.point_a": half})
        state = mb.assemble(system, mechanism.state, rates=mechanism.rates, throw=False)
        sol = mb.simulate(system, state, t1=0.1, throw=False)
        return sol["crank"].angle[-1], sol.result == mb.RESULTS.successful, sol.result == mb.RESULTS.assembly_failed

    # A coupler of 40 m closes no loop.
    angle, fine, failed = jax.jit(jax.vmap(run))(jnp.array([3.0, 40.0, 3.1]))
    np.testing.assert_array_equal(fine, [True, False, True])
    np.testing.assert_array_equal(failed, [False, True, False])
    np.testing.assert_allclose(angle[0], run(jnp.array(3.0))[0], rtol=1e-9)
