"""All formulations give the same accelerations: on matrices against NumPy, on the library's mechanisms against each
other.
"""

from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from every_formulation import FORMULATIONS

import jaxmb as mb
from jaxmb.formulations import AbstractFormulation, Multipliers, Partitioned, Poincare, UdwadiaKalaba, accelerations
from jaxmb.formulations.formulation import pivoted_jacobian
from jaxmb.linalg.elimination import full_pivot
from jaxmb.linalg.jacobian import DenseJacobian
from jaxmb.system import DenseInertia, DiagonalInertia

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
    return root @ root.T + N * np.eye(N), rng.normal(size=N), A, A @ rng.normal(size=N)


def by_numpy(M, F, A, gamma, rows):
    """Accelerations and multipliers of the kept rows from the equations of both together."""
    A, gamma = A[rows], gamma[rows]
    m, n = A.shape
    both = np.block([[M, -A.T], [A, np.zeros((m, m))]])
    solution = np.linalg.solve(both, np.concatenate([F, gamma]))
    return solution[:n], solution[n:]


def test_formulations_are_equal_to_numpy():
    """Whichever rows and columns are chosen: charts that prefer other columns have other {1}-inverses.

    Also in a batch, whose members are those of a loop.
    """
    rng = np.random.default_rng(0)
    equations = [random_equation(rng) for _ in range(3)]
    scales = np.concatenate([np.ones((1, N)), 10.0 ** rng.uniform(-2, 2, size=(2, N))])

    @jax.jit
    @jax.vmap
    def solve(equation, scale):
        M, F, A, gamma = equation
        order = full_pivot(A, scale=scale).order
        return order.rows, *solve_by_all(DenseInertia(M), F, A, gamma, order)

    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *equations)
    solutions = zip(equations, *jax.device_get(solve(stacked, scales)), strict=True)
    for equation, order, udot, found in solutions:
        kept = order[:RANK]
        expected, some = by_numpy(*equation, kept)
        all_rows = np.zeros(RANK + 1)
        all_rows[kept] = some
        for k, name in enumerate(FORMULATIONS):
            np.testing.assert_allclose(udot[k], expected, rtol=0, atol=1e-11, err_msg=name)
            atol = 1e-11 * (1 + np.max(np.abs(some)))
            np.testing.assert_allclose(found[k], all_rows, rtol=0, atol=atol, err_msg=name)


@pytest.mark.slow
def test_formulations_for_a_singular_mass():
    """A velocity without mass, held by a constraint."""
    rng = np.random.default_rng(2)
    M, F, A, gamma = random_equation(rng, redundant=False)
    M[-1] = M[:, -1] = F[-1] = 0.0
    A[0] = 0.3 * np.eye(N)[0] + np.eye(N)[-1]
    formulations = WITHOUT_INVERSE_OF_MASS
    solve = lambda F, A, gamma: solve_by_all(DenseInertia(M), F, A, gamma, full_pivot(A).order, formulations)
    udot, multipliers = map(np.asarray, jax.jit(solve)(F, A, gamma))
    expected, _ = by_numpy(M, F, A, gamma, np.arange(RANK))
    for k, name in enumerate(formulations):
        close = lambda a, b, atol, name=name: np.testing.assert_allclose(a, b, rtol=0, atol=atol, err_msg=name)
        force = M @ udot[k] - F
        close(udot[k], expected, 1e-11)
        close(A @ udot[k], gamma, 1e-14 * (1 + np.max(np.abs(gamma))))
        close(A.T @ multipliers[k], force, 1e-14 * (1 + np.max(np.abs(force))))


@pytest.mark.slow
def test_forces_that_do_virtual_work():
    """A rigid body's rotation with one non-ideal constraint."""
    moments, spin = np.array([1.0, 2.0, 3.0]), np.array([0.3, -0.5, 0.8])
    force = np.array([0.1, 0.2, -0.3]) - np.cross(spin, moments * spin)
    A, gamma = np.array([[1.0, 2.0, -1.0]]), jnp.array([0.4])
    admissible = np.linalg.svd(A)[2][1:].T
    rough = np.array([0.05, -0.02, 0.03])

    @jax.jit
    def solve(F):
        jacobian = DenseJacobian(jnp.asarray(A)).eliminated(full_pivot(jnp.asarray(A)).order, 1)
        return [own.solve(DiagonalInertia(jnp.asarray(moments)), F, jacobian, gamma) for own in FORMULATIONS.values()]

    # Only the part along motions that the constraint allows acts.
    outcomes = zip(FORMULATIONS, solve(force), solve(force + rough), solve(force + 3.0 * A[0]), strict=True)
    for name, (ideal, multipliers), (udot, _), (same, _) in outcomes:
        close = lambda a, b, name=name: np.testing.assert_allclose(a, b, rtol=0, atol=1e-14, err_msg=name)
        close(A @ ideal, gamma)
        close(moments * ideal - force, A.T @ multipliers)
        close(admissible.T @ (moments * ideal - force), 0.0)
        close(A @ udot, gamma)
        close(admissible.T @ (moments * udot - force - rough), 0.0)
        close(same, ideal)


