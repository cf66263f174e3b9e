"""Trains: draft gears, chains of vehicles of any length, and the cost of them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import trains as oracle

import jaxmb as mb
from jaxmb import planar

# A draft gear that is a linear spring.
LINEAR = functools.partial(planar.DraftGear, stiffness=2e7, unloading=1.0, preload=0.0, slack=0.0, travel=10.0)
BARE = {"suspension": 0.0, "resistance": 0.0, "brake": 0.0, "speed": 0.0, "coupler_height": 0.0}


def gear(**numbers):
    return planar.DraftGear("gear", "a", "b", free_length=1.0, **numbers)


# The draft gear


def test_draft_gear_is_that_of_an_independent_model():
    s, rate = np.meshgrid(np.linspace(-0.16, 0.16, 641), [-20.0, -0.01, -1e-5, 0.0, 1e-12, 0.003, 1.0])
    for numbers, same in (
        ({}, {}),
        ({"slack": 0.0, "unloading": 1.0, "damping": 1e4}, {"slack": 0.0, "eta": 1.0, "c": 1e4}),
        ({"smoothing": 1e-6, "slack": 1e-9}, {"width": 1e-6, "slack": 1e-9}),
    ):
        expected = oracle.draft_gear(s, rate, **same)
        np.testing.assert_allclose(gear(**numbers).tension(s, rate), expected, rtol=1e-12, atol=1e-6)


@pytest.mark.parametrize("preload", [0.0, 5e4])
def test_area_of_a_cycle_is_what_friction_takes(preload):
    k, eta, slack, stroke = 1e7, 0.4, 0.02, 0.08
    part = gear(stiffness=k, unloading=eta, slack=slack, preload=preload)
    angle = np.linspace(0.0, 2 * np.pi, 200001)
    for sign in (1, -1):
        s = sign * (slack + 0.5 * stroke * (1 - np.cos(angle)))
        rate = sign * 0.5 * stroke * np.sin(angle)
        area = np.trapezoid(part.tension(s, 1e2 * rate), s)
        assert area == pytest.approx((1 - eta) * (0.5 * k * stroke**2 + preload * stroke), rel=0.01)


def test_draft_gear_without_slack_and_friction_is_a_spring():
    s = np.linspace(-0.1, 0.1, 81)
    np.testing.assert_allclose(LINEAR("c", "a", "b").tension(s, 3.0), 2e7 * s, rtol=1e-13, atol=1e-8)


@pytest.mark.parametrize("rate", [0.0, 1e-300, 1e-12, -1e3, 1e6])
@pytest.mark.parametrize("extension", [0.0, 0.02, -0.02, 1e-300, 0.13, -1e3])
def test_derivatives_of_the_tension_are_finite_everywhere(extension, rate):
    value = lambda part, s, v: part.tension(s, v)
    out = jax.grad(value, argnums=(0, 1, 2))(gear(), jnp.asarray(extension), jnp.asarray(rate))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(out))


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"slack": -0.01}, "slack must be non-negative"),
        ({"unloading": 1.5}, "unloading .* at most 1"),
        ({"transition": 0.0}, "transition must be positive"),
        ({"smoothing": 0.0}, "smoothing must be positive"),
        ({"travel": 0.0}, "travel must be positive"),
    ],
)
def test_numbers_of_draft_gears_are_checked(numbers, message):
    with pytest.raises(ValueError, match=f"'coupler1': {message}"):
        mb.mechanisms.train(n=2, coupler=functools.partial(planar.DraftGear, **numbers))


# Trains with draft gears


def test_frequencies_of_a_free_chain():
    n, k, m = 20, 2e7, 8e4
    system = mb.mechanisms.train(n=n, coupler=LINEAR, **BARE).system
    along = np.arange(0, 3 * n, 3)
    stiffness = -jax.jacfwd(lambda q: system.force(0.0, q, system.guess.u))(system.guess.q)[np.ix_(along, along)]
    found = np.sqrt(np.linalg.eigvalsh(stiffness / m)[1:])
    np.testing.assert_allclose(found, 2 * np.sqrt(k / m) * np.sin(np.arange(1, n) * np.pi / (2 * n)), rtol=1e-9)
