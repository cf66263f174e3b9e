"""The mechanisms of the test set for initial value problem solvers: their end values, systems, and equations in the
coordinates of the test set.

Source: F. Mazzia and C. Magherini, "Test Set for Initial Value Problem Solvers", Bari 2008.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import fekete_problem as fekete
import jax
import jax.numpy as jnp
import numpy as np
import wheelset_problem as wheelset
from jaxtyping import Array
from radau5 import Equations, Run

import jaxmb as mb
from jaxmb.mechanisms import Mechanism


class Problem(NamedTuple):
    """A motion and the components of its end that count.

    `build()` returns a system with a state; `end(trajectory)` and `end_of(run)` are the components, of jaxmb and of a
    solver of the `equations`; `published` and `exact` their values, `exact` the better ones, good to the relative
    error `accuracy`.
    """

    title: str
    t1: float
    build: Callable[[], tuple[mb.system.AbstractSystem, mb.State]]
    end: Callable[[mb.Trajectory], Array]
    equations: Equations
    end_of: Callable[[Run], np.ndarray]
    published: np.ndarray
    exact: np.ndarray
    accuracy: float


def scd(found: Array, published: np.ndarray) -> float:
    """The number of correct digits of the worst component."""
    return float(-np.log10(relative(found, published)))


def relative(found: Array, known: np.ndarray) -> float:
    """The largest relative error of a component."""
    return float(np.max(np.abs(np.asarray(found) / known - 1)))


# Andrews' squeezing mechanism, in the seven angles of the source; bodies are given in `jaxmb.mechanisms.andrews`.

_ANGLES = ("beta", "Theta", "gamma", "Phi", "delta", "Omega", "epsilon")
_MASSES = np.array([0.04325, 0.00365, 0.02373, 0.00706, 0.07050, 0.00706, 0.05498])
_INERTIAS = np.array([2.194e-6, 4.410e-7, 5.255e-6, 5.667e-7, 1.169e-5, 5.667e-7, 1.912e-5])
_A, _B, _C = np.array([-0.06934, -0.00227]), np.array([-0.03635, 0.03273]), np.array([0.014, 0.072])
_ANDREWS_START = np.array(
    [
        -0.0617138900142764496,
        0.0,
        0.455279819163070380,
        0.222668390165885885,
        0.487364979543842550,
        -0.222668390165885885,
        1.23054744454982119,
    ]
)
_ANDREWS_END = np.array(
    [
        15.81077119629904,
        -15.75637105984298,
        0.04082224013073101,
        -0.5347301163226948,
        0.5244099658805304,
        0.5347301163226948,
        1.048080741042263,
    ]
)


def _turned(angle, x, y):
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([c * x - s * y, s * x + c * y])


def _squeezer(q):
    """Angles and mass centres of the bodies, the points E of four of them, and the spring's end D."""
    beta, theta, gamma, phi, delta, omega, epsilon = q
    angles = jnp.stack([beta, beta + theta, gamma, phi + delta, delta, omega + epsilon, epsilon])
    F, G, H = _turned(beta, 0.007, 0.0), _A + _turned(delta, 0.04, 0.0), _A + _turned(epsilon, 0.0, -0.04)
    origins = jnp.stack([jnp.zeros(2), F, jnp.asarray(_B), G, jnp.asarray(_A), H, jnp.asarray(_A)])
    own = [(0.00092, 0.0), (-0.0115, 0.0), (0.01043, -0.01874), (0.0, -0.00579), (0.02308, 0.00916), (0.00579, 0.0)]
    own.append((-0.00449, -0.01228))
    centres = origins + jnp.stack([_turned(angle, *point) for angle, point in zip(angles, own, strict=True)])
    at = {1: (-0.028, 0.0), 2: (0.0, -0.035), 3: (0.0, -0.02), 5: (0.02, 0.0)}
    ends = jnp.stack([origins[k] + _turned(angles[k], *point) for k, point in at.items()])
    return angles, centres, ends, origins[2] + _turned(gamma, 0.02, -0.018)


def _squeezer_lagrangian(t, q, v, parameters):
    _, rates = jax.jvp(lambda q: _squeezer(q)[:2], (q,), (v,))
    spring = jnp.linalg.norm(_squeezer(q)[3] - _C) - 0.07785
    kinetic = 0.5 * (jnp.dot(_INERTIAS, rates[0] ** 2) + jnp.dot(_MASSES, jnp.sum(rates[1] ** 2, axis=1)))
    return kinetic - 0.5 * 4530.0 * spring**2


def _squeezer_loops(t, q):
    ends = _squeezer(q)[2]
    return jnp.ravel(ends[1:] - ends[:1])


