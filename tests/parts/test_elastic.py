"""Elastic bodies move as their mass points do; bars bend, stretch, twist and vibrate by closed forms."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.formulations import Multipliers, accelerations
from jaxmb.parts.planar.kinematics import PLANE
from jaxmb.parts.spatial.kinematics import SPACE

MOST_PROGRAMS = 120

STEEL: dict[str, Any] = {"young": 2e11, "density": 7800.0, "width": 0.03, "thickness": 0.01}
AREA, IN_PLANE, ACROSS = 3e-4, 0.03 * 0.01**3 / 12, 0.01 * 0.03**3 / 12
SPACES = {2: planar, 3: spatial}


def springs(nodes, stiffness):
    """The stiffness matrix of springs between all nodes."""
    n, d = nodes.shape
    out = np.zeros((n, d, n, d))
    for i in range(n):
        for j in range(i):
            way = (nodes[i] - nodes[j]) / np.linalg.norm(nodes[i] - nodes[j])
            block = stiffness * np.outer(way, way)
            for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
                out[a, :, b] += sign * block
    return out.reshape(n * d, n * d)


def random_model(d, n=7, modes=3):
    """A model with consistent masses, and modes that do not follow from it."""
    rng = np.random.default_rng(d)
    root = rng.normal(size=(n, n))
    nodes = rng.normal(size=(n, d)) + 0.5
    return {
        "nodes": nodes,
        "mass": root @ root.T + np.eye(n),
        "stiffness": springs(nodes, 300.0),
        "modes": 0.2 * rng.normal(size=(n * d, modes)),
    }


def turned(d, pose):
    """The rotation matrix of a pose."""
    if d == 3:
        return Rotation.from_quat(pose[[4, 5, 6, 3]]).as_matrix()
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[c, -s], [s, c]])


def spin(d, omega):
    """The matrix of ω × x in body axes."""
    if d == 2:
        return omega[0] * np.array([[0.0, -1.0], [1.0, 0.0]])
    x, y, z = omega
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


class NodesInMotion:
    """The nodes of a model in motion, in world axes."""

    def __init__(self, model, q, u, udot):
        self.d = d = model["nodes"].shape[1]
        modes = model["modes"].reshape(*model["nodes"].shape, -1)
        r, v = 3 * (d - 1), 3 * (d - 1)
        size = len(q) - modes.shape[2]
        self.turn, zeta, rates, second = turned(d, q[:size]), q[size:], u[v:], udot[v:]
        body, omega, alpha = model["nodes"] + modes @ zeta, spin(d, u[d:r]), spin(d, udot[d:r])
        self.places = q[:d] + body @ self.turn.T
        self.velocities = u[:d] + (body @ omega.T + modes @ rates) @ self.turn.T
        inner = body @ (alpha + omega @ omega).T + 2 * (modes @ rates) @ omega.T + modes @ second
        self.accelerations = udot[:d] + inner @ self.turn.T
        # Velocities of the nodes by unit velocities of the body and of the coordinates.
        along = [np.broadcast_to(axis, body.shape) for axis in np.eye(d)]
        along += [body @ spin(d, axis).T @ self.turn.T for axis in np.eye(r - d)]
        along += [modes[:, :, k] @ self.turn.T for k in range(modes.shape[2])]
        self.along = np.array(along)

    def moment(self, mass, vectors):
        x, p = self.places, mass @ vectors
        return np.sum(np.cross(x, p), axis=0) if self.d == 3 else np.sum(x[:, 0] * p[:, 1] - x[:, 1] * p[:, 0])


@functools.partial(jax.jit, static_argnums=0)
def told(d, system, q, u):
    del d
    return (
        accelerations(system, Multipliers(), 0.0, q, u)[0],
        system.kinetic_energy(0.0, q, u),
        system.potential_energy(0.0, q),
        system.linear_momentum(q, u),
        system.angular_momentum(q, u),
    )


@pytest.mark.parametrize("d", [2, 3])
def test_body_moves_as_its_nodes_do(d):
    """With gravity: energies, momenta, and Newton's law along all motions that the modes admit."""
    model, gravity, rng = random_model(d), np.array([0.7, -3.0, 9.0])[:d], np.random.default_rng(5)
    body, frames = SPACES[d].ElasticBody.from_nodes("body", model, interfaces={"tip": [1, 3, 4, 6]}, damping=0.1)
    system = mb.Scene([body], forces=[mb.Gravity(gravity)], frames=frames).compile()
    q, u = 0.3 * rng.normal(size=system.nq), rng.normal(size=system.nu)
    if d == 3:
        q[3:7] /= np.linalg.norm(q[3:7])
    udot, kinetic, potential, linear, angular = told(d, system, q, u)
    nodes, mass = NodesInMotion(model, q, u, np.asarray(udot)), model["mass"]
    zeta, rates = q[-3:], u[-3:]
    stiffness = model["modes"].T @ model["stiffness"] @ model["modes"]
    np.testing.assert_allclose(kinetic, 0.5 * np.sum(nodes.velocities * (mass @ nodes.velocities)), rtol=1e-13)
    height = np.sum(mass @ nodes.places, axis=0) @ gravity
    np.testing.assert_allclose(potential, 0.5 * zeta @ stiffness @ zeta - height, rtol=1e-12)
    np.testing.assert_allclose(linear, np.sum(mass @ nodes.velocities, axis=0), rtol=1e-12)
    np.testing.assert_allclose(angular, nodes.moment(mass, nodes.velocities), rtol=1e-12)
    unmet = np.einsum("kna,na->k", nodes.along, mass @ (nodes.accelerations - gravity))
    unmet[-3:] += stiffness @ (zeta + 0.1 * rates)
    scale = np.einsum("kna,na->k", np.abs(nodes.along), np.abs(mass @ nodes.accelerations)) + np.max(np.abs(stiffness))
    np.testing.assert_allclose(unmet / scale, 0.0, atol=1e-11)


