"""Bodies whose frame has its origin off the mass centre: one rule for the points of all parts."""

import inspect

import jax.numpy as jnp
import numpy as np
import pytest
from every_part import EXAMPLES

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.formulations import Partitioned, accelerations
from jaxmb.parts import AbstractBody, AbstractCompound, AbstractForce, AbstractPotentialForce, fields
from jaxmb.parts.base import AbstractLink, AbstractVelocityConstraint
from jaxmb.parts.frames import LinkFrame
from jaxmb.parts.planar.kinematics import PLANE
from jaxmb.parts.spatial.kinematics import SPACE

MOST_PROGRAMS = 200

CENTRE = {2: np.array([0.3, -0.2]), 3: np.array([0.3, -0.2, 0.1])}


def points_at_the_origin(cls):
    """The fields of body-fixed points that are the origin where they are left out, with the number of the body; None
    for points on several bodies.
    """
    found = {}
    for name, own in fields.declarations(cls).items():
        if (own.is_point and own.body is not None and (own.at_origin or _zero_by_default(cls, name))) or (
            cls.__name__.endswith("Driver") and name in ("point_a", "point_b")
        ):
            found[name] = own.body
        elif name == "centres":
            found[name] = None
    return found


def _zero_by_default(cls, name):
    default = cls.__dataclass_fields__[name].default
    return isinstance(default, tuple) and not any(default)


PARTS = {
    cls: points_at_the_origin(cls)
    for module in (planar, spatial, mb)
    for _, cls in inspect.getmembers(module, inspect.isclass)
    if issubclass(cls, AbstractLink) and not cls.__name__.startswith("Abstract") and points_at_the_origin(cls)
}


def test_all_that_may_leave_out_a_point_are_here():
    names = {cls.__name__ for cls in PARTS}
    assert names >= {
        "SpringDamper",
        "Damper",
        "PointForce",
        "Contact",
        "Tyre",
        "RollingSphere",
        "RollingDisc",
        "Driver",
    }
    assert names >= {"Distance", "PlateContact", "DiscContact", "KnifeEdge", "DraftGear"}


def examples():
    """An example of each of these parts in each space, without the points that may be left out."""
    out = {}
    for name, example in EXAMPLES.items():
        cls = type(example.part)
        if cls in PARTS and getattr(example.part, "quantity", "") != "angle":
            left_out = {
                field: None if cls.__dataclass_fields__[field].default is None else np.zeros(_dimension(example))
                for field in PARTS[cls]
            }
            out[name] = example.part.with_fields(**left_out), example.bodies
    return out


def _dimension(example):
    return example.bodies[0].dimension


WITHOUT_POINTS = examples()


def evaluated(part, space, frames, poses, velocities):
    """All that the kernels of a part return on these frames; the part has every number filled in."""
    own = part.components() if isinstance(part, AbstractCompound) else (part,)
    out = []
    for single in own:
        single = single.with_fields(body_frames=frames)
        seen = single.seen(space, poses, velocities)
        if isinstance(single, AbstractForce):
            out.append(single.wrenches_on_bodies(space, poses, single.wrenches(space, *seen, 0.1)))
            if isinstance(single, AbstractPotentialForce) and single.conservative:
                out.append(single.energy(space, seen[0], 0.1))
        elif isinstance(single, AbstractVelocityConstraint):
            out.append(single.residual(space, *seen, 0.1))
        else:
            out.append(single.residual(space, seen[0], 0.1))
    return out


LONG = ("Contact", "Tyre", "spatial")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * any(own in name for own in LONG)) for name in WITHOUT_POINTS]
)
def test_a_point_that_is_left_out_is_the_origin_of_the_frame(name):
    """On a body with its mass centre elsewhere the part is that with its points given where the origin is."""
    part, bodies = WITHOUT_POINTS[name]
    d, rng = bodies[0].dimension, np.random.default_rng(1)
    space, centre, known = (PLANE if d == 2 else SPACE), CENTRE[d], {body.name: body for body in bodies}
    poses = np.stack([known[own].pose() if own in known else np.asarray(space.ground) for own in part.bodies])
    velocities = np.stack([rng.normal(size=space.velocity_size) * (own in known) for own in part.bodies])
    frames = {str(k): LinkFrame(name=own, body=own, centre=centre) for k, own in enumerate(part.bodies) if own in known}
    # The points where the origin is, in frames at the mass centres.
    of_body = [-centre if own in known else 0.0 * centre for own in part.bodies]
    given = {
        field: np.stack(of_body[len(of_body) - _count(part, field) :]) if body is None else of_body[body]
        for field, body in PARTS[type(part)].items()
    }
    left_out = part.resolve(space, part.with_fields(body_frames=frames).seen_poses(space, poses))
    by_hand = part.with_fields(**given).resolve(space, poses)
    at = np.stack([space.prepare(np.asarray(pose)) for pose in poses]), velocities
    for found, expected in zip(
        evaluated(left_out, space, frames, *at), evaluated(by_hand, space, {}, *at), strict=True
    ):
        scale = 1.0 + np.max(np.abs(expected), initial=0.0)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * scale)
    assert not any(isinstance(part, AbstractBody) for part in (left_out, by_hand))


