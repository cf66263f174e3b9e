"""Distances of states: full turns and both signs of Euler parameters are one place."""

import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.studies.constraint_branches import distance, signs_like

MOST_PROGRAMS = 20


def test_distance_ignores_full_turns_of_a_body_in_the_plane():
    system = mb.Scene([planar.Body("bar", mass=1.0, inertia=0.1)]).compile()
    q = np.array([0.3, -0.2, 1.1])
    assert distance(system, q + np.array([0.0, 0.0, 4 * np.pi]), q) < 1e-12
    for change in np.eye(3):
        assert distance(system, q + 0.5 * change, q) == pytest.approx(0.5 / system.coordinate_scale()[change > 0][0])


def test_distance_ignores_the_sign_of_euler_parameters():
    system = mb.Scene([spatial.Body("ball", mass=1.0, inertia=np.ones(3))]).compile()
    q = np.array([0.3, -0.2, 1.1, 0.5, -0.5, 0.5, -0.5])
    turned = np.where(np.arange(7) < 3, q, -q)
    assert distance(system, turned, q) == 0.0
    np.testing.assert_array_equal(signs_like(system, turned, q), [1, 1, 1, -1, -1, -1, -1])
    assert distance(system, np.where(np.arange(7) < 3, -q, q), q) > 0.1
