"""`Hermite` on scenes of any size: its sparse elimination against dense matrices, and its motions against others."""

import math
import re

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from compiling import jit_quickly
from oracles.sprung_chain import sprung_chain

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.bodies.field_jacobian import motion_jacobian
from jaxmb.linalg.elimination_order import order_nodes
from jaxmb.manifold import Partition, Projection
from jaxmb.manifold.default import Unconstrained, default_manifold
from jaxmb.solvers import Hermite
from jaxmb.solvers._structured import StructuredInverses, _spectrum

R = 0.03 + 0.02j


def chain(n, *, stiffness=1e4, damping=20.0, curl=0.0):
    """Rods on hinges with stiff springs, from the ground on."""
    bodies, joints, forces, end = [], [], [mb.Gravity((0.0, -9.81))], np.zeros(2)
    for k in range(n):
        angle = 0.3 + curl * k
        along = np.array([np.cos(angle), np.sin(angle)])
        bodies.append(planar.Body(f"rod{k}", mass=1.0, inertia=1 / 12, position=end + along / 2, angle=angle))
        end = end + along
        before, point = (f"rod{k - 1}", (0.5, 0.0)) if k else ("ground", (0.0, 0.0))
        places = {"point_a": point, "point_b": (-0.5, 0.0)}
        joints.append(planar.Revolute(f"hinge{k}", before, f"rod{k}", **places))
        if k:
            rates = {"stiffness": (0.0, 0.0, stiffness), "damping": (0.0, 0.0, damping), "free_angle": curl}
            forces.append(planar.Bushing(f"spring{k}", before, f"rod{k}", **places, **rates))
    return mb.Scene(bodies, joints=joints, forces=forces).compile()


def cable(n, *, stiffness=0.5, damping=5e-4):
    """The library's cable with springs that resist bending and torsion; the ground closes a loop."""
    plain = mb.mechanisms.get("cable", n=n)
    poses, l, m = np.asarray(plain.state.q).reshape(n, 7), 1.0 / n, 1.0 / n
    inertia = spatial.rod(m, l, radius=0.01)
    rods = [
        spatial.Body(f"rod{k}", mass=m, inertia=inertia, position=pose[:3], orientation=pose[3:])
        for k, pose in enumerate(poses)
    ]
    left, right = (-l / 2, 0.0, 0.0), (l / 2, 0.0, 0.0)
    joints = [spatial.Spherical("ball0", "ground", "rod0", point_a=(0.0, 0.0, 0.0), point_b=left)]
    forces = [mb.Gravity((0.0, 0.0, -9.81))]
    for k in range(1, n):
        pair = f"rod{k - 1}", f"rod{k}"
        joints.append(spatial.Spherical(f"ball{k}", *pair, point_a=right, point_b=left))
        rates = {"stiffness": (0.0,) * 3 + (stiffness,) * 3, "damping": (0.0,) * 3 + (damping,) * 3}
        upright = {"orientation": (1.0, 0.0, 0.0, 0.0)}
        forces.append(spatial.Bushing(f"bend{k}", *pair, point_a=right, point_b=left, **rates, **upright))
    joints.append(spatial.Spherical(f"ball{n}", f"rod{n - 1}", "ground", point_a=right, point_b=(0.8, 0.0, 0.0)))
    return mb.Scene(rods, joints=joints, forces=forces).compile()


def tower(n):
    """Spatial bodies on bushings alone, from the ground on."""
    bodies = [
        spatial.Body(f"b{k}", mass=1.0, inertia=np.diag([0.1, 0.2, 0.3]), position=(0.0, 0.0, k + 0.5))
        for k in range(n)
    ]
    rates = {"stiffness": (1e5,) * 3 + (1e4,) * 3, "damping": (1e2,) * 3 + (1e1,) * 3}
    pairs = [("ground" if k == 0 else f"b{k - 1}", f"b{k}", k) for k in range(n)]
    forces = [spatial.Bushing(f"mount{k}", a, b, point=(0.0, 0.1, float(k)), **rates) for a, b, k in pairs]
    return mb.Scene(bodies, forces=[mb.Gravity((0.0, 0.0, -9.81)), *forces]).compile()


def strip(n):
    """Elastic beams on a pin: two constraint rows, and a freedom for every other velocity."""
    section = mb.sections.Rectangle(thickness=0.02, width=0.02, modulus=5e6, poisson_ratio=0.45)
    nodes = np.linspace((0.0, 0.0), (1.0, 0.0), n)
    own = planar.beam_chain("strip", nodes, section, mass=0.44, ends=(None, None), damping_time=1e-3)
    pin = planar.Revolute("pin", "ground", "strip_node0", point_a=(0.0, 0.0), point_b=(0.0, 0.0))
    return mb.Scene(own.bodies, joints=[pin], forces=[*own.forces, mb.Gravity((0.0, -9.81))]).compile()


def moving(system, seed=0):
    """A state on the constraints with some velocities and angles."""
    random = np.random.default_rng(seed)
    state = mb.assemble(system)
    u = jnp.asarray(random.normal(size=system.nu))
    return mb.manifold.project(system, 0.0, mb.State(state.q, u))