@pytest.mark.slow
def test_bar_in_the_plane_is_a_bar_in_space():
    rod: dict[str, Any] = {"length": 0.8, "bending": 3, "stretch": 2} | STEEL
    flat, solid = planar.ElasticBar("rod", **rod), spatial.ElasticBar("rod", torsion=1, **rod)
    rng = np.random.default_rng(1)
    bends, stretches, place = 0.02 * rng.normal(size=3), 1e-4 * rng.normal(size=2), rng.normal(size=2)
    systems = [
        mb.Scene([flat], frames=[planar.BarFrame("eye", "rod", station=0.7, offset=0.004)]).compile(),
        mb.Scene([solid], frames=[spatial.BarFrame("eye", "rod", station=0.7, offset=(0.004, 0.0))]).compile(),
    ]
    q = [np.array([*place, 0.4, *bends, *stretches]), np.zeros(16)]
    q[1][:2], q[1][3:7], q[1][7:10], q[1][13:15] = place, (np.cos(0.2), 0.0, 0.0, np.sin(0.2)), bends, stretches
    rates = rng.normal(size=8) * np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.01, 0.01])
    u, shared = [rates, np.zeros(15)], [0, 1, 5, 6, 7, 8, 12, 13]
    u[1][shared] = rates
    names = ("eye.position", "eye.velocity", "eye.acceleration", "eye.deflection", "eye.strain", "eye.stress")
    (flat_motion, flat_values), (motion, values) = (
        (jax.tree.map(np.asarray, told(d, s, x, v)), mb.evaluate(s, mb.State(x, v), names))
        for d, s, x, v in zip((2, 3), systems, q, u, strict=True)
    )
    np.testing.assert_allclose(motion[0][shared], flat_motion[0], rtol=1e-8)
    np.testing.assert_allclose(np.delete(motion[0], shared), 0.0, atol=1e-9)
    np.testing.assert_allclose(motion[1:3], flat_motion[1:3], rtol=1e-12)
    np.testing.assert_allclose(motion[4][2], flat_motion[4], rtol=1e-12)
    for name in names:
        size = np.max(np.abs(flat_values[name]))
        np.testing.assert_allclose(
            np.ravel(values[name])[: np.size(flat_values[name])], np.ravel(flat_values[name]), atol=1e-9 * size
        )


