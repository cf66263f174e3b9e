"""Numbers that no scene would be compiled with, and times at which nothing can be simulated."""

import re

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.parts import fields

SIZE = (0.1, 0.2, 0.25)


@pytest.fixture(scope="module")
def rod():
    """A rod of 2 m on a pin at the origin, with a stop and a servo-driven second rod."""
    bodies = [
        planar.Body("rod", mass=3.0, inertia=1.0, position=(1.0, 0.0)),
        planar.Body("other", mass=1.0, inertia=1.0, position=(5.0, 0.0)),
    ]
    program = planar.Driver(
        "drive", "ground", "other", quantity="angle", motion=lambda t, p: p["w"] * t, parameters={"w": 1.0}
    )
    joints = [planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0)), mb.Servo(program, 1.0, 1.0)]
    stop = mb.JointStop("stop", "pin.angle", stiffness=1.0, lower=-1.0, upper=1.0)
    return mb.Scene(bodies, joints=joints, forces=[mb.Gravity((0.0, -9.81)), stop]).compile()


@pytest.fixture(scope="module")
def top():
    body = spatial.Body("top", mass=1.0, inertia=SIZE)
    hinge = spatial.Revolute("hinge", "ground", "top", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    return mb.Scene([body], joints=[hinge]).compile()


PLANAR = {
    "negative mass": ({"rod.mass": -1.0}, "Body 'rod': mass must be positive, got -1.0"),
    "no mass": ({"other.mass": 0.0}, "Body 'other': mass must be positive"),
    "NaN": ({"rod.inertia": np.nan}, "Body 'rod': inertia must be finite"),
    "endless gravity": ({"gravity.acceleration": [0.0, -np.inf]}, "Gravity 'gravity': acceleration must be finite"),
    "negative gain": ({"drive.damping": -1.0}, "Servo 'drive': damping must be non-negative"),
    "number of a user's function": ({"drive.w": np.nan}, "Servo 'drive': program.w must be finite"),
    "limits in the wrong order": ({"stop.lower": 2.0}, "JointStop 'stop': lower must be less than upper"),
}
SPATIAL = {
    "flat body": ({"top.inertia": np.diag([1.0, 1.0, 3.0])}, "Body 'top': inertia violates the triangle inequality"),
    "negative moment": ({"top.inertia": np.diag([1.0, 1.0, -1.0])}, "Body 'top': inertia must be positive definite"),
    "direction of no unit length": (
        {"hinge.axis_a": [0.0, 0.0, 2.0]},
        "Revolute 'hinge': axis_a must be a unit vector",
    ),
}


@pytest.mark.parametrize("case", PLANAR | SPATIAL)
def test_with_parameters_refuses_what_compile_refuses(rod, top, case):
    values, message = (PLANAR | SPATIAL)[case]
    with pytest.raises(ValueError, match=message):
        mb.with_parameters(rod if case in PLANAR else top, values)


def test_both_limits_may_be_moved_at_once(rod):
    assert mb.parameters(mb.with_parameters(rod, {"stop.lower": 2.0, "stop.upper": 3.0}))["stop.lower"] == 2.0


@pytest.mark.slow
def test_a_traced_number_out_of_range_is_the_result(rod):
    start, names = mb.assemble(rod), ("rod.mass", "rod.inertia", "stop.smoothing")

    def end(values):
        changed = mb.with_parameters(rod, dict(zip(names, values, strict=True)))
        motion = mb.simulate(changed, start, t1=0.1, max_steps=64, throw=False)
        return motion.ys.q[-1], motion.stats["num_steps"], motion.result == mb.RESULTS.invalid_parameters

    members = jnp.array([[1.0, 1.0, 1.0], [-1.0, 1.0, 1.0], [1.0, np.nan, 1.0], [1.0, 1.0, 0.0]])
    q, steps, invalid = map(np.asarray, jax.jit(jax.vmap(end))(members))
    np.testing.assert_array_equal(invalid, [False, True, True, True])
    np.testing.assert_array_equal(np.isnan(q).all(axis=1), invalid)
    assert steps[0] > 0 and np.all(steps[1:] == 0)


def test_traced_moments_of_inertia_are_positive_definite(top):
    inside = jax.jit(lambda inertia: mb.with_parameters(top, {"top.inertia": inertia}).parameter_table.in_range())
    assert inside(np.diag(SIZE))
    assert not inside(np.diag([1.0, 1.0, -1.0]))
    assert not inside(np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))
    assert mb.with_parameters(top, {"top.inertia": np.diag(SIZE)}).parameter_table.in_range() is True


