"""Andrews' squeezing mechanism."""

from typing import Literal

import jax.numpy as jnp
import numpy as np

from .. import planar
from ..bodies.scene import Scene
from .mechanism import Mechanism, References, build, mechanism

# Lengths [m] along the bodies, in the letters of the source.
_F, _FE = 0.007, 0.028
_ANGLES = (
    -0.0617138900142764496358948458001,
    0.0,
    0.455279819163070380255912382449,
    0.222668390165885884674473185609,
    0.487364979543842550225598953530,
    -0.222668390165885884674473185609,
    1.23054744454982119249735015568,
)
# Mass [kg], moment of inertia [kg m²], and mass centre [m] in a frame with its origin in the body's first point.
_BODIES = {
    "K1": (0.04325, 2.194e-6, (0.00092, 0.0)),
    "K2": (0.00365, 4.410e-7, (-0.0115, 0.0)),
    "K3": (0.02373, 5.255e-6, (0.01043, -0.01874)),
    "K4": (0.00706, 5.667e-7, (0.0, -0.00579)),
    "K5": (0.07050, 1.169e-5, (0.02308, 0.00916)),
    "K6": (0.00706, 5.667e-7, (0.00579, 0.0)),
    "K7": (0.05498, 1.912e-5, (-0.00449, -0.01228)),
}
_POINTS = {
    "K1": {"O": (0.0, 0.0), "F": (_F, 0.0)},
    "K2": {"F": (0.0, 0.0), "E": (-_FE, 0.0)},
    "K3": {"B": (0.0, 0.0), "E": (0.0, -0.035), "D": (0.02, -0.018)},
    "K4": {"G": (0.0, 0.0), "E": (0.0, -0.02)},
    "K5": {"A": (0.0, 0.0), "G": (0.04, 0.0)},
    "K6": {"H": (0.0, 0.0), "E": (0.02, 0.0)},
    "K7": {"A": (0.0, 0.0), "H": (0.0, -0.04)},
}
_FIXED = {"O": (0.0, 0.0), "A": (-0.06934, -0.00227), "B": (-0.03635, 0.03273), "C": (0.014, 0.072)}
_JOINTS = {
    "O": ("ground", "K1"),
    "F": ("K1", "K2"),
    "B": ("ground", "K3"),
    "E23": ("K2", "K3"),
    "E24": ("K2", "K4"),
    "E26": ("K2", "K6"),
    "G": ("K4", "K5"),
    "A5": ("ground", "K5"),
    "H": ("K6", "K7"),
    "A7": ("ground", "K7"),
}


@mechanism(variants=("problem",))
def andrews(
    *,
    problem: Literal["ivp", "iftomm"] = "ivp",
    torque: float = 0.033,
    stiffness: float = 4530.0,
    free_length: float = 0.07785,
    angle: float | None = None,
) -> Mechanism:
    """Andrews' squeezing mechanism: seven bodies K1 … K7, ten pins, one degree of freedom, driven by a constant torque
    against a spring; no gravity.

    Source: G. C. Andrews and M. K. Ormrod, "Advent: a simulation program for constrained planar kinematic and dynamic
    systems", ASME 86-DET-97, 1986; data of W. Schiehlen (ed.), "Multibody Systems Handbook", Springer 1990, as in F.
    Mazzia and C. Magherini, "Test Set for Initial Value Problem Solvers", 2008. The reference values were recomputed in
    extended precision in two formulations: the end values printed in the test set are correct to ten digits in the
    angles and to seven in their rates.

    **Arguments:** `problem`: `"ivp"`, the test set's start and 0.03 s, or `"iftomm"`, problem A03 of the IFToMM library
    with 0.05 s; `torque` [N m] on K1; `stiffness` [N/m] and `free_length` [m] of the spring; `angle` [rad] of K1 at the
    start, default from the problem (−0.0617… or −0.0620).

    **Labels:** the test set's angles [rad] `beta`, `Theta`, `gamma`, `Phi`, `delta`, `Omega`, `epsilon` and their rates
    [rad/s] `d_beta`, …; `F_x`, `F_y` [m], the crank's pin.
    """
    if problem not in ("ivp", "iftomm"):
        raise ValueError(f"andrews: problem must be 'ivp' or 'iftomm', got {problem!r}.")
    start = (_ANGLES[0] if problem == "ivp" else -0.0620) if angle is None else angle
    origins, angles = _poses()
    centre = {name: np.array(_BODIES[name][2]) for name in _BODIES}
    bodies = [
        planar.Body(
            name,
            mass=mass,
            inertia=inertia,
            position=origins[name] + _turned(angles[name], centre[name]),
            angle=angles[name],
        )
        for name, (mass, inertia, _) in _BODIES.items()
    ]

    def point(body, name):
        return _FIXED[name[0]] if body == "ground" else np.array(_POINTS[body][name[0]]) - centre[body]

    joints = [
        planar.Revolute(name, a, b, point_a=point(a, name), point_b=point(b, name)) for name, (a, b) in _JOINTS.items()
    ]
    spring = planar.SpringDamper(
        "spring",
        "ground",
        "K3",
        stiffness=stiffness,
        free_length=free_length,
        point_a=_FIXED["C"],
        point_b=point("K3", "D"),
    )
    return build(
        "andrews",
        Scene(bodies, joints=joints, forces=[spring, planar.Torque("drive", "K1", torque=torque)]),
        t1=0.03 if problem == "ivp" else 0.05,
        observe=_observe,
        description="Andrews' squeezing mechanism: seven planar bodies in three loops, a torque against a spring.",
        references=References.load(f"andrews_{problem}") if angle is None else None,
        fix={"K1.angle": start},
        rates={"K1.angle": 0.0},
    )


def _turned(angle, v):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * v[0] - s * v[1], s * v[0] + c * v[1]])


def _poses():
    """Origins of the bodies' frames and their angles at the published start."""
    beta, theta, gamma, phi, delta, omega, epsilon = _ANGLES
    angles = dict(zip(_BODIES, (beta, beta + theta, gamma, phi + delta, delta, omega + epsilon, epsilon), strict=True))
    along = lambda name, point: _turned(angles[name], np.array(_POINTS[name][point]))
    A = np.array(_FIXED["A"])
    origins = {
        "K1": np.zeros(2),
        "K2": along("K1", "F"),
        "K3": np.array(_FIXED["B"]),
        "K4": A + along("K5", "G"),
        "K5": A,
        "K6": A + along("K7", "H"),
        "K7": A,
    }
    return origins, angles


def _observe(trajectory):
    K = {name: trajectory[name] for name in _BODIES}
    pairs = {
        "beta": ("K1", None),
        "Theta": ("K2", "K1"),
        "gamma": ("K3", None),
        "Phi": ("K4", "K5"),
        "delta": ("K5", None),
        "Omega": ("K6", "K7"),
        "epsilon": ("K7", None),
    }
    observed = {}
    for label, (body, base) in pairs.items():
        observed[label] = K[body].angle - (0.0 if base is None else K[base].angle)
        observed[f"d_{label}"] = K[body].angular_velocity - (0.0 if base is None else K[base].angular_velocity)
    observed["F_x"], observed["F_y"] = _F * jnp.cos(K["K1"].angle), _F * jnp.sin(K["K1"].angle)
    return observed
