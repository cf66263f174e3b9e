"""What a user's function reads is changed and the system is built anew: it moves by the new number, and the old system,
which is still there, by the old one.
"""

import copy

import changing_numbers
import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from changing_numbers import BALL, PLACES, WAYS

import jaxmb as mb
from jaxmb import planar
from jaxmb._captured import Captured


def plain(k):
    """The way of a function that holds nothing that could change."""
    return lambda formula: (lambda *given: formula(k, *given), None)


def expected(place, k):
    build, compute, _ = place(plain(k))
    return np.asarray(compute(build()))


def check(place, way, first, second):
    build, compute, change = place(way)
    change(first)
    old = build()
    np.testing.assert_allclose(compute(old), expected(place, first), rtol=1e-12)
    change(second)
    new = expected(place, second)
    assert np.max(np.abs(new - compute(old))) > 1e-3
    np.testing.assert_allclose(compute(build()), new, rtol=1e-12)
    return old, compute


@pytest.mark.parametrize("place", PLACES, ids=lambda place: place.__name__)
def test_each_place_of_a_function(place):
    check(place, changing_numbers.in_global, 1.5, 2.5)


@pytest.mark.parametrize("way", WAYS, ids=lambda way: way.__name__)
def test_each_way_to_hold_a_number(way):
    check(changing_numbers.force, way, 1.5, 2.5)
