"""One motion from every way to write its equations: frames, connections, constraints, quasi-velocities."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import mechanisms
from jaxmb.formulations import Multipliers, Partitioned, accelerations
from jaxmb.lagrangian import (
    Connection,
    Hamel,
    LagrangianSystem,
    Nonholonomic,
    QuasiVelocities,
    QuasiVelocityFrame,
    Voronets,
)

ZERO = jnp.zeros(())


@functools.cache
def library(name, **parameters):
    return mechanisms.get(name, **parameters)


@jax.jit
def solved(system, q, u):
    """Accelerations, multipliers, and the coordinates' accelerations, at t = 0."""
    udot, multipliers = accelerations(system, Partitioned(), ZERO, q, u)
    v = system.rates(ZERO, q, u)
    a = jax.jvp(system.rates, (ZERO, q, u), (jnp.ones(()), v, udot))[1]
    return udot, multipliers, a


# Accelerations of an independent program, with its own derivatives, at these states.
PUBLISHED = {"roller_racer": (-0.35211055, 1.39346791), "nonholonomic_cart": (-0.24890835, 1.00990722)}
STATE = jnp.array([0.1, 0.2, 0.3, 0.7]), jnp.array([1.0, 0.5])


@pytest.mark.slow
@pytest.mark.parametrize("name", PUBLISHED)
def test_published_accelerations_and_multipliers(name):
    system = library(name).system
    udot, _, a = solved(system, *STATE)
    np.testing.assert_allclose(udot, PUBLISHED[name], rtol=0, atol=1e-8)
    constrained = library(name, form="constraints").system
    own, multipliers, again = solved(constrained, STATE[0], system.rates(ZERO, *STATE))
    np.testing.assert_allclose(again, a, rtol=0, atol=1e-13)
    np.testing.assert_allclose(own, a, rtol=0, atol=1e-13)
    if name == "roller_racer":
        np.testing.assert_allclose(multipliers, (0.16391926, 1.09314151), rtol=0, atol=1e-8)


# In the frame of the constraints or with their connection: Hamel's and Voronets' equations.
WRITTEN = {
    "roller_racer": ("frame", "connection"),
    "nonholonomic_cart": ("frame", "connection"),
    "three_platform_snake": ("connection",),
}


def rewritten(name, form, equations):
    """The same system with its equations written in another way, and a torque between the platforms."""
    system = library(name, form=form).system if form == "frame" else library(name, form="connection").system
    torque = lambda t, q, v, p: jnp.zeros_like(q).at[3].set(0.1 * jnp.cos(3 * q[3]) - 0.02 * v[3])
    written = lambda equations: LagrangianSystem(
        system.lagrangian,
        force=torque,
        kinematics=system.kinematics,
        equations=equations,
        q=system.guess.q,
        u=system.guess.u,
        parameters=system.parameters | {"gamma": np.zeros((system.nq,) * 3)},
    )
    return written(None), written(equations)


def any_variation(t, q, v, dq, p):
    return jnp.einsum("ijk,j,k->i", p["gamma"], v, dq)


@pytest.mark.slow
@pytest.mark.parametrize("name, form", [(name, form) for name, forms in WRITTEN.items() for form in forms])
def test_transpositional_relations_do_not_matter(name, form):
    random = np.random.default_rng(0)
    kind = Hamel if form == "frame" else Voronets
    states = []
    for transposition in ("holder", "suslov", 0.37, any_variation):
        projected, written = rewritten(name, form, kind(transposition))
        if not states:
            q = projected.guess.q[None] + 0.3 * random.standard_normal((3, projected.nq))
            states = [(q, random.standard_normal((3, projected.nu)))]
        q, u = states[0]
        expected = jax.vmap(solved, in_axes=(None, 0, 0))(projected, q, u)[0]
        found = jax.vmap(solved, in_axes=(None, 0, 0))(written, q, u)[0]
        size = np.max(np.abs(expected))
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * size)
        if callable(transposition):
            gamma = random.standard_normal((projected.nq,) * 3)
            changed = mb.with_parameters(written, {"gamma": gamma})
            again = jax.vmap(solved, in_axes=(None, 0, 0))(changed, q, u)[0]
            np.testing.assert_allclose(again, expected, rtol=0, atol=1e-12 * size)


