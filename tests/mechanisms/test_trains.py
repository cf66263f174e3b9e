"""Trains: draft gears, chains of vehicles of any length, and the cost of them."""

import dataclasses
import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import trains as oracle

import jaxmb as mb
from jaxmb import planar
from jaxmb.bodies.joint_graph import joint_order
from jaxmb.formulations import Multipliers, Poincare, accelerations
from jaxmb.manifold import Partition, Projection
from jaxmb.mechanisms.train import coupler_forces

# A draft gear that is a linear spring.
LINEAR = functools.partial(planar.DraftGear, stiffness=2e7, unloading=1.0, preload=0.0, slack=0.0, travel=10.0)
BARE = {"suspension": 0.0, "resistance": 0.0, "brake": 0.0, "speed": 0.0, "coupler_height": 0.0}


def gear(**numbers):
    return planar.DraftGear("gear", "a", "b", free_length=1.0, **numbers)


# The draft gear

GEARS = {
    "default": ({}, {}),
    "without preload": (
        {"stiffness": 1e7, "unloading": 0.4, "slack": 0.02, "preload": 0.0},
        {"S0": 0.0, "k": 1e7, "eta": 0.4, "slack": 0.02},
    ),
    "damped": ({"slack": 0.0, "unloading": 1.0, "damping": 1e4}, {"slack": 0.0, "eta": 1.0, "c": 1e4}),
    "sharp": ({"smoothing": 1e-6, "slack": 1e-9}, {"width": 1e-6, "slack": 1e-9}),
}


def test_draft_gear_is_that_of_an_independent_model():
    s, rate = np.meshgrid(np.linspace(-0.16, 0.16, 641), [-20.0, -0.01, -1e-5, 0.0, 1e-12, 0.003, 1.0])
    tension = jax.jit(lambda part, s, rate: part.tension(s, rate))
    for numbers, same in GEARS.values():
        expected = oracle.draft_gear(s, rate, **same)
        np.testing.assert_allclose(tension(gear(**numbers), s, rate), expected, rtol=1e-12, atol=1e-6)
    # Without slack and friction it is a spring.
    spring = LINEAR("c", "a", "b")
    np.testing.assert_allclose(tension(spring, s, rate), 2e7 * s, rtol=1e-13, atol=1e-8)


def test_draft_gear_takes_in_a_cycle_what_its_friction_does():
    """The area of a cycle; of the independent model, which is the same."""
    angle, stroke = np.linspace(0.0, 2 * np.pi, 20001), 0.08
    for preload in (0.0, 5e4):
        for sign in (1, -1):
            s = sign * (0.02 + 0.5 * stroke * (1 - np.cos(angle)))
            rate = sign * 0.5 * stroke * np.sin(angle)
            area = np.trapezoid(oracle.draft_gear(s, 1e2 * rate, S0=preload), s)
            assert area == pytest.approx((1 - 0.4) * (0.5 * 1e7 * stroke**2 + preload * stroke), rel=0.01)


def test_draft_gear_has_finite_derivatives_everywhere():
    extensions, rates = [0.0, 0.02, -0.02, 1e-300, 0.13, -1e3], [0.0, 1e-300, 1e-12, -1e3, 1e6]
    s, rate = (x.ravel() for x in np.meshgrid(extensions, rates))
    of_one = jax.grad(lambda part, s, v: part.tension(s, v), argnums=(0, 1, 2))
    out = jax.jit(jax.vmap(of_one, (None, 0, 0)))(gear(), s, rate)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(out))


# Trains with draft gears


@pytest.mark.slow
def test_train_has_the_frequencies_of_a_free_chain():
    n, k, m = 20, 2e7, 8e4
    system = mb.mechanisms.train(n=n, coupler=LINEAR, **BARE).system
    along = np.arange(0, 3 * n, 3)
    stiffness = -jax.jacfwd(lambda q: system.force(0.0, q, system.guess.u))(system.guess.q)[np.ix_(along, along)]
    found = np.sqrt(np.linalg.eigvalsh(stiffness / m)[1:])
    np.testing.assert_allclose(found, 2 * np.sqrt(k / m) * np.sin(np.arange(1, n) * np.pi / (2 * n)), rtol=1e-9)


