"""Every part in a scene: it compiles, moves on its constraints, has derivatives, finds its equilibrium, and is known
when it stands twice.

Each part has bodies of its own. All parts of a space in one scene share the few programs that are compiled for it;
alone, with another method of integration, each has programs without anything of the others.
"""

import dataclasses
import functools
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.formulations import Multipliers, accelerations
from jaxmb.parts import (
    AbstractBody,
    AbstractCompound,
    AbstractConstraint,
    AbstractForce,
    AbstractNonIdeal,
    AbstractVelocityConstraint,
    contact,
    terrain,
)

CONSTRAINTS = (AbstractConstraint, AbstractVelocityConstraint, AbstractCompound)
TIMES = jnp.array([0.08, 0.2])


@dataclasses.dataclass
class Example:
    """A part with the bodies that it acts on, and with other parts that hold these.

    `parameter` is the name of what derivatives are taken with respect to, without that of the part. `rests`: whether
    the scene has a static equilibrium. `ideal`: whether its constraints bind positions or velocities and obey
    d'Alembert's principle.
    """

    part: Any
    bodies: list
    parameter: str
    joints: tuple = ()
    forces: tuple = ()
    rests: bool = True
    ideal: bool = True

    @property
    def constrains(self):
        return isinstance(self.part, CONSTRAINTS)


# Plane


def body_2d(name, **state):
    return planar.Body(name, mass=1.5, inertia=0.2, **({"position": (0.5, 0.1), "angle": 0.2} | state))


def hold_2d(body):
    """A spring by which a body hangs: it starts to move, and it has a place to rest."""
    place = {"point_a": (0.7, 0.9), "point_b": (0.2, 0.1)} if isinstance(body, planar.Body) else {"point_a": (0.7, 0.9)}
    return planar.SpringDamper(f"{body.name} spring", "ground", body.name, stiffness=40.0, free_length=0.2, **place)


def of_ground_2d(cls, parameter, *, name=None, joints=(), body=body_2d, rests=True, **options):
    """A part between the ground and a body."""
    name = cls.__name__ if name is None else name
    own = body(f"{name} body")
    part = cls(name, "ground", own.name, **options)
    return Example(part, [own], parameter, tuple(joint(own) for joint in joints), (hold_2d(own),), rests)


def on_body_2d(cls, parameter, *, name=None, rests=True, **options):
    name = cls.__name__ if name is None else name
    own = body_2d(f"{name} body", velocity=(0.5, 0.2), angular_velocity=1.0)
    return Example(cls(name, own.name, **options), [own], parameter, (), (hold_2d(own),), rests)


def pin_2d(body, point=(0.0, 0.0)):
    return planar.Revolute(f"{body.name} pin", "ground", body.name, point=point)


def gears():
    bodies = [body_2d("small", position=(0.0, 0.0)), body_2d("large", position=(0.8, 0.0))]
    pins = pin_2d(bodies[0], (0.0, 0.0)), pin_2d(bodies[1], (0.8, 0.0))
    return Example(planar.Gear("Gear", "small", "large", ratio=-0.5), bodies, "ratio", pins, (hold_2d(bodies[1]),))


def rack():
    bodies = [body_2d("pinion", position=(0.0, 0.3), angle=0.0), body_2d("rack", position=(0.0, 0.0), angle=0.0)]
    rail = planar.Prismatic("rail", "ground", "rack", point=(0.0, 0.0), axis=(1.0, 0.0))
    part = planar.RackAndPinion("RackAndPinion", "pinion", "rack", radius=0.3)
    return Example(part, bodies, "radius", (pin_2d(bodies[0], (0.0, 0.3)), rail), (hold_2d(bodies[1]),))


def track():
    own = body_2d("Track body")
    path = [("ground", (0.0, 0.9)), (own.name, (0.1, -0.1)), ("ground", (1.0, 0.8))]
    return Example(planar.Track("Track", path, pretension=3.0, stiffness=20.0), [own], "stiffness", (), (hold_2d(own),))


def turn(t, p):
    """From rest, so that there is an equilibrium at the start."""
    return p["start"] + p["rate"] * t**2


def circle(point, p):
    return jnp.dot(point, point) - p["radius"] ** 2


GROUND_2D = {
    "terrain": terrain.Slope(0.1, level=-0.1),
    "normal": contact.Linear(500.0),
    "friction": contact.Coulomb(0.3, transition_speed=0.5),
    "radius": 0.25,
    "damping": 5.0,
    "smoothing": 0.02,
}
POINT_MASS_2D = planar.PointMass("PointMass", mass=1.2, position=(0.4, 0.2))
BODY_2D = body_2d("Body", velocity=(1.0, 0.0))

