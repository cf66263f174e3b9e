"""Studies of motions with impacts and dry friction: identification, and a design whose number of impacts changes."""

import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar

pytestmark = pytest.mark.slow

G = 9.81


def test_restitution_and_friction_from_a_recorded_motion():
    """A block slides on a rail, rebounds from a stop and comes to rest; its motion in closed form is the record."""
    coefficient, restitution, v0 = 0.25, 0.55, 3.0
    block = planar.Body("block", mass=2.0, inertia=1.0, velocity=(v0, 0.0))
    rail = planar.Prismatic("rail", "ground", "block", axis=(1.0, 0.0), point=(0.0, 0.0))
    stop = mb.Stop("end", "rail.displacement", upper=1.0, restitution=0.8)
    forces = [mb.Gravity((0.0, -G)), mb.DryFriction("rub", "rail", coefficient=0.15)]
    system = mb.Scene([block], joints=[rail, stop], forces=forces).compile()

    ts, a = np.linspace(0.02, 1.6, 40), coefficient * G
    v1 = np.sqrt(v0**2 - 2 * a)
    t1 = (v0 - v1) / a
    rest = t1 + restitution * v1 / a
    assert ts[9] < t1 < rest < ts[-10]
    s = np.minimum(ts, rest) - t1
    recorded = np.where(ts < t1, v0 * ts - a * ts**2 / 2, 1.0 - restitution * v1 * s + a * s**2 / 2)
    free = {"rub.coefficient": 0.15, "end.restitution": 0.8}
    fit = mb.identify(system, {"rail.displacement": recorded}, ts=ts, free=free, rtol=1e-9)
    assert fit.converged
    np.testing.assert_allclose(fit.parameters["rub.coefficient"], coefficient, rtol=1e-9)
    np.testing.assert_allclose(fit.parameters["end.restitution"], restitution, rtol=1e-9)


def test_a_design_across_a_change_in_the_number_of_impacts():
    """How hard one disc is pushed so that two of them end where they should: at first it does not reach the other.

    The derivative of each trial is that of its own number of impacts.
    """
    masses, restitution, drag, gap, t1 = (1.0, 2.0), 0.5, 2.0, 0.5, 2.0
    discs = [planar.Body(f"disc{k}", mass=m, inertia=0.01, position=(0.7 * k, 0.0)) for k, m in enumerate(masses)]
    rails = [planar.Prismatic(f"rail{k}", "ground", f"disc{k}", axis=(1.0, 0.0), point=(0.0, 0.0)) for k in range(2)]
    radii = {"radius_a": 0.1, "radius_b": 0.1}
    meet = mb.RigidBallContact("meet", "disc0", "disc1", **radii, restitution=restitution)
    drags = [mb.JointSpring(f"drag{k}", f"rail{k}.displacement", stiffness=0.0, damping=drag) for k in range(2)]
    system = mb.Scene(discs, joints=[*rails, meet], forces=drags).compile()

    def exact(speed):
        """The sum of both places at the end, and the number of impacts."""
        slow, other = (drag / m for m in masses)
        path = lambda v, rate, t: v / rate * (1 - np.exp(-rate * t))
        if path(speed, slow, t1) <= gap:
            return 0.7 + path(speed, slow, t1), 0
        t, w = -np.log(1 - gap * slow / speed) / slow, speed - slow * gap
        own, given = masses[0] - restitution * masses[1], masses[0] * (1 + restitution)
        ways = path(own / sum(masses) * w, slow, t1 - t), path(given / sum(masses) * w, other, t1 - t)
        return 0.7 + gap + sum(ways), 1

    def places(values):
        state = mb.assemble(system, rates={"rail0.displacement": values["speed"]})
        motion = mb.simulate(system, state, t1=t1, rtol=1e-10, max_steps=300)
        return motion["disc0"].position[-1, 0] + motion["disc1"].position[-1, 0]

    target, start = exact(2.5)[0], {"speed": 0.6}
    assert (exact(2.5)[1], exact(0.6)[1]) == (1, 0)
    np.testing.assert_allclose(places(start), exact(0.6)[0], rtol=1e-9)
    best = mb.optimise(lambda values: (places(values) - target) ** 2, start, bounds={"speed": (0.1, 5.0)})
    assert best.success
    np.testing.assert_allclose(best.parameters["speed"], 2.5, rtol=1e-6)