@pytest.mark.slow
def test_train_takes_a_pull_at_its_head_as_a_wave():
    n, k, m, pull = 100, 2e7, 8e4, 3e5
    mechanism = mb.mechanisms.train(n=n, coupler=LINEAR, pull=pull, **BARE)
    times = np.arange(1, 601) * 0.01
    sol = mb.simulate(mechanism.system, mechanism.state, t1=6.0, rtol=1e-8, atol=1e-9, saveat=times)
    force = coupler_forces(sol)[:, 50]
    assert 50 / np.sqrt(k / m) == pytest.approx(3.162, abs=1e-3)
    assert np.interp(0.5 * pull, force[times < 3.5], times[times < 3.5]) == pytest.approx(3.273, abs=2e-3)
    assert np.mean(force[(times > 5) & (times < 6)]) == pytest.approx(3.003e5, rel=0.01)
    np.testing.assert_allclose(sol.linear_momentum[:, 0], pull * times, rtol=1e-12)


def test_longitudinal_train_has_the_accelerations_of_its_vehicles():
    """Of each by the pull at the head, its own coupler and that before; the coordinates are differences of places."""
    rng = np.random.default_rng(0)
    n, mass = 5, 8e4 * (1 + 0.3 * rng.random(5))
    system = mb.mechanisms.longitudinal_train(n=n, mass=mass, pull=1e5, resistance=(0, 0, 0), brake=0.0).system
    y, w = 0.05 * rng.normal(size=n), 0.2 * rng.normal(size=n)

    @jax.jit
    def evaluate(q, u):
        inertia = system.inertia(0.0, q, u)
        udot, _ = accelerations(system, Multipliers(), 1.0, q, u)
        return udot, system.tensions(mb.State(q, u)), inertia.product(udot) - system.force(1.0, q, u)

    udot, tensions, unmet = evaluate(y, w)
    S = oracle.draft_gear(y[1:], w[1:])
    np.testing.assert_allclose(tensions, S, rtol=1e-12, atol=1e-6)
    pulls = np.append(-S, 0.0) + np.insert(S, 0, 1e5)
    absolute = pulls / mass
    expected = np.append(absolute[0], absolute[:-1] - absolute[1:])
    np.testing.assert_allclose(udot, expected, rtol=0, atol=1e-12 * np.max(np.abs(expected)))
    np.testing.assert_allclose(unmet, 0.0, atol=1e-12 * np.max(np.abs(pulls)) * n)


@pytest.mark.slow
def test_longitudinal_train_moves_as_a_train_that_stays_straight():
    rng = np.random.default_rng(0)
    n, mass = 5, 8e4 * (1 + 0.3 * rng.random(5))
    relative = mb.mechanisms.longitudinal_train(n=n, mass=mass, pull=1e5, grade=0.01).system
    plane = mb.mechanisms.train(n=n, mass=mass, pull=1e5, grade=0.01, coupler_height=0.0).system
    y, w = 0.05 * rng.normal(size=n), 0.2 * rng.normal(size=n)
    absolute = lambda first, rest: np.cumsum(np.concatenate([[first], -rest]))
    x, v = absolute(y[0], y[1:] + 13.0), absolute(w[0], w[1:])
    still = lambda values: jnp.asarray(np.stack([values, 0 * values, 0 * values], axis=1).ravel())
    found, _ = accelerations(relative, Multipliers(), 1.0, jnp.asarray(y), jnp.asarray(w))
    expected, _ = accelerations(plane, Multipliers(), 1.0, still(x), still(v))
    np.testing.assert_allclose(absolute(found[0], np.asarray(found[1:])), expected[::3], rtol=0, atol=1e-11)


