"""Facts about a Lagrangian system that are found when it is made hold for all numbers of its parameters."""

from typing import ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb.lagrangian import Holonomic, LagrangianSystem, Nonholonomic
from jaxmb.lagrangian.constraints import AbstractCoordinateConstraint
from jaxmb.system import AbstractSystem, DiagonalInertia, Ranks

NAMES = ("m0", "m1", "m2", "b", "c", "k", "s")


def free(t, q, v, p):
    return 0.5 * v @ v


def kinetic(t, q, v, p):
    """Three masses with an inerter, a coupling that equal masses cancel, a product and a sine."""
    mass = jnp.stack([p["m0"], p["m1"], p["m2"]])
    coupling = p["b"] * (v[0] - v[1]) ** 2 + 0.2 * (p["m1"] - p["m2"]) * v[1] * v[2] + p["c"] * p["k"] * v[0] * v[2]
    return 0.5 * (mass @ v**2 + coupling + jnp.sin(p["s"]) * (v[0] + v[1] + v[2]) ** 2)


def mass_matrix(p):
    m0, m1, m2, b, c, k, s = (p[name] for name in NAMES)
    out = np.diag([m0 + b, m1 + b, m2]) + np.sin(s)
    for i, j, x in ((0, 1, -b), (1, 2, 0.1 * (m1 - m2)), (0, 2, 0.5 * c * k)):
        out[i, j] += x
        out[j, i] += x
    return out


def make(numbers):
    pull = lambda t, q, p: -(q[0] + 2 * q[1] - q[2])
    return LagrangianSystem(kinetic=kinetic, potential=pull, q=[0.0, 0.0, 0.0], parameters=numbers)


def degenerate(random):
    """Numbers of which some are zero and some are equal, as far as M stays regular."""
    numbers = dict.fromkeys(NAMES, 0.0)
    numbers |= {name: random.choice([1.0, 2.0]) for name in ("m0", "m1", "m2")}
    return numbers | {name: random.choice([0.0, 0.0, 0.3]) for name in ("b", "c", "k", "s")}


def test_mass_matrix_by_other_numbers():
    """The matrix of a system with other numbers than it was made with, by hand."""
    for seed in range(2):
        random = np.random.default_rng(seed)
        system = make(degenerate(random))
        numbers = {name: random.uniform(2, 4) if name[0] == "m" else random.uniform(0, 0.5) for name in NAMES}
        changed, zero = mb.with_parameters(system, numbers), np.zeros(3)
        run = jax.jit(lambda own, q, v: (own.inertia(0.0, q, v).product(jnp.eye(3)), own.force(0.0, q, v)))
        matrix, force = run(changed, zero, zero)
        np.testing.assert_allclose(matrix, mass_matrix(numbers), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(force, [1.0, 2.0, -1.0], rtol=1e-12)
    assert not make(dict.fromkeys(NAMES, 1.0) | {"b": 0.0, "c": 0.0, "s": 0.0}).diagonal


@pytest.mark.slow
def test_inerter_in_motion():
    """Two masses with an inerter b, of which one is pushed: a number, with derivatives, and a function of time."""
    lagrangian = lambda t, q, v, p: 0.5 * (v[0] ** 2 + v[1] ** 2 + p["b"] * (v[0] - v[1]) ** 2) + q[0]
    system = LagrangianSystem(lagrangian, q=[0.0, 0.0], parameters={"b": 0.0})
    state = mb.assemble(system)

    def end(b):
        return mb.simulate(mb.with_parameters(system, {"b": b}), state, t1=1.0, rtol=1e-9).ys.q[-1]

    # A unit force on the first moves them by M⁻¹ (1, 0) ½ t²; the derivative is that of b / (2 (1 + 2 b)).
    np.testing.assert_allclose(end(1.0), [1 / 3, 1 / 6], rtol=1e-8)
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(end)(0.0)[1], 0.5, rtol=1e-8)
    # The momenta are M(t) v = (t, 0), so the difference d of the velocities is t / (1 + 2 t), and their sum is t.
    growing = mb.simulate(system, state, t1=1.0, rtol=1e-10, inputs={"b": lambda t: t}).ys
    difference = 0.5 - 0.25 * np.log(3.0)
    np.testing.assert_allclose(growing.q[-1], [0.25 + 0.5 * difference, 0.25 - 0.5 * difference], rtol=1e-9)


def test_piecewise_matrix():
    """A mass that a comparison of a parameter couples is not taken for diagonal; a plain diagonal one is."""
    lagrangian = lambda t, q, v, p: 0.5 * v @ v + jnp.maximum(p["b"] - 5.0, 0.0) * v[0] * v[1]
    system = LagrangianSystem(lagrangian, q=[0.0, 0.0], parameters={"b": 1.0})
    changed = mb.with_parameters(system, {"b": 5.5})
    matrix = jax.jit(lambda v: changed.inertia(0.0, v, v).product(jnp.eye(2)))(np.zeros(2))
    np.testing.assert_allclose(matrix, [[1.0, 0.5], [0.5, 1.0]])
    plain = LagrangianSystem(lambda t, q, v, p: 0.5 * p["m"] * v @ v, q=[0.0, 0.0], parameters={"m": 1.0})
    assert plain.diagonal


