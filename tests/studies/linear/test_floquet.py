"""Floquet's multipliers of periodic motions, against Mathieu's equation and direct integration."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from scipy.special import ellipk, mathieu_a, mathieu_b

import jaxmb as mb
from jaxmb import lagrangian, planar, spatial
from jaxmb.studies.linear.floquet import Floquet, _return

G = 9.81


@functools.cache
def parametric():
    """`θ̈ + (δ + ε cos t) sin θ = 0`."""
    return lagrangian.LagrangianSystem(
        lambda t, q, v, p: 0.5 * v[0] ** 2 + (p["delta"] + p["epsilon"] * jnp.cos(t)) * jnp.cos(q[0]),
        q=(0.0,),
        parameters={"delta": 0.3, "epsilon": 0.1},
        coordinates=("theta",),
    )


def monodromy(delta, epsilon):
    """Of Mathieu's equation, by direct integration."""
    run = lambda y: scipy.integrate.solve_ivp(
        lambda t, y: [y[1], -(delta + epsilon * np.cos(t)) * y[0]],
        (0, 2 * np.pi),
        y,
        rtol=1e-12,
        atol=1e-13,
        method="DOP853",
    ).y[:, -1]
    return np.stack([run([1.0, 0.0]), run([0.0, 1.0])], axis=1)


@pytest.mark.slow
def test_a_parametric_pendulum_has_mathieus_multipliers():
    system = parametric()
    found = mb.floquet(system, mb.assemble(system), 2 * np.pi)
    assert found.states == ("theta", "theta_rate")
    np.testing.assert_allclose(found.monodromy, monodromy(0.3, 0.1), atol=1e-8)
    own = np.linalg.eigvals(monodromy(0.3, 0.1))
    np.testing.assert_allclose(np.sort_complex(found.multipliers), np.sort_complex(own), atol=1e-8)
    assert "multiplier" in str(found)


@pytest.mark.slow
def test_the_tongues_of_mathieu():
    """With `a = 4 δ`, `q = −2 ε`, a multiplier is −1 on the borders of the first tongue: the trace is −2."""
    system, epsilon = parametric(), 0.2

    def trace(delta):
        changed = mb.with_parameters(system, {"delta": delta, "epsilon": epsilon})
        return jnp.trace(mb.floquet(changed, mb.State(jnp.zeros(1), jnp.zeros(1)), 2 * np.pi).monodromy)

    borders = np.sort([mathieu_a(1, 2 * epsilon), mathieu_b(1, 2 * epsilon)]) / 4
    traces = jax.jit(jax.vmap(trace))(np.array([*borders, np.mean(borders)]))
    np.testing.assert_allclose(traces[:2], -2.0, atol=1e-8)
    assert traces[2] < -2.0
    h = 1e-5
    slope = (np.trace(monodromy(borders[0] + h, epsilon)) - np.trace(monodromy(borders[0] - h, epsilon))) / (2 * h)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(trace))(borders[0]), slope, rtol=1e-5)


@pytest.mark.slow
def test_a_swinging_rod_has_two_multipliers_of_one():
    rod = planar.Body("rod", mass=1.0, inertia=1 / 12, position=(0.0, -0.5), angle=-np.pi / 2)
    pin = planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0))
    system = mb.Scene([rod], joints=[pin], forces=[mb.Gravity((0.0, -G))]).compile()
    state = mb.assemble(system, fix={"rod.angle": -np.pi / 2 + 1.0})
    period = 4 * np.sqrt(2 / (3 * G)) * ellipk(np.sin(0.5) ** 2)
    found = mb.floquet(system, state, period, coordinates=["rod.angle"])
    assert np.trace(found.monodromy) == pytest.approx(2.0, abs=1e-7)
    assert np.linalg.det(found.monodromy) == pytest.approx(1.0, abs=1e-7)
    with pytest.raises(ValueError, match=r"does not return after 1 s: it differs in rod.*ignorable"):
        mb.floquet(system, state, 1.0)


def test_floquet_has_multipliers_and_exponents():
    """Of a hand-made map: the largest first, and their logarithms over the period."""
    found = Floquet(jnp.diag(jnp.array([0.5, 2.0])), ("a", "b"), 1, jnp.eye(2), jnp.asarray(3.0))
    multipliers, exponents = eqx.filter_jit(lambda found: (found.multipliers, found.exponents))(found)
    np.testing.assert_allclose(multipliers, [2.0, 0.5], rtol=1e-14)
    np.testing.assert_allclose(exponents, np.log([2.0, 0.5]) / 3.0, rtol=1e-14)


def test_whole_turns_and_the_sign_of_euler_parameters_are_no_distance():
    top = mb.Scene([spatial.Body("top", mass=1.0, inertia=(1.0, 1.0, 2.0), orientation=(0.6, 0.0, 0.8, 0.0))]).compile()
    attitude = -np.asarray(top.guess.q[3:]) + np.array([0.0, 0.1, 0.0, 0.0])
    flipped = np.concatenate([top.guess.q[:3], attitude, top.guess.u])
    pushed = np.arange(26.0).reshape(13, 2)
    distance, back = jax.jit(lambda end: _return(top, top.guess, end, jnp.asarray(pushed), np.zeros(0, int)))(flipped)
    np.testing.assert_allclose(distance, np.eye(13)[4] * -0.1, atol=1e-15)
    np.testing.assert_allclose(back, pushed * np.where((np.arange(13) > 2) & (np.arange(13) < 7), -1.0, 1.0)[:, None])
    rod = mb.Scene([planar.Body("rod", mass=1.0, inertia=1.0)]).compile()
    turned = np.concatenate([np.asarray(rod.guess.q) + np.array([3.0, 0.2, 4 * np.pi + 0.1]), rod.guess.u])
    distance, _ = jax.jit(lambda end: _return(rod, rod.guess, end, jnp.zeros((6, 1)), np.array([0])))(turned)
    np.testing.assert_allclose(distance, [0.0, 0.2, 0.1, 0.0, 0.0, 0.0], atol=1e-14)


def test_periods_and_names_that_cannot_be():
    system = parametric()
    for period, options, message in (
        (0.0, {}, "period must be positive"),
        (np.inf, {}, "period must be positive"),
        (1.0, {"ignorable": ["thet"]}, "Unknown coordinate 'thet'; did you mean 'theta'"),
        (1.0, {"coordinates": ["theta", "thet"]}, "There are 1 independent coordinates"),
    ):
        with pytest.raises(ValueError, match=message):
            mb.floquet(system, mb.State(jnp.zeros(1), jnp.zeros(1)), period, **options)


@pytest.mark.slow
def test_multipliers_of_a_motion_with_impacts():
    """A slide between elastic stops: a perturbation of the speed moves its place in proportion to the time."""
    slide = planar.Body("slide", mass=1.0, inertia=0.1, position=(0.2, 0.0))
    rail = planar.Prismatic("rail", "ground", "slide", point=(0.0, 0.0), axis=(1.0, 0.0))
    stop = mb.Stop("stop", "rail.displacement", lower=-0.2, upper=0.2, restitution=1.0)
    system = mb.Scene([slide], joints=[rail, stop]).compile()
    state = mb.assemble(system, fix={"slide.x": 0.1}, rates={"slide.x": 1.0})
    found = mb.floquet(system, state, 0.8)
    np.testing.assert_allclose(found.monodromy, [[1.0, 0.8], [0.0, 1.0]], atol=1e-8)
