"""Constraints of systems from a Lagrangian: geometric phases, control, friction, the spherical four-bar, bad input."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import mechanisms
from jaxmb.formulations import Multipliers, Partitioned, accelerations
from jaxmb.lagrangian import (
    AccelerationConstraint,
    Connection,
    CoulombFriction,
    Hamel,
    Holonomic,
    LagrangianSystem,
    Nonholonomic,
    NonIdealForce,
    Pfaffian,
    QuasiVelocities,
    QuasiVelocityFrame,
    ServoConstraint,
    Voronets,
)

ZERO = jnp.zeros(())


@functools.cache
def library(name, **parameters):
    return mechanisms.get(name, **parameters)


def free(t, q, v, p):
    return 0.5 * jnp.dot(v, v)


# The snake's geometric phase


def circle(t):
    return jnp.stack([0.9 + 0.3 * jnp.cos(t), 0.2 + 0.3 * jnp.sin(t)])


@pytest.mark.slow
def test_a_closed_path_of_shapes_moves_the_snake():
    mechanism = library("three_platform_snake", gait=circle)
    system, state = mechanism.system, mechanism.state
    assert system.velocity_rank == system.nu and system.linear and not system.drift_free
    run = lambda y, t0, t1: mb.simulate(system, y, t0=t0, t1=t1, rtol=1e-12, atol=1e-14)
    last = lambda out: jax.tree.map(lambda y: y[-1], out.ys)
    once = last(run(state, 0.0, 2 * np.pi))
    np.testing.assert_allclose(once.q[:3], (0.341277854133, 0.002496318416, 0.482671126542), rtol=0, atol=1e-9)
    # In SE(2) two periods are the square of one.
    twice = last(run(once, 2 * np.pi, 4 * np.pi))
    x, y, theta = np.asarray(once.q[:3])
    moved = (x + x * np.cos(theta) - y * np.sin(theta), y + x * np.sin(theta) + y * np.cos(theta), 2 * theta)
    np.testing.assert_allclose(twice.q[:3], moved, rtol=0, atol=1e-10)
    back = last(run(once, 2 * np.pi, 0.0))
    np.testing.assert_allclose(back.q[:3], 0.0, atol=1e-11)


# Control


def deviation(t, q):
    return np.array([q[0] - 0.5 * np.sin(t), q[2] - q[0] - 0.2 * np.cos(2 * t)])


@pytest.mark.slow
def test_the_desired_motion_is_kept_and_found():
    mechanism = library("tracking_chain")
    run = mb.simulate(mechanism.system, mechanism.state, t1=20.0, rtol=1e-12, atol=1e-13)
    assert np.max(np.abs(deviation(20.0, run.ys.q[-1]))) < 1e-12
    np.testing.assert_allclose(run.ys.q[-1, 1], 0.3463702111, rtol=0, atol=1e-8)
    np.testing.assert_allclose(run.constraint_forces["track"][-1], (7.88958994, 0.0, 0.27118949), rtol=0, atol=1e-6)
    off = mechanisms.tracking_chain(offset=0.1, gains=(10.0, 25.0))
    assert np.max(np.abs(deviation(0.0, off.state.q))) > 0.1
    found = mb.simulate(off.system, off.state, t1=10.0, rtol=1e-11, atol=1e-13)
    assert np.max(np.abs(deviation(10.0, found.ys.q[-1]))) < 1e-11


@pytest.mark.slow
def test_a_servo_beside_constraints_that_are_kept():
    """A pendulum in Cartesian coordinates whose height follows: one chart for the bar, its force and the control's."""
    bar = Holonomic("bar", lambda t, q, p: jnp.dot(q, q) - 1.0)
    follow = ServoConstraint("follow", lambda t, q, p: q[1] + 0.8 - 0.1 * jnp.sin(3 * t), damping=8.0, stiffness=16.0)
    system = LagrangianSystem(
        kinetic=free, potential=lambda t, q, p: 9.81 * q[1], constraints=[follow, bar], q=(0.6, -0.8), u=(0.0, 0.0)
    )
    assert (system.position_rows, system.velocity_rows) == (1, 1)
    assert (system.acceleration_rows, system.acceleration_rank) == (2, 2)
    run = mb.simulate(system, system.guess, t1=6.0, rtol=1e-10)
    assert float(run.constraint_violation.position[-1]) < 1e-12
    np.testing.assert_allclose(run.ys.q[-1, 1], -0.8 + 0.1 * np.sin(18.0), rtol=0, atol=1e-7)