PLANAR = [
    Example(BODY_2D, [BODY_2D], "inertia", (), (hold_2d(BODY_2D),)),
    Example(POINT_MASS_2D, [POINT_MASS_2D], "mass", (), (hold_2d(POINT_MASS_2D),)),
    of_ground_2d(planar.Revolute, "point_b", point=(0.0, 0.0)),
    of_ground_2d(planar.Fixed, "angle", point=(0.0, 0.0)),
    of_ground_2d(planar.PointOnLine, "point_b", point=(0.2, 0.0), axis=(0.8, 0.6)),
    of_ground_2d(planar.Prismatic, "angle", point=(0.2, 0.0), axis=(0.8, 0.6)),
    of_ground_2d(planar.Distance, "length", point_b=(0.1, 0.0)),
    of_ground_2d(planar.PointOnCurve, "radius", curve=circle, parameters={"radius": 0.5}),
    gears(),
    rack(),
    of_ground_2d(
        planar.Driver,
        "rate",
        quantity="angle",
        motion=turn,
        parameters={"start": 0.2, "rate": 5.0},
        joints=(pin_2d,),
    ),
    of_ground_2d(
        planar.Driver,
        "rate",
        name="Driver of a distance",
        quantity="distance",
        motion=turn,
        parameters={"start": 0.5, "rate": 5.0},
    ),
    on_body_2d(planar.KnifeEdge, "point", point=(0.2, 0.0)),
    of_ground_2d(planar.SpringDamper, "stiffness", stiffness=30.0, damping=0.5, free_length=0.1, point_b=(0.1, 0.2)),
    of_ground_2d(planar.Damper, "damping", damping=3.0, point_b=(0.1, 0.2)),
    on_body_2d(planar.PointForce, "force", force=(2.0, 1.0), point=(0.1, 0.2)),
    on_body_2d(planar.Torque, "torque", torque=0.5),
    of_ground_2d(planar.TorsionalSpringDamper, "stiffness", stiffness=5.0, damping=0.2, free_angle=0.8),
    of_ground_2d(planar.BumpStop, "stiffness", stiffness=300.0, lower=-0.1, upper=0.1),
    of_ground_2d(planar.Bushing, "stiffness", stiffness=(30.0, 20.0, 3.0), damping=(1.0, 1.0, 0.1), point=(0.0, 0.0)),
    of_ground_2d(
        planar.DraftGear,
        "preload",
        stiffness=300.0,
        preload=5.0,
        travel=0.2,
        stop_stiffness=500.0,
        transition=0.5,
        smoothing=0.05,
        free_length=0.3,
    ),
    track(),
    on_body_2d(planar.Contact, "normal.stiffness", **GROUND_2D),
]


# Functions, and laws of joints


def rubbing(build, name, parameter):
    """A pendulum whose pin rubs, swinging already, so that the direction of its slip is certain."""
    own = body_2d(f"{name} body", angular_velocity=3.0)
    pin = pin_2d(own)
    return Example(build(name, pin.name), [own], parameter, (pin,), (hold_2d(own),), ideal=False)


def rub(poses, velocities, reactions, t, p):
    return -p["share"] * jnp.sum(reactions[:, :2] ** 2) * velocities * jnp.array([0.0, 0.0, 1.0])


def program():
    own = body_2d("Servo body")
    drive = planar.Driver(
        "Servo", "ground", own.name, quantity="angle", motion=turn, parameters={"start": 0.0, "rate": 2.0}
    )
    servo = mb.Servo(drive, damping=4.0, stiffness=9.0)
    return Example(servo, [own], "stiffness", (pin_2d(own),), (hold_2d(own),), ideal=False)


def on_parabola(poses, t, p):
    return (poses[0, 1] - p["curvature"] * poses[0, 0] ** 2)[None]


def skate(poses, velocities, t, p):
    angle = poses[0, 2] + p["angle"]
    return (velocities[0, 1] * jnp.cos(angle) - velocities[0, 0] * jnp.sin(angle))[None]


def drag(poses, velocities, t, p):
    return -p["drag"] * jnp.sum(velocities**2) * velocities


