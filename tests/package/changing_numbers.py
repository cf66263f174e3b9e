"""Ways in which a user's function holds a number that changes later, and places where such functions enter a system.

A way makes, of a formula `formula(k, *arguments)`, a function of the arguments and what sets the number. A place makes,
of such a way, a function that builds a system anew and one that computes something of a system by a compiled program.
"""

import functools
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxmb as mb
from jaxmb import planar
from jaxmb.lagrangian import (
    Holonomic,
    LagrangianSystem,
    NonIdealForce,
    Pfaffian,
    QuasiVelocityFrame,
)
from jaxmb.lagrangian.constraints import AbstractCoordinateConstraint
from jaxmb.lagrangian.kinematics import AbstractKinematics

# Ways to hold a number


def in_global(formula):
    scope: dict[str, Any] = {"formula": formula}
    exec("def law(*given): return formula(K, *given)", scope)
    return scope["law"], lambda k: scope.__setitem__("K", k)


def in_attribute(formula):
    class Machine:
        def law(self, *given):
            return formula(self.k, *given)

    machine = Machine()
    return machine.law, functools.partial(setattr, machine, "k")


def in_array(formula):
    table = np.zeros(40)
    return (lambda *given: formula(jnp.asarray(table)[8], *given)), functools.partial(table.__setitem__, 8)


def in_closure(formula):
    k = 0.0

    def change(value):
        nonlocal k
        k = value

    return (lambda *given: formula(k, *given)), change


def in_module_of_arrays(formula):
    class Law(eqx.Module):
        numbers: Any
        one: jax.Array

        def __call__(self, *given):
            return formula(self.numbers[0] * self.one, *given)

    numbers = [0.0]
    held = eqx.tree_at(lambda x: x.one, Law(None, jnp.zeros(())), jnp.ones(()))
    law = lambda *given: eqx.tree_at(lambda x: x.numbers, held, numbers, is_leaf=lambda x: x is None)(*given)
    return law, functools.partial(numbers.__setitem__, 0)


def in_rule(formula):
    """In a function with a rule of its own for derivatives, which reads the number as well."""
    numbers = [0.0]

    @jax.custom_jvp
    def scaled(x):
        return numbers[0] * x

    scaled.defjvp(lambda primals, tangents: (scaled(*primals), numbers[0] * tangents[0]))
    return (lambda *given: formula(scaled(jnp.ones(())), *given)), functools.partial(numbers.__setitem__, 0)


# They are traced, so that it does not matter how a function reaches a number, but for these.
WAYS = [in_global, in_attribute, in_array, in_closure, in_module_of_arrays, in_rule]

# Places of functions

BALL = planar.Body("ball", mass=1.0, inertia=1.0, position=(1.0, 0.5))
PIN = planar.Revolute("pin", "ground", "ball", point=(0.0, 0.0))
STATE = jnp.array([1.0, 0.5, 0.2]), jnp.array([0.3, -0.2, 0.1])


def scene(**parts):
    return lambda: mb.Scene([BALL], **parts).compile()


def of_force(system):
    return system.force(0.5, *STATE)


def of_positions(system):
    return system.position_residual(0.5, STATE[0])


def of_velocities(system):
    return system.velocity_residual(0.5, *STATE)


def force(way):
    law, change = way(lambda k, poses, velocities, t, p: -k * poses)
    return scene(forces=[mb.Force("law", "ball", law)]), of_force, change


def energy(way):
    law, change = way(lambda k, poses, t, p: 0.5 * k * jnp.sum(poses**2))
    own = mb.Force("law", "ball", lambda poses, velocities, t, p: -poses, potential=law)
    return scene(forces=[own]), lambda system: system.potential_energy(0.5, STATE[0]), change


def driver(way):
    law, change = way(lambda k, t, p: k * t)
    own = planar.Driver("turn", "ground", "ball", quantity="angle", motion=law)
    return scene(joints=[own]), of_positions, change


