"""The laws of constraint forces are those of the system, chosen in one place."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import lagrangian
from jaxmb.formulations.laws import GivenLaws, IdealLaws, ReactiveLaws, laws_of
from jaxmb.system.instant import Instant


def ring(*nonideal):
    return lagrangian.LagrangianSystem(
        kinetic=lambda t, q, v, p: 0.5 * jnp.dot(v, v),
        constraints=[lagrangian.Holonomic("ring", lambda t, q, p: 0.5 * (jnp.dot(q, q) - 1.0))],
        nonideal=list(nonideal),
        q=(1.0, 0.0),
        parameters={"c": 0.2},
    )


@pytest.mark.parametrize(
    "build, laws",
    [
        (lambda: mb.mechanisms.four_bar().system, IdealLaws),
        (ring, IdealLaws),
        (lambda: ring(lagrangian.Viscous("ring", "c")), GivenLaws),
        (lambda: mb.mechanisms.get("rough_ring").system, ReactiveLaws),
    ],
    ids=["four-bar", "ring", "viscous", "rough"],
)
def test_applied_forces_and_memory(build, laws):
    system = build()
    own = laws_of(system)
    assert type(own) is laws
    at = Instant(system, jnp.zeros(()), system.guess.q, jnp.ones(system.nu))
    multipliers = jnp.arange(1.0, system.acceleration_rows + 1)
    memory = own.remembered(at, multipliers)
    assert (memory is None) == (laws is not ReactiveLaws)
    np.testing.assert_array_equal(own.recalled(at, multipliers, memory), multipliers)
    expected = at.force + system.nonideal_force(at.t, at.q, at.u, multipliers)
    np.testing.assert_allclose(jax.jit(lambda: own.applied(at, memory))(), expected, rtol=1e-12, atol=1e-12)
