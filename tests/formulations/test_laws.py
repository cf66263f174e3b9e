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
def test_laws_applied_forces_and_memory(build, laws):
    system = build()
    own = laws_of(system)
    assert type(own) is laws
    q, u = np.asarray(system.guess.q), np.ones(system.nu)
    multipliers = np.arange(1.0, system.acceleration_rows + 1)

    @jax.jit
    def run(q, u, multipliers):
        at = Instant(system, jnp.zeros(()), q, u)
        memory = own.remembered(at, multipliers)
        assert (memory is None) == (laws is not ReactiveLaws)
        expected = at.force + system.nonideal_force(at.t, q, u, multipliers)
        return own.applied(at, memory), expected, own.recalled(at, multipliers, memory)

    applied, expected, recalled = run(q, u, multipliers)
    np.testing.assert_allclose(applied, expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(recalled, multipliers)
    if laws is not IdealLaws:
        # Friction works against the motion.
        force = (
            system.nonideal_force(0.0, q, u, multipliers) if laws is GivenLaws else applied - system.force(0.0, q, u)
        )
        assert u @ np.asarray(force) < 0
        if laws is GivenLaws:
            np.testing.assert_allclose(force, -0.2 * u, rtol=1e-14)
