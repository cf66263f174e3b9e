"""Sparse elimination of symmetric block matrices against NumPy, on graphs of many kinds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.linalg.block_elimination import eliminate_blocks
from jaxmb.linalg.elimination_order import order_nodes
from jaxmb.linalg.positive_definite import DensePositiveDefinite
from jaxmb.linalg.sums import placed_sums


def graph(n, edges):
    neighbours = [set() for _ in range(n)]
    for a, b in edges:
        if a != b:
            neighbours[a].add(b)
            neighbours[b].add(a)
    return neighbours


def grid(n, m):
    index = lambda i, j: i * m + j
    across = [(index(i, j), index(i, j + 1)) for i in range(n) for j in range(m - 1)]
    return graph(n * m, across + [(index(i, j), index(i + 1, j)) for i in range(n - 1) for j in range(m)])


def scattered(n, edges, seed):
    return graph(n, np.random.default_rng(seed).integers(0, n, (edges, 2)).tolist())


GRAPHS = {
    "one node": graph(1, []),
    "no neighbours": graph(5, []),
    "a chain": graph(30, [(k, k + 1) for k in range(29)]),
    "a ring": graph(31, [(k, (k + 1) % 31) for k in range(31)]),
    "a tree": graph(40, [(k, (k - 1) // 3) for k in range(1, 40)]),
    "a star": graph(25, [(0, k) for k in range(1, 25)]),
    "a grid": grid(6, 5),
    "everyone with everyone": graph(7, [(a, b) for a in range(7) for b in range(a)]),
    "few edges at random": scattered(30, 25, 0),
    "many edges at random": scattered(30, 70, 1),
}


def blocks_of(order, neighbours, b, rng):
    """Stored blocks and the whole matrix of a random positive definite one."""
    n = len(neighbours)
    stored = np.zeros((order.blocks, b, b))
    whole = np.zeros((n, b, n, b))
    for k, (i, j) in enumerate(zip(order.row, order.column, strict=True)):
        if i == j:
            half = rng.normal(size=(b, b))
            stored[k] = half @ half.T + 3 * b * (1 + len(neighbours[i])) * np.eye(b)
        elif j in neighbours[i]:
            stored[k] = rng.normal(size=(b, b))
        whole[j, :, i] = stored[k].T
        whole[i, :, j] = stored[k]
    return stored, whole.reshape(n * b, n * b)


def check(name, b):
    """Solutions of two matrices in a batch, and the pivots."""
    rng, order = np.random.default_rng(b), order_nodes(GRAPHS[name], b)
    stored, whole = map(np.stack, zip(*[blocks_of(order, GRAPHS[name], b, rng) for _ in range(2)], strict=True))
    x = rng.normal(size=(2, order.nodes, b))

    @jax.jit
    @jax.vmap
    def solve(stored, x):
        factor = eliminate_blocks(stored, order)
        return factor.pivots(), jax.vmap(factor.solve)(jnp.stack([x, 2 * x]))

    pivots, found = map(np.asarray, solve(stored, x))
    expected = np.linalg.solve(whole, x.reshape(2, -1, 1)).reshape(x.shape)
    np.testing.assert_allclose(found, np.stack([expected, 2 * expected], axis=1), rtol=0, atol=1e-14)
    for own, matrix in zip(pivots, whole, strict=True):
        # A pivot lies between what is left of a row given all others, and its diagonal.
        assert np.all(own >= 1 / np.diag(np.linalg.inv(matrix)).reshape(own.shape) * (1 - 1e-12))
        assert np.all(own <= np.diag(matrix).reshape(own.shape) * (1 + 1e-12))


@pytest.mark.parametrize(
    ("name", "b"),
    [("one node", 1), ("no neighbours", 2), ("a ring", 2), ("everyone with everyone", 3), ("many edges at random", 2)],
)
def test_solutions_and_pivots(name, b):
    check(name, b)


@pytest.mark.slow
def test_solutions_and_pivots_of_other_graphs():
    for name in ("a chain", "a tree", "a star", "a grid", "few edges at random", "many edges at random"):
        for b in (1, 3):
            check(name, b)


@pytest.mark.slow
def test_nodes_wait_for_those_they_come_after():
    """A quasi-definite matrix: its negative node must not come before the others."""
    neighbours = GRAPHS["a star"]
    order = order_nodes(neighbours, 2, after=[set(range(1, 25)), *([set()] * 24)])
    eliminated = [node for stage in order.stages for node in stage.nodes.ravel() if node < 25] + order.rest.tolist()
    assert eliminated[-1] == 0
    assert order.blocks == 25 + 24
    stored, whole = blocks_of(order, neighbours, 2, np.random.default_rng(0))
    minus = np.where((order.row == 0) & (order.column == 0), -1.0, 1.0)
    whole[:2, :2] *= -1.0
    x = np.random.default_rng(1).normal(size=(25, 2))
    found = jax.jit(lambda s: eliminate_blocks(s, order).solve(x))(stored * minus[:, None, None])
    np.testing.assert_allclose(found.ravel(), np.linalg.solve(whole, x.ravel()), rtol=0, atol=1e-14)


def test_work_and_program_grow_as_the_chain():
    """A number of levels like the logarithm, and a program of the same size."""
    sizes = {}
    for n in (100, 10000):
        order = order_nodes(graph(n, [(k, k + 1) for k in range(n - 1)]), 2)
        assert order.levels <= np.log2(n) + 1
        assert order.blocks <= 3 * n
        assert sum(stage.nodes.size for stage in order.stages) <= 2 * n
        stored, x = (
            jax.ShapeDtypeStruct((k, *shape), float) for k, shape in ((order.blocks, (2, 2)), (order.nodes, (2,)))
        )
        traced = jax.jit(lambda s, x, order=order: eliminate_blocks(s, order).solve(x)).trace(stored, x)
        sizes[n] = len(traced.jaxpr.eqns)
    assert sizes[10000] <= 3 * sizes[100]


def test_sums_of_places():
    shapes, given, expected = [(10, 3), (0, 4), (300, 1), (1000, 7), (50, 50)], [], []
    sums, rng = [], np.random.default_rng(0)
    for entries, places in shapes:
        place, values, total = (
            rng.integers(-1, places + 1, entries),
            rng.normal(size=(entries, 2)),
            np.zeros((places, 2)),
        )
        inside = (place >= 0) & (place < places)
        np.add.at(total, place[inside], values[inside])
        sums.append(placed_sums(place, places))
        assert sum(index.size for index in sums[-1].passes) <= 2 * entries + 4 * places
        given.append(values)
        expected.append(total)
    found = jax.jit(lambda given: [of(values) for of, values in zip(sums, given, strict=True)])(given)
    for own, total in zip(found, expected, strict=True):
        np.testing.assert_allclose(own, total, rtol=0, atol=1e-12)


@pytest.mark.parametrize("n", [1, 4])
def test_dense_matrices_and_their_derivatives(n):
    rng = np.random.default_rng(n)
    root, change = rng.normal(size=(2, n, n))
    T, dT = root @ root.T + n * np.eye(n), change + change.T
    b = rng.normal(size=n)

    @jax.jit
    def run(T):
        known = DensePositiveDefinite(T).eliminate()
        x, dx = jax.jvp(lambda T: DensePositiveDefinite(T).eliminate().solve(b), (T,), (jnp.asarray(dT),))
        # The factor of one matrix with the derivatives of another of the same value.
        borrowed = lambda s: known.for_matrix(DensePositiveDefinite(T + s * dT)).solve(b)
        return x, dx, jax.jacrev(borrowed)(0.0), known.smallest_pivot()

    x, dx, borrowed, pivot = run(T)
    np.testing.assert_allclose(x, np.linalg.solve(T, b), rtol=0, atol=1e-13)
    np.testing.assert_allclose(dx, -np.linalg.solve(T, dT @ x), rtol=0, atol=1e-12)
    np.testing.assert_allclose(borrowed, dx, rtol=0, atol=1e-12)
    assert pivot == pytest.approx(np.min(1 / (np.diag(np.linalg.inv(T)) * np.diag(T))), rel=1e-12)
