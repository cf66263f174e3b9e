"""Derivatives of random outputs with respect to random parameters, of every part and along every front.

Parts stand side by side in few scenes, each a machine of its own that touches no other. Outputs are quantities by name
at two times; parameters of every kind move the state that is assembled, the forces, or both. Other cases go along one
front each: a solver, events, jumps, equilibria, systems from a Lagrangian.
"""

import dataclasses
import functools
import typing

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivative_checks import Case, Machine, check
from driven_arm import driven_arm
from every_contact import CONTACTS
from every_dry_friction import FRICTIONS
from every_part import EXAMPLES, FUNCTIONS, Example, hold_2d, pin_2d, rubbing_3d
from exports import OF_SCENES, exported
from laws import FRICTION, LAWS, TERRAINS
from sprung_pendulums import HANGING, double_pendulum, pendulum as sprung_pendulum

import jaxmb as mb
from jaxmb import formulations, lagrangian, manifold, mechanisms, planar, solvers, spatial
from jaxmb.formulations import Multipliers, NullSpace, Partitioned, Poincare, UdwadiaKalaba
from jaxmb.lagrangian.constraints import AbstractCoordinateConstraint
from jaxmb.lagrangian.kinematics import AbstractKinematics
from jaxmb.lagrangian.model import AbstractEquations
from jaxmb.lagrangian.nonideal import AbstractNonIdealForce
from jaxmb.parts import (
    AbstractForce,
    AbstractFrictionLaw,
    AbstractNonIdeal,
    AbstractNormalLaw,
    AbstractTerrain,
    contact,
    fields,
    terrain,
)
from jaxmb.system.quantities import Solved

TIMES = np.array([0.06, 0.1])
MOTION = ("position", "velocity", "angle", "orientation", "angular_velocity")
DOPRI8 = {"solver": diffrax.Dopri8(), "manifold": manifold.Projection()}
# Programs of fixed steps are compiled sooner; for the differences they are half as long.
FIXED = DOPRI8 | {"stepsize_controller": diffrax.ConstantStepSize(), "dt0": 0.02}


def run(system, state, rtol, **options):
    options = {"t1": TIMES[-1], "saveat": TIMES, "max_steps": 512, "throw": False} | options
    if options.get("dt0") is not None:
        options["dt0"] = options["dt0"] * jnp.where(rtol < 1e-10, 0.5, 1.0)
    return mb.simulate(system, state, rtol=rtol, **options)


# Scenes of parts


def scene_of(examples):
    """Several examples side by side in one scene."""
    bodies, joints, forces = [], [], []
    for example in examples:
        part, own = example.part, list(example.forces)
        own += [part] if isinstance(part, AbstractForce | AbstractNonIdeal) else []
        joints += [*example.joints, *([] if part in example.bodies or part in own else [part])]
        bodies, forces = bodies + example.bodies, forces + own
    gravity = mb.Gravity((0.0, -9.81) if bodies[0].dimension == 2 else (0.0, 0.0, -9.81))
    return mb.Scene(bodies, joints=joints, forces=[*forces, gravity]).compile()


def machines_of(system, examples, own_fields=MOTION):
    """The examples as machines: what is seen of their bodies, and parameters of all that acts on these."""
    out = []
    for example in examples:
        own = [example.part, *example.bodies, *example.joints, *example.forces]
        names = [n for n in mb.parameters(system) if any(n.startswith(f"{part.name}.") for part in own)]
        seen = [f"{body.name}.{field}" for body in example.bodies for field in own_fields]
        seen = [name for name in seen if name in system.quantities()]
        out.append(Machine(example.part.name, names, seen, [f"{example.part.name}.{example.parameter}"]))
    return out


def side_by_side(examples, start=mb.assemble, **options):
    """Motions of examples in one scene."""
    system = scene_of(examples)
    machines = machines_of(system, examples)

    def observe(system, extra, rtol):
        sol = run(system, start(system, throw=False), rtol, **options)
        return {name: sol.quantity(name) for machine in machines for name in machine.outputs}

    return Case(system, machines, observe)


