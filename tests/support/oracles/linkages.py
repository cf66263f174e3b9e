"""Planar linkages in one generalized coordinate, with equations of their own: NumPy and SciPy only.

With the crank angle θ as the coordinate, every velocity is a known function of θ times θ̇, so the kinetic energy is
`½ I(θ) θ̇²` and

    I θ̈ + ½ I′ θ̇² = −V′.

`I′` is worked out by hand from the second derivatives of the loop's angles.
"""

import numpy as np
from scipy.integrate import solve_ivp


def four_bar(times, *, lengths=(1.0, 3.0, 2.5), base=2.5, masses=(1.0, 3.0, 2.5), start=np.pi / 2, speed=4.0, g=9.81):
    """Uniform bars between ground pivots (0, 0) and (base, 0), coupler-rocker pin on the left of the way from B to D.

    **Returns:** crank, coupler and rocker angles [rad] and their rates [rad/s], shape (times, 6).
    """
    a, b, c = lengths
    m1, m2, m3 = masses

    def angles(theta):
        """Coupler and rocker angles from the triangle B, C, D."""
        dx, dy = base - a * np.cos(theta), -a * np.sin(theta)
        e = np.hypot(dx, dy)
        toward = np.arctan2(dy, dx)
        at_B = np.arccos((b**2 + e**2 - c**2) / (2 * b * e))
        at_D = np.arccos((c**2 + e**2 - b**2) / (2 * c * e))
        return toward + at_B, toward + np.pi - at_D

    def kinematics(theta):
        """Angles, and two derivatives with respect to θ, from the closed loop a + b − c − base = 0."""
        p, r = angles(theta)
        # b sin p p′ − c sin r r′ = −a sin θ,   b cos p p′ − c cos r r′ = −a cos θ
        matrix = np.array([[b * np.sin(p), -c * np.sin(r)], [b * np.cos(p), -c * np.cos(r)]])
        p1, r1 = np.linalg.solve(matrix, [-a * np.sin(theta), -a * np.cos(theta)])
        right = [
            -a * np.cos(theta) - b * np.cos(p) * p1**2 + c * np.cos(r) * r1**2,
            a * np.sin(theta) + b * np.sin(p) * p1**2 - c * np.sin(r) * r1**2,
        ]
        p2, r2 = np.linalg.solve(matrix, right)
        return p, r, p1, r1, p2, r2

    def acceleration(theta, rate):
        p, r, p1, r1, p2, r2 = kinematics(theta)
        # The coupler's centre is at a e(θ) + b/2 e(p); |v|² = a² + b²/4 p′² + a b cos(θ − p) p′, times θ̇².
        cosine, sine = np.cos(theta - p), np.sin(theta - p)
        inertia = m1 * a**2 / 3 + m2 * (a**2 + b**2 * p1**2 / 3 + a * b * cosine * p1) + m3 * c**2 * r1**2 / 3
        half_slope = (
            m2 * (b**2 * p1 * p2 / 3 + 0.5 * a * b * (cosine * p2 - sine * (1 - p1) * p1)) + m3 * c**2 * r1 * r2 / 3
        )
        slope = g * (
            m1 * a / 2 * np.cos(theta) + m2 * (a * np.cos(theta) + b / 2 * np.cos(p) * p1) + m3 * c / 2 * np.cos(r) * r1
        )
        return -(half_slope * rate**2 + slope) / inertia

    def observe(theta, rate):
        p, r, p1, r1, _, _ = kinematics(theta)
        return np.array([theta, p, r, rate, p1 * rate, r1 * rate])

    return _solve(times, acceleration, observe, start, speed)


