"""Each rule of an operation gives what `jax.vmap` gives, with members on the last axis."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxmb.lanes import elementary, in_lanes

MEMBERS = 5
RANDOM = np.random.default_rng(0)
MATRICES = RANDOM.standard_normal((MEMBERS, 4, 3))
OTHERS = RANDOM.standard_normal((MEMBERS, 3, 6))
LARGE = RANDOM.standard_normal((MEMBERS, 40, 20))
LONG = RANDOM.standard_normal((MEMBERS, 600, 20))
VECTORS = RANDOM.standard_normal((MEMBERS, 4))
PLACES = np.array([0, 3, 1, 2, 7])
ORDERS = np.stack([RANDOM.permutation(20) for _ in range(MEMBERS)])


def entries(a, order):
    return a.at[order[:8, None], order[None, 4:]].get(mode="promise_in_bounds")


def counted(x, k):
    return lax.while_loop(lambda carry: carry[0] < k, lambda carry: (carry[0] + 1, carry[1] * 1.5 + 1), (0, x))


def rare(x):
    """A condition with a rule for batches, as those of events have."""
    taken = jax.custom_batching.custom_vmap(lambda x: lax.cond(x[0] > 0, lambda x: jnp.sort(2 * x), lambda x: x, x))
    taken.def_vmap(lambda size, batched, x: (jax.vmap(lambda x: jnp.where(x[0] > 0, jnp.sort(2 * x), x))(x), True))
    return taken(x)


def powers(x):
    """The number of turns differs within a member, and is the same for all members."""
    of_one = lambda n: lax.while_loop(lambda carry: carry[0] < n, lambda carry: (carry[0] + 1, carry[1] * x), (0, x))[1]
    return jax.vmap(of_one)(jnp.arange(MEMBERS))


def powers_twice(x):
    """Of two axes, with values that are the same for all members beside values that are not."""
    turn = lambda carry: (carry[0] + 1, carry[1] * 1.5, carry[2] * x)
    of_two = lambda m, n: lax.while_loop(lambda carry: carry[0] < m + n, turn, (0, jnp.ones(3), x))
    return jax.vmap(lambda m: jax.vmap(lambda n: of_two(m, n))(jnp.arange(MEMBERS)))(jnp.arange(3))


def halved(x, size):
    """The number of turns depends on the member as well."""
    of_one = lambda a: lax.while_loop(lambda c: jnp.sum(c) > 1.0, lambda c: 0.5 * c, a * jnp.abs(x))
    return jax.vmap(of_one)(jnp.arange(1.0, size + 1))


def halved_within(x):
    """A loop that ends at its own time, within a loop and a scan that do."""
    inner = lambda c: lax.while_loop(lambda c: jnp.sum(c) > 1.0, lambda c: 0.5 * c, c)
    outer = lambda n: lax.fori_loop(0, n, lambda k, c: inner(c + jnp.abs(x)), x)
    rows = lambda n: lax.scan(lambda c, row: (inner(c + row**2), c), outer(n), jnp.stack([x, 2 * x]))
    return jax.vmap(rows)(jnp.arange(MEMBERS))


def derivatives_of_a_loop(x):
    """Tangents have the axes of the condition as well, and rows of a Jacobian one more."""
    of_one = lambda n, x: lax.fori_loop(0, n, lambda k, c: jnp.sin(c) * x, x)
    return jax.vmap(lambda n: (jax.jacfwd(lambda x: of_one(n, x))(x), jax.jvp(lambda x: of_one(n, x), (x,), (x,))))(
        jnp.arange(MEMBERS)
    )


def chosen_within(x, k):
    """Loops within the branches of conditions, by members and by rows."""
    loop = lambda n: lax.while_loop(lambda c: c[0] < n, lambda c: (c[0] + 1, c[1] * x), (0, x))[1]
    every = lambda: jax.vmap(loop)(jnp.arange(3))
    of_row = lambda n: lax.cond(n > 1, loop, lambda n: x, n)
    return lax.cond(k > 1, every, lambda: jnp.zeros((3, 4)) + x[0]), jax.vmap(of_row)(jnp.arange(3) + k)


def keys(x):
    """Random keys in loops and conditions."""
    key = jax.random.key(0)
    of_one = lambda y: lax.while_loop(
        lambda carry: carry[0] < 3 * y, lambda carry: (carry[0] + 1, jax.random.fold_in(carry[1], 5)), (0.0, key)
    )[1]
    return jax.random.uniform(jax.vmap(of_one)(x)[1], (2,))


def read_before(a):
    """Starts in front of a table, the same for all members, are brought into range."""
    out = lax.fori_loop(0, 2, lambda k, c: c + lax.dynamic_slice(a, (k - 11, 0), (2, 3)), jnp.zeros((2, 3)))
    return out, lax.fori_loop(0, 2, lambda k, c: lax.dynamic_update_slice(c, c[1:3], (k - 11, 0)), a)


CASES = {
    "powers": (powers, VECTORS),
    "powers twice": (powers_twice, VECTORS),
    "halved": (lambda x: (halved(x, MEMBERS), halved(x, 4), halved(x, 3)), VECTORS),
    "halved within": (halved_within, VECTORS),
    "derivatives of a loop": (derivatives_of_a_loop, VECTORS),
    "chosen within": (chosen_within, VECTORS, PLACES),
    "keys": (keys, VECTORS),
    "read before": (read_before, MATRICES),
    "no terms": (lambda a: (lax.cumsum(a[:0], 0), lax.cummax(a[:0], 0), a[:0].sum(0), jnp.sort(a[:0], 0)), MATRICES),
    "recomputed": (lambda x: jax.checkpoint(lambda x: halved(jnp.sin(x), 3))(x), VECTORS),
    "products": (lambda a, b: (a @ b, a * 2, jnp.einsum("ij,ij->i", a, a)), MATRICES, OTHERS),
    "long products": (lambda a: (a @ a.T, a @ LARGE[0].T), LARGE),
    "no rows": (lambda a: a[:, :0] @ a[:, :0].T, MATRICES),
    "functions": (lambda x: (jnp.sin(x), jnp.cos(1e3 * x), jnp.abs(x) ** 1.7, x**3, jnp.exp(x), jnp.tanh(x)), VECTORS),
    "sums": (lambda a: (a.sum(0), a.max(1), jnp.prod(a), jnp.any(a > 1, axis=1), jnp.cumsum(a, 1)), MATRICES),
    "cumulative": (lambda a: (lax.cumsum(a, 0, reverse=True), lax.cummax(a, 1), jnp.cumsum(a[:, 0])), LONG[:, :100]),
    "places": (lambda a: (jnp.argmax(a, 0), jnp.argmin(a.at[1].set(jnp.nan), 0), jnp.argmax(a[:, 0])), MATRICES),
    "long sums": (lambda a: (a.sum(0), a.max(), jnp.argmax(a, 0)), LONG),
    "moved": (lambda a: (a[::-1], a.T, a.reshape(6, 2), a[1:3, ::2], jnp.stack([a, 2 * a], 1), a[None]), MATRICES),
    "joined": (lambda a: (jnp.concatenate([a, jnp.ones((2, 3))]), jnp.split(a, 2), jnp.sort(a, 0)), MATRICES),
    "padded": (lambda a: (jnp.pad(a, ((1, 2), (0, 1))), lax.pad(a, a[0, 0], ((1, 0, 1), (0, 0, 0)))), MATRICES),
    "selected": (lambda a, k: (jnp.where(a > a[k % 3], a, 0.0), jnp.clip(a, -(a[3] ** 2), 1.0)), VECTORS, PLACES),
    "shared places": (lambda a: (a[jnp.array([2, 0])], a.at[1].set(5.0), a.at[:, 1].add(a[:, 0])), MATRICES),
    "rows": (lambda a, k: (a[k], a[:, jnp.clip(k, 0, 2)], a.at[k].get(mode="fill", fill_value=3.0)), MATRICES, PLACES),
    "slices": (lambda a, k: lax.dynamic_slice(a, (k, 0), (2, 3)), MATRICES, PLACES),
    "set": (lambda a, k: (a.at[k].set(1.0), a.at[k].add(a[0]), a.at[k, 1].set(5.0)), MATRICES, PLACES),
    "updated": (lambda a, k: lax.dynamic_update_slice(a, a[:1], (k, 0)), MATRICES, PLACES),
    "large rows": (lambda a, k: (a[k], a[k, k], lax.dynamic_slice(a, (k, 0), (2, 3)), a[9 * k]), LARGE, PLACES),
    "large parts": (lambda a, k: lax.dynamic_slice(a, (5 * k, k), (3, 12)), LARGE, PLACES),
    "entries": (entries, LARGE, ORDERS),
    "entries at the same places": (entries, LARGE, np.tile(ORDERS[:1], (MEMBERS, 1))),
    "large set": (lambda a, k: (a.at[k].set(1.0), a.at[9 * k].set(a[0]), a.at[k, 2].set(5.0)), LARGE, PLACES),
    "large mode": (
        lambda a, k: (a.at[100 * k].set(a[0], mode="drop"), a.at[100 * k].set(0.0, mode="clip")),
        LONG,
        PLACES,
    ),
    "large updated": (lambda a, k: lax.dynamic_update_slice(a, a[:1], (90 * k, 0)), LONG, PLACES),
    "small integers": (lambda k: (k // 2, k % 3, k.astype(np.float32), k > 1), PLACES),
    "switch": (lambda x, k: lax.switch(jnp.clip(k, 0, 2), [lambda x: x, lambda x: 2 * x, jnp.sin], x), VECTORS, PLACES),
    "shared switch": (lambda x: lax.cond(jnp.array(1) > 0, lambda x: 2 * x, lambda x: jnp.ones(4), x), VECTORS),
    "cond": (lambda x: lax.cond(x[0] > 0, lambda x: x, lambda x: -x, x), VECTORS),
    "rare": (rare, VECTORS),
    "while": (counted, VECTORS, PLACES),
    "shared while": (lambda x: counted(x, 3), VECTORS),
    "scan": (lambda a: lax.scan(lambda c, row: (c + row, jnp.outer(row, c)), jnp.zeros(3), a), MATRICES),
    "backward": (lambda a: lax.scan(lambda c, row: (c * row, None), jnp.ones(3), a, reverse=True), MATRICES),
    "loop": (lambda x: lax.fori_loop(0, 4, lambda k, c: c.at[k].add(x[k]), jnp.zeros(4)), VECTORS),
    "constants": (lambda x: (jnp.full(3, 2.0) * x[0], jnp.arange(3), jnp.ones(2)), VECTORS),
}


SLOW = ("no rows", "large updated", "large mode", "entries at the same places", "long sums", "shared switch")
SLOW += ("powers twice", "halved within", "derivatives of a loop", "chosen within", "keys", "no terms", "recomputed")


def on_last_axis(function, *members):
    """The results with members on the last axis, moved to the first."""
    program = jax.make_jaxpr(function)(*[x[0] for x in members])
    found = in_lanes(program, len(members[0]))(*[jnp.moveaxis(jnp.asarray(x), 0, -1) for x in members])
    return [jnp.moveaxis(x, -1, 0) for x in found]


def compare(cases, rtol=1e-14):
    """One program has all cases in both ways."""
    given = {name: members for name, (_, *members) in cases.items()}
    in_lanes_ = lambda given: {name: on_last_axis(cases[name][0], *own) for name, own in given.items()}
    by_vmap = lambda given: {name: jax.tree.leaves(jax.vmap(cases[name][0])(*own)) for name, own in given.items()}
    found, expected = jax.device_get(jax.jit(lambda given: (in_lanes_(given), by_vmap(given)))(given))
    for name in cases:
        for x, y in zip(found[name], expected[name], strict=True):
            assert (x.shape, x.dtype) == (y.shape, y.dtype), name
            np.testing.assert_allclose(x, y, rtol=rtol, atol=rtol, err_msg=name)


def test_rules_give_what_vmap_gives():
    compare({name: case for name, case in CASES.items() if name not in SLOW})
    # An operation without a rule has that of batches; large angles are left to the library, and so are powers where
    # they are not plain.
    x, y = np.array([[2.0, -2.0, 0.0], [0.5, 3.0, np.inf]]), np.array([[0.0, 3.0, 0.0], [-1.5, np.inf, 2.0]])
    angles = np.array([[1.0, 1e9, 1e15], [2.0, -1e12, 0.5]])
    further = {
        "no rule": (lambda a: jnp.linalg.solve(a @ a.T + jnp.eye(4), a[:, 0]), MATRICES),
        "large angles": (lambda x: (jnp.sin(x), jnp.cos(x)), angles),
        "powers that are not plain": (lambda x, y: x**y, x, y),
    }
    compare(further, 1e-11)


@pytest.mark.slow
def test_rules_give_what_vmap_gives_in_loops_of_rows():
    compare({name: CASES[name] for name in SLOW})


@pytest.mark.slow
@pytest.mark.parametrize("rows", [3, MEMBERS])
@pytest.mark.parametrize("part", range(4))
def test_rules_give_what_vmap_gives_within_a_vmap(part, rows):
    """With as many rows as members as well, where axes could be taken for each other."""
    together = {}
    for name in [*CASES][part::4]:
        function, *members = CASES[name]
        together[name] = jax.vmap(function), *[np.stack([np.roll(x, k, 0) for k in range(rows)], 1) for x in members]
    compare(together, 1e-12)


@pytest.mark.parametrize("name", ["sin", "cos"])
def test_functions_by_operations_are_exact_to_three_units(name):
    x = np.concatenate([np.linspace(-300.0, 300.0, 20_001), RANDOM.uniform(-9e4, 9e4, 20_000)])
    exact = getattr(np, name)(x.astype(np.longdouble))
    found = np.asarray(jax.jit(getattr(elementary, name))(x))
    differs = found != exact.astype(float)
    # Sine and cosine are small by cancellation near multiples of half a turn.
    size = np.maximum(np.abs(found[differs]), 2.0**-30)
    assert np.all(np.abs(found[differs] - exact[differs]) <= 3 * np.spacing(size))


def test_powers_are_exact_over_the_whole_range():
    bases, exponents = np.geomspace(1e-200, 1e200, 401)[:, None], np.linspace(-0.06, 0.06, 25)[None]
    x, y = np.broadcast_arrays(bases, exponents)
    exact, power = x.astype(np.longdouble) ** y.astype(np.longdouble), jax.jit(elementary.power)
    np.testing.assert_allclose(power(x, y), exact.astype(float), rtol=1e-14)
    # Numbers below the normal ones, and powers near the end of the range, are those of the library.
    pairs = [(5e-324, 0.1), (1e-310, 0.5), (2.0, 1017.5), (2.0, -1010.5), (10.0, 305.0), (10.0, 400.0)]
    ends, library = np.array([[pair, (2.0, 0.5)] for pair in pairs]), jax.jit(lax.pow)
    for base, exponent in ends.swapaxes(1, 2):
        np.testing.assert_array_equal(power(base, exponent), library(base, exponent))