def servo(way):
    law, change = way(lambda k, t, p: k * t**2)
    own = planar.Driver("turn", "ground", "ball", quantity="angle", motion=law)
    build = scene(joints=[mb.Servo(own, damping=1.0, stiffness=2.0)])
    return build, lambda system: system.acceleration_residual(0.5, *STATE, STATE[1]), change


def constraint(way):
    law, change = way(lambda k, poses, t, p: (poses[0, 0] - 1.0 - k * t)[None])
    return scene(joints=[mb.Constraint("line", "ball", law)]), of_positions, change


def velocity_constraint(way):
    law, change = way(lambda k, poses, velocities, t, p: (velocities[0, 0] - k * velocities[0, 2])[None])
    own = mb.VelocityConstraint("roll", "ball", law, linear=True, homogeneous=True)
    return scene(joints=[own]), of_velocities, change


def curve(way):
    law, change = way(lambda k, point, p: k * (point @ point - 1.25))
    own = planar.PointOnCurve("ring", "ground", "ball", law)
    return scene(joints=[own]), lambda system: system.position_residual(0.5, 1.1 * STATE[0]), change


def nonideal(way):
    law, change = way(lambda k, poses, velocities, reactions, t, p: k * velocities)
    own = mb.NonIdeal("rub", "pin", law)
    of_state = lambda system: system.nonideal_force(0.5, *STATE, jnp.ones(2))
    return scene(joints=[PIN], forces=[own]), of_state, change


def controller(way):
    law, change = way(lambda k, t, measured, states, p: (-k * measured["angle"], {}))
    own = mb.Controller("control", law, {"angle": "pin.angle"}, "pin.angle")
    return scene(joints=[PIN], forces=[own]), of_force, change


def terrain(way):
    law, change = way(lambda k, place, p: 0.9 + 0.1 * k * place[0])
    ground = mb.terrain.Surface(law)
    own = planar.Contact("contact", "ball", radius=0.1, terrain=ground, normal=mb.contact.Linear(100.0))
    return scene(forces=[own]), of_force, change


def signal(way):
    law, change = way(lambda k, t: k * t)
    system = mb.Scene([BALL], forces=[planar.Torque("motor", "ball", torque=0.0)]).compile()
    return lambda: mb.with_inputs(system, {"motor.torque": law}), of_force, change


def own_force(way):
    law, change = way(lambda k, poses: -k * poses)

    class Spring(mb.parts.AbstractForce):
        name: str = mb.parts.name()
        body: str = mb.parts.body_name()

        def wrenches(self, space, poses, velocities, t):
            return law(poses[:, :3])

    return lambda own=Spring: mb.Scene([BALL], forces=[own("spring", "ball")]).compile(), of_force, change


def own_constraint(way):
    law, change = way(lambda k, poses, t: (poses[0, 1] - 0.5 - k * t)[None])

    class Line(mb.parts.AbstractConstraint):
        name: str = mb.parts.name()
        body: str = mb.parts.body_name()
        rows: ClassVar[int] = 1
        rheonomic: ClassVar[bool] = True

        def residual(self, space, poses, t):
            return law(poses, t)

    return lambda own=Line: mb.Scene([BALL], joints=[own("line", "ball")]).compile(), of_positions, change


def own_terrain(way):
    law, change = way(lambda k, place: 0.9 + 0.1 * k * place[0])

    class Hill(mb.terrain.AbstractTerrain):
        def height(self, place):
            return law(place)

    own = planar.Contact("contact", "ball", radius=0.1, terrain=Hill(), normal=mb.contact.Linear(100.0))
    return scene(forces=[own]), of_force, change


