"""Motions that NumPy computes are those of the compiler, to the growth of rounding errors."""

import batched_machines
import jax
import numpy as np
import pytest
from by_numpy import nothing_compiled

import jaxmb as mb

MOST_PROGRAMS = 30
# Two motions at this tolerance differ by rounding alone, which errors of the start let grow.
RTOL, GROWN = 1e-12, 1e-9
ALL = [*mb.mechanisms.names(), *(f"batched {name}" for name in batched_machines.MACHINES)]
SHORT = ["pendulum"]


def motion_of(name):
    if name.startswith("batched "):
        found = batched_machines.MACHINES[name.removeprefix("batched ")]()(1.0)
        return found[1] if isinstance(found, tuple) else found
    machine = mb.mechanisms.get(name)
    return mb.simulate(machine.system, machine.state, t1=0.1, rtol=RTOL, saveat=np.linspace(0.0, 0.1, 3))


def scaled(x, y):
    """The largest difference, relative to the largest number."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    np.testing.assert_array_equal(np.isfinite(x), np.isfinite(y))
    kept = np.isfinite(y)
    return np.max(np.abs(x - y)[kept], initial=0.0) / np.max(np.abs(y)[kept], initial=1.0)


@pytest.mark.slow(but=tuple(SHORT))
@pytest.mark.parametrize("name", ALL)
def test_motions_are_those_of_the_compiler(name):
    with nothing_compiled():
        found = motion_of(name)
    expected = motion_of(name)
    assert found.stats["interpreted"] and not expected.stats["interpreted"]
    assert found.result == expected.result
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    kinds = lambda motion: [(x.shape, x.dtype) for x in jax.tree.leaves(motion)]
    assert kinds(found) == kinds(expected)
    assert scaled(found.ts, expected.ts) < GROWN
    of = lambda motion: jax.tree.leaves((motion.ys.q, motion.ys.u, motion.ys.z))
    worst = [scaled(x, y) for x, y in zip(of(found), of(expected), strict=True)]
    # The scenes have tolerances of their own.
    tolerance = 1e-7 if name.startswith("batched ") else GROWN
    assert max(worst) < tolerance, worst
    if found.ys.angles is not None:
        # Counted angles are interpolated between the ends of steps.
        assert scaled(found.ys.angles, expected.ys.angles) < 1e-6
