"""Positions of suspensions from the geometry of their points: NumPy only. x forward, y to the left, z up.

A position is the place of the wheel's centre and the rotation of the carrier from its design position.
"""

import numpy as np

WISHBONE = {
    "lower_front": (0.14, 0.36, 0.24),
    "lower_rear": (-0.22, 0.36, 0.25),
    "lower_ball": (0.0, 0.74, 0.21),
    "upper_front": (0.11, 0.43, 0.51),
    "upper_rear": (-0.15, 0.43, 0.5),
    "upper_ball": (-0.02, 0.69, 0.53),
    "rack": (-0.12, 0.38, 0.29),
    "steering_arm": (-0.13, 0.7, 0.27),
    "wheel": (0.0, 0.78, 0.32),
    "spring_top": (0.0, 0.45, 0.62),
    "spring_bottom": (0.0, 0.6, 0.235),
}
FIVE_LINK = {
    "lower_front_inner": (0.16, 0.38, 0.22),
    "lower_front_outer": (0.05, 0.72, 0.2),
    "lower_rear_inner": (-0.14, 0.36, 0.23),
    "lower_rear_outer": (-0.05, 0.71, 0.2),
    "upper_front_inner": (0.12, 0.44, 0.5),
    "upper_front_outer": (0.03, 0.69, 0.52),
    "upper_rear_inner": (-0.18, 0.42, 0.48),
    "upper_rear_outer": (-0.04, 0.68, 0.51),
    "tie_rod_inner": (-0.2, 0.4, 0.28),
    "tie_rod_outer": (-0.15, 0.71, 0.26),
    "wheel": (0.0, 0.78, 0.32),
    "spring_top": (0.0, 0.48, 0.62),
    "spring_bottom": (0.0, 0.66, 0.25),
}
LINKS = ("lower_front", "lower_rear", "upper_front", "upper_rear", "tie_rod")


def unit(v):
    return v / np.linalg.norm(v)


def arrays(points):
    return {name: np.array(value, float) for name, value in points.items()}


def about(point, axis, angle, moved):
    """A point turned about an axis through another point (Rodrigues)."""
    r = moved - point
    turned = np.cos(angle) * r + np.sin(angle) * np.cross(axis, r) + (1 - np.cos(angle)) * axis * (axis @ r)
    return point + turned


def three_spheres(centres, radii, near):
    """The common point of three spheres nearer to another point."""
    first, second, third = centres
    x = unit(second - first)
    i, d = x @ (third - first), np.linalg.norm(second - first)
    y = unit(third - first - i * x)
    j = y @ (third - first)
    a = (radii[0] ** 2 - radii[1] ** 2 + d**2) / (2 * d)
    b = (radii[0] ** 2 - radii[2] ** 2 + i**2 + j**2 - 2 * i * a) / (2 * j)
    out = np.sqrt(radii[0] ** 2 - a**2 - b**2) * np.cross(x, y)
    both = [first + a * x + b * y + sign * out for sign in (1, -1)]
    return min(both, key=lambda point: np.linalg.norm(point - near))


def frame(origin, first, second):
    """Axes from three points, as columns."""
    x = unit(first - origin)
    z = unit(np.cross(x, second - origin))
    return np.stack([x, np.cross(z, x), z], axis=1)


def on_circle(point, axis, start, centre, radius, near):
    """The point of a circle about an axis, through `start`, at a distance `radius` from `centre`."""
    origin = point + axis * (axis @ (start - point))
    u = start - origin
    v = np.cross(axis, u)
    gap = origin - centre
    A, B = 2 * gap @ u, 2 * gap @ v
    C = radius**2 - gap @ gap - u @ u
    # A cos φ + B sin φ = C.
    middle, half = np.arctan2(B, A), np.arccos(C / np.hypot(A, B))
    both = [origin + np.cos(phi) * u + np.sin(phi) * v for phi in (middle + half, middle - half)]
    return min(both, key=lambda point: np.linalg.norm(point - near))


