"""Modes are followed along a parameter, also where eigenvalues cross."""

import functools

import numpy as np
import pytest

import jaxmb as mb
from jaxmb import lagrangian


@functools.cache
def two_masses():
    """Two masses on springs of their own."""
    return lagrangian.LagrangianSystem(
        kinetic=lambda t, q, v, p: 0.5 * v[0] ** 2 + 0.5 * v[1] ** 2,
        potential=lambda t, q, p: 0.5 * p["k"] * q[0] ** 2 + 2.0 * q[1] ** 2,
        q=(0.0, 0.0),
        parameters={"k": 1.0, "c": np.zeros(2)},
        coordinates=("a", "b"),
    )


@pytest.mark.slow
def test_modes_keep_their_places_where_they_cross():
    values = np.linspace(1.0, 9.0, 18)
    locus = mb.root_locus(two_masses(), "k", values, state=mb.assemble)
    assert locus.states == ("a", "b", "a_rate", "b_rate")
    own = np.abs(locus.eigenvalues)
    first = np.argsort(own[0])
    np.testing.assert_allclose(own[:, first[:2]], np.sqrt(values)[:, None] * np.ones(2), rtol=1e-12)
    np.testing.assert_allclose(own[:, first[2:]], 2.0, rtol=1e-12)
    assert np.all(locus.stable())


def test_stability_changes_where_the_largest_growth_crosses_zero():
    """Modes that stay at zero neither grow nor decay."""
    growth = np.array([-1.0, 3.0, 2.0, -2.0])
    values = np.stack([growth + 5.0j, growth - 5.0j, -4.0 + 0.0 * growth, 0.0 * growth], axis=1)
    locus = mb.RootLocus("speed", np.array([1.0, 2.0, 4.0, 5.0]), values, np.zeros((4, 1, 4)), ("a", "b", "c", "d"))
    np.testing.assert_array_equal(locus.stable(), [True, False, False, True])
    np.testing.assert_allclose(locus.boundaries(), [1.25, 4.5], rtol=1e-14)


def test_what_cannot_be_followed():
    system = two_masses()
    for model, name, values, options, message in (
        (system, "kk", [1.0, 2.0], {"state": mb.assemble}, "Unknown parameter 'kk'; did you mean 'k'"),
        (system, "k", [1.0, 2.0], {}, "needs the state of each system"),
        (system, "c", [1.0, 2.0], {"state": mb.assemble}, r"shape \(2,\)"),
        (system, "k", [1.0], {"state": mb.assemble}, "at least two finite numbers"),
        (3.0, "k", [1.0, 2.0], {}, "a compiled system, or a function"),
    ):
        with pytest.raises(ValueError, match=message):
            mb.root_locus(model, name, values, **options)
