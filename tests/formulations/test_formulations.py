"""All formulations give the same accelerations: on matrices against NumPy, on the library's mechanisms against each
other.
"""

from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_to_run_long
from every_formulation import FORMULATIONS

import jaxmb as mb
from jaxmb.formulations import AbstractFormulation, Multipliers, Partitioned, Poincare, UdwadiaKalaba
from jaxmb.formulations.formulation import pivoted_jacobian
from jaxmb.formulations.laws import laws_of
from jaxmb.linalg.elimination import full_pivot
from jaxmb.linalg.inertia import BlockInertia
from jaxmb.linalg.jacobian import DenseJacobian
from jaxmb.system import DenseInertia, DiagonalInertia
from jaxmb.system.instant import Instant

WITHOUT_INVERSE_OF_MASS = {name: FORMULATIONS[name] for name in ("partitioned", "null_space", "singular_mass")}
N, RANK = 7, 4


def solve_by_all(inertia, force, jacobian, gamma, order, formulations=FORMULATIONS):
    """Accelerations and multipliers, an array each with an axis of formulations."""
    jacobian = DenseJacobian(jacobian).eliminated(order, RANK)
    pairs = [formulation.solve(inertia, force, jacobian, gamma) for formulation in formulations.values()]
    return tuple(jnp.stack(values) for values in zip(*pairs, strict=True))


def random_equation(rng, *, redundant=True):
    """M, F, A, γ of seven velocities and four independent rows, and a fifth that follows from two of them."""
    root = rng.normal(size=(N, N))
    A = rng.normal(size=(RANK, N))
    if redundant:
        A = np.vstack([A, A[0] + 2 * A[1]])
    return tuple(map(jnp.asarray, (root @ root.T + N * np.eye(N), rng.normal(size=N), A, A @ rng.normal(size=N))))


def by_numpy(M, F, A, gamma, rows):
    """Accelerations and multipliers of the kept rows from the equations of both together."""
    A, gamma = np.asarray(A)[rows], np.asarray(gamma)[rows]
    m, n = A.shape
    both = np.block([[np.asarray(M), -A.T], [A, np.zeros((m, m))]])
    solution = np.linalg.solve(both, np.concatenate([F, gamma]))
    return solution[:n], solution[n:]


@pytest.fixture(scope="module")
def dense():
    return jax.jit(lambda M, F, A, gamma, order: solve_by_all(DenseInertia(M), F, A, gamma, order))


@pytest.mark.slow
def test_equal_to_numpy_whichever_rows_and_columns_are_chosen(dense):
    rng = np.random.default_rng(0)
    for _ in range(5):
        M, F, A, gamma = random_equation(rng)
        # Charts that prefer other columns have other {1}-inverses.
        for scale in (None, jnp.asarray(10.0 ** rng.uniform(-2, 2, size=N))):
            order = full_pivot(A, scale=scale).order
            udot, multipliers = dense(M, F, A, gamma, order)
            kept = np.asarray(order.rows[:RANK])
            expected, some = by_numpy(M, F, A, gamma, kept)
            all_rows = np.zeros(RANK + 1)
            all_rows[kept] = some
            for k, name in enumerate(FORMULATIONS):
                np.testing.assert_allclose(udot[k], expected, rtol=0, atol=1e-11, err_msg=name)
                np.testing.assert_allclose(
                    multipliers[k], all_rows, rtol=0, atol=1e-11 * (1 + np.max(np.abs(some))), err_msg=name
                )


