"""Integers of NumPy wherever a number is counted: they do what Python's do."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb._arguments import whole_number
from jaxmb.mechanisms.train import train
from jaxmb.solvers import Adams, Hermite
from jaxmb.studies.sweep.cases import table


@pytest.mark.parametrize("kind", [np.int64, np.int32, np.uint8])
def test_counts_of_studies(kind):
    members = jnp.arange(6.0)
    np.testing.assert_array_equal(mb.batch(lambda x: x**2, size=kind(4))(members), members**2)
    found = mb.sweep(lambda a: {"b": 2 * a}, table(a=np.arange(3.0)), chunk=kind(2), processes=kind(1), progress=False)
    np.testing.assert_array_equal(found["b"], [0.0, 2.0, 4.0])
    best = mb.optimise(lambda v: (v["x"] - 1) ** 2, {"x": 0.0}, max_iterations=kind(20), starts=kind(1))
    assert best.success


@pytest.mark.parametrize("kind", [np.int64, np.uint8])
def test_counts_of_motions(kind):
    m = mb.mechanisms.get("pendulum")
    solver = Adams(min_order=kind(1), max_order=kind(5))
    motion = mb.simulate(m.system, m.state, t1=0.1, solver=solver, max_steps=kind(200), max_events=kind(10))
    same = mb.simulate(m.system, m.state, t1=0.1, solver=Adams(min_order=1, max_order=5), max_steps=200, max_events=10)
    np.testing.assert_array_equal(motion.ys.q, same.ys.q)
    assert Hermite(past_points=(kind(1), kind(2))).past_points == (1, 2)
    assert len(train(n=kind(3)).system.scene.bodies) == 3


@pytest.mark.parametrize("value", [True, 2.0, "2", None, np.float64(2.0), 0, -1])
def test_what_is_no_count_is_named(value):
    with pytest.raises(
        ValueError,
        match=f"number must be an integer of at least 1, got {value!r}".replace("(", r"\(").replace(")", r"\)"),
    ):
        whole_number("number", value)
