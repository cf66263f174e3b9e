"""Ropes in space and ropes that go slack: derivatives of their motions, and a motion over many turns of a drum."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxmb as mb
from jaxmb import planar, spatial

G = 9.81
DOWN = {2: mb.Gravity((0.0, -G)), 3: mb.Gravity((0.0, 0.0, -G))}
# Seen against it x points to the right and z up.
AXIS = (0.0, -1.0, 0.0)
# Compiled sooner than the default.
METHOD = {"solver": diffrax.Dopri8(), "manifold": mb.manifold.Projection(), "max_steps": 4096}


def derivatives_agree(end, values, rtol=1e-5, atol=1e-6):
    """Forwards, backwards and differences of a tighter solution, in a batch of two."""
    x, unravel = ravel_pytree(values)
    x = jnp.stack([x, 1.01 * x])
    at = lambda x, rtol: end(unravel(x), rtol)
    forward = jax.jit(jax.vmap(jax.jacfwd(lambda x: at(x, 1e-9))))(x)
    reverse = jax.jit(jax.vmap(jax.jacrev(lambda x: at(x, 1e-9))))(x)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-9)
    h = 1e-5
    moved = x[:, None, None] + h * np.array([1.0, -1.0])[:, None, None] * np.eye(x.shape[1])
    ends = jax.jit(jax.vmap(lambda x: at(x, 1e-12)))(moved.reshape(-1, x.shape[1])).reshape(*moved.shape[:3], -1)
    difference = (ends[:, 0] - ends[:, 1]) / (2 * h)
    assert np.all(np.isfinite(difference)) and np.all(np.max(np.abs(difference), axis=2) > 1e-3)
    np.testing.assert_allclose(np.swapaxes(forward, 1, 2), difference, rtol=rtol, atol=atol)


def crane(**rope):
    """A drum with a motor winds up a rope over a sheave, and the load on it swings sideways."""
    wheel = lambda name, m, r, x, z, **state: spatial.Body(
        name, mass=m, inertia=spatial.disc(m, r, "y"), position=(x, 0.0, z), **state
    )
    bodies = [
        wheel("drum", 5.0, 0.2, -1.0, 0.5, angular_velocity=(0.0, -8.0, 0.0)),
        wheel("sheave", 1.0, 0.1, 0.0, 0.0, angular_velocity=(0.0, -16.0, 0.0)),
        spatial.PointMass("load", mass=2.0, position=(0.5, 0.0, -3.0), velocity=(0.0, 0.8, 1.6)),
    ]
    axles = [spatial.Revolute(f"{x.name} axle", "ground", x.name, point=x.position, axis=AXIS) for x in bodies[:2]]
    sheave = mb.Pulley("sheave", 0.1, "right", grips=not rope, axis=AXIS)
    path = [mb.Pulley("drum", 0.2, "right", turns=3.0, axis=AXIS), sheave, ("load", (0.0, 0.0, 0.0))]
    motor = mb.JointForce("motor", "drum axle.angle", force=6.0)
    return mb.Scene(bodies, joints=[*axles, mb.Rope("rope", path, **rope)], forces=[motor, DOWN[3]]).compile()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The velocities given with the bodies")
@pytest.mark.parametrize("rope", [{}, {"stiffness": 400.0, "length": 7.9}], ids=["gripping", "elastic"])
def test_a_crane_that_swings_while_its_drum_turns(rope):
    """The drum turns by more than a turn."""
    system = crane(**rope)
    known = mb.parameters(system)
    names = ["rope.radii", "load.mass", "motor.force", *(f"rope.{name}" for name in rope)]

    def moved(values, rtol):
        changed = mb.with_parameters(system, values)
        return mb.simulate(changed, mb.assemble(changed), t1=0.8, rtol=rtol, **METHOD)

    def end(values, rtol):
        motion = moved(values, rtol)
        return jnp.append(motion["load"].position[-1], jnp.ravel(motion["rope"].tension[-1])[-1])

    values = {name: known[name] for name in names}
    derivatives_agree(end, values)
    motion = moved(values, 1e-9)
    assert abs(motion["drum axle"].angle[-1]) > 2 * np.pi and abs(motion["load"].position[-1, 1]) > 0.1


@pytest.mark.slow
def test_a_winch_that_hoists_a_swinging_load():
    """The length of the rope is an input; the load swings in both directions."""
    load = spatial.PointMass("load", mass=3.0, position=(0.8, 0.0, -1.5), velocity=(0.0, 0.9, 0.0))
    path = [("ground", (-2.0, 0.0, 0.2)), mb.Pulley("ground", 0.2, "right", axis=AXIS), ("load", (0.0, 0.0, 0.0))]
    system = mb.Scene([load], joints=[mb.Rope("rope", path)], forces=[DOWN[3]]).compile()
    known = mb.parameters(system)
    values = {"rate": jnp.array(0.7), "rope.radii": known["rope.radii"], "start": known["rope.length"]}

    def end(values, rtol):
        changed = mb.with_parameters(system, {"rope.radii": values["rope.radii"]})
        inputs = {"rope.length": lambda t: values["start"] - values["rate"] * t}
        start = mb.assemble(mb.with_inputs(changed, inputs))
        motion = mb.simulate(changed, start, t1=0.8, inputs=inputs, rtol=rtol, **METHOD)
        return jnp.append(motion["load"].position[-1], motion["rope"].tension[-1])

    derivatives_agree(end, values)


@pytest.mark.slow
@pytest.mark.parametrize("restitution", [0.0, 0.5])
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_slack_rope_that_tightens(dimension, restitution):
    """A load is thrown until its rope is tight: it then swings on it, or rebounds."""
    at = lambda x, z: (x, z) if dimension == 2 else (x, 0.0, z)
    own, axis = (planar, {}) if dimension == 2 else (spatial, {"axis": AXIS})
    sideways = (0.5, 0.0) if dimension == 2 else (0.5, 0.8, 0.0)
    load = own.PointMass("load", mass=1.5, position=at(0.6, -0.3), velocity=sideways)
    path = [("ground", at(-0.5, 0.1)), mb.Pulley("ground", 0.1, "right", **axis), ("load", at(0.0, 0.0))]
    rope = mb.Rope("rope", path, length=1.6, slack=True, restitution=restitution)
    system = mb.Scene([load], joints=[rope], forces=[DOWN[dimension]]).compile()
    known = mb.parameters(system)
    values = {name: known[name] for name in ("rope.length", "rope.radii", "gravity.acceleration")}

    def moved(values, rtol):
        changed = mb.with_parameters(system, values)
        return mb.simulate(changed, mb.assemble(changed), t1=0.5, rtol=rtol)

    def end(values, rtol):
        motion = moved(values, rtol)
        return jnp.append(motion["load"].position[-1], motion["rope"].tension[-1])

    (event,) = moved(values, 1e-9).events
    assert event.kind == ("impact" if restitution else "close")
    derivatives_agree(end, values)


@pytest.mark.slow
def test_a_load_that_unwinds_a_drum_in_space():
    """Over forty turns it swings sideways on a rope that grows longer, and keeps its energy."""
    r = 0.1
    drum = spatial.Body("drum", mass=8.0, inertia=spatial.disc(8.0, r, "y"))
    load = spatial.PointMass("load", mass=2.0, position=(r, 0.0, -1.0), velocity=(0.1, 0.5, 0.0))
    axle = spatial.Revolute("axle", "ground", "drum", point=(0.0, 0.0, 0.0), axis=AXIS)
    rope = mb.Rope("rope", [mb.Pulley("drum", r, "right", turns=50.0, axis=AXIS), ("load", (0.0, 0.0, 0.0))])
    system = mb.Scene([drum, load], joints=[axle, rope], forces=[DOWN[3]]).compile()
    motion = mb.simulate(system, mb.assemble(system), t1=4.2, saveat=np.linspace(0.0, 4.2, 8), rtol=1e-9)
    wrap, free = motion["rope"].wrap[:, 0], 1.0 + r * 100 * np.pi - r * motion["rope"].wrap[:, 0]
    assert wrap[0] - wrap[-1] > 80 * np.pi
    fallen = 2.0 * G * np.ptp(motion["load"].position[:, 2])
    np.testing.assert_allclose(motion.energy, motion.energy[0], rtol=0, atol=1e-6 * fallen)
    # The free part is as long as the rope that has left the drum.
    x, y, z = motion["load"].position.T
    straight = np.sqrt(x**2 + y**2 + z**2 - r**2)
    np.testing.assert_allclose(straight, free, rtol=1e-9)