def slider_crank(
    times,
    *,
    crank=0.153,
    rod=0.306,
    masses=(0.038, 0.038, 0.076),
    inertias=(7.4e-5, 5.9e-4, 2.7e-6),
    start=0.0,
    speed=150.0,
    g=9.81,
):
    """Crank at the origin, slider on the x axis, mass centres in the middle.

    **Returns:** crank and rod angles [rad], slider position [m], and their rates, shape (times, 6).
    """
    a, b = crank, rod
    m1, m2, m3 = masses
    J1, J2, _ = inertias

    def kinematics(theta):
        """Rod angle φ and slider position x with first and second derivatives with respect to θ: b sin φ = −a sin θ."""
        s, c = np.sin(theta), np.cos(theta)
        phi = np.arcsin(-a * s / b)
        f1 = -a * c / (b * np.cos(phi))
        f2 = (a * s + b * np.sin(phi) * f1**2) / (b * np.cos(phi))
        x = a * c + b * np.cos(phi)
        x1 = -a * s - b * np.sin(phi) * f1
        x2 = -a * c - b * np.cos(phi) * f1**2 - b * np.sin(phi) * f2
        return phi, f1, f2, x, x1, x2

    def acceleration(theta, rate):
        phi, f1, f2, _, x1, x2 = kinematics(theta)
        s, c = np.sin(theta), np.cos(theta)
        # The rod's centre: x_m = a cos θ + b/2 cos φ, y_m = a/2 sin θ, since it is halfway down to the x axis.
        u1 = -a * s - b / 2 * np.sin(phi) * f1
        u2 = -a * c - b / 2 * np.cos(phi) * f1**2 - b / 2 * np.sin(phi) * f2
        inertia = J1 + m1 * a**2 / 4 + J2 * f1**2 + m2 * (u1**2 + (a / 2 * c) ** 2) + m3 * x1**2
        half_slope = J2 * f1 * f2 + m2 * (u1 * u2 - (a / 2) ** 2 * s * c) + m3 * x1 * x2
        slope = g * (m1 + m2) * a / 2 * c
        return -(half_slope * rate**2 + slope) / inertia

    def observe(theta, rate):
        phi, f1, _, x, x1, _ = kinematics(theta)
        return np.array([theta, phi, x, rate, f1 * rate, x1 * rate])

    return _solve(times, acceleration, observe, start, speed)


def n_four_bar(times, *, n=2, length=1.0, speed=1.0, g=9.81):
    """n + 1 upright bars and n level ones of equal mass and length, θ from upright: bars of the first kind turn about
    their ends, the others move as their ends do.

    **Returns:** place and velocity of the first tip, and θ̇, shape (times, 5).
    """
    turning, weight = (n + 1) / 3 + n, (n + 1) / 2 + n

    def observe(theta, rate):
        c, s = np.cos(theta), np.sin(theta)
        return np.array([length * s, length * c, length * c * rate, -length * s * rate, rate])

    acceleration = lambda theta, rate: weight * g * np.sin(theta) / (turning * length)
    return _solve(times, acceleration, observe, 0.0, speed / length)


def hanging_chain(times, *, n=5, length=1.0, mode=2, amplitude=0.1, g=9.81):
    """Equal masses on n rods of length/n, with angles φ from the downward vertical, at rest at first in the shape of a
    mode of small oscillations.

        Σ_k a_jk (cos(φ_j − φ_k) φ̈_k + sin(φ_j − φ_k) φ̇_k²) = −(n + 1 − j) g/l sin φ_j,   a_jk = n + 1 − max(j, k)

    **Returns:** place of the lowest mass, and angles, shape (times, 2 + n).
    """
    l = length / n
    below = n - np.arange(n)
    a = np.minimum(below[:, None], below)

    def right(t, y):
        angles, rates = y[:n], y[n:]
        between = angles[:, None] - angles
        force = -below * g / l * np.sin(angles) - (a * np.sin(between)) @ rates**2
        return np.concatenate([rates, np.linalg.solve(a * np.cos(between), force)])

    # Modes of small oscillations: of a φ̈ = −diag(below) g/l φ.
    squares, shapes = np.linalg.eig(np.linalg.solve(a, np.diag(below)))
    shape = shapes[:, np.argsort(squares)[mode - 1]]
    across = np.cumsum(shape)
    across *= np.sign(across[-1]) * amplitude / np.max(np.abs(across))
    start = np.arcsin(np.diff(across, prepend=0.0) / l)
    solution = solve_ivp(
        right,
        (0.0, times[-1]),
        np.concatenate([start, np.zeros(n)]),
        method="DOP853",
        t_eval=times,
        rtol=2.3e-14,
        atol=1e-14,
    )
    angles = solution.y[:n].T
    tip = l * np.stack([np.sin(angles).sum(axis=1), -np.cos(angles).sum(axis=1)], axis=1)
    return np.concatenate([tip, angles], axis=1)


def _solve(times, acceleration, observe, start, speed):
    solution = solve_ivp(
        lambda t, y: [y[1], acceleration(y[0], y[1])],
        (0.0, times[-1]),
        [start, speed],
        method="DOP853",
        t_eval=times,
        rtol=2.3e-14,
        atol=1e-14,
    )
    return np.array([observe(*y) for y in solution.y.T])
