"""Scenes that are made of others, and parts that cannot act on a point mass."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

import jaxmb as mb
from jaxmb import contact, parts, planar, spatial, terrain


def test_scene_is_extended():
    scene = mb.mechanisms.get("four_bar").scene
    mass, mark = planar.PointMass("mass", mass=1.0), planar.Frame("mark", "crank", position=(0.1, 0.0))
    rod = planar.Distance("rod", "ground", "mass", point_a=(0.0, 0.0), length=1.0)
    motor = planar.Torque("motor", "crank", torque=1.0)
    more = scene.extended(bodies=[mass], joints=[rod], forces=[motor], frames=[mark], without=["D"])
    assert more.bodies == (*scene.bodies, mass) and more.frames == (mark,)
    assert more.joints == (*(own for own in scene.joints if own.name != "D"), rod)
    assert more.forces == (*scene.forces, motor)
    with pytest.raises(ValueError, match="without: Unknown part 'E'"):
        scene.extended(without=["E"])
    with pytest.raises(ValueError, match="motor"):
        more.extended(forces=[motor])


FLAT = (planar.Body("bar", mass=1.0, inertia=0.1, position=(1.0, 0.5), angle=0.3), planar.PointMass("mass", mass=1.0))
DEEP = (
    spatial.Body("bar", mass=1.0, inertia=(1.0, 1.0, 1.0), position=(1.0, 0.5, 0.2)),
    spatial.PointMass("mass", mass=1.0, position=(0.3, 0.2, 0.1)),
)
PAIR = ("part", "bar", "mass")
BOTH = {"stiffness": 10.0, "damping": 1.0}


def compiled(bodies, part):
    joints, forces = ((), [part]) if isinstance(part, parts.AbstractForce) else ([part], ())
    return mb.Scene(bodies, joints=joints, forces=forces).compile()


def turning(poses, velocities, t, parameters):
    return jnp.stack([1.0, 0.0, parameters["moment"]])[None]


def turning_by_difference(poses, velocities, t, parameters):
    return jnp.stack([1.0, 0.0, parameters["a"] - parameters["b"]])[None]


def turning_by_network(poses, velocities, t, parameters):
    return parameters["net"](poses[0, :2])[None]


# A network whose weights are all zero, as before a training that starts from no force.
ZERO = jax.tree.map(jnp.zeros_like, eqx.nn.Linear(2, 3, key=jax.random.key(0)))


TURNING = [
    (FLAT, planar.TorsionalSpringDamper(*PAIR, stiffness=0.0, damping=1.0)),
    (DEEP, spatial.RotationalDamper("part", "ground", "mass", damping=1.0)),
    (FLAT, planar.Bushing(*PAIR, stiffness=(1.0, 1.0, 1.0), point=(0.0, 0.0))),
    (FLAT, planar.SpringDamper("part", "ground", "mass", **BOTH, point_b=(0.0, 1.0))),
    (FLAT, planar.PointForce("part", "mass", force=(0.0, 0.0), point=(1.0, 0.0))),
    (FLAT, planar.Torque("part", "mass", torque=0.0)),
    (FLAT, mb.RigidContact("part", "mass", terrain=terrain.Flat(), centre=(0.1, 0.0))),
    (FLAT, mb.Force("part", "mass", turning, parameters={"moment": 0.0})),
    (FLAT, mb.Force("part", "mass", turning_by_network, parameters={"net": ZERO})),
]
ALSO_TURNING = [
    (FLAT, planar.TorsionalSpringDamper("part", "ground", "mass", **BOTH)),
    (DEEP, spatial.Bushing(*PAIR, stiffness=(1.0,) * 6, point=(0.3, 0.2, 0.1))),
    (DEEP, spatial.PointForce("part", "mass", force=(0.0, 0.0, 0.0), point=(1.0, 0.0, 0.0))),
    (DEEP, spatial.Torque("part", "mass", torque=(0.0, 0.0, 0.0))),
    (FLAT, mb.Force("part", "mass", turning_by_difference, parameters={"a": 1.0, "b": 1.0})),
]
THROUGH_THE_CENTRE = [
    (FLAT, planar.Bushing(*PAIR, stiffness=(1.0, 1.0, 0.0), damping=(1.0, 1.0, 0.0), point=(0.0, 0.0))),
    (FLAT, planar.SpringDamper(*PAIR, **BOTH, point_a=(0.1, 0.1))),
    (DEEP, spatial.PointForce("part", "mass", force=(0.0, 0.0, 0.0), frame="body")),
    (FLAT, planar.Revolute(*PAIR, point=(0.0, 0.0))),
]


def check_refused(cases):
    for bodies, part in cases:
        with pytest.raises(ValueError, match="'part' acts on the rotation of a PointMass, which has none"):
            compiled(bodies, part)


def test_point_mass_takes_no_part_that_would_turn_it():
    """Also none without a moment at the given poses: a spring at rest, an open contact, an input that is zero."""
    check_refused(TURNING)
    for bodies, part in THROUGH_THE_CENTRE:
        compiled(bodies, part)


@pytest.mark.slow
def test_point_mass_takes_no_other_part_that_would_turn_it():
    check_refused(ALSO_TURNING)
    bushing = spatial.Bushing(*PAIR, stiffness=(1.0,) * 3 + (0.0,) * 3, point=(0.3, 0.2, 0.1))
    discs = planar.DiscContact(*PAIR[:1], PAIR[1:], radii=0.1, normal=contact.Linear(1e4), radius=0.1)
    for bodies, part in ((DEEP, bushing), (FLAT, discs)):
        compiled(bodies, part)
