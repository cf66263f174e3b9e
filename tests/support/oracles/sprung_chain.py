"""A chain of rods with stiff springs at its hinges, by equations of its own: NumPy and SciPy only."""

import numpy as np
from scipy.integrate import solve_ivp


def sprung_chain(times, *, n, stiffness, damping, curl=0.0, start=0.3, length=1.0, mass=1.0, g=9.81):
    """Equal slender rods on pins, from the ground on, in their angles θ from the horizontal. With s_j the number of
    rods beyond rod j

        Σ_j a_ij (cos(θ_i − θ_j) θ̈_j + sin(θ_i − θ_j) θ̇_j²) = −(s_i + 1/2) g/l cos θ_i + (τ_i − τ_{i+1}) / (m l²),

    a_ii = s_i + 1/3, a_ij = a_ji = s_j + 1/2 for j > i, τ_i = −k (θ_i − θ_{i−1} − curl) − c (θ̇_i − θ̇_{i−1}), τ_1 = 0.
    At the start all springs are at rest.

    **Returns:** angles and rates, shape (times, 2 n).
    """
    beyond = n - 1.0 - np.arange(n)
    a = np.minimum(beyond[:, None], beyond) + 0.5
    a[np.diag_indices(n)] = beyond + 1 / 3

    def right(t, y):
        angles, rates = y[:n], y[n:]
        between = angles[:, None] - angles
        moment = np.zeros(n + 1)
        moment[1:n] = -stiffness * (np.diff(angles) - curl) - damping * np.diff(rates)
        load = (moment[:-1] - moment[1:]) / (mass * length**2)
        force = load - (beyond + 0.5) * g / length * np.cos(angles) - (a * np.sin(between)) @ rates**2
        return np.concatenate([rates, np.linalg.solve(a * np.cos(between), force)])

    y0 = np.concatenate([start + curl * np.arange(n), np.zeros(n)])
    return solve_ivp(right, (0.0, times[-1]), y0, method="Radau", t_eval=times, rtol=1e-11, atol=1e-12).y.T
