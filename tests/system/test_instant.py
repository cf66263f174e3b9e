"""The system at an instant: quantities are computed once in each trace, and never taken from one that has ended."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import jaxmb as mb
from jaxmb.system.instant import Instant, Keeper, kept


def four_bar():
    mechanism = mb.mechanisms.four_bar()
    return Instant.of(mechanism.system, 0.0, mechanism.state)


def counted(program, *arguments):
    """How often a program evaluates its sine."""
    return str(jax.make_jaxpr(program)(*arguments)).count(" sin ")


class Angle(eqx.Module, Keeper):
    x: jax.Array

    @kept
    def sine(self):
        return jnp.sin(self.x)


def test_instant_computes_a_quantity_once_in_a_trace():
    assert counted(lambda x: (lambda angle: angle.sine + angle.sine)(Angle(x)), 0.3) == 1
    assert counted(lambda x: Angle(x).sine + Angle(x).sine, 0.3) == 2
    branch = lambda angle: lax.cond(angle.x > 0, lambda: angle.sine, lambda: 2 * angle.sine)
    assert counted(lambda x: (lambda angle: angle.sine + branch(angle))(Angle(x)), 0.3) == 1
    assert counted(lambda x: branch(Angle(x)), 0.3) == 2


@pytest.mark.slow
def test_instant_leaves_quantities_in_branches_loops_and_derivatives():
    def program(x):
        angle = Angle(x)
        branch = lax.cond(x > 0, lambda: angle.sine, lambda: 2 * angle.sine)
        loop = lax.fori_loop(0, 2, lambda _, y: y + angle.sine, 0.0)
        slope = jax.grad(lambda y: y * angle.sine)(x)
        lanes = jax.vmap(lambda y: y * angle.sine)(jnp.ones(2))
        return branch + loop + slope + jnp.sum(lanes) + angle.sine

    for of in (program, jax.jit(program), lambda x: jax.vmap(program)(x[None])[0]):
        np.testing.assert_allclose(of(jnp.array(0.3)), 7 * np.sin(0.3), rtol=1e-6)
    np.testing.assert_allclose(jax.grad(program)(0.3), 7 * np.cos(0.3), rtol=1e-6)


def test_instant_whose_copy_keeps_nothing():
    at = four_bar()
    force = at.force
    assert at.force is force
    assert jax.tree.map(lambda x: x, at).force is not force
    assert jax.tree.structure(at) == jax.tree.structure(four_bar())


def test_instant_has_what_the_equation_has():
    at = four_bar()
    system, q, u = at.system, np.asarray(at.q), np.asarray(at.u) + 0.1 * np.eye(9)[0]

    @jax.jit
    def evaluate(q, u):
        at = Instant.of(system, 0.0, mb.State(q, u))
        of_rows = at.jacobian @ u - system.acceleration_residual(0.0, q, u, u)
        sizes = at.row_sizes()
        return of_rows, at.gamma, at.rates, system.rates(0.0, q, u), sizes, at.velocity_residual, at.violations(sizes)

    of_rows, gamma, rates, expected, sizes, unmet, (positions, velocities) = evaluate(q, u)
    np.testing.assert_allclose(of_rows, gamma, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(rates, expected)
    # Corrections of velocities are relative to the largest velocity, which is not one.
    speed = np.max(np.abs(u) / np.asarray(system.velocity_scale()))
    np.testing.assert_allclose(velocities, np.abs(unmet) / sizes / speed, rtol=1e-5, atol=1e-9)
    assert np.max(velocities) > 1e-3 and np.max(positions) < 1e-6 and abs(speed - 1.0) > 0.1
    udot = jnp.ones_like(at.u)
    assert at.motion(udot).u is udot and at.motion(udot).z is None
    assert at.position_rows.size == at.velocity_rows.size == system.acceleration_rows
