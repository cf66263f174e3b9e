"""Forces of a four-bar linkage of uniform bars with a given motion, by Newton and Euler for each bar."""

import numpy as np


def angles(lengths, base, crank):
    """Angles of the coupler and the rocker from the x axis, where the two meet above the line to the rocker's pivot."""
    a, b, c = lengths
    across = base - a * np.exp(1j * crank)
    size = abs(across)
    start = np.angle(across) + np.arccos((b**2 + size**2 - c**2) / (2 * b * size))
    return start, np.angle(a * np.exp(1j * crank) + b * np.exp(1j * start) - base)


def motion(lengths, base, angle, rate, acceleration):
    """Angles, rates and accelerations of the three bars, and accelerations of their centres, complex."""
    a, b, c = lengths
    phi, psi = angles(lengths, base, angle)
    units = np.exp(1j * np.array([angle, phi, psi]))
    solve = lambda right: np.linalg.solve(
        [[(b * 1j * units[1]).real, -(c * 1j * units[2]).real], [(b * 1j * units[1]).imag, -(c * 1j * units[2]).imag]],
        [right.real, right.imag],
    )
    rates = np.array([rate, *solve(-a * 1j * rate * units[0])])
    centripetal = -(rates**2) * units
    rest = a * (1j * acceleration * units[0] + centripetal[0]) + b * centripetal[1] - c * centripetal[2]
    accelerations = np.array([acceleration, *solve(-rest)])
    changes = 1j * accelerations * units + centripetal
    centres = np.array([a * changes[0] / 2, a * changes[0] + b * changes[1] / 2, c * changes[2] / 2])
    return np.array([angle, phi, psi]), rates, accelerations, centres


def forces(lengths, base, masses, gravity, angle, rate, acceleration, driven="crank"):
    """The torque on a bar with a pivot, and the forces at A on the crank, at B on the coupler, at C on the rocker and
    at D on the rocker, shape (4, 2).
    """
    lengths, masses = np.array(lengths), np.array(masses)
    turned, _, alpha, centres = motion(lengths, base, angle, rate, acceleration)
    arms = lengths[:, None] / 2 * np.stack([np.cos(turned), np.sin(turned)], axis=1)
    matrix, right = np.zeros((9, 9)), np.zeros(9)
    # Each pin: the bars that its force acts on, with signs, and the ends where it acts.
    acts = [[(0, 1, -1)], [(1, 1, -1), (0, -1, 1)], [(2, 1, 1), (1, -1, 1)], [(2, 1, -1)]]
    for pin, on_bars in enumerate(acts):
        for bar, sign, end in on_bars:
            x, y = end * arms[bar]
            matrix[3 * bar, 2 * pin] += sign
            matrix[3 * bar + 1, 2 * pin + 1] += sign
            matrix[3 * bar + 2, 2 * pin : 2 * pin + 2] += sign * np.array([-y, x])
    matrix[{"crank": 2, "rocker": 8}[driven], 8] = 1
    for bar in range(3):
        right[3 * bar] = masses[bar] * centres[bar].real
        right[3 * bar + 1] = masses[bar] * (centres[bar].imag + gravity)
        right[3 * bar + 2] = masses[bar] * lengths[bar] ** 2 / 12 * alpha[bar]
    solution = np.linalg.solve(matrix, right)
    return solution[8], solution[:8].reshape(4, 2)