@pytest.mark.slow
def test_derivatives_of_equations_written_in_another_way():
    """Forward and reverse, with respect to state and parameters, are those of the projected equations."""
    forms = {"frame": Hamel("suslov"), "connection": Voronets("holder")}
    for form, equations in forms.items():
        found = []
        for system in rewritten("roller_racer", form, equations):

            def solve(numbers, system=system):
                changed = mb.with_parameters(system, {"pivot": numbers[2]})
                return accelerations(changed, Partitioned(), ZERO, numbers[0], numbers[1])[0]

            numbers = STATE[0], STATE[1], system.parameters["pivot"]
            found += [jax.jit(jax.jacfwd(solve))(numbers), jax.jit(jax.jacrev(solve))(numbers)]
        for other in found[1:]:
            jax.tree.map(
                lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * np.max(np.abs(b))), other, found[0]
            )


def test_equations_in_a_frame_and_with_a_connection():
    """A sleigh on a plane that turns and is carried along: rheonomic in every term."""
    kinetic = lambda t, q, v, p: 0.5 * (1.3 * v[0] ** 2 + 1.1 * v[1] ** 2 + (0.4 + 0.1 * jnp.sin(q[0] + t)) * v[2] ** 2)
    potential = lambda t, q, p: jnp.sin(q[0]) * q[1] + 0.3 * q[2] ** 2 * jnp.cos(t)
    A = lambda t, q, p: jnp.stack([-jnp.sin(q[2] + t), 0.2 * q[1] * jnp.ones_like(q[2])])[None]
    a = lambda t, q, p: jnp.stack([0.3 * jnp.cos(t) + 0.1 * q[0] * q[1]])
    common = {"kinetic": kinetic, "potential": potential, "q": (0.3, -0.2, 0.5)}
    slip = lambda t, q, v, p: v[1] + A(t, q, p)[0] @ v[jnp.array([0, 2])] + a(t, q, p)[0]
    connection = Connection((0, 2), (1,), A, a)
    columns = lambda t, q, p: jax.jacfwd(lambda u: connection.rates(t, q, u, p))(jnp.zeros(2))
    frame = QuasiVelocityFrame(columns, 2, lambda t, q, p: connection.rates(t, q, jnp.zeros(2), p))
    ways = ((connection, None), (connection, Voronets("holder")), (frame, Hamel(0.37)))
    systems = [LagrangianSystem(**common, kinematics=k, equations=e) for k, e in ways]
    held = LagrangianSystem(**common, constraints=[Nonholonomic("slip", slip)])
    q, u = np.array(common["q"]), np.array([0.7, -0.4])

    @jax.jit
    def every(t):
        v = systems[0].rates(t, q, u)
        return [accelerations(own, Partitioned(), t, q, u)[0] for own in systems], accelerations(
            held, Multipliers(), t, q, v
        )[0]

    found, expected = every(0.4)
    for udot in found:
        np.testing.assert_allclose(udot, np.asarray(expected)[[0, 2]], rtol=1e-12)


# Nonlinear quasi-velocities


