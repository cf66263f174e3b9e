"""Shapes that functions of the user's parts may return."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.parts.planar.kinematics import PLANE


def pulled(space, rows):
    """A body on a spring from a function that returns its wrench in some form."""

    def pull(poses, velocities, t, p):
        d = space_of(space)
        return rows(jnp.zeros(velocities.shape[1]).at[:d].set(-p["k"] * poses[0, :d]))

    energy = lambda poses, t, p: 0.5 * p["k"] * jnp.sum(poses[0, : space_of(space)] ** 2)
    d = space_of(space)
    body = space.Body("body", mass=1.0, inertia=1.0 if d == 2 else np.eye(3), position=np.arange(1.0, 1.0 + d))
    spring = mb.Force("spring", "body", pull, parameters={"k": 3.0}, potential=energy)
    return mb.Scene([body], forces=[spring]).compile()


def space_of(space):
    return 2 if space is planar else 3


@pytest.mark.parametrize("space", [planar, spatial])
def test_a_force_on_one_body_may_return_a_vector(space):
    row, vector = (pulled(space, rows) for rows in (lambda w: w[None], lambda w: w))
    state = row.guess
    np.testing.assert_array_equal(vector.force(0.0, state.q, state.u), row.force(0.0, state.q, state.u))


def test_a_force_on_two_bodies_returns_a_row_for_each():
    bodies = [planar.Body(name, mass=1.0, inertia=1.0) for name in ("a", "b")]
    lone = mb.Force("lone", ("a", "b"), lambda x, v, t, p: v[0])
    with pytest.raises(ValueError, match=r"'lone' must return shape \(2, 3\), got \(3,\)"):
        mb.Scene(bodies, forces=[lone]).compile()


def test_a_gap_is_a_number_or_a_vector():
    """Its rate is that along the motion, also by time."""

    def scene(gap):
        body = planar.Body("body", mass=1.0, inertia=1.0)
        return mb.Scene([body], forces=[mb.Force("layer", "body", lambda x, v, t, p: 0 * v, gap=gap)])

    falls = lambda x, t, p: x[0, 0] + 3.0 * t
    between = lambda x, t, p: jnp.stack([x[0, 0] - 1.0, 2.0 - x[0, 0] + t])
    for gap, rates in ((falls, [5.0]), (between, [2.0, -1.0])):
        system = scene(gap).compile()
        seen = system.gaps_seen(jnp.array(0.0), system.guess.q, system.guess.u.at[0].set(2.0))
        assert system.has_gaps and seen.gaps.shape == (len(rates),)
        np.testing.assert_allclose(seen.rates, rates, rtol=1e-15)
    assert not scene(None).compile().has_gaps
    with pytest.raises(ValueError, match=r"'layer': gaps must return a vector, got shape \(1, 3\)"):
        scene(lambda x, t, p: x).compile()


def test_a_velocity_constraint_of_time_prescribes_its_rate():
    """The rate of v − x t² is v̇ − v t² − 2 x t."""
    body = planar.Body("body", mass=1.0, inertia=0.1)
    pace = mb.VelocityConstraint("pace", "body", lambda x, v, t, p: v[0, :1] - x[0, :1] * t**2, linear=True)
    system = mb.Scene([body], joints=[pace]).compile()
    q, u, udot = np.array([1.5, 0.0, 0.0]), np.array([0.7, 0.2, 0.1]), np.array([-0.4, 0.3, 0.0])
    found = jax.jit(lambda *at: system.acceleration_residual(*at))(2.0, q, u, udot)
    np.testing.assert_allclose(found, [-0.4 - 0.7 * 4.0 - 2 * 1.5 * 2.0], rtol=1e-14)


BODY = planar.Body("body", mass=1.0, inertia=0.1, position=(1.0, 0.0))
ZERO = {"a": 0.0}
DECLARED = {
    "rheonomic": (
        lambda: mb.Constraint(
            "bound", "body", lambda x, t, p: x[0, 0] - p["a"] * jnp.sin(t) - 1.0, parameters=ZERO, rheonomic=False
        ),
        "its residual depends on t; declare rheonomic=True",
    ),
    "linear": (
        lambda: mb.VelocityConstraint(
            "bound", "body", lambda x, v, t, p: v[0, 0] + p["a"] * v[0, 1] ** 2, parameters=ZERO, linear=True
        ),
        "depends on the velocities; declare linear=False",
    ),
    "homogeneous": (
        lambda: mb.VelocityConstraint(
            "bound", "body", lambda x, v, t, p: v[0, 0] - p["a"], parameters=ZERO, homogeneous=True
        ),
        "its residual is not zero at rest; declare homogeneous=False",
    ),
}


@pytest.mark.parametrize("word", DECLARED)
def test_constraints_that_are_not_what_they_declare(word):
    """Also where a parameter that is zero hides it."""
    make, message = DECLARED[word]
    with pytest.raises(ValueError, match=f"'bound'.*{message}"):
        mb.Scene([BODY], joints=[make()]).compile()


def test_constraints_that_are_what_they_declare():
    blade = lambda x, v, t, p: v[0, 1] * jnp.cos(x[0, 2]) - v[0, 0] * jnp.sin(x[0, 2] - p["a"])
    parts = [
        mb.Constraint("ring", "body", lambda x, t, p: jnp.dot(x[0, :2], x[0, :2]) - 1.0, rheonomic=False),
        mb.VelocityConstraint("blade", "body", blade, parameters={"a": 0.0}, linear=True, homogeneous=True),
    ]
    assert mb.Scene([BODY], joints=parts).compile().drift_free


def test_indices_out_of_bounds_of_derived_arrays():
    """A function indexes outside of an array that it computes from its arguments."""
    far = lambda poses, velocities, t, p: jnp.stack([jnp.sin(poses)[0, 7], 0.0, 0.0])[None]
    with pytest.raises(ValueError, match="index 7 is out of bounds for axis 1 with size 3"):
        mb.Scene([BODY], forces=[mb.Force("far", "body", far)]).compile()
    law = lambda t, measured, states, p: (jnp.cos(jnp.stack([measured["x"], measured["x"]]))[4], {})
    push = mb.Controller("push", law, {"x": "slide.displacement"}, "slide.displacement")
    slide = planar.Prismatic("slide", "ground", "body", point=(1.0, 0.0), axis=(1.0, 0.0))
    with pytest.raises(ValueError, match="index 4 is out of bounds for axis 0 with size 2"):
        mb.Scene([BODY], joints=[slide], forces=[push]).compile()


def test_functions_see_the_time():
    """The functions of forces, of their energies, and of constraints."""
    poses, velocities, t = np.array([[0.4, -0.2, 0.3]]), np.array([[1.5, 0.2, -0.6]]), 0.7
    numbers = {"parameters": {"k": 3.0}}
    push = mb.Force(
        "push", "body", lambda x, v, t, p: p["k"] * t * x, potential=lambda x, t, p: -p["k"] * t * x[0, 1], **numbers
    )
    np.testing.assert_allclose(push.wrenches(PLANE, poses, velocities, t), 2.1 * poses, rtol=1e-14)
    np.testing.assert_allclose(push.energy(PLANE, poses, t), 0.42, rtol=1e-14)
    ring = mb.Constraint("ring", "body", lambda x, t, p: x[0, :1] - p["k"] * t, **numbers)
    np.testing.assert_allclose(ring.residual(PLANE, poses, t), [0.4 - 2.1], rtol=1e-14)
    belt = mb.VelocityConstraint("belt", "body", lambda x, v, t, p: v[0, :1] - p["k"] * t, **numbers)
    np.testing.assert_allclose(belt.residual(PLANE, poses, velocities, t), [1.5 - 2.1], rtol=1e-14)


def test_a_non_ideal_force_is_that_of_its_function():
    """A brake: in proportion to the reaction, to the time, and against the slide."""
    reactions, velocities = np.array([[3.0, 40.0, -2.0]]), np.array([[0.5, 0.0, 0.0]])
    brake = lambda x, v, r, t, p: np.array([[-1.0, 0.0, 0.0]]) * p["mu"] * t * r[0, 1] * np.sign(v[0, 0])
    part = mb.NonIdeal("brake", "slide", brake, parameters={"mu": 0.3})
    found = part.wrenches(PLANE, np.zeros((1, 3)), velocities, reactions, 2.0)
    np.testing.assert_allclose(found, [[-24.0, 0.0, 0.0]], rtol=1e-14)


def test_a_controller_measures_rates_and_velocities_at_frames():
    pin = planar.Revolute("pin", "ground", "bar", point_a=(0.0, 0.0), point_b=(0.0, 0.0))
    tip = planar.Frame("tip", "bar", position=(0.5, -0.1), angle=0.2)
    law = lambda t, seen, states, p: (-2.0 * seen["rate"] + seen["speed"] @ jnp.array([3.0, 5.0]), {})
    push = mb.Controller("push", law, {"rate": "pin.angle_rate", "speed": "tip.velocity"}, "pin.angle")
    push = push.of_sources([pin, tip], [(0, 1), (1,)])
    poses, velocities = np.array([[0.0] * 3, [0.1, 0.2, 0.3]]), np.array([[0.0] * 3, [0.4, -0.2, 1.5]])
    wrenches = jax.jit(lambda q, u: push.wrenches(PLANE, q, u, 0.0))(poses, velocities)
    c, s = np.cos(0.3), np.sin(0.3)
    arm = np.array([c * 0.5 + s * 0.1, s * 0.5 - c * 0.1])
    speed = np.array([0.4 - 1.5 * arm[1], -0.2 + 1.5 * arm[0]])
    force = -2.0 * 1.5 + speed @ [3.0, 5.0]
    np.testing.assert_allclose(wrenches, [[0.0, 0.0, -force], [0.0, 0.0, force]], rtol=1e-13, atol=1e-15)
