"""Starts whose Euler parameters are not of length one: only their direction has a meaning."""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxmb as mb
from jaxmb import rotations, spatial

INERTIA = (0.2, 0.35, 0.4)
RNG = np.random.default_rng(7)


@pytest.fixture(scope="module")
def free():
    return mb.Scene([spatial.Body("body", mass=1.5, inertia=INERTIA)]).compile()


@pytest.fixture(scope="module")
def arm():
    """A bar on a hinge with gravity, a point mass on a cord, and a tendon that counts turns."""
    bar = spatial.Body("bar", mass=1.0, inertia=(0.01, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    bob = spatial.PointMass("bob", mass=0.2, position=(1.0, 0.0, -0.6))
    pin = spatial.Revolute("pin", "ground", "bar", point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    cord = spatial.Distance("cord", "bar", "bob", point_a=(0.5, 0.0, 0.0))
    winch = mb.FixedTendon("winch", ("pin.angle",), coefficients=(0.1,))
    pull = mb.JointSpring("pull", "winch.length", stiffness=3.0, damping=0.2, free=0.1)
    return mb.Scene([bar, bob], joints=[pin, cord, winch], forces=[mb.Gravity((0, 0, -9.81)), pull]).compile()


def scaled(state, factor):
    return dataclasses.replace(state, q=state.q.at[3:7].multiply(factor))


def spun(p, omega, t1):
    """The attitude of a free body after a time, by SciPy."""
    J = np.array(INERTIA)

    def rates(_, y):
        p, w = y[:4], y[4:]
        return np.concatenate([np.asarray(rotations.rates(p, w)), np.cross(J * w, w) / J])

    p = np.asarray(p) / np.linalg.norm(p)
    return solve_ivp(rates, (0.0, t1), np.concatenate([p, omega]), rtol=1e-12, atol=1e-13, method="DOP853").y[:, -1]


def starts(count, rng):
    """Random attitudes with lengths between a thousandth and a thousand, and angular velocities."""
    p, omega = rng.normal(size=(count, 4)), rng.normal(size=(count, 3)) * 3
    return p / np.linalg.norm(p, axis=1)[:, None] * 10.0 ** rng.uniform(-3, 3, size=(count, 1)), omega


def check_free(free, count, rng, **options):
    """Random starts, by one program, against SciPy."""
    ps, omegas = starts(count, rng)
    ps[::4] = np.round(ps[::4] / np.linalg.norm(ps[::4], axis=1)[:, None], 4)

    def end(p, omega):
        state = mb.State(jnp.concatenate([jnp.zeros(3), p]), jnp.concatenate([jnp.zeros(3), omega]))
        return mb.simulate(free, state, t1=1.0, rtol=1e-9, saveat=diffrax.SaveAt(t0=True, t1=True), **options).ys

    run = jax.jit(end)
    for p, omega in zip(ps, omegas, strict=True):
        ys = run(jnp.asarray(p), jnp.asarray(omega))
        expected = spun(p, omega, 1.0)
        np.testing.assert_allclose(np.linalg.norm(ys.q[:, 3:], axis=1), 1.0, rtol=0, atol=1e-12)
        np.testing.assert_allclose(ys.q[0, 3:], p / np.linalg.norm(p), rtol=0, atol=1e-15)
        np.testing.assert_allclose(np.abs(ys.q[1, 3:] @ expected[:4]), 1.0, rtol=0, atol=1e-12)
        np.testing.assert_allclose(ys.q[1, 3:], expected[:4], rtol=0, atol=3e-7)
        np.testing.assert_allclose(ys.u[1, 3:], expected[4:], rtol=0, atol=3e-7)


def test_free_body(free):
    check_free(free, 8, RNG)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"solver": "hermite"},
        {"solver": diffrax.Dopri8()},
        {"manifold": mb.manifold.Partition()},
        {"manifold": mb.manifold.Projection()},
        {"manifold": mb.manifold.Baumgarte()},
    ],
    ids=lambda options: next((x if isinstance(x, str) else type(x).__name__ for x in options.values()), "default"),
)
def test_free_body_by_methods(free, options):
    if options.get("solver") == "hermite":
        options = {"solver": mb.solvers.Hermite()}
    check_free(free, 40, np.random.default_rng(11), **options)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [2.0, 1.0001, 0.01])
