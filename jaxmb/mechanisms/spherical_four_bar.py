"""The spherical four-bar linkage."""

import jax
import jax.numpy as jnp
import numpy as np

from .. import spatial
from ..bodies.scene import Scene
from ..lagrangian import Holonomic, LagrangianSystem
from ..linalg import rotations
from ..parts.functions import Force
from ..system import parameters as parameters_of
from .mechanism import Mechanism, Model, References, build, is_rigid, mechanism
from .observe import columns, lagrangian_coordinates

_COUPLER = ((0.06, -0.004, 0.0), (-0.004, 0.05, 0.0), (0.0, 0.0, 0.03))
_CENTRES = ((0.02, -0.05, 0.1), (0.05, -0.12, 0.15), (0.0, -0.08, 0.12))


@mechanism(variants=("model",))
def spherical_four_bar(
    *,
    arcs: tuple[float, float, float, float] = (30.0, 75.0, 60.0, 80.0),
    inertias: tuple[float, float] = (0.02, 0.05),
    coupler_inertia: tuple[tuple[float, ...], ...] = _COUPLER,
    masses: tuple[float, float, float] = (0.6, 1.5, 0.8),
    centres: tuple[tuple[float, ...], ...] = _CENTRES,
    torque: float = 0.1,
    angle: float = 0.7,
    speed: float = 2.0,
    branch: int = 1,
    gravity: float = 9.81,
    model: Model = "lagrangian",
) -> Mechanism:
    """Four links turn about axes through the centre of a sphere; a constant torque drives the input.

    Coordinates: the input angle θ, the output angle ψ [rad], and the coupler's Euler parameters. The input turns about
    z; the output about z turned by the ground arc about x. The coupler's frame has z along its joint with the input.
    There are two rows for each dyad, input and output, and one for the norm of the Euler parameters: one degree of
    freedom.

    Source: J. R. Dooley and J. M. McCarthy, on the dynamics of spherical four-bar linkages with the Euler parameters of
    the coupler; data of this package. Reference values from DOP853 on the equation of motion in θ alone.

    **Arguments:** `arcs` [degree] of input, coupler, output and ground; `inertias` [kg m²] of input and output about
    their axes; `coupler_inertia` [kg m²] about the sphere's centre, in its frame; `masses` [kg] and mass `centres` [m]
    of input, coupler and output in their frames; `torque` [N m] on the input; `angle` θ [rad] and `speed` θ̇ [rad/s] at
    the start; `branch` of the assembly, 1 or −1; `gravity` [m/s²] along −y; `model`: from its Lagrangian, or as rigid
    bodies `input`, `coupler` and `output` on four hinges through the centre, with three redundant rows among twenty.

    **Labels:** `theta`, `psi` [rad], of rigid bodies in (−π, π] and [0, 2π); `e0` … `e3`, and the rates `u0`, `u1`
    [rad/s], ….
    """
    parameters = {
        "arcs": np.radians(np.asarray(arcs, float)),
        "inertias": inertias,
        "coupler_inertia": coupler_inertia,
        "masses": masses,
        "centres": centres,
        "torque": torque,
        "gravity": gravity,
    }
    q = _closed(parameters["arcs"], angle, branch)
    rigid = is_rigid(model)
    return build(
        "spherical_four_bar",
        _bodies(parameters, q) if rigid else _lagrangian(parameters, q),
        t1=3.0,
        observe=_observe_bodies if rigid else lagrangian_coordinates,
        description="Spherical four-bar linkage, in angles and the coupler's Euler parameters (Dooley and McCarthy).",
        references=References.load("spherical_four_bar"),
        fix={} if rigid else {"theta": angle},
        rates={"input.wz" if rigid else "theta": speed},
    )


def _lagrangian(parameters, q) -> LagrangianSystem:
    return LagrangianSystem(
        kinetic=_kinetic,
        potential=_potential,
        force=_force,
        constraints=[Holonomic("input", _input), Holonomic("output", _output), Holonomic("unit", _unit)],
        q=q,
        parameters=parameters,
        coordinates=("theta", "psi", "e0", "e1", "e2", "e3"),
    )


def _bodies(p, q) -> Scene:
    """The links with their frames and inertia at the sphere's centre, where hinges hold them; their weights act at
    separate points.
    """
    alpha, eta, beta, gamma = p["arcs"]
    z = np.array([0.0, 0.0, 1.0])
    tilted = lambda a: np.array([0.0, -np.sin(a), np.cos(a)])
    inertias = (p["inertias"][0] * np.eye(3), p["coupler_inertia"], p["inertias"][1] * np.eye(3))
    ground = rotations.from_axis_angle((1.0, 0.0, 0.0), gamma)
    attitudes = (
        rotations.from_axis_angle(z, q[0]),
        jnp.asarray(q[2:]),
        rotations.multiply(ground, rotations.from_axis_angle(z, q[1])),
    )
    names = ("input", "coupler", "output")
    bodies = [
        spatial.Body(name, mass=p["masses"][k], inertia=inertias[k], orientation=attitudes[k])
        for k, name in enumerate(names)
    ]
    weights = [
        Force(
            f"{name}_weight",
            name,
            _weight,
            parameters={"weight": p["masses"][k] * p["gravity"], "centre": p["centres"][k]},
            potential=lambda poses, t, p: p["weight"] * rotations.rotate(poses[0, 3:], p["centre"])[1],
        )
        for k, name in enumerate(names)
    ]
    axes = {
        "input_axle": ("ground", "input", z, z),
        "input_hinge": ("input", "coupler", tilted(alpha), z),
        "output_hinge": ("coupler", "output", tilted(eta), tilted(beta)),
        "output_axle": ("ground", "output", tilted(gamma), z),
    }
    centre = np.zeros(3)
    hinges = [
        spatial.Revolute(name, a, b, point_a=centre, point_b=centre, axis_a=axis_a, axis_b=axis_b)
        for name, (a, b, axis_a, axis_b) in axes.items()
    ]
    return Scene(bodies, joints=hinges, forces=[spatial.Torque("drive", "input", torque=p["torque"] * z), *weights])