class Belt(AbstractCoordinateConstraint):
    """A constraint of one's own between velocities that declares nothing about itself."""

    name: str = eqx.field(static=True)
    square: bool = eqx.field(static=True, default=False)
    level: ClassVar[int] = 1

    def value(self, t, q, v, a, parameters):
        rate = v[0] * v[0] if self.square else v[0]
        return (rate - parameters["slope"] * v[1] - parameters["speed"])[None]


class Lift(AbstractCoordinateConstraint):
    """A constraint of one's own between positions."""

    name: str = eqx.field(static=True)
    level: ClassVar[int] = 0

    def value(self, t, q, v, a, parameters):
        return (q[0] - parameters["speed"] * t)[None]


def test_constraints_of_ones_own():
    """Data flow tells what constraints do not declare: drift by a parameter that is zero, and squares of velocities."""
    common = {"q": [0.0, 0.0], "u": [0.0, 0.0], "parameters": {"slope": 0.0, "speed": 0.0}}
    belt, lift = (LagrangianSystem(free, constraints=[c], **common) for c in (Belt("belt"), Lift("lift")))
    assert (belt.linear, belt.drift_free, lift.linear, lift.drift_free) == (True, False, True, False)
    for system in (belt, lift):
        moving = mb.with_parameters(system, {"speed": 0.5})
        np.testing.assert_allclose(mb.assemble(moving).u, [0.5, 0.0], atol=1e-12)
    common |= {"u": [1.0, 0.0], "parameters": {"slope": 0.0, "speed": 1.0}}
    assert not LagrangianSystem(free, constraints=[Belt("belt", square=True)], **common).linear


class Crank(AbstractSystem):
    """A point that an arm carries round, as a system of one's own that declares nothing about its velocities."""

    mass: jax.Array
    speed: jax.Array
    length: jax.Array
    guess: mb.State
    design: tuple = ()
    nq: ClassVar[int] = 2
    nu: ClassVar[int] = 2
    position_rows: ClassVar[int] = 1
    rows: ClassVar = (("arm", 0),)
    ranks: ClassVar[Ranks] = Ranks(1, 1, 1, 1)

    def coordinate_names(self):
        return {"x": [0], "y": [1]}

    def parameter_paths(self):
        return {"speed": [(lambda s: s.speed, None)]}

    def coordinate_scale(self):
        return jnp.ones(2)

    velocity_scale = coordinate_scale

    def inertia(self, t, q, u):
        return DiagonalInertia(jnp.full(2, self.mass))

    def force(self, t, q, u):
        return jnp.zeros(2)

    def kinetic_energy(self, t, q, u):
        return 0.5 * self.mass * jnp.dot(u, u)

    def potential_energy(self, t, q):
        return jnp.zeros(())

    def position_residual(self, t, q):
        return (q[0] - jnp.sin(self.speed * t))[None]

    def velocity_residual(self, t, q, u):
        return (u[0] - self.speed * jnp.cos(self.speed * t))[None]

    def acceleration_residual(self, t, q, u, udot):
        return (udot[0] + self.speed**2 * jnp.sin(self.speed * t))[None]


def test_systems_of_ones_own():
    """A drive that stands still when the system is made has a drift all the same."""
    crank = Crank(jnp.ones(()), jnp.zeros(()), jnp.ones(()), mb.State(jnp.zeros(2), jnp.zeros(2)))
    assert (crank.linear, crank.drift_free) == (True, False)
    np.testing.assert_allclose(mb.assemble(mb.with_parameters(crank, {"speed": 2.0})).u, [2.0, 0.0], atol=1e-12)


WRONG = {
    "kinetic": {"kinetic": lambda t, q, v, p: 0.5 * (v[0] ** 2 + v[5] ** 2)},
    "potential": {"potential": lambda t, q, p: jnp.sin(q)[3] ** 2},
    "force": {"force": lambda t, q, v, p: jnp.stack([v[-3], v[0]])},
    "bar": {"constraints": [Holonomic("bar", lambda t, q, p: q[0] + q[2] - 0.5)]},
    "roll": {
        "parameters": {"n": np.ones(2)},
        "constraints": [Nonholonomic("roll", lambda t, q, v, p: v[0] * p["n"][jnp.array([0, 4])])],
    },
}


def test_indices_out_of_bounds():
    """Also of a function of an event."""
    for name, own in WRONG.items():
        with pytest.raises(ValueError, match=f"{name} indexes out of bounds: index -?[0-9] is out of bounds for axis"):
            LagrangianSystem(**{"kinetic": free, "q": [0.3, 0.2], **own})
    system = LagrangianSystem(free, q=[0.0, 0.0], u=[1.0, 0.0])
    event = diffrax.Event(lambda t, y, args, **more: jnp.cos(y.q)[2])
    with pytest.raises(ValueError, match="index 2 is out of bounds for axis 0 with size 2"):
        mb.simulate(system, system.guess, t1=1.0, event=event)