@pytest.mark.slow
def test_vmap_equals_the_loop(dense):
    rng = np.random.default_rng(1)
    equations = [random_equation(rng) for _ in range(3)]
    members = [(*equation, full_pivot(equation[2]).order) for equation in equations]
    together = jax.jit(jax.vmap(dense))(*jax.tree.map(lambda *leaves: jnp.stack(leaves), *members))
    for k, member in enumerate(members):
        for batched, alone in zip(together, dense(*member), strict=True):
            np.testing.assert_allclose(batched[k], alone, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_singular_mass():
    """A velocity without mass, held by a constraint."""
    rng = np.random.default_rng(2)
    M, F, A, gamma = random_equation(rng, redundant=False)
    M, F = M.at[-1].set(0.0).at[:, -1].set(0.0), F.at[-1].set(0.0)
    A = A.at[0].set(0.3 * jnp.eye(N)[0] + jnp.eye(N)[-1])
    order = full_pivot(A).order
    formulations = WITHOUT_INVERSE_OF_MASS
    udot, multipliers = jax.jit(lambda *args: solve_by_all(DenseInertia(M), *args, formulations))(F, A, gamma, order)
    expected, _ = by_numpy(M, F, A, gamma, np.arange(RANK))
    for k, name in enumerate(formulations):
        np.testing.assert_allclose(udot[k], expected, rtol=0, atol=1e-11, err_msg=name)
        np.testing.assert_allclose(A @ udot[k], gamma, rtol=0, atol=1e-14 * (1 + np.max(np.abs(gamma))), err_msg=name)
        force = M @ udot[k] - F
        np.testing.assert_allclose(
            A.T @ multipliers[k], force, rtol=0, atol=1e-14 * (1 + np.max(np.abs(force))), err_msg=name
        )


@pytest.mark.slow
def test_forces_that_do_virtual_work():
    """A rigid body's rotation with one non-ideal constraint."""
    moments, spin = np.array([1.0, 2.0, 3.0]), np.array([0.3, -0.5, 0.8])
    force = jnp.asarray(np.array([0.1, 0.2, -0.3]) - np.cross(spin, moments * spin))
    A, gamma = jnp.array([[1.0, 2.0, -1.0]]), jnp.array([0.4])
    admissible = np.linalg.svd(A)[2][1:].T
    jacobian = DenseJacobian(A).eliminated(full_pivot(A).order, 1)
    inertia = DiagonalInertia(jnp.asarray(moments))
    solve = jax.jit(lambda F: [formulation.solve(inertia, F, jacobian, gamma) for formulation in FORMULATIONS.values()])
    rough = jnp.array([0.05, -0.02, 0.03])
    # Only the part along motions that the constraint allows acts.
    outcomes = zip(FORMULATIONS, solve(force), solve(force + rough), solve(force + 3.0 * A[0]), strict=True)
    for name, (ideal, multipliers), (udot, _), (same, _) in outcomes:
        np.testing.assert_allclose(A @ ideal, gamma, rtol=0, atol=1e-14, err_msg=name)
        np.testing.assert_allclose(moments * ideal - force, A.T @ multipliers, rtol=0, atol=1e-14, err_msg=name)
        np.testing.assert_allclose(admissible.T @ (moments * ideal - force), 0.0, atol=1e-14, err_msg=name)
        np.testing.assert_allclose(A @ udot, gamma, rtol=0, atol=1e-14, err_msg=name)
        np.testing.assert_allclose(admissible.T @ (moments * udot - force - rough), 0.0, atol=1e-14, err_msg=name)
        np.testing.assert_allclose(same, ideal, rtol=0, atol=1e-14, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("redundant", [False, True])
def test_derivatives(redundant):
    """Of accelerations and constraint forces to all entries of M, F, A and γ, an implied row following the others."""
    rng = np.random.default_rng(3)
    M, F, A, gamma = random_equation(rng, redundant=False)
    combine = jnp.asarray(np.vstack([np.eye(RANK), [[1.0, 2.0, 0.0, 0.0]]]) if redundant else np.eye(RANK))
    order = full_pivot(combine @ A).order
    start, unravel = jax.flatten_util.ravel_pytree((M, F, A, gamma))
    direction = jnp.asarray(rng.normal(size=start.size))

    def solutions(entries):
        M, F, A, gamma = unravel(entries)
        inertia = DenseInertia((M + M.T) / 2)
        udot, multipliers = solve_by_all(inertia, F, combine @ A, combine @ gamma, order)
        return jnp.concatenate([udot, multipliers @ combine @ A], axis=1)

    @jax.jit
    def derivatives(entries):
        push = lambda of: jax.jvp(of, (entries,), (direction,)) if redundant else (of(entries), None)
        return push(jax.jacfwd(solutions)), push(jax.jacrev(solutions))

    (first, second), (first_reverse, second_reverse) = derivatives(start)
    h = 1e-5
    difference = lambda of: (of(start + h * direction) - of(start - h * direction)) / (2 * h)
    size = np.max(np.abs(first))
    np.testing.assert_allclose(first_reverse, first, rtol=0, atol=1e-12 * size)
    np.testing.assert_allclose(first, jnp.broadcast_to(first[:1], first.shape), rtol=0, atol=1e-11 * size)
    np.testing.assert_allclose(first @ direction, difference(jax.jit(solutions)), rtol=0, atol=1e-8 * size)
    if redundant:
        size = np.max(np.abs(second))
        np.testing.assert_allclose(second_reverse, second, rtol=0, atol=1e-12 * size)
        np.testing.assert_allclose(second, jnp.broadcast_to(second[:1], second.shape), rtol=0, atol=1e-11 * size)
        np.testing.assert_allclose(
            second, difference(lambda entries: derivatives(entries)[0][0]), rtol=0, atol=1e-8 * size
        )


@pytest.mark.slow
def test_roots_of_mass_matrices():
    """`L Lᵀ` by products and by solves, and derivatives of what no choice of root can change."""
    rng = np.random.default_rng(4)
    half = rng.normal(size=(2, 3, 3))
    rotary = jnp.asarray(half @ half.swapaxes(1, 2) + 10 * np.eye(3))
    point = mb.spatial.PointMass("p", mass=2.0)
    body = mb.spatial.Body("b", mass=3.0, inertia=rotary[0], position=(1.0, 0.0, 0.0))
    mixed = mb.Scene([point, body]).compile()
    inertias = [
        DiagonalInertia(jnp.array([1.0, 4.0, 0.3])),
        BlockInertia(jnp.array([2.0, 3.0]), rotary),
        mixed.inertia(0.0, *jax.tree.leaves(mb.assemble(mixed))),
        DenseInertia(rotary[0]),
    ]
    forces = [jnp.asarray(rng.normal(size=(n, 2))) for n in (3, 12, 9, 3)]

    def compare(inertias):
        for inertia, f in zip(inertias, forces, strict=True):
            root = inertia.root()
            back = root.transpose()
            for v in (f, f[:, 0]):
                yield root.product(back.product(v)), inertia.product(v)
                yield back.solve(root.solve(v)), inertia.solve(v)
                yield root.solve(root.product(v)), v
            framed = jax.grad(lambda inertia, f=f: jnp.sum(inertia.root().solve(f) ** 2))(inertia)
            plain = jax.grad(lambda inertia, f=f: jnp.vdot(f, inertia.solve(f)))(inertia)
            # A matrix that stays symmetric knows only the symmetric part of its gradient.
            symmetric = lambda x: x if x.ndim < 2 else x + x.swapaxes(-1, -2)
            yield from zip(*(map(symmetric, jax.tree.leaves(x)) for x in (framed, plain)), strict=True)

    for found, expected in jax.jit(lambda inertias: list(compare(inertias)))(inertias):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


# With no more bodies than it takes to have all their joints.
FEW = {
    "rod_chain": {"n": 5},
    "hanging_chain": {"n": 3},
    "tree": {"n": 4},
    "cable": {"n": 3},
    "net": {"n": 3, "m": 2},
    "n_four_bar": {"n": 1},
    "swash_plate": {"pistons": 1},
    "tracked_vehicle": {"n_wheels": 2},
}
LIBRARY = {name: FEW.get(name, {}) for name in mb.mechanisms.names()}


STEPS = 40


def motion_by(system, formulations, q, u):
    """A short motion from one state by every formulation, by a Runge–Kutta method of order four.

    **Returns:** what each formulation gives at the beginning of every step: state, accelerations and constraint forces,
    (steps, formulations, …); and at the start the multipliers, the Jacobian, and the basis of what it allows.
    """

    def evaluate(t, q, u):
        jacobian = jax.vmap(lambda q, u: pivoted_jacobian(system, t, q, u))(q, u)
        lane = lambda tree, k: jax.tree.map(lambda x: x[k], tree)
        solved = lambda at, formulation, jacobian: laws_of(system).solve(at, formulation, jacobian, at.gamma)
        pairs = [
            solved(Instant(system, t, q[k], u[k]), formulation, lane(jacobian, k))[:2]
            for k, formulation in enumerate(formulations.values())
        ]
        udot, multipliers = (jnp.stack(values) for values in zip(*pairs, strict=True))
        force = jnp.einsum("krn,kr->kn", jacobian.matrix, multipliers)
        rates = jax.vmap(lambda q, u: system.rates(t, q, u))(q, u)
        return rates, udot, force, multipliers, jacobian.matrix[0], jacobian.pivoted.null_space[0]

    def step(carry, _):
        t, q, u, h = carry

        def stage(rates, weights):
            ahead, _ = weights
            qdot, udot, *others = evaluate(t + ahead * h, q + ahead * h * rates[0], u + ahead * h * rates[1])
            return (qdot, udot), (qdot, udot, others)

        weights = jnp.array([0.0, 0.5, 0.5, 1.0]), jnp.array([1.0, 2.0, 2.0, 1.0]) / 6
        still = jnp.zeros_like(q), jnp.zeros_like(u)
        _, (qdot, udot, others) = jax.lax.scan(stage, still, weights)
        mean = lambda x: jnp.tensordot(weights[1], x, 1)
        # So short that the steps follow the fastest vibration and the fastest decay.
        speed, change = (jnp.max(jnp.abs(x) / system.velocity_scale()) for x in (u[0], udot[0, 0]))
        h = jnp.where(t > 0, h, 0.02 * jnp.minimum(1 / jnp.sqrt(1.0 + change), speed / (1e-9 + change)))
        first = jax.tree.map(lambda x: x[0], (udot, others))
        return (t + h, q + h * mean(qdot), u + h * mean(udot), h), (q, u, first)

    zero, lanes = jnp.zeros(()), (len(formulations), 1)
    start = zero, jnp.tile(q, lanes), jnp.tile(u, lanes), zero
    _, (q, u, (udot, (force, *others))) = jax.lax.scan(step, start, None, length=STEPS)
    return (q, u, udot, force), [x[0] for x in others]


def gauss_function(system, y, udot):
    """Gauss' function of accelerations at a state, which the true ones make least of those that constraints allow."""
    at = Instant(system, jnp.zeros(()), y.q, y.u)
    deviation = udot - at.inertia.solve(at.force)
    return jnp.vdot(deviation, at.inertia.product(deviation))


@pytest.mark.slow
@pytest.mark.parametrize("name", LIBRARY)
def test_formulations_agree(name):
    """Accelerations and multipliers by every formulation, at random states on the constraints, are those of least
    effort, and the motions from there are the same.
    """
    mechanism = mb.mechanisms.get(name, **LIBRARY[name])
    system, state = mechanism.system, mechanism.state
    formulations = FORMULATIONS if system.positive_definite_mass else WITHOUT_INVERSE_OF_MASS

    # Eliminations of many rows take longer than to compile them.
    @(jit_to_run_long if system.acceleration_rows > 16 else jax.jit)
    def solve(q, u, change):
        y = mb.manifold.project(system, 0.0, mb.State(q, u))
        motion, (multipliers, jacobian, basis) = motion_by(system, formulations, y.q, y.u)
        udot = motion[2][0]
        left = jax.vmap(lambda udot: system.acceleration_residual(0.0, y.q, y.u, udot))(udot)
        other = basis @ change
        gauss = [gauss_function(system, y, udot[0] + x) for x in (jnp.zeros_like(other), other)]
        excess = other @ system.inertia(0.0, y.q, y.u).product(other)
        terms = jacobian @ udot[0], jnp.abs(jacobian) @ jnp.abs(udot[0])
        power = multipliers @ (jacobian @ other), jnp.abs(multipliers) @ (jnp.abs(jacobian) @ jnp.abs(other))
        return motion, multipliers, left, terms, power, gauss, excess

    largest = lambda values: 1.0 + np.max(np.abs(values), initial=0.0)
    rng = np.random.default_rng(0)
    for _ in range(20):
        q = state.q + 0.01 * system.coordinate_scale() * jnp.asarray(rng.normal(size=system.nq))
        # A projection on constraints that are not linear starts near them.
        u = state.u + (1.0 if system.linear else 0.1) * jnp.asarray(rng.normal(size=system.nu))
        change = jnp.asarray(rng.normal(size=system.nu - system.acceleration_rank))
        motion, multipliers, left, (sums, sizes), (power, powers), (least, more), excess = solve(q, u, change)
        for values in (motion[2][0], multipliers):
            for k, formulation in enumerate(formulations):
                np.testing.assert_allclose(
                    values[k], values[0], rtol=0, atol=1e-10 * largest(values[0]), err_msg=formulation
                )
        np.testing.assert_allclose(left[0], 0.0, atol=1e-9 * largest(sums))
        np.testing.assert_allclose(left, 0.0, atol=1e-10 * largest(sizes))
        # The ideal force of constraints does no work in displacements that they allow.
        np.testing.assert_allclose(power, 0.0, atol=1e-10 * largest(powers))
        if system.ideal and system.positive_definite_mass:
            np.testing.assert_allclose(more - least, excess, rtol=0, atol=1e-12 * more)
        for values in motion:
            for k, formulation in enumerate(formulations):
                bound = 1e-8 * largest(values[:, 0])
                np.testing.assert_allclose(values[:, k], values[:, 0], rtol=0, atol=bound, err_msg=formulation)


MOTIONS = {
    "parallelogram": {},  # has redundant rows
    "pendulum": {"solver": diffrax.Tsit5(), "manifold": mb.manifold.Projection()},
}


@pytest.fixture(scope="module")
def motions():
    """How to run one motion on either manifold, and where it ends."""

    def by(name, **options):
        mechanism = mb.mechanisms.get(name)
        return lambda formulation: (
            mb.simulate(mechanism.system, mechanism.state, t1=0.2, rtol=1e-9, formulation=formulation, **options).ys
        )

    ways = [by(name, **options) for name, options in MOTIONS.items()]
    return [(way, way(Partitioned())) for way in ways]


@pytest.mark.slow
@pytest.mark.parametrize("formulation", [name for name in FORMULATIONS if name not in ("partitioned", "multipliers")])
def test_motions_by_every_formulation(formulation, motions):
    for way, expected in motions:
        end = way(FORMULATIONS[formulation])
        np.testing.assert_allclose(end.q, expected.q, rtol=0, atol=1e-9)
        np.testing.assert_allclose(end.u, expected.u, rtol=0, atol=1e-8)


def test_unknown_form_is_an_error():
    with pytest.raises(ValueError, match="moore_penrose"):
        UdwadiaKalaba("pinv")  # pyright: ignore[reportArgumentType]


# One of your own


class SaddlePoint(AbstractFormulation):
    """Accelerations and multipliers at once, from the matrix of both."""

    partitions: ClassVar[bool] = False
    inverts_mass: ClassVar[bool] = False

    def solve(self, inertia, force, jacobian, gamma):
        jacobian = jacobian.dense()
        A = jacobian.independent
        m, n = A.shape
        mass = inertia.product(jnp.eye(n))
        both = jnp.concatenate([jnp.concatenate([mass, -A.T], axis=1), jnp.concatenate([A, jnp.zeros((m, m))], axis=1)])
        solution = jnp.linalg.solve(both, jnp.concatenate([force, jacobian.gather_rows(gamma)]))
        return solution[:n], jacobian.scatter_rows(solution[n:])


@pytest.mark.slow
def test_a_formulation_of_ones_own(motions):
    for way, expected in motions:
        np.testing.assert_allclose(way(SaddlePoint()).q, expected.q, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_formulations_that_need_the_inverse_of_a_singular_mass_matrix_are_refused():
    mechanism = mb.mechanisms.get("spherical_four_bar")
    for formulation in (Multipliers(), Poincare(), UdwadiaKalaba()):
        with pytest.raises(ValueError, match="NullSpace"):
            mb.formulations.accelerations(mechanism.system, formulation, 0.0, mechanism.state.q, mechanism.state.u)
        with pytest.raises(ValueError, match="NullSpace"):
            mb.simulate(mechanism.system, mechanism.state, t1=1.0, formulation=formulation)
