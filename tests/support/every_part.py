"""Every part in a small scene of its own, where gravity and a spring move it, and every method of integration."""

import dataclasses
from pathlib import Path
from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np

import jaxmb as mb
from jaxmb import planar, sections, spatial
from jaxmb.manifold.default import Unconstrained
from jaxmb.parts import AbstractForce, AbstractNonIdeal, contact, terrain, tir


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


def touching(cls, parameter, **options):
    """Contact of a disc on a body with something that is fixed in the ground."""
    own = body_2d(f"{cls.__name__} body", velocity=(0.5, 0.2), angular_velocity=1.0)
    laws = {name: value for name, value in GROUND_2D.items() if name != "terrain"}
    part = cls(cls.__name__, (own.name, "ground"), centre=(0.05, 0.02), **laws, **options)
    return Example(part, [own], parameter, (), (hold_2d(own),))


def turn(t, p):
    """From rest and without a push, so that there is an equilibrium at the start."""
    return p["start"] + p["rate"] * t**3


def driven(quantity, start):
    return {"quantity": quantity, "motion": turn, "parameters": {"start": start, "rate": 25.0}}


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
TYRE_2D = {
    "terrain": terrain.Slope(0.1, level=-0.1),
    "normal": contact.Linear(500.0),
    "radius": 0.25,
    "coefficient": 0.7,
    "slip_stiffness": 4.0,
    "relaxation_length": 0.2,
    "damping": 5.0,
    "smoothing": 0.02,
}
# The example of a tyre on the scale of these bodies, with wide limits.
TYRE_FILE = Path(__file__).parents[2] / "notebooks" / "tyre_61.tir"
TYRE_3D = tir.read("", TYRE_FILE).coefficients | {
    "FITTYP": 61,
    "TYRESIDE": "left",
    "UNLOADED_RADIUS": 0.25,
    "FNOMIN": 10.0,
    "LONGVL": 2.0,
    "VERTICAL_STIFFNESS": 500.0,
    "VERTICAL_DAMPING": 5.0,
    "LONGITUDINAL_STIFFNESS": 900.0,
    "LATERAL_STIFFNESS": 500.0,
    **dict.fromkeys(("CAMMIN", "ALPMIN"), -1.5),
    **dict.fromkeys(("CAMMAX", "ALPMAX"), 1.5),
    "KPUMIN": -9.0,
    "KPUMAX": 9.0,
    "FZMIN": 0.1,
    "FZMAX": 1e3,
}
SECTION = sections.Section(bending_stiffness=4.0, torsional_stiffness=3.0, axial_stiffness=90.0, shear_stiffness=60.0)
CYLINDER_2D = {"bore_area": 2e-3, "pressure": 8e3, "rod_area": 1.5e-3, "rod_pressure": 2e3}
DRAFT_GEAR = {"stiffness": 300.0, "preload": 5.0, "travel": 0.2, "stop_stiffness": 500.0, "transition_speed": 0.5}
DRAFT_GEAR |= {"smoothing": 0.05}
POINT_MASS_2D = planar.PointMass("PointMass", mass=1.2, position=(0.4, 0.2))
BODY_2D = body_2d("Body", velocity=(1.0, 0.0))
BAR = {"length": 0.5, "young": 1e6, "density": 900.0, "width": 0.06, "thickness": 0.04, "bending": 2}
BAR_2D = planar.ElasticBar("ElasticBar", position=(0.3, 0.2), angle=0.1, **BAR)
ELASTIC_2D = planar.ElasticBody(
    "ElasticBody",
    mass=1.3,
    first_moment=(0.1, 0.02),
    second_moment=((0.2, 0.01), (0.01, 0.1)),
    modal_moments=((0.0, 0.3),),
    mixed_moments=(((0.0, 0.1), (0.0, 0.02)),),
    modal_products=((((0.05, 0.0), (0.0, 0.3)),),),
    stiffness=((60.0,),),
    damping=((0.5,),),
    position=(0.4, 0.1),
)

