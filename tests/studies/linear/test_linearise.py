"""Linear equations about equilibria against closed forms and independent computations; derivatives; what has none."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from compiling import compiled

import jaxmb as mb
from jaxmb import lagrangian, planar, spatial
from jaxmb.mechanisms.four_bar import circles_meet
from jaxmb.studies.linear.eigen import eigen
from jaxmb.studies.linear.linearisation import Linearisation
from jaxmb.studies.linear.steady import _bodies, _Unknowns

MOST_PROGRAMS = 90

G = 9.81


@functools.cache
def double_pendulum():
    """Two hanging rods of 1 m and 1 kg with dampers in their hinges and a motor at the upper one."""
    rod = lambda name, y: planar.Body(name, mass=1.0, inertia=1 / 12, position=(0.0, y), angle=-np.pi / 2)
    pin = lambda name, a, b, at: planar.Revolute(name, a, b, point_a=at, point_b=(-0.5, 0.0))
    dampers = [
        planar.TorsionalSpringDamper("d1", "ground", "upper", stiffness=0.0, damping=0.1, free_angle=0.0),
        planar.TorsionalSpringDamper("d2", "upper", "lower", stiffness=0.0, damping=0.2, free_angle=0.0),
    ]
    system = mb.Scene(
        [rod("upper", -0.5), rod("lower", -1.5)],
        joints=[pin("A", "ground", "upper", (0.0, 0.0)), pin("B", "upper", "lower", (0.5, 0.0))],
        forces=[mb.Gravity((0.0, -G)), planar.Torque("motor", "upper", torque=0.0), *dampers],
    ).compile()
    return system, mb.assemble(system)


M = np.array([[4 / 3, 1 / 2], [1 / 2, 1 / 3]])
K = np.diag([1.5 * G, 0.5 * G])
DAMPING = np.array([[0.3, -0.2], [-0.2, 0.2]])


@functools.cache
def linear_pendulum():
    system, state = double_pendulum()
    return mb.linearise(
        system, state, inputs=["motor.torque"], outputs=["lower.angle", "A.force"], coordinates=["upper.angle"]
    )


@pytest.mark.slow
def test_a_double_pendulum_has_its_closed_form():
    linear = linear_pendulum()
    assert linear.states == ("upper.angle", "lower.angle", "upper.angle_rate", "lower.angle_rate")
    stiffness, damping = np.linalg.solve(M, K), np.linalg.solve(M, DAMPING)
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-stiffness, -damping]])
    push = np.linalg.solve(M, [1.0, 0.0])
    np.testing.assert_allclose(linear.A, A, atol=1e-12)
    np.testing.assert_allclose(linear.B[:, 0], [0.0, 0.0, *push], atol=1e-12)
    assert linear.outputs == ("lower.angle", "A.force[0]", "A.force[1]")
    # The hinge carries the horizontal acceleration of both mass centres, also that which the motor causes at once.
    across = np.array([1.5, 0.5])
    np.testing.assert_allclose(linear.C[0], [0.0, 1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(linear.C[1], across @ A[2:], atol=1e-12)
    np.testing.assert_allclose(linear.D[:, 0], [0.0, across @ push, 0.0], atol=1e-12)
    response = linear.frequency_response([0.0, 2.0])
    direct = [np.linalg.solve(K + 1j * w * DAMPING - w**2 * M, [1.0, 0.0])[1] for w in (0.0, 2.0)]
    np.testing.assert_allclose(response[:, 0, 0], direct, atol=1e-12)
    own = scipy.linalg.eigvals(A)
    np.testing.assert_allclose(np.sort_complex(linear.eigenvalues), np.sort_complex(own), atol=1e-12)
    np.testing.assert_allclose(linear.frequencies * linear.damping_ratios, -linear.eigenvalues.real, atol=1e-12)
    assert "upper.angle" in str(linear) and str(linear).count("±") == 2


@pytest.mark.slow
def test_other_programs_and_responses():
    """The same numbers and names; free motion as SciPy computes it."""
    system, state = double_pendulum()
    linear = mb.linearise(system, state, inputs=["motor.torque"], outputs=["lower.angle", "upper.angle"])
    scipys, controls = linear.to_scipy(), linear.to_control()
    for name in "ABCD":
        np.testing.assert_array_equal(getattr(scipys, name), getattr(linear, name))
        np.testing.assert_array_equal(getattr(controls, name), getattr(linear, name))
    assert controls.state_labels == [name.replace(".", "_") for name in linear.states]
    assert controls.input_labels == ["motor_torque"] and controls.output_labels == ["lower_angle", "upper_angle"]
    z0, ts = np.array([0.1, -0.2, 0.0, 0.3]), np.linspace(0.0, 3.0, 7)
    expected = np.array([scipy.linalg.expm(np.asarray(linear.A) * t) @ z0 for t in ts])
    np.testing.assert_allclose(linear.response(z0, ts), expected, rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match=r"z0 must have shape \(4,\)"):
        linear.response(z0[:3], ts)
    with pytest.raises(ValueError, match="ts must be a vector of times"):
        linear.response(z0, 1.0)


def of_numbers(A, *more):
    """Linear equations of two masses with one input and one output."""
    B, C, D = more or (np.zeros((4, 0)), np.zeros((0, 4)), np.zeros((0, 0)))
    system = lagrangian.LagrangianSystem(lambda t, q, v, p: 0.5 * v @ v, q=[0.0, 0.0])
    names = ("a", "b", "a_rate", "b_rate"), ("push",) * B.shape[1], ("seen",) * C.shape[0], 2
    return Linearisation(*map(jnp.asarray, (A, B, C, D)), *names, jnp.eye(4), system, system.guess, jnp.zeros(()))


def masses(stiffness, damping):
    return np.block([[np.zeros((2, 2)), np.eye(2)], [-stiffness, -damping]])


def test_linear_equations_have_modes_and_responses():
    stiffness, damping = np.array([[5.0, -1.0], [-2.0, 9.0]]), np.array([[0.4, 0.1], [0.0, 0.6]])
    A, B, C, D = masses(stiffness, damping), np.eye(4)[:, 2:3], np.array([[1.0, 0.0, 0.5, 0.0]]), np.array([[0.7]])
    linear = of_numbers(A, B, C, D)
    values = np.linalg.eigvals(A)
    np.testing.assert_allclose(np.sort_complex(linear.eigenvalues), np.sort_complex(values), rtol=1e-12)
    found = np.asarray(linear.eigenvalues)
    np.testing.assert_allclose(linear.damping_ratios, -found.real / np.abs(found), rtol=1e-12)
    omega = np.array([0.0, 2.0])
    expected = [C @ np.linalg.solve(1j * w * np.eye(4) - A, B) + D for w in omega]
    np.testing.assert_allclose(linear.frequency_response(omega), expected, rtol=1e-12)
    mode = eqx.filter_jit(lambda linear: linear.mode(1))(linear)
    shape = np.concatenate([mode.q, mode.u])
    np.testing.assert_allclose(A @ shape, mode.eigenvalue * shape, rtol=1e-12, atol=1e-12)
    state = eqx.filter_jit(lambda mode: mode.at(0.3, 0.1))(mode)
    moved = 0.1 * (np.exp(0.3j) * shape).real
    np.testing.assert_allclose(np.concatenate([state.q, state.u]), moved, rtol=1e-12, atol=1e-14)


def test_what_rounding_explains_is_printed_as_zero():
    lines = lambda *given: [line.split()[1:-1] for line in str(of_numbers(masses(*given))).splitlines()[1:]]
    # Two masses with a spring between them, free together.
    spring = np.outer([70.0, -30.0], [1.0, -1.0])
    shown = lines(spring, 0.01 * spring)
    assert [line[:3] for line in shown[:2]] == 2 * [["0", "0", "0.0000"]]
    assert shown[2][:3] == ["-0.5", "±", "9.9875i"]
    # Rounding explains no slow mode, and none of critical damping, whose condition is as large as that of a free one.
    assert lines(np.diag([1e-6, 1e2]), np.zeros((2, 2)))[0][:5] == ["0", "±", "0.001i", "0.001", "0.0000"]
    assert [line[:3] for line in lines(np.diag([1.0, 1e4]), np.diag([2.0, 0.0]))[:2]] == 2 * [["-1", "1", "1.0000"]]


def test_a_circling_mass_is_seen_from_a_frame_that_moves_with_it():
    """On a string, without gravity: the azimuth has no effect, although place and velocity change."""
    ball = planar.PointMass("ball", mass=1.5, position=(2.0, 0.0), velocity=(0.0, 3.0))
    string = planar.Distance("string", "ground", "ball", point_a=(0.0, 0.0), length=2.0)
    system = mb.Scene([ball], joints=[string]).compile()
    linear = mb.linearise(system, system.guess)
    assert linear.states == ("ball.y", "ball.y_rate")
    np.testing.assert_allclose(linear.A, [[0.0, 1.0], [0.0, 0.0]], atol=1e-9)
    # Other numbers have the same programs.
    heavier = mb.with_parameters(system, {"ball.mass": 2.5})
    with compiled() as programs:
        mb.linearise(heavier, system.guess)
    assert not programs


def test_bodies_are_carried_by_a_turn_a_travel_and_their_spins():
    """In space and in the plane: rates of places, attitudes and velocities; and the spins of a steady motion."""
    turning, travel = np.array([0.3, -0.2, 0.9]), np.array([0.5, 0.4, -0.1])
    body = spatial.Body("top", mass=1.0, inertia=(1.0, 1.2, 1.5), position=(1.0, 2.0, 3.0))
    system, random = mb.Scene([body]).compile(), np.random.default_rng(0)
    q, u = np.array(system.guess.q), random.normal(size=6)
    q[3:] = random.normal(size=4)
    q[3:] /= np.linalg.norm(q[3:])
    state = mb.State(jnp.asarray(q), jnp.asarray(u))
    carried_in = lambda system: jax.jit(
        lambda state, turning: (
            (carrier := _bodies(system, _Unknowns(state, turning, jnp.asarray(travel)), 0.0 * state.q)).field(state),
            carrier.spins,
        )
    )
    carried, spins = carried_in(system)(state, turning)
    np.testing.assert_allclose(carried.q[:3], travel + np.cross(turning, q[:3]), rtol=1e-12)
    np.testing.assert_allclose(carried.u[:3], np.cross(turning, u[:3]), rtol=1e-12)
    # A body turns with the others and spins in addition; together that is its angular velocity, in its own axes.
    of_turn = jax.jit(lambda p, dp: (mb.rotations.angular_velocity(p, dp), mb.rotations.rotation_matrix(p)))
    omega, R = map(np.asarray, of_turn(q[3:], carried.q[3:]))
    np.testing.assert_allclose(omega, u[3:], rtol=1e-12)
    np.testing.assert_allclose(spins[0], u[3:] - R.T @ turning, rtol=1e-12)
    np.testing.assert_allclose(carried.u[3:], np.cross(u[3:], spins[0]), rtol=1e-12)

    flat = mb.Scene([planar.Body("disc", mass=1.0, inertia=1.0, position=(1.0, 2.0))]).compile()
    state = mb.State(flat.guess.q, jnp.array([0.1, 0.2, 5.0]))
    carried, _ = carried_in(flat)(state, np.array([0.0, 0.0, 0.9]))
    np.testing.assert_allclose(carried.q, [travel[0] - 0.9 * 2.0, travel[1] + 0.9 * 1.0, 5.0], rtol=1e-12)
    np.testing.assert_allclose(carried.u, [-0.9 * 0.2, 0.9 * 0.1, 0.0], rtol=1e-12)


@pytest.mark.slow
def test_a_mode_moves_on_the_constraints():
    linear = linear_pendulum()
    mode = linear.mode(0)
    shape, system = np.asarray(mode.q), linear.system
    assert np.max(np.abs(shape) / system.coordinate_scale()) == pytest.approx(1.0)
    state = mode.at(0.3, 0.1)
    assert np.max(np.abs(system.position_residual(0.0, state.q))) < 1e-12
    assert np.max(np.abs(system.velocity_residual(0.0, state.q, state.u))) < 1e-12
    near = mode.at(0.3, 1e-5)
    expected = (np.exp(0.3j) * shape).real
    np.testing.assert_allclose((near.q - linear.state.q) / 1e-5, expected, atol=1e-4)
    # q̇ along the mode is λ times its shape.
    np.testing.assert_allclose(mode.u, mode.eigenvalue * mode.q, atol=1e-10)


def test_eigenvalues_are_differentiated_forward_and_backward():
    A, dA = (np.random.default_rng(seed).normal(size=(5, 5)) for seed in (3, 4))
    kept, weights = np.array([True, True, False, True, True]), np.arange(1.0, 6.0)

    def observed(A):
        values, vectors, _ = eigen(A, jnp.asarray(kept))
        seen = jnp.sum(weights * values.real + weights**2 * values.imag)
        return seen + jnp.sum(weights[:, None] * weights[None, :] * (vectors.real + 2 * vectors.imag))

    of_all = jax.jit(lambda A: (*jax.jvp(observed, (A,), (jnp.asarray(dA),)), jax.grad(observed)(A)))
    _, forward, slope = of_all(A)
    h = 1e-6
    central = (of_all(A + h * dA)[0] - of_all(A - h * dA)[0]) / (2 * h)
    np.testing.assert_allclose(forward, np.sum(slope * dA), rtol=1e-10)
    np.testing.assert_allclose(forward, central, rtol=1e-7)


def damped(system, state, mass, stiffness):
    """The two frequencies of the double pendulum with another mass and with a spring."""
    changed = mb.with_parameters(system, {"lower.mass": mass, "d2.stiffness": stiffness, "d2.free_angle": 0.0})
    return mb.linearise(changed, state).eigenvalues


@pytest.mark.slow
def test_derivatives_of_eigenvalues_by_parameters():
    system, state = double_pendulum()
    values = lambda x: (lambda w: jnp.stack([w[0].real, w[0].imag, w[2].imag]))(damped(system, state, x[0], x[1]))
    at = jnp.array([1.2, 3.0])
    forward, reverse = jax.jit(jax.jacfwd(values))(at), jax.jit(jax.jacrev(values))(at)

    def closed(x):
        m, k = x
        mass = np.array([[1 / 3 + m, m / 2], [m / 2, 1 / 12 + m / 4]])
        stiffness = np.diag([(0.5 + m) * G, 0.5 * m * G]) + k * np.array([[1.0, -1.0], [-1.0, 1.0]])
        A = np.block(
            [[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(mass, stiffness), -np.linalg.solve(mass, DAMPING)]]
        )
        w = scipy.linalg.eigvals(A)
        w = sorted(w[w.imag > 0], key=abs)
        return np.array([w[0].real, w[0].imag, w[1].imag])

    np.testing.assert_allclose(values(at), closed(at), rtol=1e-11)
    step = 1e-5
    central = np.stack([(closed(at + step * e) - closed(at - step * e)) / (2 * step) for e in np.eye(2)], axis=1)
    np.testing.assert_allclose(forward, reverse, rtol=1e-10)
    # Differences have rounding errors of eps |λ| / step.
    np.testing.assert_allclose(forward, central, rtol=1e-8, atol=1e-9)
    batch = jnp.stack([at, at + 0.1])
    np.testing.assert_allclose(jax.vmap(values)(batch), np.stack([closed(x) for x in batch]), rtol=1e-11)


def bars(theta, lengths=(1.0, 3.0, 2.5), base=2.5):
    """Mass centres and angles of a four-bar linkage in closed form."""
    crank, coupler, rocker = lengths
    B = crank * np.array([np.cos(theta), np.sin(theta)])
    D = np.array([base, 0.0])
    C = circles_meet(B, D, coupler, rocker)
    ends = [(np.zeros(2), B), (B, C), (D, C)]
    turn = lambda d: np.arctan2(d[1], d[0])
    return np.array([[*(a + b) / 2, turn(b - a)] for a, b in ends])


def central(f, x, h=2e-3):
    """The derivative by differences of sixth order."""
    difference = lambda k: (f(x + k * h) - f(x - k * h)) / (2 * k * h)
    return 1.5 * difference(1) - 0.6 * difference(2) + 0.1 * difference(3)


@pytest.mark.slow
def test_a_four_bar_on_a_spring_is_a_system_of_one_freedom():
    lengths, masses = (1.0, 3.0, 2.5), (1.0, 3.0, 2.5)
    bodies = [
        planar.Body(name, mass=m, inertia=m * l**2 / 12, position=x[:2], angle=x[2])
        for name, m, l, x in zip(("crank", "coupler", "rocker"), masses, lengths, bars(1.2), strict=True)
    ]
    joints = [
        planar.Revolute("A", "ground", "crank", point_a=(0.0, 0.0), point_b=(-0.5, 0.0)),
        planar.Revolute("B", "crank", "coupler", point_a=(0.5, 0.0), point_b=(-1.5, 0.0)),
        planar.Revolute("C", "coupler", "rocker", point_a=(1.5, 0.0), point_b=(1.25, 0.0)),
        planar.Revolute("D", "ground", "rocker", point_a=(2.5, 0.0), point_b=(-1.25, 0.0)),
    ]
    spring = planar.TorsionalSpringDamper("spring", "ground", "crank", stiffness=200.0, damping=4.0, free_angle=1.3)
    system = mb.Scene(bodies, joints=joints, forces=[spring, mb.Gravity((0.0, -G))]).compile()
    state = mb.equilibrium(system)
    linear = mb.linearise(system, state, coordinates=["crank.angle"])

    potential = lambda q: sum(m * G * x[1] for m, x in zip(masses, bars(q), strict=True)) + 100.0 * (q - 1.3) ** 2
    slope = lambda q: central(potential, q)
    q = scipy.optimize.brentq(slope, 1.0, 1.5, xtol=1e-13)
    assert float(state.q[2]) == pytest.approx(q, abs=1e-8)
    moving = zip(masses, lengths, central(bars, q), strict=True)
    inertia = sum(m * (r[0] ** 2 + r[1] ** 2 + l**2 / 12 * r[2] ** 2) for m, l, r in moving)
    stiffness = central(slope, q)
    np.testing.assert_allclose(linear.A, [[0.0, 1.0], [-stiffness / inertia, -4.0 / inertia]], rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_a_spinning_body_on_soft_bearings_has_gyroscopic_frequencies():
    """A rotor about its symmetry axis on isotropic springs at its centre: nutation at (C/A) Ω, and zero."""
    A, C, spin = 2.0, 3.0, 7.0
    rotor = spatial.Body("rotor", mass=1.0, inertia=(A, A, C), angular_velocity=(0.0, 0.0, spin))
    mount = spatial.Spherical("mount", "ground", "rotor", point=(0.0, 0.0, 0.0))
    system = mb.Scene([rotor], joints=[mount]).compile()
    linear = mb.linearise(system, mb.assemble(system, rates={"rotor.angular_velocity": (0.0, 0.0, spin)}))
    # In the frame that does not spin the axis keeps its direction or nutates at C Ω / A.
    np.testing.assert_allclose(np.max(np.abs(linear.eigenvalues.imag)), C / A * spin, rtol=1e-9)
    assert np.max(np.abs(linear.eigenvalues.real)) < 1e-6


@pytest.mark.slow
def test_a_lagrangian_system_and_a_singular_mass_matrix():
    cart = lagrangian.LagrangianSystem(
        kinetic=lambda t, q, v, p: 0.5 * p["m"] * (v[0] ** 2 + v[1] ** 2),
        potential=lambda t, q, p: p["m"] * G * q[1] + 0.0 * q[2],
        constraints=[
            lagrangian.Holonomic("rod", lambda t, q, p: jnp.stack([q[0] - jnp.sin(q[2]), q[1] + jnp.cos(q[2])]))
        ],
        q=(0.0, -1.0, 0.0),
        parameters={"m": 2.0},
        coordinates=("x", "y", "theta"),
    )
    linear = mb.linearise(cart, mb.assemble(cart), coordinates=["theta"])
    assert linear.states == ("theta", "theta_rate")
    np.testing.assert_allclose(linear.A, [[0.0, 1.0], [-G, 0.0]], atol=1e-12)


REFUSED = [
    ({"coordinates": ["uper.angle"]}, "Unknown coordinate 'uper.angle'; did you mean 'upper.angle'"),
    ({"coordinates": "upper.angle"}, "sequence"),
    ({"coordinates": ["upper.angle", "upper.angle"]}, "named twice"),
    ({"coordinates": ["upper.angle", "lower.angle", "lower.x"]}, "There are 2 independent coordinates, and 3"),
    ({"coordinates": ["upper.angular_velocity"]}, "depends on velocities"),
    ({"rates": ["upper.angl"]}, "Unknown rate"),
    ({"inputs": ["motor.torq"]}, "Unknown input 'motor.torq'; did you mean 'motor.torque'"),
    ({"outputs": ["A.forces"]}, "Unknown output 'A.forces'; did you mean 'A.force'"),
    ({"outputs": ["A.force", "A.force[0]"]}, "named once"),
]


def test_names_that_linearise_does_not_know():
    system, state = double_pendulum()
    for arguments, message in REFUSED:
        with pytest.raises(ValueError, match=message):
            mb.linearise(system, state, **arguments)


@pytest.mark.slow
def test_states_and_names_that_linearise_refuses():
    system, state = double_pendulum()
    off = mb.assemble(system, fix={"upper.angle": -1.5})
    for at, options, message in (
        (state, {"coordinates": ["upper.angle", "upper.x"]}, r"coordinates upper.angle, upper.x are not independent"),
        (state, {"inputs": ["A.point_b"]}, r"A.point_b\[0\], A.point_b\[1\] cannot be an input"),
        (off, {}, r"not an equilibrium: accelerations remain along .*jaxmb.equilibrium"),
        (mb.State(state.q + 0.1, state.u), {}, "violates the constraints"),
        (mb.assemble(system, rates={"upper.angle": 1.0}), {}, "not a steady motion: accelerations remain"),
    ):
        with pytest.raises(ValueError, match=message):
            mb.linearise(system, at, **options)
    assert np.all(np.isnan(jax.jit(lambda q: mb.linearise(system, mb.State(q, off.u)).A)(off.q)))
