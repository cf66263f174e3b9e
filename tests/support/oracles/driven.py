"""Machines with motors, controllers and tyres, as ordinary differential equations of their own: NumPy and SciPy."""

import numpy as np
from scipy.integrate import solve_ivp


def _solve(right, start, times):
    options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-14, "max_step": 0.01}
    return solve_ivp(right, (0.0, times[-1]), start, t_eval=times, **options).y.T


def cart_and_pole(times, gains, *, cart=2.0, pole=0.5, half=0.6, start=0.1, g=9.81):
    """Place and speed of the cart, angle of the pole from the vertical and its rate, and the integral of the place; the
    force on the cart is the sum of `gains` times these five.
    """
    inertia = pole * half**2 * 4 / 3

    def right(t, y):
        x, v, a, w, _ = y
        matrix = [[cart + pole, -pole * half * np.cos(a)], [-pole * half * np.cos(a), inertia]]
        force = np.dot(gains, y) - pole * half * np.sin(a) * w**2
        dv, dw = np.linalg.solve(matrix, [force, pole * g * half * np.sin(a)])
        return [v, dv, w, dw, x]

    return _solve(right, [0.0, 0.0, start, 0.0, 0.0], times)


def motor_of_four_bar(times, *, command, gain, lag, limit, angle=np.pi / 2, speed=4.0, g=9.81):
    """Crank's angle and rate and the motor's torque, of the library's four-bar with a motor that is to hold a speed."""
    lengths, masses, base = np.array([1.0, 3.0, 2.5]), np.array([1.0, 3.0, 2.5]), 2.5
    unit = lambda a: np.array([np.cos(a), np.sin(a)])
    across = lambda a: np.array([-np.sin(a), np.cos(a)])

    def right(t, y):
        a, w, torque = y
        l1, l2, l3 = lengths
        gap = np.array([base, 0.0]) - l1 * unit(a)
        d = np.hypot(*gap)
        b = np.arctan2(gap[1], gap[0]) + np.arccos((l2**2 + d**2 - l3**2) / (2 * l2 * d))
        tip = l1 * unit(a) + l2 * unit(b) - np.array([base, 0.0])
        c = np.arctan2(tip[1], tip[0])
        # l1 e(a) + l2 e(b) - l3 e(c) is constant: first and second derivative.
        loop = np.stack([l2 * across(b), -l3 * across(c)], axis=1)
        db, dc = np.linalg.solve(loop, -l1 * across(a))
        curved = l1 * unit(a) * w**2 + l2 * unit(b) * (db * w) ** 2 - l3 * unit(c) * (dc * w) ** 2
        ddb, ddc = np.linalg.solve(loop, curved)
        # The mass centres' velocities for a rate of one, and their accelerations without that of the crank.
        centres = [l1 / 2 * across(a), l1 * across(a) + l2 / 2 * across(b) * db, l3 / 2 * across(c) * dc]
        bias = [
            -l1 / 2 * unit(a) * w**2,
            -l1 * unit(a) * w**2 + l2 / 2 * (across(b) * ddb - unit(b) * (db * w) ** 2),
            l3 / 2 * (across(c) * ddc - unit(c) * (dc * w) ** 2),
        ]
        own = masses * lengths**2 / 12
        inertia = own @ np.array([1.0, db**2, dc**2]) + sum(m * v @ v for m, v in zip(masses, centres, strict=True))
        force = torque - own[1] * db * ddb - own[2] * dc * ddc
        for m, v, acceleration in zip(masses, centres, bias, strict=True):
            force += m * v @ (np.array([0.0, -g]) - acceleration)
        demand = gain * (command - w)
        return [w, force / inertia, (limit * np.tanh(demand / limit) - torque) / lag]

    return _solve(right, [angle, speed, 0.0], times)


CAR = {
    "mass": 900.0,
    "inertia": (220.0, 900.0, 1000.0),
    "wheel_mass": 18.0,
    "wheel_inertia": (0.5, 0.9, 0.5),
    "corners": ((1.2, 0.75, -0.2), (1.2, -0.75, -0.2), (-1.3, 0.75, -0.2), (-1.3, -0.75, -0.2)),
    "radius": 0.3,
    "stiffness": 2.0e5,
    "damping": 1.5e3,
    "coefficient": 0.9,
    "slip_stiffness": (20.0, 14.0),
    "relaxation": (0.1, 0.35),
    "transition_speed": 0.1,
    "smoothing": 5e-3,
    "damping_depth": 0.01,
    "bump": {"start": 3.0, "length": 1.5, "peak": 0.04},
}