FUNCTIONS = [
    on_body_2d(mb.Constraint, "curvature", function=on_parabola, parameters={"curvature": 0.4}, rheonomic=False),
    on_body_2d(mb.VelocityConstraint, "angle", function=skate, parameters={"angle": 0.1}, homogeneous=True),
    on_body_2d(mb.Force, "drag", function=drag, parameters={"drag": 0.2}),
    rubbing(lambda n, pin: mb.NonIdeal(n, pin, function=rub, parameters={"share": 1e-3}), "NonIdeal", "share"),
    rubbing(
        lambda n, pin: planar.Friction(n, pin, coefficient=0.3, radius=0.1, smoothing=0.05), "Friction", "coefficient"
    ),
    program(),
]


# Space

AXIS = (0.6, 0.0, 0.8)


def body_3d(name, **state):
    return spatial.Body(name, mass=1.5, inertia=(0.2, 0.25, 0.3), **({"position": (0.5, 0.1, 0.2)} | state))


def hold_3d(body):
    place = {"point_b": (0.2, 0.1, 0.05)} if isinstance(body, spatial.Body) else {}
    return spatial.SpringDamper(
        f"{body.name} spring",
        "ground",
        body.name,
        stiffness=40.0,
        free_length=0.2,
        point_a=(0.7, 0.3, 1.1),
        **place,
    )


def of_ground_3d(cls, parameter, *, joints=(), rests=True, **options):
    own = body_3d(f"{cls.__name__} body")
    part = cls(cls.__name__, "ground", own.name, **options)
    return Example(part, [own], parameter, tuple(joint(own) for joint in joints), (hold_3d(own),), rests)


def on_body_3d(cls, parameter, *, rests=True, position=(0.5, 0.1, 0.2), **options):
    moving = {"velocity": (0.5, 0.2, 0.0), "angular_velocity": (0.3, 1.0, 0.5), "position": position}
    own = body_3d(f"{cls.__name__} body", **moving)
    return Example(cls(cls.__name__, own.name, **options), [own], parameter, (), (hold_3d(own),), rests)


def pin_3d(body):
    return spatial.Revolute(f"{body.name} pin", "ground", body.name, point=(0.0, 0.0, 0.0), axis=AXIS)


def rubbing_3d():
    own = body_3d("Friction body", angular_velocity=(1.8, 0.0, 2.4))
    pin = pin_3d(own)
    part = spatial.Friction("Friction", pin.name, coefficient=0.3, radius=0.1, smoothing=0.05)
    return Example(part, [own], "coefficient", (pin,), (hold_3d(own),), ideal=False)


O = (0.0, 0.0, 0.0)
POINT_MASS_3D = spatial.PointMass("PointMass", mass=1.2, position=(0.4, 0.2, 0.1))
BODY_3D = body_3d("Body", angular_velocity=(1.0, 2.0, 0.5))

SPATIAL = [
    Example(BODY_3D, [BODY_3D], "inertia", (), (hold_3d(BODY_3D),)),
    Example(POINT_MASS_3D, [POINT_MASS_3D], "mass", (), (hold_3d(POINT_MASS_3D),)),
    of_ground_3d(spatial.Spherical, "point_b", point=O),
    of_ground_3d(spatial.Revolute, "point_b", point=O, axis=AXIS),
    of_ground_3d(spatial.Universal, "point_b", point=O, axis_a_W=AXIS, axis_b_W=(0.0, 1.0, 0.0)),
    of_ground_3d(spatial.Cylindrical, "point_b", point=O, axis=AXIS),
    of_ground_3d(spatial.Screw, "pitch", point=O, axis=AXIS, pitch=0.4),
    of_ground_3d(spatial.Prismatic, "axis_a", point=O, axis=AXIS),
    of_ground_3d(spatial.Planar, "point_b", point=O, axis=AXIS),
    of_ground_3d(spatial.Fixed, "point_b", point=O),
    of_ground_3d(spatial.Distance, "length", point_b=(0.1, 0.0, 0.0)),
    of_ground_3d(spatial.PointOnPlane, "point_b", point=O, axis=AXIS),
    of_ground_3d(spatial.PointOnLine, "point_b", point=O, axis=AXIS),
    of_ground_3d(
        spatial.Driver,
        "rate",
        quantity="angle",
        motion=turn,
        parameters={"start": 0.0, "rate": 5.0},
        axis=AXIS,
        joints=(pin_3d,),
    ),
    on_body_3d(spatial.KnifeEdge, "point", point=(0.2, 0.0, 0.0)),
    # A disk at rest falls over.
    on_body_3d(spatial.RollingDisk, "radius", position=(0.5, 0.1, 0.3), radius=0.3, axis=(0.0, 1.0, 0.0), rests=False),
    on_body_3d(spatial.RollingSphere, "radius", radius=0.2),
    of_ground_3d(spatial.SpringDamper, "stiffness", stiffness=30.0, damping=0.5, free_length=0.1),
    of_ground_3d(spatial.Damper, "damping", damping=3.0, point_b=(0.1, 0.2, 0.0)),
    on_body_3d(spatial.PointForce, "force", force=(2.0, 1.0, 0.5), point=(0.1, 0.2, 0.0)),
    on_body_3d(spatial.Torque, "torque", torque=(0.2, 0.1, 0.0)),
    of_ground_3d(spatial.TorsionalSpringDamper, "stiffness", stiffness=5.0, damping=0.2, axis=AXIS, free_angle=0.5),
    of_ground_3d(
        spatial.Bushing, "stiffness", stiffness=(30.0, 20.0, 25.0, 3.0, 4.0, 5.0), damping=np.full(6, 0.3), point=O
    ),
    on_body_3d(spatial.Contact, "normal.stiffness", **GROUND_2D),
]

