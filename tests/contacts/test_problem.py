"""Which laws of dry friction hold at the limit of stick."""

import functools
import itertools
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmb.contacts.forces import Limits
from jaxmb.contacts.problem import Laws
from jaxmb.parts.modes import FREE, STICK
from jaxmb.system.contact_set import ContactSet

NORMAL, COEFFICIENT = 10.0, 0.3


@functools.cache
def found():
    """Which laws hold of friction in a joint, in a mode and under a load, relative to its limit."""

    @jax.jit
    def answers(mode, load):
        one, none = jnp.ones(1), jnp.zeros(0)
        joint = ContactSet(names=("rub",), rows=(0,), places=(0,), contact_of=(-1,), releases=(False,))
        constant = types.SimpleNamespace(slip=types.SimpleNamespace(varies=False))
        at: Any = types.SimpleNamespace(system=types.SimpleNamespace(contacts=joint), contact_laws=constant)
        limits = Limits(COEFFICIENT * one, None)
        laws = Laws(at, jnp.eye(1), limits, limits)
        reactions = jnp.array([[[0.0, NORMAL]], [[0.0, 0.0]]])
        opening = load * COEFFICIENT * NORMAL * one
        rest = 0 * one
        problem = laws.of_forces(opening, reactions, none > 0, rest, rest, joint.as_modes(mode * one), rest)
        return laws.answers(problem)

    return answers


# In which mode, under which load, and whether it sticks.
CASES = [(FREE, 1.0, True), (FREE, 1 + 1e-7, False), (STICK, 1.0, False), (STICK, 1 - 1e-6, True)]


def test_friction_at_its_limit():
    """At its limit friction sticks: the guard of its force tells whether it slips. Friction that has stuck until then
    slips, in the direction of the load.
    """
    for (mode, load, sticks), sign in itertools.product(CASES, (1.0, -1.0)):
        answers = found()(float(mode), sign * load)
        assert bool(answers.solvable) and bool(answers.sticks[0]) == sticks
        np.testing.assert_array_equal(answers.slips, [0.0 if sticks else sign])
