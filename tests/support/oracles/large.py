"""Trees, cables and nets of many bodies by equations of their own: NumPy and SciPy only."""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq


def tree(times, *, n, branching=2, spread=0.5, length=1.0, start=0.5, g=9.81):
    """Equal slender rods on pins, in their angles θ from the downward vertical. With s_j the number of rods below rod j

        Σ_j a_ij (cos(θ_i − θ_j) θ̈_j + sin(θ_i − θ_j) θ̇_j²) = −(s_i + 1/2) g/l sin θ_i,

    a_ii = s_i + 1/3, a_ij = a_ji = s_j + 1/2 for j below i, and zero if neither is below the other.

    **Returns:** place of the free end of the last rod, angles and rates, shape (times, 2 + 2 n).
    """
    parents = [None, *((k - 1) // branching for k in range(1, n))]

    def path(k):
        return [] if k is None else [*path(parents[k]), k]

    # One where a rod is the other or hangs from it, by however many between them.
    on_path = np.zeros((n, n))
    for k in range(n):
        on_path[k, path(k)] = 1.0
    below = on_path.sum(axis=0) - 1
    a = on_path.T * (below + 0.5) + on_path * (below[:, None] + 0.5)
    a[np.diag_indices(n)] = below + 1 / 3

    theta = np.empty(n)
    theta[0] = start
    for k in range(1, n):
        brothers = [j for j in range(1, n) if parents[j] == parents[k]]
        share = 2 * brothers.index(k) / (len(brothers) - 1) - 1 if len(brothers) > 1 else 0.0
        theta[k] = theta[parents[k]] + spread * share

    def right(t, y):
        angles, rates = y[:n], y[n:]
        between = angles[:, None] - angles
        force = -(below + 0.5) * g / length * np.sin(angles) - (a * np.sin(between)) @ rates**2
        return np.concatenate([rates, np.linalg.solve(a * np.cos(between), force)])

    y = _solve(right, np.concatenate([theta, np.zeros(n)]), times)
    tip = length * np.stack([np.sin(y[:, :n]) @ on_path[-1], -np.cos(y[:, :n]) @ on_path[-1]], axis=1)
    return np.concatenate([tip, y], axis=1)


def cable(times, *, n, length=1.0, span=0.8, mass=1.0, radius=0.01, swung=0.5, g=9.81):
    """Round rods on ball joints in their unit directions d, without spin, so that the mass matrix is constant:

        Σ_j M_ij d̈_j = f_i + λ_i d_i + l μ,   d_i·d̈_i = −ḋ_i·ḋ_i,   Σ_j d̈_j = 0.

    The shape at the start is that of a polygon inscribed in a circle whose chord is the span.

    **Returns:** places of the rods' ends from the second to the last, shape (times, n, 3), and the drift: how far the
    constraints are violated at the last time.
    """
    l, m = length / n, mass / n
    # Half the angle at the circle's centre over one rod: the chord over all of them is the span.
    half = brentq(lambda half: l * np.sin(n * half) / np.sin(half) - span, 1e-6, np.pi / n, xtol=1e-15)
    slope = (2 * np.arange(n) - n + 1) * half
    d0 = np.stack([np.cos(slope), -np.sin(slope) * np.sin(swung), np.sin(slope) * np.cos(swung)], axis=1)

    # Centres of mass are W d.
    W = l * (np.tri(n, k=-1) + 0.5 * np.eye(n))
    M = m * W.T @ W + m * (l**2 / 12 + radius**2 / 4) * np.eye(n)
    f = np.zeros((n, 3))
    f[:, 2] = -m * g * W.sum(axis=0)
    inverse = np.linalg.inv(M)
    free = inverse @ f

    def right(t, y):
        d, v = y.reshape(2, n, 3)
        A = np.zeros((n + 3, n, 3))
        A[np.arange(n), np.arange(n)] = d
        A[n + np.arange(3), :, np.arange(3)] = 1.0
        through = np.einsum("ij,rjx->rix", inverse, A)
        gamma = np.concatenate([-np.sum(v**2, axis=1), np.zeros(3)])
        multipliers = np.linalg.solve(np.einsum("rix,six->rs", A, through), gamma - np.einsum("rix,ix->r", A, free))
        return np.concatenate([v.ravel(), (free + np.einsum("r,rix->ix", multipliers, through)).ravel()])

    y = _solve(right, np.concatenate([d0.ravel(), np.zeros(3 * n)]), times)
    d = y[:, : 3 * n].reshape(-1, n, 3)
    ends = l * np.cumsum(d, axis=1)
    drift = max(
        np.max(np.abs(np.linalg.norm(d[-1], axis=1) - 1.0)),
        np.max(np.abs(ends[-1, -1] - [span, 0.0, 0.0])),
    )
    return ends, drift


def net(times, *, n, m, spacing=1.0, g=9.81):
    """Equal masses at a grid of places x with `|x_i − x_j| = spacing`, by the forces in the rods per mass and length:

        ẍ = g + Aᵀ λ,   A ẍ = −|v_i − v_j|²,   each row of A with x_i − x_j at i and its negative at j.

    **Returns:** places of the knots, shape (times, n, m, 3), and the drift: how far the constraints are violated at the
    last time.
    """
    place = np.zeros((n, m, 3))
    place[..., 0], place[..., 1] = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    place *= spacing
    number = np.arange(n * m).reshape(n, m)
    pairs = [*zip(number[1:].flat, number[:-1].flat, strict=True)]
    pairs += zip(number[:, 1:].flat, number[:, :-1].flat, strict=True)
    held = {number[0, 0]: place[0, 0] + [0, 0, spacing], number[-1, 0]: place[-1, 0] + [0, 0, spacing]}
    # Rows of signs, and what to add for the ends on the ground.
    signs, fixed = np.zeros((len(pairs) + 2, n * m)), np.zeros((len(pairs) + 2, 3))
    for r, (i, j) in enumerate(pairs):
        signs[r, i], signs[r, j] = 1.0, -1.0
    for r, (i, point) in enumerate(held.items(), start=len(pairs)):
        signs[r, i], fixed[r] = 1.0, -point
    weight = np.array([0.0, 0.0, -g])
    falling = signs @ np.tile(weight, (n * m, 1))
    common = signs @ signs.T

    def right(t, y):
        x, v = y.reshape(2, n * m, 3)
        rods, rates = signs @ x + fixed, signs @ v
        matrix = common * (rods @ rods.T)
        multipliers = np.linalg.solve(matrix, -np.sum(rates**2, axis=1) - np.sum(rods * falling, axis=1))
        return np.concatenate([v.ravel(), (weight + signs.T @ (multipliers[:, None] * rods)).ravel()])

    y = _solve(right, np.concatenate([place.ravel(), np.zeros(3 * n * m)]), times)
    x = y[:, : 3 * n * m].reshape(-1, n * m, 3)
    drift = np.max(np.abs(np.linalg.norm(signs @ x[-1] + fixed, axis=1) - spacing))
    return x.reshape(-1, n, m, 3), drift


def _solve(right, start, times):
    """States at the times, shape (times, states)."""
    return solve_ivp(right, (0.0, times[-1]), start, method="DOP853", t_eval=times, rtol=2.3e-14, atol=1e-14).y.T