GROUPS = {"planar": PLANAR, "spatial": SPATIAL, "functions": FUNCTIONS, "spatial friction": [rubbing_3d()]}
EXAMPLES = {f"{group}: {example.part.name}": (group, example) for group, own in GROUPS.items() for example in own}
ALONE = {"solver": diffrax.Tsit5(), "manifold": mb.manifold.Projection()}


def twin(part):
    return dataclasses.replace(part, name=f"{part.name} twin")


# What is tested


def compiled(examples, *, twins=False):
    """All examples in one scene; `twins`: with all their constraints in it twice."""
    parts = [example.part for example in examples if not isinstance(example.part, AbstractBody)]
    parts += [twin(example.part) for example in examples if twins and example.constrains]
    forces = [part for part in parts if isinstance(part, AbstractForce | AbstractNonIdeal)]
    joints = [part for part in parts if part not in forces]
    of_all = lambda name: [own for example in examples for own in getattr(example, name)]
    bodies = of_all("bodies")
    gravity = mb.Gravity((0.0, -9.81) if bodies[0].dimension == 2 else (0.0, 0.0, -9.81))
    joints, forces = [*of_all("joints"), *joints], [*of_all("forces"), *forces, gravity]
    return mb.Scene(bodies, joints=joints, forces=forces).compile()


def observers(system, examples):
    """A row for each example: weights of the coordinates of its own bodies, so that no other part counts."""
    weights = np.zeros((len(examples), system.nq))
    for row, example in zip(weights, examples, strict=True):
        for name, index in system.coordinate_names().items():
            if name.rpartition(".")[0] in [body.name for body in example.bodies]:
                row[list(index)] = np.cos(np.asarray(index))
    return weights


@dataclasses.dataclass
class Motion:
    """A short motion of examples, compiled: from a share that is added to their parameters to what they show."""

    examples: list
    options: dict

    def __post_init__(self):
        system = compiled(self.examples)
        names = [f"{example.part.name}.{example.parameter}" for example in self.examples]
        base = [mb.parameters(system)[name] for name in names]
        size = np.array([max(np.max(np.abs(value)), 0.1) for value in base])
        weights = jnp.asarray(observers(system, self.examples))

        def seen(shares, rtol, adjoint):
            values = [value + change for value, change in zip(base, shares * size, strict=True)]
            changed = mb.with_parameters(system, dict(zip(names, values, strict=True)))
            state = mb.assemble(changed, throw=False)
            options = {"saveat": TIMES, "max_steps": 1024, "throw": False, "adjoint": adjoint} | self.options
            sol = mb.simulate(changed, state, t1=TIMES[-1], rtol=rtol, **options)
            y = sol.ys
            broken = jax.vmap(lambda t, q, u: changed.position_residual(t, q))(sol.ts, y.q, y.u)
            slipping = jax.vmap(changed.velocity_residual)(sol.ts, y.q, y.u)
            return weights @ y.q[-1], (broken, slipping, sol.energy, y)

        self.system = system
        tangent = jnp.ones(len(names))

        @jax.jit
        def forward(shares, rtol):
            push = lambda shares: seen(shares, rtol, diffrax.ForwardMode())
            return jax.jvp(push, (shares,), (tangent,), has_aux=True)

        self.forward = forward
        self.reverse = jax.jit(jax.grad(lambda shares, rtol: jnp.sum(seen(shares, rtol, None)[0])))

    def by_name(self, values, mask):
        """The examples for which a mask holds, with values of theirs: what fails, by name."""
        return {e.part.name: v for e, v, wrong in zip(self.examples, values, mask, strict=True) if wrong}


