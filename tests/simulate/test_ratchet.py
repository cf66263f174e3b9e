"""A ratchet whose teeth and pawl are discs without restitution, against events by hand."""

import jax.numpy as jnp
import numpy as np
import pytest
from oracles.ratchet import Ratchet, moved

import jaxmb as mb
from jaxmb import planar

START = (0.1, 0.3)
# The wheel turns to and fro; the tip comes to rest between two teeth, striking one and the other ever faster.
TURNS, LOCKS = Ratchet(drive=3.0), Ratchet()
MOMENTS = ("drive", "frequency", "damping", "stiffness", "free")


def _moments(x, v, t, p):
    wheel = p["drive"] * jnp.cos(p["frequency"] * t) - p["damping"] * v[0, 2]
    return jnp.zeros((2, 3)).at[0, 2].set(wheel).at[1, 2].set(-p["stiffness"] * (x[1, 2] - p["free"]))


def scene(ratchet):
    bodies = [
        planar.Body("wheel", mass=1.0, inertia=ratchet.inertias[0]),
        planar.Body("pawl", mass=1.0, inertia=ratchet.inertias[1], position=ratchet.pin),
    ]
    joints = [
        planar.Revolute("axle", "ground", "wheel", point=(0.0, 0.0)),
        planar.Revolute("pin", "ground", "pawl", point=ratchet.pin),
    ]
    contacts = [
        mb.RigidBallContact(
            f"tooth{k}",
            "wheel",
            "pawl",
            point_a=centre,
            point_b=(ratchet.length, 0.0),
            radius_a=ratchet.tooth,
            radius_b=ratchet.tip,
        )
        for k, centre in enumerate(ratchet.centres(0.0)[0])
    ]
    numbers = {name: getattr(ratchet, name) for name in MOMENTS}
    moments = mb.Force("moments", ["wheel", "pawl"], _moments, parameters=numbers)
    return mb.Scene(bodies, joints=[*joints, *contacts], forces=[moments]).compile()


@pytest.mark.slow
def test_ratchet_turns_and_locks():
    system = scene(LOCKS)
    state = mb.assemble(system, fix=dict(zip(("wheel.angle", "pawl.angle"), START, strict=True)))
    for ratchet, end in ((TURNS, 1.2), (LOCKS, 0.5)):
        changed = mb.with_parameters(system, {f"moments.{name}": getattr(ratchet, name) for name in MOMENTS})
        motion = mb.simulate(changed, state, t1=end, saveat=[end], rtol=1e-10, max_events=100)
        q, u, events = moved(ratchet, START, (0.0, 0.0), end)
        bodies = motion["wheel"], motion["pawl"]
        np.testing.assert_allclose([body.angle[0] for body in bodies], q, atol=1e-8)
        np.testing.assert_allclose([body.angular_velocity[0] for body in bodies], u, atol=1e-8)
        # The last strikes between two teeth are too low to be seen.
        count = len(motion.events.times) - (ratchet is LOCKS)
        assert motion.stats["num_events"] == len(motion.events.times)
        assert count == len(events) if ratchet is TURNS else 8 <= count <= len(events)
        np.testing.assert_allclose(motion.events.times[:count], [time for time, _ in events][:count], atol=1e-8)
        for closed, (_, known) in zip(motion.events.after[:count], events, strict=False):
            assert tuple(np.flatnonzero(closed)) == known
