"""One motion from every way to write its equations: frames, connections, constraints, quasi-velocities."""

import functools

import diffrax
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
    Holonomic,
    LagrangianSystem,
    Nonholonomic,
    QuasiVelocities,
    QuasiVelocityFrame,
    Voronets,
)
from jaxmb.linalg import rotations

pytestmark = pytest.mark.slow

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


def columns_of_the_snake(t, q, p):
    system = library("three_platform_snake").system
    return jax.jacfwd(system.kinematics.rates, 2)(t, q, jnp.zeros(2), p)


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


def test_the_snake_in_a_frame_as_well():
    """Hamel-Voronets: the base's frame, moved along by the connection."""
    system = library("three_platform_snake").system
    frame = LagrangianSystem(
        system.lagrangian,
        kinematics=QuasiVelocityFrame(columns_of_the_snake, 2),
        equations=Hamel("suslov"),
        q=system.guess.q,
        parameters=system.parameters,
    )
    q, u = system.guess.q, jnp.array([0.7, -1.1])
    np.testing.assert_allclose(solved(frame, q, u)[0], solved(system, q, u)[0], rtol=0, atol=1e-12)


def test_constraining_the_lagrangian_first_is_another_motion():
    """Which it would be without the curvature's term, as it is where motions are varied within the constraints."""
    system = library("roller_racer", form="connection").system
    lift = lambda r: jnp.concatenate([jnp.zeros(2), r])
    reduced = LagrangianSystem(
        lambda t, r, w, p: system.lagrangian(t, lift(r), system.kinematics.rates(t, lift(r), w, p), p),
        q=STATE[0][2:],
        parameters=system.parameters,
    )
    w = jnp.array([0.5, 0.2])
    right, other = solved(system, STATE[0], w)[0], solved(reduced, STATE[0][2:], w)[0]
    assert np.max(np.abs(right - other)) > 1e-2


def test_a_drift_and_time_in_the_frame_and_in_the_connection():
    """A sleigh on a plane that turns and is carried along: rheonomic in every term."""
    kinetic = lambda t, q, v, p: 0.5 * (1.3 * v[0] ** 2 + 1.1 * v[1] ** 2 + (0.4 + 0.1 * jnp.sin(q[0] + t)) * v[2] ** 2)
    potential = lambda t, q, p: jnp.sin(q[0]) * q[1] + 0.3 * q[2] ** 2 * jnp.cos(t)
    A = lambda t, q, p: jnp.stack([-jnp.sin(q[2] + t), 0.2 * q[1] * jnp.ones_like(q[2])])[None]
    a = lambda t, q, p: jnp.stack([0.3 * jnp.cos(t) + 0.1 * q[0] * q[1]])
    common = {"kinetic": kinetic, "potential": potential, "q": (0.3, -0.2, 0.5)}
    slip = lambda t, q, v, p: v[1] + A(t, q, p)[0] @ v[jnp.array([0, 2])] + a(t, q, p)[0]
    connection = Connection((0, 2), (1,), A, a)
    projected = LagrangianSystem(**common, kinematics=connection, u=(0.7, -0.4))
    t, q, u = jnp.asarray(0.4), projected.guess.q, projected.guess.u
    expected = accelerations(projected, Partitioned(), t, q, u)[0]

    columns = lambda t, q, p: jax.jacfwd(lambda u: connection.rates(t, q, u, p))(jnp.zeros(2))
    drift = lambda t, q, p: connection.rates(t, q, jnp.zeros(2), p)
    frame = QuasiVelocityFrame(columns, 2, drift)
    for kinematics, equations in (
        (connection, Voronets()),
        (connection, Voronets("holder")),
        (frame, None),
        (frame, Hamel()),
        (frame, Hamel(0.37)),
    ):
        other = LagrangianSystem(**common, kinematics=kinematics, equations=equations)
        np.testing.assert_allclose(accelerations(other, Partitioned(), t, q, u)[0], expected, rtol=1e-12)
    constrained = LagrangianSystem(**common, constraints=[Nonholonomic("slip", slip)])
    v = projected.rates(t, q, u)
    found, _ = accelerations(constrained, Multipliers(), t, q, v)
    np.testing.assert_allclose(found[jnp.array([0, 2])], expected, rtol=1e-12)


def _body_axes(q):
    """Rates of Euler angles z, x, z with turning about the body's axes."""
    _, theta, psi = q
    s, c = jnp.sin(theta), jnp.cos(theta)
    zero = jnp.zeros_like(s)
    return jnp.stack(
        [
            jnp.stack([jnp.sin(psi) / s, jnp.cos(psi) / s, zero]),
            jnp.stack([jnp.cos(psi), -jnp.sin(psi), zero]),
            jnp.stack([-jnp.sin(psi) * c / s, -jnp.cos(psi) * c / s, zero + 1.0]),
        ]
    )


# A rigid body in Euler parameters: a mass matrix of rank three in four coordinates, or three quasi-velocities


def test_a_body_in_euler_parameters_and_in_angular_velocities():
    J = np.diag([1.0, 2.0, 3.0])
    omega_of = lambda p, v: rotations.angular_velocity(p, v)
    kinetic = lambda t, q, v, p: 0.5 * omega_of(q, v) @ p["inertia"] @ omega_of(q, v)
    columns = lambda t, q, p: jax.jacfwd(lambda w: rotations.rates(q, w))(jnp.zeros(3))
    q, w = jnp.array([0.8, 0.0, 0.6, 0.0]), jnp.array([0.3, -1.2, 0.7])
    expected = np.linalg.solve(J, -np.cross(w, J @ w))
    for equations in (None, Hamel()):
        body = LagrangianSystem(
            kinetic=kinetic,
            kinematics=QuasiVelocityFrame(columns, 3),
            equations=equations,
            q=q,
            parameters={"inertia": J},
        )
        np.testing.assert_allclose(solved(body, q, w)[0], expected, rtol=0, atol=1e-13)
    unit = Holonomic("unit", lambda t, q, p: q @ q - 1.0)
    whole = LagrangianSystem(kinetic=kinetic, constraints=[unit], q=q, parameters={"inertia": J})
    v = rotations.rates(q, w)
    a = solved(whole, q, v)[0]
    turned = jax.jvp(omega_of, (q, v), (v, a))[1]
    np.testing.assert_allclose(turned, expected, rtol=0, atol=1e-13)


