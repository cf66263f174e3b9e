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
    "parallelogram": [],
    "spatial_slider_crank": ["slider.x"],
    "double_wishbone": ["upright.z"],
    "heavy_top": ["top.z"],
}


def held_coordinates(system, names):
    held = np.zeros(system.nq, bool)
    for name in names:
        held[np.atleast_1d(system.coordinate_names()[name])] = True
    return held


def check(system, t, guess, u, held):
    """The closest configuration and velocities are those of programs; False if they are left to these."""
    on_host, none = system.on_host(t), np.zeros(system.nu, bool)
    expected, ok = closest_configuration(system, t, guess, tuple(held.tolist()), system.coordinate_rank)
    found = on_host.closest_configuration(guess, held, system.coordinate_rank)
    assert ok
    if found is None:
        return False
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    expected, ok = closest_velocities(Instant(system, t, found, u), tuple(none.tolist()))
    rates = on_host.closest_velocities(found, u, none, system.velocity_rank)
    assert ok and rates is not None
    np.testing.assert_allclose(rates, expected, rtol=0, atol=1e-11)
    return True


@pytest.mark.slow
@pytest.mark.parametrize("name", MACHINES)
def test_on_host_closest_states_are_those_of_programs(name):
    built = mb.mechanisms.get(name)
    system, random, found = built.system, np.random.default_rng(5), []
    for names in ([], MACHINES[name]):
        held = held_coordinates(system, names)
        for _ in range(3):
            q = np.asarray(built.state.q)
            guess = np.where(held, q, q + 0.03 * random.normal(size=system.nq))
            found.append(check(system, jnp.zeros(()), guess, random.normal(size=system.nu), held))
    # With redundant rows some guesses are left to programs.
    assert all(found) or (system.implied and any(found))


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


@pytest.mark.slow
@pytest.mark.parametrize("make", [driven, stopped, screwed, rolling, of_a_lagrangian])
def test_on_host_states_of_any_constraints_are_those_of_programs(make):
    system, random = make(), np.random.default_rng(7)
    guess = np.array(system.guess.q)
    guess[: 3 if system.contacts else None] += 0.03 * random.normal(size=3 if system.contacts else system.nq)
    assert check(system, jnp.asarray(0.3), guess, random.normal(size=system.nu), np.zeros(system.nq, bool))


@pytest.mark.slow
def test_on_host_leaves_coordinates_that_cannot_be_held_to_programs():
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
def test_on_host_joint_that_is_half_a_turn_off_is_turned_back():
    over = mb.rotations.from_axis_angle(np.array([1.0, 0.0, 0.0]), np.pi - 0.01)
    system = hinge(over).compile()
    upside_down = np.array([0.5, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    assert np.max(np.abs(system.on_host(0.0).coordinate_residual(upside_down))) < 1e-15
    assert not system.on_host(0.0).holds(upside_down)
    state = mb.assemble(system)
    axis = mb.rotations.rotate(state.q[3:], jnp.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(axis, [0.0, 0.0, 1.0], atol=1e-10)


@pytest.mark.slow
def test_on_host_slide_that_is_half_a_turn_off_is_turned_back():
    block = planar.Body("block", mass=1.0, inertia=0.1, position=(0.3, 0.0), angle=3.0)
    slide = planar.Prismatic(
        "slide", "ground", "block", point_a=(0.0, 0.0), point_b=(0.0, 0.0), axis_a=(1.0, 0.0), angle=0.0
    )
    state = mb.assemble(mb.Scene([block], joints=[slide]).compile())
    np.testing.assert_allclose(state.q[2], 0.0, atol=1e-12)


@pytest.mark.slow
def test_on_host_within_a_program_of_the_users():
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
def test_on_host_equilibrium_is_that_of_a_program():
    spring = planar.SpringDamper("spring", "ground", "bar", stiffness=20.0, point_a=(1.0, 1.0), point_b=(0.4, 0.0))
    system = hanging([spring])
    for fix in ({}, {"bar.angle": 0.2}):
        outside = mb.equilibrium(system, fix=fix)
        inside = jax.jit(lambda q, fix=fix: mb.equilibrium(system, mb.State(q, system.guess.u), fix=fix))(
            system.guess.q
        )
        np.testing.assert_allclose(outside.q, inside.q, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_on_host_equilibrium_in_space_is_that_of_a_program():
    system = hanging_in_space()
    outside = mb.equilibrium(system)
    inside = jax.jit(lambda q: mb.equilibrium(system, mb.State(q, system.guess.u)))(system.guess.q)
    np.testing.assert_allclose(outside.q, inside.q, rtol=0, atol=1e-9)
    np.testing.assert_allclose(outside.q[9], -1.5, atol=1e-9)


def test_on_host_is_none_without_constraints():
    bar = planar.Body("bar", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))
    assert mb.Scene([bar], joints=[pin]).compile().on_host(0.0) is not None
    assert mb.Scene([bar]).compile().on_host(0.0) is None
