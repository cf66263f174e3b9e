"""The watch of rows that other rows imply."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxmb.lagrangian import AccelerationConstraint, Holonomic, LagrangianSystem
from jaxmb.manifold.implied import DroppedRows, violation_of_accelerations, watched
from jaxmb.system.instant import Instant


def free(t, q, v, p):
    return 0.5 * v @ v


def test_violation_of_an_implied_position():
    """A row that is not implied any more is violated by the displacement that would satisfy it."""
    rows = [Holonomic(name, lambda t, q, p, k=k: k * (q[0] - 1.0)) for name, k in (("one", 1.0), ("twice", 2.0))]
    system = LagrangianSystem(free, constraints=rows, q=(1.0, 0.0))

    @jax.jit
    def run(q, independent):
        at = Instant(system, jnp.zeros(()), q, jnp.zeros(2))
        found = watched(at, dataclasses.replace(DroppedRows.at_start(at), independent=independent), 1e-9, 1e-6)
        return found.violation, found.suspected

    q, newton, eps = np.array([1.0 + 1e-8, 0.0]), 1e-9, np.finfo(float).eps
    allowed, independent = 8 * eps**0.5, 1e-3
    implied, suspected = run(q, 1e-7)
    np.testing.assert_allclose(implied, 1e-8 / allowed, rtol=1e-6)
    np.testing.assert_allclose(suspected, 1e-8 / newton, rtol=1e-6)
    other, _ = run(q, independent)
    np.testing.assert_allclose(other, 1e-8 / (10 * 1e-6 * independent), rtol=1e-6)
    assert run(np.array([1.0, 0.0]), independent)[0] == 0


def test_violation_of_an_implied_acceleration():
    """It counts in units of the effect of small errors: the larger of the acceleration and the square of the speed."""
    row = lambda name: AccelerationConstraint(
        name, lambda t, q, v, p: jnp.array([[1.0, 0.0]]), lambda t, q, v, p: p["a"][None]
    )
    system = LagrangianSystem(free, constraints=[row("one"), row("twin")], q=(0.0, 0.0), parameters={"a": 1.0})
    scale = np.asarray(system.velocity_scale())
    assert scale[0] == scale[1]

    @jax.jit
    def run(u, udot):
        return violation_of_accelerations(Instant(system, jnp.zeros(()), jnp.zeros(2), u), udot, 1e-6)

    for u, udot, size in (((3.0, 0.0), (0.0, 0.0), 9.0 / scale[0]), ((1.0, 0.0), (0.0, 20.0), 20.0)):
        found = run(np.array(u), np.array(udot))
        np.testing.assert_allclose(found, 1.0 / (10 * 1e-6 * size), rtol=1e-10)
    assert run(np.zeros(2), np.array([1.0, 0.0])) == 0