@pytest.mark.parametrize("manifold", [None, mb.manifold.Projection(), mb.manifold.Baumgarte()], ids=str)
def test_mixed_scene(arm, manifold, factor):
    """A run from scaled parameters is the run from normalised ones, count of turns included."""
    state = mb.assemble(arm, rates={"pin.angle": 2.0})
    run = lambda state: mb.simulate(arm, state, t1=1.0, manifold=manifold, saveat=np.linspace(0.0, 1.0, 5))
    ours, theirs = run(scaled(state, factor)), run(state)
    for a, b in ((ours.ys, theirs.ys), (ours.energy, theirs.energy), (ours["pin"].angle, theirs["pin"].angle)):
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
            np.testing.assert_allclose(x, y, rtol=0, atol=1e-10)


def test_assembly_from_scaled_parameters(arm):
    """The closest state to the directions, which does not depend on the length; so no derivative along it."""
    far = scaled(arm.guess, 1.0)
    far = dataclasses.replace(far, q=far.q.at[7:10].add(0.1))
    for factor in (2.0, 0.3):
        np.testing.assert_allclose(mb.assemble(arm, scaled(far, factor)).q, mb.assemble(arm, far).q, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_functions_of_a_state(arm):
    """Other functions that take a state do not depend on the length either."""
    state = mb.equilibrium(arm)
    other = scaled(state, 2.0)
    np.testing.assert_allclose(mb.assemble(arm, other).q, state.q, rtol=0, atol=1e-9)
    slope = jax.jit(jax.jacfwd(lambda factor: mb.assemble(arm, scaled(state, factor)).q))(2.0)
    np.testing.assert_allclose(slope, 0.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(mb.equilibrium(arm, other).q, state.q, rtol=0, atol=1e-7)
    a, b = (np.sort_complex(np.asarray(mb.linearise(arm, x).eigenvalues)) for x in (state, other))
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_required_forces():
    bar = spatial.Body("bar", mass=1.0, inertia=(0.01, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    door = mb.Scene([bar], joints=[spatial.Revolute("pin", "ground", "bar", point=(0, 0, 0), axis=(0, 0, 1))]).compile()
    motion, ts = {"pin.angle": lambda t: 0.3 * t**2}, np.array([0.0, 0.5])
    needs = [
        mb.required_forces(door, motion, by=["pin.angle"], ts=ts, guess=state)["pin.angle"]
        for state in (door.guess, scaled(door.guess, 2.0))
    ]
    np.testing.assert_allclose(needs[0], 0.6 * 0.35, rtol=1e-9)
    np.testing.assert_allclose(needs[1], needs[0], rtol=1e-9)


@pytest.mark.slow
def test_derivative_by_the_raw_parameters(free):
    """Zero along the parameters themselves; forward mode, reverse mode and differences agree."""
    p, omega, along = 2.0 * np.asarray(spun([0.5, 0.5, -0.1, 0.7], [0, 0, 0], 0.0)[:4]), np.array([1.0, -2.0, 0.5]), 0.1

    def angle(p, rtol=1e-9):
        state = mb.State(jnp.concatenate([jnp.zeros(3), p]), jnp.concatenate([jnp.zeros(3), jnp.asarray(omega)]))
        return mb.simulate(free, state, t1=1.0, rtol=rtol).ys.q[-1, 3:] @ jnp.array([1.0, 2.0, 3.0, 4.0])

    p = jnp.asarray(p)
    gradient = jax.jit(jax.grad(angle))(p)
    np.testing.assert_allclose(gradient @ p, 0.0, rtol=0, atol=1e-10)
    way = jnp.array([along, -along, 2 * along, 0.0])
    _, forward = jax.jit(lambda p: jax.jvp(angle, (p,), (way,)))(p)
    np.testing.assert_allclose(forward, gradient @ way, rtol=1e-9)
    tight = jax.jit(lambda p: angle(p, 1e-12))
    np.testing.assert_allclose(forward, (tight(p + 1e-4 * way) - tight(p - 1e-4 * way)) / 2e-4, rtol=1e-6)
    batch = jax.jit(jax.vmap(jax.grad(angle)))(jnp.stack([p, 3 * p]))
    np.testing.assert_allclose(batch[0], gradient, rtol=1e-7)
    np.testing.assert_allclose(batch[1], gradient / 3, rtol=1e-7)


def test_parameters_that_are_all_zero(free):
    state = scaled(free.guess, 0.0)
    with pytest.raises(RuntimeError, match=r"all zero have no direction: give body.orientation\."):
        mb.simulate(free, state, t1=1.0)
    assert np.isnan(jax.jit(lambda state: mb.simulate(free, state, t1=1.0).ys.q)(state)).all()
