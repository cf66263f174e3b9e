"""Coulomb friction in joints: the normal force is that of the joint with friction, or there is none."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxmb as mb
from jaxmb import formulations, lagrangian, planar
from jaxmb.formulations import accelerations
from jaxmb.formulations.friction import contracts, find_multipliers
from jaxmb.parts import smooth

G, M, A, V = 9.81, 1.2, 0.5, 1e-3
J = M * A**2 / 3
GRAVITY = mb.Gravity((0.0, -G))


# A uniform rod of length 2A whose lower end slides on a floor. In its own coordinates, place of the end and angle:
#   N/M − G = A cos θ θ̈ − A sin θ θ̇²,  J θ̈ = A (sin θ F − cos θ N),  M (s̈ − A sin θ θ̈ − A cos θ θ̇²) = F.


def coupling(mu, angle):
    """Change of N by the friction of N: with 1 or more the friction has none or two (Painlevé)."""
    return 3 * mu * np.sin(angle) * np.cos(angle) / (1 + 3 * np.cos(angle) ** 2)


def rod_forces(mu, angle, speed, rate):
    """N and F of the rod, from its own two equations, for a normal force of either sign."""
    s, c = np.sin(angle), np.cos(angle)
    free = (G - A * s * rate**2) / (1 / M + A**2 * c**2 / J)
    share = coupling(mu, angle) * np.tanh(speed / V)
    normal = free / (1 + np.sign(free) * share)
    return normal, -mu * np.tanh(speed / V) * abs(normal)


def rod_rates(mu, y):
    angle, speed, rate = y[1:]
    normal, force = rod_forces(mu, angle, speed, rate)
    turn = A * (np.sin(angle) * force - np.cos(angle) * normal) / J
    return np.array([speed, rate, force / M + A * np.sin(angle) * turn + A * np.cos(angle) * rate**2, turn])


def to_rod(q, u):
    """Place of the lower end, angle, and their rates, from those of the rod's centre."""
    q, u = np.asarray(q), np.asarray(u)
    place = q[..., 0] - A * np.cos(q[..., 2]), u[..., 0] + A * np.sin(q[..., 2]) * u[..., 2]
    return np.stack([place[0], q[..., 2], place[1], u[..., 2]], axis=-1)


def rod_state(angle, speed, rate):
    s, c = np.sin(angle), np.cos(angle)
    q = np.array([A * c, A * s, angle])
    return mb.State(q, np.array([speed - A * s * rate, A * c * rate, rate]))


def rod_scene(mu):
    body = planar.Body("rod", mass=M, inertia=J, position=(A, 0.0))
    floor = planar.PointOnLine("floor", "ground", "rod", point_a=(0.0, 0.0), point_b=(-A, 0.0), axis_a=(1.0, 0.0))
    rub = planar.Friction("rub", "floor", coefficient=mu, transition_speed=V)
    return mb.Scene([body], joints=[floor], forces=[GRAVITY, rub]).compile()


def rod_lagrangian(mu):
    slip = lambda t, q, v, p: v[0] + A * jnp.sin(q[2]) * v[2]
    return lagrangian.LagrangianSystem(
        kinetic=lambda t, q, v, p: 0.5 * (p["mass"] * (v[0] ** 2 + v[1] ** 2) + p["mass"] * A**2 / 3 * v[2] ** 2),
        potential=lambda t, q, p: p["mass"] * G * q[1],
        constraints=[lagrangian.Holonomic("floor", lambda t, q, p: q[1] - A * jnp.sin(q[2]))],
        nonideal=[
            lagrangian.CoulombFriction(
                "floor", "mu", slip=slip, normal=lambda t, q, multipliers, p: multipliers[0], transition_speed=V
            )
        ],
        q=(A, 0.0, 0.0),
        parameters={"mu": mu, "mass": M},
    )


@functools.cache
def rod(law="Friction", mu=0.3):
    return rod_lagrangian(mu) if law == "Lagrangian" else rod_scene(mu)


STATES = [(1.0, 2.0, 0.3), (0.7, -1.5, 8.0), (2.0, 1e-4, -1.0), (1.4, -3.0, -6.5), (0.6, 0.0, 7.0)]


