"""How far a mechanism is from closing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from designed_four_bar import designed

import jaxmb as mb
from jaxmb import planar

FIX = {"crank.angle": np.pi}


@pytest.fixture(scope="module")
def plain():
    return mb.mechanisms.four_bar()


@pytest.fixture(scope="module")
def machine(plain):
    return designed(plain)


def gap(machine, plain, rod, crank):
    return mb.assembly_gap(mb.with_parameters(machine, {"rod": rod, "crank": crank}), plain.state, fix=FIX)


@pytest.mark.slow
def test_the_gap_is_zero_where_a_mechanism_closes_and_grows_where_not(machine, plain):
    """With the crank at 180° the pivots of coupler and rocker, 2.5 m long, are 2.5 + crank apart."""
    rods = jnp.array([0.2, 0.6, 0.99, 1.01, 3.0, 5.99, 6.01, 6.5])
    gaps = np.asarray(jax.vmap(lambda rod: gap(machine, plain, rod, 1.0))(rods))
    missing = np.maximum(np.maximum(1.0 - rods, rods - 6.0), 0.0)
    assert np.all((gaps == 0) == (missing == 0))
    assert np.all(np.abs(gaps[missing > 0] / missing[missing > 0] / 0.155 - 1) < 0.06)
    solved = jax.vmap(
        lambda rod: mb.assemble(mb.with_parameters(machine, {"rod": rod}), plain.state, fix=FIX, throw=False).q
    )
    np.testing.assert_array_equal(np.isnan(solved(rods)).any(axis=1), missing > 0)


@pytest.mark.slow
@pytest.mark.parametrize("rod", [0.3, 6.4])
def test_derivatives_of_the_gap(machine, plain, rod):
    """Forward mode, reverse mode and central differences agree; a coupler too short wants to be longer."""
    at = (jnp.asarray(rod), jnp.asarray(1.0))
    of = lambda rod, crank: gap(machine, plain, rod, crank)
    forward, reverse = (np.array(d(of, (0, 1))(*at)) for d in (jax.jacfwd, jax.jacrev))
    h = 1e-6
    central = [
        (of(at[0] + h, at[1]) - of(at[0] - h, at[1])) / (2 * h),
        (of(at[0], at[1] + h) - of(at[0], at[1] - h)) / (2 * h),
    ]
    np.testing.assert_allclose(forward, reverse, rtol=1e-12)
    np.testing.assert_allclose(forward, central, rtol=1e-8)
    assert (forward[0] < 0) == (rod < 1)


def test_a_gap_without_constraints():
    body = planar.Body("disk", mass=1.0, inertia=1.0, position=(0.0, 0.0))
    assert float(mb.assembly_gap(mb.Scene([body]).compile())) == 0.0
