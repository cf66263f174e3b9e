"""Planar tracked vehicles in minimal coordinates, with equations of their own: NumPy and SciPy only.

Every point of the chain is `r = (X, Y) + Σ_k R(θ_k) s_k` with constant vectors s_k, so with the coordinates
z = (X, Y, θ) its velocity is `J ż` and its acceleration `J z̈ − Σ_k θ̇_k² R(θ_k) s_k`.
"""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import root

G, RADIUS, REACH = 9.81, 0.305, np.array([-0.288, -0.134])
HULL, ARM, WHEEL = (7819.24, 27287.61), (150.52, 1.54 + 150.52 * (REACH @ REACH) / 12), (300.0, 14.0)
PIVOTS = np.array([(1.639, -0.487), (0.972, -0.487), (0.305, -0.487), (-0.362, -0.487), (-1.028, -0.487)])
SPROCKET, IDLER = np.array([2.006, -0.406]), np.array([-1.824, -0.526])
REAR, FRONT = np.array([-2.4, -0.2]), np.array([2.4, -0.2])
EPS = 1e-3


def plus(d):
    """A smooth max(d, 0), and its derivative."""
    root = np.sqrt(d * d + EPS * EPS)
    return 0.5 * (d + root), 0.5 * (1 + d / root)


def bump(x, start=4.0, length=1.5, height=0.12):
    s = (x - start) / length
    on = (s > 0) & (s < 1)
    slope = height * np.pi / length * np.sin(2 * np.pi * s)
    return np.where(on, height * np.sin(np.pi * s) ** 2, 0.0), np.where(on, slope, 0.0)


