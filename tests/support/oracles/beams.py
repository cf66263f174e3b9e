"""The tip of a clamped beam under a dead load, from the differential equations of a geometrically exact beam.

With the position r, the axes R of the section and the moment m along the beam, in the world: `r′ = R Γ`, `R′ = R κ̃`,
`m′ = −r′ × F`, with `Γ = (1, 0, 0) + Rᵀ F / (EA, GA, GA)` and `κ = κ₀ + Rᵀ m / (GJ, EI, EI)`. The moment at the clamp
follows from zero moment at the tip.
"""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import root


def tip(length, extension, bending, force, curvature=(0.0, 0.0, 0.0), loads=5):
    """The position [m] of the tip and the direction of its x axis; the clamp is at the origin, in the world's axes."""
    force, moment = np.asarray(force, float), np.zeros(3)

    def along(s, values, load):
        axes, m = values[3:12].reshape(3, 3), values[12:]
        step = axes @ (np.eye(3)[0] + axes.T @ load / extension)
        turning = np.cross(axes, np.broadcast_to(curvature + axes.T @ m / bending, (3, 3)))
        return np.concatenate([step, turning.ravel(), -np.cross(step, load)])

    def end(moment, load):
        start = np.concatenate([np.zeros(3), np.eye(3).ravel(), moment])
        return solve_ivp(along, (0.0, length), start, args=(load,), method="DOP853", rtol=1e-11, atol=1e-13).y[:, -1]

    for share in np.arange(1, loads + 1) / loads:
        found = root(lambda m, load: end(m, load)[12:], moment, args=(share * force,), tol=1e-12)
        assert found.success
        moment = found.x
    out = end(moment, force)
    return out[:3], out[3:12].reshape(3, 3)[:, 0]
