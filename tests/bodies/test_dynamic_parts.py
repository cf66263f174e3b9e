"""Internal states of joints, contacts and bodies, against closed forms and SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flexible_bodies import PlanarSlider
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

import jaxmb as mb
from jaxmb import parts, planar, spatial
from jaxmb.formulations import Multipliers, accelerations
from jaxmb.parts.modes import CLOSED

MOST_PROGRAMS = 90

G = 9.81
GRAVITY = mb.Gravity((0.0, -G))


class FadingFriction(mb.DryFriction, parts.AbstractDynamicPart):
    """Friction that fades to a half."""

    fade: parts.Number = parts.internal_state(unit="1")
    lag: parts.Number = parts.parameter(unit="s", sign="positive")

    @property
    def contact_law(self):
        return parts.Coulomb(self.coefficient * (1 - self.fade), None)

    def state_rates(self, space, poses, velocities, t):
        return {"fade": (0.5 - self.fade) / self.lag}


class Bristle(parts.AbstractNonIdeal, parts.AbstractDynamicPart):
    """Dahl's law in a pin: the moment follows the angle, and never exceeds its limit."""

    name: str = parts.name()
    joint: str = parts.name()
    arm: parts.Number = parts.parameter(unit="m", sign="non-negative")
    stiffness: parts.Number = parts.parameter(unit="1/rad", sign="positive")
    bend: parts.Number = parts.internal_state(unit="1")

    def wrenches(self, space, poses, velocities, reactions, t):
        moment = self.arm * self.bend * mb.rotations.norm(reactions[-1, :2])
        return jnp.zeros_like(velocities).at[-1, 2].set(-moment)

    def state_rates(self, space, poses, velocities, t):
        rate = velocities[-1, 2]
        return {"bend": self.stiffness * (rate - jnp.abs(rate) * self.bend)}


class MaxwellSlider(PlanarSlider, parts.AbstractDynamicPart):
    """A bob on a spring, beside a spring in line with a damper."""

    beside: parts.Number = parts.parameter(unit="N/m", sign="positive")
    lag: parts.Number = parts.parameter(unit="s", sign="positive")
    pull: parts.Number = parts.internal_state(unit="N")

    def internal_force(self, space, zeta, rates):
        return -self.pull[None]

    def state_rates(self, space, poses, velocities, t):
        return {"pull": self.beside * velocities[1, 0] - self.pull / self.lag}


def fading(start, mu, lag):
    """A point that slides on a floor."""
    body = planar.PointMass("body", mass=1.0, velocity=(start, 0.0))
    floor = mb.RigidContact("floor", "body", terrain=mb.terrain.Flat())
    rub = FadingFriction("rub", "floor", coefficient=mu, lag=lag)
    return mb.Scene([body], joints=[floor], forces=[GRAVITY, rub]).compile()


def test_friction_of_a_contact_is_that_of_its_internal_state():
    system = fading(2.0, 0.4, 0.3)
    assert system.state_names() == {"rub.fade": [0]} and "rub.lag" in mb.parameters(system)
    q = system.contacts.with_modes(system.guess.q, np.array([CLOSED, 1.0]))
    found = jax.jit(lambda y: accelerations(system.at(y), Multipliers(), jnp.zeros(()), y.q, y.u)[0])
    udot = found(mb.State(q, system.guess.u, jnp.array([0.3])))
    np.testing.assert_allclose(udot[:2], [-0.4 * (1 - 0.3) * G, 0.0], rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_friction_of_a_contact_that_fades():
    """The time at which a point stops on a floor, and its derivative."""
    start, mu, lag = 2.0, 0.4, 0.3
    system = fading(start, mu, lag)
    closed = system.contacts.with_modes(system.guess.q, np.array([CLOSED, 0.0]))

    @jax.jit
    def run(lag):
        own = mb.with_parameters(system, {"rub.lag": lag})
        motion = mb.simulate(own, mb.State(closed, system.guess.u, system.guess.z), t1=1.0, max_events=2)
        return motion.events.times[0], motion["rub"].fade[-1]

    # v' = −μ g (1 − fade), fade = (1 − e^(−t / lag)) / 2
    speed = lambda t, lag: start - G * mu * (t - 0.5 * (t - lag * (1 - np.exp(-t / lag))))
    stop = lambda lag: brentq(speed, 0.3, 1.5, (lag,), xtol=1e-14)
    (time, fade), (slope, _) = jax.jit(lambda x: jax.jvp(run, (x,), (jnp.ones(()),)))(jnp.asarray(lag))
    np.testing.assert_allclose(time, stop(lag), rtol=1e-8)
    np.testing.assert_allclose(fade, 0.5 * (1 - np.exp(-1.0 / lag)), rtol=1e-8)
    np.testing.assert_allclose(slope, (stop(lag + 1e-5) - stop(lag - 1e-5)) / 2e-5, rtol=1e-6)


@pytest.mark.slow
def test_joint_with_a_bristle():
    """The moment depends on the reaction of the pin, and on an internal state."""
    bar = planar.Body("bar", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))
    rub = Bristle("rub", "pin", arm=0.05, stiffness=5.0)
    system = mb.Scene([bar], joints=[pin], forces=[GRAVITY, rub]).compile()

    def rates(t, y):
        angle, rate, bend = y
        c, s = np.cos(angle), np.sin(angle)

        def unmet(a):
            force = 0.5 * np.array([-c * rate**2 - s * a, -s * rate**2 + c * a]) + np.array([0.0, G])
            return 0.35 * a + 0.5 * G * c + 0.05 * bend * np.linalg.norm(force)

        return [rate, brentq(unmet, -1e3, 1e3, xtol=1e-13), 5.0 * (rate - abs(rate) * bend)]

    motion = mb.simulate(system, mb.assemble(system), t1=1.0, rtol=1e-9)
    expected = solve_ivp(rates, (0.0, 1.0), np.zeros(3), rtol=1e-11, atol=1e-12).y[:, -1]
    found = [motion["bar"].angle[-1], motion["bar"].angular_velocity[-1], motion["rub"].bend[-1]]
    np.testing.assert_allclose(found, expected, atol=1e-8)
    # What the law does is known of a saved motion too.
    normal = np.linalg.norm(motion.reactions["pin"].force[-1])
    np.testing.assert_allclose(motion.forces["rub"][-1, -1, 2], -0.05 * expected[2] * normal, rtol=1e-6)


