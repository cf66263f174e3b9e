"""Rigid bodies in Euler parameters with angular velocities: an axis that tracks, and two bodies held in one attitude.

After F. E. Udwadia and P. Phohomsiri, Explicit Poincaré equations of motion for general constrained systems. Part II,
Proc. R. Soc. A 463, 2007. Expected values are of equations of their own, in NumPy.
"""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import jaxmb as mb
from jaxmb.formulations import Multipliers, NullSpace, Partitioned, Poincare, UdwadiaKalaba, accelerations
from jaxmb.lagrangian import Holonomic, LagrangianSystem, QuasiVelocityFrame, ServoConstraint
from jaxmb.linalg import rotations

pytestmark = pytest.mark.slow

ROADS = [Partitioned(), Multipliers(), NullSpace(), Poincare(), UdwadiaKalaba()]
INERTIAS = np.array([np.diag([1.0, 2.0, 3.0]), [[2.0, 0.3, -0.1], [0.3, 1.5, 0.2], [-0.1, 0.2, 1.8]]])
GAINS = DAMPING, STIFFNESS = 6.0, 9.0


def kinetic(t, q, v, p):
    omega = jax.vmap(rotations.angular_velocity)(q.reshape(-1, 4), v.reshape(-1, 4))
    return 0.5 * jnp.einsum("ki,kij,kj->", omega, p["inertias"], omega)


def turning(t, q, p):
    """Rates of the Euler parameters of every body for its angular velocities in its own axes."""
    blocks = jax.vmap(lambda p: jax.jacfwd(lambda w: rotations.rates(p, w))(jnp.zeros(3)))(q.reshape(-1, 4))
    return jax.scipy.linalg.block_diag(*blocks)


def bodies(inertias, constraint, q, u):
    return LagrangianSystem(
        kinetic=kinetic,
        kinematics=QuasiVelocityFrame(turning, u.size),
        constraints=[constraint],
        q=q,
        u=u,
        parameters={"inertias": inertias},
    )


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, 0, 0, 0))
def by_all(system, t, q, u):
    """Accelerations and constraint forces by every formulation."""
    pairs = [accelerations(system, road, t, q, u) for road in ROADS]
    forces = [system.constraint_force(t, q, u, multipliers) for _, multipliers in pairs]
    return jnp.stack([udot for udot, _ in pairs]), jnp.stack(forces)


def attitude(p):
    return Rotation.from_quat(np.roll(p, -1))


def random_attitude(rng):
    p = rng.standard_normal(4)
    return p / np.linalg.norm(p)


# The third axis of a body follows a direction


def direction(t, xp=np):
    """A direction that wanders about the vertical."""
    tilt, turn = 0.4 + 0.2 * xp.sin(2 * t), 0.7 * t
    return xp.stack([xp.sin(tilt) * xp.cos(turn), xp.sin(tilt) * xp.sin(turn), xp.cos(tilt)])


