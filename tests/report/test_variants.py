"""Variants of a machine that reports compare: the motions that they say."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar
from jaxmb.report.variants import doubled, in_time, nonholonomic, scaled_lengths, units, with_damper


@eqx.filter_jit
def udot(system, y):
    """Accelerations at t = 0."""
    return mb.formulations.accelerations(system, mb.formulations.Multipliers(), jnp.zeros(()), y.q, y.u)[0]


@pytest.mark.parametrize("factor", [1e-9, 1e6])
def test_lengths_are_scaled_by_dimension(pendulum, factor):
    """The accelerations of the scaled machine are the same in units of its size."""
    system, state = pendulum
    assert units(system)["spring.stiffness"] == "N m/rad"
    scaled, start = scaled_lengths(system, state, factor)
    found = mb.parameters(scaled)
    np.testing.assert_allclose(found["rod.inertia"], 0.3 * factor**2, rtol=1e-14)
    np.testing.assert_allclose(found["spring.stiffness"], 3.0 * factor**2, rtol=1e-14)
    np.testing.assert_allclose(found["gravity.acceleration"], (0.0, -9.81 * factor), rtol=1e-14)
    np.testing.assert_allclose(
        udot(scaled, start) / scaled.velocity_scale(), udot(system, state) / system.velocity_scale(), rtol=1e-12
    )


def test_lengths_in_functions_are_not_scaled():
    drive = planar.Driver("drive", "ground", "rod", quantity="x", motion=lambda t, p: 0.1 * t)
    system = mb.Scene([planar.Body("rod", mass=1.0, inertia=1.0)], joints=[drive]).compile()
    with pytest.raises(ValueError, match="units of drive"):
        scaled_lengths(system, system.guess, 2.0)


def test_numbers_on_a_joint_have_the_units_of_its_coordinate():
    """A spring on a slide and a motor on a hinge: the same accelerations in units of the system's size."""
    cart = planar.Body("cart", mass=5.0, inertia=0.5, position=(0.1, 0.0))
    rod = planar.Body("rod", mass=1.0, inertia=0.1, position=(0.6, 0.0))
    joints = [
        planar.Prismatic("rail", "ground", "cart", point=(0.0, 0.0), axis=(1.0, 0.0)),
        planar.Revolute("pin", "cart", "rod", point=(0.1, 0.0)),
    ]
    forces = [
        mb.JointSpring("spring", "rail.displacement", stiffness=200.0, damping=1.0, free=0.3),
        mb.JointForce("motor", "pin.angle", force=2.0),
    ]
    system = mb.Scene([cart, rod], joints=joints, forces=forces).compile()
    scaled, start = scaled_lengths(system, system.guess, 1e3)
    size = jnp.array([1e3, 1e3, 1.0] * 2)
    np.testing.assert_allclose(udot(scaled, start), size * udot(system, system.guess), rtol=1e-9, atol=1e-9)


def test_variants_do_not_change_the_motion(pendulum):
    system, state = pendulum
    both = doubled(system, state)
    assert both.acceleration_rows == 4 and both.acceleration_rank == 2 and system.acceleration_rows == 2
    driven, rolling = in_time(system, state), nonholonomic(system, state)
    assert system.drift_free and not driven.drift_free
    assert rolling.velocity_rows == 4 and rolling.position_rows == 2 and rolling.velocity_rank == 2
    for variant in (both, driven, rolling, with_damper(system, state)):
        np.testing.assert_allclose(udot(variant, state), udot(system, state), rtol=0, atol=1e-12)
