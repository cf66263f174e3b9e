"""One machine from its Lagrangian and as rigid bodies: the same accelerations and the same motion."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import mechanisms
from jaxmb.formulations import Partitioned, accelerations
from jaxmb.linalg import rotations

ZERO = jnp.zeros(())

# Compiled sooner than the default; any method will do.
METHOD = {"solver": diffrax.Dopri8(), "manifold": mb.manifold.Projection(), "max_steps": 100_000}


@functools.cache
def library(name, **parameters):
    return mechanisms.get(name, **parameters)


def along(angle):
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def platforms_of_cart(q, p):
    """Mass centres and headings."""
    front = q[2] + q[3]
    centres = q[:2] + p["ahead"] * along(q[2]), q[:2] + p["pivot"] * along(q[2]) + p["lever"] * along(front)
    return jnp.concatenate([centres[0], q[2:3], centres[1], front[None]])


def platforms_of_snake(q, p):
    rear, front = q[2] - q[3], q[2] + q[4]
    before = q[:2] - p["half"] * (along(rear) + along(q[2]))
    after = q[:2] + p["half"] * (along(q[2]) + along(front))
    return jnp.concatenate([before, rear[None], q[:3], after, front[None]])


def links_on_sphere(q, p):
    z, x = np.eye(3)[2], np.eye(3)[0]
    ground = rotations.from_axis_angle(x, p["arcs"][3])
    output = rotations.multiply(ground, rotations.from_axis_angle(z, q[1]))
    centre = jnp.zeros(3)
    return jnp.concatenate([centre, rotations.from_axis_angle(z, q[0]), centre, q[2:], centre, output])


def body_velocities(q, rates):
    """Of the links on a sphere: positions at rest, and angular velocities."""
    turning = jax.vmap(rotations.angular_velocity)(q.reshape(-1, 7)[:, 3:], rates.reshape(-1, 7)[:, 3:])
    return jnp.hstack([jnp.zeros_like(turning), turning]).ravel()


# Mass centres ahead of axle, pin ahead of axle, and front mass centre ahead of the pin. The racer's front platform has
# its centre in the pin and I/(I + 2 m d²) times the mass of the rear one; the common centre is on the rear axle.
RACER = {"ahead": -0.5 * 0.3 / (0.3 + 2 * 2.0 * 0.5**2), "pivot": 0.5, "lever": 0.0}
CART = {"ahead": 0.15, "pivot": 0.5, "lever": 0.2 - 0.05}

# Where the bodies are for coordinates of the Lagrangian, and how closely references are reached.
TWINS = {
    "roller_racer": (lambda q, p: platforms_of_cart(q, RACER), 1e-7),
    "nonholonomic_cart": (lambda q, p: platforms_of_cart(q, CART), 1e-7),
    "three_platform_snake": (platforms_of_snake, 1e-6),
    "benenti": (lambda q, p: q, 1e-8),
    "constant_speed_particle": (lambda q, p: q, 1e-9),
    "appell_hamel": (lambda q, p: q, 1e-9),
    "spherical_four_bar": (links_on_sphere, 1e-7),
    "rough_ring": (lambda q, p: q, 1e-9),
    "tracking_chain": (lambda q, p: jnp.stack([q, jnp.zeros_like(q)], axis=1).ravel(), 1e-7),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", TWINS)
def test_accelerations_and_motion(name):
    place, bound = TWINS[name]
    paper, bodies = library(name), library(name, model="rigid_bodies")
    system, scene = paper.system, bodies.system
    seen = (lambda q, v: v) if scene.rates_are_velocities or scene.nq == scene.nu else body_velocities

    def both(state):
        q, u = state
        near = mb.manifold.project(system, ZERO, mb.State(q, u))
        y = mb.manifold.project(system, ZERO, near)
        udot, _ = accelerations(system, Partitioned(), ZERO, y.q, y.u)
        v = system.rates(ZERO, y.q, y.u)
        a = jax.jvp(system.rates, (ZERO, y.q, y.u), (jnp.ones(()), v, udot))[1]
        where = lambda q: place(q, system.parameters)
        move = lambda q, v: seen(where(q), jax.jvp(where, (q,), (v,))[1])
        q = where(y.q)
        u, expected = jax.jvp(move, (y.q, v), (v, a))
        found, _ = accelerations(scene, Partitioned(), ZERO, q, u)
        return found, expected, scene.position_residual(ZERO, q), scene.velocity_residual(ZERO, q, u)

    rng = np.random.default_rng(0)
    noise = lambda y, size: y[None] + size * rng.standard_normal((20, y.size))
    states = noise(paper.state.q, 0.03), noise(paper.state.u, 0.3)
    found, expected, *residuals = jax.jit(lambda states: jax.lax.map(both, states))(states)
    size = 1 + np.max(np.abs(expected), axis=1, keepdims=True)
    np.testing.assert_allclose(found / size, expected / size, rtol=0, atol=1e-10)
    for residual in residuals:
        np.testing.assert_allclose(residual, 0.0, atol=1e-12)

    times = bodies.references.times
    trajectory = mb.simulate(scene, bodies.state, t1=times[-1], rtol=1e-10, saveat=times, **METHOD)
    assert np.max([error[-1] for error in bodies.errors(trajectory).values()]) <= bound


def circle(t):
    return jnp.stack([0.9 + 0.3 * jnp.cos(t), 0.2 + 0.3 * jnp.sin(t)])


@pytest.mark.slow
def test_a_snake_of_bodies_is_driven_through_its_gait():
    snake = library("three_platform_snake", gait=circle, model="rigid_bodies")
    assert snake.system.velocity_rank == snake.system.nu
    trajectory = mb.simulate(snake.system, snake.state, t1=snake.t1, rtol=1e-12, atol=1e-14, **METHOD)
    end = [snake.observe(trajectory)[label][-1] for label in ("x", "y", "theta", "phi1", "phi2")]
    np.testing.assert_allclose(end, (0.341277854133, 0.002496318416, 0.482671126542, 1.2, 0.2), rtol=0, atol=1e-9)


def test_what_is_refused():
    with pytest.raises(ValueError, match="lagrangian, rigid_bodies"):
        mechanisms.benenti(model="bodies")
    with pytest.raises(ValueError, match="leave out form"):
        mechanisms.roller_racer(model="rigid_bodies", form="constraints")