def _weight(poses, velocities, t, p):
    force = jnp.zeros(3).at[1].set(-p["weight"])
    return jnp.concatenate([force, rotations.cross(p["centre"], rotations.unrotate(poses[0, 3:], force))])[None]


def _observe_bodies(trajectory):
    first, coupler, last = (trajectory[name] for name in ("input", "coupler", "output"))
    # The output's axle is tilted by the ground arc, and then turned about z.
    axle = parameters_of(trajectory.system)["output_axle.axis_a"]
    tilt = rotations.from_axis_angle((1.0, 0.0, 0.0), jnp.arctan2(-axle[1], axle[2]))
    turned = jax.vmap(lambda p: rotations.multiply(rotations.conjugate(tilt), p))(last.orientation)
    angle = lambda p: 2 * jnp.arctan2(p[:, 3], p[:, 0])
    rates = jax.vmap(rotations.rates)(coupler.orientation, coupler.angular_velocity)
    observed = {
        "theta": (angle(first.orientation) + jnp.pi) % (2 * jnp.pi) - jnp.pi,
        "psi": angle(turned) % (2 * jnp.pi),
        "u0": first.angular_velocity[:, 2],
        "u1": last.angular_velocity[:, 2],
    }
    parameters = columns(("e0", "e1", "e2", "e3"), coupler.orientation)
    return observed | parameters | columns(("u2", "u3", "u4", "u5"), rates)


def _closed(arcs, theta, branch):
    """A configuration, by the cosine rule on the sphere: not differentiated, a guess for the assembly."""
    alpha, eta, beta, gamma = arcs
    x = lambda a: np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    z = lambda a: np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    axis = np.array([0.0, 0.0, 1.0])
    A = z(theta) @ x(alpha) @ axis
    a = x(gamma).T @ A
    P, Q = a[0] * np.sin(beta), -a[1] * np.sin(beta)
    cosine = (np.cos(eta) - a[2] * np.cos(beta)) / np.hypot(P, Q)
    if not abs(cosine) <= 1:
        raise ValueError(f"The linkage with the arcs {np.degrees(arcs)} cannot be closed at the input angle {theta}.")
    psi = np.arctan2(P, Q) + branch * np.arccos(cosine)
    B = x(gamma) @ z(psi) @ x(beta) @ axis
    y = (np.cos(eta) * A - B) / np.sin(eta)
    return np.concatenate([[theta, psi], np.asarray(rotations.from_matrix(np.stack([np.cross(y, A), y, A], axis=1)))])


def _turn(a):
    """Rotation about x."""
    one, zero = jnp.ones_like(a), jnp.zeros_like(a)
    c, s = jnp.cos(a), jnp.sin(a)
    return jnp.stack([jnp.stack([one, zero, zero]), jnp.stack([zero, c, -s]), jnp.stack([zero, s, c])])


def _spin(a, vector):
    """A vector turned about z."""
    c, s = jnp.cos(a), jnp.sin(a)
    return jnp.stack([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1], vector[2]])


def _input(t, q, p):
    return _dyad(rotations.rotate(q[2:], jnp.array([0.0, 0.0, 1.0])), q[0], p["arcs"][0])


def _output(t, q, p):
    eta = p["arcs"][1]
    along = jnp.stack([jnp.zeros_like(eta), -jnp.sin(eta), jnp.cos(eta)])
    return _dyad(_turn(p["arcs"][3]).T @ rotations.rotate(q[2:], along), q[1], p["arcs"][2])


def _dyad(axis, angle, arc):
    """The residual of a joint axis on a cone about z, in the plane that turns with the angle."""
    return jnp.stack([axis[2] - jnp.cos(arc), jnp.cos(angle) * axis[0] + jnp.sin(angle) * axis[1]])


def _unit(t, q, p):
    return jnp.dot(q[2:], q[2:]) - 1.0


def _kinetic(t, q, v, p):
    omega = rotations.angular_velocity(q[2:], v[2:])
    turning = p["inertias"][0] * v[0] ** 2 + p["inertias"][1] * v[1] ** 2
    return 0.5 * (turning + omega @ p["coupler_inertia"] @ omega)


def _potential(t, q, p):
    centres = p["centres"]
    heights = jnp.stack(
        [
            _spin(q[0], centres[0])[1],
            rotations.rotate(q[2:], centres[1])[1],
            (_turn(p["arcs"][3]) @ _spin(q[1], centres[2]))[1],
        ]
    )
    return p["gravity"] * jnp.dot(p["masses"], heights)


def _force(t, q, v, p):
    return jnp.zeros_like(q).at[0].set(p["torque"])
