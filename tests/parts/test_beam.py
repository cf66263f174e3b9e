"""Beams: closed forms of one element, and published values of chains, to which they converge."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from oracles.beams import tip

import jaxmb as mb
from jaxmb import planar, sections, spatial
from jaxmb.parts.planar.kinematics import PLANE
from jaxmb.parts.spatial.kinematics import SPACE

L = 0.8
EA, GA, EI = 90.0, 60.0, 4.0
ALONG = sections.Section(bending_stiffness=EI, axial_stiffness=EA, shear_stiffness=GA)
DEEP = sections.Section(
    bending_stiffness=(2.0, EI), torsional_stiffness=3.0, axial_stiffness=EA, shear_stiffness=(50.0, GA)
)
BENT = {"bending_stiffness": 1.0}
IDENTITY = (1.0, 0.0, 0.0, 0.0)


def resolved(space, part):
    given = np.stack([np.asarray(space.ground)] * 2)
    given[1, 0] = L
    return part.resolve(space, given), given


# Sections


def test_torsion_of_rectangles():
    """Timoshenko and Goodier, section 94; either side may be the longer one, also for derivatives."""
    torsion = lambda y, z: sections.Rectangle(thickness=y, width=z, modulus=1.0, poisson_ratio=0.3).second_moments[0]
    for ratio, expected in ((1.0, 0.1406), (2.0, 0.229), (10.0, 0.312)):
        np.testing.assert_allclose(torsion(0.1, 0.1 * ratio) / (ratio * 1e-4), expected, rtol=0, atol=6e-4)
        np.testing.assert_allclose(torsion(0.1, 0.1 * ratio), torsion(0.1 * ratio, 0.1), rtol=1e-15)
    # Of the square, by a double Fourier series.
    m = np.arange(1.0, 400.0, 2.0)
    series = 256 / np.pi**6 * np.sum(1 / (m[:, None] ** 2 * m**2 * (m[:, None] ** 2 + m**2)))
    np.testing.assert_allclose(torsion(1.0, 1.0), series, rtol=1e-6)
    slopes = jax.jit(jax.vmap(jax.grad(torsion, (0, 1))))
    y, z = np.array([1.0, 1.0, 0.01]), np.array([1.0, 1.3, 2.0])
    for k, found in enumerate(slopes(y, z)):
        step = 1e-5 * np.eye(2)[k]
        change = [torsion(a + s * step[0], b + s * step[1]) for a, b in zip(y, z, strict=True) for s in (1, -1)]
        np.testing.assert_allclose(found, (np.array(change[::2]) - np.array(change[1::2])) / 2e-5, rtol=1e-6, atol=1e-8)


def test_stiffnesses_of_shapes():
    E, nu, y, z, r = 7e10, 0.31, 2e-3, 5e-3, 1e-3
    G = E / 2.62
    strip = sections.Rectangle(thickness=y, width=z, modulus=E, poisson_ratio=nu)
    wire = sections.Circle(radius=r, modulus=E, poisson_ratio=nu)
    flat, round_ = 13.1 / 15.41, 7.86 / 8.86
    np.testing.assert_allclose(strip.extension(3), y * z * np.array([E, flat * G, flat * G]), rtol=1e-14)
    np.testing.assert_allclose(wire.extension(3), np.pi * r**2 * np.array([E, round_ * G, round_ * G]), rtol=1e-14)
    np.testing.assert_allclose(strip.bending(3)[1:], [E * y * z**3 / 12, E * z * y**3 / 12], rtol=1e-14)
    np.testing.assert_allclose(wire.bending(3), np.pi * r**4 / 4 * np.array([2 * G, E, E]), rtol=1e-14)
    np.testing.assert_array_equal(strip.bending(2), strip.bending(3)[2:])
    np.testing.assert_array_equal(strip.extension(2), strip.extension(3)[:2])
    np.testing.assert_allclose(DEEP.extension(3), [EA, 50.0, GA], rtol=0)
    np.testing.assert_allclose(DEEP.bending(3), [3.0, 2.0, EI], rtol=0)


# One element


def of_bending(bending, shear):
    """The stiffness of a beam against a deflection and a turn of its end, by Timoshenko's theory (J. S. Przemieniecki,
    "Theory of Matrix Structural Analysis", McGraw-Hill 1968, section 5.6).
    """
    phi = 12 * bending / (shear * L**2)
    return bending / (L**3 * (1 + phi)) * np.array([[12.0, -6 * L], [-6 * L, (4 + phi) * L**2]])


@functools.partial(jax.jit, static_argnums=0)
def observed(space, part, poses, velocities):
    """The quantities at several poses and velocities."""
    return jax.vmap(lambda q, v: part.observables(space, q, v, 0.0))(poses, velocities)


def test_stiffness_at_rest_is_that_of_the_element_of_timoshenko():
    """Of a displacement and a turn of B, as of the exact solution, by forward and by reverse mode."""
    part, given = resolved(PLANE, planar.Beam("F", "a", "b", section=ALONG))
    energy = lambda x: part.energy(PLANE, jnp.stack([jnp.asarray(given[0]), given[1] + x]), 0.0)
    found = jax.jit(lambda x: (jax.hessian(energy)(x), jax.jacrev(jax.grad(energy))(x), jax.grad(energy)(x)))(
        np.zeros(3)
    )
    expected = np.diag([EA / L, 0.0, 0.0])
    expected[1:, 1:] = of_bending(EI, GA)
    for matrix in found[:2]:
        np.testing.assert_allclose(matrix, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found[2], 0.0, atol=1e-13)


@pytest.mark.slow
def test_stiffness_at_rest_in_space():
    part, given = resolved(SPACE, spatial.Beam("F", "a", "b", section=DEEP))

    def wrench(x):
        half = jnp.concatenate([jnp.ones(1), x[3:] / 2])
        pose = jnp.concatenate([given[1, :3] + x[:3], half / jnp.sqrt(half @ half)])
        poses = jnp.stack([jnp.asarray(given[0]), pose])
        return part.wrenches(SPACE, poses, jnp.zeros((2, 6)), 0.0)[1]

    expected = np.diag([EA / L, 0.0, 0.0, 3.0 / L, 0.0, 0.0])
    expected[np.ix_([1, 5], [1, 5])] = of_bending(EI, 50.0)
    # A deflection along z goes with a turn about -y.
    expected[np.ix_([2, 4], [2, 4])] = of_bending(2.0, GA) * [[1, -1], [-1, 1]]
    np.testing.assert_allclose(jax.jit(jax.jacfwd(wrench))(np.zeros(6)), -expected, rtol=0, atol=1e-12)


ANGLES = np.array([0.0, 0.5, 2.9])
COS, SIN, ZERO = np.cos(ANGLES / 2), np.sin(ANGLES / 2), np.zeros(3)


def turned(given, *rows):
    """Poses with B moved from the given poses."""
    return np.stack([np.broadcast_to(given[0], (3, len(rows))), np.stack(rows, axis=1)], axis=1)


def test_pure_bending():
    """Sections at the ends of circular arcs: the moment is the stiffness times the angle over the length."""
    part, given = resolved(PLANE, planar.Beam("F", "a", "b", section=ALONG))
    seen = observed(PLANE, part, turned(given, L * COS, L * SIN, ANGLES), np.zeros((3, 2, 3)))
    np.testing.assert_allclose(seen["strain"], [[1.0, 0.0]] * 3, rtol=0, atol=1e-14)
    np.testing.assert_allclose(seen["curvature"], ANGLES / L, rtol=1e-14)
    np.testing.assert_allclose(seen["section_moment"], EI * ANGLES / L, rtol=1e-14)


@pytest.mark.slow
def test_pure_bending_and_torsion_in_space():
    part, given = resolved(SPACE, spatial.Beam("F", "a", "b", section=DEEP))
    bent = turned(given, L * COS, L * SIN, ZERO, COS, ZERO, ZERO, SIN)
    twisted = turned(given, ZERO + L, ZERO, ZERO, COS, SIN, ZERO, ZERO)
    for poses, stiffness in ((bent, [0.0, 0.0, EI]), (twisted, [3.0, 0.0, 0.0])):
        seen = observed(SPACE, part, poses, np.zeros((3, 2, 6)))
        np.testing.assert_allclose(seen["strain"], [[1.0, 0.0, 0.0]] * 3, rtol=0, atol=1e-14)
        np.testing.assert_allclose(seen["section_moment"], np.outer(ANGLES / L, stiffness), rtol=1e-13, atol=1e-14)


def test_stretch_shear_and_damping():
    """Of a beam that is pulled, sheared and moves on; a tension is positive."""
    part, given = resolved(PLANE, planar.Beam("F", "a", "b", section=ALONG, damping_time=0.1))
    poses, velocities = given + np.array([[0.0] * 3, [0.02, 0.01, 0.0]]), np.array([[0.0] * 3, [0.3, -0.2, 0.0]])
    seen = observed(PLANE, part, poses[None], velocities[None])
    wrenches = np.asarray(jax.jit(lambda q, v: part.wrenches(PLANE, q, v, 0.0))(poses, velocities))
    force = np.array([EA / L * (0.02 + 0.1 * 0.3), of_bending(EI, GA)[0, 0] * (0.01 - 0.1 * 0.2)])
    np.testing.assert_allclose(seen["section_force"][0], force, rtol=1e-13)
    np.testing.assert_allclose(wrenches[1, :2], -force, rtol=1e-12)
    # Without bending the moments of both ends are equal, and balance the pair of forces.
    pair = poses[1, 0] * force[1] - poses[1, 1] * force[0]
    np.testing.assert_allclose(wrenches[:, 2], pair / 2, rtol=1e-12)


def test_rows_of_an_inextensible_beam():
    """A tension holds back a stretch, and a shear force a shear: the rows fall where these grow, but not by bending."""
    part, given = resolved(PLANE, planar.InextensibleBeam("F", "a", "b", section=sections.Section(**BENT)))
    assert part.rows == 2
    stretched = given + np.array([[0.0] * 3, [0.02, 0.01, 0.0]])
    np.testing.assert_allclose(part.residual(PLANE, stretched, 0.0), [-0.02, -0.01], rtol=1e-12)
    bent = turned(given, L * COS, L * SIN, ANGLES)[2]
    np.testing.assert_allclose(part.residual(PLANE, bent, 0.0), 0.0, atol=1e-15)
    bending = part.components()[1].energy(PLANE, bent, 0.0)
    np.testing.assert_allclose(bending, 0.5 * ANGLES[2] ** 2 / L, rtol=1e-13)


def test_curved_at_rest():
    """Sections along the tangents of an arc: curved without a force, and straight with a moment. A free curvature that
    grows is a rate of bending.
    """
    angle, still = 0.6, np.zeros((2, 2, 3))
    end = np.array([L * np.cos(angle / 2), L * np.sin(angle / 2), angle])
    poses = np.stack([np.zeros(3), end])
    part = planar.Beam("F", "a", "b", section=ALONG, angle_a=0.0, angle_b=0.0, damping_time=0.5).resolve(PLANE, poses)
    np.testing.assert_allclose(part.free_curvature, angle / L, rtol=1e-15)
    straight = np.stack([np.zeros(3), [L, 0.0, 0.0]])
    seen = observed(PLANE, part, np.stack([poses, straight]), still)
    np.testing.assert_allclose(seen["section_force"][0], 0.0, atol=1e-13)
    np.testing.assert_allclose(seen["section_moment"], [0.0, -EI * angle / L], rtol=1e-13, atol=1e-14)
    drift = jax.tree.map(lambda _: None, part).with_fields(free_curvature=np.array(2.0))
    seen = observed(PLANE, part.with_fields(drift=drift), poses[None], still[:1])
    np.testing.assert_allclose(seen["section_moment"], -EI * 0.5 * 2.0, rtol=1e-13)
    poses = np.stack([SPACE.ground, [*end[:2], 0.0, np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)]])
    deep = spatial.Beam("F", "a", "b", section=DEEP, orientation_a=IDENTITY, orientation_b=IDENTITY)
    deep = deep.resolve(SPACE, poses)
    np.testing.assert_allclose(deep.free_curvature, [0.0, 0.0, angle / L], rtol=0, atol=1e-15)
    np.testing.assert_allclose(deep.free_strain, [1.0, 0.0, 0.0], rtol=0, atol=1e-15)


def test_sections_in_turned_bodies():
    """By default x leads from A to B at the given poses, and y and z follow from the axes of A by the shortest turn."""
    turned = np.asarray(mb.rotations.from_axis_angle((0.3, -0.5, 0.8), 1.2))
    place = np.array([0.4, -0.7, 0.2])
    poses = np.stack([np.append(np.ones(3), IDENTITY), np.append(np.ones(3) + place, turned)])
    part = spatial.Beam("F", "a", "b", section=DEEP).resolve(SPACE, poses)
    axes = np.asarray(mb.rotations.rotation_matrix(part.orientation_a))
    np.testing.assert_allclose(axes[:, 0], place / np.linalg.norm(place), rtol=1e-14)
    other = np.asarray(mb.rotations.rotation_matrix(mb.rotations.multiply(turned, part.orientation_b)))
    np.testing.assert_allclose(other, axes, rtol=0, atol=1e-14)
    # The axis of the shortest turn stays.
    across = np.cross([1.0, 0.0, 0.0], place)
    np.testing.assert_allclose(axes @ across, across, rtol=0, atol=1e-14)
    back = np.stack([np.asarray(SPACE.ground), np.append([-L, 0.0, 0.0], IDENTITY)])
    part = spatial.Beam("F", "a", "b", section=DEEP).resolve(SPACE, back)
    np.testing.assert_allclose(mb.rotations.rotate(part.orientation_a, np.eye(3)[0]), [-1, 0, 0], rtol=0, atol=1e-15)


REFUSED = [
    (PLANE, sections.Section(**BENT), {}, "lacks axial_stiffness or shear_stiffness"),
    (PLANE, DEEP, {}, "section.bending_stiffness must be one number, got"),
    (PLANE, ALONG, {"free_curvature": (0.0, 0.0)}, r"free_curvature must have shape \(\)"),
    (PLANE, ALONG, {"damping_time": -1.0}, "damping_time must be non-negative"),
    (PLANE, ALONG, {"point_b": (-L, 0.0)}, "its points coincide"),
    (SPACE, ALONG, {}, "its section has no torsional_stiffness"),
    (SPACE, DEEP, {"angle_a": 0.0}, "angle_a belongs to planar scenes"),
    (PLANE, 2.0, {}, "section must be a section, such as"),
]


@pytest.mark.parametrize(("space", "section", "options", "message"), REFUSED)
def test_beam_that_is_refused(space, section, options, message):
    with pytest.raises(ValueError, match=f"'J': .*{message}"):
        resolved(space, planar.Beam("J", "a", "b", section=section, **options))


# Chains


def chain(space, points, section, force=None, *, frame="world", **options):
    """A chain that is clamped at its first point, with a force on the last node."""
    own = space.beam_chain("b", points, section, **({"mass": 1.0} | options))
    force = np.zeros(np.shape(points)[1]) if force is None else force
    load = space.PointForce("load", f"b_node{len(points) - 1}", force=force, frame=frame)
    return mb.Scene(own.bodies, joints=own.joints, forces=[*own.forces, load]).compile()


def line(n, length=1.0, dimension=2):
    return np.linspace(np.zeros(dimension), length * np.eye(dimension)[0], n + 1)


def test_nodes_of_a_chain():
    """Their mass, mass centre, and inertia about the middle are those of the beam."""
    n, length, mass = 6, 2.0, 3.0
    cell = mass / n
    strip = sections.Rectangle(thickness=0.1, width=0.3, modulus=1.0, poisson_ratio=0.3)
    for space, points in ((planar, line(n, length)), (spatial, line(n, length, 3))):
        own = space.beam_chain("b", points, strip, mass=mass, ends=("ground", "other"), damping_time=0.2)
        assert [body.name for body in own.bodies] == [f"b_node{k}" for k in range(n + 1)]
        assert [part.name for part in (*own.joints, *own.forces)] == [
            "b_start",
            "b_end",
            *(f"b{k}" for k in range(1, n + 1)),
        ]
        assert [part.bodies for part in own.joints] == [("ground", "b_node0"), ("other", "b_node6")]
        assert all(part.damping_time == 0.2 for part in own.forces)
        masses = np.array([body.mass for body in own.bodies])
        np.testing.assert_allclose(masses, cell * np.array([9, 28, 23, 24, 23, 28, 9]) / 24, rtol=1e-13)
        about_z = np.array([body.inertia if space is planar else body.inertia[2, 2] for body in own.bodies])
        np.testing.assert_allclose(about_z, masses * 0.01 / 12, rtol=1e-13)
        places = np.array(points)[:, 0] - length / 2
        whole = mass * (length**2 + 0.01) / 12
        np.testing.assert_allclose(
            [np.sum(masses * places), np.sum(about_z + masses * places**2)], [0.0, whole], atol=1e-12
        )
    radii = np.array([0.01 + 0.09, 0.09, 0.01]) / 12
    np.testing.assert_allclose(np.diag(own.bodies[1].inertia) / masses[1], radii, rtol=1e-13)
    hard = planar.beam_chain("b", line(n, length), strip, mass=mass, inextensible=True)
    halves = cell * np.array([0.5, 1, 1, 1, 1, 1, 0.5])
    np.testing.assert_allclose([body.mass for body in hard.bodies], halves, rtol=1e-13)
    radius = (0.01 + (length / n) ** 2) / 12
    np.testing.assert_allclose([body.inertia for body in hard.bodies], halves * radius, rtol=1e-13)


@pytest.mark.parametrize("lengths", [(1.0,), (1.0, 1.0), (1.0, 1.4, 0.8), (3.0, 1.0, 1.0), (1.0, 0.1, 4.0)])
def test_nodes_between_beams_of_several_lengths(lengths):
    """Each has a mass, and all together have that of the beam."""
    places = np.concatenate([[0.0], np.cumsum(lengths)])
    own = planar.beam_chain("b", np.stack([places, 0 * places], axis=1), ALONG, mass=places[-1])
    masses = np.array([body.mass for body in own.bodies])
    assert np.all(masses > 0)
    np.testing.assert_allclose(np.sum(masses), places[-1], rtol=1e-13)


@pytest.mark.slow
def test_frequencies_of_an_elastic_chain():
    """Of a thin cantilever. They err by the fourth power of the length of a beam: with 4 beams by twenty times as much,
    and with 8 inextensible beams by 0.7 percent.
    """
    thin = sections.Section(bending_stiffness=1.0, axial_stiffness=1e6, shear_stiffness=1e6)
    own = planar.beam_chain("b", line(8), thin, mass=1.0)
    system = mb.Scene(own.bodies, joints=own.joints, forces=own.forces).compile()
    frequencies = mb.linearise(system, mb.assemble(system)).frequencies[:4:2]
    assert np.all(np.abs(frequencies / np.array([3.5160152687, 22.0344915644]) - 1) < [1e-4, 5e-4])


def test_chain_along_a_curve():
    """Its nodes have their x axes along the tangents, the first one its y axis in the given plane."""
    angles = np.linspace(0.0, 1.0, 6)
    arc = np.stack([np.sin(angles), 1 - np.cos(angles), np.zeros(6)], axis=1)
    own = spatial.beam_chain("b", arc, DEEP, mass=1.0, y=(0.0, 0.0, 2.0), ends=(None, None), inextensible=True)
    assert not own.forces and len(own.joints) == 5
    for body, angle in zip(own.bodies[1:-1], angles[1:-1], strict=True):
        axes = np.asarray(mb.rotations.rotation_matrix(body.orientation))
        np.testing.assert_allclose(axes[:, 0], [np.cos(angle), np.sin(angle), 0.0], rtol=0, atol=1e-14)
        np.testing.assert_allclose(axes[:, 1], [0.0, 0.0, 1.0], rtol=0, atol=1e-14)
    flat = planar.beam_chain("b", arc[:, :2], ALONG, mass=1.0)
    np.testing.assert_allclose([body.angle for body in flat.bodies[1:-1]], angles[1:-1], rtol=1e-13)


@pytest.mark.parametrize(
    ("points", "section", "message"),
    [
        (np.zeros(3), ALONG, r"points must have shape \(n \+ 1, 2\)"),
        (np.zeros((3, 2)), ALONG, "neighbouring points coincide"),
        (line(2, 1.0, 3), sections.Section(torsional_stiffness=1.0, **BENT), "lacks axial_stiffness"),
    ],
)
def test_chain_that_is_refused(points, section, message):
    with pytest.raises(ValueError, match=message):
        planar.beam_chain("b", points, section, mass=1.0)


# Chains at rest, against published values. Errors are multiples of the square of the number of elements, then of its
# fourth power.


def extrapolated(values):
    """From values with numbers of elements that double."""
    for order in range(1, len(values)):
        share = 4.0**order
        values = [(share * b - a) / (share - 1) for a, b in itertools.pairwise(values)]
    return values[0]


def at_end(system, guess=None):
    """The position of the last node, and its angle in the plane."""
    state = mb.equilibrium(system, guess)
    return np.asarray(state.q[-3:] if system.layout.space.dimension == 2 else state.q[-7:-4])


# The shortening 1 - x, the deflection y and the angle of the tip, by the load P L²/EI.
ELASTICA = {
    1.0: (0.0564332363, 0.3017207738, 0.4613519497),
    5.0: (0.3876283607, 0.7137915236, 1.2153681176),
    10.0: (0.5549955978, 0.8106090249, 1.4302855388),
}


@pytest.mark.slow
def test_elastica():
    """Bisshopp and Drucker 1945, by elliptic integrals."""
    wire, found = sections.Section(bending_stiffness=1.0), {}
    for n in (4, 8, 16):
        system = chain(planar, line(n), wire, inextensible=True)
        for load in ELASTICA:
            end = at_end(mb.with_parameters(system, {"load.force": (0.0, load)}))
            found.setdefault(load, []).append(np.array([1 - end[0], end[1], end[2]]))
    for load, values in found.items():
        errors = np.abs(np.array(values) - ELASTICA[load])
        np.testing.assert_allclose(errors[2] / errors[1], 0.25, atol=0.02)
        np.testing.assert_allclose(extrapolated(values), ELASTICA[load], rtol=0, atol=1e-6)


@pytest.mark.slow
def test_thick_cantilever_in_large_deflection():
    """K. Nachbagauer et al. 2011."""
    E, height, width, length = 2.07e11, 0.5, 0.1, 2.0
    thick = sections.Rectangle(thickness=height, width=width, modulus=E, poisson_ratio=0.3)
    force = (0.0, -5e8 * height**3)
    values = [at_end(chain(planar, line(n, length), thick, force))[:2] - [length, 0.0] for n in (4, 8, 16)]
    np.testing.assert_allclose(extrapolated(values), [-0.15097103, -0.71056837], rtol=0, atol=1e-6)


RADIUS = 100.0
SQUARE = sections.Section(
    bending_stiffness=1e7 / 12, torsional_stiffness=5e6 * 0.1406, axial_stiffness=1e7, shear_stiffness=5e6
)
UP = (0.0, 0.0, 600.0)


def arc(angles):
    return RADIUS * np.stack([np.sin(angles), 1 - np.cos(angles), np.zeros_like(angles)], axis=1)


def bend(n):
    """Bathe's and Bolourchi's cantilever, an eighth of a circle: each beam is an arc."""
    angles = np.linspace(0.0, np.pi / 4, n + 1)
    turned = [np.asarray(mb.rotations.from_axis_angle((0.0, 0.0, 1.0), angle)) for angle in angles]
    nodes = [
        spatial.Body(f"node{k}", mass=1.0, inertia=(1.0, 1.0, 1.0), position=at, orientation=turn)
        for k, (at, turn) in enumerate(zip(arc(angles), turned, strict=True))
    ]
    own = {"section": SQUARE, "length": RADIUS * np.pi / 4 / n, "orientation_a": IDENTITY, "orientation_b": IDENTITY}
    beams = [spatial.Beam(f"beam{k}", f"node{k}", f"node{k + 1}", **own) for k in range(n)]
    clamp = spatial.Fixed("clamp", "ground", "node0", point=(0.0, 0.0, 0.0))
    load = spatial.PointForce("load", f"node{n}", force=UP)
    return mb.Scene(nodes, joints=[clamp], forces=[*beams, load]).compile()


@pytest.mark.slow
def test_curved_cantilever_in_space():
    """Sixteen arcs, and eight straight beams, against the differential equations; a published deflection by sixteen
    elements, without the residual bending flexibility, differs from these by 0.024.
    """
    start = arc(np.array([np.pi / 4]))[0]
    fine = at_end(bend(16)) - start
    extension, bending = np.asarray(SQUARE.extension(3)), np.asarray(SQUARE.bending(3))
    end, _ = tip(RADIUS * np.pi / 4, extension, bending, UP, (0.0, 0.0, 1 / RADIUS))
    np.testing.assert_allclose(end - start, [-23.795, -13.719, 53.588], rtol=0, atol=0.024)
    np.testing.assert_allclose(fine, end - start, rtol=0, atol=0.018)
    straight = at_end(chain(spatial, arc(np.linspace(0.0, np.pi / 4, 9)), SQUARE, UP)) - start
    np.testing.assert_allclose(straight, end - start, rtol=0, atol=0.045)


@pytest.mark.slow
def test_princeton_beam():
    """The experiment of Dowell and Traybar 1975, a load at 45° to the sides of a thin beam that bends and twists:
    against the differential equations, and a published deflection across the thin side.
    """
    length, strip = 0.508, {"thickness": 12.3777e-3, "width": 3.2024e-3, "modulus": 71.7e9, "poisson_ratio": 0.31}
    section = sections.Rectangle(**strip)
    force = 13.345 * np.array([0.0, np.cos(np.pi / 4), np.sin(np.pi / 4)])
    values = [at_end(chain(spatial, line(n, length, 3), section, force)) for n in (4, 8)]
    end, _ = tip(length, np.asarray(section.extension(3)), np.asarray(section.bending(3)), force)
    np.testing.assert_allclose(extrapolated(values), end, rtol=0, atol=3e-5)
    np.testing.assert_allclose(end[2], 0.1564672, rtol=1e-3)


# Small motions


def column(n):
    """Squares of eigenvalues of a cantilever by a force along its tip, and by a factor of its thickness."""
    section = sections.Rectangle(thickness=1e-3, width=1.0, modulus=12e9, poisson_ratio=0.3)
    system = chain(planar, line(n), section, frame="body", inextensible=True)
    state = mb.assemble(system)
    names = [f"b{k}.section.thickness" for k in range(1, n + 1)]

    @jax.jit
    def squares(load, thickness=1.0):
        """Squares of the smallest eigenvalues, of one of each pair."""
        numbers = dict.fromkeys(names, 1e-3 * thickness) | {"load.force": jnp.stack([-load, jnp.zeros_like(load)])}
        values = jnp.linalg.eigvals(mb.linearise(mb.with_parameters(system, numbers), state).A)
        return values[jnp.argsort(jnp.abs(values))[:4:2]] ** 2

    return squares


def apart(squares):
    """The square of the difference of two squares, negative where they are complex."""
    return ((squares[0] - squares[1]) ** 2).real


def flutter(squares, thickness=1.0):
    """The load at which the two smallest frequencies meet, by the secant method."""
    a, b = 19.0 * thickness**3, 19.5 * thickness**3
    x, y = (float(apart(squares(load, thickness))) for load in (a, b))
    for _ in range(12):
        if abs(b - a) < 1e-9 * b:
            break
        a, b, x = b, b - y * (b - a) / (y - x), y
        y = float(apart(squares(b, thickness)))
    return b


@pytest.mark.slow
def test_free_and_loaded_column():
    """The frequencies of a cantilever, and the load and the frequency at which Beck's column flutters under a force
    along its tip, of an Euler-Bernoulli beam. With 16 beams this frequency errs by 0.4 percent, and by 0.004 percent
    after extrapolation from 4, 8 and 16.
    """
    frequencies, critical = [], []
    for n in (4, 8, 16):
        squares = column(n)
        frequencies.append(np.sqrt(-np.asarray(squares(0.0)).real))
        load = flutter(squares)
        critical.append(np.array([load, np.sqrt(-np.mean(squares(load)).real)]))
    np.testing.assert_allclose(extrapolated(frequencies), [3.5160152687, 22.0344915644], rtol=5e-4)
    np.testing.assert_allclose(extrapolated(critical), [20.0509536190, 11.0155576439], rtol=1e-4)


@pytest.mark.slow
def test_load_of_flutter_by_thickness():
    """It grows with the cube of the thickness, since the masses of nodes are numbers of their own. Where the
    frequencies meet, they have no derivatives, and the load has.
    """
    squares = column(4)
    load = flutter(squares)
    unmet = jax.jit(jax.grad(lambda load, thickness: apart(squares(load, thickness)), (0, 1)))
    by_load, by_thickness = unmet(load * (1 - 1e-6), 1.0)
    slope = -by_thickness / by_load
    np.testing.assert_allclose(slope, 3 * load, rtol=1e-5)
    differences = (flutter(squares, 1.001) - flutter(squares, 0.999)) / 2e-3
    np.testing.assert_allclose(slope, differences, rtol=1e-4)


def turning_modes(stiffness, count=16):
    """Squares of frequencies out of the plane of a rotating inextensible beam with a hinge on the axis; in the plane
    they are lower by one. Mass, length and speed are one, and the tension is `(1 - x²) / 2`. By Ritz's method.
    """
    nodes, weights = np.polynomial.legendre.leggauss(60)
    x, weights = 0.5 + 0.5 * nodes, 0.5 * weights
    of = [
        np.polynomial.Polynomial.basis(1)
        * np.polynomial.Legendre.basis(k, (0, 1)).convert(kind=np.polynomial.Polynomial)
        for k in range(count)
    ]
    shape, slope, curve = (np.array([own.deriv(m)(x) for own in of]) for m in range(3))
    energy = (slope * weights * (1 - x**2) / 2) @ slope.T + stiffness * (curve * weights) @ curve.T
    return scipy.linalg.eigh(energy, (shape * weights) @ shape.T, eigvals_only=True)


def test_turning_chain_of_links():
    """Without stiffness, the squares of the frequencies are n (2 n - 1)."""
    np.testing.assert_allclose(turning_modes(0.0)[:4], [1.0, 6.0, 15.0, 28.0], rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("space", "counts", "rtol"), [(planar, (8, 16), 3e-3), (spatial, (4, 8), 1.5e-2)])
def test_frequencies_of_a_turning_chain(space, counts, rtol):
    """The lowest about a steady rotation, in its plane, and in space out of it."""
    d, found = 2 if space is planar else 3, []
    twist = {} if d == 2 else {"torsional_stiffness": 1.0}
    section = sections.Section(bending_stiffness=1e-3, axial_stiffness=10.0, shear_stiffness=1.0, **twist)
    expected = np.sqrt(turning_modes(1e-3)[1] - (d == 2))
    for n in counts:
        own = space.beam_chain("b", line(n, 1.0, d), section, mass=1.0, ends=(None, None), inextensible=True)
        hinge = (planar.Revolute if d == 2 else spatial.Spherical)("hinge", "ground", "b_node0", point=np.zeros(d))
        system = mb.Scene(own.bodies, joints=[hinge, *own.joints], forces=own.forces).compile()
        spin = {"angle_rate": 1.0} if d == 2 else {"angular_velocity": (0.0, 0.0, 1.0)}
        rates = {f"b_node{k}.{name}": value for k in range(n + 1) for name, value in spin.items()}
        values = np.abs(np.asarray(mb.linearise(system, mb.assemble(system, rates=rates)).eigenvalues).imag)
        found.append(values[np.argmin(np.abs(values - expected))])
    np.testing.assert_allclose(extrapolated(found), expected, rtol=rtol)


def strip_in_bending(n):
    """A strip along x, tall along z, with a load down at its end: its lowest squared frequency by the load."""
    section = sections.Section(
        bending_stiffness=(1e4, 1.0), torsional_stiffness=1.0, axial_stiffness=1e6, shear_stiffness=1e6
    )
    own = spatial.beam_chain("b", line(n, 1.0, 3), section, mass=1.0, y=(0.0, 1.0, 0.0), inextensible=True)
    load = spatial.PointForce("load", f"b_node{n}", force=np.zeros(3))
    system = mb.Scene(own.bodies, joints=own.joints, forces=[*own.forces, load]).compile()

    @jax.jit
    def lowest(load):
        loaded = mb.with_parameters(system, {"load.force": jnp.array([0.0, 0.0, -1.0]) * load})
        values = mb.linearise(loaded, mb.equilibrium(loaded)).eigenvalues
        return -(values[0] ** 2).real

    return lowest


@pytest.mark.slow
def test_lateral_buckling_of_a_strip():
    """Prandtl's load of a cantilever strip, 4.0125985 √(EI GJ) / L² (S. P. Timoshenko and J. M. Gere, "Theory of
    Elastic Stability", McGraw-Hill 1961, section 6.3).
    """
    # Beyond this load an equilibrium is a buckled strip.
    loads, found = np.array([3.6, 3.8, 4.0]), []
    for n in (4, 8):
        lowest = strip_in_bending(n)
        found.append(np.polyval(np.polyfit([lowest(load) for load in loads], loads, 2), 0.0))
    np.testing.assert_allclose(extrapolated(found), 4.0125985, rtol=5e-4)


# Section forces, motions and derivatives


@pytest.mark.slow
def test_spin_up():
    """The largest lag of the tip of a blade that spins up (T. R. Kane, R. R. Ryan, A. K. Banerjee 1987; J. C. Simo,
    L. Vu-Quoc 1986), a chain of hinged bars with springs: -0.574 after extrapolation.
    """
    length, mass, stiffness = 10.0, 12.0, 1.4e4
    angle = lambda t, p: 0.4 * (t**2 / 2 + (7.5 / np.pi) ** 2 * (jnp.cos(np.pi * t / 7.5) - 1))
    found = []
    for n in (4, 8):
        section = sections.Section(bending_stiffness=stiffness)
        own = planar.beam_chain("b", line(n, length), section, mass=mass, ends=("hub", None), inextensible=True)
        hub = planar.Body("hub", mass=1.0, inertia=1.0)
        joints = [
            planar.Revolute("axle", "ground", "hub", point=(0.0, 0.0)),
            planar.Driver("drive", "ground", "hub", quantity="angle", motion=angle),
        ]
        system = mb.Scene([hub, *own.bodies], joints=[*joints, *own.joints], forces=own.forces).compile()
        ts = np.linspace(6.0, 7.5, 61)
        motion = mb.simulate(
            system, mb.assemble(system), t1=7.5, saveat=ts, rtol=1e-6, solver=mb.solvers.Hermite(), max_steps=20000
        )
        tip, turn = np.asarray(motion[f"b_node{n}"].position), np.asarray(motion["hub"].angle)
        found.append(np.min(np.cos(turn) * tip[:, 1] - np.sin(turn) * tip[:, 0]))
    np.testing.assert_allclose(extrapolated(found), -0.574, rtol=0, atol=3e-3)


@pytest.mark.slow
def test_pendulum_bends_as_an_elastic_bar():
    """A bar of two modes falls from the horizontal, against chains of inextensible beams."""
    bar = {"length": 1.0, "width": 0.02, "thickness": 0.02}
    young, density, fall = 1e8, 1000.0, mb.Gravity((0.0, -9.81))
    at = {"point_a": (0.0, 0.0), "point_b": (0.0, 0.0)}
    rod = planar.ElasticBar("rod", young=young, density=density, bending=3, **bar)
    hung = planar.Revolute("pin", "ground", "rod", **at)
    single = mb.Scene([rod], joints=[hung], forces=[fall], frames=[planar.BarFrame("tip", "rod")]).compile()
    end = lambda system, name: np.asarray(
        mb.simulate(system, mb.assemble(system), t1=0.3, rtol=1e-8).quantity(f"{name}.position")[-1]
    )
    section = sections.Rectangle(thickness=0.02, width=0.02, modulus=young, poisson_ratio=0.3)
    found = []
    for n in (4, 8):
        own = planar.beam_chain("b", line(n), section, mass=0.4, ends=(None, None), inextensible=True)
        pin = planar.Revolute("pin", "ground", "b_node0", **at)
        found.append(end(mb.Scene(own.bodies, joints=[pin, *own.joints], forces=[fall]).compile(), f"b_node{n}"))
    expected = end(single, "tip")
    np.testing.assert_allclose(extrapolated(found), expected, rtol=0, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("inextensible", [False, True])
def test_section_forces_of_statics(inextensible):
    """At rest the moment of the middle section is the load times its arm about the middle of the chord, and the forces
    are the load in the axes of the middle section; so are the multipliers of a constraint.
    """
    force = np.array([-3.0, 5.0])
    system = chain(planar, line(3), ALONG, force, inextensible=inextensible)
    state = mb.equilibrium(system)
    names = ["b2.section_moment", "b_start.moment", *([] if inextensible else ["b2.section_force"])]
    seen = mb.evaluate(system, state, names)
    x, y, angles = np.asarray(state.q).reshape(-1, 3).T
    arm = np.array([x[3] - (x[1] + x[2]) / 2, y[3] - (y[1] + y[2]) / 2])
    cross = lambda a, b: a[0] * b[1] - a[1] * b[0]
    np.testing.assert_allclose(seen["b2.section_moment"], cross(arm, force), rtol=1e-8)
    np.testing.assert_allclose(seen["b_start.moment"], -cross((x[3], y[3]), force), rtol=1e-8)
    middle = (angles[1] + angles[2]) / 2
    turned = [
        np.cos(middle) * force[0] + np.sin(middle) * force[1],
        np.cos(middle) * force[1] - np.sin(middle) * force[0],
    ]
    motion = mb.simulate(system, state, t1=1e-3)
    found = motion.reactions["b2"].multipliers[0] if inextensible else seen["b2.section_force"]
    np.testing.assert_allclose(found, turned, rtol=1e-7)


def strip_at(x):
    """A chain of two beams with other numbers: modulus, thickness, length and load, relative to those given."""
    names = {f"b{k}.section.{name}": x[j] * given for k in (1, 2) for j, (name, given) in enumerate(GIVEN.items())}
    lengths = {f"b{k}.length": 0.5 * x[2] for k in (1, 2)}
    return mb.with_parameters(STRIP, names | lengths | {"load.force": x[3] * jnp.array([0.0, 0.4])})


GIVEN = {"modulus": 4e5, "thickness": 0.02}
STRIP = chain(planar, line(2), sections.Rectangle(width=0.3, poisson_ratio=0.3, **GIVEN), damping_time=1e-3)


def check_derivatives(of, *, rtol):
    """Forward mode, and reverse mode under `jit`, against each other and central differences."""
    x, steps = jnp.ones(4), 2e-5 * np.eye(4)
    forward = np.asarray(jax.jacfwd(of)(x))
    np.testing.assert_allclose(jax.jit(jax.jacrev(of))(x), forward, rtol=1e-8, atol=1e-10 * np.max(np.abs(forward)))
    between = lambda step: np.asarray(of(x + step)) - np.asarray(of(x - step))
    differences = np.stack([(8 * between(step) - between(2 * step)) / 2.4e-4 for step in steps], axis=1)
    np.testing.assert_allclose(forward, differences, rtol=rtol, atol=rtol * np.max(np.abs(differences)))


@pytest.mark.slow
def test_derivatives_of_a_deflection():
    """By modulus, thickness, length and load; in a batch, value by value."""
    of = lambda x: mb.equilibrium(strip_at(x)).q[-3:]
    check_derivatives(of, rtol=1e-6)
    batch = np.ones((2, 4)) + np.array([[0.0], [0.01]])
    np.testing.assert_allclose(jax.jit(jax.vmap(of))(batch), [of(row) for row in batch], rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_derivatives_of_a_motion():
    of = lambda x: mb.simulate((own := strip_at(x)), mb.assemble(own), t1=0.05, rtol=1e-10, atol=1e-12).ys.q[-1, -3:]
    check_derivatives(of, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("inextensible", [False, True])
def test_free_flight_keeps_energy_and_momentum(inextensible):
    """Of a chain in space that spins, bends and twists."""
    own = spatial.beam_chain(
        "b",
        line(3, 1.0, 3),
        sections.Circle(radius=0.05, modulus=4e5, poisson_ratio=0.3),
        mass=0.5,
        ends=(None, None),
        inextensible=inextensible,
    )
    system = mb.Scene(own.bodies, joints=own.joints, forces=own.forces).compile()
    rates = {"b_node0.angular_velocity": (3.0, 5.0, -4.0), "b_node3.angular_velocity": (-6.0, 1.0, 2.0)}
    motion = mb.simulate(
        system, mb.assemble(system, rates=rates), t1=0.5, rtol=1e-10, atol=1e-12, saveat=np.linspace(0, 0.5, 6)
    )
    bent = np.max(np.abs(motion["b2"].curvature), axis=0)
    assert np.all(bent > 1e-3)
    np.testing.assert_allclose(motion.energy, motion.energy[0], rtol=1e-8)
    masses = np.array([body.mass for body in own.bodies])
    momenta = sum(m * np.asarray(motion[body.name].velocity) for m, body in zip(masses, own.bodies, strict=True))
    np.testing.assert_allclose(momenta - momenta[0], 0.0, atol=1e-9)


def right_angle(n):
    """A right angle of two legs of n inextensible beams, clamped at one end, with the published numbers. A force at the
    elbow rises to 50 in the first second and falls to zero in the next (J. C. Simo, L. Vu-Quoc, Comput.
    Methods Appl. Mech. Engrg. 66(2), 1988).
    """
    stiff = {"axial_stiffness": 1e6, "shear_stiffness": 1e6}
    section = sections.Section(bending_stiffness=1e3, torsional_stiffness=1e3, **stiff)
    corner = (10.0, 0.0, 0.0)
    chain = functools.partial(spatial.beam_chain, section=section, mass=10.0, inextensible=True)
    legs = [
        chain("a", np.linspace((0.0, 0.0, 0.0), corner, n + 1)),
        chain("b", np.linspace(corner, (10.0, 10.0, 0.0), n + 1), ends=(f"a_node{n}", None)),
    ]
    length = 10.0 / n

    def with_inertia(body):
        # The rest of a half beam is about the node, which is at its end.
        share = body.mass / length
        turned = body.mass * length**2 / 12 * np.array([0.0, 1.0, 1.0])
        return body.with_fields(inertia=np.diag(share * length * np.array([20.0, 10.0, 10.0]) + turned))

    bodies = [with_inertia(body) for leg in legs for body in leg.bodies]
    load = spatial.PointForce("load", f"a_node{n}", force=(0.0, 0.0, 0.0))
    scene = mb.Scene(bodies, joints=[part for leg in legs for part in leg.joints], forces=[load])
    return mb.with_inputs(scene.compile(), {"load.force": right_angle_force})


def right_angle_force(t):
    return jnp.array([0.0, 0.0, 50.0]) * jnp.maximum(0.0, 1.0 - jnp.abs(t - 1.0))


@pytest.mark.slow
def test_right_angle_sways():
    """With 16 beams within 2 % of the limit; the energy after the load is the work of the load."""
    times, swings = np.concatenate([np.linspace(0.0, 2.0, 401), np.linspace(2.0, 30.0, 561)[1:]]), []
    for n in (4, 8):
        system = right_angle(n)
        motion = mb.simulate(system, mb.assemble(system), t1=30.0, rtol=1e-6, atol=1e-7, jumps=[1.0, 2.0], saveat=times)
        force = np.asarray(jax.vmap(right_angle_force)(times[:401]))[:, 2]
        power = force * np.asarray(motion[f"a_node{n}"].velocity)[:401, 2]
        np.testing.assert_allclose(
            motion.energy[400:] - motion.energy[0], scipy.integrate.simpson(power, x=times[:401]), rtol=1e-5
        )
        ends = [np.asarray(motion[name].position)[:, 2] for name in (f"a_node{n}", f"b_node{n}")]
        swings.append([extreme(z) for z in ends for extreme in (np.max, np.min)])
    limit = extrapolated(np.array(swings))
    assert np.all(np.abs(limit) > 4.0)
    np.testing.assert_allclose(swings[1], limit, rtol=0.02)
