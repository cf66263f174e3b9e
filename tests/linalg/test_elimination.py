"""Full-pivot elimination against NumPy's ranks, inverses and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.linalg import elimination

# As programs: every operation of its own would be compiled for every shape.
full_pivot, solve, solve_positive, cholesky = map(
    jax.jit, (elimination.full_pivot, elimination.solve, elimination.solve_positive, elimination.cholesky)
)
eliminate = jax.jit(elimination.eliminate, static_argnums=2)
gauss_jordan = jax.jit(elimination.gauss_jordan, static_argnums=1)

RNG = np.random.default_rng(0)


def random_matrix(m, n, rank):
    return jax.device_put(RNG.normal(size=(m, rank)) @ RNG.normal(size=(rank, n)))


@pytest.mark.parametrize(
    ("m", "n", "rank"), [(1, 3, 1), (4, 9, 4), (8, 9, 8), (9, 7, 7), (12, 14, 9), (30, 35, 28), (5, 5, 0)]
)
def test_rank_orders_and_influence(m, n, rank):
    A = random_matrix(m, n, rank)
    pivots = full_pivot(A)
    assert int(pivots.rank) == rank
    order = pivots.order
    assert sorted(np.asarray(order.rows)) == list(range(m))
    assert sorted(np.asarray(order.columns)) == list(range(n))
    np.testing.assert_array_equal(np.asarray(order.rows)[np.asarray(order.row_place)], np.arange(m))
    np.testing.assert_array_equal(np.asarray(order.columns)[np.asarray(order.column_place)], np.arange(n))
    solved = eliminate(A, order, rank)
    A = np.asarray(A)
    np.testing.assert_allclose(A @ solved.null_space, 0, atol=1e-11 * max(1, np.max(np.abs(A))))
    independent = np.asarray(order.columns)[rank:]
    np.testing.assert_allclose(np.asarray(solved.null_space)[independent], np.eye(n - rank), rtol=0, atol=0)
    # The correction solves consistent equations and leaves independent columns alone.
    x = RNG.normal(size=n)
    moved = np.asarray(solved.right_inverse) @ (A @ x)
    np.testing.assert_allclose(A @ moved, A @ x, rtol=0, atol=1e-10 * max(1, np.max(np.abs(A @ x))))
    np.testing.assert_allclose(moved[independent], 0, atol=0)


def test_influence_is_of_order_one():
    for _ in range(20):
        A = random_matrix(8, 12, 8)
        pivots = full_pivot(A)
        influence = eliminate(A, pivots.order, 8).null_space
        assert np.max(np.abs(influence)) < 10


def test_scale_decides_between_units():
    # One row, a length of 1000 against an angle: in scaled units the angle counts more.
    A = jnp.array([[1.0, 0.1]])
    assert int(full_pivot(A).order.columns[0]) == 0
    assert int(full_pivot(A, scale=jnp.array([1e-3, 1.0])).order.columns[0]) == 1


def test_stages_nest():
    A = jnp.concatenate([0.1 * random_matrix(2, 6, 2), random_matrix(2, 6, 2)])
    order = full_pivot(A, level=jnp.array([0, 0, 1, 1])).order
    assert set(np.asarray(order.rows[:2]).tolist()) == {0, 1}
    np.testing.assert_array_equal(order.columns[:2], full_pivot(A[:2]).order.columns[:2])


def test_rank_tolerance_between_rounding_and_near_toggle():
    rows = random_matrix(3, 6, 3)
    implied = jnp.concatenate([rows, (rows[0] + rows[1] + 1e-15)[None]])
    assert int(full_pivot(implied).rank) == 3
    near = implied.at[3, 2].add(1e-5)
    assert int(full_pivot(near).rank) == 4


def test_jit_vmap_equal_loop():
    batch = jnp.stack([random_matrix(5, 8, 5) for _ in range(4)])
    together = jax.jit(jax.vmap(full_pivot))(batch)
    for k in range(4):
        alone = full_pivot(batch[k])
        np.testing.assert_array_equal(together.order.packed[k], alone.order.packed)


@pytest.mark.slow("3-5", "20-22")
@pytest.mark.parametrize(("m", "n"), [(8, 9), (3, 5), (1, 2), (20, 22)])
def test_batches_are_eliminated_as_their_members_are(m, n):
    """With derivatives; each member in an order of its own, and batches of batches."""
    batch = jnp.asarray(RNG.normal(size=(2, 6, m, n)))
    weights = jnp.asarray(RNG.normal(size=(n, n)))

    @jax.value_and_grad
    def single(A):
        solved = eliminate(A, full_pivot(A).order, m)
        return jnp.sum(weights * jnp.concatenate([solved.right_inverse, solved.null_space], axis=1) ** 2)

    assert len({tuple(np.asarray(full_pivot(A).order.columns)) for A in batch[0]}) > 1
    found = jax.jit(jax.vmap(jax.vmap(single)))(batch)
    alone = jax.jit(single)
    for place in np.ndindex(2, 6):
        for together, expected in zip(found, alone(batch[place]), strict=True):
            np.testing.assert_allclose(together[place], expected, rtol=0, atol=1e-11 * np.max(np.abs(expected)))


@pytest.mark.parametrize("n", [3, 8, 30])
def test_gauss_jordan_values_and_derivatives(n):
    B = jnp.asarray(RNG.normal(size=(n, n + 3)) + np.eye(n, n + 3) * 10)
    swept = gauss_jordan(B, n)
    inverse = np.linalg.inv(B[:, :n])
    np.testing.assert_allclose(swept, np.concatenate([inverse, inverse @ B[:, n:]], axis=1), rtol=0, atol=1e-12)
    weights = jnp.asarray(RNG.normal(size=swept.shape))
    loss = lambda B: jnp.sum(weights * jnp.sin(gauss_jordan(B, n)))
    gradient = jax.jit(jax.grad(loss))(B)
    direction = RNG.normal(size=B.shape)
    forward = jax.jit(lambda B: jax.jvp(loss, (B,), (jnp.asarray(direction),))[1])(B)
    value = jax.jit(loss)
    central = (value(B + 1e-5 * direction) - value(B - 1e-5 * direction)) / 2e-5
    np.testing.assert_allclose(np.vdot(gradient, direction), forward, rtol=1e-10)
    np.testing.assert_allclose(forward, central, rtol=1e-6)


def test_factor_second_derivative():
    A = random_matrix(4, 6, 4)
    order = full_pivot(A).order
    direction = random_matrix(4, 6, 4)
    curve = lambda s: jnp.sum(eliminate(A + s * direction, order, 4).null_space ** 2)
    second = jax.jit(jax.grad(jax.grad(curve)))(0.0)
    curve, h = jax.jit(curve), 1e-4
    np.testing.assert_allclose(second, (curve(h) - 2 * curve(0.0) + curve(-h)) / h**2, rtol=1e-4)


@pytest.mark.parametrize("n", [0, 1, 5, 30])
def test_solve_positive(n):
    root = jnp.asarray(RNG.normal(size=(n, n)))
    M = root @ root.T + jnp.eye(n)
    b = jnp.asarray(RNG.normal(size=n))
    np.testing.assert_allclose(M @ solve_positive(M, b), b, rtol=0, atol=1e-10)


@pytest.mark.parametrize("n", [1, 5])
def test_cholesky_and_its_derivatives(n):
    start, along = RNG.normal(size=(2, n, n))
    M = jnp.asarray(start @ start.T + np.eye(n))
    dM = jnp.asarray(along + along.T)
    np.testing.assert_allclose(cholesky(M), np.linalg.cholesky(M), rtol=0, atol=1e-13)
    # Results that are the same for every root have derivatives; this one knows its own without a root.
    force = jnp.asarray(RNG.normal(size=n))
    distance = lambda s: jnp.sum(solve_positive(cholesky(M + s * dM), force) ** 2)
    plain = lambda s: force @ jnp.linalg.solve(M + s * dM, force)
    for order in range(3):
        found, expected = jax.jit(lambda s, both=(distance, plain): [of(s) for of in both])(0.0)
        np.testing.assert_allclose(found, expected, rtol=1e-10, err_msg=f"derivative {order}")
        distance, plain = jax.grad(distance), jax.jacfwd(plain)


@pytest.mark.parametrize("n", [0, 1, 2, 5, 12, 41])
def test_solve_of_any_regular_matrix(n):
    """With zeros on the diagonal, so that rows have to be chosen."""
    A = RNG.normal(size=(n, n)) * (1 - np.eye(n)) if n > 1 else RNG.normal(size=(n, n))
    for b in (RNG.normal(size=n), RNG.normal(size=(n, 3))):
        np.testing.assert_allclose(solve(A, b), np.linalg.solve(A, b), rtol=1e-9, atol=1e-11)
    As, bs = RNG.normal(size=(4, n, n)), RNG.normal(size=(4, n))
    together = jax.vmap(elimination.solve)(As, bs)
    np.testing.assert_allclose(together, [np.linalg.solve(*pair) for pair in zip(As, bs, strict=True)], rtol=1e-8)


def test_solve_leaves_the_residual_of_an_elimination():
    """Of Hilbert's matrices, up to a condition of 1e10."""
    for n in (4, 6, 8):
        A = 1 / (1 + np.arange(n)[:, None] + np.arange(n)[None])
        x = np.asarray(solve(A, A @ np.ones(n)))
        assert np.max(np.abs(A @ x - A @ np.ones(n))) < 1e-14 * n * np.max(np.abs(x))