def derivatives_of_direction(t):
    """The direction, its rate and its second derivative, by hand."""
    a, a1, a2 = 0.4 + 0.2 * np.sin(2 * t), 0.4 * np.cos(2 * t), -0.8 * np.sin(2 * t)
    b, b1 = 0.7 * t, 0.7
    s, c = np.sin(a), np.cos(a)
    around, across = np.array([np.cos(b), np.sin(b), 0.0]), np.array([-np.sin(b), np.cos(b), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    first = c * a1 * around + s * b1 * across - s * a1 * up
    second = (c * a2 - s * a1**2 - s * b1**2) * around + 2 * c * a1 * b1 * across - (s * a2 + c * a1**2) * up
    return s * around + c * up, first, second


def off(t, q, p):
    n = direction(t, jnp)
    return rotations.unrotate(q, n)[:2]


def tracked(t, p, omega):
    """`ω̇` and the control torque: with `n′ = Rᵀ n` in body axes, `φ = (n′₁, n′₂)` and

    `φ̈ = (Rᵀ n̈ − 2 ω × Rᵀ ṅ + ω × (ω × n′) − ω̇ × n′)₁₂ = −damping φ̇ − stiffness φ`; the torque has no part along n′.
    """
    J = INERTIAS[0]
    n, n1, n2 = (attitude(p).inv().apply(x) for x in derivatives_of_direction(t))
    rate = (n1 - np.cross(omega, n))[:2]
    known = n2 - 2 * np.cross(omega, n1) + np.cross(omega, np.cross(omega, n))
    rows = -np.cross(n, np.eye(3)[:2])
    right = -(known[:2] + DAMPING * rate + STIFFNESS * n[:2])
    both = np.block([[J, -rows.T], [rows, np.zeros((2, 2))]])
    solution = np.linalg.solve(both, np.concatenate([-np.cross(omega, J @ omega), right]))
    return solution[:3], rows.T @ solution[3:]


def test_the_control_of_an_axis():
    rng, u = np.random.default_rng(0), np.array([0.3, -0.2, 0.5])
    tracking = bodies(INERTIAS[:1], ServoConstraint("track", off, *GAINS), np.array([1.0, 0.0, 0.0, 0.0]), u)
    states = [(rng.uniform(0, 3), random_attitude(rng), rng.standard_normal(3)) for _ in range(6)]
    stacked = [np.stack(x) for x in zip(*states, strict=True)]
    udot, torque = by_all(tracking, *stacked)
    for k, state in enumerate(states):
        expected, control = tracked(*state)
        size = 1 + np.max(np.abs(expected))
        np.testing.assert_allclose(udot[k], np.tile(expected, (len(ROADS), 1)), rtol=0, atol=1e-12 * size)
        np.testing.assert_allclose(torque[k], np.tile(control, (len(ROADS), 1)), rtol=0, atol=1e-11 * size)


# Two bodies that keep one attitude


def together(omega):
    """`ω̇` of both as one body, and the torques between them."""
    J = INERTIAS.sum(axis=0)
    udot = np.linalg.solve(J, -np.cross(omega, J @ omega))
    return udot, np.concatenate([own @ udot + np.cross(omega, own @ omega) for own in INERTIAS])


def test_two_bodies_in_one_attitude_turn_as_one():
    """Four rows between Euler parameters, of which angular velocities feel three."""
    rng = np.random.default_rng(2)
    q, u = random_attitude(rng), np.array([0.4, -0.9, 0.6])
    same = Holonomic("same", lambda t, q, p: q[:4] - q[4:])
    locked = bodies(INERTIAS, same, np.tile(q, 2), np.tile(u, 2))
    assert (locked.nq, locked.coordinate_rank, locked.nu, locked.velocity_rows, locked.velocity_rank) == (8, 4, 6, 4, 3)
    omega, q = rng.standard_normal((5, 3)), np.stack([np.tile(random_attitude(rng), 2) for _ in range(5)])
    udot, torque = by_all(locked, np.zeros(5), q, np.tile(omega, 2))
    for k in range(5):
        expected, between = together(omega[k])
        size = 1 + np.max(np.abs(expected))
        np.testing.assert_allclose(udot[k], np.tile(expected, (len(ROADS), 2)), rtol=0, atol=1e-12 * size)
        np.testing.assert_allclose(torque[k], np.tile(between, (len(ROADS), 1)), rtol=0, atol=1e-12 * size)
    # Compiled sooner than the default; any method will do.
    method = {"solver": diffrax.Dopri8(), "rtol": 1e-11, "atol": 1e-13, "max_steps": 100_000}
    run = mb.simulate(locked, locked.guess, t1=2.0, manifold=mb.manifold.Projection(), **method)
    expected = solve_ivp(lambda t, w: together(w)[0], (0.0, 2.0), u, method="DOP853", rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(run.ys.u[-1], np.tile(expected.y[:, -1], 2), rtol=0, atol=1e-9)
    np.testing.assert_allclose(run.ys.q[-1, :4], run.ys.q[-1, 4:], rtol=0, atol=1e-12)