PLANAR = [
    Example(BODY_2D, [BODY_2D], "inertia", (), (hold_2d(BODY_2D),)),
    Example(BAR_2D, [BAR_2D], "thickness", (), (hold_2d(BAR_2D),)),
    Example(ELASTIC_2D, [ELASTIC_2D], "stiffness", (), (hold_2d(ELASTIC_2D),)),
    Example(POINT_MASS_2D, [POINT_MASS_2D], "mass", (), (hold_2d(POINT_MASS_2D),)),
    of_ground_2d(planar.Revolute, "point_b", point=(0.0, 0.0)),
    of_ground_2d(planar.Fixed, "angle", point=(0.0, 0.0)),
    of_ground_2d(planar.PointOnLine, "point_b", point=(0.2, 0.0), axis=(0.8, 0.6)),
    of_ground_2d(planar.Prismatic, "angle", point=(0.2, 0.0), axis=(0.8, 0.6)),
    of_ground_2d(planar.Distance, "length", point_b=(0.1, 0.0)),
    of_ground_2d(planar.PointOnCurve, "radius", curve=circle, parameters={"radius": 0.5}),
    gears(),
    rack(),
    of_ground_2d(planar.Driver, "rate", joints=(pin_2d,), **driven("angle", 0.2)),
    of_ground_2d(planar.Driver, "rate", name="Driver of a distance", **driven("distance", 0.5)),
    on_body_2d(planar.KnifeEdge, "point", point=(0.2, 0.0)),
    of_ground_2d(planar.SpringDamper, "stiffness", stiffness=30.0, damping=0.5, free_length=0.1, point_b=(0.1, 0.2)),
    of_ground_2d(planar.Damper, "damping", damping=3.0, point_b=(0.1, 0.2)),
    on_body_2d(planar.PointForce, "force", force=(2.0, 1.0), point=(0.1, 0.2)),
    on_body_2d(planar.Torque, "torque", torque=0.5),
    of_ground_2d(planar.TorsionalSpringDamper, "stiffness", stiffness=5.0, damping=0.2, free_angle=0.8),
    of_ground_2d(planar.RotationalDamper, "damping", damping=0.3),
    of_ground_2d(planar.Bushing, "stiffness", stiffness=(30.0, 20.0, 3.0), damping=(1.0, 1.0, 0.1), point=(0.0, 0.0)),
    of_ground_2d(planar.Beam, "section.bending_stiffness", section=SECTION, damping_time=0.02, point_b=(0.1, 0.2)),
    of_ground_2d(planar.InextensibleBeam, "length", section=SECTION, damping_time=0.02, point_b=(0.1, 0.2)),
    of_ground_2d(planar.Cylinder, "bore_area", point_a=(0.1, -0.6), point_b=(0.1, 0.2), **CYLINDER_2D),
    of_ground_2d(planar.DraftGear, "preload", free_length=0.3, **DRAFT_GEAR),
    track(),
    on_body_2d(planar.Contact, "normal.stiffness", **GROUND_2D),
    on_body_2d(planar.Tyre, "slip_stiffness", **TYRE_2D),
    # The disc moves along the plate's end.
    touching(planar.PlateContact, "start", start=(0.4, -0.06), end=(2.0, 0.1), edge=0.3),
    touching(planar.DiscContact, "radii", radii=0.5, centres=(0.5, -0.55)),
]


# Functions, and laws of joints


def rubbing(build, name, parameter):
    """A pendulum whose pin rubs, swinging already, so that the direction of its slip is certain."""
    own = body_2d(f"{name} body", angular_velocity=3.0)
    pin = pin_2d(own)
    return Example(build(name, pin.name), [own], parameter, (pin,), (hold_2d(own),), ideal=False)


def rub(poses, velocities, reactions, t, p):
    return -p["share"] * jnp.sum(reactions[:, :2] ** 2) * velocities * jnp.array([[0.0, 0.0, 1.0]])


