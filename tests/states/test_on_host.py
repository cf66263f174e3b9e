"""Consistent states found in NumPy, against those that programs of JAX find."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.states.closest import closest_configuration, closest_velocities
from jaxmb.system.instant import Instant

# With coordinates that may be held.
MACHINES = {
    "four_bar": ["crank.angle"],
    "slider_crank": ["crank.angle"],
    "parallelogram": ["left.angle"],
    "spatial_slider_crank": ["slider.x"],
    "double_wishbone": ["upright.z"],
    "heavy_top": ["top.z"],
}


def held_coordinates(system, names):
    held = np.zeros(system.nq, bool)
    for name in names:
        held[np.atleast_1d(system.coordinate_names()[name])] = True
    return held


@pytest.mark.slow
@pytest.mark.parametrize("holds", [False, True])
@pytest.mark.parametrize("name", MACHINES)
def test_closest_states_are_those_of_programs(name, holds):
    built = mb.mechanisms.get(name)
    system = built.system
    on_host = system.on_host(0.0)
    assert on_host is not None
    first = next(iter(system.coordinate_names()))
    names = [own if own in system.coordinate_names() else first for own in MACHINES[name]] if holds else []
    held = held_coordinates(system, names)
    for key in jax.random.split(jax.random.key(5), 3):
        guess = np.array(built.state.q + 0.03 * jax.random.normal(key, (system.nq,)))
        guess[held] = np.asarray(built.state.q)[held]
        expected, ok = closest_configuration(system, jnp.zeros(()), guess, tuple(held.tolist()), system.coordinate_rank)
        found = on_host.closest_configuration(guess, held, system.coordinate_rank)
        assert ok and found is not None
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
        u = np.array(jax.random.normal(key, (system.nu,)))
        none = np.zeros(system.nu, bool)
        expected, ok = closest_velocities(Instant(system, jnp.zeros(()), found, u), tuple(none.tolist()))
        rates = on_host.closest_velocities(found, u, none, system.velocity_rank)
        assert ok and rates is not None
        np.testing.assert_allclose(rates, expected, rtol=0, atol=1e-11)


def pinned_bar(**more):
    bar = planar.Body("bar", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))
    return [bar], [pin, *more.pop("joints", ())], [mb.Gravity((0.0, -9.81)), *more.pop("forces", ())]


def driven():
    drive = planar.Driver("drive", "ground", "bar", quantity="angle", motion=lambda t, p: 0.4 * t**2)
    bodies, joints, forces = pinned_bar(joints=[drive])
    return mb.Scene(bodies, joints=joints, forces=forces).compile()


def stopped():
    bodies, joints, forces = pinned_bar(joints=[mb.Stop("stop", "pin.angle", lower=-0.5)])
    return mb.Scene(bodies, joints=joints, forces=forces).compile()


def screwed():
    nut = spatial.Body("nut", mass=1.0, inertia=spatial.box(1.0, 0.1, 0.2, 0.3), position=(0.0, 0.0, 0.3))
    axis = (0.0, 0.0, 1.0)
    screw = spatial.Screw("screw", "ground", "nut", point=(0.0, 0.0, 0.0), axis=axis, pitch=0.1)
    return mb.Scene([nut], joints=[screw]).compile()


def rolling():
    disc = spatial.Body("disc", mass=1.0, inertia=spatial.box(1.0, 0.2, 0.1, 0.2), position=(0.0, 0.0, 0.3))
    plane = spatial.RollingDisc("plane", "disc", radius=0.3, axis=(0.0, 1.0, 0.0))
    return mb.Scene([disc], joints=[plane]).compile()


def of_a_lagrangian():
    ring = mb.lagrangian.Holonomic("ring", lambda t, q, p: jnp.array([q @ q - (1.0 + 0.1 * t) ** 2]))
    blade = mb.lagrangian.Pfaffian("blade", lambda t, q, p: jnp.array([[0.0, -jnp.sin(q[2]), jnp.cos(q[2])]]))
    kinetic = lambda t, q, v, p: 0.5 * v @ v
    return mb.lagrangian.LagrangianSystem(kinetic=kinetic, constraints=[ring, blade], q=[0.6, 0.7, 0.2])


LONG = [pytest.param(make, marks=pytest.mark.slow) for make in (screwed, rolling, of_a_lagrangian)]


@pytest.mark.slow
@pytest.mark.parametrize("make", [driven, stopped, *LONG])
def test_states_of_any_constraints_are_those_of_programs(make):
    system, t, key = make(), jnp.asarray(0.3), jax.random.key(7)
    none, still = np.zeros(system.nq, bool), np.zeros(system.nu, bool)
    if not system.contacts:
        guess = np.array(system.guess.q + 0.03 * jax.random.normal(key, (system.nq,)))
    else:
        guess = np.array(system.guess.q)
        guess[:3] += 0.03
    u = np.array(jax.random.normal(key, (system.nu,)))
    on_host = system.on_host(t)
    expected, ok = closest_configuration(system, t, guess, tuple(none.tolist()), system.coordinate_rank)
    found = on_host.closest_configuration(guess, none, system.coordinate_rank)
    assert ok and found is not None
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    expected, ok = closest_velocities(Instant(system, t, found, u), tuple(still.tolist()))
    rates = on_host.closest_velocities(found, u, still, system.velocity_rank)
    assert ok and rates is not None
    np.testing.assert_allclose(rates, expected, rtol=0, atol=1e-11)


@pytest.mark.slow
def test_coordinates_that_cannot_be_held_together_are_left_to_programs():
    system = mb.mechanisms.get("four_bar").system
    held = held_coordinates(system, ["crank.angle", "rocker.angle"])
    assert system.on_host(0.0).closest_configuration(np.array(system.guess.q), held, system.coordinate_rank) is None
    with pytest.raises(ValueError, match=r"crank\.angle"):
        mb.assemble(system, fix={"crank.angle": 0.3, "rocker.angle": 0.1})


def hinge(turn, **more):
    arm = spatial.Body("arm", mass=1.0, inertia=spatial.box(1.0, 1.0, 0.1, 0.1), orientation=turn)
    axes = {"axis_a": (0.0, 0.0, 1.0), "axis_b": (0.0, 0.0, 1.0), "x_a": (1.0, 0.0, 0.0), "x_b": (1.0, 0.0, 0.0)}
    points = {"point_a": (0.0, 0.0, 0.0), "point_b": (-0.5, 0.0, 0.0)}
    return mb.Scene([arm], joints=[spatial.Revolute("hinge", "ground", "arm", **points, **axes)])


@pytest.mark.slow
def test_a_joint_that_is_half_a_turn_off_is_turned_back():
    over = mb.rotations.from_axis_angle(np.array([1.0, 0.0, 0.0]), np.pi - 0.01)
    system = hinge(over).compile()
    upside_down = np.array([0.5, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    assert np.max(np.abs(system.on_host(0.0).coordinate_residual(upside_down))) < 1e-15
    assert not system.on_host(0.0).holds(upside_down)
    state = mb.assemble(system)
    axis = mb.rotations.rotate(state.q[3:], jnp.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(axis, [0.0, 0.0, 1.0], atol=1e-10)


@pytest.mark.slow
def test_a_slide_that_is_half_a_turn_off_is_turned_back():
    block = planar.Body("block", mass=1.0, inertia=0.1, position=(0.3, 0.0), angle=3.0)
    slide = planar.Prismatic(
        "slide", "ground", "block", point_a=(0.0, 0.0), point_b=(0.0, 0.0), axis_a=(1.0, 0.0), angle=0.0
    )
    state = mb.assemble(mb.Scene([block], joints=[slide]).compile())
    np.testing.assert_allclose(state.q[2], 0.0, atol=1e-12)


@pytest.mark.slow
def test_within_a_program_of_the_users():
    system = mb.mechanisms.get("four_bar").system
    outside = mb.assemble(system, fix={"crank.angle": 1.2}, rates={"crank.angle": 2.0})
    inside = jax.jit(lambda x: (x, mb.assemble(system, fix={"crank.angle": 1.2}, rates={"crank.angle": 2.0})))(1.0)[1]
    np.testing.assert_allclose(inside.q, outside.q, atol=1e-12)
    np.testing.assert_allclose(inside.u, outside.u, atol=1e-12)


def test_other_constraints_within_a_program_of_the_users():
    system = driven()
    outside = mb.assemble(system, t=0.5)
    inside = jax.jit(lambda x: (x, mb.assemble(system, t=0.5)))(1.0)[1]
    np.testing.assert_allclose(inside.q, outside.q, atol=1e-12)
    np.testing.assert_allclose(inside.u, outside.u, atol=1e-12)
    np.testing.assert_allclose(outside.u[2], 0.4, atol=1e-12)


def hanging(spring):
    bodies, joints, forces = pinned_bar(forces=spring)
    rope = planar.Body("rope", mass=0.5, inertia=0.05, position=(1.5, 0.0))
    joints.append(planar.Revolute("knee", "bar", "rope", point=(1.0, 0.0)))
    return mb.Scene([*bodies, rope], joints=joints, forces=forces).compile()


def hanging_in_space():
    names, inertia = {"bar": 0.5, "rope": 1.5}, spatial.box(1.0, 1.0, 0.1, 0.1)
    bodies = [spatial.Body(name, mass=1.0, inertia=inertia, position=(x, 0.0, 0.0)) for name, x in names.items()]
    joints = [spatial.Revolute("pin", "ground", "bar", point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))]
    joints.append(spatial.Revolute("knee", "bar", "rope", point=(1.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0)))
    return mb.Scene(bodies, joints=joints, forces=[mb.Gravity((0.0, 0.0, -9.81))]).compile()


@pytest.mark.slow
def test_an_equilibrium_is_that_of_a_program():
    spring = planar.SpringDamper("spring", "ground", "bar", stiffness=20.0, point_a=(1.0, 1.0), point_b=(0.4, 0.0))
    system = hanging([spring])
    for fix in ({}, {"bar.angle": 0.2}):
        outside = mb.equilibrium(system, fix=fix)
        inside = jax.jit(lambda q, fix=fix: mb.equilibrium(system, mb.State(q, system.guess.u), fix=fix))(
            system.guess.q
        )
        np.testing.assert_allclose(outside.q, inside.q, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_an_equilibrium_in_space_is_that_of_a_program():
    system = hanging_in_space()
    outside = mb.equilibrium(system)
    inside = jax.jit(lambda q: mb.equilibrium(system, mb.State(q, system.guess.u)))(system.guess.q)
    np.testing.assert_allclose(outside.q, inside.q, rtol=0, atol=1e-9)
    np.testing.assert_allclose(outside.q[9], -1.5, atol=1e-9)


def test_scenes_without_constraints_have_no_such_form():
    bar = planar.Body("bar", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))
    assert mb.Scene([bar], joints=[pin]).compile().on_host(0.0) is not None
    assert mb.Scene([bar]).compile().on_host(0.0) is None
