"""Mechanisms of space with one degree of freedom, from where their bodies are: NumPy and SciPy only.

Where positions `r(q)` and rotations `R(q)` of all bodies are known in closed form, in functions that are analytic, a
step along the imaginary axis gives their derivatives to rounding, and with them

    T = ½ I(q) q̇²,   I = Σ m r′·r′ + w·J w,   w̃ = Rᵀ R′,   V = −Σ m g·r + …
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp

from . import suspensions

X, Y, Z = np.eye(3)
_TINY = 1e-30


@dataclasses.dataclass(frozen=True)
class Linkage:
    """Bodies with `masses` and `inertias` in their own axes, placed by `poses(q)`: r, shape (bodies, 3), and R, shape
    (bodies, 3, 3); `gravity`, the vector; `stored(q)`, potential energy other than of weight.
    """

    masses: np.ndarray
    inertias: np.ndarray
    poses: Callable[[complex], tuple[np.ndarray, np.ndarray]]
    gravity: np.ndarray
    stored: Callable[[complex], complex] = lambda q: 0.0 * q

    def rates(self, q):
        """`r′`, shape (bodies, 3), and w in the bodies' axes."""
        r, R = self.poses(q + 1j * _TINY)
        turning = np.einsum("kji,kjl->kil", R.real, R.imag) / _TINY
        return r.imag / _TINY, np.stack([turning[:, 2, 1], turning[:, 0, 2], turning[:, 1, 0]], axis=1)

    def inertia(self, q):
        v, w = self.rates(q)
        return self.masses @ np.sum(v * v, axis=1) + np.einsum("ki,kij,kj->", w, self.inertias, w)

    def potential(self, q):
        return self.stored(q) - self.masses @ (self.poses(q)[0] @ self.gravity)

    def turned(self, times, start, speed, *, torque=0.0):
        """Coordinate and rate, shape (times, 2), of a motion that does not turn back, from its energy alone; `torque`,
        constant, does work on q.
        """
        energy = 0.5 * self.inertia(start) * speed**2 + self.potential(start) - torque * start

        def rate(t, q):
            return np.sqrt(2 * (energy + torque * q[0] - self.potential(q[0])) / self.inertia(q[0]))[None]

        q = _solve(rate, [start], times)[0]
        return np.stack([q, np.array([rate(0.0, x[None])[0] for x in q])], axis=1)

    def swung(self, times, start, speed, *, damping, span):
        """Coordinate and rate, shape (times, 2), of a motion within `span`, where I is interpolated for its derivative;
        `damping(q)`, force for a rate of one.
        """
        slope = np.polynomial.Chebyshev.interpolate(np.vectorize(self.inertia), 40, span).deriv()

        def right(t, y):
            q, rate = y
            force = -self.potential(q + 1j * _TINY).imag / _TINY - damping(q) * rate
            return [rate, (force - 0.5 * slope(q) * rate**2) / self.inertia(q)]

        return _solve(right, [start, speed], times).T


def _solve(right, start, times):
    return solve_ivp(right, (0.0, times[-1]), start, method="DOP853", t_eval=times, rtol=3e-14, atol=1e-14).y


def unit(v):
    """A vector divided by its length, analytic in its components."""
    return v / np.sqrt(np.sum(v * v))


def triad(first, second):
    """Axes along `first`, along `second` across that, and across both, as columns."""
    x = unit(first)
    z = unit(np.cross(x, second))
    return np.stack([x, np.cross(z, x), z], axis=1)


def turn(axis, c, s):
    """Rotation about a unit axis, from cosine and sine of its angle."""
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + s * skew + (1 - c) * skew @ skew


def rod_inertia(mass, length, radius):
    """Of a round rod along x."""
    return mass * np.diag([radius**2 / 2, *[(3 * radius**2 + length**2) / 12] * 2])


def swash_plate(times, *, pistons=3, radius=0.2, rod=0.5, tilt=np.pi / 9, speed=20 * np.pi, g=9.81):
    """Shaft along x, plate, rods and pistons of the compressor, z up.

    **Returns:** cosine and sine of the shaft's angle, its rate, place and velocity of every piston, shape
    (times, 3 + 2 pistons).
    """
    angles = 2 * np.pi * np.arange(pistons) / pistons
    cylinders = radius * np.stack([np.zeros(pistons), np.cos(angles), np.sin(angles)], axis=1)
    tangents = np.stack([np.zeros(pistons), -np.sin(angles), np.cos(angles)], axis=1)

    def poses(theta):
        c, s = np.cos(theta), np.sin(theta)
        journal = np.array([np.cos(tilt) + 0 * c, np.sin(tilt) * c, np.sin(tilt) * s])
        plate = triad(journal, np.cross(Z, journal))
        pins = cylinders @ plate.T
        across = (pins - cylinders) * (1 - X)
        heads = cylinders + (pins[:, :1] + np.sqrt(rod**2 - np.sum(across**2, axis=1))[:, None]) * X
        along = [unit(head - pin) for head, pin in zip(heads, pins, strict=True)]
        rods = [triad(e, np.cross(e, tangent)) for e, tangent in zip(along, tangents, strict=True)]
        still = np.tile(np.eye(3) + 0 * c, (pistons, 1, 1))
        shaft = turn(X, c, s)
        origin = np.zeros((2, 3)) + 0 * c
        return np.concatenate([origin, (pins + heads) / 2, heads]), np.concatenate([[shaft, plate], rods, still])

    plate = 3.0 * radius**2 * np.diag([1 / 2, 1 / 4, 1 / 4])
    order = [0, 1, *[2] * pistons, *[3] * pistons]
    inertias = np.array([0.03 * np.eye(3), plate, rod_inertia(0.5, rod, rod / 50), np.eye(3)])
    linkage = Linkage(np.array([4.0, 3.0, 0.5, 0.8])[order], inertias[order], poses, -g * Z)
    out = []
    for theta, omega in linkage.turned(times, 0.0, speed):
        x, v = poses(theta)[0][2 + pistons :, 0], linkage.rates(theta)[0][2 + pistons :, 0] * omega
        out.append([np.cos(theta), np.sin(theta), omega, *np.stack([x, v], axis=1).ravel()])
    return np.array(out)


