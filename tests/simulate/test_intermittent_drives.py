"""Drives that move and rest by turns: compliant contacts that set in again and again, at any tolerance."""

import functools

import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar

pytestmark = pytest.mark.slow

# With the default tolerance where none is given.
TOLERANCES = {"coarse": {"rtol": 1e-4}, "medium": {"rtol": 1e-6}, "default": {}, "fine": {"rtol": 1e-10}}
DEFAULT = 1e-8


class Drive:
    """A system with the state and the times of its motion."""

    def __init__(self, bodies, joints, forces, start, times):
        self.system = mb.Scene(bodies, joints=joints, forces=forces).compile()
        self.state, self.times = mb.assemble(self.system, fix=start), times

    def motion(self, **options):
        t = self.times
        return mb.simulate(self.system, self.state, t1=t[-1], saveat=t, max_steps=100_000, **options)

    @functools.cached_property
    def exact(self):
        """With steps that are too short to pass over a contact."""
        return self.motion(rtol=1e-12, dtmax=self.times[-1] / 20_000)


# A Geneva wheel with four slots, which a pin enters and leaves along their direction, and a brake that holds it
# in between.
ARM, PIN, CLEARANCE, RATE, TURNS = 0.05, 0.004, 1e-4, 6.0, 4
APART = np.sqrt(2.0) * ARM


@functools.cache
def geneva():
    bodies = [
        planar.Body("crank", mass=0.5, inertia=5e-4, angle=np.pi),
        planar.Body("wheel", mass=0.5, inertia=2e-4, position=(APART, 0.0)),
    ]
    joints = [
        planar.Revolute("shaft", "ground", "crank", point=(0.0, 0.0)),
        planar.Revolute("axle", "ground", "wheel", point=(APART, 0.0)),
        mb.JointDriver("turn", "shaft.angle", value=np.pi, rate=RATE),
    ]
    along = np.array([[x, y] for x in (-1, 1) for y in (-1, 1)]) / np.sqrt(2.0)
    across = (PIN + CLEARANCE) * along @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    start, end = (np.concatenate([radius * along + across, radius * along - across]) for radius in (0.012, ARM))
    slots = planar.PlateContact(
        "slots",
        ("crank", *8 * ["wheel"]),
        normal=mb.contact.Linear(3e5),
        radius=PIN,
        centre=(ARM, 0.0),
        start=start,
        end=end,
        edge=1e-3,
        damping=100.0,
        damping_depth=1e-4,
        smoothing=1e-5,
    )
    brake = mb.JointSpring("brake", "axle.angle", stiffness=0.0, damping=2e-2)
    times = np.linspace(0.0, TURNS * 2 * np.pi / RATE, 200 * TURNS + 1)
    return Drive(bodies, joints, [slots, brake], {"wheel.angle": 0.0}, times)


def indexed(times):
    """The angle of the wheel where the pin has no play, and the distance of the pin from the wheel's axle."""
    turns, crank = np.divmod(RATE * times, 2 * np.pi)
    crank = np.clip(crank - np.pi, -np.pi / 4, np.pi / 4)
    x, y = ARM * np.cos(crank) - APART, ARM * np.sin(crank)
    return -np.pi / 2 * turns - np.pi / 4 + np.arctan2(y, x) % (2 * np.pi) - np.pi, np.hypot(x, y)


@pytest.mark.parametrize("name", TOLERANCES)
def test_a_geneva_wheel_turns_by_a_quarter_at_each_turn(name):
    drive, options = geneva(), TOLERANCES[name]
    motion, rtol = drive.motion(**options), options.get("rtol", DEFAULT)
    angle, radius = indexed(drive.times)
    wheel, exact = motion["wheel"], drive.exact["wheel"]
    # The pin moves by its clearance and by what the contact yields.
    assert np.max(np.abs(wheel.angle - angle) * radius) < 2 * CLEARANCE
    np.testing.assert_allclose(wheel.angle[::200], -np.pi / 2 * np.arange(TURNS + 1), atol=CLEARANCE / ARM)
    np.testing.assert_allclose(wheel.angle, exact.angle, rtol=0, atol=10 * rtol)
    np.testing.assert_allclose(wheel.angular_velocity, exact.angular_velocity, rtol=0, atol=300 * rtol)


# A weight turns a wheel, whose teeth push an anchor to and fro; the anchor's two pins stop them by turns.
TEETH, RADIUS, TIP, OVERLAP = 6, 0.03, 5e-4, 1.5e-4
PITCH, REACH = 2 * np.pi / TEETH, RADIUS + 2 * TIP
# The pins are one and a half pitches apart, and move towards the axle and away from it.
BESIDE = 0.75 * PITCH


@functools.cache
def escapement():
    pivot = (0.0, REACH / np.cos(BESIDE))
    bodies = [
        planar.Body("wheel", mass=0.1, inertia=1e-6),
        planar.Body("anchor", mass=0.1, inertia=2e-5, position=pivot),
    ]
    joints = [
        planar.Revolute("axle", "ground", "wheel", point=(0.0, 0.0)),
        planar.Revolute("pivot", "ground", "anchor", point=pivot),
    ]
    teeth = RADIUS * np.stack([f(PITCH * np.arange(TEETH)) for f in (np.cos, np.sin)], axis=1)

    def pallet(name, side):
        place = (REACH - OVERLAP) * np.array([side * np.sin(BESIDE), np.cos(BESIDE)])
        return planar.DiscContact(
            name,
            ("anchor", *TEETH * ["wheel"]),
            normal=mb.contact.Linear(1e4),
            radius=TIP,
            radii=TIP,
            centre=place - pivot,
            centres=teeth,
            damping=8.0,
            damping_depth=2e-6,
            smoothing=1e-6,
        )

    weight = mb.JointForce("weight", "axle.angle", force=-1e-4)
    oil = mb.JointSpring("oil", "pivot.angle", stiffness=0.0, damping=2e-3)
    forces = [weight, oil, pallet("entry", -1), pallet("exit", 1)]
    start = {"wheel.angle": 0.0, "anchor.angle": 0.0}
    return Drive(bodies, joints, forces, start, np.linspace(0.0, 3.0, 1001))


@pytest.mark.parametrize("name", TOLERANCES)
def test_an_escapement_lets_one_tooth_pass_at_each_swing(name):
    drive, options = escapement(), TOLERANCES[name]
    motion, rtol = drive.motion(**options), options.get("rtol", DEFAULT)
    wheel, anchor = (np.asarray(motion[body].angle) for body in ("wheel", "anchor"))
    # From one stop to the next, at the other pin, the wheel turns by half a pitch.
    moves = np.abs(anchor) > 1e-3
    changes = np.flatnonzero(np.diff(np.sign(anchor[moves])))
    way = (wheel[0] - wheel[moves][changes]) / (0.5 * PITCH)
    assert len(changes) == 17
    assert np.max(np.abs(way - way[0] - np.arange(17))) < 0.01
    for body in ("wheel", "anchor"):
        np.testing.assert_allclose(motion[body].angle, drive.exact[body].angle, rtol=0, atol=100 * rtol)