def test_constraints_of_accelerations_are_what_their_rows_say():
    """Of rows that are given, and of a deviation that decays as its gains say."""
    right = lambda t, q, v, p: jnp.cos(t) - v[:1]
    rows = AccelerationConstraint("rows", lambda t, q, v, p: jnp.array([[1.0, 2.0]]), right)
    plain = LagrangianSystem(kinetic=free, constraints=[rows], q=(0.0, 0.0), u=(1.0, 0.0))
    servo = ServoConstraint("servo", lambda t, q, p: q[1] - jnp.sin(2 * t), damping=8.0, stiffness=16.0)
    held = LagrangianSystem(kinetic=free, constraints=[servo], q=(0.3, 0.5), u=(1.0, -0.7))
    solve = lambda system: accelerations(system, Partitioned(), jnp.asarray(0.3), *jax.tree.leaves(system.guess))[0]
    found, deviating = map(np.asarray, jax.jit(lambda: (solve(plain), solve(held)))())
    np.testing.assert_allclose(found[0] + 2 * found[1], np.cos(0.3) - 1.0, rtol=1e-14)
    np.testing.assert_allclose(found[1], 2 * found[0], rtol=1e-14)
    phi, rate = 0.5 - np.sin(0.6), -0.7 - 2 * np.cos(0.6)
    np.testing.assert_allclose(deviating, [0.0, -4 * np.sin(0.6) - 8 * rate - 16 * phi], rtol=1e-13, atol=1e-15)


# Constraints that are not ideal


def ring(*laws, extra=(), **kwargs):
    rows = Holonomic("ring", lambda t, q, p: 0.5 * (jnp.dot(q, q) - 1.0))
    kwargs = {"q": (0.6, 0.8), "u": (-0.8, 0.6), "parameters": {"mu": 0.3, "c": 0.2}, **kwargs}
    return LagrangianSystem(kinetic=free, constraints=[rows, *extra], nonideal=laws, **kwargs)


@pytest.mark.slow
def test_work_of_constraint_forces():
    """`w · (M u̇ − F) = w · C` in every displacement w that is allowed, and the constraint holds whatever C is."""
    along = np.array([-0.8, 0.6])
    wild = NonIdealForce("ring", lambda t, q, v, multipliers, p: jnp.array([0.7, -0.4]) * multipliers[0] ** 2)
    normal = NonIdealForce("ring", lambda t, q, v, multipliers, p: 5.0 * q)
    systems = [ring(wild), ring(normal), ring()]
    q, u = systems[0].guess.q, systems[0].guess.u
    for formulation in (Partitioned(), Multipliers()):
        udot, *others = (np.asarray(accelerations(own, formulation, ZERO, q, u)[0]) for own in systems)
        # On a ring of radius one at speed one the constraint's λ and the part of C along it, 0.1 λ², add up to −1;
        # λ is found by iteration, to 64 rounding errors of |λ⁰| + |λ| + |P C|, which is below 5.
        multiplier, near = (-1 + np.sqrt(0.6)) / 0.2, 64 * 5 * np.finfo(float).eps
        np.testing.assert_allclose(along @ udot, along @ np.array([0.7, -0.4]) * multiplier**2, rtol=0, atol=near)
        np.testing.assert_allclose(systems[0].acceleration_residual(ZERO, q, u, udot), 0.0, atol=1e-14)
        # What is normal to the ring has no effect.
        np.testing.assert_allclose(*others, rtol=0, atol=1e-14)


# The spherical four-bar


