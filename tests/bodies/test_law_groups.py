"""Rows of stops and of friction in joints that know the rates of their coordinates: those of automatic
differentiation.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import spatial
from jaxmb.system.instant import Instant

AXIS = (0.48, 0.64, 0.6)
BODIES = [
    spatial.Body("a", mass=1.0, inertia=(0.1, 0.2, 0.3), position=(0.0, 0.0, 0.0)),
    spatial.Body("b", mass=2.0, inertia=(0.2, 0.2, 0.3), position=(1.0, 0.2, 0.1)),
]
# Each joint with the coordinate that a stop limits, and what rubs.
JOINTS = {
    "revolute": (spatial.Revolute, "angle", {"radius": 0.1}),
    "cylindrical": (spatial.Cylindrical, "displacement", {"radius": 0.1}),
    "screw": (spatial.Screw, "angle", {"radius": 0.1}),
    "prismatic": (spatial.Prismatic, "displacement", {}),
    "planar": (spatial.Planar, "angle", {}),
}


class OwnStop(mb.Stop):
    """A stop of a user, whose gap is known only as a function."""

    def gap(self, space, poses):
        return 1.0 * super().gap(space, poses)


class OwnFriction(mb.DryFriction):
    """Friction of a user, whose slip is known only as a function: from the coordinates."""

    def slip(self, space, poses, velocities):
        lengths = lambda part, x: part._lengths(part.joints["0"].coordinates_at(space, x))
        return mb.parts.rate_of(space, self, lengths, poses, velocities)[1]


@pytest.mark.slow(but=("revolute", "planar"))
@pytest.mark.parametrize("name", JOINTS)
def test_rates_of_coordinates_give_the_rows_of_stops_and_friction(name):
    kind, coordinate, options = JOINTS[name]
    joint = kind("joint", "a", "b", point=(0.4, 0.1, 0.0), axis=AXIS, **({"pitch": 0.3} if name == "screw" else {}))
    of = "joint.angle" if name == "screw" else "joint"

    def scene(stop, friction):
        limits = stop("stop", f"joint.{coordinate}", lower=-0.5, upper=0.9, restitution=0.5)
        rub = friction("rub", of, coefficient=0.3, **options)
        return mb.Scene(BODIES, joints=[joint, limits], forces=[rub]).compile()

    systems = [scene(mb.Stop, mb.DryFriction), scene(OwnStop, OwnFriction)]
    moves = mb.State(systems[0].guess.q, np.random.default_rng(0).normal(size=systems[0].nu))
    state = mb.assemble(systems[0], moves, fix={f"joint.{coordinate}": 0.3})

    def laws(system):
        at = Instant(system, jnp.zeros(()), state.q, state.u)
        return at.contact_place, at.contact_motion

    own, expected = jax.jit(lambda: [laws(system) for system in systems])()
    for found, known in zip(jax.tree.leaves(own), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(found, known, rtol=1e-11, atol=1e-11)
    assert np.all(np.abs(own[1].rates) > 1e-2)