def sections(bar, zeta, station):
    """A section's place and turn, and their derivatives by the coordinates, by differences."""
    steps = 1e-6 * np.eye(len(zeta))
    at = lambda zeta: np.concatenate(bar.section(np.asarray(station), zeta))
    return at(zeta), np.array([(at(zeta + step) - at(zeta - step)) / 2e-6 for step in steps]).T


@pytest.mark.parametrize("d", [2, 3])
def test_mass_matrix_of_a_bar_is_that_of_its_sections(d):
    """To the second order in the deformation."""
    numbers = {"bending": 2, "stretch": 1} | STEEL | ({"torsion": 1} if d == 3 else {})
    bar, space = SPACES[d].ElasticBar("bar", length=0.8, **numbers), SPACE if d == 3 else PLANE
    n = len(bar.modes)
    zeta = np.random.default_rng(0).normal(size=n) * 0.005
    at_rest, deformed = jax.jit(lambda zeta: [bar.mass_matrix(space, x) for x in (0 * zeta, zeta)])(zeta)
    moments = np.array([IN_PLANE + ACROSS, ACROSS, IN_PLANE]) if d == 3 else np.array([IN_PLANE])
    nodes, weights = np.polynomial.legendre.leggauss(12)
    for matrix, at, tolerance in ((at_rest, np.zeros(n), 1e-9), (deformed, zeta, 2e-6)):
        expected = 0.0
        for station, weight in zip(0.5 + 0.5 * nodes, 0.5 * weights, strict=True):
            place, moves = sections(bar, at, station)
            swept = np.array([spin(d, axis) @ place[:d] for axis in np.eye(len(moments))]).T
            of_point = np.concatenate([np.eye(d), swept, moves[:d]], axis=1)
            of_section = np.concatenate([np.zeros((len(moments), d)), np.eye(len(moments)), moves[d:]], axis=1)
            rows = AREA * of_point.T @ of_point + of_section.T @ np.diag(moments) @ of_section
            expected = expected + weight * STEEL["density"] * 0.8 * rows
        np.testing.assert_allclose(matrix, expected, rtol=0, atol=tolerance * np.max(expected))


def test_bar_deflects_by_closed_forms():
    """Under forces and moments at its end."""
    bar = spatial.ElasticBar("bar", length=0.8, stretch=1, torsion=1, **STEEL)
    young, shear, l = STEEL["young"], STEEL["young"] / 2.6, 0.8
    stiffness = np.diag(np.asarray(bar.matrices()[0]))
    _, moves = sections(bar, np.zeros(6), 1.0)
    force, torque = np.array([3.0, 2.0, -3.0]), np.array([4.0, 5.0, -7.0])
    zeta = moves.T @ np.concatenate([force, torque]) / stiffness
    y = (force[1] * l**3 / 3 + torque[2] * l**2 / 2) / (young * IN_PLANE)
    z = (force[2] * l**3 / 3 - torque[1] * l**2 / 2) / (young * ACROSS)
    # Saint-Venant's constant of a rectangle three times as wide as thick is 0.2633 a b³.
    turn = [torque[0] * l / (shear * 0.2633 * 0.03 * 0.01**3)]
    turn += [(torque[1] * l - force[2] * l**2 / 2) / (young * ACROSS)]
    turn += [(torque[2] * l + force[1] * l**2 / 2) / (young * IN_PLANE)]
    np.testing.assert_allclose(moves @ zeta, [force[0] * l / (young * AREA), y, z, *turn], rtol=3e-4)
    np.testing.assert_allclose(
        (moves @ zeta)[[0, 1, 2, 4, 5]], [force[0] * l / (young * AREA), y, z, *turn[1:]], rtol=1e-8
    )
    strain = force[0] / (young * AREA) - 0.005 * (torque[2] + 0.75 * l * force[1]) / (young * IN_PLANE)
    np.testing.assert_allclose(bar.strain(np.asarray(0.25), np.array([0.005, 0.0]), zeta), strain, rtol=1e-8)


