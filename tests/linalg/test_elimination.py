"""Full-pivot elimination against NumPy's ranks, inverses and finite differences."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.linalg.elimination import cholesky, eliminate, full_pivot, gauss_jordan, solve, solve_positive

RNG = np.random.default_rng(0)


def random_matrix(m, n, rank):
    return RNG.normal(size=(m, rank)) @ RNG.normal(size=(rank, n))


def by_numpy(function):
    """A compiled function whose results are of NumPy."""
    compiled = jax.jit(function)
    return lambda *args: jax.device_get(compiled(*args))


@pytest.mark.parametrize(("m", "n", "rank"), [(1, 3, 1), (9, 7, 7), (12, 14, 9), (30, 35, 28), (5, 5, 0)])
def test_full_pivot_finds_rank_orders_and_influence(m, n, rank):
    A = random_matrix(m, n, rank)

    @by_numpy
    def run(A):
        pivots = full_pivot(A)
        return pivots, eliminate(A, pivots.order, rank)

    pivots, solved = run(A)
    assert pivots.rank == rank
    order = pivots.order
    assert sorted(order.rows) == list(range(m))
    assert sorted(order.columns) == list(range(n))
    np.testing.assert_array_equal(order.rows[order.row_place], np.arange(m))
    np.testing.assert_array_equal(order.columns[order.column_place], np.arange(n))
    np.testing.assert_allclose(A @ solved.null_space, 0, atol=1e-11 * max(1, np.max(np.abs(A))))
    independent = order.columns[rank:]
    np.testing.assert_allclose(solved.null_space[independent], np.eye(n - rank), rtol=0, atol=0)
    # The correction solves consistent equations and leaves independent columns alone.
    x = RNG.normal(size=n)
    moved = solved.right_inverse @ (A @ x)
    np.testing.assert_allclose(A @ moved, A @ x, rtol=0, atol=1e-10 * max(1, np.max(np.abs(A @ x))))
    np.testing.assert_allclose(moved[independent], 0, atol=0)


def test_full_pivot_minds_scales_levels_and_tolerance():
    rows = random_matrix(3, 6, 3)
    implied = np.concatenate([rows, (rows[0] + rows[1] + 1e-15)[None]])
    near, staged = implied.copy(), np.concatenate([0.1 * random_matrix(2, 6, 2), random_matrix(2, 6, 2)])
    near[3, 2] += 1e-5
    one = np.array([[1.0, 0.1]])

    @by_numpy
    def run(one, implied, near, staged):
        scaled = full_pivot(one, scale=jnp.array([1e-3, 1.0]))
        nested = full_pivot(staged, level=jnp.array([0, 0, 1, 1]))
        return full_pivot(one), scaled, full_pivot(implied), full_pivot(near), nested, full_pivot(staged[:2])

    plain, scaled, rounding, other, nested, first = run(one, implied, near, staged)
    # One row, a length of 1000 against an angle: in scaled units the angle counts more.
    assert (plain.order.columns[0], scaled.order.columns[0]) == (0, 1)
    # Between rounding and a mechanism that nearly toggles.
    assert (rounding.rank, other.rank) == (3, 4)
    assert set(nested.order.rows[:2].tolist()) == {0, 1}
    np.testing.assert_array_equal(nested.order.columns[:2], first.order.columns[:2])


@pytest.mark.slow("20-22")
@pytest.mark.parametrize(("m", "n"), [(8, 12), (20, 22)])
def test_batches_are_eliminated_as_their_members_are(m, n):
    """With derivatives; each member in an order of its own, whose influence is of order one, and batches of batches."""
    batch = RNG.normal(size=(2, 6, m, n))
    weights = RNG.normal(size=(n, n))

    def single(A):
        def total(A):
            pivots = full_pivot(A)
            solved = eliminate(A, pivots.order, m)
            both = jnp.concatenate([solved.right_inverse, solved.null_space], axis=1)
            return jnp.sum(weights * both**2), (pivots.order.columns, solved.null_space)

        return jax.value_and_grad(total, has_aux=True)(A)

    alone, together = by_numpy(single), by_numpy(jax.vmap(jax.vmap(single)))(batch)
    assert len({tuple(columns) for columns in together[0][1][0].reshape(12, n)}) > 1
    assert np.max(np.abs(together[0][1][1])) < 10
    for place in np.ndindex(2, 6):
        for found, expected in zip(jax.tree.leaves(together), jax.tree.leaves(alone(batch[place])), strict=True):
            np.testing.assert_allclose(found[place], expected, rtol=0, atol=1e-11 * np.max(np.abs(expected)))


def test_factor_has_the_derivatives_of_a_matrix():
    """Also the second ones, although its numbers have none; of values they are those of central differences."""
    A, along = RNG.normal(size=(2, 3, 5))

    @by_numpy
    def run(h):
        order = full_pivot(A).order
        known = eliminate(jnp.asarray(A), order, 3)

        def derivatives(of):
            matrices = lambda s: jax.tree.leaves((of(A + s * along).right_inverse, of(A + s * along).null_space))
            return matrices(h), jax.jacfwd(matrices)(h), jax.jacfwd(jax.jacfwd(matrices))(h)

        # The numbers stay those of the matrix at which they were found.
        return derivatives(known.for_matrix)[1:], derivatives(lambda A: eliminate(A, order, 3))

    h = 1e-5
    (found, expected), (_, ahead), (_, behind) = (run(s) for s in (0.0, h, -h))
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected[1:]), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-11)
    for own, after, before in zip(expected[1:], ahead, behind, strict=False):
        for one, a, b in zip(own, after, before, strict=True):
            np.testing.assert_allclose(one, (a - b) / (2 * h), rtol=1e-6, atol=1e-6)


def test_gauss_jordan_values_and_derivatives():
    matrices = [RNG.normal(size=(n, n + 3)) + np.eye(n, n + 3) * 10 for n in (5, 30, 45)]
    direction, weights = RNG.normal(size=(2, 5, 8))

    @by_numpy
    def run(B, others):
        loss = lambda B: jnp.sum(weights * jnp.sin(gauss_jordan(B, 5)))
        value, forward = jax.jvp(loss, (B,), (jnp.asarray(direction),))
        swept = [gauss_jordan(own, own.shape[0]) for own in (B, *others)]
        return value, forward, jnp.vdot(jax.grad(loss)(B), direction), swept

    _, forward, reverse, swept = run(matrices[0], matrices[1:])
    for B, found in zip(matrices, swept, strict=True):
        inverse = np.linalg.inv(B[:, : len(B)])
        np.testing.assert_allclose(found, np.hstack([inverse, inverse @ B[:, len(B) :]]), rtol=0, atol=1e-12)
    values = [run(matrices[0] + s * 1e-5 * direction, matrices[1:])[0] for s in (1, -1)]
    np.testing.assert_allclose(reverse, forward, rtol=1e-10)
    np.testing.assert_allclose(forward, (values[0] - values[1]) / 2e-5, rtol=1e-6)


@pytest.mark.parametrize("size", [5, 41])
def test_gauss_jordan_in_a_loop_has_derivatives_of_its_gradient(size):
    """Side by side, by a number that the first derivatives of all members share."""
    matrix, change = np.eye(size) + 0.1 * RNG.normal(size=(2, size, size)) / size

    def looped(x):
        step = lambda _, x: x + 0.1 * jnp.sum(gauss_jordan(matrix + jnp.sum(x) * change, size))
        return jnp.sum(jax.lax.fori_loop(0, 2, step, x))

    x = np.array([0.1, 0.2])
    both = jax.jit(lambda x: (jax.jacfwd(jax.grad(looped))(x), jax.jacfwd(jax.jacfwd(looped))(x)))
    np.testing.assert_allclose(*both(x), rtol=1e-9)


def test_solve_of_any_regular_matrix():
    """With zeros on the diagonal, so that rows have to be chosen, and one by one in a batch."""
    equations = []
    for n in (0, 1, 2, 5, 12, 41):
        A = RNG.normal(size=(4, n, n)) * (1 - np.eye(n)) if n > 1 else RNG.normal(size=(4, n, n))
        equations.append((A, RNG.normal(size=(4, n)), RNG.normal(size=(n, 3))))
    hilbert = [1 / (1 + np.arange(n)[:, None] + np.arange(n)[None]) for n in (4, 6, 8)]

    @by_numpy
    def run(equations, hilbert):
        several = [(solve(A[0], b[0]), solve(A[0], c), jax.vmap(solve)(A, b)) for A, b, c in equations]
        residuals = [A @ (solve(A, jnp.sum(A, axis=1)) - 1) for A in hilbert]
        return several, residuals, solve(jnp.array([[1.0, 2.0], [2.0, 4.0]]), jnp.ones(2))

    several, residuals, singular = run(equations, hilbert)
    for (A, b, c), (one, matrix, batch) in zip(equations, several, strict=True):
        np.testing.assert_allclose(one, np.linalg.solve(A[0], b[0]), rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(matrix, np.linalg.solve(A[0], c), rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(batch, np.linalg.solve(A, b[..., None])[..., 0], rtol=1e-8)
    # One correction leaves the residual of an elimination, up to a condition of 1e10.
    assert all(np.max(np.abs(left)) < 2e-14 * len(left) for left in residuals)
    assert not np.any(np.isfinite(singular))


def test_solve_has_derivatives_of_every_order():
    at, along = [(RNG.normal(size=(4, 4)), RNG.normal(size=4)) for _ in range(2)]

    def derivatives(by):
        loss = lambda A, b: jnp.sum(jnp.sin(by(A, b)))
        slope = lambda A, b: jax.jvp(loss, (A, b), along)[1]
        return slope(*at), jax.grad(loss, (0, 1))(*at), jax.grad(slope, (0, 1))(*at)

    found, expected = by_numpy(lambda: (derivatives(solve), derivatives(jnp.linalg.solve)))()
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-9), found, expected)


def test_solve_positive_and_cholesky_with_derivatives():
    roots = [RNG.normal(size=(n, n)) for n in (0, 1, 5, 30)]
    positive = [(root @ root.T + np.eye(len(root)), RNG.normal(size=len(root))) for root in roots]
    along = RNG.normal(size=(5, 5))

    @by_numpy
    def run(positive):
        (M, force), dM = positive[2], along + along.T
        # Results that are the same for every root have derivatives; this one knows its own without a root.
        distance = lambda s: jnp.sum(solve_positive(cholesky(M + s * dM), force) ** 2)
        plain = lambda s: force @ jnp.linalg.solve(M + s * dM, force)
        pairs = []
        for _ in range(3):
            pairs.append((distance(0.0), plain(0.0)))
            distance, plain = jax.grad(distance), jax.jacfwd(plain)
        return [(solve_positive(*own), cholesky(own[0]) if len(own[1]) else own[0]) for own in positive], pairs

    solutions, pairs = run(positive)
    for (M, b), (x, root) in zip(positive, solutions, strict=True):
        np.testing.assert_allclose(M @ x, b, rtol=0, atol=1e-10)
        np.testing.assert_allclose(root, np.linalg.cholesky(M) if len(M) else M, rtol=0, atol=1e-12)
    for order, (found, expected) in enumerate(pairs):
        np.testing.assert_allclose(found, expected, rtol=1e-10, err_msg=f"derivative {order}")
