"""Batches in blocks: the numbers of `jax.vmap` and of a loop, remainders, derivatives, sizes and refusals."""

import itertools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import compiled

import jaxmb as mb
from jaxmb.lanes.evaluate import RULES
from jaxmb.studies.batch import Member


def halved(x):
    """The halves of `start` down to one `small`, by a loop whose length depends on the member."""
    out = jax.lax.while_loop(lambda s: s[0] > x["small"], lambda s: (s[0] / 2, s[1] + 1), (x["start"], 0))
    return {"last": (out[0], jnp.stack([out[0], x["small"]])), "steps": out[1]}


def members(count):
    return {"start": np.geomspace(1.0, 1e6, count), "small": np.linspace(0.3, 0.9, count)}


def by_hand(x):
    """The same, member by member: halves are exact."""
    steps = np.maximum(0, np.ceil(np.log2(x["start"] / x["small"]))).astype(int)
    last = x["start"] / 2.0**steps
    assert np.all(last <= x["small"]) and np.all((steps == 0) | (2 * last > x["small"]))
    return {"last": (last, np.stack([last, x["small"]], axis=1)), "steps": steps}


def check_members(found, x):
    expected = by_hand(x)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    assert [own.dtype for own in jax.tree.leaves(found)] == [own.dtype for own in jax.tree.leaves(expected)]


@pytest.mark.parametrize(("count", "size"), [(7, None), (7, 1), (7, 3), (8, 4), (7, 100), (1, 3)])
def test_blocks_have_the_numbers_of_each_member(count, size):
    x = members(count)
    check_members(mb.batch(halved, size)(x), x)


def test_several_arguments_names_and_what_is_shared():
    factor = np.array([2.0, 3.0])
    scaled = lambda x, how, y: {how: x["a"] * factor + y}
    found = mb.batch(scaled, 2)({"a": np.arange(5.0)}, "sum", np.ones(5))
    np.testing.assert_array_equal(found["sum"], np.arange(5.0)[:, None] * factor + 1)
    assert mb.batch(scaled)({"a": np.arange(5.0)}, "other", np.ones(5)).keys() == {"other"}


def test_a_remainder_compiles_nothing_more():
    traced = []

    def function(x):
        traced.append(1)
        return jnp.sum(x**2)

    own, x = mb.batch(function, 4), np.arange(20.0).reshape(10, 2)
    with compiled() as names:
        np.testing.assert_array_equal(own(x), np.sum(x**2, axis=1))
        own(x + 1)
    assert len(names) == 1 and len(traced) == 1


def derivatives(batch):
    """Of all orders and modes, within and around batches, of what the function is given and refers to."""

    def total(shared, x):
        return jnp.sum(batch(lambda x: jnp.sum(jnp.sin(shared * x) ** 2) * x)(x) ** 2)

    def every(shared, x):
        of_all = [derivative(total, (0, 1))(shared, x) for derivative in (jax.grad, jax.jacfwd, jax.hessian)]
        outer = jax.vmap(total, (None, 0))(shared, jnp.stack([x, 2 * x]))
        return of_all, outer, batch(jax.grad(lambda x: jnp.sum(jnp.sin(shared * x))))(x)

    return jax.jit(every)(np.array([0.3, 0.7]), np.linspace(0.5, 2.0, 7))


@pytest.mark.slow
def test_derivatives_are_those_of_a_batch():
    expected = derivatives(jax.vmap)
    for size in (3, None):
        found = derivatives(lambda function, size=size: mb.batch(function, size))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-13), found, expected)


def test_a_last_member_that_fails_leaves_the_others():
    x = np.array([4.0, 9.0, 16.0, 25.0, -1.0])
    own = mb.batch(lambda x: jnp.where(x > 0, jnp.sqrt(x), jnp.nan), 2)
    np.testing.assert_array_equal(own(x), [2.0, 3.0, 4.0, 5.0, np.nan])
    slope = jax.jit(jax.grad(lambda x: jnp.sum(own(x)[:4])))(x)
    np.testing.assert_allclose(slope[:4], 0.5 / np.sqrt(x[:4]))


@pytest.mark.slow
def test_tables_of_which_a_step_writes_a_row_do_not_make_blocks_small():
    """So those of a gradient, which keeps a row of every step, are not of single members."""
    machine = mb.mechanisms.pendulum(length=1.25)

    def end(mass):
        system = mb.with_parameters(machine.system, {"bob.mass": mass})
        return mb.simulate(system, machine.state, t1=0.1, rtol=1e-4).ys.q[-1, 0]

    sizes = [Member(function, np.asarray(2.0)).block_size(1000) for function in (end, jax.grad(end))]
    assert sizes == [64, 32]


def test_the_size_of_a_block_is_that_of_what_loops_carry():
    """Twice as much to carry halves a block, a power of two; without a loop a block is the whole batch."""

    def size(numbers, members=1000):
        def function(x):
            return jax.lax.fori_loop(0, 10, lambda k, y: jnp.sin(y), x * jnp.ones(numbers))

        return Member(function, np.asarray(1.0)).block_size(members)

    sizes = [size(2**k) for k in range(4, 20)]
    assert sizes[0] == 64 and sizes[-1] == 1
    assert all(a in (b, 2 * b) for a, b in itertools.pairwise(sizes))
    assert Member(lambda x: jnp.sin(x) * jnp.ones(10), np.asarray(1.0)).block_size(1000) == 1000