@pytest.mark.slow
def test_random_quasi_velocities_move_as_their_constraints():
    n, dependent = 4, (1, 3)
    random = np.random.default_rng(1)
    B, C, D = (random.standard_normal(shape) for shape in ((n, n), (n, n, n), (n, n)))

    def omega(t, q, v, p):
        mixed = v + 0.2 * jnp.tanh(B @ v) + 0.1 * jnp.einsum("ijk,j,k->i", C, jnp.sin(q), v)
        return mixed + 0.1 * jnp.cos(q + t)

    def kinetic(t, q, v, p):
        L = jnp.eye(n) + 0.2 * jnp.sin(D + q[None])
        return 0.5 * (v @ L @ L.T @ v)

    common = {
        "kinetic": kinetic,
        "potential": lambda t, q, p: jnp.sum(jnp.sin(q)),
        "force": lambda t, q, v, p: -0.1 * v,
        "q": 0.1 * random.standard_normal(n),
    }
    quasi = LagrangianSystem(**common, kinematics=QuasiVelocities(omega, np.zeros(n), dependent), u=(0.4, -0.3))
    t, q, u = jnp.asarray(0.2), quasi.guess.q, quasi.guess.u

    # Chetaev's multipliers give the same motion.
    rows = Nonholonomic("held", lambda t, q, v, p: omega(t, q, v, p)[jnp.array(dependent)])
    chetaev = LagrangianSystem(**common, constraints=[rows])

    @jax.jit
    def everything():
        udot = accelerations(quasi, Partitioned(), t, q, u)[0]
        v = quasi.rates(t, q, u)
        a = jax.jvp(quasi.rates, (t, q, u), (jnp.ones(()), v, udot))[1]
        both = jax.jvp(lambda t, q, v: omega(t, q, v, {}), (t, q, v), (jnp.ones(()), v, a))
        return a, accelerations(chetaev, Multipliers(), t, q, v)[0], both

    found, expected, held = map(np.asarray, everything())
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(held[:, list(dependent)], 0.0, atol=1e-14)


def test_quasi_velocities_of_a_speed_that_is_given():
    """Speed and heading of a particle, whose speed is s(t): the heading turns by `φ̇ = −g cos φ / s`."""

    def omega(t, q, v, p):
        return jnp.stack([jnp.hypot(v[0], v[1]) - p["speed"] * (1 + 0.1 * t), jnp.arctan2(v[1], v[0])])

    near = lambda t, q, omega, p: p["speed"] * jnp.stack([jnp.cos(omega[1]), jnp.sin(omega[1])])
    system = LagrangianSystem(
        kinetic=lambda t, q, v, p: 0.5 * v @ v,
        potential=lambda t, q, p: 9.81 * q[1],
        kinematics=QuasiVelocities(omega, near, (0,)),
        q=(0.0, 0.0),
        u=(0.3,),
        parameters={"speed": 3.0},
    )

    @jax.jit
    def run(t, q, u):
        udot, _ = accelerations(system, Partitioned(), t, q, u)
        v = system.rates(t, q, u)
        return udot, v, jax.jvp(system.rates, (t, q, u), (jnp.ones(()), v, udot))[1]

    t, heading = 0.5, 0.7
    udot, v, a = run(t, np.array([1.0, 2.0]), np.array([heading]))
    along, speed = np.array([np.cos(heading), np.sin(heading)]), 3.0 * (1 + 0.1 * t)
    turn = -9.81 * along[0] / speed
    np.testing.assert_allclose(udot, [turn], rtol=1e-12)
    np.testing.assert_allclose(v, speed * along, rtol=1e-12)
    np.testing.assert_allclose(a, 0.3 * along + speed * turn * np.array([-along[1], along[0]]), rtol=1e-12)


@pytest.mark.slow
def test_motion_in_quasi_velocities():
    """It is that of the constraint; the start of Newton's method is a function, which is not a value of the system."""
    references, quasi = library("constant_speed_particle").references, library("constant_speed_particle", form="quasi")
    run = jax.jit(
        lambda speed: (
            mb.simulate(mb.with_parameters(quasi.system, {"speed": speed}), quasi.state, t1=1.0, rtol=1e-12).ys
        )
    )(3.0)
    np.testing.assert_allclose(run.q[-1], references.values[-1, :2], rtol=0, atol=1e-10)
    np.testing.assert_allclose(run.u[-1, 0], -1.319751601680, rtol=0, atol=1e-10)


# Singular states


@pytest.mark.slow
def test_the_end_of_a_cone_is_a_result_and_not_a_number():
    """At rest the constraint has no gradient: there the motion ends."""
    mechanism = library("appell_hamel")
    run = mb.simulate(mechanism.system, mechanism.state, t1=2.0, rtol=1e-8, throw=False, max_steps=2000)
    assert run.result != mb.RESULTS.successful
    assert np.all(np.isfinite(run.ys.q)) and np.all(np.isfinite(run.ys.u))