def test_body_with_an_internal_state():
    """The relative motion of a box and its bob, which are free, is linear."""
    case, bob, k, beside, lag = 1.0, 0.5, 40.0, 30.0, 0.2
    numbers = {"bob": bob, "stiffness": k, "beside": beside, "lag": lag}
    box = MaxwellSlider("box", mass=case + bob, inertia=0.1, **numbers)
    system = mb.Scene([box]).compile()
    place = system.coordinate_names()["box.slide"][0]
    state = mb.State(system.guess.q.at[place].set(0.1), system.guess.u, system.guess.z)

    @jax.jit
    def run(state):
        ys = mb.simulate(system, state, t1=1.0, rtol=1e-9).ys
        return ys.q[-1, place], ys.z[-1, 0]

    slide, pull = run(state)
    mass = case * bob / (case + bob)
    matrix = np.array([[0.0, 1.0, 0.0], [-k / mass, 0.0, -1 / mass], [0.0, beside, -1 / lag]])
    expected = expm(matrix) @ [0.1, 0.0, 0.0]
    np.testing.assert_allclose([slide, pull], expected[[0, 2]], atol=1e-8)


class PlanarRocket(planar.AbstractRigidBody, parts.AbstractDynamicPart):
    """A body that loses mass, with no velocity beside its own."""

    dry: parts.Number = parts.parameter(unit="kg", sign="positive")
    flow: parts.Number = parts.parameter(unit="kg/s", sign="positive")
    inertia: parts.Number = parts.parameter(unit="kg m²", shape=None)
    fuel: parts.Number = parts.internal_state(unit="kg")

    @property
    def mass(self):
        return self.dry + self.fuel

    def state_rates(self, space, poses, velocities, t):
        return {"fuel": -self.flow}


class SpatialRocket(spatial.AbstractRigidBody, parts.AbstractDynamicPart):
    """The same in space."""

    dry: parts.Number = parts.parameter(unit="kg", sign="positive")
    flow: parts.Number = parts.parameter(unit="kg/s", sign="positive")
    inertia: parts.Number = parts.parameter(unit="kg m²", shape=(3, 3))
    fuel: parts.Number = parts.internal_state(unit="kg")
    mass, state_rates = PlanarRocket.mass, PlanarRocket.state_rates


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "space", "inertia"),
    [(PlanarRocket, planar, 1.0), (SpatialRocket, spatial, np.eye(3))],
    ids=["plane", "space"],
)
def test_body_that_loses_mass_speeds_up_as_a_rocket(kind, space, inertia):
    """Tsiolkovsky: v = F / ṁ ln(m₀ / m), and its derivative by the flow."""
    dry, fuel, flow, force = 2.0, 3.0, 1.5, 4.0
    rocket = kind("rocket", dry=dry, fuel=fuel, flow=flow, inertia=inertia)
    push = space.PointForce("push", "rocket", force=force * np.eye(space.Body.dimensions[0])[0])
    system = mb.Scene([rocket], forces=[push]).compile()

    def speed(flow):
        changed = mb.with_parameters(system, {"rocket.flow": flow})
        return mb.simulate(changed, changed.guess, t1=1.0, rtol=1e-10, atol=1e-12).ys.u[-1, 0]

    expected = lambda flow: force / flow * jnp.log((dry + fuel) / (dry + fuel - flow))
    found = jax.jit(lambda x: (*jax.jvp(speed, (x,), (1.0,)), jax.grad(speed)(x)))(flow)
    slope = jax.grad(expected)(flow)
    np.testing.assert_allclose(found, [expected(flow), slope, slope], rtol=1e-8)


class Lagging(parts.AbstractConstraint, parts.AbstractDynamicPart):
    name: str = parts.name()
    body: str = parts.body_name()
    rows = 1
    rheonomic = False
    height: parts.Number = parts.internal_state(unit="m")

    def residual(self, space, poses, t):
        return (poses[0, 1] - self.height)[None]

    def state_rates(self, space, poses, velocities, t):
        return {"height": -self.height}


class NoRates(PlanarSlider):
    pull: parts.Number = parts.internal_state(unit="N")


class OtherRates(MaxwellSlider):
    def state_rates(self, space, poses, velocities, t):
        return {"push": jnp.zeros(())}


SLIDER = {"mass": 1.5, "inertia": 0.1, "bob": 0.5, "stiffness": 40.0}
BAD = {
    "rows": (
        lambda: mb.Scene([planar.PointMass("body", mass=1.0)], joints=[Lagging("lift", "body")]),
        "Lagging 'lift': its residual must not depend on its internal states",
    ),
    "no rates": (lambda: mb.Scene([NoRates("box", **SLIDER)]), "derive it from AbstractDynamicPart"),
    "other rates": (
        lambda: mb.Scene([OtherRates("box", beside=1.0, lag=1.0, **SLIDER)]),
        "state_rates must return a dictionary of the internal states, pull",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_internal_states_that_are_refused(case):
    scene, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        scene().compile()