@functools.cache
def motion(key):
    """That of a group of examples together, or of one alone."""
    if key in GROUPS:
        return Motion(GROUPS[key], {})
    return Motion([EXAMPLES[key][1]], ALONE)


def start(own):
    return jnp.zeros(len(own.examples))


def check_motion(own):
    _, _, (broken, slipping, energy, y) = own.forward(start(own), 1e-6)
    rows = [name for name, _ in own.system.rows]
    for residual in (broken, slipping):
        worst = {name: size for name, size in zip(rows, np.max(np.abs(residual), axis=0), strict=False) if size > 1e-9}
        assert worst == {}
    assert np.all(np.isfinite(energy)) and np.all(np.isfinite(y.u))


def check_derivatives(own):
    """Forward, reverse and central differences of a tighter solution."""
    _, forward, _ = own.forward(start(own), 1e-9)
    reverse = own.reverse(start(own), 1e-9)
    # A parameter of no effect would pass the rest.
    assert own.by_name(forward, np.abs(forward) < 1e-6) == {}
    pairs = np.stack([forward, reverse], axis=1)
    assert own.by_name(pairs, np.abs(reverse - forward) > 1e-9 * (1 + np.abs(forward))) == {}
    h = 1e-3
    value = lambda s: own.forward(start(own) + s, 1e-12)[0]
    difference = (8 * (value(h) - value(-h)) - (value(2 * h) - value(-2 * h))) / (12 * h)
    pairs = np.stack([forward, difference], axis=1)
    assert own.by_name(pairs, np.abs(difference - forward) > 1e-6 * (1 + np.abs(forward))) == {}


def check_redundancy(examples, options):
    """With all constraints twice, the rows of each twin imply those of the other, and the motion is the same."""
    once, twice = compiled(examples), compiled(examples, twins=True)
    for example in examples:
        names = {example.part.name, twin(example.part).name}
        implied = [item for item in twice.implied if item.name in names]
        assert len(implied) == len([name for name, _ in once.rows if name == example.part.name]), names
        assert all(set(item.by) >= names - {item.name} for item in implied), names
    ends = []
    for system in (once, twice):
        end = mb.simulate(system, mb.assemble(system), t1=TIMES[-1], rtol=1e-10, **options).ys
        ends.append(np.concatenate([end.q[-1], end.u[-1]]))
    np.testing.assert_allclose(ends[1], ends[0], rtol=0, atol=1e-8)


def check_equilibrium(examples):
    system = compiled(examples)
    state = mb.equilibrium(system)
    at_rest = jax.jit(lambda q: accelerations(system, Multipliers(), 0.0, q, jnp.zeros(system.nu))[0])(state.q)
    np.testing.assert_allclose(at_rest, 0.0, atol=1e-8)
    np.testing.assert_allclose(system.position_residual(0.0, state.q), 0.0, atol=1e-12)


# All parts of a space in one scene


@pytest.mark.parametrize("group", GROUPS)
def test_motion(group):
    check_motion(motion(group))


@pytest.mark.parametrize("group", GROUPS)
def test_derivatives(group):
    check_derivatives(motion(group))


@pytest.mark.parametrize("group", ["planar", "spatial", "functions"])
def test_redundancy(group):
    check_redundancy([example for example in GROUPS[group] if example.constrains], {})


@pytest.mark.parametrize("group", ["planar", "spatial", "functions"])
def test_equilibrium(group):
    check_equilibrium([example for example in GROUPS[group] if example.rests and example.ideal])


# Each part alone


@pytest.mark.long
@pytest.mark.parametrize("name", EXAMPLES)
def test_motion_and_derivatives_alone(name):
    check_motion(motion(name))
    check_derivatives(motion(name))


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name, (_, example) in EXAMPLES.items() if example.constrains])
def test_redundancy_alone(name):
    check_redundancy([EXAMPLES[name][1]], ALONE)


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name, (_, e) in EXAMPLES.items() if e.rests and e.ideal])
def test_equilibrium_alone(name):
    check_equilibrium([EXAMPLES[name][1]])