def at_one_instant(examples, formulation):
    """Assembled states of examples in one scene, their accelerations, and the forces of joints."""
    system = scene_of(examples)
    machines = machines_of(system, examples, ("position", "velocity", "angular_velocity"))
    for machine, example in zip(machines, examples, strict=True):
        machine.outputs += [f"{body.name}.acceleration" for body in example.bodies]
        machine.outputs += [name for name in (f"{example.part.name}.force",) if name in system.quantities()]

    def observe(system, extra, rtol):
        state, t = mb.assemble(system, throw=False), jnp.zeros(())
        udot, multipliers = formulations.accelerations(system.at(state), formulation, t, state.q, state.u)
        along = t[None], jax.tree.map(lambda x: x[None], state), Solved(udot[None], multipliers[None])
        out = {}
        for name in (name for machine in machines for name in machine.outputs):
            body, field = name.rsplit(".", 1)
            if field == "acceleration":
                moving = system.catalogue.motion(body, mb.State(state.q[None], udot[None]))
                turning = moving.angular_velocity
                out[name] = jnp.append(moving.velocity, jnp.zeros(0) if turning is None else turning)
            else:
                out[name] = system.quantities()[name].value(*along)
        return out

    return Case(system, machines, observe, outputs=5)


def named(space, names):
    return [EXAMPLES[f"{space}: {name}"] for name in names.split(", ")]


def on_the_ground():
    """Every terrain and law, each under a wheel of its own that has sunk in by two centimetres."""
    examples = []
    normals, frictions = list(LAWS.values()), list(FRICTION.values())
    for k, (name, ground) in enumerate(TERRAINS.items()):
        x = 4.4
        height = float(ground.height(jnp.array([x]))) + 0.28
        body = planar.Body(
            name, mass=200.0, inertia=6.0, position=(x, height), velocity=(1.0, 0.0), angular_velocity=-1.0
        )
        part = planar.Contact(
            f"under {name}",
            name,
            terrain=ground,
            normal=normals[k % len(normals)],
            friction=frictions[k % len(frictions)],
            radius=0.3,
            damping=500.0,
        )
        examples.append(Example(part, [body], "radius"))
    return examples


OF_BOTH = (
    "Body, ElasticBar, ElasticBody, PointMass, SpringDamper, Damper, PointForce, Torque, RotationalDamper, Bushing, "
    "Beam, Cylinder, Contact, Tyre"
)
PLANAR_FORCES = named("planar", f"{OF_BOTH}, TorsionalSpringDamper, DraftGear, Track, PlateContact, DiscContact")
SPATIAL_FORCES = named("spatial", f"{OF_BOTH}, MagicFormulaTyre")
# Examples, and how they are integrated.
GROUPS = {
    "planar joints": (named("planar", "Revolute, Fixed, PointOnLine, Prismatic, Distance, InextensibleBeam"), FIXED)
}
# Examples that are not moved, which takes a third of the time, and how their accelerations are solved for.
INSTANTS = {
    "planar gears and drivers": (
        named("planar", "PointOnCurve, Gear, RackAndPinion, Driver, Driver of a distance"),
        Poincare(),
    ),
    "planar velocities, laws and functions": ([*named("planar", "KnifeEdge"), *FUNCTIONS], Multipliers()),
    "planar forces": (PLANAR_FORCES, Multipliers()),
    "spatial joints": (
        named("spatial", "Spherical, Revolute, Universal, Gimbal, Cylindrical"),
        UdwadiaKalaba(),
    ),
    "spatial slides": (
        named("spatial", "Screw, Prismatic, Planar, Fixed, Composite"),
        UdwadiaKalaba("inverses"),
    ),
    "spatial points": (named("spatial", "Distance, InextensibleBeam, PointOnPlane, PointOnLine, Driver"), NullSpace()),
    "spatial rolling": (named("spatial", "KnifeEdge, RollingDisc, RollingSphere"), UdwadiaKalaba("singular_mass")),
    "spatial friction": ([rubbing_3d()], Partitioned()),
    "spatial forces": (SPATIAL_FORCES, Multipliers()),
    "ground": (on_the_ground(), Multipliers()),
}


