"""Which contacts are closed, and which dry friction sticks or slips in two directions, of random problems."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.contacts.dry_laws import Dry, laws_of
from jaxmb.contacts.friction import frictional
from jaxmb.linalg.pairs import of_pairs


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
