"""One machine with all that a sweep's function may refer to, and ways of changing it; importable by other processes."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxmb as mb
from jaxmb import planar

SCALE = 1.0


class Law(eqx.Module):
    """A force law with a number and a choice."""

    gain: float
    kind: str = eqx.field(static=True, default="viscous")

    def __call__(self, speed):
        return -self.gain * speed


class Stiffer(Law):
    """The same fields and another formula."""

    def __call__(self, speed):
        return -self.gain * speed**3


class Wind:
    """A user's class of no kind that JAX knows."""

    def __init__(self, strength, options=()):
        self.strength, self.options = strength, dict(options)

    def force(self, poses, velocities, t, p):
        return self.strength * jnp.ones(3) * t

    def gust(self, poses, velocities, t, p):
        return self.strength * jnp.ones(3) * t**2


def scaled(t):
    return SCALE * t


def delayed(t, p, delay=0.1):
    return jnp.sin(t - delay)


def within(amplitude):
    return lambda t, p: amplitude * jnp.sin(t)


def power(exponent, t, p):
    return t**exponent


def with_global(scale):
    """A function of this module that reads another value of the global `SCALE`."""
    made = type(scaled)(scaled.__code__, {"SCALE": scale}, "scaled")
    made.__module__ = __name__
    return made


def _with_default(value):
    def law(t, a=value):
        return a * t

    return law


def helper(k):
    return 2 * k


def other_helper(k):
    return 3 * k


def _nested_two(k):
    return {"x": (lambda y: 2 * y)(k)}


def _nested_three(k):
    return {"x": (lambda y: 3 * y)(k)}


def quick(t, measured, states, p):
    return -p["gain"] * measured["rate"], {}


def slow(t, measured, states, p):
    return -p["gain"] * measured["rate"] ** 3, {}


@jax.custom_jvp
def smooth(x):
    return jnp.abs(x)


smooth.defjvp(lambda primals, tangents: (smooth(*primals), jnp.sign(primals[0]) * tangents[0]))


@jax.custom_jvp
def smoother(x):
    return jnp.abs(x)


smoother.defjvp(lambda primals, tangents: (smoother(*primals), jnp.tanh(primals[0]) * tangents[0]))


def machine(
    motion=lambda t, p: jnp.sin(t),
    control=quick,
    wind=None,
    names=("wheel", "elbow", "wind"),
    joint=planar.Revolute,
    to="wheel",
    mass=1.0,
    ground=None,
    normal=None,
    order=1,
    more=(),
):
    """A wheel under a controller with an arm on it, and a ball over a terrain that is turned by a driver."""
    wheel, elbow, push = names
    bodies = [
        planar.Body(wheel, mass=mass, inertia=0.5),
        planar.Body("arm", mass=1.0, inertia=0.5, position=(1.0, 0.0)),
        planar.Body("ball", mass=1.0, inertia=0.1, position=(2.0, 1.0)),
    ]
    joints = [
        planar.Revolute("axle", "ground", wheel, point=(0.0, 0.0)),
        joint(elbow, wheel if to == "wheel" else to, "arm", point=(1.0, 0.0)),
        planar.Driver("drive", "ground", "ball", quantity="angle", motion=motion),
    ]
    forces = [
        mb.Gravity((0.0, -9.81)),
        mb.Controller("control", control, {"rate": "axle.angle_rate"}, "axle.angle", parameters={"gain": 1.0}),
        mb.Force(push, "ball", Wind(1.0).force if wind is None else wind),
        planar.Contact(
            "contact",
            "ball",
            radius=0.1,
            terrain=mb.terrain.Flat() if ground is None else ground,
            normal=mb.contact.Linear(1e4) if normal is None else normal,
        ),
    ]
    return mb.Scene(bodies[::order], joints=joints, forces=[*forces, *more])


def of_machine(**options):
    """A swept function that refers to a machine."""
    system = machine(**options)
    return lambda k: {"x": k, "n": len(system.bodies)}


def of(*held):
    """A swept function that refers to anything else."""
    return lambda k: {"x": k, "n": len(held)}