# Nonlinear quasi-velocities


def johnsen_hamel_residual(system, t, q, u, udot):
    r"""Residuals of the Johnsen-Hamel equations at accelerations u̇, for all ω_k in order: zero for the independent ones
    of a motion, and Λ_k for the dependent ones, in the equations' own terms:

    $$\frac{d}{dt} \frac{\partial L^*}{\partial \omega_k} - \frac{\partial L^*}{\partial \theta_k}
      - p_l \left(\frac{d}{dt} \frac{\partial \dot q_l}{\partial \omega_k}
      - \frac{\partial \dot q_l}{\partial \theta_k} \right) - \Theta_k$$

    with $L^*(t, q, \omega) = L(t, q, \dot q)$ and
    $\partial / \partial \theta_k = (\partial \dot q_l / \partial \omega_k) \, \partial / \partial q_l$.
    """
    kinematics, at = system.kinematics, system.parameters_at
    omega, along = kinematics.all_of(q.size, u), kinematics.all_of(q.size, udot)
    rates = lambda t, q, omega: kinematics.rates_of_all(t, q, omega, at(t))
    star = lambda t, q, omega: system.lagrangian(t, q, rates(t, q, omega), at(t))
    v = rates(t, q, omega)
    moving = (t, q, omega), (jnp.ones_like(t), v, along)
    columns, turned = jax.jvp(jax.jacfwd(rates, 2), *moving)
    _, first = jax.jvp(jax.grad(star, 2), *moving)
    second = jax.grad(star, 1)(t, q, omega) @ columns
    bracket = turned - jax.jacfwd(rates, 1)(t, q, omega) @ columns
    return first - second - system.momentum(t, q, v) @ bracket - system.applied_force(t, q, v) @ columns


def test_johnsen_hamel_equations_of_random_quasi_velocities():
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

    @jax.jit
    def everything(system):
        udot = accelerations(system, Partitioned(), t, q, u)[0]
        v = system.rates(t, q, u)
        a = jax.jvp(system.rates, (t, q, u), (jnp.ones(()), v, udot))[1]
        return v, a, johnsen_hamel_residual(system, t, q, u, udot)

    v, a, left = everything(quasi)
    np.testing.assert_allclose(omega(t, q, v, {})[jnp.array(dependent)], 0.0, atol=1e-14)
    independent = np.delete(np.arange(n), dependent)
    np.testing.assert_allclose(left[independent], 0.0, atol=1e-12)
    # Chetaev's multipliers give the same motion, and are the forces that hold the dependent quasi-velocities at zero.
    rows = Nonholonomic("held", lambda t, q, v, p: omega(t, q, v, p)[jnp.array(dependent)])
    chetaev = LagrangianSystem(**common, constraints=[rows])
    found, multipliers = accelerations(chetaev, Multipliers(), t, q, v)
    np.testing.assert_allclose(a, found, rtol=0, atol=1e-12)
    np.testing.assert_allclose(left[jnp.array(dependent)], multipliers, rtol=1e-10)
    rate = jax.jvp(lambda t, q, v: omega(t, q, v, {}), (t, q, v), (jnp.ones(()), v, a))[1]
    np.testing.assert_allclose(rate[jnp.array(dependent)], 0.0, atol=1e-14)


def test_quasi_velocities_and_the_constraint_give_one_motion():
    references = library("constant_speed_particle").references
    quasi = library("constant_speed_particle", form="quasi")
    run = mb.simulate(quasi.system, quasi.state, t1=1.0, rtol=1e-12)
    speed = quasi.system.rates(1.0, run.ys.q[-1], run.ys.u[-1])
    np.testing.assert_allclose(np.hypot(*speed), 3.0, rtol=0, atol=1e-11)
    np.testing.assert_allclose(run.ys.q[-1], references.values[-1, :2], rtol=0, atol=1e-10)
    np.testing.assert_allclose(run.ys.u[-1, 0], -1.319751601680, rtol=0, atol=1e-10)


def test_quasi_velocities_of_a_traced_system():
    """The start of Newton's method is a function, which is not a value of the system."""
    quasi = library("constant_speed_particle", form="quasi")
    options = {"t1": 0.1, "solver": diffrax.Dopri8(), "manifold": mb.manifold.Projection(), "throw": False}

    @jax.jit
    def end(speed):
        return mb.simulate(mb.with_parameters(quasi.system, {"speed": speed}), quasi.state, **options).ys.q[-1]

    alone = mb.simulate(quasi.system, quasi.state, **options).ys.q[-1]
    np.testing.assert_allclose(end(3.0), alone, rtol=0, atol=1e-12)


# Singular states


def test_the_end_of_a_cone_is_a_result_and_not_a_number():
    """At rest the constraint has no gradient: there the motion ends."""
    mechanism = library("appell_hamel")
    run = mb.simulate(mechanism.system, mechanism.state, t1=2.0, rtol=1e-8, throw=False, max_steps=2000)
    assert run.result != mb.RESULTS.successful
    assert np.all(np.isfinite(run.ys.q)) and np.all(np.isfinite(run.ys.u))