def bennett(times, *, lengths=(0.3, 0.5), twist=70.0, masses=(0.6, 1.0, 0.6), start=1.0, speed=8.0, g=9.81):
    """Links a, b, a between the axes z at 0 and (0, sin β, cos β) at (−b, 0, 0); gravity along −y. By the condition of
    Bennett, b sin α = a sin β, and his relation of input θ and output φ

        tan(θ/2) tan(φ/2) = sin((α + β)/2) / sin((β − α)/2).

    **Returns:** cosine and sine of both angles and the rate of the input, shape (times, 5).
    """
    a, b = lengths
    alpha, beta = np.arcsin(a * np.sin(np.radians(twist)) / b), np.radians(twist)
    ratio = np.sin((alpha + beta) / 2) / np.sin((beta - alpha) / 2)

    def output(theta):
        c, s = np.cos(theta), np.sin(theta)
        size = 1 - c + ratio**2 * (1 + c)
        return (1 - c - ratio**2 * (1 + c)) / size, 2 * ratio * s / size

    def poses(theta):
        c, s = np.cos(theta), np.sin(theta)
        cosine, sine = output(theta)
        first = turn(Z, c, s)
        second = first @ turn(X, np.cos(alpha), np.sin(alpha)) @ turn(Z, cosine, sine)
        third = second @ turn(X, np.cos(beta), np.sin(beta)) @ turn(Z, c, -s)
        frames = np.stack([first, second, third])
        links = np.array([a, b, a])[:, None] * frames[:, :, 0]
        return np.cumsum(links, axis=0) - links / 2, frames

    inertias = np.array([rod_inertia(m, l, 0.02) for m, l in zip(masses, (a, b, a), strict=True)])
    linkage = Linkage(np.array(masses), inertias, poses, -g * Y)
    motion = linkage.turned(times, start, speed)
    return np.array([[np.cos(q), np.sin(q), *output(q), rate] for q, rate in motion])