@pytest.mark.slow
def test_derivatives_of_formulations():
    """Of accelerations and constraint forces to all entries of M, F, A and γ, to the second order.

    An implied row follows the others.
    """
    rng = np.random.default_rng(3)
    M, F, A, gamma = random_equation(rng, redundant=False)
    combine = np.vstack([np.eye(RANK), [[1.0, 2.0, 0.0, 0.0]]])
    order = jax.jit(full_pivot)(combine @ A).order
    start, unravel = jax.flatten_util.ravel_pytree((M, F, A, gamma))
    direction = jnp.asarray(rng.normal(size=start.size))

    def solutions(entries):
        M, F, A, gamma = unravel(entries)
        inertia = DenseInertia((M + M.T) / 2)
        udot, multipliers = solve_by_all(inertia, F, combine @ A, combine @ gamma, order)
        return jnp.concatenate([udot, multipliers @ combine @ A], axis=1)

    @jax.jit
    def derivatives(entries):
        push = lambda of: jax.jvp(of, (entries,), (direction,))
        return push(jax.jacfwd(solutions)), push(jax.jacrev(solutions))

    (first, second), (first_reverse, second_reverse) = derivatives(start)
    h = 1e-5
    difference = lambda of: (of(start + h * direction) - of(start - h * direction)) / (2 * h)
    close = lambda a, b, atol: np.testing.assert_allclose(a, b, rtol=0, atol=atol * np.max(np.abs(a)))
    close(first_reverse, first, 1e-12)
    close(first, jnp.broadcast_to(first[:1], first.shape), 1e-11)
    close(first @ direction, difference(jax.jit(solutions)), 1e-8)
    close(second_reverse, second, 1e-12)
    close(second, jnp.broadcast_to(second[:1], second.shape), 1e-11)
    close(second, difference(lambda entries: derivatives(entries)[0][0]), 1e-8)


# One or more of each kind of system and of constraint, with no more bodies than it takes to have all their joints.
LIBRARY = {
    "parallelogram": {},
    "bricard": {},
    "cable": {"n": 3},
    "swash_plate": {"pistons": 1},
    "rolling_disc": {},
    "benenti": {},
    "roller_racer": {},
    "nonholonomic_cart": {"form": "constraints"},
    "constant_speed_particle": {},
    "rough_ring": {},
    "tracking_chain": {},
    "spherical_four_bar": {},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LIBRARY)
def test_formulations_agree(name):
    """Accelerations and multipliers by every formulation, at random states on the constraints.

    They satisfy the constraints, and the ideal force of these does no work in displacements that they allow.
    """
    mechanism = mb.mechanisms.get(name, **LIBRARY[name])
    system, state = mechanism.system, mechanism.state
    formulations = FORMULATIONS if system.positive_definite_mass else WITHOUT_INVERSE_OF_MASS

    @jax.jit
    def solve(q, u):
        y = mb.manifold.project(system, 0.0, mb.State(q, u))
        pairs = [accelerations(system, own, 0.0, y.q, y.u) for own in formulations.values()]
        udot, multipliers = (jnp.stack(values) for values in zip(*pairs, strict=True))
        left = jax.vmap(lambda udot: system.acceleration_residual(0.0, y.q, y.u, udot))(udot)
        jacobian = pivoted_jacobian(system, 0.0, y.q, y.u)
        return udot, multipliers, left, jacobian.matrix, jacobian.pivoted.null_space

    largest = lambda values: 1.0 + np.max(np.abs(values), initial=0.0)
    rng = np.random.default_rng(0)
    for _ in range(5):
        q = state.q + 0.01 * system.coordinate_scale() * jnp.asarray(rng.normal(size=system.nq))
        # A projection on constraints that are not linear starts near them.
        u = state.u + (1.0 if system.linear else 0.1) * jnp.asarray(rng.normal(size=system.nu))
        udot, multipliers, left, jacobian, basis = jax.device_get(solve(q, u))
        for values in (udot, multipliers):
            for k, own in enumerate(formulations):
                atol = 1e-10 * largest(values[0])
                np.testing.assert_allclose(values[k], values[0], rtol=0, atol=atol, err_msg=own)
        np.testing.assert_allclose(left, 0.0, atol=1e-10 * largest(np.abs(jacobian) @ np.abs(udot[0])))
        sizes = np.abs(multipliers) @ np.abs(jacobian) @ np.abs(basis)
        np.testing.assert_allclose(multipliers @ jacobian @ basis, 0.0, atol=1e-10 * largest(sizes))


MOTIONS = {
    "parallelogram": {},  # has redundant rows
    "pendulum": {"solver": diffrax.Tsit5(), "manifold": mb.manifold.Projection()},
}


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
@pytest.mark.parametrize("name", MOTIONS)
def test_motions_by_every_formulation(name):
    """And by one of your own, on either manifold."""
    mechanism = mb.mechanisms.get(name)
    options = MOTIONS[name] | {"t1": 0.2, "rtol": 1e-9}
    by = lambda own: mb.simulate(mechanism.system, mechanism.state, formulation=own, **options).ys
    expected = by(Partitioned())
    for own in (*list(FORMULATIONS.values())[2:], SaddlePoint()):
        end = by(own)
        np.testing.assert_allclose(end.q, expected.q, rtol=0, atol=1e-9)
        np.testing.assert_allclose(end.u, expected.u, rtol=0, atol=1e-8)


def test_unknown_form_is_refused():
    with pytest.raises(ValueError, match="moore_penrose"):
        UdwadiaKalaba("pinv")  # pyright: ignore[reportArgumentType]


@pytest.mark.slow
def test_inverse_of_a_singular_mass_matrix_is_refused():
    mechanism = mb.mechanisms.get("spherical_four_bar")
    for formulation in (Multipliers(), Poincare(), UdwadiaKalaba()):
        with pytest.raises(ValueError, match="NullSpace"):
            accelerations(mechanism.system, formulation, 0.0, mechanism.state.q, mechanism.state.u)
    with pytest.raises(ValueError, match="NullSpace"):
        mb.simulate(mechanism.system, mechanism.state, t1=1.0, formulation=Multipliers())
