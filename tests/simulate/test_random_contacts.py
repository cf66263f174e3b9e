"""Many random motions of scenes with several contacts: each runs to its end or ends in a named result, no bodies are
inside each other, and energy is never gained.
"""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar
from jaxmb.parts import terrain

pytestmark = pytest.mark.slow

MEMBERS, END = 12, 1.0
TIMES = np.linspace(0.0, END, 101)
DOWN = mb.Gravity((0.0, -9.81))


def _floor(body, **where):
    return mb.RigidContact(f"floor {body}", body, terrain=terrain.Flat(), **where)


def _rubs(contacts):
    return [mb.DryFriction(f"rub {part.name}", part.name, coefficient=0.3) for part in contacts]


def _disc(name, x, y, radius=0.2):
    return planar.Body(name, mass=1.0, inertia=0.5 * radius**2, position=(x, y))


def _discs(count, friction):
    """Discs side by side on a floor: contacts with it, and of each with the next."""
    discs = [_disc(f"disc{k}", 0.5 * k, 0.25) for k in range(count)]
    contacts = [_floor(disc.name, radius=0.2) for disc in discs]
    contacts += [
        mb.RigidBallContact(f"pair{k}", f"disc{k}", f"disc{k + 1}", radius_a=0.2, radius_b=0.2)
        for k in range(count - 1)
    ]
    return mb.Scene(discs, joints=contacts, forces=[DOWN, *(_rubs(contacts) if friction else [])]).compile()


def _block():
    """A block between a floor and a wall: four corners, two of which may meet the wall."""
    corners = {"sw": (-0.3, -0.2), "se": (0.3, -0.2), "ne": (0.3, 0.2), "nw": (-0.3, 0.2)}
    floors = [mb.RigidContact(f"floor {k}", "block", terrain=terrain.Flat(), centre=at) for k, at in corners.items()]
    walls = [
        mb.RigidPlaneContact(f"wall {k}", "ground", "block", point_a=(0.8, 0.0), point_b=corners[k], normal=(-1.0, 0.0))
        for k in ("se", "ne")
    ]
    block = planar.Body("block", mass=1.0, inertia=0.05, position=(0.2, 0.5))
    return mb.Scene([block], joints=[*floors, *walls], forces=[DOWN, *_rubs([*floors, *walls])]).compile()


def _linkage():
    """A double pendulum with stops, whose end may meet the floor."""
    bodies = [planar.Body("upper", mass=1.0, inertia=0.03, position=(0.3, 0.7), angle=0.0)]
    bodies += [planar.Body("lower", mass=1.0, inertia=0.03, position=(0.9, 0.7), angle=0.0)]
    joints = [
        planar.Revolute("hip", "ground", "upper", point=(0.0, 0.7)),
        planar.Revolute("knee", "upper", "lower", point=(0.6, 0.7)),
    ]
    tip = _floor("lower", centre=(0.3, 0.0))
    stops = [mb.Stop("hip stop", "hip.angle", lower=-1.4, upper=1.4), mb.Stop("knee stop", "knee.angle", upper=0.5)]
    rubs = [mb.DryFriction("rub hip", "hip", coefficient=0.2, radius=0.03), *_rubs([tip])]
    return mb.Scene(bodies, joints=[*joints, *stops, tip], forces=[DOWN, *rubs]).compile()


SCENES = {
    "two discs": lambda: _discs(2, friction=True),
    "three discs without friction": lambda: _discs(3, friction=False),
    "three discs": lambda: _discs(3, friction=True),
    "block": _block,
    "linkage": _linkage,
}


@pytest.mark.parametrize("name", SCENES)
def test_random_motions(name):
    system = SCENES[name]()
    state = mb.assemble(system)
    chance = np.random.default_rng(sorted(SCENES).index(name))
    names = [own for own in mb.parameters(system) if own.endswith((".restitution", ".coefficient"))]
    limit = {own: 0.9 if own.endswith("restitution") else 0.5 for own in names}
    given = {own: jnp.asarray(chance.uniform(0.0, limit[own], MEMBERS)) for own in names}
    modes = np.isin(np.arange(system.nu), [k for own, at in system.rate_names().items() if ".mode" in own for k in at])
    speeds = jnp.asarray(chance.normal(size=(MEMBERS, system.nu)) * np.where(modes, 0.0, 1.0))
    failed = 0
    for k in range(MEMBERS):
        own = mb.with_parameters(system, {name: value[k] for name, value in given.items()})
        start = mb.assemble(own, mb.State(state.q, speeds[k]))
        motion = mb.simulate(own, start, t1=END, saveat=TIMES, rtol=1e-8, max_events=400, throw=False)
        if motion.result != mb.RESULTS.successful:
            failed += 1
            continue
        energy = np.asarray(motion.energy)
        assert np.all(np.isfinite(energy))
        size = np.ptp(energy) + 1.0
        assert np.max(np.diff(energy)) <= 1e-7 * size
        assert np.min(motion.events.kinetic_energy_lost, initial=0.0) >= -1e-9 * size
        gaps = [motion[part].gap for part in own.contacts.contact_names if "stop" not in part]
        assert np.min(gaps) >= -1e-10 * float(system.length)
    assert failed <= 1
