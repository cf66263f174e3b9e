"""A wheel with teeth that are discs, and a pawl whose tip is one, without restitution or friction: events by hand.

The angles of wheel and pawl are the coordinates, so that their inertias are constant. Which contacts push is found by
trying all combinations of those that touch.
"""

import itertools
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

# Gaps [m] and rates [m/s] that count as zero, and how far beyond that a force may pull.
_TOUCH, _REST, _PULL = 1e-9, 1e-9, 1e-10
# Where the tip falls between two teeth it strikes one and the other, ever faster: slower than this [m/s] it is at rest.
_SLOW = 1e-7


class Ratchet(NamedTuple):
    """**Fields:** the number of `teeth`, on a `pitch` circle [m], with their radius `tooth` [m]; the pin of the pawl at
    `pin` [m], its tip at a distance `length` [m] with the radius `tip` [m]; `inertias` of wheel and pawl about their
    pins [kg m²]; a moment of `drive` [N m] at a `frequency` [rad/s] and the `damping` [N m s] of the wheel; the
    `stiffness` [N m] of the pawl's spring, without moment at the angle `free`.
    """

    teeth: int = 8
    pitch: float = 0.2
    tooth: float = 0.06
    pin: tuple[float, float] = (-0.25, 0.25)
    length: float = 0.27
    tip: float = 0.02
    inertias: tuple[float, float] = (0.05, 0.004)
    drive: float = 1.0
    frequency: float = 4.0
    damping: float = 0.02
    stiffness: float = 2.0
    free: float = -0.7

    def moments(self, t, q, u):
        wheel = self.drive * np.cos(self.frequency * t) - self.damping * u[0]
        return np.array([wheel, -self.stiffness * (q[1] - self.free)])

    def centres(self, angle):
        """The centres of the teeth, and their derivatives by the angle."""
        at = angle + 2 * np.pi * np.arange(self.teeth) / self.teeth
        own = self.pitch * np.stack([np.cos(at), np.sin(at)], axis=1)
        return own, np.stack([-own[:, 1], own[:, 0]], axis=1)

    def gaps(self, q, u):
        """Gaps, their gradients, and their second derivatives without acceleration."""
        centres, along = self.centres(q[0])
        arm = self.length * np.array([np.cos(q[1]), np.sin(q[1])])
        turned = np.array([-arm[1], arm[0]])
        apart = np.array(self.pin) + arm - centres
        size = np.linalg.norm(apart, axis=1)
        normal = apart / size[:, None]
        rows = np.stack([-np.sum(normal * along, axis=1), normal @ turned], axis=1)
        relative = turned * u[1] - along * u[0]
        inward = -arm * u[1] ** 2 + centres * u[0] ** 2
        across = np.sum(relative**2, axis=1) - np.sum(normal * relative, axis=1) ** 2
        return size - self.tooth - self.tip, rows, np.sum(normal * inward, axis=1) + across / size


def _pushing(rows, free, inertias, among):
    """The contacts of those `among` which push so that no rate or acceleration is negative, with their impulses or
    forces; `free`: rates without them.
    """
    for count in range(min(len(among), 2) + 1):
        for chosen in itertools.combinations(among, count):
            own = rows[list(chosen)]
            weights = (own / inertias) @ own.T
            if count == 2 and np.linalg.det(weights) < 1e-8 * weights[0, 0] * weights[1, 1]:
                continue
            push = np.linalg.solve(weights, -free[list(chosen)]) if count else np.zeros(0)
            rates = free + (rows / inertias) @ (own.T @ push)
            if np.all(push >= -_PULL) and np.all(rates[among] >= -_REST):
                return list(chosen), push
    raise ArithmeticError("no combination of contacts pushes")


def moved(ratchet: Ratchet, q, u, end: float, rtol=1e-12):
    """Angles and rates at the time `end`, and the events: `(time, the contacts that are closed after it)`."""
    t, q, u, inertias = 0.0, np.array(q, float), np.array(u, float), np.array(ratchet.inertias)
    closed, events = [], []

    def forces(t, q, u, closed):
        _, rows, bent = ratchet.gaps(q, u)
        free = rows @ (ratchet.moments(t, q, u) / inertias) + bent
        own = rows[closed]
        push = np.linalg.solve((own / inertias) @ own.T, -free[closed]) if closed else np.zeros(0)
        return (ratchet.moments(t, q, u) + own.T @ push) / inertias, push

    while t < end:
        others = [k for k in range(ratchet.teeth) if k not in closed]
        field = lambda t, y, closed=closed: np.concatenate([y[2:], forces(t, y[:2], y[2:], closed)[0]])
        looks = [lambda t, y, k=k: ratchet.gaps(y[:2], y[2:])[0][k] for k in others]
        looks += [lambda t, y, k=k, own=closed: forces(t, y[:2], y[2:], own)[1][k] for k in range(len(closed))]
        for look in looks:
            look.terminal, look.direction = True, -1
        # The first steps are short, since a gap that has just opened may close again in one that is not.
        options = {"rtol": rtol, "atol": 1e-13, "first_step": min(1e-8, end - t), "max_step": 0.01}
        run = solve_ivp(field, (t, end), np.append(q, u), "DOP853", events=looks, **options)
        t, q, u = run.t[-1], run.y[:2, -1], run.y[2:, -1]
        if run.status != 1:
            break
        gap, rows, _ = ratchet.gaps(q, u)
        hit = next(k for k, times in enumerate(run.t_events) if times.size)
        struck = others[hit] if hit < len(others) else None
        touching = [k for k in range(ratchet.teeth) if k in closed or k == struck or gap[k] <= _TOUCH]
        if struck is not None:
            chosen, impulse = _pushing(rows, rows @ u, inertias, touching)
            u = u + rows[chosen].T @ impulse / inertias
        _, rows, bent = ratchet.gaps(q, u)
        # A contact whose force becomes zero opens; those that an impact parts are open.
        opens = closed[hit - len(others)] if struck is None else None
        may = [k for k in touching if abs(rows[k] @ u) <= _SLOW and k != opens]
        free = rows @ (ratchet.moments(t, q, u) / inertias) + bent
        closed, _ = _pushing(rows, free, inertias, may)
        own = rows[closed]
        u = u - own.T @ np.linalg.solve((own / inertias) @ own.T, own @ u) / inertias if closed else u
        events.append((t, tuple(closed)))
    return q, u, events
