"""Inertias of joints themselves: accelerations, energy and momentum by all formulations, motions and derivatives."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from every_formulation import FORMULATIONS

import jaxmb as mb
from jaxmb import parts, planar, spatial
from jaxmb.formulations import accelerations
from jaxmb.parts.planar.kinematics import PLANE

X, Y, Z = np.eye(3)
J = np.array([[0.05, 0.01, 0.0], [0.01, 0.09, 0.02], [0.0, 0.02, 0.07]])
SIZES = {"rotor": ("hip.angle", 0.7), "spindle": ("reach.displacement", 3.0), "winch": ("cord.length", 0.4)}


def arm(*inertias, floats=False):
    """A link on a hinge, and another that slides on it; a tendon along both. Its base is the ground, or floats."""
    bodies = [
        spatial.Body("link", mass=1.0, inertia=J, position=(0.5, 0.0, 0.0)),
        spatial.Body("hand", mass=0.4, inertia=0.5 * J, position=(1.0, 0.1, 0.0)),
    ]
    base = "base" if floats else "ground"
    bodies += [spatial.Body("base", mass=2.0, inertia=2 * J)] if floats else []
    hinge = {"point": (0.0, 0.0, 0.0), "axis": (0.0, 0.6, 0.8)}
    joints = [
        *inertias,
        spatial.Revolute("hip", base, "link", **hinge),
        spatial.Revolute("hip twin", base, "link", **hinge),
        spatial.Prismatic("reach", "link", "hand", point=(0.9, 0.0, 0.0), axis=(0.8, 0.0, 0.6)),
        mb.FixedTendon("cord", ("hip.angle", "reach.displacement"), coefficients=(0.3, 1.5)),
    ]
    spring = mb.JointSpring("spring", "reach.displacement", stiffness=40.0, free=0.1)
    forces = [spring] if floats else [spring, mb.Gravity((0.0, 0.0, -9.81))]
    return mb.Scene(bodies, joints=joints, forces=forces).compile()


def inertias():
    return [mb.JointInertia(name, coordinate, inertia=size) for name, (coordinate, size) in SIZES.items()]


def moving(system, **fix):
    random = np.random.default_rng(3)
    start = mb.assemble(system, fix={"hip.angle": 0.6, "reach.displacement": 0.2} | fix)
    return mb.manifold.project(system, 0.0, mb.State(start.q, jnp.asarray(random.normal(size=system.nu))))


def rates_of(system, q, u):
    """The rates of the coordinates that have inertias."""
    known, t = system.joint_coordinates(), jnp.zeros(())

    def single(name):
        value = lambda q: system.catalogue.joint_coordinate(known[name], t, q)
        return jax.jvp(value, (q,), (system.rates(t, q, u),))[1]

    return jnp.stack([single(name) for name, _ in SIZES.values()])


@jax.jit
def terms(system, q, u):
    """The gradients G of the rates, `Ġ u`, M, A, F and γ of a scene without the parts."""
    t, none = jnp.zeros(()), jnp.zeros(system.nu)
    G = jax.jacfwd(lambda u: rates_of(system, q, u))(u)
    bias = jax.jvp(lambda q: rates_of(system, q, u), (q,), (system.rates(t, q, u),))[1]
    mass, A = system.inertia(t, q, u).product(jnp.eye(system.nu)), system.jacobian(t, q, u)
    return G, bias, mass, A, system.force(t, q, u), -system.acceleration_residual(t, q, u, none)


def by_mass_matrix(system, q, u):
    """Its accelerations with `Σ inertia g gᵀ` in the mass matrix in addition, by NumPy."""
    G, bias, mass, A, force, gamma = map(np.asarray, terms(system, q, u))
    sizes = np.array([size for _, size in SIZES.values()])
    mass, force = mass + G.T @ (sizes[:, None] * G), force - G.T @ (sizes * bias)
    both = np.block([[mass, A.T], [A, np.zeros((len(A), len(A)))]])
    return np.linalg.lstsq(both, np.concatenate([force, gamma]))[0][: system.nu]


@pytest.mark.slow
def test_accelerations_by_all_formulations_are_those_of_the_exact_mass_matrix():
    """With redundant rows, and inertias of an angle, of a displacement and of a tendon along both."""
    plain, system = arm(), arm(*inertias())
    assert (system.nu, system.velocity_rank) == (plain.nu + 3, plain.velocity_rank + 3)
    state = moving(system)
    # The first coordinate after those of bodies is the angle of the hinge in either scene.
    n, m = plain.nq, plain.nu
    own = by_mass_matrix(plain, state.q[:n], state.u[:m])
    solve = jax.jit(lambda q, u: [accelerations(system, f, 0.0, q, u)[0] for f in FORMULATIONS.values()])
    found = solve(state.q, state.u)
    for name, udot in zip(FORMULATIONS, found, strict=True):
        np.testing.assert_allclose(udot[:m], own, rtol=0, atol=1e-11 * np.max(np.abs(own)), err_msg=name)


@pytest.mark.slow
def test_they_have_energy_but_neither_mass_nor_momentum():
    plain, system = arm(floats=True), arm(*inertias(), floats=True)
    state = moving(system)
    q, u = state.q[: plain.nq], state.u[: plain.nu]
    np.testing.assert_array_equal(system.mass, plain.mass)
    assert system.body_names == plain.body_names and "spatial, 3 bodies" in str(system)
    more = sum(0.5 * size * rate**2 for (_, size), rate in zip(SIZES.values(), state.u[plain.nu :], strict=True))
    kinetic = plain.kinetic_energy(0.0, q, u) + more
    assert float(system.kinetic_energy(0.0, state.q, state.u)) == pytest.approx(float(kinetic), rel=1e-14)
    assert float(system.potential_energy(0.0, state.q)) == float(plain.potential_energy(0.0, q))
    for name in ("linear_momentum", "angular_momentum"):
        np.testing.assert_array_equal(getattr(system, name)(state.q, state.u), getattr(plain, name)(q, u))


@pytest.mark.slow
def test_a_machine_that_floats_conserves_energy_and_momentum():
    system = arm(*inertias(), floats=True)
    motion = mb.simulate(system, moving(system), t1=2.0, rtol=1e-10, saveat=np.linspace(0.0, 2.0, 9))
    np.testing.assert_allclose(motion.energy, motion.energy[0], rtol=1e-9)
    for name in ("linear_momentum", "angular_momentum"):
        values = jax.vmap(getattr(system, name))(motion.ys.q, motion.ys.u)
        np.testing.assert_allclose(values, jnp.broadcast_to(values[0], values.shape), rtol=0, atol=1e-9)
    assert np.max(motion.constraint_violation) < 1e-12


INERTIA, STIFFNESS, WINDING, START, RATE = 0.3, 2.0, 0.3, 0.4, 8.0


def wheel():
    """A wheel in space with a rotor, and with a spring on a cord that it winds up."""
    cord = mb.FixedTendon("cord", "axle.angle", coefficients=(WINDING,))
    joints = [
        spatial.Revolute("axle", "ground", "wheel", point=(0.0, 0.0, 0.0), axis=Y),
        mb.JointInertia("rotor", "axle.angle", inertia=INERTIA),
        cord,
    ]
    spring = mb.JointSpring("spring", "cord.length", stiffness=STIFFNESS, free=0.0)
    return mb.Scene([spatial.Body("wheel", mass=1.0, inertia=J)], joints=joints, forces=[spring]).compile()


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"manifold": mb.manifold.Projection()}], ids=["default", "projection"])
def test_wheel_with_a_rotor_winds_up_a_cord(options):
    """It vibrates by more than a full turn to either side, which the angle of a hinge in space is known up to."""
    system, ts = wheel(), np.linspace(0.0, 5.0, 6)
    start = mb.assemble(system, fix={"axle.angle": START}, rates={"axle.angle": RATE})
    motion = mb.simulate(system, start, t1=5.0, rtol=1e-9, saveat=ts, **options)
    omega = WINDING * np.sqrt(STIFFNESS / (J[1, 1] + INERTIA))
    expected = START * np.cos(omega * ts) + RATE / omega * np.sin(omega * ts)
    assert np.max(expected) > 2 * np.pi
    np.testing.assert_allclose(motion["rotor"].angle, expected, rtol=0, atol=1e-7)
    np.testing.assert_allclose(motion["axle"].angle, motion["rotor"].angle, rtol=0, atol=1e-9)
    np.testing.assert_allclose(motion["cord"].length, WINDING * expected, rtol=0, atol=1e-7)
    np.testing.assert_allclose(motion.energy, motion.energy[0], rtol=1e-8)
    pull = -STIFFNESS * WINDING * motion["cord"].length
    acceleration = pull / (J[1, 1] + INERTIA)
    np.testing.assert_allclose(motion["rotor"].angle_acceleration, acceleration, rtol=0, atol=1e-9)
    np.testing.assert_allclose(motion.forces["spring"][:, -1, 4], pull, rtol=0, atol=1e-9)
    # On the wheel acts what accelerates it alone.
    moment = pull + motion.reactions["rotor"].moment[:, 1]
    np.testing.assert_allclose(moment, J[1, 1] * acceleration, rtol=0, atol=1e-9)


def geared(n):
    """Links on hinges that are not parallel, one after the other, and a drive with much inertia on each."""
    point = lambda k: np.array([0.4 * k, 0.05 * (-1) ** k, 0.0])
    axis = lambda k: (0.0, 0.96, 0.28 * (-1) ** k)
    bodies = [
        spatial.Body(f"link{k}", mass=1.0, inertia=0.2 * J, position=(point(k) + point(k + 1)) / 2) for k in range(n)
    ]
    pairs = [("ground" if k == 0 else f"link{k - 1}", f"link{k}") for k in range(n)]
    joints = [spatial.Revolute(f"hinge{k}", *pair, point=point(k), axis=axis(k)) for k, pair in enumerate(pairs)]
    joints += [mb.JointInertia(f"drive{k}", f"hinge{k}.angle", inertia=0.1 * (k + 1)) for k in range(n)]
    hold = lambda k: mb.JointSpring(f"spring{k}", f"hinge{k}.angle", stiffness=30.0, damping=0.5, free=0.0)
    springs = [hold(k) for k in range(n)]
    return mb.Scene(bodies, joints=joints, forces=[mb.Gravity((0.0, 0.0, -9.81)), *springs]).compile()


@pytest.mark.slow
def test_sparse_elimination():
    """Of many links: the accelerations of dense matrices, and motions on the constraints."""
    system = geared(7)
    assert system.elimination is not None
    start = mb.assemble(system, rates={f"hinge{k}.angle": 0.5 for k in range(7)})
    sparse, dense = (
        accelerations(system, FORMULATIONS[name], 0.0, start.q, start.u)[0] for name in ("multipliers", "null_space")
    )
    np.testing.assert_allclose(sparse, dense, rtol=0, atol=1e-10 * np.max(np.abs(dense)))
    motion = mb.simulate(system, start, t1=0.2, rtol=1e-8, manifold=mb.manifold.Partition())
    assert np.max(motion.constraint_violation) < 1e-10


@pytest.mark.slow
def test_linear_and_steady_motion():
    """Vibration of a hinge with a spring, and a wheel with a rotor that turns steadily."""
    rod = planar.Body("rod", mass=1.0, inertia=0.1, position=(0.0, 0.0))
    hip = planar.Revolute("hip", "ground", "rod", point=(0.0, 0.0))
    spring = mb.JointSpring("spring", "hip.angle", stiffness=8.0, free=0.0)
    rotor = mb.JointInertia("rotor", "hip.angle", inertia=INERTIA)
    system = mb.Scene([rod], joints=[hip, rotor], forces=[spring]).compile()
    eigenvalues = mb.linearise(system, mb.assemble(system)).eigenvalues
    np.testing.assert_allclose(np.abs(np.imag(eigenvalues)), np.sqrt(8.0 / (0.1 + INERTIA)), rtol=1e-9)

    wheel = spatial.Body("wheel", mass=1.0, inertia=J)
    axle = spatial.Revolute("axle", "ground", "wheel", point=(0.0, 0.0, 0.0), axis=Z)
    own = mb.JointInertia("rotor", "axle.angle", inertia=INERTIA)
    free = mb.Scene([wheel], joints=[axle, own]).compile()
    state = mb.steady_motion(free, mb.assemble(free), rates={"axle.angle": 3.0})
    assert float(state.u[-1]) == pytest.approx(3.0, rel=1e-9)


def test_row_holds_its_coordinate_at_that_of_the_joint():
    pin = planar.Revolute("pin", "ground", "rod", point_a=(0.0, 0.0), point_b=(0.0, 0.0))
    part = mb.JointInertia("rotor", "pin.angle", inertia=INERTIA).of_sources([pin], [(0, 1)])
    poses = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.7], [0.9, 0.0, 0.0]])
    np.testing.assert_allclose(part.residual(PLANE, poses, 0.0), [0.2], rtol=1e-13)


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (mb.JointInertia("r", "hip.angle", inertia=0.0), "JointInertia 'r': inertia must be positive"),
        (mb.JointInertia("r", "hip.angel", inertia=1.0), "JointInertia 'r': Unknown coordinate 'hip.angel'"),
        (mb.JointInertia("r", "hop.angle", inertia=1.0), "JointInertia 'r': Unknown joint 'hop'"),
        (mb.JointInertia("r", "ball.rotation", inertia=1.0), "'ball.rotation' must be a number, it has shape"),
    ],
)
def test_inertias_that_cannot_be(part, message):
    bodies = [spatial.Body(name, mass=1.0, inertia=J) for name in ("a", "b")]
    hip = spatial.Revolute("hip", "ground", "a", point=(0.0, 0.0, 0.0), axis=Z)
    ball = spatial.Spherical("ball", "a", "b", point=(0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match=message):
        mb.Scene(bodies, joints=[hip, ball, part]).compile()


@pytest.mark.slow
def test_an_inertia_is_no_function_of_time():
    with pytest.raises(ValueError, match=r"'rotor\.inertia' must be constant: masses, moments of inertia"):
        mb.with_inputs(wheel(), {"rotor.inertia": lambda t: jnp.asarray(1.0 + t)})


class Slot(parts.AbstractPlanarPart, parts.AbstractAxisJoint):
    """A slot along which a pin goes, whose coordinate has a name of its own."""

    rows: ClassVar[int] = 1

    def residual(self, space, poses, t):
        d, along = parts.separation(space, self, poses), space.direction(poses[0], self.axis_a)
        return (along[0] * d[1] - along[1] * d[0])[None]

    def coordinates(self, space, poses):
        return {"stroke": jnp.dot(space.direction(poses[0], self.axis_a), parts.separation(space, self, poses))}


class Stroke(Slot):
    quantities: ClassVar = {"stroke": "length"}


def test_a_joint_declares_what_its_coordinates_are():
    """A rotor on a coordinate that is a length is one of a displacement, and a radius goes with an angle only."""
    block = planar.Body("block", mass=1.0, inertia=0.1, position=(0.3, 0.0))
    rotor = mb.JointInertia("rotor", "slot.stroke", inertia=2.0)
    way = {"point": (0.0, 0.0), "axis": (1.0, 0.0)}
    system = mb.Scene([block], joints=[Stroke("slot", "ground", "block", **way), rotor]).compile()
    assert "rotor.displacement" in system.coordinate_names()
    rub = mb.DryFriction("rub", "slot.stroke", coefficient=0.1, radius=0.2)
    for joints, forces, what in (((rotor,), (), "JointInertia 'rotor'"), ((), (rub,), "DryFriction 'rub'")):
        scene = mb.Scene([block], joints=[Slot("slot", "ground", "block", **way), *joints], forces=forces)
        with pytest.raises(ValueError, match=f"{what}: Slot 'slot' does not say whether its coordinate 'stroke' is an"):
            scene.compile()