def frequencies(bending, ends):
    """Natural frequencies of a slender bar, by `√(EI / ρ A l⁴)`."""
    thin: dict[str, Any] = {"young": 1.0, "density": 1e6, "width": 1.0, "thickness": 1e-3}
    rod = planar.ElasticBar("rod", length=1.0, bending=bending, **thin)
    joints = {
        "clamped": [planar.Fixed("A", "ground", "rod", point=(0.0, 0.0))],
        "pinned": [
            planar.Revolute("A", "ground", "rod", point=(0.0, 0.0)),
            planar.PointOnLine("B", "ground", "tip", point_a=(0.0, 0.0), point_b=(0.0, 0.0), axis_a=(1.0, 0.0)),
        ],
    }[ends]
    system = mb.Scene([rod], joints=joints, frames=[planar.BarFrame("tip", "rod")]).compile()
    values = mb.linearise(system, mb.assemble(system)).eigenvalues
    unit = np.sqrt(1e-9 / 12 / (1e6 * 1e-3))
    return np.sort(np.abs(values.imag))[::2][:2] / unit


@pytest.mark.slow
@pytest.mark.parametrize(
    "ends, exact",
    [("clamped", (3.516015268729, 22.03449156)), ("pinned", (np.pi**2, 4 * np.pi**2))],
)
def test_frequencies_converge_to_those_of_euler_and_bernoulli(ends, exact):
    """From above, the more modes there are."""
    errors = np.array([frequencies(n, ends) / exact - 1 for n in (2, 6)])
    assert np.all(errors > -1e-6)
    assert np.all(errors[0] > 1e-3)
    np.testing.assert_allclose(errors[1], 0.0, atol=1e-4)


# Out of the plane of rotation, by hub speed over √(EI / ρ A l⁴). Source: A. D. Wright, C. E. Smith, R. W. Thresher,
# J. L. C. Wang, "Vibration Modes of Centrifugally Stiffened Beams", J. Appl. Mech. 49, 1982.
WRIGHT = {0.0: 3.5160, 1.0: 3.6816, 2.0: 4.1373, 3.0: 4.7973, 10.0: 11.2023}