def test_loops_that_become_kernels_are_computed_one_after_the_other(monkeypatch):
    """Those of large arrays stay in blocks."""
    function = lambda size: lambda x: jax.lax.fori_loop(0, 10, lambda k, y: y * jnp.sin(y), x * jnp.ones(size))
    sizes = lambda: [Member(function(size), np.asarray(1.0)).block_size(1000) for size in (100, 20_000)]
    before = sizes()
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=9000")
    assert sizes() == [1, before[1]] and before[0] > before[1] > 1


REFUSED = [
    *(
        (lambda size=size: mb.batch(halved, size), f"size must be an integer of at least 1, or None, got {size!r}.")
        for size in (0, 1.5, True, "4")
    ),
    *(
        (lambda arguments=arguments: mb.batch(lambda *x: x)(*arguments), message)
        for arguments, message in (
            ((), "A batch needs an array with members along axis 0, got none."),
            (("name",), "A batch needs an array with members along axis 0, got none."),
            ((2.0,), "Argument [0] is a single number, 2.0: members are along axis 0"),
            ((np.ones(3), {"a": np.ones(4)}), "Argument [0] has 3 members, but Argument [1]['a'] has 4."),
            ((np.ones(4), {"a": np.ones(3)}), "Argument [0] has 4 members, but Argument [1]['a'] has 3."),
            ((np.ones((0, 2)),), "A batch needs at least one member, and Argument [0] has none."),
            (([{"a": 1.0}, {"a": 2.0, "b": 1.0}],), "of one structure is stacked by jax.tree.map"),
        )
    ),
    (lambda: mb.batch(3), "batch needs a function, got 3"),
    (lambda: mb.batch(lambda x: x if x > 0 else -x)(np.ones(4)), "cannot be batched: it needs an argument as a number"),
]


def test_what_batch_refuses():
    for call, message in REFUSED:
        with pytest.raises(ValueError, match=re.escape(message)):
            call()


def test_an_operation_without_a_rule_is_computed_one_member_after_the_other():
    known = jax.extend.core.Primitive("no_rule_for_batches")
    known.def_abstract_eval(lambda x: x)
    jax.interpreters.mlir.register_lowering(known, jax.interpreters.mlir.lower_fun(jnp.sin, multiple_results=False))
    with pytest.raises(ValueError, match=r"cannot be batched .*no_rule_for_batches.* size=1 computes one member after"):
        mb.batch(known.bind, 2)(np.arange(4.0))
    np.testing.assert_allclose(mb.batch(known.bind, 1)(np.arange(4.0)), np.sin(np.arange(4.0)), rtol=1e-15)


@pytest.mark.slow
def test_motions_in_blocks():
    """Steps and states of a batch of simulations, one of which fails, and of single runs."""
    mechanism = mb.mechanisms.get("pendulum")

    def swing(mass):
        system = mb.with_parameters(mechanism.system, {"bob.mass": mass})
        return mb.simulate(system, mechanism.state, t1=0.5, rtol=1e-8, throw=False)

    outcome = lambda mass: (lambda sol: (sol.ys, sol.result._value, sol.stats["num_steps"]))(swing(mass))
    masses = np.array([1.0, 0.5, 2.0, -1.0, 3.0])
    found, alone = mb.batch(outcome, 2)(masses), jax.jit(outcome)
    assert np.all(np.isfinite(found[0].q[np.array([0, 1, 2, 4])])) and np.all(np.isnan(found[0].q[3]))
    for k, mass in enumerate(masses):
        one = alone(mass)
        np.testing.assert_array_equal([found[1][k], found[2][k]], one[1:])
        np.testing.assert_allclose(found[0].q[k], one[0].q, rtol=1e-9)


@pytest.fixture
def side_by_side(monkeypatch):
    """As after `setup(compile="for batches")`, with any options of the compiler."""
    monkeypatch.setattr("jaxmb.lanes.members.computes_side_by_side", lambda: True)


@pytest.mark.parametrize("count", [1, 19])
def test_members_side_by_side_have_the_numbers_of_each_member(count, side_by_side):
    x = members(count)
    check_members(mb.batch(halved)(x), x)


@pytest.mark.slow
def test_members_side_by_side_have_the_derivatives_of_a_batch(side_by_side):
    def last(x, factor):
        return jax.lax.fori_loop(0, 3, lambda k, y: jnp.sin(factor * y) + k, x) ** 2

    total = lambda factor, x, at_once: jnp.sum(at_once(lambda x: last(x, factor))(x) ** 2)
    x = np.linspace(0.1, 1.0, 10)
    for derivative in (jax.grad, jax.jacfwd, jax.hessian):
        found, expected = (derivative(total)(0.7, x, at_once) for at_once in (mb.batch, jax.vmap))
        np.testing.assert_allclose(found, expected, rtol=1e-13)


def test_an_operation_without_a_rule_is_refused_side_by_side_as_well(side_by_side, monkeypatch):
    def lacks(lanes, equation, values):
        raise NotImplementedError("no rule")

    monkeypatch.setitem(RULES, "sin", lacks)
    with pytest.raises(ValueError, match=r"cannot be batched \(no rule\); size=1 computes"):
        mb.batch(lambda x: jax.lax.fori_loop(0, 2, lambda k, y: jnp.sin(y), x))(np.ones(10))


def test_members_of_large_loops_do_not_stand_side_by_side(side_by_side):
    def iterated(x, size):
        return jax.lax.fori_loop(0, 2, lambda k, y: y + k, jnp.full(size, x))

    small, large = (Member(lambda x, size=size: iterated(x, size), np.zeros(())) for size in (1000, 60_000))
    assert (small.block_size(100), large.block_size(100)) == (8, 2)
