"""Variants of a machine that reports compare: the motions that they say."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from reported_machines import udot

import jaxmb as mb
from jaxmb import parts, planar
from jaxmb.parts.fields import declarations
from jaxmb.report.variants import _unit, doubled, scaled_lengths, units


def test_lengths_are_scaled_by_dimension(pendulum):
    """The accelerations of the scaled machine are the same in units of its size."""
    system, state = pendulum
    assert units(system)["spring.stiffness"] == "N m/rad"
    expected = np.asarray(udot(system, state)) / np.asarray(system.velocity_scale())
    for factor in (1e-9, 1e6):
        scaled, start = scaled_lengths(system, state, factor)
        found = mb.parameters(scaled)
        np.testing.assert_allclose(found["rod.inertia"], 0.3 * factor**2, rtol=1e-14)
        np.testing.assert_allclose(found["spring.stiffness"], 3.0 * factor**2, rtol=1e-14)
        np.testing.assert_allclose(found["gravity.acceleration"], (0.0, -9.81 * factor), rtol=1e-14)
        own = np.asarray(udot(scaled, start)) / np.asarray(scaled.velocity_scale())
        np.testing.assert_allclose(own, expected, rtol=1e-12)


def test_lengths_in_functions_are_not_scaled():
    drive = planar.Driver("drive", "ground", "rod", quantity="x", motion=lambda t, p: 0.1 * t)
    system = mb.Scene([planar.Body("rod", mass=1.0, inertia=1.0)], joints=[drive]).compile()
    with pytest.raises(ValueError, match="units of drive"):
        scaled_lengths(system, system.guess, 2.0)


def stop(**own):
    return mb.JointStop("s", "a.angle", lower=0.0, upper=1.0, stiffness=1.0, **own)


ON_ANGLE, ON_BOTH = ("angle", "displacement"), ("angle", "angle", "displacement")


@pytest.mark.parametrize(
    "part, within, field, expected",
    [
        (mb.JointInertia("j", "a.angle", inertia=0.2), ("angle",), "inertia", "kg m²"),
        (mb.JointInertia("j", "a.displacement", inertia=0.2), ("displacement",), "inertia", "kg"),
        (mb.JointCoupling("j", "a.angle", "b.displacement", coefficients=(0.0, 1.0)), ON_ANGLE, "zero", "rad"),
        (mb.JointCoupling("j", "a.angle", "b.displacement", coefficients=(0.0, 1.0)), ON_ANGLE, "other_zero", "m"),
        (
            mb.JointCoupling("j", "a.angle", ("b", "c"), coefficients=[(0.0, 1.0)] * 2),
            ON_BOTH,
            "other_zero",
            "rad, m",
        ),
        (mb.Motor("m", "a.angle", command=1.0, lag=0.1), ("displacement",), "limit", "N"),
        (stop(), ("angle",), "stiffness", "N m/rad"),
        (stop(exponent=3.0), ("angle",), "stiffness", None),
        (stop(exponent=3.0), ("angle",), "upper", "rad"),
        (mb.FixedTendon("t", ("a.angle", "b"), coefficients=(1.0, 1.0)), ON_ANGLE, "coefficients", "m/rad, 1"),
        (mb.JointInertia("j", "a.stroke", inertia=0.2), ("stroke",), "inertia", None),
    ],
)
def test_units_by_the_coordinates_that_a_part_acts_on(part, within, field, expected):
    joints = {str(k): planar.PointOnLine("a", "ground", "rod", point=(0.0, 0.0)) for k in range(len(within))}
    own = part.with_fields(within=within, joints=joints)
    assert _unit(own, field, declarations(type(part))[field]) == expected


def test_units_of_the_library_are_known():
    """But for those that depend on other numbers, or on whether a coordinate is an angle."""
    classes, open_ends = [], [eqx.Module]
    while open_ends:
        classes += (more := open_ends.pop().__subclasses__())
        open_ends += more
    numbers = {
        (cls.__name__, name): declared.unit
        for cls in classes
        if cls.__module__.startswith("jaxmb.") and dataclasses.is_dataclass(cls)
        for name, declared in declarations(cls).items()
        if declared.kind == "number"
    }
    unknown = {own for own, unit in numbers.items() if unit is None}
    of_actuator = {("Actuator", name) for name in ("control", "gain", "bias", "control_range", "force_range")}
    of_bekker = {("Bekker", "cohesive_modulus"), ("Bekker", "frictional_modulus")}
    of_motor = {("Motor", "gain"), ("Motor", "command")}
    assert unknown == of_actuator | of_bekker | of_motor | {("JointCoupling", "coefficients")}


@pytest.mark.parametrize("unit", ["N m or N", "N/m^(n+1)", "", "Nm", "N  m"])
def test_units_are_read_when_a_class_is_made(unit):
    with pytest.raises(ValueError, match=r"in the unit .* write a unit as in 'N m/rad'"):
        parts.parameter(unit=unit)
    with pytest.raises(ValueError, match="in the unit"):
        parts.parameter(unit=("N m", unit))


class Rub(parts.AbstractForce):
    """A force of a user's own on a body, whose numbers have units that nothing chooses from, and none."""

    name: str = parts.name()
    body: str = parts.body_name()
    force: parts.Number = parts.parameter(unit=("N m", "N"), default=1.0)
    share: parts.Number = parts.parameter(default=0.5)

    def wrenches(self, space, poses, velocities, t):
        return jnp.zeros((1, space.velocity_size))


def test_units_of_a_part_of_a_user():
    system = mb.Scene([planar.Body("rod", mass=1.0, inertia=1.0)], forces=[Rub("rub", "rod")]).compile()
    assert units(system)["rub.force"] is units(system)["rub.share"] is None
    with pytest.raises(ValueError, match=r"units of rub\.force, rub\.share are not known"):
        scaled_lengths(system, system.guess, 2.0)


@pytest.mark.slow
def test_lengths_of_laws_of_contact_and_rotors_are_scaled_by_dimension():
    """A ball on elastic ground, and a rod with a rotor: the same accelerations in units of the system's size."""
    ball = planar.Body("ball", mass=1.0, inertia=0.1, position=(0.0, 0.099))
    rod = planar.Body("rod", mass=1.0, inertia=0.1, position=(0.6, 0.3))
    joints = [
        planar.Revolute("pin", "ground", "rod", point=(0.1, 0.3)),
        mb.JointInertia("rotor", "pin.angle", inertia=0.7),
    ]
    forces = [
        planar.Contact("touch", "ball", terrain=mb.terrain.Flat(), normal=mb.contact.Hertz(1e5), radius=0.1),
        mb.JointForce("motor", "pin.angle", force=2.0),
    ]
    system = mb.Scene([ball, rod], joints=joints, forces=forces).compile()
    assert units(system)["touch.normal.stiffness"] == "N/m^1.5"
    natural = lambda s, y: np.asarray(udot(s, y) / s.velocity_scale())
    expected = natural(system, system.guess)
    assert abs(expected[1]) > 1.0 and abs(expected[-1]) > 0.1
    for factor in (1e-3, 1e3):
        found = natural(*scaled_lengths(system, system.guess, factor))
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_doubled_joint_does_not_change_the_motion(pendulum):
    system, state = pendulum
    both = doubled(system, state)
    assert both.acceleration_rows == 4 and both.acceleration_rank == 2 and system.acceleration_rows == 2
    np.testing.assert_allclose(udot(both, state), udot(system, state), rtol=0, atol=1e-12)