@pytest.mark.slow
def test_the_spherical_four_bar():
    mechanism = library("spherical_four_bar")
    system, state = mechanism.system, mechanism.state
    assert (system.coordinate_rank, system.velocity_rank, system.nu) == (5, 5, 6)
    udot, _ = accelerations(system, Partitioned(), ZERO, state.q, state.u)
    np.testing.assert_allclose(udot[:2], (-14.4937116428, 10.4421360647), rtol=0, atol=1e-9)
    np.testing.assert_allclose(state.q[3] ** 2 + state.q[4] ** 2, 0.0669872981, rtol=0, atol=1e-10)
    run = mb.simulate(system, state, t1=3.0, rtol=1e-12, saveat=np.linspace(0.0, 3.0, 7))
    assert np.all(run.constraint_violation.position < 1e-11)
    balance = run.energy - 0.1 * run["theta"]
    np.testing.assert_allclose(balance, balance[0], rtol=0, atol=1e-10)


# Derivatives


# Mechanism, and its parameters with their values and what they change by.
DIFFERENTIATED = {
    "tracking_chain": ({"offset": 0.1, "gains": (10.0, 25.0)}, {"masses": [1.0, 2.0, 1.5], "damping": 0.1}),
    "rough_ring": ({}, {"friction": 0.3, "gravity": 0.5}),
    "roller_racer": ({}, {"pivot": 0.5, "front_inertia": 0.05}),
    "constant_speed_particle": ({"form": "quasi"}, {"speed": 3.0, "gravity": 9.81}),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", DIFFERENTIATED)
def test_derivatives_three_ways(name):
    """Of a servo, of friction, in a frame and in quasi-velocities: forward, reverse and central differences."""
    arguments, start = DIFFERENTIATED[name]
    mechanism = library(name, **arguments)

    def loss(x, rtol):
        changed = {key: jnp.asarray(value) + x[k] for k, (key, value) in enumerate(start.items())}
        system = mb.with_parameters(mechanism.system, changed)
        out = mb.simulate(system, mechanism.state, t1=0.3, rtol=rtol, max_steps=512, throw=False)
        seen = jnp.concatenate([y[-1] for y in jax.tree.leaves(out.ys)])
        return jnp.sum(seen / (1.0 + jnp.arange(seen.size, dtype=float)))

    twice = lambda x, rtol: (loss(x, rtol),) * 2
    derivatives_and_value = jax.jit(jax.jacfwd(twice, has_aux=True))
    forward, _ = derivatives_and_value(np.zeros(2), 1e-10)
    reverse = jax.jit(jax.grad(lambda x: loss(x, 1e-10)))(np.zeros(2))
    scale = np.max(np.abs(forward))
    assert np.all(np.abs(forward) > 1e-4 * scale)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-9 * scale)
    h = 1e-4
    value = lambda k: np.array([derivatives_and_value(k * h * e, 1e-13)[1] for e in np.eye(2)])
    central = (8 * (value(1.0) - value(-1.0)) - (value(2.0) - value(-2.0))) / (12 * h)
    np.testing.assert_allclose(forward, central, rtol=1e-5, atol=1e-7 * scale)


# Bad input


def system(**kwargs):
    return LagrangianSystem(**{"kinetic": free, "q": (0.6, 0.8), **kwargs})


def always(value):
    """A function of everything with one value."""
    return lambda *given: jnp.asarray(value)


def held(*constraints, **further):
    return {"constraints": constraints, **further}


def moved(kinematics, **further):
    return {"kinematics": kinematics, **further}


