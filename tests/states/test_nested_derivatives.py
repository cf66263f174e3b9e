"""Derivatives of derivatives of an equilibrium, outside of `jit`: of several orders by one parameter, or of first order
by each of several.
"""

import jax
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar

G = 9.81


@pytest.mark.slow
def test_equilibrium_has_mixed_second_derivatives():
    """A pendulum on a spring: k angle = −m g l cos(angle)."""
    bob = planar.Body("bob", mass=2.0, inertia=0.1, position=(0.0, -1.0), angle=-np.pi / 2)
    pin = planar.Revolute("pin", "ground", "bob", point=(0.0, 0.0))
    spring = planar.TorsionalSpringDamper("spring", "ground", "bob", stiffness=5.0, free_angle=0.0)
    system = mb.Scene([bob], joints=[pin], forces=[spring, mb.Gravity((0.0, -G))]).compile()

    def angle(stiffness, mass):
        return mb.equilibrium(mb.with_parameters(system, {"spring.stiffness": stiffness, "bob.mass": mass})).q[2]

    def slope(stiffness, mass=2.0):
        at = -1.2
        for _ in range(50):
            at -= (stiffness * at + mass * G * np.cos(at)) / (stiffness - mass * G * np.sin(at))
        return -G * np.cos(at) / (stiffness - mass * G * np.sin(at))

    near, far = ((slope(5.0 + h) - slope(5.0 - h)) / (2 * h) for h in (1e-3, 2e-3))
    found = jax.grad(lambda stiffness: jax.grad(angle, 1)(stiffness, 2.0))(5.0)
    np.testing.assert_allclose(found, (4 * near - far) / 3, rtol=1e-8)