# Fronts


def pendulum(seen, *, observe=None, scene=double_pendulum, **options):
    """A pendulum on a spring, with its initial rate, and what is seen of its motion."""
    system, _, fix, rate = scene()

    def outputs(system, extra, rtol):
        state = mb.assemble(system, fix=fix, rates={rate: extra["initial rate"]}, throw=False)
        return (observe or watched)(run(system, state, rtol, **options))

    def watched(sol):
        return {name: sol.quantity(name) for name in seen if "." in name} | {
            "energy": sol.energy,
            "spring": sol.forces["spring"],
            "reaction": sol.reactions["pin"].moment if "pin" in system.catalogue.constraint_names() else sol.energy,
        }

    machine = Machine("pendulum", list(mb.parameters(system)), seen, ["initial rate"])
    return Case(system, [machine], outputs, {"initial rate": 0.4}, parameters=6, outputs=7)


SEEN = ("rod.position", "rod.angular_velocity", "shank.velocity", "knee.force", "energy", "spring")


def event(**options):
    """The time of an event, and the state there."""
    seen = lambda sol: {"when": sol.ts[-1:], "q": sol.ys.q[-1], "u": sol.ys.u[-1]}
    own = {"event": HANGING, "saveat": None, "t1": 1.0} | options
    return pendulum(("when", "q", "u"), observe=seen, scene=sprung_pendulum, **own)


def jumps(**options):
    """A rate that jumps at one time, a force at another; both times are parameters."""
    law = lambda poses, velocities, t, p: (
        jnp.zeros_like(velocities).at[0, 1].set(jnp.where(t < p["on"], 0.0, p["push"]))
    )
    push = mb.Force("push", "rod", law, parameters={"on": 0.12, "push": 20.0})
    system = mb.with_parameters(driven_arm(push), {"drive.when": 0.05})

    def observe(system, extra, rtol):
        own = mb.parameters(system)
        times = jnp.stack([own["drive.when"], own["push.on"]])
        state = mb.assemble(system, rates={"rod.angle": 0.3}, throw=False)
        sol = run(system, state, rtol, jumps=times, t1=0.2, saveat=jnp.array([0.1, 0.2]), **options)
        return {name: sol.quantity(name) for name in seen} | {"energy": sol.energy}

    seen = ("rod.position", "rod.velocity", "rod.angle", "rod.angular_velocity")
    names = [name for name in mb.parameters(system) if "gravity" not in name]
    always = ["drive.before", "drive.after", "push.push", "drive.when", "push.on"]
    return Case(system, [Machine("arm", names, [*seen, "energy"], always)], observe, parameters=7, outputs=8)


class Disc(planar.AbstractRigidBody):
    """A body of a user's, with mass and inertia from other numbers."""

    radius: fields.Number = fields.length(sign="positive")
    density: fields.Number = fields.parameter(unit="kg/m²", sign="positive")

    @property
    def mass(self):
        return jnp.pi * self.radius**2 * self.density

    @property
    def inertia(self):
        return 0.5 * self.mass * self.radius**2


def body_of_a_user(**options):
    own = Disc("disc", radius=0.4, density=3.0, position=(0.5, 0.0), velocity=(0.0, 1.0), angular_velocity=2.0)
    example = Example(pin_2d(own), [own], "point_b", (), (hold_2d(own),))
    case = side_by_side([example], **options)
    machine = case.machines[0]
    machine.always, case.parameters, case.outputs = ["disc.radius", "disc.density"], 5, 6
    return case


def placed(system, state):
    """What quantities by name need, of one state."""
    return lambda name: system.quantities()[name].value(jnp.zeros(1), mb.State(state.q[None], state.u[None]), None)