@pytest.mark.slow
def test_solve_has_derivatives_of_every_order():
    A, b = jnp.asarray(RNG.normal(size=(4, 4))), jnp.asarray(RNG.normal(size=4))
    by = jax.jit(lambda A, b: jnp.sum(jnp.sin(elimination.solve(A, b))))
    other = jax.jit(lambda A, b: jnp.sum(jnp.sin(jnp.linalg.solve(A, b))))
    for derivative in (jax.grad, jax.jacfwd, jax.hessian):
        for k in (0, 1):
            np.testing.assert_allclose(derivative(by, k)(A, b), derivative(other, k)(A, b), rtol=1e-9, atol=1e-9)


def test_solve_with_a_singular_matrix_is_not_finite():
    assert not np.any(np.isfinite(solve(np.array([[1.0, 2.0], [2.0, 4.0]]), np.ones(2))))


def test_a_factor_has_the_derivatives_of_a_matrix():
    """Also the second ones, although its numbers have none."""
    rng = np.random.default_rng(3)
    A, along = (jnp.asarray(rng.normal(size=(3, 5))) for _ in range(2))
    order = full_pivot(A).order
    known = eliminate(A, order, 3)

    def derivatives(of):
        matrices = lambda s: jax.tree.leaves((of(A + s * along).right_inverse, of(A + s * along).null_space))
        return matrices(0.0), jax.jacfwd(matrices)(0.0), jax.jacfwd(jax.jacfwd(matrices))(0.0)

    found, expected = jax.jit(lambda: (derivatives(known.for_matrix), derivatives(lambda A: eliminate(A, order, 3))))()
    # The numbers stay those of the matrix at which they were found.
    for one, other in zip(jax.tree.leaves(found[1]), jax.tree.leaves(expected[1]), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-12)
    for one, other in zip(jax.tree.leaves(found[2]), jax.tree.leaves(expected[2]), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-11)
