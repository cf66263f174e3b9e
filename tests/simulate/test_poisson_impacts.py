"""Impacts by Poisson's law, against closed forms and a search through all cases of both phases."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly
from scipy.spatial.transform import Rotation

import jaxmb as mb
from jaxmb import planar, spatial, terrain
from jaxmb.contacts.impact import impact
from jaxmb.contacts.tolerance import ContactTolerance

HALF, TALL, MASS = 0.3, 0.2, 2.0
INERTIA = MASS * (HALF**2 + TALL**2) / 3
CORNERS = {"left": (-HALF, -TALL), "right": (HALF, -TALL)}


def block(restitution, coefficient, laws=("poisson", "poisson"), angle=0.0):
    """A block above the ground, with its two lower corners as contacts with friction."""
    c, s = np.cos(angle), np.sin(angle)
    low = max(-(s * x + c * y) for x, y in CORNERS.values())
    body = planar.Body("block", mass=MASS, inertia=INERTIA, position=(0.0, low), angle=angle)
    floors = [
        mb.RigidContact(name, "block", terrain=terrain.Flat(), centre=at, restitution=e, impact_law=law)
        for (name, at), e, law in zip(CORNERS.items(), restitution, laws, strict=True)
    ]
    rubs = [
        mb.DryFriction(f"rub {name}", name, coefficient=mu) for name, mu in zip(CORNERS, coefficient, strict=True) if mu
    ]
    return mb.Scene([body], joints=floors, forces=[mb.Gravity((0.0, -9.81)), *rubs]).compile()


def struck(system):
    """The event at the scene's own position, as a function of parameters and of the velocity of the body."""
    state = mb.assemble(system)
    count = system.nu - len(system.contacts.places)

    def event(p, u):
        own = mb.with_parameters(system, p)
        y = mb.State(state.q, jnp.concatenate([u, state.u[count:]]))
        tolerance = ContactTolerance(jnp.asarray(1e-9))
        return impact(own, mb.formulations.Multipliers(), tolerance, jnp.zeros(()), y)

    return event


def phase(W, b, again, coefficient):
    """The impulses of one phase: normal ones of `again` or more, and friction in the cone; all cases are tried."""
    n = len(again)
    for closed, dry in itertools.product(
        itertools.product((False, True), repeat=n), itertools.product((0, 1, -1), repeat=n)
    ):
        matrix, right = np.eye(2 * n), np.zeros(2 * n)
        for k in range(n):
            if closed[k]:
                matrix[k], right[k] = W[k], -b[k]
            else:
                right[k] = again[k]
            if dry[k] == 0:
                matrix[n + k], right[n + k] = W[n + k], -b[n + k]
            else:
                matrix[n + k, k] = dry[k] * coefficient[k]
        try:
            x = np.linalg.solve(matrix, right)
        except np.linalg.LinAlgError:
            continue
        rate = W @ x + b
        small = 1e-12 * (1 + np.abs(x).max())
        fits = [
            (x[k] >= again[k] - small)
            and rate[k] >= -small
            and (abs(x[n + k]) <= coefficient[k] * x[k] + small if dry[k] == 0 else dry[k] * rate[n + k] >= -small)
            for k in range(n)
        ]
        if all(fits):
            return x
    raise AssertionError("no case fits")


