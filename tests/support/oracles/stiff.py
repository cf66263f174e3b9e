"""Mechanisms with stiff springs and dampers in minimal coordinates, with equations of their own: NumPy only.

Each model gives accelerations `q̈(q, q̇)` and observed values; `motion` integrates it.
"""

import dataclasses
from collections.abc import Callable

import numpy as np


@dataclasses.dataclass(frozen=True)
class Model:
    """Start `q`, `rates`, accelerations and observed values of a mechanism, in numbers of one type."""

    q: np.ndarray
    rates: np.ndarray
    acceleration: Callable[[np.ndarray, np.ndarray], np.ndarray]
    observe: Callable[[np.ndarray, np.ndarray], np.ndarray]


def four_bar(
    *,
    lengths=(1.0, 3.0, 2.5),
    base=2.5,
    masses=(1.0, 3.0, 2.5),
    start=np.pi / 2,
    speed=4.0,
    g=9.81,
    stiffness=1e8,
    damping=1e2,
    number=np.longdouble,
):
    """Crank A→B, coupler B→C and rocker D→C as an open chain of three uniform bars that a spring and a damper hold to
    the ground pivot D = (base, 0); absolute angles φ.

    With `e(φ)` along and `n(φ)` across a bar, mass centres are at `Σ_j L_ij e(φ_j)` and the end of the chain is at
    `Σ_j l_j e(φ_j)`, l = (a, b, −c). Lagrange's equations are

        Σ_k W_jk cos(φ_j − φ_k) φ̈_k + J_j φ̈_j = −Σ_k W_jk sin(φ_j − φ_k) φ̇_k² − g cos φ_j Σ_i m_i L_ij + l_j n_j·F

    with `W = Lᵀ diag(m) L` and `F = −stiffness δ − damping δ̇`, δ the displacement of the end from D.

    **Observed:** crank, coupler and rocker angles [rad], their rates [rad/s], and δ [m], shape (8,).
    """
    a, b, c = (number(l) for l in lengths)
    m, ends = np.array(masses, number), np.array([a, b, -c])
    base, g, stiffness, damping = (number(x) for x in (base, g, stiffness, damping))
    levers = np.array([[a / 2, 0, 0], [a, b / 2, 0], [a, b, -c / 2]], number)
    W = (levers.T * m) @ levers
    J = np.diag(m * ends**2) / 12
    weight = g * (m @ levers)

    def displacement(phi):
        return ends @ np.cos(phi) - base, ends @ np.sin(phi)

    def acceleration(phi, rate):
        cosine, sine = np.cos(phi), np.sin(phi)
        x, y = displacement(phi)
        across = ends * rate
        fx = -stiffness * x + damping * (across @ sine)
        fy = -stiffness * y - damping * (across @ cosine)
        between = cosine[:, None] * cosine + sine[:, None] * sine
        turned = sine[:, None] * cosine - cosine[:, None] * sine
        right = -(W * turned) @ rate**2 - weight * cosine + ends * (fy * cosine - fx * sine)
        return _solve3(W * between + J, right)

    def observe(phi, rate):
        return np.array([*phi, *rate, *displacement(phi)])

    # The rigid linkage: the triangle B, C, D, and rates from a θ̇ n(θ) + b ṗ n(p) − c ṙ n(r) = 0.
    theta, speed = number(start), number(speed)
    dx, dy = base - a * np.cos(theta), -a * np.sin(theta)
    e = np.hypot(dx, dy)
    toward, half_turn = np.arctan2(dy, dx), np.arccos(number(-1))
    p = toward + np.arccos((b**2 + e**2 - c**2) / (2 * b * e))
    r = toward + half_turn - np.arccos((c**2 + e**2 - b**2) / (2 * c * e))
    p1 = a * speed * np.sin(r - theta) / (b * np.sin(p - r))
    r1 = a * speed * np.sin(p - theta) / (c * np.sin(p - r))
    return Model(np.array([theta, p, r]), np.array([speed, p1, r1]), acceleration, observe)


def _solve3(matrix, right):
    """Solution of three symmetric equations by elimination, in any type of number."""
    (a, b, c), (_, d, e), (_, _, f) = matrix
    x, y, z = right
    m, n = b / a, c / a
    d, e, f = d - m * b, e - m * c, f - n * c
    y, z = y - m * x, z - n * x
    k = e / d
    z = (z - k * y) / (f - k * e)
    y = (y - e * z) / d
    return np.array([(x - b * y - c * z) / a, y, z])