@pytest.mark.slow(but=("Lagrangian",))
@pytest.mark.parametrize("law", ["Friction", "Lagrangian"])
def test_friction_is_the_coefficient_times_the_normal_force(law):
    """Of a rod on a floor, pressed on it and held down to it, by every formulation."""
    system = rod(law)
    roads = [formulations.Partitioned(), formulations.Multipliers(), formulations.NullSpace(), formulations.Poincare()]
    roads = roads[:1] if law == "Lagrangian" else roads
    every = jax.jit(lambda q, u: [accelerations(system, road, 0.0, q, u) for road in roads])
    signs = set()
    for numbers in STATES:
        y = rod_state(*numbers)
        normal, force = rod_forces(0.3, *numbers)
        signs.add(np.sign(normal))
        turn = A * (np.sin(numbers[0]) * force - np.cos(numbers[0]) * normal) / J
        for udot, multipliers in every(y.q, y.u):
            np.testing.assert_allclose(multipliers, [normal], rtol=1e-12)
            np.testing.assert_allclose(M * udot[:2], [force, normal - M * G], rtol=1e-11, atol=1e-11 * M * G)
            np.testing.assert_allclose(udot[2], turn, rtol=1e-11)
    assert signs == {-1.0, 1.0}


@pytest.mark.slow
def test_a_sliding_rod():
    """Its motion, with a slip that turns round, against an integration in its own coordinates."""
    times = np.linspace(0.0, 0.5, 6)
    system, start = rod(), rod_state(1.2, 0.5, 0.0)
    run = mb.simulate(system, start, t1=0.5, rtol=1e-10, saveat=times, dt0=1e-3)
    y0 = to_rod(start.q, start.u)
    expected = solve_ivp(
        lambda t, y: rod_rates(0.3, y), (0.0, 0.5), y0, "LSODA", t_eval=times, rtol=1e-12, atol=1e-13, max_step=1e-3
    )
    assert expected.y[2].min() < 0 < y0[2]
    np.testing.assert_allclose(to_rod(run.ys.q, run.ys.u), expected.y.T, rtol=1e-7, atol=1e-7)
    normal = [rod_forces(0.3, *y[1:])[0] for y in expected.y.T]
    np.testing.assert_allclose(run.reactions["floor"].force[:, 1], normal, rtol=1e-6)


# Painlevé's paradox: the rod's friction has no or two solutions where the coupling is above 1.

STEEP, SLIDING = 1.5, -3.0


SOLVERS = {
    "Adams": {},
    "Tsit5": {"solver": diffrax.Tsit5(), "max_steps": 500, "rtol": 1e-6},
    "Hermite": {"solver": mb.solvers.Hermite()},
}


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS)
def test_motion_ends_where_friction_is_no_longer_unique(solver):
    """A rod that is held down to the floor, and swings up to the angle of coupling 1; the error names the joint."""
    system, start = rod(mu=STEEP), rod_state(0.5, SLIDING, 6.0)
    options = {"t1": 1.0, "saveat": diffrax.SaveAt(steps=True), "throw": False} | SOLVERS[solver]
    run = mb.simulate(system, start, **options)
    assert run.result == mb.RESULTS.friction_undetermined
    assert run.ts.size > 10 and np.all(np.isfinite(run.ys.q))
    np.testing.assert_allclose(coupling(STEEP, run["rod"].angle[-1]), 1.0, rtol=1e-6)
    assert run.reactions["floor"].force[-1, 1] < 0
    if solver == "Adams":
        with pytest.raises(RuntimeError, match=r"friction of 'floor' came to a singular configuration.*Painlevé"):
            mb.simulate(system, start, t1=1.0)
        # From a state without a solution as well.
        assert coupling(STEEP, 1.1) > 1
        with pytest.raises(RuntimeError, match="'floor'"):
            mb.simulate(system, rod_state(1.1, 2.0, 0.3), t1=1.0)


@pytest.mark.slow
def test_no_solution_is_nan():
    """Just beyond a coupling of 1, in one member of a batch only."""
    critical = 1 / coupling(1.0, 1.1)
    systems = [rod(mu=critical * (1 + share)) for share in (-1e-6, 1e-6)]
    numbers = [(1.1, 2.0, 0.3), (1.1, -2.0, 0.3), (1.1, 2.0, 7.0), (1.1, -2.0, 7.0), (1.1, 1e-4, 0.3)]
    states = [rod_state(*own) for own in numbers]
    batch = jax.tree.map(lambda *x: np.stack(x), *states)
    one = lambda system, y: jnp.concatenate(accelerations(system, formulations.Multipliers(), 0.0, y.q, y.u))
    solve = jax.jit(jax.vmap(one, in_axes=(None, 0)))
    # A floor that presses has none then, one that holds two; near rest there is less friction, and one solution.
    np.testing.assert_array_equal(np.isfinite(solve(systems[0], batch)), np.ones((5, 4), bool))
    finite = np.repeat([[False], [False], [False], [False], [True]], 4, axis=1)
    np.testing.assert_array_equal(np.isfinite(solve(systems[1], batch)), finite)


