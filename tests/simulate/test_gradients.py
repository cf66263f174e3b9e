"""Gradients of motions: forward mode = reverse mode, and both = central differences of a tighter solution.

Every mechanism gets a driven anchor and a spring from the anchor to one of its bodies, so that parameters of every
kind are there: mass, inertia, body-fixed point, stiffness, a driver's parameter, and an initial rate.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from execute_notebooks import readme_machine

import jaxmb as mb
from jaxmb import planar, spatial

pytestmark = pytest.mark.slow

TIME = 0.4


def planar_anchor(body, point):
    anchor = planar.Body("anchor", mass=1.0, inertia=1.0, position=(0.5, 2.0))
    swing = lambda t, p: 0.5 + p["amplitude"] * jnp.sin(p["rate"] * t)
    joints = [
        planar.Prismatic("rail", "ground", "anchor", point=(0.5, 2.0), axis=(1.0, 0.0)),
        planar.Driver(
            "drive", "ground", "anchor", quantity="x", motion=swing, parameters={"amplitude": 0.3, "rate": 4.0}
        ),
    ]
    spring = planar.SpringDamper(
        "spring", "anchor", body, stiffness=20.0, damping=0.5, free_length=0.4, point_a=(0.1, 0.0), point_b=point
    )
    return anchor, joints, spring


def spatial_anchor(body, point):
    anchor = spatial.Body("anchor", mass=1.0, inertia=(1.0, 1.0, 1.0), position=(0.5, 0.2, 0.9))
    swing = lambda t, p: 0.5 + p["amplitude"] * jnp.sin(p["rate"] * t)
    joints = [
        spatial.Prismatic("rail", "ground", "anchor", point=(0.5, 0.2, 0.9), axis=(1.0, 0.0, 0.0)),
        spatial.Driver(
            "drive", "ground", "anchor", quantity="x", motion=swing, parameters={"amplitude": 0.3, "rate": 4.0}
        ),
    ]
    spring = spatial.SpringDamper(
        "spring", "anchor", body, stiffness=5.0, damping=0.1, free_length=0.4, point_a=(0.1, 0.0, 0.0), point_b=point
    )
    return anchor, joints, spring


CASES = {
    # mechanism: (body of the spring, its point, more fixed coordinates, rate that is differentiated, other parameters)
    "four_bar": ("rocker", (0.3, 0.1), "crank.angle", ["crank.mass", "rocker.inertia", "spring.point_b"]),
    "bricard": ("bar3", (0.1, 0.0, 0.2), "bar1.wy", ["bar2.mass", "bar3.inertia", "spring.point_b"]),
    "rolling_disc": (
        "disc",
        (0.05, 0.02, 0.1),
        "disc.wy",
        ["disc.mass", "disc.inertia", "spring.point_b", "plane.radius"],
    ),
    "heavy_top": ("top", (0.02, 0.01, 0.05), "top.wz", ["top.mass", "top.inertia", "tip.point_b", "spring.point_b"]),
}


def build(name):
    """A scalar of the motion as a function of parameters by name, at a given tolerance."""
    body, point, rate, names = CASES[name]
    mechanism = mb.mechanisms.get(name)
    space = planar_anchor if name == "four_bar" else spatial_anchor
    anchor, joints, spring = space(body, point)
    system = mechanism.scene.extended(bodies=[anchor], joints=joints, forces=[spring]).compile()
    rates = dict(mechanism.rates) or {rate: 0.0}
    start = {k: v for k, v in mb.parameters(system).items() if k in [*names, "spring.stiffness", "drive.rate"]}
    whole = rate.rsplit(".", 1)[0] + ".angular_velocity"

    def observe(parameters, rtol):
        parameters = dict(parameters)
        spin = parameters.pop("initial rate")
        own = dict(rates)
        if whole in own:
            k = {"x": 0, "y": 1, "z": 2}[rate[-1]]
            own[whole] = jnp.asarray(own[whole], float).at[k].add(spin)
        else:
            own[rate] = jnp.asarray(own[rate], float) + spin
        changed = mb.with_parameters(system, parameters)
        state = mb.assemble(changed, fix=mechanism.fix, rates=own, throw=False)
        sol = mb.simulate(changed, state, t1=TIME, rtol=rtol, max_steps=1024, throw=False)
        weights = jnp.cos(jnp.arange(system.nq + system.nu, dtype=float))
        return jnp.sum(weights * jnp.concatenate([sol.ys.q[-1], sol.ys.u[-1]]))

    return observe, {**start, "initial rate": jnp.array(0.1)}


@pytest.mark.parametrize("name", CASES)
def test_forward_reverse_and_central_differences(name):
    observe, start = build(name)
    flat, unravel = jax.flatten_util.ravel_pytree(start)
    loss = lambda x, rtol: observe(unravel(x), rtol)
    # One program, of the derivative in one direction: at a tighter tolerance it also gives the values for differences,
    # of which there are several for each parameter.
    value_and_derivative = jax.jit(lambda x, along, rtol: jax.jvp(lambda x: loss(x, rtol), (x,), (along,)))
    directions = np.eye(flat.size)
    forward = np.array([value_and_derivative(flat, along, 1e-9)[1] for along in directions])
    reverse = jax.jit(jax.grad(lambda x: loss(x, 1e-9)))(flat)
    scale = np.max(np.abs(forward))
    # Not zeros, but for the few that symmetry makes so.
    assert np.all(np.isfinite(forward)) and np.mean(np.abs(forward) > 1e-8 * scale) > 0.5
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-9 * scale)

    h = 1e-4 * np.maximum(np.abs(flat), 1e-2)
    value = lambda k: np.array([value_and_derivative(flat + k * h * along, along, 1e-12)[0] for along in directions])
    plain, double = (value(1.0) - value(-1.0)) / (2 * h), (value(2.0) - value(-2.0)) / (4 * h)
    # Richardson's extrapolation of central differences, so that their own error is below the one tested.
    np.testing.assert_allclose(forward, (4 * plain - double) / 3, rtol=1e-5, atol=1e-7 * scale)


def test_gradients_in_a_batch():
    observe, start = build("four_bar")
    flat, unravel = jax.flatten_util.ravel_pytree(start)
    loss = lambda x, rtol: observe(unravel(x), rtol)
    values_and_gradients = jax.jit(jax.vmap(jax.value_and_grad(loss), in_axes=(0, None)))
    direction = np.cos(np.arange(flat.size)) * np.abs(flat)
    steps = 1e-4 * np.array([0.0, 1.0, -1.0, 2.0, -2.0])
    batch = flat[None, :] + steps[:, None] * direction[None, :]
    gradients = values_and_gradients(batch, 1e-9)[1]
    # The gradients compared are not zeros.
    felt = unravel(np.abs(gradients[0]))
    assert all(np.all(value > 1e-8) for name, value in felt.items() if name != "spring.point_b")
    slope = gradients @ direction
    values = values_and_gradients(batch, 1e-12)[0]
    central = (8 * (values[1] - values[2]) - (values[3] - values[4])) / 12e-4
    np.testing.assert_allclose(slope[0], central, rtol=1e-6)


def test_the_example_of_the_readme_without_an_option():
    """First and second derivatives by a length of the loop, and differences of it."""
    angle, length, h = readme_machine()["angle"], 2.0, 1e-3
    first, along, second = jax.grad(angle)(length), jax.jacfwd(angle)(length), jax.hessian(angle)(length)
    np.testing.assert_allclose(along, first, rtol=1e-11)
    low2, low, high, high2 = (angle(length + k * h) for k in (-2, -1, 1, 2))
    np.testing.assert_allclose(first, (8 * (high - low) - (high2 - low2)) / (12 * h), rtol=1e-6)
    slopes = [jax.grad(angle)(length + k * h) for k in (-2, -1, 1, 2)]
    central = (8 * (slopes[2] - slopes[1]) - (slopes[3] - slopes[0])) / (12 * h)
    np.testing.assert_allclose(second, central, rtol=1e-5)