# Linear algebra


def dense_resolvent(system, y, x, r):
    """The same equations with dense matrices, from the whole system's functions."""
    t, (q, u) = 0.0, (y.q, y.u)
    A, M = system.jacobian(t, q, u), system.inertia(t, q, u)
    _, multipliers = mb.formulations.accelerations(system, mb.formulations.Multipliers(), t, q, u)
    force = lambda q, u: system.force(t, q, u) + system.constraint_force(t, q, u, multipliers)
    N = jax.jacfwd(lambda u: system.rates(t, q, u))(u)
    K, D = jax.jacfwd(force, (0, 1))(q, u)
    mass, m = M.product(jnp.eye(system.nu)), A.shape[0]
    K, D, N, mass, A = map(np.asarray, (K @ N, D, N, mass, A))
    top = np.concatenate([mass - r * D - r**2 * K, A.T], axis=1)
    matrix = np.concatenate([top, np.concatenate([A, np.zeros((m, m))], axis=1)])
    move = np.linalg.lstsq(N, x[: system.nq])[0]
    load = np.concatenate([mass @ x[system.nq :] + r * K @ move, np.zeros(m)])
    solved = np.linalg.solve(matrix, load)[: system.nu]
    return np.concatenate([N @ (move + r * solved), solved])


@pytest.mark.slow
@pytest.mark.parametrize("build, n", [(chain, 12), (cable, 5), (tower, 3), (strip, 5)])
def test_resolvents_are_those_of_dense_matrices(build, n):
    system = build(n)
    y = moving(system)
    jacobian = motion_jacobian(system, 0.0, y)
    random = np.random.default_rng(1)
    x, w = random.normal(size=(2, system.nq + system.nu)) + 1j * random.normal(size=(2, system.nq + system.nu))
    resolvent = jacobian.resolvent(jnp.asarray(R))
    found = resolvent.solve(jnp.asarray(x))
    expected = dense_resolvent(system, y, x, R)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * np.max(np.abs(expected)))
    across = resolvent.transpose_solve(jnp.asarray(w))
    np.testing.assert_allclose(np.sum(across * x), np.sum(w * found), rtol=1e-10)
    # A projection, on tangent vectors of the constraints.
    tangent = jacobian.project(jnp.asarray(x.real))
    np.testing.assert_allclose(jacobian.project(tangent), tangent, rtol=0, atol=1e-11)
    bound = system.jacobian(0.0, y.q, y.u) @ tangent[system.nq :]
    np.testing.assert_allclose(bound, 0.0, rtol=0, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("n, damping", [(6, 0.0), (2, 20.0)])
def test_the_spectrum_is_that_near_the_step(n, damping):
    """Of the dense Jacobian in independent coordinates, by `linearise` at rest: the eigenvalue nearest to an
    undamped vibration with `|h λ|` of a few, which decides on formulas, is found, and nothing that is none.
    """
    system = chain(n, stiffness=1e3, damping=damping)
    hanging = mb.assemble(system, fix={f"rod{k}.angle": -np.pi / 2 for k in range(n)})
    expected = np.asarray(mb.linearise(system, hanging).eigenvalues)
    jacobian = motion_jacobian(system, 0.0, hanging)
    r = jnp.asarray(1 / (1.4 * np.max(np.abs(expected.imag)) * (0.8 - 0.6j)))
    inverses = StructuredInverses(jacobian.resolvent(r), jnp.real(2 * r), -(jnp.abs(r) ** 2), r)
    found = np.asarray(_spectrum(inverses, jacobian.project))
    nearest = expected[np.argsort(np.abs(1 / (1 - complex(r) * expected)))[-3:]]
    for own in nearest:
        assert np.min(np.abs(found - own)) <= 1e-6 * abs(own)
    # Zeros are of directions across the constraints, up to rounding errors.
    for own in found[np.abs(found) > 1e-9 * np.max(np.abs(found))]:
        assert np.min(np.abs(expected - own)) <= 1e-6 * abs(own)


# Motions


def run(system, state, *, rtol, **options):
    return mb.simulate(system, state, rtol=rtol, solver=Hermite(), **options)


@pytest.mark.slow
def test_a_long_chain_moves_as_by_other_equations():
    times, n = np.array([0.1, 0.3]), 16
    expected = sprung_chain(times, n=n, stiffness=1e4, damping=20.0)
    system = chain(n)
    state = mb.assemble(system)
    sol = run(system, state, rtol=1e-7, t1=times[-1], saveat=times)
    found = np.concatenate([sol.ys.q[:, 2::3], sol.ys.u[:, 2::3]], axis=1)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)
    assert np.all(sol.constraint_violation.position <= 1e-12)
    assert np.all(sol.constraint_violation.velocity <= 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    "build, sizes", [(chain, (50, 200)), (cable, (25, 100)), (tower, (25, 100)), (strip, (25, 100))]
)
def test_no_dense_matrix_and_programs_of_one_size(build, sizes):
    lines = []
    for n in sizes:
        system = build(n)
        program = jax.jit(lambda y, system=system: run(system, y, rtol=1e-6, t1=0.1).ys).lower(system.guess)
        text = program.as_text()
        found = set(re.findall(r"tensor<((?:\d+x)+)(?:f64|complex)", text))
        assert max(math.prod(map(int, shape[:-1].split("x"))) for shape in found) < 3000 * n
        lines.append(text.count("\n"))
    assert lines[1] <= 1.3 * lines[0]