ONE = Holonomic("ring", lambda t, q, p: jnp.dot(q, q) - 1.0)
SAME = Holonomic("same", lambda t, q, p: 2 * jnp.dot(q, q) - 2.0)
RUB = {"nonideal": [CoulombFriction("ring", "mu")]}
ALL, FIRST = (lambda t, q, *rest: q), (lambda t, q, *rest: q[:1])
REFUSED = [
    ({"lagrangian": free}, "either `lagrangian` or `kinetic`"),
    ({"kinetic": lambda t, q, v, p: jnp.sum(jnp.abs(v))}, "second derivatives"),
    ({"force": always(np.zeros(3))}, "force must have shape"),
    ({"equations": Hamel()}, "kinematics=QuasiVelocityFrame"),
    ({"equations": Voronets()}, "kinematics=Connection"),
    ({"coordinates": ("x", "x")}, "all different"),
    (held(ONE, coordinates=("ring", "s")), "'ring' is a constraint as well as a coordinate"),
    (held(ONE, ONE), "'ring' is used twice"),
    (held(free), "constraints must hold"),
    (held(Holonomic("far", lambda t, q, p: jnp.dot(q, q) + 1.0)), "far"),
    (held(Nonholonomic("cone", lambda t, q, v, p: jnp.sqrt(jnp.dot(v, v)))), "cone: its derivative"),
    (
        held(AccelerationConstraint("a", always(np.ones((1, 2))), ALL)),
        r"a: right must have shape \(1,\), .* got \(2,\)",
    ),
    (held(AccelerationConstraint("a", always(np.eye(2)), FIRST)), r"a: right must have shape \(2,\), .* got \(1,\)"),
    (held(Pfaffian("belt", always(np.ones((1, 2))), ALL)), r"belt: drift must have shape \(1,\), .* got \(2,\)"),
    (moved(QuasiVelocityFrame(always(np.ones((2, 3))), 3)), "at most one per coordinate"),
    (moved(QuasiVelocityFrame(always(np.ones((2, 2))), 2), equations=Hamel()), "not independent"),
    (moved(QuasiVelocityFrame(always(1.0), 1)), r"matrix of a frame must have shape \(2, 1\), got \(\)"),
    (moved(QuasiVelocities(lambda t, q, v, p: v[0] * jnp.ones(2), (1.0, 1.0))), "not invertible"),
    (moved(Connection((0,), (0,), always(np.ones((1, 1))))), "each of them once"),
    (moved(Connection((0,), (1,), always(np.zeros((2, 1))))), r"matrix .* must have shape \(1, 1\), got \(2, 1\)"),
    (moved(Connection((0,), (1,), always(1.0))), r"must have shape \(1, 1\), got \(\)"),
    (moved(Connection((0,), (1,), always(np.zeros((1, 1))), ALL)), r"drift .* must have shape \(1,\), got \(2,\)"),
    ({"nonideal": [CoulombFriction("wire", "mu")]}, "'wire'"),
    (held(ONE, SAME, **RUB, parameters={"mu": 0.1}), "not determined"),
    (held(ONE, **RUB), "'mu'"),
]


def test_refused():
    for arguments, message in REFUSED:
        with pytest.raises(ValueError, match=message):
            system(**arguments)


def test_bad_transpositions():
    with pytest.raises(ValueError, match="'holder', 'suslov'"):
        Hamel("vakonomic")
    frame = QuasiVelocityFrame(lambda t, q, p: jnp.eye(2), 2)
    with pytest.raises(ValueError, match="must have shape"):
        system(kinematics=frame, equations=Hamel(lambda t, q, v, dq, p: jnp.zeros(3)))


def test_contradicting_rows_leave_a_residual():
    """Rows of accelerations that cannot hold together are found in what is left of them."""
    rows = lambda name, value: AccelerationConstraint(
        name, lambda t, q, v, p: jnp.array([[1.0, 0.0]]), lambda t, q, v, p: jnp.array([value])
    )
    with pytest.raises(ValueError, match="one, two"):
        system(constraints=[rows("one", 1.0), rows("two", 2.0)])
    belt = lambda name, speed: Pfaffian(name, lambda t, q, p: jnp.array([[1.0, 0.0]]), lambda t, q, p: -speed * q[:1])
    with pytest.raises(ValueError, match=r"slow, fast.*no velocities"):
        system(constraints=[belt("slow", 1.0), belt("fast", 2.0)])


@pytest.mark.slow
def test_pfaffian_with_a_drift():
    moving = Pfaffian("belt", lambda t, q, p: jnp.array([[0.0, 1.0]]), lambda t, q, p: -p["speed"])
    belt = system(constraints=[moving], parameters={"speed": 0.3})
    assert belt.linear and not belt.drift_free
    start = mb.assemble(belt, rates={"q0": 0.5})
    np.testing.assert_allclose(start.u, (0.5, 0.3), rtol=0, atol=1e-15)
    run = mb.simulate(belt, start, t1=1.0)
    np.testing.assert_allclose(run.ys.q[-1], (1.1, 1.1), rtol=0, atol=1e-10)
