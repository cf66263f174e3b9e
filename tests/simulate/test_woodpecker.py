"""The woodpecker toy: a sleeve with play on a bar, and a bird on a spring that strikes it, in a limit cycle of impacts,
stick and slip.

Source: R. I. Leine, Ch. Glocker and D. H. van Campen, "Nonlinear dynamics of the woodpecker toy", Proc. DETC'01, ASME,
2001, with the numbers of Ch. Glocker, "Dynamik von Starrkörpersystemen mit Reibung und Stößen", VDI, 1995.
"""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar
from jaxmb.parts import AbstractRigidContact, fields

pytestmark = pytest.mark.slow


class Guide(AbstractRigidContact):
    """A point of a body at `arm` beside its centre, which a small turn brings to the bar, at x = −clearance."""

    name: str = fields.name()
    body: str = fields.body_name()
    clearance: fields.Number = fields.length()
    gain: fields.Number = fields.parameter(unit="m/rad")
    arm: fields.Number = fields.length()

    def gap(self, space, poses):
        return self.clearance + poses[0, 0] + self.gain * poses[0, 2]

    def touching(self, space, poses):
        return poses[0, :2] + jnp.stack([self.arm, 0 * self.arm])


BAR, SLEEVE, HALF, TO_SPRING, TO_BIRD, BEAK, REACH = 2.5e-3, 3.1e-3, 5.8e-3, 1e-2, 1.5e-2, 2e-2, 2.01e-2
SPRING = 5.6e-3
# On the limit cycle: the height of the sleeve, the angles of sleeve and bird, and their rates.
START, RATES = (0.0, -0.1036, -0.2788), (-0.3411, 0.0, -7.4583)


def toy():
    def at(values):
        # The geometry of small angles: the bird is above the sleeve by what both turn.
        return values[0] + TO_SPRING * values[1] + TO_BIRD * values[2]

    def spring(x, v, t, parameters):
        moment = SPRING * (x[1, 2] - x[0, 2])
        return jnp.stack([jnp.stack([0 * t, 0 * t, moment]), jnp.stack([0 * t, 0 * t, -moment])])

    def guided(x, t, parameters):
        return jnp.stack([x[0, 0], x[1, 0], x[1, 1] - at((x[0, 1], x[0, 2], x[1, 2]))])

    sleeve = planar.Body(
        "sleeve",
        mass=3e-4,
        inertia=5e-9,
        position=(0.0, START[0]),
        angle=START[1],
        velocity=(0.0, RATES[0]),
        angular_velocity=RATES[1],
    )
    bird = planar.Body(
        "bird",
        mass=4.5e-3,
        inertia=7e-7,
        position=(0.0, at(START)),
        angle=START[2],
        velocity=(0.0, at(RATES)),
        angular_velocity=RATES[2],
    )
    contacts = [
        Guide("beak", "bird", clearance=TO_SPRING + TO_BIRD - REACH - BAR, gain=-BEAK, arm=-REACH, restitution=0.5),
        Guide("lower", "sleeve", clearance=SLEEVE - BAR, gain=HALF, arm=SLEEVE),
        Guide("upper", "sleeve", clearance=SLEEVE - BAR, gain=-HALF, arm=SLEEVE),
    ]
    rubs = [mb.DryFriction(f"rub {part.name}", part.name, coefficient=0.3) for part in contacts]
    link = mb.Constraint("link", ["sleeve", "bird"], guided, rows=3, rheonomic=False)
    gravity, bend = mb.Gravity((0.0, -9.81)), mb.Force("spring", ["sleeve", "bird"], spring)
    return mb.Scene([sleeve, bird], joints=[link, *contacts], forces=[gravity, bend, *rubs]).compile()


def test_the_woodpecker_comes_down_in_its_limit_cycle():
    system = toy()
    state = mb.assemble(system, fix={"lower.mode": 1})
    motion = mb.simulate(system, state, t1=0.35, saveat=np.linspace(0.1, 0.2, 10001), rtol=1e-9)
    events = [(event.part, event.kind) for event in motion.events if event.time > 0.12]
    cycle = [
        ("lower", "close"),
        ("rub lower", "slip"),
        ("rub lower", "stick"),
        ("rub lower", "slip"),
        ("lower", "open"),
        ("upper", "impact"),
        ("rub upper", "impact"),
        ("beak", "impact"),
        ("rub beak", "impact"),
        ("upper", "close"),
        ("rub upper", "slip"),
        ("upper", "open"),
        ("lower", "impact"),
        ("rub lower", "impact"),
    ]
    assert events[: len(cycle)] == cycle
    assert events[len(cycle) :] == cycle[:3]
    # One turn later the bird passes the same angle, with the velocities that were published.
    angle = motion["bird"].angle
    later = 1 + np.flatnonzero((angle[:-1] > START[2]) & (angle[1:] <= START[2]))[0]
    found = [motion["sleeve"].velocity[later, 1], motion["bird"].angular_velocity[later]]
    np.testing.assert_allclose(found, [RATES[0], RATES[2]], rtol=1e-2)
    np.testing.assert_allclose(motion["sleeve"].angle[later], START[1], rtol=1e-2)