def assembled(name):
    """A state of a mechanism of the library, by its coordinates and rates that are fixed."""
    mechanism = mechanisms.get(name)
    bodies = [name for name, own in mechanism.system.quantities().items() if not own.of_forces]

    def observe(system, extra, rtol):
        state = mb.assemble(system, fix=mechanism.fix, rates=mechanism.rates, throw=False)
        return {name: placed(system, state)(name) for name in bodies}

    names = [name for name in mb.parameters(mechanism.system) if ".point" in name]
    return Case(mechanism.system, [Machine(name, names, bodies)], observe, parameters=5, outputs=8)


def measured_rod():
    """A rod in its link frame on a pin with a motor, a spring and an inertial sensor."""
    rod = planar.Body("rod", mass=1.0, inertia=0.1, centre=(0.4, 0.02), position=(0.0, 0.0))
    pin = planar.Revolute("pin", "ground", "rod", point_a=(0.0, 0.0), point_b=(0.0, 0.0))
    imu = planar.Frame("imu", "rod", position=(0.8, 0.05), angle=0.3)
    forces = [
        mb.Gravity((0.0, -9.81)),
        mb.JointForce("motor", "pin.angle", force=0.5),
        mb.JointSpring("spring", "pin.angle", stiffness=6.0, damping=0.2),
    ]
    return mb.Scene([rod], joints=[pin], frames=[imu], forces=forces).compile()


def inputs(interpolation, **options):
    """A motor whose torque is a series, and what a sensor shows; the values of the series are parameters."""
    system, seen = measured_rod(), ("imu.specific_force", "imu.position", "imu.angular_velocity", "pin.angle")

    def observe(system, extra, rtol):
        state = mb.assemble(system, rates={"pin.angle": 0.3}, throw=False)
        torque = mb.Series(np.linspace(0.0, 0.3, 4), extra["torque"], interpolation)
        own = {"t1": 0.3, "saveat": np.array([0.14, 0.3]), "inputs": {"motor.force": torque}}
        sol = run(system, state, rtol, **options, **own)
        return {name: sol.quantity(name) for name in seen} | {"energy": sol.energy}

    always = ["torque", "rod.centre", "imu.position", "imu.angle"]
    machine = Machine("rod", list(mb.parameters(system)), [*seen, "energy"], always)
    return Case(system, [machine], observe, {"torque": np.array([0.0, 2.0, -1.0, 1.5])}, parameters=7, outputs=8)


def linearised():
    """The matrices of small motions about an equilibrium, seen by a sensor."""
    system = measured_rod()

    def observe(system, extra, rtol):
        state = mb.equilibrium(system, throw=False)
        found = mb.linearise(
            system,
            state,
            coordinates=["pin.angle"],
            inputs=["motor.force"],
            outputs=["imu.specific_force", "imu.position"],
        )
        return {"A": found.A, "B": found.B, "C": found.C, "D": found.D}

    always = ["rod.centre", "imu.position", "imu.angle", "motor.force"]
    machine = Machine("rod", list(mb.parameters(system)), ["A", "B", "C", "D"], always)
    return Case(system, [machine], observe, parameters=7, outputs=16)


def equilibria():
    """Where gravity, springs, joints and the ground hold bodies at rest."""
    joints = named("planar", "Revolute, Prismatic, Distance")
    springs = named("planar", "SpringDamper, TorsionalSpringDamper, Bushing, Contact, Track")
    examples = [*joints, *springs]
    system = scene_of(examples)
    machines = machines_of(system, examples, ("position", "angle"))

    def observe(system, extra, rtol):
        value = placed(system, mb.equilibrium(system, throw=False))
        return {name: value(name) for machine in machines for name in machine.outputs}

    return Case(system, machines, observe, outputs=3)


def generalized(system, guess=None, **options):
    """A motion in generalized coordinates: coordinates, rates, energy, forces of constraints."""
    seen = list(system.quantities())

    def observe(system, extra, rtol):
        state = mb.assemble(system, guess, throw=False)
        sol = run(system, state, rtol, t1=0.3, saveat=np.array([0.15, 0.3]), **options)
        return {name: sol.quantity(name) for name in seen} | {"energy": sol.energy}

    return Case(
        system, [Machine("system", list(mb.parameters(system)), [*seen, "energy"])], observe, parameters=5, outputs=8
    )


