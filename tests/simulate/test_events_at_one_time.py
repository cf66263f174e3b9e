"""Machines that share a scene, and the moments of their events, have motions and derivatives of their own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly
from scipy.integrate import solve_ivp

import jaxmb as mb
from jaxmb import planar
from jaxmb.parts import terrain

pytestmark = pytest.mark.slow

G, FLAT = 9.81, terrain.Flat()
DOWN = mb.Gravity((0.0, -G))


class Ball:
    """A ball that falls on the floor; with numbers: height and speed at the start, restitution, mass."""

    joints = (mb.RigidContact("floor", "ball", terrain=FLAT, restitution=0.5),)
    bodies, forces = (planar.PointMass("ball", mass=1.0, position=(0.0, 1.0)),), ()
    parameters = ("floor.restitution", "ball.mass")

    @staticmethod
    def drawn(chance, moment):
        v = chance.uniform(-2.0, 0.0)
        return [0.5 * G * moment**2 - v * moment, v, chance.uniform(0.0, 1.0), chance.uniform(0.5, 3.0)]

    @staticmethod
    def start(numbers):
        return {"ball.y": numbers[0]}, {"ball.y_rate": numbers[1]}


class Bar:
    """A pendulum that meets a stop; with numbers: angle and rate at the start, restitution."""

    bodies = (planar.Body("bar", mass=1.0, inertia=0.05, position=(0.5, 0.0)),)
    joints = (
        planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0)),
        mb.Stop("stop", "pin.angle", lower=-0.9, restitution=0.5),
    )
    forces, parameters = (), ("stop.restitution",)

    @staticmethod
    def drawn(chance, moment):
        fall = lambda t, y: [y[1], -0.5 * G / 0.3 * np.cos(y[0])]
        end = [-0.9, -chance.uniform(2.5, 4.0)]
        back = solve_ivp(fall, (moment, 0.0), end, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
        return [*back, chance.uniform(0.0, 1.0)]

    @staticmethod
    def start(numbers):
        angle, rate = numbers[:2]
        x, y = 0.5 * jnp.cos(angle), 0.5 * jnp.sin(angle)
        return {"bar.x": x, "bar.y": y, "bar.angle": angle}, {
            "bar.x_rate": -y * rate,
            "bar.y_rate": x * rate,
            "bar.angle_rate": rate,
        }


class Box:
    """A box on a rail that friction brings to rest; with numbers: speed at the start, coefficient."""

    bodies = (planar.Body("box", mass=2.0, inertia=0.1),)
    joints = (planar.Prismatic("rail", "ground", "box", point=(0.0, 0.0), axis=(1.0, 0.0)),)
    forces, parameters = (mb.DryFriction("rub", "rail", coefficient=0.4),), ("rub.coefficient",)

    @staticmethod
    def drawn(chance, moment):
        coefficient = chance.uniform(0.1, 0.6)
        return [coefficient * G * moment, coefficient]

    @staticmethod
    def start(numbers):
        return {}, {"box.x_rate": numbers[0]}


def ending(machines, t1):
    """The places and speeds of the machines at the end, and the energy lost in events, by numbers of each."""
    parts = lambda kind: [part for machine in machines for part in getattr(machine, kind)]
    system = mb.Scene(parts("bodies"), joints=parts("joints"), forces=[DOWN, *parts("forces")]).compile()
    drawn, at, of_rates = mb.assemble(system), system.coordinate_names(), system.rate_names()

    def end(numbers):
        q, u, values = drawn.q, drawn.u, {}
        for machine, of_machine in zip(machines, numbers, strict=True):
            places, rates = machine.start(of_machine)
            values |= dict(zip(machine.parameters, of_machine[-len(machine.parameters) :], strict=True))
            for name, value in places.items():
                q = q.at[at[name][0]].set(value)
            for name, value in rates.items():
                u = u.at[of_rates[name][0]].set(value)
        changed = mb.with_parameters(system, values)
        motion = mb.simulate(changed, mb.State(q, u), t1=t1, rtol=1e-9, max_steps=400, max_events=24)
        last = motion.ys
        bodies = [machine.bodies[0].name for machine in machines]
        own = [jnp.concatenate([last.q[-1][_of(at, n)], last.u[-1][_of(of_rates, n)]]) for n in bodies]
        return own, jnp.sum(motion.events.kinetic_energy_lost), jnp.sum(jnp.isfinite(motion.events.times))

    return end


def _of(names, body):
    return np.array([k for name, at in names.items() if name.startswith(f"{body}.") and len(at) == 1 for k in at])


def test_machines_beside_each_other_are_those_of_scenes_of_their_own():
    """Random machines with an impact, a stop and an end of slip at one moment: motions, energies and derivatives."""
    machines, moment, members = [Ball, Bar, Box], 0.2, 4

    def with_slopes(end):
        def twice(numbers):
            out = end(numbers)
            return out[0], out

        return jit_quickly(jax.jacfwd(twice, has_aux=True))

    together = with_slopes(ending(machines, 0.4))
    alone = [with_slopes(ending([machine], 0.4)) for machine in machines]
    chance, shared = np.random.default_rng(0), 0
    for _ in range(members):
        numbers = [jnp.array(machine.drawn(chance, moment)) for machine in machines]
        slopes, (ends, lost, count) = together(numbers)
        own = [end([of_machine]) for end, of_machine in zip(alone, numbers, strict=True)]
        shared += int(count) < sum(int(found[1][2]) for found in own)
        np.testing.assert_allclose(lost, sum(float(found[1][1]) for found in own), rtol=1e-7)
        for k, ((own_slopes,), ((own_end,), _, _)) in enumerate(own):
            np.testing.assert_allclose(ends[k], own_end, atol=5e-7)
            for j, slope in enumerate(slopes[k]):
                size = 1 + np.max(np.abs(own_slopes[0]))
                np.testing.assert_allclose(slope, own_slopes[0] if j == k else 0.0 * slope, atol=1e-5 * size)
    # By rounding, some follow each other instead.
    assert shared >= members // 2


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
