"""Starts whose Euler parameters are not of length one: only their direction has a meaning."""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly
from scipy.integrate import solve_ivp

import jaxmb as mb
from jaxmb import spatial

INERTIA = (0.2, 0.35, 0.4)


@pytest.fixture(scope="module")
def free():
    return mb.Scene([spatial.Body("body", mass=1.5, inertia=INERTIA)]).compile()


@pytest.fixture(scope="module")
def door():
    bar = spatial.Body("bar", mass=1.0, inertia=(0.01, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    return mb.Scene([bar], joints=[spatial.Revolute("pin", "ground", "bar", point=(0, 0, 0), axis=(0, 0, 1))]).compile()


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


def product(p, e):
    """Half the product of Euler parameters with an angular velocity in the axes of the body."""
    w, v = p[0], p[1:]
    return 0.5 * np.append(-v @ e, w * e + np.cross(v, e))


def spun(p, omega, t1):
    """The attitude and the angular velocity of a free body after a time, by SciPy."""
    J, p = np.array(INERTIA), np.asarray(p) / np.linalg.norm(p)
    rates = lambda _, y: np.concatenate([product(y[:4], y[4:]), np.cross(J * y[4:], y[4:]) / J])
    return solve_ivp(rates, (0.0, t1), np.append(p, omega), rtol=1e-12, atol=1e-13, method="DOP853").y[:, -1]


def start(p, omega):
    return mb.State(jnp.concatenate([jnp.zeros(3), p]), jnp.concatenate([jnp.zeros(3), omega]))


METHODS = {
    "Adams": {},
    "Hermite": {"solver": mb.solvers.Hermite()},
    "Dopri8": {"solver": diffrax.Dopri8()},
    "Projection": {"manifold": mb.manifold.Projection()},
    "Baumgarte": {"manifold": mb.manifold.Baumgarte()},
}


@pytest.mark.slow(but=("Adams",))
@pytest.mark.parametrize("method", METHODS)
def test_free_body_turns_as_from_parameters_of_length_one(free, method):
    """From random attitudes with lengths between a thousandth and a thousand, and of four digits."""
    rng, saveat = np.random.default_rng(11), diffrax.SaveAt(t0=True, t1=True)
    run = jit_quickly(
        lambda p, omega: mb.simulate(free, start(p, omega), t1=1.0, rtol=1e-9, saveat=saveat, **METHODS[method]).ys
    )
    for k in range(16):
        p, omega = rng.normal(size=4), rng.normal(size=3) * 3
        p = p / np.linalg.norm(p)
        p = np.round(p, 4) if k % 4 == 0 else p * 10.0 ** rng.uniform(-3, 3)
        ys, known = jax.tree.map(np.asarray, run(p, omega)), spun(p, omega, 1.0)
        np.testing.assert_allclose(np.linalg.norm(ys.q[:, 3:], axis=1), 1.0, rtol=0, atol=1e-12)
        np.testing.assert_allclose(ys.q[0, 3:], p / np.linalg.norm(p), rtol=0, atol=1e-15)
        np.testing.assert_allclose(ys.q[1, 3:], known[:4], rtol=0, atol=3e-7)
        np.testing.assert_allclose(ys.u[1, 3:], known[4:], rtol=0, atol=3e-7)
    assert np.isnan(run(0.0 * p, omega).q).all()


def test_free_body_whose_parameters_are_all_zero_is_refused(free):
    with pytest.raises(RuntimeError, match=r"all zero have no direction: give body.orientation\."):
        mb.simulate(free, scaled(free.guess, 0.0), t1=1.0)


@pytest.mark.slow
def test_assembly_does_not_depend_on_the_length(door):
    """It finds the closest state to the directions."""
    far = dataclasses.replace(door.guess, q=door.guess.q + np.array([0.1, 0.2, 0.0, 0.0, 0.1, 0.0, 0.2]))
    find = jit_quickly(lambda p: mb.assemble(door, dataclasses.replace(far, q=far.q.at[3:].set(p)), throw=False).q)
    found = [np.asarray(find(factor * far.q[3:])) for factor in (1.0, 2.0, 0.3)]
    assert np.all(np.isfinite(found))
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("manifold", [None, mb.manifold.Projection(), mb.manifold.Baumgarte()], ids=str)
def test_run_from_scaled_parameters_is_that_from_normalised_ones(arm, manifold):
    """The count of turns included."""
    state = mb.assemble(arm, rates={"pin.angle": 2.0})
    run = lambda state: mb.simulate(arm, state, t1=1.0, manifold=manifold, saveat=np.linspace(0.0, 1.0, 5))
    seen = lambda motion: jax.tree.leaves((motion.ys, motion.energy, motion["pin"].angle))
    known = seen(run(state))
    for factor in (2.0, 1.0001, 0.01):
        for x, y in zip(seen(run(scaled(state, factor))), known, strict=True):
            np.testing.assert_allclose(x, y, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_functions_of_a_state_do_not_depend_on_the_length(arm, door):
    state = mb.equilibrium(arm)
    other = scaled(state, 2.0)
    slope = jax.jit(jax.jacfwd(lambda factor: mb.assemble(arm, scaled(state, factor)).q))(2.0)
    np.testing.assert_allclose(slope, 0.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(mb.equilibrium(arm, other).q, state.q, rtol=0, atol=1e-7)
    a, b = (np.sort_complex(np.asarray(mb.linearise(arm, x).eigenvalues)) for x in (state, other))
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-6)

    motion, ts = {"pin.angle": lambda t: 0.3 * t**2}, np.array([0.0, 0.5])
    for guess in (door.guess, scaled(door.guess, 2.0)):
        needs = mb.required_forces(door, motion, by=["pin.angle"], ts=ts, guess=guess)["pin.angle"]
        np.testing.assert_allclose(needs, 0.6 * 0.35, rtol=1e-9)


@pytest.mark.slow
def test_derivatives_by_the_raw_parameters(free):
    """Zero along the parameters themselves; forward mode, reverse mode, a batch and differences agree."""
    p, omega, along = 2.0 * spun([0.5, 0.5, -0.1, 0.7], np.zeros(3), 0.0)[:4], np.array([1.0, -2.0, 0.5]), 0.1
    weights = jnp.array([1.0, 2.0, 3.0, 4.0])
    angle = lambda p, rtol=1e-9: (
        mb.simulate(free, start(p, jnp.asarray(omega)), t1=1.0, rtol=rtol).ys.q[-1, 3:] @ weights
    )
    gradients = jax.jit(jax.vmap(jax.grad(angle)))(jnp.stack([p, 3 * p]))
    np.testing.assert_allclose(gradients[0] @ p, 0.0, rtol=0, atol=1e-10)
    np.testing.assert_allclose(gradients[1], gradients[0] / 3, rtol=1e-7)
    way = jnp.array([along, -along, 2 * along, 0.0])
    forward = jax.jit(lambda p, rtol: jax.jvp(lambda p: angle(p, rtol), (p,), (way,)))
    slope = forward(jnp.asarray(p), 1e-9)[1]
    np.testing.assert_allclose(slope, gradients[0] @ way, rtol=1e-9)
    ahead, back = (forward(p + h * way, 1e-12)[0] for h in (1e-4, -1e-4))
    np.testing.assert_allclose(slope, (ahead - back) / 2e-4, rtol=1e-6)