TIMES = {
    "after the end": ({"saveat": [0.5, 2.0]}, "saveat must lie between t0 = 0 and t1 = 1, got times from 0.5 to 2"),
    "before the start": ({"saveat": diffrax.SaveAt(ts=[-0.5, 0.5])}, "saveat must lie between t0 = 0 and t1 = 1"),
    "of a run back": ({"t1": -1.0, "saveat": [0.0, 0.5]}, "saveat must lie between t0 = 0 and t1 = -1"),
    "back and forth": ({"saveat": [0.5, 0.2]}, "saveat must run from t0 to t1 without turning back"),
    "against a run back": ({"t1": -1.0, "saveat": [-0.5, -0.2]}, "saveat must run from t0 to t1"),
}


def test_times_to_save_at(rod):
    for changes, message in TIMES.values():
        with pytest.raises(ValueError, match=message):
            mb.simulate(rod, rod.guess, **({"t1": 1.0} | changes))


def pushed_until(end):
    law = lambda poses, velocities, t, p: jnp.stack([jnp.sqrt(p["end"] - t), 0.0 * t, 0.0 * t])[None]
    forces = [mb.Force("push", "body", law, parameters={"end": end}), mb.Gravity((0.0, -9.81))]
    return mb.Scene([planar.PointMass("body", mass=1.0)], forces=forces).compile()


def driven_until(end):
    """An angle whose second derivative grows beyond bounds."""
    turn = lambda t, p: -((p["end"] - t) ** 1.5)
    drive = planar.Driver("drive", "ground", "body", quantity="angle", motion=turn, parameters={"end": end})
    return mb.Scene([planar.Body("body", mass=1.0, inertia=1.0)], joints=[drive]).compile()


def in_coordinates(end):
    kinetic, potential = lambda t, q, v, p: 0.5 * v @ v, lambda t, q, p: jnp.sqrt(p["end"] - q[0]) ** 3
    numbers = {"q": [0.0], "u": [1.0], "parameters": {"end": end}}
    return mb.lagrangian.LagrangianSystem(kinetic=kinetic, potential=potential, **numbers)


