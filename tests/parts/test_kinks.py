"""Derivatives of laws with a kink, at the kink: those of the side on which the law acts."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar
from jaxmb.parts.kinks import clipped, excess
from jaxmb.system.instant import Instant

STEP = 2.0**-20
G = mb.Gravity((0.0, -9.81))


def test_one_sided_derivatives():
    """At both ends of a range, for all three arguments; a missing number stays missing."""
    at = np.array([-2.0, -1.0, 0.5, 3.0, 4.0])
    slopes = jax.jit(jax.vmap(jax.grad(clipped, (0, 1, 2)), (0, None, None)))(at, -1.0, 3.0)
    np.testing.assert_array_equal(np.stack(slopes), [[0, 1, 1, 1, 0], [1, 0, 0, 0, 0], [0, 0, 0, 0, 1]])
    np.testing.assert_array_equal(jax.jit(jax.vmap(jax.grad(excess)))(np.array([-1.0, 0.0, 1.0])), [0.0, 1.0, 1.0])
    assert np.isnan(clipped(jnp.array(jnp.nan), -1.0, 3.0)) and np.isnan(excess(jnp.array(jnp.nan)))


def dyadic(random, low, high):
    """A random number with few digits, so that sums and products of a few such numbers are exact."""
    return round(random.uniform(low, high) * 16) / 16


def arm(*forces):
    body = planar.Body("arm", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "arm", point=(0.0, 0.0))
    return mb.Scene([body], joints=[pin], forces=[*forces]).compile()


def block(*forces, **more):
    return mb.Scene([planar.Body("block", mass=1.0, inertia=0.1, **more)], forces=[*forces]).compile()


class Case:
    """A law in a scene; `sample` gives numbers, coordinates and velocities at a kink, and the direction to its inside,
    of the numbers and of the coordinates.
    """

    value = staticmethod(lambda system, q, u: system.force(0.0, q, u))

    @functools.cached_property
    def compiled(self):
        """A function of the numbers, and its derivative along them and the coordinates."""
        system = self.scene()

        def of(numbers, q, u):
            return type(self).value(mb.with_parameters(system, numbers), q, u)

        derivative = lambda given, along, u: jax.jvp(lambda *x: of(*x, u), given, along)[1]
        return jax.jit(of), jax.jit(derivative), system

    def check(self, seed):
        value, derivative, system = self.compiled
        numbers, q, u, along, dq = self.sample(np.random.default_rng(seed), system)
        along = {name: along.get(name, np.zeros(np.shape(x))) for name, x in numbers.items()}
        numbers, along = ({name: jnp.asarray(x, float) for name, x in given.items()} for given in (numbers, along))
        q, u, dq = (jnp.asarray(x, float) for x in (q, u, np.zeros(len(q)) if dq is None else dq))
        moved = lambda k: value(jax.tree.map(lambda x, d: x + k * STEP * d, numbers, along), q + k * STEP * dq, u)
        expected = (-3 * moved(0) + 4 * moved(1) - moved(2)) / (2 * STEP)
        slope = derivative((numbers, q), (along, dq), u)
        size = float(jnp.max(jnp.abs(expected)) + jnp.max(jnp.abs(moved(0)))) + 1.0
        np.testing.assert_allclose(slope, expected, rtol=1e-5, atol=1e-6 * size)
        return float(jnp.max(jnp.abs(slope)))


class Control(Case):
    """The control of an actuator at an end of its range."""

    def scene(self):
        return arm(mb.Actuator("servo", "pin.angle", control_range=(-1.0, 1.0)))

    def sample(self, random, system):
        low = dyadic(random, -2, 2)
        high = low + dyadic(random, 0.5, 2)
        sign = random.choice([-1, 1])
        numbers = {"servo.control": low if sign > 0 else high, "servo.control_range": (low, high)}
        numbers["servo.gain"] = [dyadic(random, 1, 9) for _ in range(3)]
        return numbers, [0.5, 0.0, dyadic(random, -1, 1)], [0.0, 0.0, 0.5], {"servo.control": sign}, None


class Range(Control):
    """The ends of the range move, with the control at one of them; the control follows."""

    def sample(self, random, system):
        numbers, q, u, along, _ = super().sample(random, system)
        return numbers, q, u, {"servo.control": 2 * along["servo.control"], "servo.control_range": (1.0, -1.0)}, None


class ForceRange(Case):
    """The force of an actuator at an end of its range."""

    def scene(self):
        return arm(mb.Actuator("servo", "pin.angle", force_range=(-1.0, 1.0)))

    def sample(self, random, system):
        gain, control, sign = dyadic(random, 1, 4), dyadic(random, -2, 2), random.choice([-1, 1])
        limits = (gain * control, gain * control + 1.0) if sign > 0 else (gain * control - 1.0, gain * control)
        numbers = {"servo.control": control, "servo.gain": (gain, 0.0, 0.0), "servo.force_range": limits}
        return numbers, [0.5, 0.0, 0.0], np.zeros(3), {"servo.control": sign}, None


class Activation(Control):
    """The rate of an activation, for a control at an end of its range."""

    value = staticmethod(lambda system, q, u: system.with_states(jnp.array([0.25])).state_rates(0.0, q, u))

    def scene(self):
        return arm(mb.Actuator("servo", "pin.angle", control_range=(-1.0, 1.0), lag=0.5))


class FullThrottle(Case):
    """The control of a motor with a torque curve, at full control and at none."""

    def scene(self):
        curve = {"speeds": (0.0, 100.0, 200.0, 300.0), "torques": (0.8, 0.8, 0.5, 0.0)}
        return arm(mb.TableMotor("motor", "pin.angle", **curve))

    def sample(self, random, system):
        control, inward = [(1.0, -1.0), (-1.0, 1.0), (0.0, 1.0)][random.integers(3)]
        numbers = {"motor.control": control, "motor.gear": dyadic(random, 1, 20)}
        return numbers, [0.5, 0.0, 0.0], [0.0, 0.0, dyadic(random, 1, 9)], {"motor.control": inward}, None


class Unstretched(Case):
    """An elastic rope of just its length, at rest and swinging."""

    def scene(self):
        bob = planar.PointMass("bob", mass=1.0, position=(0.0, -1.0))
        rope = mb.Rope("rope", [("ground", (0.0, 0.0)), ("bob", (0.0, 0.0))], stiffness=1.0, damping=1.0)
        return mb.Scene([bob], joints=[rope]).compile()

    def sample(self, random, system):
        length = dyadic(random, 0.5, 4)
        numbers = {"rope.length": length, "rope.stiffness": 10 ** random.uniform(1, 5)}
        numbers["rope.damping"] = random.choice([0.0, 3.0])
        shorter = random.choice([0.0, 1.0])
        swing = [random.choice([0.0, 1.0]), 0.0]
        return numbers, [0.0, -length], swing, {"rope.length": -shorter}, [random.normal(), shorter - 2.0]


class RopeEnergy(Unstretched):
    """The gradient of the energy of such a rope."""

    value = staticmethod(lambda system, q, u: jax.grad(lambda q: system.potential_energy(0.0, q))(q))


class BumpEnds(Case):
    """A point on soft ground at the ends of a bump."""

    def scene(self):
        bump = mb.terrain.Bump(start=1.0, length=2.0, peak=0.5)
        return block(planar.Contact("floor", "block", terrain=bump, normal=mb.contact.Linear(1e4)))

    def sample(self, random, system):
        start, length, sign = dyadic(random, -2, 2), dyadic(random, 1, 4), random.choice([-1, 1])
        numbers = {"floor.terrain.start": start, "floor.terrain.length": length}
        numbers["floor.terrain.peak"] = random.normal()
        return numbers, [start if sign > 0 else start + length, -0.01, 0.0], np.zeros(3), {}, [sign, 0.0, 0.0]


class Touching(Case):
    """A disc that just touches soft ground: its law is smooth there."""

    def scene(self):
        laws = {"terrain": mb.terrain.Flat(), "normal": mb.contact.Linear(1e4), "damping": 10.0}
        return block(planar.Contact("floor", "block", radius=0.25, **laws))

    def sample(self, random, system):
        numbers = {"floor.smoothing": 10 ** random.uniform(-2, -1), "floor.damping": random.uniform(0, 10)}
        return numbers, [0.0, 0.25, 0.0], random.normal(size=3), {}, [0.0, random.choice([-1, 1]), 0.0]


class BoxEdge(Case):
    """The direction of a hard contact with a box, of a ball above an edge of its top: constant on the top."""

    value = staticmethod(lambda system, q, u: jax.jacfwd(lambda q: Instant(system, 0.0, q, u).gaps)(q))

    def scene(self):
        bodies = [planar.Body("ball", mass=1.0, inertia=0.1, position=(0.0, 2.0))]
        box = mb.RigidBoxContact("box", "ground", "ball", size=(2.0, 1.0), radius=0.25)
        return mb.Scene(bodies, joints=[box]).compile()

    def sample(self, random, system):
        size, sign = [dyadic(random, 0.5, 2) * 2 for _ in range(2)], random.choice([-1, 1])
        place = [0.5 * sign * size[0], 0.5 * size[1] + dyadic(random, 0.25, 1)]
        q = np.array(system.guess.q)
        q[:2] = place
        along = np.zeros_like(q)
        along[0] = -sign
        return {"box.size": size}, q, np.zeros(system.nu), {}, along


class GearEnds(Case):
    """A draft gear where slack, ramps and travel end: its law is smooth there."""

    def scene(self):
        cars = [planar.Body(name, mass=1.0, inertia=1.0, position=(x, 0.0)) for name, x in (("front", 4), ("rear", 0))]
        return mb.Scene(cars, forces=[planar.DraftGear("gear", "rear", "front", slack=0.25, smoothing=0.125)]).compile()

    def sample(self, random, system):
        numbers = {"gear.travel": 1.0, "gear.damping": random.choice([0.0, 5.0]), "gear.stiffness": 100.0}
        numbers |= {"gear.preload": 10.0, "gear.stop_stiffness": 1000.0, "gear.transition_speed": 0.5}
        stroke = random.choice([-0.0625, 0.0625, 0.9375, 1.0625])
        q = np.array(system.guess.q)
        q[0] += random.choice([-1, 1]) * (0.25 + stroke)
        along = np.zeros_like(q)
        along[0] = random.choice([-1, 1])
        u = np.zeros(system.nu)
        u[0] = random.choice([0.0, 1.0])
        return numbers, q, u, {}, along


CASES = [Control, Range, ForceRange, Activation, FullThrottle, Unstretched, RopeEnergy, BumpEnds, Touching]
CASES += [BoxEdge, GearEnds]


@pytest.mark.slow(but=("ForceRange",))
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_laws_at_kinks(case):
    """The derivative of the force is the one-sided difference from the inside of the law."""
    one = case()
    sizes = [one.check(seed) for seed in range(4)]
    assert max(sizes) > 0 or case is BoxEdge


@pytest.mark.slow
def test_linearisation_at_the_end_of_a_range():
    """A control at an end of its range, and within it: a torque of 10 times the control on an arm of 0.35 kg m²."""
    system = arm(mb.Actuator("servo", "pin.angle", gain=(10.0, 0.0, 0.0), control_range=(-1.0, 1.0)))
    for limits in ((-1.0, 1.0), (0.0, 1.0), (-1.0, 0.0)):
        changed = mb.with_parameters(system, {"servo.control_range": limits})
        found = np.asarray(mb.linearise(changed, mb.assemble(changed), inputs=["servo.control"]).B)
        np.testing.assert_allclose(found[1, 0], 10 / 0.35, rtol=1e-10)


@pytest.mark.slow
def test_equilibrium_of_a_rope_that_just_tightens():
    """A mass of 1 kg on a rope of 10 kN/m, which is just unstretched where it is given, hangs 0.981 mm lower."""
    bob = planar.PointMass("bob", mass=1.0, position=(0.0, -1.0))
    rope = mb.Rope("rope", [("ground", (0.0, 0.0)), ("bob", (0.0, 0.0))], stiffness=1e4)
    system = mb.Scene([bob], joints=[rope], forces=[G]).compile()
    np.testing.assert_allclose(mb.equilibrium(system).q, [0.0, -1.000981], atol=1e-10)
