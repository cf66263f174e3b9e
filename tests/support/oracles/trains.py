"""Trains with equations of their own: NumPy and SciPy only.

A vehicle has coordinates (x, y, φ); its coupler points are (±a, h) in its own axes, its springs stand at (±w, 0).
"""

import numpy as np
from numpy.polynomial import Polynomial
from scipy.integrate import solve_ivp

# A step with two vanishing derivatives at either end, and its integral.
STEP = 30 * (Polynomial([0, 1]) ** 2 * Polynomial([1, -1]) ** 2).integ()
RAMP = STEP.integ()


def step(x, width):
    return STEP(np.clip(x / width + 0.5, 0, 1))


def ramp(x, width):
    return np.where(x > width / 2, x, width * RAMP(np.clip(x / width + 0.5, 0, 1)))


def draft_gear(s, rate, *, k=1e7, eta=0.4, S0=5e4, slack=0.02, travel=0.11, ks=1e8, c=0.0, v0=0.01, width=0.005):
    """Tension [N] at an extension and its rate: loading and unloading branch, blended, either way."""
    tension = 0.0
    for sign in (1, -1):
        x, v = sign * s - slack, sign * rate
        loading = S0 * step(x, width) + k * ramp(x, width)
        share = 0.5 * (1 + np.tanh(v / v0))
        branch = loading * share + eta * loading * (1 - share)
        tension = tension + sign * (branch + ks * ramp(x - travel, width) + c * step(x, width) * v)
    return tension


def turned(points, angle):
    """World offsets of body-fixed points (2,) at angles (n,), shape (n, 2)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([points[0] * c - points[1] * s, points[0] * s + points[1] * c], axis=1)


def perp(v):
    return np.stack([-v[:, 1], v[:, 0]], axis=1)


def cross(a, b):
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


class Train:
    """The emergency stop of `mechanisms.train`."""

    def __init__(self, n, *, reach=6.0, h=-0.5, length=1.0, m=8e4, J=1.3e6, k=5e6, c=1e5, w=4.25, brake=8e4, g=9.81):
        self.n, self.reach, self.h, self.length = n, reach, h, length
        self.m, self.J, self.k, self.c, self.w, self.brake, self.g = m, J, k, c, w, brake, g
        self.start = (2 * reach + length) * np.arange(n) / 250.0

    def tension(self, q, u):
        """Forces of the couplers, and their points' offsets and unit vectors from front to rear vehicle."""
        rear, front = turned((-self.reach, self.h), q[:-1, 2]), turned((self.reach, self.h), q[1:, 2])
        d = q[1:, :2] + front - q[:-1, :2] - rear
        e = np.linalg.norm(d, axis=1)
        rate = u[1:, :2] + u[1:, 2:] * perp(front) - u[:-1, :2] - u[:-1, 2:] * perp(rear)
        along = d / e[:, None]
        return draft_gear(e - self.length, np.sum(along * rate, axis=1)), rear, front, along

    def accelerations(self, t, q, u):
        force = np.zeros_like(q)
        S, rear, front, along = self.tension(q, u)
        pull = S[:, None] * along
        force[:-1, :2] += pull
        force[:-1, 2] += cross(rear, pull)
        force[1:, :2] -= pull
        force[1:, 2] -= cross(front, pull)
        for side in (self.w, -self.w):
            arm = turned((side, 0.0), q[:, 2])
            y, v = q[:, 1] + arm[:, 1], u[:, 1] + u[:, 2] * arm[:, 0]
            up = -self.k * (y - self.m * self.g / (2 * self.k)) - self.c * v
            force[:, 1] += up
            force[:, 2] += arm[:, 0] * up
        force[:, 1] -= self.m * self.g
        v = u[:, 0]
        z = np.clip((t - self.start) / 2.0, 0, 1)
        against = 1200.0 + 12.0 * np.abs(v) + 1.5 * v**2 + self.brake * STEP(z)
        force[:, 0] -= against * np.tanh(v / 0.1)
        return force / np.array([self.m, self.m, self.J])

    def motion(self, times, *, speed=20.0, rtol=1e-13):
        """Coordinates (times, n, 3), velocities (times, n, 3) and coupler forces along x (times, n − 1).

        The third derivatives of the couplers' forces jump. With steps as long as the method likes, what remains of its
        error, a few 10⁻⁷ of the forces, depends on rounding; with these it is below 10⁻⁷.
        """
        n = self.n
        q0, u0 = np.zeros((n, 3)), np.zeros((n, 3))
        q0[:, 0], u0[:, 0] = -(2 * self.reach + self.length) * np.arange(n), speed

        def field(t, y):
            q, u = y[: 3 * n].reshape(n, 3), y[3 * n :].reshape(n, 3)
            return np.concatenate([u.ravel(), self.accelerations(t, q, u).ravel()])

        y0 = np.concatenate([q0.ravel(), u0.ravel()])
        options = {"t_eval": times, "rtol": rtol, "atol": 1e-12, "max_step": 0.02}
        y = solve_ivp(field, (0.0, times[-1]), y0, method="DOP853", **options).y.T
        q, u = y[:, : 3 * n].reshape(-1, n, 3), y[:, 3 * n :].reshape(-1, n, 3)
        forces = []
        for a, b in zip(q, u, strict=True):
            S, _, _, along = self.tension(a, b)
            forces.append(-S * along[:, 0])
        return q, u, np.array(forces)


def hinged_accelerations(q, u, force, mass, inertia, *, reach=6.0, h=-0.5):
    """Accelerations (n, 3) and hinge forces on the front vehicles (n − 1, 2), from one matrix of all of them."""
    n = len(q)
    rear, front = turned((-reach, h), q[:-1, 2]), turned((reach, h), q[1:, 2])
    A, gamma = np.zeros((2 * n - 2, 3 * n)), np.zeros(2 * n - 2)
    for j in range(n - 1):
        rows = slice(2 * j, 2 * j + 2)
        A[rows, 3 * j : 3 * j + 2], A[rows, 3 * j + 3 : 3 * j + 5] = np.eye(2), -np.eye(2)
        A[rows, 3 * j + 2], A[rows, 3 * j + 5] = perp(rear[j : j + 1])[0], -perp(front[j : j + 1])[0]
        gamma[rows] = rear[j] * u[j, 2] ** 2 - front[j] * u[j + 1, 2] ** 2
    M = np.diag(np.stack([mass, mass, inertia], axis=1).ravel())
    both = np.block([[M, -A.T], [A, np.zeros((len(A), len(A)))]])
    solution = np.linalg.solve(both, np.concatenate([force.ravel(), gamma]))
    return solution[: 3 * n].reshape(n, 3), solution[3 * n :].reshape(-1, 2)
