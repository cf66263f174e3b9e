"""Rigid contacts are the limit of compliant ones, and keep their energy over many impacts."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar

pytestmark = pytest.mark.slow


# A contact of stiffness k lasts for π √(m / k), in which time a rigid one does not move: the error falls with 1 / √k.
STIFFNESSES = (1e8, 1e10, 1e12)


def converges_to(rigid, compliant):
    """States with compliant contacts of each stiffness come closer to that with rigid ones, at the rate of theory."""
    errors = [np.max(np.abs(compliant(k) - rigid)) for k in STIFFNESSES]
    assert np.all(np.diff(errors) < 0) and errors[-1] <= 1e2 / np.sqrt(STIFFNESSES[-1])
    np.testing.assert_allclose(errors[-2] / errors[-1], 10.0, rtol=0.1)


def train(couplings):
    """Ten cars of different masses, the first of which moves; its impacts run through the slack of the couplings."""
    masses = 1.0 + 0.4 * np.sin(1.0 + np.arange(10))
    cars = [
        planar.Body(f"car{k}", mass=m, inertia=1.0, position=(-2.0 * k, 0.0), velocity=(float(k == 0), 0.0))
        for k, m in enumerate(masses)
    ]
    before = ["ground", *(car.name for car in cars)]
    rails = [
        planar.Prismatic(f"rail{k}", before[k], f"car{k}", axis=(-1.0, 0.0), point=(-2.0 * k, 0.0)) for k in range(10)
    ]
    stops = [couplings(f"slack{k}", f"rail{k}.displacement") for k in range(1, 10)]
    rigid = isinstance(stops[0], mb.Stop)
    return mb.Scene(cars, joints=rails + stops * rigid, forces=stops * (not rigid)).compile()


def test_train_with_slack():
    slack = {"lower": -0.5, "upper": 0.05}

    def end(system):
        motion = mb.simulate(system, mb.assemble(system), t1=1.0, saveat=[1.0], rtol=1e-10, max_steps=100_000)
        return np.array([motion[f"car{k}"].position[0, 0] for k in range(10)])

    rigid = train(lambda *names: mb.Stop(*names, **slack, restitution=1.0))
    compliant = lambda k: train(lambda *names: mb.JointStop(*names, **slack, stiffness=k, smoothing=1e-2 / np.sqrt(k)))
    converges_to(end(rigid), lambda k: end(compliant(k)))


def slider_crank(pin):
    """With clearance in the pin between crank and rod; `pin` is a part between their ends."""
    bodies = [
        planar.Body("crank", mass=1.0, inertia=0.1, position=(0.15, 0.0), angular_velocity=10.0, velocity=(0.0, 1.5)),
        planar.Body("rod", mass=0.8, inertia=0.08, position=(0.8, 0.0), velocity=(0.0, 1.5), angular_velocity=-3.0),
        planar.Body("piston", mass=0.5, inertia=0.1, position=(1.3, 0.0)),
    ]
    joints = [
        planar.Revolute("main", "ground", "crank", point=(0.0, 0.0)),
        planar.Revolute("wrist", "rod", "piston", point=(1.3, 0.0)),
        planar.Prismatic("bore", "ground", "piston", axis=(1.0, 0.0), point=(1.3, 0.0)),
    ]
    rigid = isinstance(pin, mb.Slack)
    return mb.Scene(bodies, joints=joints + [pin] * rigid, forces=[pin] * (not rigid)).compile()


ENDS = {"point_a": (0.15, 0.0), "point_b": (-0.5, 0.0)}
CLEARANCE = 0.002


def bearing(k):
    """A force that pulls the ends of crank and rod together where they are further apart than the clearance."""

    def law(x, v, t, p):
        turned = lambda x, r: x[:2] + jnp.stack([jnp.cos(x[2]) * r[0], jnp.sin(x[2]) * r[0]])
        a, b = turned(x[0], ENDS["point_a"]), turned(x[1], ENDS["point_b"])
        d = b - a
        length = jnp.sqrt(jnp.dot(d, d) + 1e-30)
        force = p["stiffness"] * jnp.maximum(length - CLEARANCE, 0.0) * d / length
        wrench = lambda x, at, f: jnp.append(f, (at - x[:2])[0] * f[1] - (at - x[:2])[1] * f[0])
        return jnp.stack([wrench(x[0], a, force), wrench(x[1], b, -force)])

    return mb.Force("pin", ["crank", "rod"], law, parameters={"stiffness": k})


def test_slider_crank_with_clearance():
    def run(system):
        return mb.simulate(system, mb.assemble(system), t1=0.0375, saveat=[0.0375], rtol=1e-11, max_steps=100_000)

    end = lambda motion: np.array([motion["crank"].angle[0], motion["rod"].angle[0], motion["piston"].position[0, 0]])
    rigid = run(slider_crank(mb.Slack("pin", "crank", "rod", **ENDS, length=CLEARANCE, restitution=1.0)))
    assert len(rigid.events) == 3
    converges_to(end(rigid), lambda k: end(run(slider_crank(bearing(k)))))


def test_energy_over_a_thousand_impacts():
    """A mass on a spring rattles between two stops: no energy comes in, and what is lost is what impacts take."""
    system = mb.Scene(
        [planar.Body("mass", mass=1.0, inertia=1.0, velocity=(10.0, 0.0))],
        joints=[
            planar.Prismatic("rail", "ground", "mass", axis=(1.0, 0.0), point=(0.0, 0.0)),
            mb.Stop("stop", "rail.displacement", lower=-0.1, upper=0.1, restitution=0.9999),
        ],
        forces=[mb.JointSpring("spring", "rail.displacement", stiffness=3.0)],
    ).compile()
    rtol, times = 1e-10, np.linspace(0.0, 35.0, 101)
    motion = mb.simulate(
        system, mb.assemble(system), t1=35.0, saveat=times, rtol=rtol, max_steps=10**5, max_events=2_000
    )
    events, start = motion.events, motion.energy[0]
    assert len(events.times) >= 1_000
    assert np.max(np.diff(motion.energy)) <= rtol * start
    lost = np.cumsum(np.asarray(events.kinetic_energy_lost))[np.searchsorted(np.asarray(events.times), times) - 1]
    np.testing.assert_allclose(motion.energy[1:], start - lost[1:], atol=1e3 * rtol * start)
    assert np.max(np.abs(np.asarray(motion["mass"].position[:, 0]))) <= 0.1 + 1e-11