WRONG = {
    "force": (pushed_until, 0.5, "At t = 0.5 the force of 'push' is not finite"),
    "driver": (driven_until, 0.3, "At t = 0.3 the residual of 'drive' is not finite"),
    "potential": (in_coordinates, 0.1, "At t = 0.0[0-9]* the force on the coordinates is not finite"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", WRONG)
def test_an_error_names_what_is_not_finite_in_one_line(case):
    build, end, message = WRONG[case]
    system = build(end)
    with pytest.raises(RuntimeError, match=message) as failed:
        mb.simulate(system, mb.assemble(system), t1=1.0)
    assert len(str(failed.value)) < 300 and "\n" not in str(failed.value)


@pytest.mark.slow
def test_an_error_of_another_kind_is_one_line():
    system = pushed_until(2.0)
    with pytest.raises(RuntimeError) as failed:
        mb.simulate(system, mb.assemble(system), t1=1.0, max_steps=3)
    text = str(failed.value)
    assert re.match(
        r"The motion came to t = \d\S* of 1 in max_steps = 3 steps, with steps of about \S+ in the end\. ", text
    )
    assert 'solver="auto"' in text and "solver=jaxmb.solvers.Hermite()" in text and "\n" not in text


class Anisotropic(mb.parts.AbstractForce):
    """A spring of one's own with a stiffness in each direction, to the origin."""

    name: str = fields.name()
    bodies: fields.Names = fields.body_names()
    stiffness: fields.Number = fields.parameter(shape=(2, 2), unit="N/m", sign="positive definite")

    def wrenches(self, space, poses, velocities, t):
        return jnp.append(-self.stiffness @ poses[0, :2], 0.0)[None]


def test_matrices_of_ones_own():
    body = planar.Body("body", mass=1.0, inertia=1.0)
    compiled = lambda matrix: mb.Scene([body], forces=[Anisotropic("spring", "body", stiffness=matrix)]).compile()
    fine = compiled(np.eye(2))
    for matrix, message in (
        (np.diag([1.0, -1.0]), "stiffness must be positive definite"),
        (np.zeros((2, 2)), "stiffness must be positive definite"),
        ([[1.0, 0.5], [0.0, 1.0]], "stiffness must be symmetric"),
    ):
        for use in (compiled, lambda matrix: mb.with_parameters(fine, {"spring.stiffness": matrix})):
            with pytest.raises(ValueError, match=f"Anisotropic 'spring': {message}"):
                use(matrix)


def test_the_size_of_a_scene_after_a_change():
    """Tolerances follow a machine that becomes a thousand times smaller or larger, also under `jit`, and stay for a
    family of designs.
    """
    bodies = [planar.Body(name, mass=1.0, inertia=0.1, position=(x, 0.0)) for name, x in (("a", 0.5), ("b", 1.5))]
    pins = [
        planar.Revolute("shoulder", "ground", "a", point_a=(0.0, 0.0), point_b=(-0.5, 0.0)),
        planar.Revolute("elbow", "a", "b", point_a=(0.5, 0.0), point_b=(-0.5, 0.0)),
    ]
    system = mb.Scene(bodies, joints=pins).compile()
    sizes = {name: value for name, value in mb.parameters(system).items() if "point" in name}
    length = lambda factor: mb.with_parameters(system, {name: factor * x for name, x in sizes.items()}).length
    at = jax.jit(lambda factor: (length(factor), jax.grad(length)(factor)))
    for factor, expected in ((1.0, 1.0), (0.5, 1.0), (2.0, 1.0), (1e-3, 1e-3), (1e3, 1e3)):
        value, slope = at(factor)
        np.testing.assert_allclose(value, expected * system.length, rtol=1e-12)
        assert slope == 0.0
    np.testing.assert_allclose(length(1e-3), 1e-3 * system.length, rtol=1e-12)


def test_lengths_that_were_zero_leave_the_size_of_a_scene():
    """A pin at the origin of a link frame moves by a little: the scene is as large as before, and so are its metric of
    assembly and its tolerances. A larger scene counts.
    """
    rod = planar.Body("rod", mass=1.0, inertia=0.1, centre=(0.4, 0.02), position=(0.0, 0.0))
    pin = planar.Revolute("pin", "ground", "rod", point_a=(0.0, 0.0), point_b=(0.0, 0.0))
    forces = [mb.Gravity((0.0, -9.81)), mb.JointSpring("spring", "pin.angle", stiffness=6.0)]
    system = mb.Scene([rod], joints=[pin], forces=forces).compile()
    moved = lambda x: mb.with_parameters(system, {"pin.point_a": x * jnp.array([0.3, 0.7])})
    for x in (1e-6, 1e-3):
        assert moved(x).length == system.length
        assert mb.with_parameters(moved(1e-6), {"pin.point_b": [x, 0.0]}).length == system.length
    assert moved(1e3).length > 100 * system.length
    placed = lambda x: mb.assemble(moved(x)).q
    np.testing.assert_allclose(jax.jacfwd(placed)(0.0), (placed(1e-4) - placed(-1e-4)) / 2e-4, rtol=1e-6, atol=1e-7)
    # The angle of balance does not depend on where the pin is.
    still = [mb.equilibrium(moved(x)).q[2] for x in (0.0, 1e-6)]
    np.testing.assert_allclose(still[1], still[0], rtol=1e-9)