def _count(part, field):
    """For how many of its bodies, the last ones, a part has points in a field."""
    return len(part.bodies) - (1 if field == "centres" and hasattr(part, "radii") else 0)


# Scenes


def free(dimension, centre):
    """A free body with a spin, given by the pose of its frame."""
    if dimension == 2:
        own = {"position": (1.0, 2.0), "angle": 0.5, "velocity": (0.3, 0.1), "angular_velocity": 2.0, "inertia": 0.1}
        return planar.Body("b", mass=1.0, centre=centre, **own)
    turn = np.array([0.8, 0.0, 0.6, 0.0])
    own = {"position": (1.0, 2.0, 0.5), "orientation": turn, "angular_velocity": (0.4, -1.0, 2.0)}
    return spatial.Body("b", mass=1.0, inertia=(0.1, 0.2, 0.25), velocity=(0.3, 0.1, 0.0), centre=centre, **own)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_changed_centre_is_that_of_a_new_scene(dimension):
    old, new = np.zeros(dimension), CENTRE[dimension]
    system = mb.Scene([free(dimension, old)]).compile()
    changed = mb.with_parameters(system, {"b.centre": new}).guess
    expected = mb.Scene([free(dimension, new)]).compile().guess
    np.testing.assert_allclose(changed.q, expected.q, rtol=0, atol=1e-15)
    np.testing.assert_allclose(changed.u, expected.u, rtol=0, atol=1e-15)


@pytest.mark.slow
def test_functions_see_and_act_on_the_frame():
    """A force at the end of a rod, whose frame has its origin there, and laws of the joint with the floor."""
    half, mu = 0.4, 0.3

    def pull(poses, velocities, t, p):
        return jnp.stack([3.0 * poses[0, 0], 4.0 - velocities[0, 1], 0.5])

    def rub(poses, velocities, reactions, t, p):
        force = -mu * jnp.abs(reactions[-1, 1]) * jnp.tanh(velocities[-1, 0] / 1e-2)
        wrench = jnp.stack([force, jnp.zeros_like(force), 0.1 * reactions[-1, 2]])
        return jnp.stack([-wrench, wrench])

    def at_mass_centre(poses, velocities, reactions, t, p):
        """`rub`, from what is seen at the mass centre."""
        x, y = -half * jnp.cos(poses[-1, 2]), -half * jnp.sin(poses[-1, 2])
        moment = reactions[-1, 2] - (x * reactions[-1, 1] - y * reactions[-1, 0])
        force = -mu * jnp.abs(reactions[-1, 1]) * jnp.tanh((velocities[-1, 0] - velocities[-1, 2] * y) / 1e-2)
        wrench = jnp.stack([force, jnp.zeros_like(force), 0.1 * moment - y * force])
        on_ground = jnp.stack([-force, jnp.zeros_like(force), -0.1 * moment])
        return jnp.stack([on_ground, wrench])

    def scene(centre, *laws):
        position, end = ((0.0, 0.0), (0.0, 0.0)) if centre else ((half, 0.0), (-half, 0.0))
        rod = planar.Body("rod", mass=1.0, inertia=0.1, centre=centre, position=position)
        floor = planar.PointOnLine("floor", "ground", "rod", point_a=(0.0, 0.0), point_b=end, axis_a=(1.0, 0.0))
        return mb.Scene([rod], joints=[floor], forces=[*laws, mb.Gravity((0.0, -9.81))]).compile()

    c, s = np.cos(0.7), np.sin(0.7)
    q, u = jnp.array([half * c + 0.2, half * s, 0.7]), jnp.array([1.0 - half * s * 2.0, half * c * 2.0, 2.0])
    solve = lambda system: accelerations(system, Partitioned(), 0.0, q, u)
    friction = planar.Friction("rub", "floor", coefficient=mu, transition_speed=1e-2)
    forces = (
        planar.PointForce("end", "rod", force=(0.6, 4.0), point=(-half, 0.0)),
        planar.Torque("T", "rod", torque=0.5),
    )
    law = lambda function: mb.NonIdeal("rub", "floor", function)
    for of_frame, of_centre in (
        ([mb.Force("pull", "rod", pull), law(rub)], [*forces, law(at_mass_centre)]),
        ([friction], [friction]),
        ([friction.with_fields(point=np.array([0.3, 0.0]))], [friction.with_fields(point=np.array([0.3 - half, 0.0]))]),
    ):
        pairs = zip(solve(scene((half, 0.0), *of_frame)), solve(scene(None, *of_centre)), strict=True)
        for found, expected in pairs:
            np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
