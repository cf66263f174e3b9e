"""Contact laws of a user, against closed forms: restitution and friction that depend on the speed."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import parts, planar
from jaxmb.formulations import Multipliers, accelerations
from jaxmb.parts.modes import CLOSED

MOST_PROGRAMS = 70

G, HEIGHT = 9.81, 1.0
GRAVITY = mb.Gravity((0.0, -G))


class Softened(parts.AbstractImpactLaw):
    slow: jax.Array
    speed: jax.Array

    def ratio(self, closing):
        return self.slow / (1 + closing / self.speed)


class SoftContact(mb.RigidContact):
    speed: parts.Number = parts.parameter(unit="m/s", sign="positive", default=1.0)

    @property
    def contact_law(self):
        return Softened(self.restitution, self.speed)


class Lubricated(parts.AbstractSlipLaw):
    dry: jax.Array
    viscous: jax.Array

    def coefficient(self, speed):
        return self.dry + self.viscous * speed

    def limit(self):
        return self.dry


class OilyFriction(mb.DryFriction):
    viscous: parts.Number = parts.parameter(unit="s/m", sign="non-negative", default=0.0)

    @property
    def contact_law(self):
        return Lubricated(self.coefficient, self.viscous)


@functools.cache
def falling():
    """A point that falls on soft ground, and one beside it that falls on ground of another law."""
    names = ("soft", "hard")
    points = [planar.PointMass(name, mass=1.0, position=(x, HEIGHT)) for x, name in enumerate(names)]
    floors = [
        SoftContact("soft floor", "soft", terrain=mb.terrain.Flat(), restitution=0.8, speed=3.0),
        mb.RigidContact("hard floor", "hard", terrain=mb.terrain.Flat(), restitution=0.6),
    ]
    return mb.Scene(points, joints=floors, forces=[GRAVITY]).compile()


def times_of_impacts(ratio, count):
    """Of a point that falls from the height, and bounces."""
    closing, times = np.sqrt(2 * G * HEIGHT), [np.sqrt(2 * HEIGHT / G)]
    while len(times) < count:
        closing *= ratio(closing)
        times.append(times[-1] + 2 * closing / G)
    return np.array(times)


@pytest.mark.slow
def test_restitution_that_depends_on_the_speed():
    """Times of impacts of two laws in one scene, and their derivatives."""
    system = falling()
    state = mb.assemble(system)
    own = lambda e, v: times_of_impacts(lambda closing: e / (1 + closing / v), 4)
    others = times_of_impacts(lambda closing: 0.6, 2)

    def run(numbers):
        changed = mb.with_parameters(system, {"soft floor.restitution": numbers[0], "soft floor.speed": numbers[1]})
        motion = mb.simulate(changed, state, t1=1.05, max_events=8)
        return motion.events.times

    numbers = jnp.array([0.8, 3.0])
    times, slopes = jax.jit(lambda x: (run(x), jax.jacfwd(run)(x)))(numbers)
    expected = np.sort(np.concatenate([own(0.8, 3.0), others[1:]]))
    np.testing.assert_allclose(times[:5], expected, rtol=1e-8)
    of_soft, h = np.isin(expected, own(0.8, 3.0)), 1e-6
    for k, step in enumerate(h * np.eye(2)):
        along = (own(*(numbers + step)) - own(*(numbers - step))) / (2 * h)
        np.testing.assert_allclose(slopes[:5, k][of_soft], along, rtol=1e-6, atol=1e-8)


def on_oil(mu, c, start):
    """A point that slides on a floor."""
    body = planar.PointMass("body", mass=1.0, velocity=(start, 0.0))
    floor = mb.RigidContact("floor", "body", terrain=mb.terrain.Flat())
    rub = OilyFriction("rub", "floor", coefficient=mu, viscous=c)
    return mb.Scene([body], joints=[floor], forces=[GRAVITY, rub]).compile()


def test_friction_that_depends_on_the_speed():
    """`v' = −(μ + c v) g` in slip, and μ is the limit of stick."""
    system = on_oil(0.2, 0.3, 2.0)
    q = system.contacts.with_modes(system.guess.q, np.array([CLOSED, 1.0]))
    found = jax.jit(lambda u: accelerations(system, Multipliers(), jnp.zeros(()), q, u)[0][0])
    for speed in (0.5, 2.0):
        udot = found(system.guess.u.at[0].set(speed))
        np.testing.assert_allclose(udot, -(0.2 + 0.3 * speed) * G, rtol=1e-12)
    np.testing.assert_allclose(system.contact_laws(0.0).slip.ask("limit"), [0.2])


@pytest.mark.slow
def test_point_on_oil_slides_to_its_stop():
    """Until `v' = −(μ + c v) g` has used up its velocity."""
    mu, c, start = 0.2, 0.3, 2.0
    system = on_oil(mu, c, start)

    @jax.jit
    def run(state):
        motion = mb.simulate(system, state, t1=1.0, max_events=2)
        return motion.events.times, motion["body"].position[-1, 0]

    closed = system.contacts.with_modes(system.guess.q, np.array([CLOSED, 0.0]))
    times, x = run(mb.State(closed, system.guess.u))
    stop = np.log(1 + c * start / mu) / (c * G)
    np.testing.assert_allclose(times, [stop, np.inf], rtol=1e-8)
    way = (start + mu / c) * (1 - np.exp(-c * G * stop)) / (c * G) - mu / c * stop
    np.testing.assert_allclose(x, way, rtol=1e-8)


class NoLaw(SoftContact):
    @property
    def contact_law(self):
        return 0.5


class TwoRatios(Softened):
    def ratio(self, closing):
        return jnp.ones(2)


class TwiceSoft(SoftContact):
    @property
    def contact_law(self):
        return TwoRatios(self.restitution, self.speed)


class Held(Lubricated):
    resists = True


class HeldFriction(OilyFriction):
    @property
    def contact_law(self):
        return Held(self.coefficient, self.viscous)


@pytest.mark.parametrize(
    "kind, friction, message",
    [
        (NoLaw, None, r"NoLaw 'floor': contact_law must be a parts\.AbstractImpactLaw, got float\."),
        (TwiceSoft, None, r"TwiceSoft 'floor': contact_law\.ratio must return shape \(\), got \(2,\)\."),
        (mb.RigidContact, HeldFriction, "HeldFriction 'rub': a contact has no friction without a normal force"),
    ],
    ids=["none", "shape", "resists"],
)
def test_contact_law_that_is_refused(kind, friction, message):
    body = planar.PointMass("body", mass=1.0)
    rubs = [friction("rub", "floor", coefficient=0.1)] if friction else []
    with pytest.raises(ValueError, match=message):
        mb.Scene([body], joints=[kind("floor", "body", terrain=mb.terrain.Flat())], forces=rubs).compile()