@pytest.mark.slow
def test_train_collides_slowly_and_fast():
    """Vehicles that meet at a nanometre or a hundred metres a second, their slack open, shut or in between."""
    system = mb.mechanisms.longitudinal_train(n=4, brake=0.0, resistance=(0, 0, 0)).system
    run = jax.jit(lambda state: mb.simulate(system, state, t1=1.0, rtol=1e-9, throw=False))
    for speed in (0.0, 1e-9, 100.0):
        for y in ((0.0, 0.0, 0.0), (-0.02, 0.0225, -0.0225)):
            state = mb.State(jnp.array([0.0, *y]), speed * jnp.array([0.0, 0.0, -1.0, 0.0]))
            sol = run(state)
            assert sol.result == mb.RESULTS.successful
            energy = lambda y: system.kinetic_energy(0.0, y.q, y.u) + system.potential_energy(0.0, y.q)
            end = jax.tree.map(lambda x: x[-1], sol.ys)
            assert energy(end) <= energy(state) + 1e-6 * (1e-3 + system.kinetic_energy(0.0, state.q, state.u))
            np.testing.assert_allclose(np.sum(np.cumsum([end.u[0], *-end.u[1:]])), 2 * speed, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_draft_gear_derivatives_of_the_largest_force_in_a_collision():
    """Of two vehicles that run into two at rest, by numbers of the first draft gear."""
    mechanism = mb.mechanisms.longitudinal_train(
        n=4, speed=(0.0, 0.0, 3.0, 3.0), extension=(0.01, -0.02, 0.02), brake=0.0, resistance=(0, 0, 0)
    )
    names = ("stiffness", "unloading", "preload", "slack", "stop_stiffness", "travel", "transition_speed")
    numbers = {f"coupler2.{name}": mb.parameters(mechanism.system)[f"coupler2.{name}"] for name in names}
    times = jnp.linspace(0.0, 0.3, 61)

    def peak(numbers, rtol):
        system = mb.with_parameters(mechanism.system, numbers)
        sol = mb.simulate(system, mechanism.state, t1=0.3, rtol=rtol, saveat=times, throw=False)
        tensions = jax.vmap(system.tensions)(sol.ys)[:, 1]
        # Not `jnp.min`: XLA may compute a number twice, rounded differently, and its derivative divides by the count
        # of numbers equal to the smallest.
        return -tensions[jnp.argmin(tensions)]

    derivatives = jax.jit(jax.jacfwd(lambda numbers, rtol: (peak(numbers, rtol),) * 2, has_aux=True))
    (forward, _), (exact, _) = derivatives(numbers, 1e-10), derivatives(numbers, 1e-12)
    # Where a step crosses the kink of a draft gear depends on rounding, and so on the program: both agree as far as
    # the tolerance lets them.
    value, reverse = jax.jit(jax.value_and_grad(peak))(numbers, 1e-12)
    assert 1e5 < value < 1e7
    for name, number in numbers.items():
        h = 1e-5 * number
        at = lambda x, name=name: derivatives(numbers | {name: x}, 1e-12)[1]
        central = lambda h, at=at, number=number: (at(number + h) - at(number - h)) / (2 * h)
        # Richardson's extrapolation: the stop bends the force over a millimetre.
        difference = (4 * central(h) - central(2 * h)) / 3
        np.testing.assert_allclose(exact[name], reverse[name], rtol=1e-9, atol=1e-9 * value / number, err_msg=name)
        np.testing.assert_allclose(forward[name], difference, rtol=1e-5, atol=5e-6 * value / number, err_msg=name)


# Trains with hinges and drawbars


@functools.cache
def hinged(n, **numbers):
    mass = 8e4 * (1 + 0.3 * np.random.default_rng(n).random(n))
    return mb.mechanisms.train(n=n, coupler=planar.Revolute, mass=mass, inertia=16 * mass, **numbers)


def by_blocks(system):
    """The system with its joints in an order of elimination, also where a dense matrix is faster."""
    return dataclasses.replace(system, elimination=joint_order(system))


def random_state(system, rng, pitch=0.2):
    q = np.asarray(system.guess.q) + np.tile([0.0, 0.0, 1.0], system.nq // 3) * pitch * rng.normal(size=system.nq)
    return jnp.asarray(q), jnp.asarray(rng.normal(size=system.nu))


@pytest.mark.slow
@pytest.mark.parametrize("n", [2, 50])
def test_train_on_hinges_has_the_forces_of_one_matrix_of_all(n):
    system = by_blocks(hinged(n).system)
    solve = jax.jit(lambda q, u: (accelerations(system, Multipliers(), 0.1, q, u), system.force(0.1, q, u)))
    rng = np.random.default_rng(n)
    for _ in range(3):
        q, u = random_state(system, rng)
        (udot, multipliers), force = solve(q, u)
        arrays = (np.asarray(x).reshape(n, 3) for x in (q, u, force))
        inertias = (np.asarray(system.mass), np.asarray(system.moments_of_inertia))
        expected, forces = oracle.hinged_accelerations(*arrays, *inertias)
        np.testing.assert_allclose(udot.reshape(n, 3), expected, rtol=0, atol=1e-12 * np.max(np.abs(expected)))
        np.testing.assert_allclose(-multipliers.reshape(-1, 2), forces, rtol=0, atol=1e-12 * np.max(np.abs(forces)))


def undamped(coupler):
    return mb.mechanisms.train(n=6, coupler=coupler, suspension_damping=0.0, resistance=0.0, brake=0.0, speed=1.0)


@pytest.mark.slow
@pytest.mark.parametrize(("coupler", "manifold"), [(LINEAR, None), (planar.Revolute, Projection())])
def test_train_keeps_its_energy_and_hinges_closed(coupler, manifold):
    system = undamped(coupler).system
    rng = np.random.default_rng(1)
    push = mb.State(system.guess.q, system.guess.u + jnp.asarray(rng.normal(size=18) * np.tile([0.3, 0.3, 0.02], 6)))
    state = mb.assemble(system, push)
    sol = mb.simulate(system, state, t1=10.0, rtol=1e-11, manifold=manifold, saveat=diffrax.SaveAt(t0=True, t1=True))
    change = sol.energy - sol.energy[0]
    assert np.max(np.abs(change)) <= 1e-9 * sol.kinetic_energy[0]
    if manifold is not None:
        assert np.max(np.abs(jax.vmap(lambda y: system.position_residual(0.0, y.q))(sol.ys))) <= 1e-13
        assert np.max(np.abs(jax.vmap(lambda y: system.velocity_residual(0.0, y.q, y.u))(sol.ys))) <= 1e-13


@pytest.mark.slow
def test_rod_chain_of_many_needs_no_choice():
    """The same motion by both solvers' defaults, by blocks."""
    long_chain = mb.mechanisms.get("rod_chain", n=16)
    assert "sparse elimination" in str(long_chain.system)
    ends = []
    for solver in (None, diffrax.Tsit5()):
        sol = mb.simulate(long_chain.system, long_chain.state, t1=0.1, rtol=1e-9, solver=solver)
        assert isinstance(sol.formulation, Multipliers)
        assert np.all(sol.constraint_violation.position <= 1e-13)
        ends.append(sol.ys)
    np.testing.assert_allclose(ends[0].q, ends[1].q, rtol=0, atol=1e-8)
    np.testing.assert_allclose(ends[0].u, ends[1].u, rtol=0, atol=1e-6)


def ring(*more, bodies=4):
    """Bodies on a line with pins between neighbours, and more joints."""
    line = [planar.Body(f"b{k}", mass=1.0, inertia=0.1, position=(k, 0.0)) for k in range(bodies)]
    pins = [planar.Revolute(f"pin{k}", f"b{k}", f"b{k + 1}", point=(k + 0.5, 0.0)) for k in range(bodies - 1)]
    return mb.Scene(line, joints=[*pins, *more]).compile()


def redundant():
    body = planar.Body("body", mass=1.0, inertia=0.1)
    pins = [planar.Revolute(name, "ground", "body", point=(x, 0.0)) for name, x in (("left", -1.0), ("right", 1.0))]
    return mb.Scene([body], joints=pins).compile()


def pendulum_on_paper():
    kinetic = lambda t, q, v, p: 0.5 * jnp.sum(v**2)
    rod = mb.lagrangian.Holonomic("rod", lambda t, q, p: q @ q - 1.0)
    return mb.lagrangian.LagrangianSystem(kinetic=kinetic, constraints=[rod], q=(1.0, 0.0))


def turning_pendulum():
    """In velocities along axes that turn and move, with a mass matrix that depends on the position."""
    kinetic = lambda t, q, v, p: 0.5 * jnp.sum(v**2) + 0.5 * q[0] ** 2 * v[1] ** 2
    rod = mb.lagrangian.Holonomic("rod", lambda t, q, p: q @ q - 1.0)
    axes = lambda t, q, p: jnp.array([[jnp.cos(q[1]), -jnp.sin(q[1])], [jnp.sin(q[1]), jnp.cos(q[1])]])
    kinematics = mb.lagrangian.QuasiVelocityFrame(axes, 2, lambda t, q, p: jnp.array([0.1, 0.2]) * jnp.cos(t))
    return mb.lagrangian.LagrangianSystem(
        kinetic=kinetic, constraints=[rod], kinematics=kinematics, q=(1.0, 0.0), u=(0.0, 0.3)
    )


def dry_friction():
    body = planar.Body("body", mass=1.0, inertia=0.1)
    pin = planar.Revolute("pin", "ground", "body", point=(1.0, 0.0))
    return mb.Scene([body], joints=[pin], forces=[planar.Friction("rub", "pin", coefficient=0.3, radius=0.1)]).compile()


def check_refused(*cases):
    for build, options, message in cases:
        system = build()
        with pytest.raises(ValueError, match=message):
            mb.simulate(system, system.guess, t1=1.0, **({"manifold": Projection()} | options))


def test_projection_with_adams_refuses_redundant_joints_and_other_formulations():
    check_refused(
        (redundant, {}, r"only 3 are independent.*Partition\(\)"),
        (ring, {"formulation": Poincare()}, r"Projection with Adams finds accelerations by Multipliers\(\)"),
    )


@pytest.mark.slow
def test_projection_refuses_systems_that_are_no_ideal_scenes():
    hermite = {"solver": mb.solvers.Hermite()}
    check_refused(
        (pendulum_on_paper, hermite, r"Projection with Hermite needs a scene.*Partition\(\)"),
        (dry_friction, hermite, "Projection with Hermite takes constraints that are ideal"),
        (lambda: mb.mechanisms.get("appell_hamel").system, {}, "linear in velocities"),
        (lambda: mb.mechanisms.get("spherical_four_bar").system, {}, "inverse of the mass matrix"),
    )


LOOP = planar.Distance("back", "b3", "b0", point_a=(0.2, 0.3))


@pytest.mark.slow
@pytest.mark.parametrize("build", [lambda: ring(LOOP), turning_pendulum, dry_friction])
def test_projection_of_other_joint_graphs_has_a_dense_matrix(build):
    """Loops and systems without joints: the same motion as by partitioning, with its derivatives."""
    system = build()
    assert system.elimination is None
    rng = np.random.default_rng(0)
    push = mb.State(system.guess.q, system.guess.u + jnp.asarray(rng.normal(size=system.nu)))
    state = mb.assemble(system, push)

    def end(u, manifold):
        start = mb.manifold.project(system, 0.0, mb.State(state.q, state.u * u))
        y = mb.simulate(system, start, t1=0.3, rtol=1e-10, manifold=manifold).ys
        return jnp.concatenate([y.q[0], y.u[0]])

    forward = lambda manifold: jax.jit(lambda u: jax.jvp(lambda u: end(u, manifold), (u,), (1.0,)))
    expected, dexpected = forward(Partition())(1.0)
    found, dfound = forward(Projection())(1.0)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7)
    np.testing.assert_allclose(dfound, dexpected, rtol=0, atol=1e-6)
    weights = jnp.asarray(rng.normal(size=found.size))
    reverse = jax.jit(jax.grad(lambda u: weights @ end(u, Projection())))(1.0)
    np.testing.assert_allclose(reverse, weights @ dfound, rtol=1e-9)


# Cost


def largest(jaxpr):
    """The size of the largest array of a program, inner ones included."""
    sizes = [int(np.prod(v.aval.shape)) for e in jaxpr.eqns for v in e.outvars]
    for equation in jaxpr.eqns:
        for value in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda x: hasattr(x, "eqns")):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                sizes.append(largest(inner))
    return max(sizes, default=0)


@pytest.mark.slow
@pytest.mark.parametrize("coupler", [planar.DraftGear, planar.Revolute, planar.Distance])
def test_train_of_many_has_no_longer_program_and_little_memory(coupler):
    """As many instructions for any number of vehicles, and no array that grows faster than it."""

    def measure(n):
        mechanism = mb.mechanisms.train(n=n, coupler=coupler)
        right_hand_side = lambda system, q, u: accelerations(system, Multipliers(), 0.1, q, u)[0]
        arguments = mechanism.system, mechanism.state.q, mechanism.state.u
        lines = jax.jit(right_hand_side).lower(*arguments).as_text().count("\n")
        return lines, largest(jax.make_jaxpr(right_hand_side)(*arguments).jaxpr)

    (few, small), (many, large) = measure(40), measure(160)
    assert few == many
    assert large <= 4.2 * small