def test_multipliers_of_laws_that_couple_at_random():
    """Solved wherever their coupling contracts, and refused elsewhere."""
    rng, k = np.random.default_rng(0), 3
    slopes, starts = rng.normal(size=(40, k, k)), rng.normal(size=(40, k))
    radii = np.max(np.abs(np.linalg.eigvals(np.abs(slopes))), axis=1)
    sizes = np.tile([0.4, 0.99, 1.01, 3.0], 10) / radii
    slopes = slopes * sizes[:, None, None]

    @jax.jit
    def run(slopes, starts, matrices):
        solve = lambda slope, start: find_multipliers(jnp.abs, slope, start, np.zeros(k, bool))
        return jax.vmap(solve)(slopes, starts), jax.vmap(contracts)(matrices)

    matrices = np.array([[[0.0, 0.5], [1.9, 0.0]], [[0.0, 0.5], [2.1, 0.0]]])
    (x, _, failed), known = jax.device_get(run(slopes, starts, matrices))
    np.testing.assert_array_equal(failed, sizes * radii > 1)
    left = x - starts - np.einsum("bij,bj->bi", slopes, np.abs(x))
    np.testing.assert_allclose(left[~failed], 0.0, atol=1e-12)
    np.testing.assert_array_equal(x[failed], starts[failed])
    assert known.tolist() == [True, False]


def test_a_foot_without_load_whose_friction_cancels():
    """Of a box that turns in place, two feet across bear it: their frictions cancel, and those of the third are
    rounding errors. Its load is found, at any slow drift.
    """
    rng = np.random.default_rng(0)
    # Loads of 9.81 N, and their changes by a force in the plane and its moments.
    start = jnp.array([9.81, 1e-16, 9.81])
    influence = jnp.array([[-0.5, 0.1, 1.7], [0.1, -2.5, -1.7], [-0.5, 2.5, 0.1]])

    def find(drift):
        across = jnp.array([[-0.2, 0.3], [0.2, 0.3], [0.2, -0.3]]) + drift[None]
        friction = 0.3 * across / jnp.linalg.norm(across, axis=1, keepdims=True)
        wrenches = jnp.concatenate([friction, -0.1 * friction[:, :1]], axis=1)
        return find_multipliers(lambda x: x @ wrenches, influence, start, np.ones(3, bool))

    x, _, failed = jax.vmap(find)(jnp.asarray(1e-14 * rng.normal(size=(200, 2))))
    assert not np.any(failed)
    np.testing.assert_allclose(x, np.broadcast_to(start, x.shape), atol=1e-12)


# Other joints


@pytest.mark.slow
def test_a_pin_rubs_in_proportion_to_its_whole_reaction():
    """`J θ̈ = −m g l cos θ − μ r |R|`, where the reaction R has the inertia of the motion that friction leaves."""
    mass, inertia, length, mu, radius = 1.5, 0.1, 0.5, 0.4, 0.2
    arm = planar.Body("arm", mass=mass, inertia=inertia, position=(length, 0.0))
    pin = planar.Revolute("pin", "ground", "arm", point=(0.0, 0.0))
    rub = planar.Friction("rub", "pin", coefficient=mu, radius=radius)
    system = mb.Scene([arm], joints=[pin], forces=[GRAVITY, rub]).compile()
    whole = inertia + mass * length**2
    solve = jax.jit(lambda q, u: accelerations(system, formulations.Partitioned(), 0.0, q, u))
    for angle, rate in [(0.3, 2.0), (-1.2, 5.0), (2.5, -3.0), (1.0, -0.1)]:
        s, c = np.sin(angle), np.cos(angle)

        def pull(turn, s=s, c=c, rate=rate):
            return mass * np.hypot(length * turn + G * c, length * rate**2 - G * s)

        def balance(turn, c=c, rate=rate):
            return whole * turn + mass * G * length * c + mu * radius * pull(turn) * np.sign(rate)

        turn = brentq(balance, -500.0, 500.0, xtol=1e-13, rtol=1e-14)
        q = jnp.array([length * c, length * s, angle])
        udot, multipliers = solve(q, rate * jnp.array([-length * s, length * c, 1.0]))
        np.testing.assert_allclose(udot[2], turn, rtol=1e-10)
        np.testing.assert_allclose(np.linalg.norm(multipliers), pull(turn), rtol=1e-10)