# For each way of changing what a sweep computes: two machines, made anew with every call.
CHANGES = {
    "a driver's function": (of_machine, lambda: of_machine(motion=lambda t, p: jnp.sin(5 * t))),
    "a function of the same constants": (
        lambda: of_machine(motion=lambda t, p: jnp.sin(t)),
        lambda: of_machine(motion=lambda t, p: jnp.cos(t)),
    ),
    "the value of a closure": (lambda: of_machine(motion=within(1.0)), lambda: of_machine(motion=within(2.0))),
    "a default argument": (
        lambda: of_machine(motion=delayed),
        lambda: of_machine(motion=lambda t, p, delay=0.2: jnp.sin(t - delay)),
    ),
    "a default argument of one code": (
        lambda: of(_with_default(1.0)),
        lambda: of(_with_default(2.0)),
    ),
    "a global that a function reads": (lambda: of(with_global(1.0)), lambda: of(with_global(2.0))),
    "a partial": (
        lambda: of_machine(motion=functools.partial(power, 2)),
        lambda: of_machine(motion=functools.partial(power, 3)),
    ),
    "the object of a bound method": (
        lambda: of_machine(wind=Wind(1.0).force),
        lambda: of_machine(wind=Wind(2.0).force),
    ),
    "a bound method": (lambda: of_machine(wind=Wind(1.0).force), lambda: of_machine(wind=Wind(1.0).gust)),
    "a dictionary in an object": (
        lambda: of_machine(wind=Wind(1.0, {"a": 1}).force),
        lambda: of_machine(wind=Wind(1.0, {"a": 2}).force),
    ),
    "a function of a controller": (of_machine, lambda: of_machine(control=slow)),
    "the name of a body": (of_machine, lambda: of_machine(names=("disc", "elbow", "wind"))),
    "the name of a joint": (of_machine, lambda: of_machine(names=("wheel", "hinge", "wind"))),
    "the name of a force": (of_machine, lambda: of_machine(names=("wheel", "elbow", "storm"))),
    "a joint of another type": (of_machine, lambda: of_machine(joint=planar.Fixed)),
    "a topology": (of_machine, lambda: of_machine(to="ground")),
    "a number": (of_machine, lambda: of_machine(mass=1.0 + 1e-15)),
    "an order of parts": (of_machine, lambda: of_machine(order=-1)),
    "a part": (of_machine, lambda: of_machine(more=(planar.Torque("t", "arm", torque=0.0),))),
    "a terrain": (of_machine, lambda: of_machine(ground=mb.terrain.Slope(0.0))),
    "the function of a terrain": (
        lambda: of_machine(ground=mb.terrain.Surface(lambda place, p: 0.1 * place[0])),
        lambda: of_machine(ground=mb.terrain.Surface(lambda place, p: 0.2 * place[0])),
    ),
    "a contact law": (of_machine, lambda: of_machine(normal=mb.contact.Hertz(1e4))),
    "the values of an input": (
        lambda: of(mb.Series([0.0, 1.0], [0.0, 1.0])),
        lambda: of(mb.Series([0.0, 1.0], [0.0, 2.0])),
    ),
    "the interpolation of an input": (
        lambda: of(mb.Series([0.0, 1.0], [0.0, 1.0], "linear")),
        lambda: of(mb.Series([0.0, 1.0], [0.0, 1.0], "held")),
    ),
    "an input that is a function": (
        lambda: of({"motor.torque": lambda t: 2.0 * t}),
        lambda: of({"motor.torque": lambda t: 3.0 * t}),
    ),
    "a formulation": (
        lambda: of(mb.formulations.NullSpace()),
        lambda: of(mb.formulations.Multipliers()),
    ),
    "an option of a solver": (
        lambda: of(mb.solvers.Adams(max_order=8)),
        lambda: of(mb.solvers.Adams(max_order=9)),
    ),
    "a word that is a choice": (lambda: of("auto"), lambda: of("switch")),
    "a number in a module": (lambda: of(Law(1.0)), lambda: of(Law(2.0))),
    "a static field of a module": (lambda: of(Law(1.0)), lambda: of(Law(1.0, "dry"))),
    "the class of a module": (lambda: of(Law(1.0)), lambda: of(Stiffer(1.0))),
    "a class": (lambda: of(Law), lambda: of(Stiffer)),
    "a compiled function": (lambda: of(jax.jit(quick)), lambda: of(jax.jit(slow))),
    "a batched function": (lambda: of(jax.vmap(quick)), lambda: of(jax.vmap(slow))),
    "a function that is kept": (lambda: of(functools.cache(quick)), lambda: of(functools.cache(slow))),
    "a rule of a derivative": (lambda: of(smooth), lambda: of(smoother)),
    "the type of a number": (lambda: of(np.float64(1.0)), lambda: of(np.float32(1.0))),
    "a shape": (lambda: of(np.zeros((2, 3))), lambda: of(np.zeros((3, 2)))),
    "where a list ends": (lambda: of([1, 2], [3]), lambda: of([1], [2, 3])),
    "a set of words": (lambda: of({"a", "b", "c"}), lambda: of({"a", "b", "d"})),
    "an exponent in the function": (lambda: lambda k: {"x": k**2}, lambda: lambda k: {"x": k**3}),
    "a function of a package": (lambda: lambda k: {"x": jnp.sin(k)}, lambda: lambda k: {"x": jnp.cos(k)}),
    "a function that the function defines": (lambda: _nested_two, lambda: _nested_three),
    "a function of this module": (lambda: lambda k: {"x": helper(k)}, lambda: lambda k: {"x": other_helper(k)}),
}
