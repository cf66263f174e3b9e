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
    return jnp.asarray(stored), whole.reshape(n * b, n * b)


SOON = {*((name, 2) for name in GRAPHS), ("a grid", 1), ("many edges at random", 3)}
EVERY = [(name, b) for name in GRAPHS for b in (1, 2, 3)]


@pytest.mark.slow("many edges at random-3")
@pytest.mark.parametrize(
    ("name", "b"), [pytest.param(*own, marks=[] if own in SOON else [pytest.mark.slow]) for own in EVERY]
)
def test_solutions_and_pivots(name, b):
    rng = np.random.default_rng(b)
    order = order_nodes(GRAPHS[name], b)
    stored, whole = blocks_of(order, GRAPHS[name], b, rng)
    x = rng.normal(size=(order.nodes, b))

    @jax.jit
    def solve(stored, x):
        factor = eliminate_blocks(stored, order)
        return factor.solve(x), factor.pivots(), jax.vmap(factor.solve)(jnp.stack([x, 2 * x]))

    found, pivots, twice = solve(stored, jnp.asarray(x))
    expected = np.linalg.solve(whole, x.ravel()).reshape(x.shape)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(twice, [expected, 2 * expected], rtol=0, atol=1e-14)
    # A pivot lies between what is left of a row given all others, and its diagonal.
    least = 1 / np.diag(np.linalg.inv(whole)).reshape(x.shape)
    assert np.all(pivots >= least * (1 - 1e-12))
    assert np.all(pivots <= np.diag(whole).reshape(x.shape) * (1 + 1e-12))


def test_a_batch_of_matrices():
    rng = np.random.default_rng(0)
    order = order_nodes(GRAPHS["a tree"], 2)
    matrices = [blocks_of(order, GRAPHS["a tree"], 2, rng) for _ in range(5)]
    x = jnp.asarray(rng.normal(size=(5, order.nodes, 2)))
    found = jax.jit(jax.vmap(lambda s, x: eliminate_blocks(s, order).solve(x)))(jnp.stack([s for s, _ in matrices]), x)
    expected = [np.linalg.solve(whole, own.ravel()) for (_, whole), own in zip(matrices, x, strict=True)]
    np.testing.assert_allclose(found.reshape(5, -1), expected, rtol=0, atol=1e-14)


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
    found = eliminate_blocks(stored * minus[:, None, None], order).solve(jnp.asarray(x))
    np.testing.assert_allclose(found.ravel(), np.linalg.solve(whole, x.ravel()), rtol=0, atol=1e-14)


def test_work_and_program_grow_as_the_chain():
    """A number of levels like the logarithm, and a program of the same size."""
    sizes = {}
    for n in (100, 10000):
        neighbours = graph(n, [(k, k + 1) for k in range(n - 1)])
        order = order_nodes(neighbours, 2)
        assert order.levels <= np.log2(n) + 1
        assert order.blocks <= 3 * n
        assert sum(stage.nodes.size for stage in order.stages) <= 2 * n
        stored = jax.ShapeDtypeStruct((order.blocks, 2, 2), float)
        text = jax.jit(lambda s, order=order: eliminate_blocks(s, order).solve(jnp.ones((order.nodes, 2)))).lower(
            stored
        )
        sizes[n] = len(text.as_text().splitlines())
    assert sizes[10000] <= 3 * sizes[100]


@pytest.mark.parametrize(("entries", "places"), [(10, 3), (0, 4), (300, 1), (1000, 7), (50, 50)])
def test_sums_of_places(entries, places):
    rng = np.random.default_rng(entries)
    place, values = rng.integers(-1, places + 1, entries), rng.normal(size=(entries, 2))
    expected = np.zeros((places, 2))
    inside = (place >= 0) & (place < places)
    np.add.at(expected, place[inside], values[inside])
    sums = placed_sums(place, places)
    np.testing.assert_allclose(sums(jnp.asarray(values)), expected, rtol=0, atol=1e-12)
    assert sum(index.size for index in sums.passes) <= 2 * entries + 4 * places


@pytest.mark.slow("4")
@pytest.mark.parametrize("n", [1, 4])
def test_dense_matrices(n):
    rng = np.random.default_rng(n)
    root, change = rng.normal(size=(2, n, n))
    T, dT = root @ root.T + n * np.eye(n), change + change.T
    b = rng.normal(size=n)
    solve = lambda T: DensePositiveDefinite(T).eliminate().solve(b)
    x, dx = jax.jvp(solve, (jnp.asarray(T),), (jnp.asarray(dT),))
    np.testing.assert_allclose(x, np.linalg.solve(T, b), rtol=0, atol=1e-13)
    np.testing.assert_allclose(dx, -np.linalg.solve(T, dT @ x), rtol=0, atol=1e-12)
    # The factor of one matrix with the derivatives of another of the same value.
    borrowed = lambda s: DensePositiveDefinite(T).eliminate().for_matrix(DensePositiveDefinite(T + s * dT)).solve(b)
    np.testing.assert_allclose(jax.jacrev(borrowed)(0.0), dx, rtol=0, atol=1e-12)
    pivot = DensePositiveDefinite(jnp.asarray(T)).eliminate().smallest_pivot()
    assert pivot == pytest.approx(np.min(1 / (np.diag(np.linalg.inv(T)) * np.diag(T))), rel=1e-12)