@pytest.mark.slow
def test_a_ladder_rubs_on_floor_and_wall():
    """Both reactions depend on both frictions: three equations with three unknowns, in the ladder's angle."""
    mu_f, mu_w, angle, rate = 0.3, 0.5, 1.0, -0.8
    s, c = np.sin(angle), np.cos(angle)
    ladder = planar.Body("ladder", mass=M, inertia=J, position=(A * c, A * s), angle=np.pi - angle)
    joints = [
        planar.PointOnLine("floor", "ground", "ladder", point_a=(0.0, 0.0), point_b=(-A, 0.0), axis_a=(1.0, 0.0)),
        planar.PointOnLine("wall", "ground", "ladder", point_a=(0.0, 0.0), point_b=(A, 0.0), axis_a=(0.0, 1.0)),
    ]
    rubs = [
        planar.Friction("below", "floor", coefficient=mu_f),
        planar.Friction("above", "wall", coefficient=mu_w),
    ]
    system = mb.Scene([ladder], joints=joints, forces=[GRAVITY, *rubs]).compile()
    q = jnp.array([A * c, A * s, np.pi - angle])
    udot, multipliers = accelerations(
        system, formulations.Multipliers(), 0.0, q, rate * jnp.array([-A * s, A * c, -1.0])
    )
    # It slides down: the floor's friction is along −x, the wall's along +y. Unknown: floor, wall, acceleration.
    equations = np.array(
        [
            [-mu_f, 1.0, M * A * s],
            [1.0, mu_w, -M * A * c],
            # About the centre, against the ladder's rise: the floor's end is at (A c, −A s), the wall's at (−A c, A s).
            [-A * c + A * s * mu_f, A * s + A * c * mu_w, -J],
        ]
    )
    right = np.array([-M * A * c * rate**2, M * G - M * A * s * rate**2, 0.0])
    floor, wall, turn = np.linalg.solve(equations, right)
    assert floor > 0 and wall > 0
    np.testing.assert_allclose(-udot[2], turn, rtol=1e-12)
    np.testing.assert_allclose(np.abs(multipliers), [floor, wall], rtol=1e-12)


# Derivatives


@pytest.mark.slow
def test_derivatives_of_accelerations():
    """Of the implicit equation, to second order: forward, reverse and differences."""
    system, y = rod(), rod_state(0.7, -1.5, 8.0)
    names = ["rub.coefficient", "rod.mass", "rod.inertia"]
    start = np.array([float(mb.parameters(system)[name]) for name in names])

    def turn(x):
        changed = mb.with_parameters(system, dict(zip(names, x, strict=True)))
        return accelerations(changed, formulations.Partitioned(), 0.0, y.q, y.u)[0][2]

    run = jax.jit(jax.vmap(lambda x: (turn(x), jax.grad(turn)(x), jax.jacfwd(turn)(x), jax.hessian(turn)(x))))
    h = 1e-3 * start
    places = [start + k * step for k in (1, -1, 2, -2) for step in np.diag(h)]
    values, reverse, forward, second = map(np.asarray, run(np.stack([start, *places])))
    four = lambda f: (8 * (f[1:4] - f[4:7]) - (f[7:10] - f[10:13])) / 12
    np.testing.assert_allclose(reverse[0], forward[0], rtol=1e-11)
    np.testing.assert_allclose(forward[0], four(values) / h, rtol=1e-8)
    np.testing.assert_allclose(second[0], four(reverse) / h[:, None], rtol=1e-7, atol=1e-8)


# The regularisation


def test_regularised_friction():
    v = np.array([0.3, -0.4])

    @jax.jit
    def run(sizes):
        # The series near rest joins the formula.
        near = jax.vmap(lambda size: smooth.dry_friction(1.0, size * v / 0.5, 1.0))(sizes)
        slope = jax.jacfwd(lambda v: smooth.dry_friction(2.0, v, 0.2))(jnp.zeros(2))
        return smooth.dry_friction(2.0, v, 0.2), near, slope, smooth.sign(jnp.array([-5.0, 0.0, 5.0]), 0.1)

    force, near, slope, signs = run(np.array([0.0316, 0.0317]))
    np.testing.assert_allclose(force, -2.0 * v / 0.5 * np.tanh(2.5), rtol=1e-15)
    np.testing.assert_allclose(near, -np.outer(np.tanh([0.0316, 0.0317]), v / 0.5), rtol=1e-13)
    np.testing.assert_allclose(slope, -10.0 * np.eye(2))
    np.testing.assert_array_equal(signs, [-1.0, 0.0, 1.0])