def rough_ring(**options):
    """A bead on a ring, held back by three laws."""
    lift = lambda t, q, v, multipliers, p: p["lift"] * multipliers[0] * jnp.stack([-q[1], q[0]])
    return generalized(
        lagrangian.LagrangianSystem(
            kinetic=lambda t, q, v, p: 0.5 * p["mass"] * jnp.dot(v, v),
            potential=lambda t, q, p: 9.81 * p["mass"] * q[1],
            constraints=[lagrangian.Holonomic("ring", lambda t, q, p: 0.5 * (jnp.dot(q, q) - p["radius"] ** 2))],
            nonideal=[
                lagrangian.CoulombFriction("ring", "mu", transition_speed=0.1),
                lagrangian.Viscous("ring", "drag"),
                lagrangian.NonIdealForce("ring", lift),
            ],
            q=(0.6, 0.8),
            u=(-0.8, 0.6),
            parameters={"mass": 1.3, "radius": 1.0, "mu": 0.3, "drag": 0.2, "lift": 0.1},
        ),
        **options,
    )


def rows_of_every_level(**options):
    """Particles on springs, bound in positions, velocities (in two ways), accelerations, and by a program."""
    return generalized(
        lagrangian.LagrangianSystem(
            kinetic=lambda t, q, v, p: 0.5 * p["mass"] * jnp.dot(v, v),
            potential=lambda t, q, p: 0.5 * p["stiffness"] * jnp.sum((q - jnp.roll(q, 1)) ** 2) + jnp.sum(jnp.cos(q)),
            force=lambda t, q, v, p: -p["drag"] * v * jnp.sqrt(1.0 + v**2),
            constraints=[
                lagrangian.Holonomic("curve", lambda t, q, p: q[0] - p["bend"] * jnp.sin(q[1] + t)),
                lagrangian.Pfaffian(
                    "belt",
                    lambda t, q, p: jnp.zeros((1, 6)).at[0, 1].set(jnp.sin(q[3])).at[0, 2].set(jnp.cos(q[3])),
                    lambda t, q, p: -p["speed"] * jnp.cos(t + q[:1]),
                ),
                lagrangian.Nonholonomic("pace", lambda t, q, v, p: v[3] ** 2 + v[4] ** 2 - p["pace"] ** 2),
                lagrangian.AccelerationConstraint(
                    "rows",
                    lambda t, q, v, p: jnp.eye(6)[4:5] + 0.5 * jnp.eye(6)[1:2],
                    lambda t, q, v, p: p["share"] * jnp.cos(t + q[:1]) - v[4:5],
                ),
                lagrangian.ServoConstraint(
                    "follow", lambda t, q, p: q[5:6] - p["aim"] * jnp.sin(3.0 * t), damping=4.0, stiffness=9.0
                ),
            ],
            q=(0.1, 0.3, -0.2, 0.5, 0.1, 0.2),
            u=(0.2, 0.4, 0.5, 0.9, 0.7, 0.1),
            parameters={
                "mass": 1.3,
                "stiffness": 4.0,
                "drag": 0.3,
                "bend": 0.5,
                "speed": 0.4,
                "pace": 1.1,
                "share": 0.6,
                "aim": 0.3,
            },
        ),
        **options,
    )


def of_library(name, form, equations=None, **options):
    chosen = {} if equations is None else {"equations": equations}
    mechanism = mechanisms.get(name, form=form, **chosen)
    return generalized(mechanism.system, mechanism.state, **options)