@pytest.mark.slow
def test_rotation_stiffens_a_blade():
    """Frequencies out of the plane and in it, where they are lower by the speed."""
    blade: dict[str, Any] = {"length": 1.0, "young": 1.0, "density": 1e6, "width": 1e-3, "thickness": 1e-3}
    rod = spatial.ElasticBar("rod", bending=6, **blade)
    hub = spatial.Revolute("hub", "ground", "rod", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    drive = mb.JointDriver("drive", "hub.angle", value=0.0, rate=1.0)
    system = mb.Scene([rod], joints=[hub, drive]).compile()
    unit = np.sqrt(1e-12 / 12 / (1e6 * 1e-6))

    @jax.jit
    def stiffness(speed):
        """The accelerations of the coordinates by the coordinates."""
        turning = mb.with_parameters(system, {"drive.rate": speed})
        u = jnp.zeros(system.nu).at[5].set(speed)
        second = lambda zeta: accelerations(turning, Multipliers(), 0.0, system.guess.q.at[7:].set(zeta), u)[0][6:]
        return jax.jacfwd(second)(jnp.zeros(12))

    for ratio, expected in WRIGHT.items():
        matrix = np.asarray(stiffness(ratio * unit)) / unit**2
        in_plane, out_of_plane = (
            np.sqrt(np.min(np.linalg.eigvals(-matrix[k, k]).real)) for k in (np.s_[:6], np.s_[6:])
        )
        np.testing.assert_allclose(out_of_plane, expected, rtol=3e-5)
        np.testing.assert_allclose(in_plane**2, out_of_plane**2 - ratio**2, rtol=1e-4)


@pytest.mark.slow
def test_force_along_a_bar_buckles_it():
    """At Euler's load, π² EI / 4 l², of a clamped bar."""
    rod = planar.ElasticBar("rod", length=1.0, **STEEL)
    clamp = planar.Fixed("clamp", "ground", "rod", point=(0.0, 0.0))
    pull = planar.PointForce("pull", "tip", force=(0.0, 0.0))
    system = mb.Scene([rod], joints=[clamp], forces=[pull], frames=[planar.BarFrame("tip", "rod")]).compile()

    @jax.jit
    def stiffness(load):
        pressed = mb.with_parameters(system, {"pull.force": jnp.array([-1.0, 0.0]) * load})
        along = lambda zeta: pressed.force(0.0, system.guess.q.at[3:].set(zeta), jnp.zeros(system.nu))[3:]
        return jax.jacfwd(along)(jnp.zeros(2))

    euler = np.pi**2 / 4 * STEEL["young"] * IN_PLANE
    largest = lambda load: np.max(np.linalg.eigvalsh(np.asarray(stiffness(load))))
    assert largest(0.98 * euler) < 0 < largest(1.02 * euler)


SLIDER = {"bend_1": 0.0, "bend_2": 0.0, "stretch_1": 1.03339863e-5, "stretch_2": 1.69327969e-5}
SLIDER_RATES = {
    "bend_1": 0.4448961125815990,
    "bend_2": 0.004634339319238670,
    "stretch_1": -1.78591076e-6,
    "stretch_2": -2.68938672e-6,
}


def slider_crank():
    """The elastic slider-crank of the test set for IVP solvers (B. Simeon, 1998), with the published numbers: the
    masses of its stretch are 15 times the integrals.
    """
    crank, rod, width, density, young, pi = 0.15, 0.3, 0.008, 7870.0, 2e11, np.pi
    mass, inertia = 0.151104, 0.0045339259
    of_rod, along = density * width**2 * rod, young * width**2 / rod
    products, mixed, stiffness = np.zeros((4, 4, 2, 2)), np.zeros((4, 2, 2)), np.zeros((4, 4))
    products[0, 0, 1, 1] = products[1, 1, 1, 1] = 0.5 * of_rod
    products[2:, 2:, 0, 0] = of_rod * np.array([[8.0, 1.0], [1.0, 2.0]])
    both = of_rod * np.array([[16 / pi**3, 1 / pi - 8 / pi**3], [0.0, -0.5 / pi]])
    products[:2, 2:, 1, 0], products[2:, :2, 0, 1] = both, both.T
    mixed[:2, 0, 1], mixed[2:, 0, 0] = of_rod * rod * np.array([[1 / pi, -0.5 / pi], [1 / 3, 1 / 6]])
    stiffness[:2, :2] = along * (width / rod) ** 2 * np.diag([pi**4 / 24, 2 * pi**4 / 3])
    stiffness[2:, 2:] = along * np.array([[16.0, -8.0], [-8.0, 7.0]]) / 3
    bodies = [
        planar.Body("crank", mass=0.36, inertia=0.002727, centre=(crank / 2, 0.0)),
        planar.ElasticBody(
            "rod",
            mass=mass,
            first_moment=(mass * rod / 2, 0.0),
            second_moment=np.diag([mass * rod**2 / 3, inertia - mass * rod**2 / 3]),
            modal_moments=of_rod * np.array([[0.0, 2 / pi], [0.0, 0.0], [2 / 3, 0.0], [1 / 6, 0.0]]),
            mixed_moments=mixed,
            modal_products=products,
            stiffness=stiffness,
            names=tuple(SLIDER),
            position=(crank, 0.0),
        ),
        planar.PointMass("slider", mass=0.075552, position=(crank + rod, 0.0)),
    ]
    joints = [
        planar.Revolute("A", "ground", "crank", point=(0.0, 0.0)),
        planar.Revolute("B", "crank", "rod", point=(crank, 0.0)),
        planar.Revolute("C", "end", "slider", point=(crank + rod, 0.0)),
        planar.PointOnLine("D", "ground", "slider", point_a=(0.0, 0.0), point_b=(0.0, 0.0), axis_a=(1.0, 0.0)),
        mb.JointDriver("drive", "A.angle", value=0.0, rate=150.0),
    ]
    turning = [[pi / rod, 2 * pi / rod, 0.0, 0.0]]
    end = planar.ModalFrame("end", "rod", position=(rod, 0.0), shapes=np.eye(2, 4, 3), turning=turning)
    return mb.Scene(bodies, joints=joints, frames=[end]).compile()


@pytest.mark.slow
def test_elastic_slider_crank_of_the_test_set():
    system = slider_crank()
    own = lambda values: {f"rod.{name}": value for name, value in values.items()}
    state = mb.assemble(system, fix=own(SLIDER), rates=own(SLIDER_RATES))
    motion = mb.simulate(system, state, t1=0.1, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(motion["rod"].angle[-1], -0.3311734988256260, rtol=0, atol=1e-9)
    np.testing.assert_allclose(motion["rod"].angular_velocity[-1], 60.25346755138369, rtol=1e-8)
    deformed = [1.893192899613509e-4, 2.375751249879174e-5, -5.323896770569702e-6, -8.363313279112129e-6]
    np.testing.assert_allclose([motion.quantity(f"rod.{name}")[-1] for name in SLIDER], deformed, rtol=1e-6)


def free_flight():
    section: dict[str, Any] = {"young": 2e7, "density": 1000.0, "width": 0.03, "thickness": 0.02}
    rod = spatial.ElasticBar("rod", length=1.0, bending=2, stretch=1, torsion=1, **section)
    return mb.Scene([rod], frames=[spatial.BarFrame("tip", "rod")]).compile()


@pytest.mark.slow
def test_free_flight_keeps_energy_and_momenta():
    system = free_flight()
    rates = {"rod.angular_velocity": (1.0, 2.0, 3.0), "rod.bend_y_1": 0.2, "rod.twist_1": 0.5}
    motion = mb.simulate(
        system,
        mb.assemble(system, fix={"rod.bend_z_1": 0.03}, rates=rates),
        t1=1.0,
        saveat=np.linspace(0.0, 1.0, 9),
        rtol=1e-10,
    )
    assert np.ptp(motion.quantity("rod.bend_y_1")) > 1e-3
    np.testing.assert_allclose(motion.energy, motion.energy[0], rtol=2e-9)
    momenta = jax.jit(jax.vmap(lambda y: (system.linear_momentum(y.q, y.u), system.angular_momentum(y.q, y.u))))
    for along in momenta(motion.ys):
        np.testing.assert_allclose(along, np.broadcast_to(along[0], along.shape), atol=1e-9)


def crank_and_rod(rod, frame):
    crank = planar.Body("crank", mass=0.36, inertia=7e-4, position=(0.075, 0.0))
    slider = planar.Body("slider", mass=0.0755, inertia=1e-4, position=(0.45, 0.0))
    joints = [
        planar.Revolute("A", "ground", "crank", point=(0.0, 0.0)),
        planar.Revolute("B", "crank", "rod", point=(0.15, 0.0)),
        planar.Revolute("C", "tip", "slider", point=(0.45, 0.0)),
        planar.Prismatic("D", "ground", "slider", point=(0.0, 0.0), axis=(1.0, 0.0)),
    ]
    forces = [mb.Gravity((0.0, -9.81))]
    return mb.Scene([crank, rod, slider], joints=joints, forces=forces, frames=[frame]).compile()


ROD: dict[str, Any] = {"length": 0.3, "density": 7870.0, "width": 0.008, "thickness": 0.008, "position": (0.15, 0.0)}


@pytest.mark.slow
def test_stiff_rod_in_a_loop_moves_as_a_rigid_one():
    """The difference falls with the stiffness."""
    mass = 7870.0 * 0.008**2 * 0.3
    inertia = mass * (0.3**2 + 0.008**2) / 12
    rigid = planar.Body("rod", mass=mass, inertia=inertia, centre=(0.15, 0.0), position=(0.15, 0.0))
    system = crank_and_rod(rigid, planar.Frame("tip", "rod", position=(0.3, 0.0)))
    options = {"t1": 0.1, "rtol": 1e-9, "solver": mb.solvers.Hermite()}
    expected = mb.simulate(system, mb.assemble(system, rates={"A.angle": 20.0}), **options)["A"].angle[-1]
    errors = []
    for young in (1e10, 1e11, 1e12):
        elastic = planar.ElasticBar("rod", young=young, damping=1e-3, **ROD)
        system = crank_and_rod(elastic, planar.BarFrame("tip", "rod"))
        start = mb.assemble(system, rates={"A.angle": 20.0, "rod.bend_1": 0.0, "rod.bend_2": 0.0})
        errors.append(abs(mb.simulate(system, start, **options)["A"].angle[-1] - expected))
    assert errors[2] < 0.2 * errors[1] < 0.04 * errors[0] + 1e-9
    assert errors[2] < 1e-5


DESIGN = {"rod.thickness": 0.02, "rod.length": 1.0, "rod.young": 2e9, "rod.density": 1000.0, "load.station": 0.8}


def loaded_bar():
    section: dict[str, Any] = {
        name.removeprefix("rod."): value for name, value in DESIGN.items() if name.startswith("rod.")
    }
    rod = planar.ElasticBar("rod", width=0.03, damping=1e-3, stretch=1, **section)
    clamp = planar.Fixed("clamp", "ground", "rod", point_a=(0.0, 0.0), point_b=(0.0, 0.0))
    frames = [planar.BarFrame("load", "rod", station=DESIGN["load.station"]), planar.BarFrame("tip", "rod")]
    pull = planar.PointForce("pull", "load", force=(0.1, 0.3))
    forces = [pull, mb.Gravity((0.0, -9.81))]
    return mb.Scene([rod], joints=[clamp], forces=forces, frames=frames).compile()


def check_derivatives(output, rtol, given=DESIGN, batched=True):
    """Forward mode, reverse mode and central differences, by relative changes of the design."""
    names, values = zip(*given.items(), strict=True)
    of = jax.jit(lambda x: output({name: x[k] * values[k] for k, name in enumerate(names)}))
    one = np.ones(len(names))
    reverse, forward = jax.jit(jax.grad(of))(one), jax.jit(jax.jacfwd(of))(one)
    np.testing.assert_allclose(forward, reverse, rtol=1e-8, atol=1e-12)
    steps = 1e-4 * np.eye(len(names))
    changed = np.concatenate([one + steps, one - steps])
    ends = np.asarray(jax.vmap(of)(changed) if batched else [of(x) for x in changed])
    differences = (ends[: len(names)] - ends[len(names) :]) / 2e-4
    np.testing.assert_allclose(reverse, differences, rtol=rtol, atol=rtol * np.max(np.abs(differences)))
    assert np.all(np.abs(differences[:3]) > 1e-6)


@pytest.mark.slow
def test_derivatives_of_a_static_deflection():
    system = loaded_bar()

    def deflection(design):
        changed = mb.with_parameters(system, design)
        return mb.evaluate(changed, mb.equilibrium(changed), ["tip.deflection"])["tip.deflection"][1]

    check_derivatives(deflection, 1e-5)


@pytest.mark.slow
def test_derivatives_of_a_motion():
    system = loaded_bar()

    def place(design):
        changed = mb.with_parameters(system, design)
        return mb.simulate(changed, mb.assemble(changed), t1=0.05, rtol=1e-11).quantity("tip.position")[-1, 1]

    check_derivatives(place, 1e-4)


PROPPED = {name: value for name, value in DESIGN.items() if name.startswith("rod.")}
PROPPED |= {"prop.station": 0.7, "pull.force": np.array([-20.0, -15.0])}


def propped_bar():
    """Clamped, on a prop, with a load on its end that presses and bends it."""
    section: dict[str, Any] = {name.removeprefix("rod."): x for name, x in PROPPED.items() if name.startswith("rod.")}
    rod = planar.ElasticBar("rod", width=0.03, bending=3, **section)
    at = {"point_a": (0.0, 0.0), "point_b": (0.0, 0.0)}
    joints = [
        planar.Fixed("clamp", "ground", "rod", **at),
        planar.PointOnLine("slide", "ground", "prop", axis_a=(1.0, 0.0), **at),
    ]
    frames = [planar.BarFrame("prop", "rod", station=PROPPED["prop.station"]), planar.BarFrame("tip", "rod")]
    forces = [planar.PointForce("pull", "tip", force=PROPPED["pull.force"]), mb.Gravity((0.0, -9.81))]
    return mb.Scene([rod], joints=joints, forces=forces, frames=frames).compile()


@pytest.mark.slow
@pytest.mark.parametrize("of", ["deflection", "frequency"])
def test_derivatives_by_the_place_of_a_joint_and_by_a_load(of):
    """And by the numbers of the bar, of a deflection and of the lowest frequency about the loaded bar."""
    system = propped_bar()

    def output(design):
        changed = mb.with_parameters(system, design)
        rest = mb.equilibrium(changed)
        if of == "frequency":
            return mb.linearise(changed, rest).frequencies[0]
        return mb.evaluate(changed, rest, ["tip.deflection"])["tip.deflection"][1]

    check_derivatives(output, 1e-6, PROPPED, batched=False)


@pytest.mark.slow
def test_derivatives_through_an_impact_of_a_bar():
    """A bar springs back, and its end strikes a stop once."""
    given = {name: value for name, value in DESIGN.items() if name.startswith("rod.")}
    section: dict[str, Any] = {name.removeprefix("rod."): value for name, value in given.items()}
    rod = planar.ElasticBar("rod", width=0.03, damping=1e-3, **section)
    joints = [
        planar.Fixed("clamp", "ground", "rod", point_a=(0.0, 0.0), point_b=(0.0, 0.0)),
        mb.RigidContact("stop", "tip", terrain=mb.terrain.Flat(-0.02), radius=0.01, restitution=0.5),
    ]
    system = mb.Scene([rod], joints=joints, frames=[planar.BarFrame("tip", "rod")]).compile()

    def run(design):
        changed = mb.with_parameters(system, design)
        start = mb.assemble(changed, fix={"rod.bend_1": 0.05, "rod.bend_2": 0.0})
        return mb.simulate(changed, start, t1=0.066, rtol=1e-10, atol=1e-12)

    assert len(run(given).events) == 1
    check_derivatives(lambda design: run(design).quantity("tip.position")[-1, 1], 1e-4, given, batched=False)


def bar(**changed):
    return planar.ElasticBar("rod", **{"length": 1.0, **STEEL} | changed)


def body(**changed):
    arrays = planar.ElasticBody.from_nodes("body", random_model(2), interfaces={})[0]
    return arrays.with_fields(**changed)


REFUSED = {
    "short": (lambda: [bar(length=0.0)], (), "length must be positive"),
    "soft": (lambda: [bar(young=-1.0)], (), "young must be positive"),
    "light": (lambda: [bar(density=0.0)], (), "density must be positive"),
    "no section": (lambda: [bar(thickness=None)], (), "give width and thickness, or area, second_moment"),
    "two sections": (lambda: [bar(area=1e-3, second_moment=1e-8)], (), "give width and thickness, or area"),
    "no modes": (lambda: [bar(bending=0)], (), "has no modes"),
    "many modes": (lambda: [bar(bending=20)], (), "bending must be a number of modes to 8, got 20"),
    "beyond": (lambda: [bar()], [planar.BarFrame("tip", "rod", station=1.5)], "station must be from 0 to 1"),
    "offset": (lambda: [bar()], [planar.BarFrame("tip", "rod", offset=(0.1, 0.2))], r"offset must have shape \(\)"),
    "other": (lambda: [body()], [planar.BarFrame("tip", "body")], "a BarFrame is in an ElasticBar"),
    "asymmetric": (lambda: [body(stiffness=np.triu(np.ones((3, 3))))], (), "stiffness must be symmetric"),
    "unstable": (lambda: [body(stiffness=-np.eye(3))], (), "stiffness must be positive definite"),
    "shape": (lambda: [body(modal_moments=np.zeros((2, 2)))], (), r"modal_moments of 3 modes must have shape \(3, 2\)"),
    "names": (lambda: [body(names=("bend",))], (), "3 modes need as many names, got bend"),
    "frame": (
        lambda: [body()],
        [planar.ModalFrame("tip", "body", position=(0.0, 0.0), shapes=np.eye(2), turning=np.ones((1, 2)))],
        "shapes and turning of 3 modes",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_elastic_part_is_refused(case):
    bodies, frames, message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        mb.Scene(bodies(), frames=frames).compile()
