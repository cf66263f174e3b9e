"""Machines that share a scene, and the moments of their events, have derivatives of their own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly

import jaxmb as mb
from jaxmb import planar
from jaxmb.parts import terrain

pytestmark = pytest.mark.slow

G, FLAT = 9.81, terrain.Flat()
DOWN = mb.Gravity((0.0, -G))


def test_contacts_that_act_on_each_other_close_together():
    """A block falls flat on both corners, and balls with a damper between them: derivatives by the common height."""
    block = planar.Body("block", mass=2.0, inertia=0.3, position=(0.0, 1.4))
    corners = [
        mb.RigidContact(n, "block", terrain=FLAT, centre=(x, -0.4), restitution=0.5)
        for n, x in (("left", -0.2), ("right", 0.2))
    ]
    balls = [planar.PointMass(n, mass=1.0, position=(x, 1.0)) for n, x in (("a", 2.0), ("b", 4.0))]
    floors = [mb.RigidContact(f"floor {n}", n, terrain=FLAT, restitution=0.5) for n in "ab"]
    damper = planar.Damper("damper", "a", "b", damping=3.0)
    system = mb.Scene([block, *balls], joints=[*corners, *floors], forces=[DOWN, damper]).compile()
    start, at, t1 = mb.assemble(system), system.coordinate_names(), 0.7
    places = np.array([at[f"{n}.y"][0] for n in ("block", "a", "b")])

    def end(height):
        state = mb.State(start.q.at[places].add(height), start.u)
        return mb.simulate(system, state, t1=t1, rtol=1e-10, max_steps=400, max_events=8).ys.q[-1][places]

    def bounced(height):
        t = jnp.sqrt(2 * (1.0 + height) / G)
        return 0.5 * G * t * (t1 - t) - 0.5 * G * (t1 - t) ** 2

    np.testing.assert_allclose(jit_quickly(jax.jacfwd(end))(0.0), jax.grad(bounced)(0.0) * np.ones(3), rtol=1e-8)


def test_blocks_that_stop_and_slip_together():
    """Two equal blocks come to rest, and a growing force moves them again: each by its own force and friction."""
    pull = lambda x, v, t, p: jnp.stack([p["rate"] * t, 0 * t, 0 * t])[None]
    bodies, joints, forces = [], [], [DOWN]
    for n in "ab":
        bodies.append(planar.Body(n, mass=2.0, inertia=0.1, velocity=(1.0, 0.0)))
        joints.append(planar.Prismatic(f"rail {n}", "ground", n, axis=(1.0, 0.0), point=(0.0, 0.0)))
        forces.append(mb.DryFriction(f"rub {n}", f"rail {n}", coefficient=0.3, static_coefficient=0.4))
        forces.append(mb.Force(f"push {n}", [n], pull, parameters={"rate": 4.0}))
    system, t1 = mb.Scene(bodies, joints=joints, forces=forces).compile(), 3.0
    names = [f"{part} {n}.{number}" for n in "ab" for part, number in (("rub", "static_coefficient"), ("push", "rate"))]

    def end(numbers):
        changed = mb.with_parameters(system, dict(zip(names, numbers, strict=True)))
        motion = mb.simulate(changed, mb.assemble(changed), t1=t1, rtol=1e-10, max_steps=400, max_events=8)
        return jnp.stack([motion[n].position[-1, 0] for n in "ab"])

    def slid(numbers):
        static, rate, slow = numbers[0], numbers[1] / 2.0, 0.3 * G
        stops = (slow - jnp.sqrt(slow**2 - 2 * rate)) / rate
        begins = static * G / rate
        first = stops + rate * stops**3 / 6 - slow * stops**2 / 2
        further = rate * ((t1**3 - begins**3) / 6 - begins**2 * (t1 - begins) / 2)
        return first + further - slow * (t1 - begins) ** 2 / 2

    jacobian, own = jit_quickly(jax.jacrev(end))(jnp.array([0.4, 4.0] * 2)), jax.grad(slid)(jnp.array([0.4, 4.0]))
    np.testing.assert_allclose(jacobian, np.kron(np.eye(2), own), atol=1e-6 * np.max(np.abs(own)))
