"""Which contacts are closed, and which dry friction sticks or slips in two directions, of random problems."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.contacts.dry_laws import Answers, Dry, laws_of
from jaxmb.contacts.events import ContactEvents
from jaxmb.contacts.friction import SlipSearch, frictional, with_implied
from jaxmb.linalg.pairs import of_pairs


@pytest.mark.slow
@pytest.mark.parametrize("contacts", [1, 2])
def test_friction_in_two_directions(contacts):
    """Of random problems: contacts push or open; the force of slip is on the cone, against the slip, and that of stick
    is within it.
    """
    n, m = contacts, 2 * contacts
    pairs, own = tuple(range(0, m, 2)), n + of_pairs(tuple(range(0, m, 2)))

    @jax.jit
    def solve(W, b, coefficient):
        dry = Dry(tuple(np.repeat(np.arange(n), 2).tolist()), pairs, coefficient, jnp.zeros(m), jnp.zeros(m))
        answers = frictional(W, b, dry, jnp.ones(n + m, bool))
        return answers, jnp.linalg.solve(*laws_of(W, b, dry, answers))

    rng, seen = np.random.default_rng(3), set()
    for _ in range(100):
        root = rng.normal(size=(n + m, n + m + 1))
        W, coefficient = root @ root.T + 0.1 * np.eye(n + m), rng.uniform(0.05, 0.3, size=n)
        b = np.concatenate([rng.normal(size=n) - 1.0, 2.0 * rng.normal(size=m)])
        answers, x = solve(W, b, jnp.asarray(np.repeat(coefficient, 2)))
        assert answers.solvable
        rates, x = W @ x + b, np.asarray(x)
        for k in range(n):
            push, force, slip = x[k], x[own[k]], rates[own[k]]
            if not answers.closed[k]:
                assert rates[k] > -1e-10 and np.max(np.abs(x[[k, *own[k]]])) < 1e-12
                seen.add("open")
            elif answers.sticks[2 * k]:
                assert push > 0 and np.linalg.norm(force) <= coefficient[k] * push * (1 + 1e-7)
                np.testing.assert_allclose([rates[k], *slip], 0.0, atol=1e-10)
                seen.add("stick")
            else:
                assert push > 0
                against = -coefficient[k] * push * slip / np.linalg.norm(slip)
                np.testing.assert_allclose(force, against, atol=1e-6 * push)
                seen.add("slip")
    assert seen == {"open", "stick", "slip"}


def searched(W, b):
    """The search of a contact with friction in two directions, which may have a force."""
    dry = Dry((0, 0), (0,), jnp.array([0.3, 0.3]), jnp.zeros(2), jnp.zeros(2))
    return SlipSearch.of(jnp.asarray(W), jnp.asarray(b), dry, jnp.ones(3, bool))


@pytest.mark.slow
def test_slip_goes_where_it_goes_without_forces():
    """At first; and with forces where the nearest ones in the cone do not end it."""
    search = searched(np.eye(3), np.array([-1.0, 3.0, -4.0]))
    np.testing.assert_allclose(search.start(), [[0.6, -0.8]], rtol=1e-15)
    x = jnp.array([1.0, -0.3 * 0.6, 0.3 * 0.8])
    np.testing.assert_allclose(search.direction(jnp.array([[1.0, 0.0]]), x), [[0.6, -0.8]], rtol=1e-15)
    assert not search.misses(search.answers(), x)


@pytest.mark.slow
def test_equations_of_slip_hold_at_a_solution():
    """Also where the matrix turns the slip, so that its direction is not that of the start."""
    rng = np.random.default_rng(1)
    root = rng.normal(size=(3, 4))
    search = searched(root @ root.T + 0.1 * np.eye(3), np.array([-2.0, 5.0, 3.0]))
    answers = search.answers()
    assert answers.solvable and answers.closed and not answers.sticks.any()
    x = jnp.linalg.solve(*laws_of(search.W, search.b, search.dry, answers))
    matrix, right = search.corrected(answers, answers.slips[None], x)
    np.testing.assert_allclose(matrix @ x, right, atol=1e-6)
    e, _ = search.with_slips(answers, answers.slips[None])
    np.testing.assert_array_equal(e.slips, answers.slips)


def test_equations_of_slip_in_any_direction():
    """Of a contact that is pushed by one and has friction of 0.3 against its slip; they have no other solution."""

    @jax.jit
    def equations(along, x):
        answers = Answers(x[:1] > 0, jnp.zeros(2, bool), along, jnp.array(True), jnp.zeros(2, bool))
        search = searched(jnp.diag(jnp.array([1.0, 2.0, 2.0])), jnp.append(-1.0, 5.0 * along))
        return search.corrected(answers, along[None], x)

    for angle in (0.25 * np.pi, -0.9):
        along = np.array([np.cos(angle), np.sin(angle)])
        x = np.append(1.0, -0.3 * along)
        matrix, right = equations(along, x)
        np.testing.assert_allclose(matrix @ x, right, atol=1e-14)
        assert np.linalg.cond(matrix) < 100


def test_stick_that_others_imply():
    """Of three feet that stick in one direction, as their rows depend on each other."""
    rows = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    yes, none = jnp.ones(3, bool), jnp.zeros(3)
    answers = Answers(jnp.zeros(0, bool), yes, none, jnp.array(True), ~yes)
    found = with_implied(jnp.asarray(rows @ rows.T), answers)
    assert np.sum(found.sticks) == 2 and np.sum(found.implied) == 1 and not np.any(found.sticks & found.implied)


def test_friction_that_others_imply_sticks():
    """It is not slip, and no event happens where two frictions exchange the force."""
    modes = np.array([[[1.0, 1.0], [2.0, 3.0]], [[2.0, 3.0], [3.0, 2.0]], [[3.0, 2.0], [1.0, 1.0]]])
    none = np.zeros((3, 2))
    events = ContactEvents(("one", "other"), 0, np.arange(3.0), none, np.zeros(3), modes[:, 0], modes[:, 1], none)
    assert [(event.time, event.kind) for event in events] == [(0.0, "stick")] * 2 + [(2.0, "slip")] * 2