def double_wishbone(times, *, masses=(4.0, 3.0, 30.0), stiffness=4e4, damping=1.5e3, tyre=2e5, speed=2.0, g=9.81):
    """Lower arm, upper arm and upright of a left wheel, by the angle of the lower arm: x forward, y to the left, z up.

    The upper ball is where the upper arm brings it to its distance from the lower one, the steering arm's end where
    its distances from the balls and from the rack are what they were.

    **Returns:** travel of the wheel's centre up and outward, camber, toe, and rate of travel, shape (times, 5).
    """
    front, rear = (
        np.array([[0.14, 0.36, 0.24], [0.11, 0.43, 0.51]]),
        np.array([[-0.22, 0.36, 0.25], [-0.15, 0.43, 0.5]]),
    )
    balls = np.array([[0.0, 0.74, 0.21], [-0.02, 0.69, 0.53]])
    rack, end, wheel = np.array([[-0.12, 0.38, 0.29], [-0.13, 0.7, 0.27], [0.0, 0.78, 0.32]])
    top, bottom = np.array([[0.0, 0.45, 0.62], [0.0, 0.6, 0.235]])
    centres = (front + rear + balls) / 3
    axes = [unit(f - r) for f, r in zip(front, rear, strict=True)]
    square = lambda v: v @ v

    def arms(q):
        """Rotations of both, and their balls."""
        lower = turn(axes[0], np.cos(q), np.sin(q))
        low = front[0] + lower @ (balls[0] - front[0])
        # |P + cos φ u + sin φ v − low| = distance: A cos φ + B sin φ = C.
        arm = balls[1] - front[1]
        along = (arm @ axes[1]) * axes[1]
        u, v = arm - along, np.cross(axes[1], arm)
        gap = front[1] + along - low
        A, B = 2 * gap @ u, 2 * gap @ v
        C = square(balls[1] - balls[0]) - square(gap) - square(u)
        root = np.sign(B.real) * np.sqrt(A**2 + B**2 - C**2)
        upper = turn(axes[1], (A * C + B * root) / (A**2 + B**2), (B * C - A * root) / (A**2 + B**2))
        return lower, upper, low, front[1] + upper @ arm

    def steered(low, high):
        """The end of the steering arm, from three distances; of two such points that on the side it was built on."""
        x = unit(high - low)
        d = np.sqrt(square(high - low))
        to_rack = rack - low
        i = x @ to_rack
        y = unit(to_rack - i * x)
        j = y @ to_rack
        far, middle = square(end - balls[0]), square(end - balls[1])
        a = (far - middle + d**2) / (2 * d)
        b = (far - square(end - rack) + i**2 + j**2 - 2 * i * a) / (2 * j)
        return low + a * x + b * y + side * np.sqrt(far - a**2 - b**2) * np.cross(x, y)

    side = 1.0
    side = 1.0 if np.allclose(steered(*balls), end) else -1.0
    built = triad(balls[1] - balls[0], end - balls[0])

    def poses(q):
        lower, upper, low, high = arms(q)
        upright = triad(high - low, steered(low, high) - low) @ built.T
        places = [front[0] + lower @ (centres[0] - front[0]), front[1] + upper @ (centres[1] - front[1])]
        return np.array([*places, low + upright @ (wheel - balls[0])]), np.array([lower, upper, upright])

    def length(q):
        return np.sqrt(square(front[0] + turn(axes[0], np.cos(q), np.sin(q)) @ (bottom - front[0]) - top))

    free = np.sqrt(square(bottom - top))
    stored = lambda q: stiffness * (length(q) - free) ** 2 / 2 + tyre * (poses(q)[0][2, 2] - wheel[2]) ** 2 / 2
    plates = [m / 12 * np.diag([0.0909, 0.0909, 0.18]) for m in masses[:2]]
    inertias = np.array(
        [*plates, masses[2] * np.diag([0.3**2 / 4 + 0.2**2 / 12, 0.3**2 / 2, 0.3**2 / 4 + 0.2**2 / 12])]
    )
    linkage = Linkage(np.array(masses), inertias, poses, -g * Z, stored)
    resistance = lambda q: damping * (length(q + 1j * _TINY).imag / _TINY) ** 2
    rise = lambda q: linkage.rates(q)[0][2, 2]
    out = []
    for q, rate in linkage.swung(times, 0.0, speed / rise(0.0), damping=resistance, span=(-0.15, 0.15)):
        r, R = poses(q)
        x, y, z = R[2][:, 1]
        out.append([*(r[2] - wheel)[[2, 1]], -np.arcsin(z), np.arctan2(x, y), rise(q) * rate])
    return np.array(out)


def five_link(times, *, masses=(16.0, 18.0), stiffness=4e4, damping=1.5e3, tyre=2e5, speed=2.0, g=9.81):
    """Carrier and wheel of a left wheel on five rods, by the height of the wheel's centre: x forward, y to the left.

    The wheel spins freely and does not at the start, so its moment of momentum about the axle stays zero: its moment of
    inertia there counts as zero. Positions between nodes follow from polynomials in the height.

    **Returns:** travel of the wheel's centre up and outward, camber, toe, and rate of travel, shape (times, 5).
    """
    points, span = suspensions.arrays(suspensions.FIVE_LINK), 0.05
    nodes = np.cos(np.pi * (np.arange(40) + 0.5) / 40)
    at_nodes = [suspensions.five_link(points, span * x) for x in nodes]
    values = [np.concatenate([r, _rodrigues(R)]) for r, R, _ in at_nodes]
    fitted = np.polynomial.chebyshev.chebfit(nodes, np.array(values), 24)

    def position(q):
        x = np.polynomial.chebyshev.chebval(q / span, fitted)
        return x[:3], suspensions.cayley(x[3:])

    def poses(q):
        r, R = position(q)
        return np.stack([r, r]), np.stack([R, R])

    def length(q):
        r, R = position(q)
        arm = r + R @ (points["spring_bottom"] - points["wheel"]) - points["spring_top"]
        return np.sqrt(arm @ arm)

    free = np.sqrt(np.sum((points["spring_bottom"] - points["spring_top"]) ** 2))
    stored = lambda q: stiffness * (length(q) - free) ** 2 / 2 + tyre * q**2 / 2
    a, b, c = 0.2, 0.1, 0.4
    box = masses[0] / 12 * np.diag([b**2 + c**2, a**2 + c**2, a**2 + b**2])
    across = masses[1] * (0.3**2 / 4 + 0.2**2 / 12)
    inertias = np.array([box, np.diag([across, 0.0, across])])
    linkage = Linkage(np.array(masses), inertias, poses, -g * Z, stored)
    resistance = lambda q: damping * (length(q + 1j * _TINY).imag / _TINY) ** 2
    out = []
    for q, rate in linkage.swung(times, 0.0, speed, damping=resistance, span=(-0.045, 0.045)):
        r, R = position(q)
        x, y, z = R[:, 1]
        out.append([q, r[1] - points["wheel"][1], -np.arcsin(z), np.arctan2(x, y), rate])
    return np.array(out)


def _rodrigues(R):
    """tan(angle/2) along the axis of a rotation."""
    skew = (R - R.T) / (1 + np.trace(R))
    return np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
