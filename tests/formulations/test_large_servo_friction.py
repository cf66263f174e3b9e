"""Servos and friction in scenes of many joints: by sparse elimination as by dense matrices."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.formulations import Multipliers, accelerations
from jaxmb.manifold import Partition
from jaxmb.manifold.impulse import after_impulse

pytestmark = pytest.mark.slow


def swing(t, p):
    return p["amplitude"] * jnp.sin(5.0 * t)


@functools.cache
def planar_chain(n=16):
    """Rods on pins, two of which rub, and a servo that moves the last rod's end; a spring holds the end."""
    angle = np.linspace(-0.3, 0.9, n)
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ends = np.concatenate([np.zeros((1, 2)), np.cumsum(along, axis=0)])
    bodies = [
        planar.Body(f"b{k}", mass=1.0 + 0.1 * k, inertia=0.1, position=(ends[k] + ends[k + 1]) / 2, angle=angle[k])
        for k in range(n)
    ]
    joints = [planar.Revolute(f"j{k}", f"b{k - 1}" if k else "ground", f"b{k}", point=tuple(ends[k])) for k in range(n)]
    program = planar.Driver("turn", "ground", "b5", quantity="angle", motion=swing, parameters={"amplitude": 0.2})
    forces = [
        mb.Gravity((0.0, -9.81)),
        planar.Friction("rub", "j3", coefficient=0.2, radius=0.1, transition_speed=0.1),
        planar.Friction("scrape", "j9", coefficient=0.3, radius=0.05, transition_speed=0.1),
    ]
    return mb.Scene(bodies, joints=[*joints, mb.Servo(program, 6.0, 9.0)], forces=forces).compile()


@functools.cache
def spatial_chain(n=12):
    """The same on balls and one hinge, with a servo on a distance."""
    bodies, joints = [], []
    for k in range(n):
        bodies.append(
            spatial.Body(f"b{k}", mass=1.0 + 0.1 * k, inertia=(0.03, 0.1, 0.12), position=(k + 0.5, 0.0, 0.0))
        )
        name, ends, at = f"j{k}", (f"b{k - 1}" if k else "ground", f"b{k}"), (float(k), 0.0, 0.0)
        hinge = functools.partial(spatial.Revolute, axis=(0.0, 1.0, 0.0))
        joints.append((hinge if k == 4 else spatial.Spherical)(name, *ends, point=at))
    program = mb.Constraint(
        "lift", "b6", lambda p, t, own: p[0, 2:3] - own["target"], parameters={"target": 0.1}, rheonomic=False
    )
    forces = [
        mb.Gravity((0.0, 0.0, -9.81)),
        spatial.Friction("rub", "j4", coefficient=0.2, radius=0.05, transition_speed=0.1),
        spatial.Friction("scrape", "j8", coefficient=0.3, radius=0.03, transition_speed=0.1),
    ]
    return mb.Scene(bodies, joints=[*joints, mb.Servo(program, 4.0, 4.0)], forces=forces).compile()


def moving(system):
    return mb.assemble(system, mb.State(system.guess.q, jnp.asarray(np.random.default_rng(0).normal(size=system.nu))))


def dense(system):
    return dataclasses.replace(system, elimination=None)


@pytest.mark.parametrize("build", [planar_chain, spatial_chain])
def test_accelerations_and_multipliers(build):
    system = build()
    assert system.elimination is not None
    assert system.acceleration_rows > system.velocity_rows
    assert system.friction_rows.size
    state = moving(system)

    @jax.jit
    def solve(y):
        return [accelerations(own, Multipliers(), 0.0, y.q, y.u) for own in (system, dense(system))]

    found, expected = solve(state)
    for own, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(own, other, rtol=0, atol=1e-10 * np.max(np.abs(other)))
    # Friction and the servo do change them.
    without = dataclasses.replace(system, constraints=dataclasses.replace(system.constraints, nonideal=()))
    ideal, _ = jax.jit(lambda y: accelerations(without, Multipliers(), 0.0, y.q, y.u))(state)
    assert np.max(np.abs(ideal - found[0])) > 1e-3
    assert np.max(np.abs(system.acceleration_residual(0.0, state.q, state.u, found[0]))) < 1e-9
    jumped = mb.State(state.q, state.u + 0.1)
    after, expected = jax.jit(lambda y: [after_impulse(own, 0.0, y).u for own in (system, dense(system))])(jumped)
    np.testing.assert_allclose(after, expected, rtol=0, atol=1e-10)
    assert np.max(np.abs(system.velocity_residual(0.0, state.q, after))) < 1e-11


def test_motion_and_its_derivatives():
    """As by partitioning, with forward, reverse and central differences."""
    system, varied = planar_chain(), {"rub.coefficient": 0.3, "turn.amplitude": 0.2, "b3.mass": 1.0}
    state, start = moving(system), mb.parameters(system)

    def tip(h, manifold, rtol):
        own = mb.with_parameters(system, {name: start[name] + h * step for name, step in varied.items()})
        y = mb.simulate(own, state, t1=0.1, rtol=rtol, atol=rtol, manifold=manifold, throw=False).ys
        return jnp.sum(jnp.cos(y.q[-1])) + jnp.sum(y.u[-1]) * 0.1

    forward = jax.jit(lambda h, rtol: jax.jvp(lambda h: tip(h, None, rtol), (h,), (1.0,)))
    value, push = forward(0.0, 1e-10)
    np.testing.assert_allclose(value, jax.jit(lambda: tip(0.0, Partition(), 1e-10))(), rtol=0, atol=1e-7)
    np.testing.assert_allclose(jax.jit(jax.grad(lambda h: tip(h, None, 1e-10)))(0.0), push, rtol=1e-8)
    h, at = 1e-3, lambda h: forward(h, 1e-12)[0]
    difference = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
    np.testing.assert_allclose(push, difference, rtol=1e-6)