@pytest.mark.slow("both corners")
@pytest.mark.parametrize("angle, touching", [(0.0, (0, 1)), (0.3, (0,))], ids=["both corners", "one corner"])
def test_block_strikes_the_ground(angle, touching):
    """At random velocities, with random coefficients."""
    rng, n = np.random.default_rng(3), len(touching)
    c, s = np.cos(angle), np.sin(angle)
    arms = np.array([[c * x - s * y, s * x + c * y] for x, y in CORNERS.values()])
    J = np.array([[0.0, 1.0, arms[k, 0]] for k in touching] + [[1.0, 0.0, -arms[k, 1]] for k in touching])
    inverse = np.diag([1 / MASS, 1 / MASS, 1 / INERTIA])
    W = J @ inverse @ J.T
    event = jax.jit(struck(block((0.5, 0.5), (0.3, 0.3), angle=angle)))
    sticks, compared = 0, 0
    for _ in range(20):
        restitution, coefficient = rng.uniform(0.2, 0.7, 2), rng.uniform(0.05, 1.5, 2)
        u = np.array([rng.normal(), -1.5 - rng.random(), 2 * rng.normal()])
        b = J @ u
        if np.any(b[:n] > 0):
            continue
        own = np.array(touching)
        first = phase(W, b, np.zeros(n), coefficient[own])
        second = phase(W, b + W @ first, restitution[own] * first[:n], coefficient[own])
        expected = u + inverse @ J.T @ (first + second)
        lost = 0.5 * (u @ np.linalg.solve(inverse, u) - expected @ np.linalg.solve(inverse, expected))
        given = {f"{name}.restitution": e for name, e in zip(CORNERS, restitution, strict=True)}
        given |= {f"rub {name}.coefficient": mu for name, mu in zip(CORNERS, coefficient, strict=True)}
        found = event(given, jnp.asarray(u))
        assert lost > 0 and found.energy > 0
        # Two corners that stick share their force in many ways.
        impulses = found.impulses[np.concatenate([own, 2 + own])]
        np.testing.assert_allclose(J.T @ impulses, J.T @ (first + second), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(found.after.u[:3], expected, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(found.energy, lost, rtol=1e-9, atol=1e-12)
        sticks, compared = sticks + np.any(np.abs(J[n:] @ expected) < 1e-12), compared + 1
    assert compared > 8 and 0 < sticks < compared


@pytest.mark.slow
def test_without_friction_one_contact_rebounds_as_by_newton():
    u = jnp.array([0.4, -2.0, 1.0])
    after = [
        struck(block((0.6, 0.6), (0.0, 0.0), (law, law), angle=0.3))({}, u).after.u for law in ("newton", "poisson")
    ]
    np.testing.assert_allclose(after[0], after[1], rtol=1e-12)


# A bar in space, an end of which is on the ground: its attitude and moments of inertia about its own axes.
TURN, MOMENTS, END = Rotation.from_euler("xyz", (0.3, 0.5, 0.2)), np.array([0.02, 0.3, 0.29]), np.array([0.5, 0.0, 0.0])


def bar():
    p = TURN.as_quat()[[3, 0, 1, 2]]
    body = spatial.Body("bar", mass=MASS, inertia=MOMENTS, position=-TURN.apply(END), orientation=p)
    tip = mb.RigidContact("tip", "bar", terrain=terrain.Flat(), centre=END, restitution=0.5, impact_law="poisson")
    return mb.Scene([body], joints=[tip], forces=[mb.DryFriction("rub", "tip", coefficient=0.4)]).compile()


def nearest(W, b, again, coefficient):
    """The impulses of one phase of one contact in space: each is the nearest one in its set to what would end its rate;
    this is repeated until nothing changes.
    """
    x, step = np.zeros(3), 0.5 / np.trace(W)
    for _ in range(20000):
        ahead = x - step * (W @ x + b)
        normal = max(again, ahead[0])
        x = np.array([normal, *(ahead[1:] * min(1.0, coefficient * normal / np.linalg.norm(ahead[1:])))])
    return x


@pytest.mark.slow
def test_bar_strikes_the_ground_in_space():
    u = np.array([0.6, -0.3, -2.0, 1.0, -0.5, 2.0])
    arm = TURN.apply(END)
    # Velocities of the end by those of the centre and the angular velocity in the axes of the bar.
    J = np.hstack([np.eye(3), np.cross(TURN.as_matrix().T, arm).T])[[2, 0, 1]]
    inverse = np.diag(1 / np.array([MASS] * 3 + [*MOMENTS]))
    W, b = J @ inverse @ J.T, J @ u
    event = jax.jit(struck(bar()))
    for coefficient in (0.1, 0.7):
        first = nearest(W, b, 0.0, coefficient)
        second = nearest(W, b + W @ first, 0.5 * first[0], coefficient)
        found = event({"rub.coefficient": jnp.asarray(coefficient)}, jnp.asarray(u))
        np.testing.assert_allclose(found.after.u[:6], u + inverse @ J.T @ (first + second), rtol=1e-9)
        assert found.energy > 0


def cases():
    """Scenes with velocities before an impact: that slip to the end with a law each, that stick, in space, and with
    less than the whole rebound, which would give energy back.
    """
    yield block((0.5, 0.4), (0.05, 0.1), ("poisson", "newton")), (2.0, -1.5, -0.7)
    yield block((0.6, 0.0), (0.6, 0.6), angle=0.3), (0.2, -1.5, 2.0)
    yield bar(), (0.6, -0.3, -2.0, 1.0, -0.5, 2.0)
    yield block((0.94, 0.95), (0.25, 0.17), ("poisson", "newton")), (0.33, -1.74, -2.37)


@pytest.mark.slow
@pytest.mark.parametrize("case", range(4))
def test_impacts_have_derivatives(case):
    """Of the velocities after impacts, the impulses and the energy, by all numbers and the velocities before."""
    system, u = list(cases())[case]
    event, given = struck(system), mb.parameters(system)
    names = [name for name in given if name.split(".")[-1] in ("mass", "inertia", "restitution", "coefficient")]

    def of(x):
        found = event({name: given[name] * x[k] for k, name in enumerate(names)}, x[len(names) :])
        return jnp.concatenate([found.after.u[: len(u)], found.impulses, found.energy[None]])

    x, h = jnp.concatenate([jnp.ones(len(names)), jnp.array(u)]), 1e-6
    forward, reverse = jit_quickly(jax.jacfwd(of))(x), jit_quickly(jax.jacrev(of))(x)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-12)
    steps = h * jnp.concatenate([jnp.eye(x.size), -jnp.eye(x.size)])
    values = jit_quickly(jax.vmap(lambda step: of(x + step)))(steps)
    np.testing.assert_allclose(forward, (values[: x.size] - values[x.size :]).T / (2 * h), atol=1e-7)
