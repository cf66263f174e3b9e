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


def test_what_cannot_be_followed():
    system = two_masses()
    with pytest.raises(ValueError, match="Unknown parameter 'kk'; did you mean 'k'"):
        mb.root_locus(system, "kk", [1.0, 2.0], state=mb.assemble)
    with pytest.raises(ValueError, match="needs the state of each system"):
        mb.root_locus(system, "k", [1.0, 2.0])
    with pytest.raises(ValueError, match="shape \\(2,\\)"):
        mb.root_locus(system, "c", [1.0, 2.0], state=mb.assemble)
    with pytest.raises(ValueError, match="at least two finite numbers"):
        mb.root_locus(system, "k", [1.0], state=mb.assemble)
    with pytest.raises(ValueError, match="a compiled system, or a function"):
        mb.root_locus(3.0, "k", [1.0, 2.0])