@pytest.mark.slow
def test_events_and_dense_output():
    """The first rod reaches a given angle, and states between steps are on the constraints."""
    system, target = chain(2), 0.2
    event = diffrax.Event(lambda t, y, args, **kwargs: y.q[2] - target, optx.Newton(1e-10, 1e-10))
    saveat = diffrax.SaveAt(ts=jnp.array([0.02, 0.07]), t1=True, dense=True)
    sol = run(system, mb.assemble(system), rtol=1e-8, t1=1.0, manifold=Projection(), event=event, saveat=saveat)
    assert sol.result == mb.RESULTS.event_occurred
    end = float(sol.ts[2])
    assert 0.07 < end < 1.0
    times = np.array([0.02, 0.05, 0.07, end])
    expected = sprung_chain(times, n=2, stiffness=1e4, damping=20.0)
    angles = lambda y: np.concatenate([y.q[:, 2::3], y.u[:, 2::3]], axis=1)
    between = sol.at(jnp.asarray(times))
    assert expected[-1, 0] == pytest.approx(target, abs=1e-8)
    np.testing.assert_allclose(angles(sol.ys)[:3], expected[[0, 2, 3]], rtol=0, atol=1e-7)
    np.testing.assert_allclose(angles(between), expected, rtol=0, atol=1e-7)
    for y in (sol.ys, between):
        for k in range(3):
            np.testing.assert_allclose(system.position_residual(0.0, y.q[k]), 0.0, rtol=0, atol=1e-12)
            np.testing.assert_allclose(system.velocity_residual(0.0, y.q[k], y.u[k]), 0.0, rtol=0, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize(
    "build, t1, names",
    [
        (lambda n: chain(n, curl=0.2), 0.2, ("rod1.mass", "spring2.stiffness", "spring2.damping")),
        (cable, 0.05, ("rod1.mass", "bend2.stiffness", "bend2.damping")),
        (strip, 0.05, ("strip_node1.mass", "strip2.section.thickness", "strip2.damping_time")),
    ],
)
def test_derivatives_three_ways(build, t1, names):
    system = build(3)
    state = mb.assemble(system)
    values = [mb.parameters(system)[name] for name in names]
    weights = jnp.asarray(np.random.default_rng(0).normal(size=system.nq + system.nu))

    def value(x, rtol):
        changed = {name: own * (1 + x[k]) for k, (name, own) in enumerate(zip(names, values, strict=True))}
        moved = mb.with_parameters(system, changed)
        sol = run(moved, state, rtol=rtol, t1=t1, manifold=Projection())
        return weights @ jnp.concatenate([sol.ys.q[-1], sol.ys.u[-1]])

    x = jnp.zeros(3)
    forward = jit_quickly(jax.jacfwd(lambda x: value(x, 1e-8)))(x)
    reverse = jit_quickly(jax.grad(lambda x: value(x, 1e-8)))(x)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-12 * np.max(np.abs(forward)))
    tighter, h = jit_quickly(jax.vmap(lambda x: value(x, 1e-10))), 1e-3
    ends = tighter(h * jnp.concatenate([jnp.eye(3), -jnp.eye(3), 2 * jnp.eye(3), -2 * jnp.eye(3)])).reshape(4, 3)
    central = (8 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / (12 * h)
    np.testing.assert_allclose(forward, central, rtol=1e-4, atol=1e-4 * np.max(np.abs(central)))


# The choice


def test_size_decides():
    hermite, adams = Hermite(), mb.solvers.Adams()
    for system, implicit, explicit in (
        (chain(4), Partition, Partition),
        (chain(16), Projection, Projection),
        (tower(2), Unconstrained, Unconstrained),
        (tower(8), Projection, Unconstrained),
        (strip(8), Partition, Partition),
        (strip(10), Projection, Partition),
    ):
        assert isinstance(default_manifold(system, hermite, None), implicit)
        assert isinstance(default_manifold(system, adams, None), explicit)
        assert ("the dense Newton matrix, with Hermite" in str(system)) == (implicit is Projection)


def test_levels_of_a_chain():
    """Bodies that share a spring and a hinge with the next, by cyclic reduction and not from an end on."""
    n, most = 1000, 40
    bodies, pairs = tuple((k,) for k in range(n)), tuple((k - 1, k) for k in range(1, n))
    neighbours = [set() for _ in range(2 * n)]
    for joint, own in enumerate([bodies[0], *pairs], n):
        neighbours[joint].update(own)
        for a in own:
            neighbours[a].update({joint, *own} - {a})
    after = [*([()] * n), *bodies]
    order = order_nodes(neighbours, 3, after=after, every_bound=True)
    assert order.levels <= most
    assert order.blocks <= 10 * n