def car(times, *, height, speed, turn, p=CAR, g=9.81):
    """Chassis and wheels on four tyres, without suspension, over a bump along x: position, velocity, Euler parameters
    and angular velocity of the chassis (body axes), spins of the wheels relative to it, deflections of the tyres.

    The wheels are symmetric about their axles, so the car is one rigid body with four rotors.
    """
    corners, R = np.array(p["corners"]), p["radius"]
    masses = np.array([p["mass"], *[p["wheel_mass"]] * 4])
    places = np.vstack([np.zeros(3), corners])
    centre = masses @ places / masses.sum()
    spread = lambda m, r: m * (r @ r * np.eye(3) - np.outer(r, r))
    whole = np.diag(p["inertia"]) + sum(spread(m, r - centre) for m, r in zip(masses, places, strict=True))
    whole = whole + 4 * np.diag(p["wheel_inertia"])
    axle, polar = np.array([0.0, 1.0, 0.0]), p["wheel_inertia"][1]

    def height_of(x):
        b = p["bump"]
        s = (x - b["start"]) / b["length"]
        s = np.where(np.real(s) <= 0, 0.0, np.where(np.real(s) >= 1, 1.0, s))
        return b["peak"] * np.sin(np.pi * s) ** 2, b["peak"] * np.pi / b["length"] * np.sin(2 * np.pi * s)

    def rotation(e):
        e0, v = e[0], e[1:]
        skew = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
        return (e0**2 - v @ v) * np.eye(3) + 2 * np.outer(v, v) + 2 * e0 * skew

    def depth_and_slope(hub, a):
        """The smoothed depth of the lowest point of a wheel, its derivatives by the hub's place and the axle.

        By a step along the imaginary axis in each of the six numbers at once.
        """
        step = 1e-30
        x = np.tile(np.concatenate([hub, a]).astype(complex), (6, 1)) + 1j * step * np.eye(6)
        hub, a = x[:, :3], x[:, 3:]
        dot = lambda x, y: np.sum(x * y, axis=1, keepdims=True)
        slope = height_of(hub[:, 0])[1]
        n = np.stack([-slope, np.zeros(6), np.ones(6)], axis=1) / np.sqrt(1 + slope**2)[:, None]
        up = n - dot(n, a) / dot(a, a) * a
        low = hub - R * up / np.sqrt(dot(up, up))
        h, own = height_of(low[:, 0])
        d = -(low[:, 2] - h) / np.sqrt(1 + own**2)
        depth = 0.5 * (d + np.sqrt(d * d + p["smoothing"] ** 2))
        return depth[0].real, depth[:3].imag / step, depth[3:].imag / step

    def right(t, y):
        r, v, e, w, spins, d = y[:3], y[3:6], y[6:10], y[10:13], y[13:17], y[17:].reshape(4, 2)
        A = rotation(e / np.linalg.norm(e))
        force, moment, torques, rates = masses.sum() * np.array([0, 0, -g]), np.zeros(3), np.zeros(4), np.zeros((4, 2))
        a = A @ axle
        for k in range(4):
            arm = corners[k] - centre
            hub, travel = r + A @ arm, v + A @ np.cross(w, arm)
            depth, by_hub, by_axle = depth_and_slope(hub, a)
            load = p["stiffness"] * depth
            slope = height_of(hub[0])[1]
            n = np.array([-slope, 0.0, 1.0]) / np.sqrt(1 + slope**2)
            # The forces of spring and damper along the normal: friction sees their sum, which never pulls.
            spring = load / (1 + (0.5 * p["smoothing"] / depth) ** 2)
            x = np.clip(depth / p["damping_depth"], 0.0, 1.0)
            damping = max(-p["damping"] * x**3 * (10 + x * (6 * x - 15)) * (travel @ n), -spring)
            up = n - (n @ a) * a
            low = -R * up / np.linalg.norm(up)
            forwards = np.cross(a, n)
            forwards = forwards / np.linalg.norm(forwards)
            along = np.stack([forwards, np.cross(n, forwards)])
            turning = A @ (w + spins[k] * axle)
            slip = along @ (travel + np.cross(turning, low))
            rolling = np.sqrt((forwards @ travel) ** 2 + p["transition_speed"] ** 2)
            rates[k] = -slip - rolling / np.array(p["relaxation"]) * d[k]
            s = np.array(p["slip_stiffness"]) * d[k] / (np.array(p["relaxation"]) * p["coefficient"])
            size = np.linalg.norm(s)
            limit = p["coefficient"] * (spring + damping)
            own = limit * (np.tanh(size) / size if size > 1e-6 else 1 - size**2 / 3) * s
            own = own @ along + damping * n
            elastic = -load * by_hub
            force = force + own + elastic
            # Moments about the hub in world axes: of the contact force, and of the load by the inclination of the axle.
            at_hub = np.cross(low, own) + np.cross(a, -load * by_axle)
            moment += A.T @ at_hub + np.cross(arm, A.T @ (own + elastic))
            torques[k] = at_hub @ a
        # Rotors: I_p (Ω̇ + ω̇·a) = torque; the rest: J ω̇ + Σ I_p Ω̇ a + ω × (J ω + Σ I_p Ω a) = moment.
        momentum = whole @ w + polar * spins.sum() * axle
        matrix = np.zeros((7, 7))
        matrix[:3, :3], matrix[:3, 3:] = whole, polar * np.outer(axle, np.ones(4))
        matrix[3:, :3], matrix[3:, 3:] = polar * np.outer(np.ones(4), axle), polar * np.eye(4)
        change = np.linalg.solve(matrix, [*(moment - np.cross(w, momentum)), *torques])
        e0, ev = e[0], e[1:]
        de = 0.5 * np.array([-ev @ w, *(e0 * w + np.cross(ev, w))])
        return np.concatenate([v, force / masses.sum(), de, change, rates.ravel()])

    place, velocity = np.array([0.0, 0.0, height]) + centre, np.array([speed, turn * centre[0], 0.0])
    start = [*place, *velocity, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, turn, *[speed / R] * 4, *[0.0] * 8]
    options = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-12, "max_step": 0.005}
    y = solve_ivp(right, (0.0, times[-1]), start, t_eval=times, **options).y.T
    # Of the chassis, not of the car's mass centre.
    A = np.stack([rotation(e / np.linalg.norm(e)) for e in y[:, 6:10]])
    y[:, :3] -= A @ centre
    y[:, 3:6] -= np.einsum("tij,tj->ti", A, np.cross(y[:, 10:13], centre))
    return y
