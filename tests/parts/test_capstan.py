"""Friction of ropes on pulleys against Euler's and Eytelwein's formula: stick and slip, their times, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.formulations import Multipliers, accelerations
from jaxmb.system.quantities import Solved

G, R = 9.81, 0.1
GRAVITY = mb.Gravity((0.0, -G))


def instant(system, state, t=0.0):
    """Quantities by name at one state."""
    udot, multipliers = accelerations(system.at(state), Multipliers(), t, state.q, state.u)
    along = jnp.full(1, t), jax.tree.map(lambda x: x[None], state), Solved(udot[None], multipliers[None])
    return lambda name: np.asarray(system.quantities()[name].value(*along)[0])


def point(name, mass, *position, **state):
    return planar.PointMass(name, mass=mass, position=position, **state)


def wheel(inertia, *position, name="wheel", **state):
    return planar.Body(name, mass=1.0, inertia=inertia, position=position, **state)


def axle(body, *at):
    return planar.Revolute(f"{body} axle", "ground", body, point=at)


def hoist(left=1.0, right=3.0, *, friction=0.2, turns=0.0, dimension=2):
    """Two loads on a rope over a drum that stands still."""
    if dimension == 2:
        loads = [point("left", left, -R, -1.0), point("right", right, R, -1.2)]
        over, gravity = {}, GRAVITY
    else:
        loads = [
            spatial.PointMass("left", mass=left, position=(-R, 0.0, -1.0)),
            spatial.PointMass("right", mass=right, position=(R, 0.0, -1.2)),
        ]
        over, gravity = {"axis": (0.0, -1.0, 0.0)}, mb.Gravity((0.0, 0.0, -G))
    drum = mb.Pulley("ground", R, "right", turns=turns, friction=friction, **over)
    path = [("left", np.zeros(dimension)), drum, ("right", np.zeros(dimension))]
    return mb.Scene(loads, joints=[mb.Rope("rope", path)], forces=[gravity]).compile()


def slips(system, mode, **fix):
    return instant(system, mb.assemble(system, fix={"rope.mode": mode, **fix}))


# Euler's and Eytelwein's formula


@pytest.mark.parametrize("mode", [1, -1])
@pytest.mark.parametrize("dimension, turns", [(2, 0.0), (2, 2.0), (3, 3.0)])
def test_the_capstan_equation(dimension, turns, mode):
    """Half a turn and some full turns on the drum: `T₂ = T₁ e^(μ φ)`, against the slip."""
    system = hoist(turns=turns, dimension=dimension)
    own, growth = slips(system, mode), np.exp(mode * 0.2 * np.pi * (1 + 2 * turns))
    a = G * (3.0 - growth) / (3.0 + growth)
    np.testing.assert_allclose(own("rope.wrap"), [np.pi * (1 + 2 * turns)], rtol=1e-12)
    np.testing.assert_allclose(own("right.acceleration")[-1], -a, rtol=1e-10)
    np.testing.assert_allclose(own("left.acceleration")[-1], a, rtol=1e-10)
    np.testing.assert_allclose(own("rope.tension"), (G + a) * np.array([1.0, growth]), rtol=1e-10)


@pytest.mark.parametrize("mode", [2, 0])
def test_stick_holds_the_loads(mode):
    """Before the start of a motion there is no friction."""
    own = slips(hoist(), mode)
    a = 0.0 if mode else 0.5 * G
    np.testing.assert_allclose(own("left.acceleration")[1], a, atol=1e-12)
    tensions = G * np.array([1.0, 3.0]) if mode else np.full(2, 1.5 * G)
    np.testing.assert_allclose(own("rope.tension"), tensions, rtol=1e-12)


def over_two(first=0.2, second=0.3, grips=None):
    """A rope over two drums, the second below a ceiling; one of them may turn."""
    bodies = [point("left", 1.0, -R, -1.0), point("right", 4.0, 1.0 + R, -1.2), wheel(0.02, 0.5, -0.6)]
    spin = {"grips": True} if grips else {}
    path = [
        ("left", (0.0, 0.0)),
        mb.Pulley("ground", R, "right", friction=first),
        mb.Pulley("wheel", R, "left", **spin),
        mb.Pulley("ground", R, "right", (1.0, 0.0), friction=second),
        ("right", (0.0, 0.0)),
    ]
    return mb.Scene(bodies, joints=[axle("wheel", 0.5, -0.6), mb.Rope("rope", path)], forces=[GRAVITY]).compile()


@pytest.mark.parametrize("modes", [(1, 1), (-1, -1), (2, 2), (0, 0)])
def test_a_rope_that_rubs_on_two_pulleys(modes):
    system = over_two()
    own = instant(system, mb.assemble(system, fix={"rope.mode_1": modes[0], "rope.mode_2": modes[1]}))
    wraps, mu = own("rope.wrap"), np.array([0.2, 0.3])
    if modes[0] == 2:
        np.testing.assert_allclose(own("right.acceleration"), 0.0, atol=1e-12)
        tension = own("rope.tension")
        np.testing.assert_allclose(tension[[0, 2]], [G, 4.0 * G], rtol=1e-12)
        return
    growth = np.exp(np.array(modes) * mu * wraps[[0, 2]])
    total = np.prod(growth)
    a = G * (4.0 - total) / (4.0 + total)
    np.testing.assert_allclose(own("right.acceleration")[1], -a, rtol=1e-10)
    np.testing.assert_allclose(own("rope.tension"), (G + a) * np.array([1.0, growth[0], total]), rtol=1e-10)