def wishbone_at(P, angle, rack):
    """The position for the angle of the lower arm, and the spring's length."""
    axes = {arm: unit(P[f"{arm}_front"] - P[f"{arm}_rear"]) for arm in ("lower", "upper")}
    low = about(P["lower_front"], axes["lower"], angle, P["lower_ball"])
    between = np.linalg.norm(P["upper_ball"] - P["lower_ball"])
    high = on_circle(P["upper_front"], axes["upper"], P["upper_ball"], low, between, P["upper_ball"])
    ends = [P["lower_ball"], P["upper_ball"], P["rack"]]
    radii = [np.linalg.norm(P["steering_arm"] - end) for end in ends]
    arm = three_spheres([low, high, P["rack"] + rack], radii, P["steering_arm"])
    built = frame(P["lower_ball"], P["upper_ball"], P["steering_arm"])
    R = frame(low, high, arm) @ built.T
    bottom = about(P["lower_front"], axes["lower"], angle, P["spring_bottom"])
    return low + R @ (P["wheel"] - P["lower_ball"]), R, np.linalg.norm(bottom - P["spring_top"])


def wishbone(points, travel, steer=0.0, direction=(0.0, 1.0, 0.0)):
    """The position for a travel of the wheel's centre and a displacement of the rack, by secants in the arm's angle;
    and the spring's length.
    """
    P, rack = arrays(points), steer * np.array(direction)
    gap = lambda angle: wishbone_at(P, angle, rack)[0][2] - P["wheel"][2] - travel
    before, now = 0.0, -0.01
    gaps = gap(before), gap(now)
    for _ in range(50):
        if gaps[1] == gaps[0] or abs(gaps[1]) < 1e-16:
            break
        before, now = now, now - gaps[1] * (now - before) / (gaps[1] - gaps[0])
        gaps = gaps[1], gap(now)
    return wishbone_at(P, now, rack)


def cayley(g):
    """The rotation by a vector of Rodrigues parameters, tan(angle/2) along the axis."""
    G = np.array([[0, -g[2], g[1]], [g[2], 0, -g[0]], [-g[1], g[0], 0]])
    return np.eye(3) + 2 / (1 + g @ g) * (G + G @ G)


def five_link(points, travel, steer=0.0, direction=(0.0, 1.0, 0.0)):
    """The position for a travel of the wheel's centre and a displacement of the tie rod's inner end, by Newton's method
    on the five distances; and the spring's length.
    """
    P = arrays(points)
    inner = np.array([P[f"{name}_inner"] for name in LINKS])
    outer = np.array([P[f"{name}_outer"] for name in LINKS]) - P["wheel"]
    squares = np.sum((outer + P["wheel"] - inner) ** 2, axis=1)
    inner[4] += steer * np.array(direction)

    def place(x):
        return P["wheel"] + np.array([x[0], x[1], travel]), cayley(x[2:])

    def unmet(x):
        centre, R = place(x)
        return np.sum((centre + outer @ R.T - inner) ** 2, axis=1) - squares

    x, tiny = np.zeros(5), 1e-30
    for _ in range(12):
        columns = [unmet(x + 1j * tiny * e).imag / tiny for e in np.eye(5)]
        x = x - np.linalg.solve(np.stack(columns, axis=1), unmet(x))
    centre, R = place(x)
    bottom = centre + R @ (P["spring_bottom"] - P["wheel"])
    return centre, R, np.linalg.norm(bottom - P["spring_top"])


def angles(centre, R, radius, side=1.0):
    """Toe, camber and contact patch of a wheel with its axle along y in design position."""
    axle = side * R[:, 1]
    down = axle[2] * axle - np.array([0.0, 0.0, 1.0])
    return np.arctan2(axle[0], side * axle[1]), -np.arcsin(axle[2]), centre + radius * unit(down)


def rigid_twist(position, step):
    """Velocity of the wheel's centre and angular velocity, from central differences of `position(s)` at s = 0."""
    (ahead, forward, _), (behind, backward, _), (_, R, _) = position(step), position(-step), position(0.0)
    turning = (forward - backward) @ R.T / (2 * step)
    return (ahead - behind) / (2 * step), np.array([turning[2, 1], turning[0, 2], turning[1, 0]])