def _andrews() -> Problem:
    mechanism = mb.mechanisms.get("andrews")
    return Problem(
        "Andrews' squeezer",
        0.03,
        lambda: (mechanism.system, mechanism.state),
        _observed(mechanism, _ANGLES),
        Equations(
            _squeezer_lagrangian,
            lambda t, q, v, multipliers: jnp.zeros(7).at[0].set(0.033),
            _squeezer_loops,
            _ANDREWS_START,
            np.zeros(7),
            0.03,
        ),
        lambda run: run.q,
        _ANDREWS_END,
        _known(mechanism, _ANGLES),
        1e-12,
    )


# The car axis.

_CAR_LABELS = ("xl", "yl", "xr", "yr", "xl1", "yl1", "xr1", "yr1")
_CAR_END = np.array(
    [
        0.0493455784275402809122,
        0.496989460230171153861,
        1.04174252488542151681,
        0.373911027265361256927,
        -0.0770583684040972357970,
        0.00744686658723778553466,
        0.0175568157537232222276,
        0.770341043779251976443,
    ]
)
_POINT, _FREE = 0.5 * 10.0 * 1e-2**2, 0.5


def _wheel(t):
    y = 0.1 * jnp.sin(10.0 * t)
    return jnp.stack([jnp.sqrt(1.0 - y**2), y])


def _axis_lagrangian(t, q, v, parameters):
    left, right = jnp.linalg.norm(q[:2]), jnp.linalg.norm(q[2:] - _wheel(t))
    springs = 0.5 * ((left - _FREE) ** 2 + (right - _FREE) ** 2)
    return 0.5 * _POINT * jnp.dot(v, v) - springs - _POINT * (q[1] + q[3])


def _axis_constraints(t, q):
    return jnp.stack([jnp.dot(q[:2], _wheel(t)), jnp.sum((q[:2] - q[2:]) ** 2) - 1.0])


def _car_axis() -> Problem:
    mechanism = mb.mechanisms.get("car_axis")
    return Problem(
        "car axis",
        3.0,
        lambda: (mechanism.system, mechanism.state),
        _observed(mechanism, _CAR_LABELS),
        Equations(
            _axis_lagrangian,
            lambda t, q, v, multipliers: jnp.zeros(4),
            _axis_constraints,
            np.array([0.0, 0.5, 1.0, 0.5]),
            np.array([-0.5, 0.0, -0.5, 0.0]),
            3.0,
        ),
        lambda run: np.concatenate([run.q, run.v]),
        _CAR_END,
        _known(mechanism, _CAR_LABELS),
        1e-12,
    )


def _observed(mechanism: Mechanism, labels) -> Callable[[mb.Trajectory], Array]:
    def end(trajectory):
        observed: Any = mechanism.observe(trajectory)
        return jnp.stack([observed[label][-1] for label in labels])

    return end


def _known(mechanism: Mechanism, labels) -> np.ndarray:
    known = mechanism.references
    return np.array([known.values[-1, known.labels.index(label)] for label in labels])


# Those in modules of their own.


def _fekete() -> Problem:
    def build():
        system = fekete.system()
        return system, mb.assemble(system)

    return Problem(
        "Fekete's particles",
        fekete.T1,
        build,
        lambda trajectory: trajectory.ys.q[-1],
        Equations(
            fekete.lagrangian,
            lambda t, q, v, multipliers: fekete.force(t, q, v, None),
            lambda t, q: fekete.sphere(t, q, None),
            fekete.start().ravel(),
            np.zeros(60),
            fekete.T1,
        ),
        lambda run: run.q,
        fekete.POSITIONS.ravel(),
        fekete.POSITIONS.ravel(),
        1e-10,
    )


def _wheelset() -> Problem:
    def build():
        system = wheelset.system()
        return system, mb.assemble(system)

    def force(t, q, v, multipliers):
        creep = [wheelset.creep(side, q, v, multipliers[k]) for k, side in enumerate(wheelset.SIDES.values())]
        return wheelset.force(t, q, v, None) + sum(creep)

    published = np.concatenate([wheelset.COORDINATES, wheelset.RATES])
    # How far the wheels have turned beyond the nominal speed is no component of the test set.
    return Problem(
        "rail wheelset",
        wheelset.T1,
        build,
        lambda trajectory: jnp.concatenate([trajectory.ys.q[-1, :5], trajectory.ys.u[-1]]),
        Equations(wheelset.lagrangian, force, lambda t, q: wheelset.gaps(q), wheelset.START, np.zeros(6), wheelset.T1),
        lambda run: np.concatenate([run.q[:5], run.v]),
        published,
        published,
        1e-5,
    )


PROBLEMS = {"andrews": _andrews, "car_axis": _car_axis, "fekete": _fekete, "wheelset": _wheelset}