# Functions that make a case, and how it is integrated, if it is.
FRONTS = {
    "Adams on a partition": (
        functools.partial(pendulum, SEEN),
        {"solver": solvers.Adams(), "manifold": manifold.Partition()},
    ),
    "Hermite": (functools.partial(pendulum, SEEN), {"solver": solvers.Hermite()}),
    "Baumgarte's terms": (
        functools.partial(pendulum, SEEN),
        {"solver": diffrax.Dopri8(), "manifold": manifold.Baumgarte()},
    ),
    "direction of a parameter": (
        functools.partial(pendulum, SEEN),
        DOPRI8 | {"direction": {"spring.stiffness": 1.0}},
    ),
    "event": (event, DOPRI8),
    # Derivatives by the times of jumps are known to multistep methods.
    "jumps": (jumps, {}),
    "body of a user": (body_of_a_user, FIXED),
    "assembly in space": (functools.partial(assembled, "spatial_slider_crank"), {}),
    "equilibria": (equilibria, {}),
    "cubic inputs with Hermite": (functools.partial(inputs, "cubic"), {"solver": solvers.Hermite()}),
    "linearised": (linearised, {}),
}
LAGRANGIAN = {
    "rough ring": rough_ring,
    "rows of every level": rows_of_every_level,
    "Hamel's equations": functools.partial(of_library, "roller_racer", "frame", lagrangian.Hamel()),
    "Voronets' equations": functools.partial(of_library, "nonholonomic_cart", "connection", lagrangian.Voronets()),
    "quasi-velocities": functools.partial(of_library, "constant_speed_particle", "quasi"),
}
CASES = (
    FRONTS
    | {name: (build, FIXED) for name, build in LAGRANGIAN.items()}
    | {name: (functools.partial(side_by_side, examples), options) for name, (examples, options) in GROUPS.items()}
    | {
        name: (functools.partial(at_one_instant, examples), {"formulation": formulation})
        for name, (examples, formulation) in INSTANTS.items()
    }
)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_forward_reverse_and_differences(name):
    """Of several outputs by several parameters, whose derivatives do not vanish."""
    build, options = CASES[name]
    assert check(name, build(**options)) >= 4


# Coverage


def kinds_within(value):
    """The classes of a module and of those within it."""
    if isinstance(value, list | tuple):
        return {kind for entry in value for kind in kinds_within(entry)}
    if not isinstance(value, eqx.Module):
        return set()
    own = [getattr(value, field.name, None) for field in dataclasses.fields(value)]
    return {type(value)} | kinds_within(own)


def left_out(module, kinds, found):
    """Names of the classes of these kinds that a module exports and that were not found."""
    return {name for name in exported(module, kinds) if getattr(module, name) not in found}


def test_every_part_and_law_stands_in_a_scene():
    examples = [example for own, _ in [*GROUPS.values(), *INSTANTS.values()] for example in own]
    found = kinds_within([[e.part, e.bodies, e.joints, e.forces] for e in examples]) | {mb.Gravity}
    # Derivatives through contacts and dry friction are those of `tests/simulate/test_contacts.py` and
    # `test_dry_friction.py`.
    found |= {type(part) for part, _, _ in CONTACTS.values()} | {type(part) for *_, part in FRICTIONS.values()}
    for module in (planar, spatial, mb):
        assert left_out(module, OF_SCENES, found) == set()
    for module, kind in ((contact, AbstractNormalLaw), (contact, AbstractFrictionLaw), (terrain, AbstractTerrain)):
        assert left_out(module, kind, found) == set()


def test_every_method_is_used():
    used = [value for _, options in CASES.values() for value in options.values()]
    found = {type(value) for value in used} | {diffrax.ConstantStepSize}
    assert left_out(formulations, formulations.AbstractFormulation, found) == set()
    forms = typing.get_args(typing.get_type_hints(UdwadiaKalaba)["method"])
    assert set(forms) == {value.method for value in used if isinstance(value, UdwadiaKalaba)}
    assert left_out(solvers, diffrax.AbstractSolver, found) == set()
    assert diffrax.Dopri8 in found
    assert left_out(manifold, manifold.AbstractManifold, found) == set()


@pytest.mark.slow
def test_every_kind_of_lagrangian_system_is_there():
    systems = [build(**FIXED).system for build in LAGRANGIAN.values()]
    found = kinds_within([[s.constraints, s.nonideal, s.kinematics, s.equations] for s in systems])
    kinds = (AbstractCoordinateConstraint, AbstractNonIdealForce, AbstractKinematics, AbstractEquations)
    assert left_out(lagrangian, kinds, found) == set()
