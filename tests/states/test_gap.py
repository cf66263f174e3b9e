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
def test_gap_is_zero_where_a_mechanism_closes_and_grows_where_not(machine, plain):
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
def test_gap_derivatives(machine, plain):
    """Forward mode, reverse mode and central differences agree; a coupler too short wants to be longer."""
    of = lambda x: gap(machine, plain, x[0], x[1])
    forward, reverse, values = (jax.jit(jax.vmap(d)) for d in (jax.jacfwd(of), jax.jacrev(of), of))
    at, h = np.array([[0.3, 1.0], [6.4, 1.0]]), 1e-6 * np.eye(2)[:, None]
    slopes = np.asarray(forward(at))
    central = np.stack([(values(at + e) - values(at - e)) / 2e-6 for e in h], axis=1)
    np.testing.assert_allclose(slopes, reverse(at), rtol=1e-12)
    np.testing.assert_allclose(slopes, central, rtol=1e-8)
    assert slopes[0, 0] < 0 < slopes[1, 0]


def test_gap_is_proportional_to_what_is_missing():
    """A bar on a pin, whose centre is held beyond its reach of half a metre; without constraints there is none."""
    bar = planar.Body("bar", mass=1.0, inertia=1.0, position=(0.5, 0.0))
    system = mb.Scene([bar], joints=[planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))]).compile()
    near, far, within = (float(mb.assembly_gap(system, fix={"bar.x": x})) for x in (1.75, 3.0, 0.5))
    assert near > 0.1 and far == pytest.approx(2 * near, rel=1e-6) and within == 0.0
    assert float(mb.assembly_gap(mb.Scene([bar]).compile())) == 0.0
