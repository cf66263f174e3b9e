"""A half-car on wishbones over bumps, by Lagrange's equations of its heave and roll: notebook 15 has the numbers."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

LENGTHS = {"upper": 0.1465, "upright": 0.23384, "lower": 0.2286, "mounts": 0.22143}  # [m]
HALF_TRACK, HEIGHT = 0.5, 0.17  # of the mounts of the lower arms, and of the chassis at the start [m]
STIFFNESS, DAMPING = 30 * 44e3, 30 * 4e3  # of a strut [N/m], [N s/m]
SIDES, FREQUENCIES = {"right": 1.0, "left": -1.0}, {"right": 10.0, "left": 9.5}  # of the bumps [Hz]
# A uniform bar moves like three point masses, and the chassis like two at its radius of gyration.
BAR = np.array([1 / 6, 2 / 3, 1 / 6])
MASSES = np.concatenate([[375.0, 375.0], *(2 * [mass * BAR for mass in (2.0, 3.0, 15.0)])])  # [kg]


def _mounts(side):
    """Where lower arm, upper arm and strut are mounted on the chassis, (y, z) [m]."""
    lower, way = np.array([0.0, side * HALF_TRACK]), np.array([1.0, side * np.sin(np.deg2rad(19.84))])
    to_upper = LENGTHS["mounts"] * way / np.linalg.norm(way)
    return lower, lower + to_upper, lower + 1.3 * to_upper


def _meet(a, radius, b, other_radius, side):
    """Where two circles about a and b meet: left of the way from a to b for the side 1."""
    way = b - a
    distance = jnp.linalg.norm(way)
    along = (radius**2 - other_radius**2 + distance**2) / (2 * distance)
    left = jnp.array([-way[1], way[0]])
    return a + (along * way + side * jnp.sqrt(radius**2 - along**2) * left) / distance


def _places(t, coordinates):
    """Places (y, z) of the point masses [m], and the lengths of the struts [m], by heave and roll."""
    heave, roll = coordinates
    c, s = jnp.cos(roll), jnp.sin(roll)

    def on_chassis(point):
        return jnp.stack([heave + point[0] * c - point[1] * s, point[0] * s + point[1] * c])

    points, struts = [on_chassis((0.0, z)) for z in (0.5, -0.5)], []
    for name, side in SIDES.items():
        lower, upper, strut = (on_chassis(point) for point in _mounts(side))
        road = 0.05 * jnp.sin(2 * jnp.pi * FREQUENCIES[name] * t)
        wheel = jnp.stack([road, side * (HALF_TRACK + LENGTHS["lower"])])
        foot = _meet(lower, LENGTHS["lower"], wheel, LENGTHS["upright"], -side)
        top = _meet(foot, LENGTHS["upright"], upper, LENGTHS["upper"], side)
        for a, b in ((upper, top), (lower, foot), (foot, top)):
            points += [a, (a + b) / 2, b]
        struts.append(jnp.linalg.norm(lower + 0.7 * (foot - lower) - strut))
    return jnp.stack(points), jnp.stack(struts)


def _energies(t, q, v):
    """Lagrange's function L = T - V [J], and Rayleigh's function R [W]."""
    (points, lengths), (velocities, length_rates) = jax.jvp(_places, (t, q), (1.0, v))
    kinetic = 0.5 * jnp.sum(MASSES[:, None] * velocities**2)
    weight = 9.81 * MASSES @ points[:, 0]
    springs = 0.5 * STIFFNESS * jnp.sum((lengths - 1.3 * LENGTHS["upright"]) ** 2)
    return kinetic - weight - springs, 0.5 * DAMPING * jnp.sum(length_rates**2)


@jax.jit
def _rates(t, y):
    q, v = y[:2], y[2:]
    lagrangian = lambda t, q, v: _energies(t, q, v)[0]
    momentum = jax.grad(lagrangian, 2)
    momentum_rate = jax.jvp(lambda t, q: momentum(t, q, v), (t, q), (1.0, v))[1]  # without acceleration
    damping = jax.grad(lambda v: _energies(t, q, v)[1])(v)
    force = jax.grad(lagrangian, 1)(t, q, v) - damping - momentum_rate
    return jnp.concatenate([v, jnp.linalg.solve(jax.jacfwd(momentum, 2)(t, q, v), force)])


def heave_and_roll(times):
    """Of the chassis [m], [rad], at times [s], shape (times, 2)."""
    start = [HEIGHT, 0.0, 0.14, 0.0]
    found = solve_ivp(_rates, (0.0, times[-1]), start, method="DOP853", rtol=1e-12, atol=1e-12, t_eval=times)
    return found.y[:2].T