def program():
    own = body_2d("Servo body")
    drive = planar.Driver(
        "Servo", "ground", own.name, quantity="angle", motion=turn, parameters={"start": 0.0, "rate": 10.0}
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


def of_joint(cls, parameter, *, name=None, rests=True, **options):
    """A part of the angle of a pin."""
    name = cls.__name__ if name is None else name
    own = body_2d(f"{name} body")
    pin = pin_2d(own)
    return Example(cls(name, f"{pin.name}.angle", **options), [own], parameter, (pin,), (hold_2d(own),), rests)


def controlled():
    own = body_2d("Controller body")
    pin = pin_2d(own)

    def law(t, measured, states, p):
        error = p["target"] - measured["angle"]
        return p["gain"] * (error + 2.0 * states["integral"]), {"integral": error}

    measures, on = {"angle": f"{pin.name}.angle"}, f"{pin.name}.angle"
    parameters = {"gain": 6.0, "target": 0.5}
    part = mb.Controller("Controller", law, measures, on, states={"integral": 0.1}, parameters=parameters)
    return Example(part, [own], "gain", (pin,), (hold_2d(own),), rests=False)


def of_tendon(part, parameter):
    """A tendon along the angle of a pin, or straight to a body, with a spring on its length."""
    own = body_2d(f"{part.kind} body")
    pin = pin_2d(own)
    spring = mb.JointSpring(f"{part.name} spring", f"{part.name}.length", stiffness=5.0, free=0.1)
    return Example(part, [own], parameter, (pin,), (hold_2d(own), spring))


def coupled():
    bodies = [body_2d("driven body", position=(0.0, 0.0)), body_2d("driving body", position=(0.8, 0.0))]
    pins = pin_2d(bodies[0], (0.0, 0.0)), pin_2d(bodies[1], (0.8, 0.0))
    names = [f"{pin.name}.angle" for pin in pins]
    part = mb.JointCoupling("JointCoupling", *names, coefficients=(0.0, -0.5, 0.1))
    return Example(part, bodies, "coefficients", pins, (hold_2d(bodies[1]),))


def roped():
    """A body that hangs in a rope from a reel, with a pulley that grips it."""
    own, reel = body_2d("Rope body"), planar.Body("reel", mass=1.0, inertia=0.1, position=(0.0, 0.9))
    under = mb.Pulley(own.name, 0.1, "left", centre=(0.1, -0.1), grips=True)
    part = mb.Rope("Rope", [mb.Pulley("reel", 0.15, "right", turns=1.0), under, ("ground", (1.0, 0.8))])
    return Example(part, [own, reel], "radii", (pin_2d(reel, (0.0, 0.9)),), (hold_2d(own),))


ACTUATOR = {"control": 0.3, "gain": (5.0, 0.0, 0.0), "bias": (0.0, -5.0, -0.2)}
TORQUES = {"speeds": (-3.0, 0.0, 3.0, 9.0), "torques": (0.2, 0.2, 0.15, 0.0), "control": 0.7}

FUNCTIONS = [
    of_joint(mb.JointStop, "stiffness", stiffness=90.0, damping=0.1, lower=-0.1, upper=0.1, smoothing=0.05),
    of_joint(
        mb.JointStop,
        "exponent",
        name="JointStop with an exponent",
        stiffness=300.0,
        exponent=3.0,
        lower=-0.1,
        upper=0.1,
    ),
    of_joint(mb.JointFriction, "force", force=0.3, transition_speed=0.5),
    of_joint(mb.Actuator, "gain", **ACTUATOR),
    of_joint(mb.Actuator, "lag", name="Actuator with a lag", lag=0.05, rests=False, **ACTUATOR),
    coupled(),
    of_tendon(mb.FixedTendon("FixedTendon", "FixedTendon body pin.angle", coefficients=(0.4,)), "coefficients"),
    of_tendon(mb.Tendon("Tendon", [("ground", (0.0, 1.0)), ("Tendon body", (0.2, 0.1))]), "points"),
    roped(),
    of_joint(mb.JointSpring, "stiffness", stiffness=5.0, damping=0.1, free=0.4),
    of_joint(mb.JointForce, "force", force=0.8),
    of_joint(mb.TableSpring, "forces", values=(-0.4, 0.1, 0.3, 0.8), forces=(-4.0, -1.0, 1.0, 3.0)),
    of_joint(mb.TableDamper, "forces", rates=(-2.0, -0.5, 0.5, 3.0), forces=(-3.0, -1.0, 0.8, 2.0)),
    of_joint(mb.TableMotor, "torques", gear=5.0, lag=0.05, rests=False, **TORQUES),
    of_joint(mb.JointDriver, "value", value=0.25, rate=0.3, rests=False),
    of_joint(mb.JointInertia, "inertia", inertia=0.4),
    of_joint(mb.Motor, "gain", mode="position", command=0.6, gain=9.0, damping=0.5, lag=0.05, limit=5.0, rests=False),
    controlled(),
    on_body_2d(mb.Constraint, "curvature", function=on_parabola, parameters={"curvature": 0.4}, rheonomic=False),
    on_body_2d(mb.VelocityConstraint, "angle", function=skate, parameters={"angle": 0.1}, homogeneous=True),
    on_body_2d(mb.Force, "drag", function=drag, parameters={"drag": 0.2}),
    rubbing(lambda n, pin: mb.NonIdeal(n, pin, function=rub, parameters={"share": 1e-3}), "NonIdeal", "share"),
    rubbing(
        lambda n, pin: planar.Friction(n, pin, coefficient=0.3, radius=0.1, transition_speed=0.05),
        "Friction",
        "coefficient",
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
        f"{body.name} spring", "ground", body.name, stiffness=40.0, free_length=0.2, point_a=(0.7, 0.3, 1.1), **place
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
    part = spatial.Friction("Friction", pin.name, coefficient=0.3, radius=0.1, transition_speed=0.05)
    return Example(part, [own], "coefficient", (pin,), (hold_3d(own),), ideal=False)


def gimbal(name, **options):
    """Axes of its own, where all its angles change."""
    axes = {"axis_1_W": AXIS, "axis_2_W": (0.0, 1.0, 0.0), "axis_3_W": (-0.8, 0.0, 0.6)}
    own = body_3d(f"{name} body", angular_velocity=(1.0, -2.0, 0.5))
    return own, spatial.Gimbal(f"{name} gimbal", "ground", own.name, point=O, **axes, **options)


def on_gimbal(parameter, name, build):
    """What acts on the angles of a gimbal."""
    own, joint = gimbal(name)
    part, *more = build([f"{joint.name}.angle_{k}" for k in (1, 2, 3)])
    return Example(part, [own], parameter, (joint,), (hold_3d(own), *more))


def springs_on(angles):
    free = enumerate((0.2, -0.3, 0.4))
    return [mb.JointSpring(f"JointSpring on angle {k}", angles[k], stiffness=4.0, damping=0.1, free=x) for k, x in free]


def tendon_on(angles):
    part = mb.FixedTendon("FixedTendon on a gimbal", angles, coefficients=(0.4, -0.3, 0.2))
    return part, mb.JointSpring("pull of angles", f"{part.name}.length", stiffness=9.0, free=0.1)


def tendon_3d():
    own = body_3d("Tendon body")
    joint = spatial.Spherical("Tendon ball", "ground", own.name, point=O)
    path = [("ground", (0.0, 0.0, 1.0)), (own.name, (0.2, 0.1, 0.1)), ("ground", (1.0, 0.2, 0.9))]
    spring = mb.JointSpring("Tendon spring", "Tendon.length", stiffness=9.0, free=0.1)
    return Example(mb.Tendon("Tendon", path), [own], "points", (joint,), (hold_3d(own), spring))


def roped_3d():
    """A body that hangs in a rope from a reel, on a pulley without friction."""
    own, axis = body_3d("Rope body"), (0.0, -1.0, 0.0)
    reel = spatial.Body("reel", mass=1.0, inertia=(0.1, 0.1, 0.1), position=(0.0, 0.0, 0.9))
    pin = spatial.Revolute("reel pin", "ground", "reel", point=reel.position, axis=axis)
    drum = mb.Pulley("reel", 0.15, "right", axis=axis, turns=1.0)
    under = mb.Pulley(own.name, 0.1, "left", centre=(0.1, 0.0, -0.1), axis=axis)
    part = mb.Rope("Rope", [drum, ("ground", (0.3, 0.1, 0.9)), under, ("ground", (1.0, 0.2, 0.9))])
    return Example(part, [own, reel], "radii", (pin,), (hold_3d(own),))


O = (0.0, 0.0, 0.0)
POINT_MASS_3D = spatial.PointMass("PointMass", mass=1.2, position=(0.4, 0.2, 0.1))
BODY_3D = body_3d("Body", angular_velocity=(1.0, 2.0, 0.5))
BAR_3D = spatial.ElasticBar("ElasticBar", position=(0.3, 0.2, 0.1), torsion=1, **BAR | {"bending": 1})
ELASTIC_3D = spatial.ElasticBody(
    "ElasticBody",
    mass=1.3,
    first_moment=(0.1, 0.02, 0.03),
    second_moment=np.diag([0.2, 0.15, 0.1]),
    modal_moments=((0.0, 0.3, 0.0),),
    mixed_moments=(((0.0, 0.1, 0.0), (0.0, 0.02, 0.0), (0.0, 0.0, 0.0)),),
    modal_products=np.diag([0.05, 0.3, 0.02])[None, None],
    stiffness=((60.0,),),
    damping=((0.5,),),
    position=(0.4, 0.1, 0.2),
)

SPATIAL = [
    of_ground_3d(spatial.RotationalDamper, "damping", damping=0.3),
    Example(BODY_3D, [BODY_3D], "inertia", (), (hold_3d(BODY_3D),)),
    Example(BAR_3D, [BAR_3D], "width", (), (hold_3d(BAR_3D),)),
    Example(ELASTIC_3D, [ELASTIC_3D], "stiffness", (), (hold_3d(ELASTIC_3D),)),
    Example(POINT_MASS_3D, [POINT_MASS_3D], "mass", (), (hold_3d(POINT_MASS_3D),)),
    of_ground_3d(spatial.Spherical, "point_b", point=O),
    of_ground_3d(spatial.Revolute, "point_b", point=O, axis=AXIS),
    of_ground_3d(spatial.Universal, "point_b", point=O, axis_a_W=AXIS, axis_b_W=(0.0, 1.0, 0.0)),
    of_ground_3d(
        spatial.Gimbal, "point_b", point=O, axis_1_W=AXIS, axis_2_W=(0.0, 1.0, 0.0), axis_3_W=(-0.8, 0.0, 0.6)
    ),
    of_ground_3d(
        spatial.Composite,
        "points",
        sequence=("slide", "hinge", "hinge"),
        axes_W=[AXIS, (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)],
        points_W=[(0.1, 0.0, 0.0), (0.0, 0.1, 0.2)],
        point=O,
    ),
    on_gimbal("stiffness", "JointSpring", springs_on),
    on_gimbal("coefficients", "FixedTendon", tendon_on),
    on_gimbal(
        "coefficients",
        "JointCoupling",
        lambda angles: [
            mb.JointCoupling(
                "JointCoupling on a gimbal", angles[0], angles[1:], coefficients=((0.0, 0.5, 0.1), (0.0, -0.3, 0.0))
            )
        ],
    ),
    on_gimbal(
        "force",
        "JointFriction",
        lambda angles: [mb.JointFriction("JointFriction on a gimbal", angles[1], force=0.3, transition_speed=0.5)],
    ),
    on_gimbal(
        "inertia", "JointInertia", lambda angles: [mb.JointInertia("JointInertia on a gimbal", angles[1], inertia=0.2)]
    ),
    tendon_3d(),
    roped_3d(),
    of_ground_3d(spatial.Cylindrical, "point_b", point=O, axis=AXIS),
    of_ground_3d(spatial.Screw, "pitch", point=O, axis=AXIS, pitch=0.4),
    of_ground_3d(spatial.Prismatic, "point_b", point=O, axis=AXIS),
    of_ground_3d(spatial.Planar, "point_b", point=O, axis=AXIS),
    of_ground_3d(spatial.Fixed, "point_b", point=O),
    of_ground_3d(spatial.Distance, "length", point_b=(0.1, 0.0, 0.0)),
    of_ground_3d(spatial.PointOnPlane, "point_b", point=O, axis=AXIS),
    of_ground_3d(spatial.PointOnLine, "point_b", point=O, axis=AXIS),
    of_ground_3d(spatial.Driver, "rate", axis=AXIS, joints=(pin_3d,), **driven("angle", 0.0)),
    on_body_3d(spatial.KnifeEdge, "point", point=(0.2, 0.0, 0.0)),
    # A disc at rest falls over.
    on_body_3d(spatial.RollingDisc, "radius", position=(0.5, 0.1, 0.3), radius=0.3, axis=(0.0, 1.0, 0.0), rests=False),
    on_body_3d(spatial.RollingSphere, "radius", radius=0.2),
    of_ground_3d(spatial.SpringDamper, "stiffness", stiffness=30.0, damping=0.5, free_length=0.1),
    of_ground_3d(spatial.Damper, "damping", damping=3.0, point_b=(0.1, 0.2, 0.0)),
    on_body_3d(spatial.PointForce, "force", force=(2.0, 1.0, 0.5), point=(0.1, 0.2, 0.0)),
    on_body_3d(spatial.Torque, "torque", torque=(0.2, 0.1, 0.0)),
    of_ground_3d(
        spatial.Bushing, "stiffness", stiffness=(30.0, 20.0, 25.0, 3.0, 4.0, 5.0), damping=np.full(6, 0.3), point=O
    ),
    of_ground_3d(
        spatial.Beam, "section.bending_stiffness", section=SECTION, damping_time=0.02, point_b=(0.1, 0.2, 0.0)
    ),
    of_ground_3d(spatial.InextensibleBeam, "length", section=SECTION, damping_time=0.02, point_b=(0.1, 0.2, 0.0)),
    of_ground_3d(spatial.Cylinder, "pressure", bore_area=2e-3, pressure=8e3, point_a=(0.1, 0.0, -0.6)),
    on_body_3d(spatial.Contact, "normal.stiffness", **GROUND_2D),
    on_body_3d(spatial.Tyre, "slip_stiffness", **TYRE_2D),
    on_body_3d(spatial.MagicFormulaTyre, "LMUY", tir=TYRE_3D, terrain=TYRE_2D["terrain"], smoothing=0.02),
]

SPACES = {"planar": PLANAR, "functions": FUNCTIONS, "spatial": [*SPATIAL, rubbing_3d()]}
EXAMPLES = {f"{space}: {example.part.name}": example for space, own in SPACES.items() for example in own}
# By a method that is compiled sooner than the default.
METHOD = {"solver": diffrax.Dopri8(), "manifold": mb.manifold.Projection(), "max_steps": 512}
# By a Runge–Kutta method with another way to stay on the constraints, or by none, and by the multistep methods.
METHODS = {
    "Adams": {"solver": mb.solvers.Adams(), "manifold": mb.manifold.Partition()},
    "Adams on projection": {
        "manifold": mb.manifold.Projection(),
        "stepsize_controller": mb.solvers.MultistepController(rtol=1e-10, atol=1e-12),
    },
    "Hermite": {"solver": mb.solvers.Hermite()},
    "Baumgarte": {"solver": diffrax.Dopri8(), "manifold": mb.manifold.Baumgarte(20.0)},
    "without constraints": {"manifold": Unconstrained()},
}


def compiled(*examples, more=()):
    """The scene of examples side by side, and of more joints."""
    bodies, joints, forces = [], [], []
    for example in examples:
        own = list(example.forces)
        own += [example.part] if isinstance(example.part, AbstractForce | AbstractNonIdeal) else []
        joints += [*example.joints, *([] if example.part in example.bodies or example.part in own else [example.part])]
        bodies, forces = bodies + example.bodies, forces + own
    gravity = mb.Gravity((0.0, -9.81) if bodies[0].dimension == 2 else (0.0, 0.0, -9.81))
    return mb.Scene(bodies, joints=[*joints, *more], forces=[*forces, gravity]).compile()
