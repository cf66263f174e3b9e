"""Joints close as they were meant: with axes that point the same way, and in their thread."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.linalg.rotations import multiply, rotate

UP = np.array([0.0, 0.0, 1.0])
PITCH = 0.1


def turn(axis, angle):
    axis = np.asarray(axis) / np.linalg.norm(axis)
    return np.append(np.cos(angle / 2), np.sin(angle / 2) * axis)


def body(orientation=(1.0, 0.0, 0.0, 0.0), position=(0.3, 0.1, 0.2)):
    return spatial.Body("body", mass=1.0, inertia=(0.1, 0.2, 0.25), position=position, orientation=orientation)


JOINTS = {
    "Revolute": spatial.Revolute,
    "Cylindrical": spatial.Cylindrical,
    "Planar": spatial.Planar,
    "Screw": functools.partial(spatial.Screw, pitch=PITCH),
}


def scene(kind, orientation=(1.0, 0.0, 0.0, 0.0), **own):
    own = {"point_a": (0.1, 0.0, 0.0), "point_b": (-0.3, 0.0, 0.0), "axis_a": UP, "axis_b": UP} | own
    return mb.Scene([body(orientation)], joints=[JOINTS[kind]("joint", "ground", "body", **own)])


@functools.cache
def compiled(kind):
    return scene(kind).compile()


@eqx.filter_jit
def closed(system, guesses):
    """The configurations that are closest to guesses of the pose."""
    rest = jnp.zeros(system.nu)
    return jax.vmap(lambda q: mb.assemble(system, mb.State(q, rest), throw=False).q)(guesses)


@pytest.mark.slow
@pytest.mark.parametrize("kind", JOINTS)
def test_joint_axes_close_the_same_way_from_guesses_tilted_past_a_right_angle(kind):
    tilts = [(angle, axis) for angle in (80, 100, 140, 170, 179.9) for axis in ((1.0, 0.0, 0.0), (1.0, 2.0, 0.0))]
    guesses = np.stack([np.append([0.3, 0.1, 0.2], turn(axis, np.deg2rad(angle))) for angle, axis in tilts])
    q = closed(compiled(kind), jnp.asarray(guesses))
    axes = jax.vmap(lambda p: rotate(p, UP))(q[:, 3:])
    np.testing.assert_allclose(axes, np.tile(UP, (len(tilts), 1)), rtol=0, atol=1e-10)


@pytest.mark.slow
def test_screw_closes_in_its_thread():
    x = np.array([1.0, 0.0, 0.0])
    system = scene("Screw", point_a=(0.0, 0.0, 0.0), point_b=(0.0, 0.0, 0.0), offset=0.0, x_a=x, x_b=x).compile()
    off = np.deg2rad([0.0, 20.0, 90.0, 100.0, 178.0, 180.0, 182.0, 260.0, 300.0, 340.0])
    guesses = [np.append([0.0, 0.0, 0.02], multiply(turn(UP, a), turn(UP, 0.4 * np.pi))) for a in off]
    q = closed(system, jnp.asarray(guesses))
    heading, theta = jax.vmap(lambda p: rotate(p, x))(q[:, 3:]), 2 * np.pi * q[:, 2] / PITCH
    np.testing.assert_allclose(heading[:, :2], np.stack([np.cos(theta), np.sin(theta)], 1), rtol=0, atol=1e-9)


@pytest.mark.slow
def test_scene_is_compiled_where_its_axes_agree():
    tilt = turn((1.0, 0.0, 0.0), np.deg2rad(100))
    system = scene("Revolute", tilt, point_a=(0.3, 0.1, 0.2), point_b=(0.0, 0.0, 0.0)).compile()
    state = mb.assemble(system)
    # The shortest turn that makes the axes parallel leads to the angle zero.
    np.testing.assert_allclose(state.q[3:], [1.0, 0.0, 0.0, 0.0], rtol=0, atol=1e-9)
    angle = system.joint_coordinates()["joint.angle"]
    np.testing.assert_allclose(system.catalogue.joint_coordinate(angle, 0.0, state.q), 0.0, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_assembly_derivatives_from_a_tilted_guess():
    tilt, point = turn((1.0, 0.0, 0.0), np.deg2rad(100)), np.array([0.1, 0.0, 0.0])
    system = scene("Revolute", tilt, point_a=(0.3, 0.1, 0.2), point_b=(0.0, 0.0, 0.0)).compile()

    def pose(x):
        return mb.assemble(mb.with_parameters(system, {"joint.point_b": x}), throw=False).q

    pose, at, along, h = jax.jit(pose), jnp.asarray(point), np.array([0.3, 1.0, -0.5]), 1e-5
    forward = jax.jvp(pose, (at,), (along,))[1]
    (reverse,) = jax.vjp(pose, at)[1](jnp.ones(7))
    central = (pose(at + h * along) - pose(at - h * along)) / (2 * h)
    np.testing.assert_allclose(forward, central, rtol=0, atol=1e-8)
    np.testing.assert_allclose(jnp.sum(forward), reverse @ along, rtol=1e-12)


@pytest.mark.slow
def test_joint_axes_against_each_other_are_refused():
    system = compiled("Revolute")
    for angle in (np.pi, np.deg2rad(179.999), np.deg2rad(160)):
        p = turn((1.0, 2.0, 0.0), angle)
        q = jnp.append(jnp.array([0.1, 0.0, 0.0]) - rotate(jnp.asarray(p), jnp.array([-0.3, 0.0, 0.0])), p)
        opposed = mb.State(q, jnp.zeros(6))
        with pytest.raises(ValueError, match=r"violates the constraints joint \("):
            mb.simulate(system, opposed, t1=0.1)
    # Where the attitude is held there is no other one.
    held = {f"body.e{k}": value for k, value in enumerate(p)}
    with pytest.raises(ValueError, match=r"residuals \[m, rad\] remain in joint \("):
        mb.assemble(system, opposed, fix=held)


@pytest.mark.slow
def test_driver_of_an_angle_is_met_and_not_its_opposite():
    hinge = spatial.Revolute("joint", "ground", "body", point=(0.0, 0.0, 0.0), axis=UP)
    x = {"axis_a": UP, "x_a": (1.0, 0.0, 0.0), "x_b": (1.0, 0.0, 0.0)}
    drive = spatial.Driver("drive", "ground", "body", quantity="angle", motion=lambda t, p: 2.0 + t, **x)
    system = mb.Scene([body()], joints=[hinge, drive]).compile()
    state = mb.assemble(system)
    heading = rotate(state.q[3:], jnp.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(heading[:2], [np.cos(2.0), np.sin(2.0)], rtol=0, atol=1e-10)


def test_assembly_of_known_numbers_within_a_trace():
    """A scene that is known is assembled in a function that JAX traces as outside of it."""
    system = mb.mechanisms.four_bar().system
    expected = mb.assemble(system).q
    np.testing.assert_allclose(jax.jit(lambda x: x * mb.assemble(system).q)(1.0), expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(jax.jacfwd(lambda x: x * mb.assemble(system).q)(1.0), expected, rtol=0, atol=1e-12)


def test_assembly_of_velocities_that_contradict_a_joint_are_told():
    """A bar turns about a pin, and its centre, whose velocity was not given, does not."""
    bar = planar.Body("bar", mass=1.0, inertia=0.1, position=(0.5, 0.0), angular_velocity=2.0)
    pin = planar.Revolute("pin", "ground", "bar", point_a=(0.0, 0.0), point_b=(-0.5, 0.0))
    system = mb.Scene([bar], joints=[pin]).compile()
    told = r"bar\.angular_velocity is 1 instead of 2\. assemble\(system, rates=\{'bar\.angular_velocity': …\}\)"
    with pytest.warns(UserWarning, match=told):
        mb.assemble(system)
    # It is prescribed by the name that it has in space as well, and that is no contradiction.
    state = mb.assemble(system, rates={"bar.angular_velocity": 2.0})
    np.testing.assert_allclose(state.u, [0.0, 1.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(mb.assemble(system, state).u, state.u)
    with pytest.raises(ValueError, match=r"'bar\.angle' is prescribed twice"):
        mb.assemble(system, rates={"bar.angular_velocity": 2.0, "bar.angle": 1.0})


@functools.cache
def bar():
    """A bar on a pin, whose centre moves on a circle of half a metre."""
    angle = np.arctan2(0.3, 0.4)
    own = planar.Body("bar", mass=1.0, inertia=planar.rod(1.0, 1.0), position=(0.4, 0.3), angle=angle)
    pin = planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))
    return mb.Scene([own], joints=[pin], forces=[mb.Gravity((0.0, -9.81))]).compile()


def placed(x):
    return mb.assemble(bar(), fix={"bar.x": x}).q[1]


def moving(speed):
    """At an angle of zero the centre has no speed along the bar."""
    return mb.assemble(bar(), fix={"bar.angle": 0.0}, rates={"bar.x": speed}).u[1]


def balanced(x):
    return mb.equilibrium(bar(), fix={"bar.x": x}).q[1]


def loaded(torque):
    """No angle balances a torque above that of gravity."""
    held = mb.Scene(
        [planar.Body("bar", mass=1.0, inertia=planar.rod(1.0, 1.0), position=(0.5, 0.0))],
        joints=[planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))],
        forces=[mb.Gravity((0.0, -9.81)), planar.Torque("motor", "bar", torque=0.0)],
    ).compile()
    return mb.equilibrium(mb.with_parameters(held, {"motor.torque": torque}), stable=False).q[2]


def linearised(x):
    state = mb.assemble(bar())
    moved = mb.State(state.q.at[0].add(x), state.u)
    return mb.linearise(bar(), moved).A[0, 0]


FAILURES = {
    "fixed": (placed, 3.0),
    "rates": (moving, 1.0),
    "equilibrium": (balanced, 3.0),
    "torque": (loaded, 100.0),
    "linearise": (linearised, 0.1),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", FAILURES)
def test_assembly_that_fails_has_derivatives_that_are_not_numbers(case):
    """An error where a value is asked for, and NaN in every kind of derivative, also outside of `jit`."""
    function, wrong = FAILURES[case]
    with pytest.raises(ValueError):
        function(wrong)
    assert jnp.isnan(jax.grad(function)(wrong))
    value, slope = jax.jvp(function, (wrong,), (1.0,))
    assert jnp.isnan(value) and jnp.isnan(slope)
    assert jnp.all(jnp.isnan(jax.vmap(jax.grad(function))(jnp.full(2, wrong))))


@pytest.mark.slow
def test_assembly_that_succeeds_has_derivatives():
    """The slope of a circle; with `throw` a failure is an error in a derivative as well."""
    for derivative in (jax.grad(placed), jax.jit(jax.grad(placed))):
        np.testing.assert_allclose(derivative(0.3), -0.75, rtol=1e-9)
    with pytest.raises(RuntimeError, match="cannot be assembled"):
        jax.grad(lambda x: mb.assemble(bar(), fix={"bar.x": x}, throw=True).q[1])(3.0)


@pytest.mark.slow
def test_assembly_that_fails_before_a_motion_has_no_gradient():
    angle = lambda x: mb.simulate(bar(), mb.assemble(bar(), fix={"bar.x": x}), t1=0.1)["bar"].angle[-1]
    assert jnp.isnan(jax.grad(angle)(3.0)) and jnp.isnan(jax.jit(jax.grad(angle))(3.0))
    assert jnp.isfinite(jax.grad(angle)(0.3))