class Vehicle:
    """`units` carriers of five wheels; arms are described in a frame in which they lie along (−.288, −.134) when the
    hull is level. Angles, a unit after the other: hull, arms, wheels.
    """

    def __init__(self, units=1, *, torque=3000.0, torsion=5e4, damping=5e3, terrain=bump):
        self.units, self.torque, self.torsion, self.damping, self.terrain = units, torque, torsion, damping, terrain
        angles = 11 * units
        self.S = np.zeros((13 * units, angles, 2))  # points: hull, arms, wheels, sprocket, idler of each unit
        self.mass, self.inertia = np.zeros(13 * units), np.tile(np.r_[HULL[1], [ARM[1]] * 5, [WHEEL[1]] * 5], units)
        for u in range(units):
            S = self.S[13 * u : 13 * u + 13]
            for k in range(u):
                S[:, 11 * k] += REAR
                S[:, 11 * k + 11] -= FRONT
            S[1:6, 11 * u] += PIVOTS
            S[6:11, 11 * u] += PIVOTS
            S[11, 11 * u] += SPROCKET
            S[12, 11 * u] += IDLER
            for i in range(5):
                S[1 + i, 11 * u + 1 + i] = REACH / 2
                S[6 + i, 11 * u + 1 + i] = REACH
            self.mass[13 * u : 13 * u + 11] = np.r_[HULL[0], [ARM[0]] * 5, [WHEEL[0]] * 5]
        self.loop = np.array([11, 12, 10, 9, 8, 7, 6])
        self.free_length = np.sum(self._spans(self.positions(np.zeros(2 + angles))[:13])[1])
        self.free_angle = (HULL[0] + 5 * ARM[0]) * G / 5 * -REACH[0] / 5e4

    def _arms(self, z):
        c, s = np.cos(z[2:]), np.sin(z[2:])
        x, y = self.S[..., 0], self.S[..., 1]
        return np.stack([c * x - s * y, s * x + c * y], axis=-1)

    def positions(self, z):
        return z[:2] + np.sum(self._arms(z), axis=1)

    def _spans(self, points):
        d = np.roll(points[self.loop], -1, axis=0) - points[self.loop]
        length = np.hypot(*d.T)
        return d / length[:, None], length

    def forces(self, z, rates, r, v):
        """Forces at points and moments on angles."""
        F, moment = np.zeros_like(r), np.zeros(z.size - 2)
        F[:, 1] -= self.mass * G
        theta, spin = z[2:], rates[2:]
        for u in range(self.units):
            o, hull, arms, wheels = 13 * u, 11 * u, slice(11 * u + 1, 11 * u + 6), slice(11 * u + 6, 11 * u + 11)
            a, rate = theta[arms] - theta[hull], spin[arms] - spin[hull]
            (low, low_slope), (high, high_slope) = plus(-a - 0.6), plus(a - 0.6)
            torque = -self.torsion * (a - self.free_angle) - self.damping * rate
            torque += 2e6 * (low**3 * low_slope - high**3 * high_slope)
            moment[arms] += torque
            moment[hull] += self.torque - np.sum(torque)
            moment[wheels] -= self.torque / 5
            own = slice(o, o + 13)
            along, spans = self._spans(r[own])
            tension = 1.5e4 + 4e5 * (np.sum(spans) - self.free_length)
            F[o + self.loop] += tension * (along - np.roll(along, 1, axis=0))
            w = slice(o + 6, o + 11)
            ground, slope = self.terrain(r[w, 0])
            depth, share = plus(RADIUS + ground - r[w, 1])
            traction = -0.7 * 8e5 * depth * np.tanh((v[w, 0] + RADIUS * spin[wheels]) / 0.3)
            F[w, 0] += traction - 8e5 * depth * share * slope
            F[w, 1] += 8e5 * depth * share - 2e4 * np.clip(depth / 0.01, 0, 1) * v[w, 1]
            moment[wheels] += RADIUS * traction
        if self.units == 2:
            hitch = -2e5 * (theta[0] - theta[11]) - 2e4 * (spin[0] - spin[11])
            moment[0] += hitch
            moment[11] -= hitch
        return F, moment

    def acceleration(self, z, rates):
        arms = self._arms(z)
        turned = np.stack([-arms[..., 1], arms[..., 0]], axis=1)  # points, xy, angles
        r, v = z[:2] + np.sum(arms, axis=1), rates[:2] + turned @ rates[2:]
        F, moment = self.forces(z, rates, r, v)
        # Newton's law at every point, less what the angles' rates alone make of it.
        F = F + self.mass[:, None] * np.einsum("pkx,k->px", arms, rates[2:] ** 2)
        heavy = self.mass[:, None, None] * turned
        M = np.zeros((z.size, z.size))
        M[:2, :2] = np.sum(self.mass) * np.eye(2)
        M[:2, 2:] = np.sum(heavy, axis=0)
        M[2:, :2] = M[:2, 2:].T
        flat = turned.reshape(-1, z.size - 2)
        M[2:, 2:] = flat.T @ heavy.reshape(flat.shape) + np.diag(self.inertia)
        Q = np.r_[np.sum(F, axis=0), flat.T @ F.ravel() + moment]
        return np.linalg.solve(M, Q)

    def equilibrium(self):
        """The coordinates at rest without drive, at X = 0 with wheels unturned."""
        drive, self.torque = self.torque, 0.0
        free = np.concatenate([[1], *(2 + 11 * u + np.arange(6) for u in range(self.units))])
        start = np.zeros(2 + 11 * self.units)
        start[1] = RADIUS - PIVOTS[0, 1] - REACH[1] - 0.01

        def balance(x):
            z = start.copy()
            z[free] = x
            return self.acceleration(z, np.zeros_like(z))[free]

        solved = root(balance, start[free], tol=1e-14)
        self.torque = drive
        start[free] = solved.x
        return start

    def motion(self, times, *, speed=5.0, rtol=1e-10):
        """Coordinates and their rates at the times, from equilibrium with wheels that roll."""
        z = self.equilibrium()
        rates = np.zeros_like(z)
        rates[0] = speed
        for u in range(self.units):
            rates[2 + 11 * u + 6 : 2 + 11 * u + 11] = -speed / RADIUS
        n = z.size
        run = solve_ivp(
            lambda t, y: np.r_[y[n:], self.acceleration(y[:n], y[n:])],
            (0.0, times[-1]),
            np.r_[z, rates],
            method="DOP853",
            t_eval=times,
            rtol=rtol,
            atol=rtol / 100,
            max_step=0.02,
        )
        return run.y[:n].T, run.y[n:].T
