"""Gradients of motions of mechanisms in space: forward mode = reverse mode, and both = differences.

Each gets a driven anchor and a spring from the anchor to one of its bodies, so that parameters of every kind are there:
mass, inertia, body-fixed point, stiffness, a driver's parameter, and an initial rate.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from execute_notebooks import readme_machine
from scenarios import Derived

import jaxmb as mb
from jaxmb import spatial

pytestmark = pytest.mark.slow


def anchor(body, point):
    own = spatial.Body("anchor", mass=1.0, inertia=(1.0, 1.0, 1.0), position=(0.5, 0.2, 0.9))
    swing = lambda t, p: 0.5 + p["amplitude"] * jnp.sin(p["rate"] * t)
    numbers = {"amplitude": 0.3, "rate": 4.0}
    joints = [
        spatial.Prismatic("rail", "ground", "anchor", point=(0.5, 0.2, 0.9), axis=(1.0, 0.0, 0.0)),
        spatial.Driver("drive", "ground", "anchor", quantity="x", motion=swing, parameters=numbers),
    ]
    acts = {"stiffness": 5.0, "damping": 0.1, "free_length": 0.4}
    spring = spatial.SpringDamper("spring", "anchor", body, point_a=(0.1, 0.0, 0.0), point_b=point, **acts)
    return {"bodies": [own], "joints": joints, "forces": [spring]}


# Redundant constraints, and rolling: the body of the spring, its point, the body that turns at the start, parameters.
CASES = {
    "bricard": ("bar3", (0.1, 0.0, 0.2), "bar1", ["bar2.mass", "bar3.inertia", "spring.point_b"]),
    "rolling_disc": (
        "disc",
        (0.05, 0.02, 0.1),
        "disc",
        ["disc.mass", "disc.inertia", "spring.point_b", "plane.radius"],
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_gradients_of_mechanisms(name):
    body, point, turns, names = CASES[name]
    mechanism = mb.mechanisms.get(name)
    system = mechanism.scene.extended(**anchor(body, point)).compile()
    given = {k: v for k, v in mb.parameters(system).items() if k in [*names, "spring.stiffness", "drive.rate"]}
    flat, unravel = jax.flatten_util.ravel_pytree({**given, "spin": jnp.array(0.1)})
    sizes = np.maximum(np.abs(flat), 0.1)
    rates, whole = dict(mechanism.rates), f"{turns}.angular_velocity"

    def end(x, rtol):
        values = unravel(flat + (x - 1) * sizes)
        spin = values.pop("spin")
        own = rates | {f"{turns}.wy": spin + rates.get(f"{turns}.wy", 0.0)}
        if whole in rates:
            own = rates | {whole: jnp.asarray(rates[whole], float).at[1].add(spin)}
        changed = mb.with_parameters(system, values)
        state = mb.assemble(changed, fix=mechanism.fix, rates=own, throw=False)
        motion = mb.simulate(changed, state, t1=0.4, rtol=rtol, max_steps=1024, throw=False)
        weights = jnp.cos(jnp.arange(system.nq + system.nu, dtype=float))
        return jnp.sum(weights * jnp.concatenate([motion.ys.q[-1], motion.ys.u[-1]]))[None]

    gradient = Derived(end, np.ones(flat.size), near=1e-5).check()
    # Not zeros, but for the few that symmetry makes so.
    assert np.mean(np.abs(gradient) > 1e-8 * np.max(np.abs(gradient))) > 0.5


def test_example_of_the_readme_has_derivatives_without_an_option():
    """First and second derivatives by a length of the loop, and differences of it."""
    angle, length, h = readme_machine()["angle"], 2.0, 1e-3
    first, along, second = jax.grad(angle)(length), jax.jacfwd(angle)(length), jax.hessian(angle)(length)
    np.testing.assert_allclose(along, first, rtol=1e-11)
    low2, low, high, high2 = (angle(length + k * h) for k in (-2, -1, 1, 2))
    np.testing.assert_allclose(first, (8 * (high - low) - (high2 - low2)) / (12 * h), rtol=1e-6)
    slopes = [jax.grad(angle)(length + k * h) for k in (-2, -1, 1, 2)]
    central = (8 * (slopes[2] - slopes[1]) - (slopes[3] - slopes[0])) / (12 * h)
    np.testing.assert_allclose(second, central, rtol=1e-5)