def own_body(way):
    law, change = way(lambda k, radius: (1.0 + k) * radius)

    class Disc(mb.parts.AbstractBody, mb.parts.AbstractPlanarPart):
        name: str = mb.parts.name()
        radius: mb.parts.Number = mb.parts.length(sign="positive")
        rotates: ClassVar[bool] = True

        @property
        def mass(self):
            return law(self.radius)

        @property
        def inertia(self):
            return 0.5 * self.radius**2

        def pose(self):
            return np.zeros(3)

        def velocities(self):
            return np.zeros(3)

    build = lambda: mb.Scene([Disc("disc", radius=0.5)]).compile()
    return build, lambda system: system.kinetic_energy(0.5, *STATE), change


def lagrangian_of(**arguments):
    common = {"kinetic": lambda t, q, v, p: 0.5 * v @ v, "q": [0.6, 0.8], "u": [0.4, -0.3]}
    return lambda: LagrangianSystem(**(common | arguments))


OF_TWO = jnp.array([0.6, 0.8]), jnp.array([0.4, -0.3])


def of_two(name, *more):
    return lambda system: getattr(system, name)(0.5, *OF_TWO[: 1 if name == "position_residual" else 2], *more)


def kinetic(way):
    law, change = way(lambda k, t, q, v, p: 0.5 * (1.0 + k) * v @ v)
    return lagrangian_of(kinetic=law), of_two("kinetic_energy"), change


def potential(way):
    law, change = way(lambda k, t, q, p: 0.5 * k * q[0] ** 2)
    return lagrangian_of(potential=law), of_two("force"), change


def applied(way):
    law, change = way(lambda k, t, q, v, p: -k * v)
    return lagrangian_of(force=law), of_two("force"), change


def holonomic(way):
    law, change = way(lambda k, t, q, p: (q @ q - 1.0 - k * t)[None])
    return lagrangian_of(constraints=[Holonomic("ring", law)]), of_two("position_residual"), change


def pfaffian(way):
    law, change = way(lambda k, t, q, p: jnp.stack([k * q[0], q[1]])[None])
    return lagrangian_of(constraints=[Pfaffian("blade", law)]), of_two("velocity_residual"), change


def nonideal_of_constraint(way):
    law, change = way(lambda k, t, q, v, multipliers, p: -k * v)
    ring = Holonomic("ring", lambda t, q, p: (q @ q - 1.0)[None])
    build = lagrangian_of(constraints=[ring], nonideal=[NonIdealForce("ring", law)])
    return build, of_two("nonideal_force", jnp.ones(1)), change


def frame(way):
    law, change = way(lambda k, t, q, p: jnp.stack([jnp.stack([1.0 + q[0] * 0.0, q[0] * k]), jnp.array([0.0, 1.0])]))
    return lagrangian_of(kinematics=QuasiVelocityFrame(law, 2)), of_two("rates"), change


def own_holonomic(way):
    law, change = way(lambda k, t, q: (q @ q - 1.0 - k * t)[None])

    class Ring(AbstractCoordinateConstraint):
        name: str = eqx.field(static=True)
        level: ClassVar[int] = 0

        def value(self, t, q, v, a, parameters):
            return law(t, q)

        def is_drift_free(self, q, parameters):
            return False

    return lagrangian_of(constraints=[Ring("ring")]), of_two("position_residual"), change


def own_kinematics(way):
    law, change = way(lambda k, u: (1.0 + k) * u)

    class Scaled(AbstractKinematics):
        identity: ClassVar[bool] = False
        linear: ClassVar[bool] = True
        drift_free: ClassVar[bool] = True

        def count(self, nq):
            return nq

        def rates(self, t, q, u, parameters):
            return law(u)

    return lagrangian_of(kinematics=Scaled()), of_two("rates"), change


PLACES = [
    force,
    energy,
    driver,
    servo,
    constraint,
    velocity_constraint,
    curve,
    nonideal,
    controller,
    terrain,
    signal,
    own_force,
    own_constraint,
    own_terrain,
    own_body,
    kinetic,
    potential,
    applied,
    holonomic,
    pfaffian,
    nonideal_of_constraint,
    frame,
    own_holonomic,
    own_kinematics,
]