def flyball(
    *,
    height=1.0,
    offset=0.05,
    length=1.0,
    section=0.01,
    cube=0.1,
    density=3000.0,
    ball=5.0,
    start=np.pi / 6,
    speed=2 * np.pi,
    g=9.81,
    stiffness=8e5,
    damping=4e4,
    number=np.longdouble,
):
    """A vertical shaft with two hinged arms, rods with balls at their ends, and a sliding cube that springs and dampers
    join to the rods' midpoints; coordinates ψ, α₁, α₂, s: turn of the shaft, angles of the arms below the horizontal,
    height of the cube.

        T = ½ (I₀ + I(α₁) + I(α₂)) ψ̇² + ½ J (α̇₁² + α̇₂²) + ½ m ṡ²
        I(α) = J_x sin² α + J_z cos² α + m_r (d + l/2 cos α)² + m_b (d + l cos α)²

    **Observed:** ψ, α₁, s, ψ̇, α̇₁, ṡ, shape (6,).
    """
    height, offset, l, w, cube, density, ball, g, stiffness, damping = (
        number(x) for x in (height, offset, length, section, cube, density, ball, g, stiffness, damping)
    )
    shaft, rod, slider = density * height * w**2, density * l * w**2, density * cube**3
    fixed = shaft * w**2 / 6 + slider * cube**2 / 6
    along, across = rod * w**2 / 6, rod * (l**2 + w**2) / 12
    hinge = across + rod * l**2 / 4 + ball * l**2
    free = l / 2

    def acceleration(q, rate):
        alpha, s = q[1:3], q[3]
        omega, turn = rate[0], rate[1:3]
        cosine, sine = np.cos(alpha), np.sin(alpha)
        about = along * sine**2 + across * cosine**2 + rod * (offset + l / 2 * cosine) ** 2
        about = about + ball * (offset + l * cosine) ** 2
        slope = 2 * (along - across) * sine * cosine - rod * l * sine * (offset + l / 2 * cosine)
        slope = slope - 2 * ball * l * sine * (offset + l * cosine)
        # Spring from (d, s) to (d + l/2 cos α, h − l/2 sin α), length f; ∂f/∂α and ∂f/∂s.
        x, z = l / 2 * cosine, height - l / 2 * sine - s
        f = np.sqrt(x**2 + z**2)
        by_alpha, by_s = (-x * l / 2 * sine - z * l / 2 * cosine) / f, -z / f
        tension = stiffness * (f - free) + damping * (by_alpha * turn + by_s * rate[3])
        gravity = g * (rod / 2 + ball) * l * cosine
        turning = -omega * np.sum(slope * turn) / (fixed + np.sum(about))
        arms = (slope * omega**2 / 2 + gravity - tension * by_alpha) / hinge
        return np.array([turning, *arms, -g - np.sum(tension * by_s) / slider])

    def observe(q, rate):
        return np.array([q[0], q[1], q[3], rate[0], rate[1], rate[3]])

    alpha, zero = number(start), number(0)
    q = np.array([zero, alpha, alpha, height - l * np.sin(alpha)])
    return Model(q, np.array([number(speed), zero, zero, zero]), acceleration, observe)


def motion(model, times, *, step, columns=10):
    """Observed values at `times` by Gragg's extrapolation of order `2 columns`, with steps of about one size [s]; in
    the type of number of the model.
    """
    n = model.q.size
    right = lambda y: np.concatenate([y[n:], model.acceleration(y[:n], y[n:])])
    y = np.concatenate([model.q, model.rates])
    out, t = [], y.dtype.type(0)
    for end in np.asarray(times, y.dtype):
        count = max(1, round(float((end - t) / step)))
        for _ in range(count):
            y = _extrapolated(right, y, (end - t) / count, columns)
        out.append(model.observe(y[:n], y[n:]))
        t = end
    return np.array(out)


def _extrapolated(right, y, step, columns):
    """One step: the midpoint rule with 2, 4, 6, … parts, whose error is even in their size."""
    first = right(y)
    row = []
    for k in range(1, columns + 1):
        h = step / (2 * k)
        before, now = y, y + h * first
        for _ in range(2 * k - 1):
            before, now = now, before + 2 * h * right(now)
        last = row
        row = [now]
        for j, value in enumerate(last, start=1):
            ratio = (now.dtype.type(k) / (k - j)) ** 2
            row.append(row[-1] + (row[-1] - value) / (ratio - 1))
    return row[-1]
