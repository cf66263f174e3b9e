"""Integers of NumPy wherever a number is counted: they do what Python's do."""

import re

import numpy as np
import pytest

import jaxmb as mb
from jaxmb._arguments import whole_number
from jaxmb.mechanisms.train import train
from jaxmb.simulate.arguments import check_steps
from jaxmb.solvers import Adams, Hermite
from jaxmb.studies.sweep.cases import table


def test_counts_of_studies(kind=np.uint8):
    members = np.arange(6.0)
    np.testing.assert_array_equal(mb.batch(lambda x: x**2, size=kind(4))(members), members**2)
    found = mb.sweep(lambda a: {"b": 2 * a}, table(a=np.arange(3.0)), chunk=kind(2), processes=kind(1), progress=False)
    np.testing.assert_array_equal(found["b"], [0.0, 2.0, 4.0])
    best = mb.optimise(lambda v: (v["x"] - 1) ** 2, {"x": 0.0}, max_iterations=kind(20), starts=kind(1))
    assert best.success


def test_counts_of_methods_and_mechanisms(kind=np.int64):
    solver = Adams(min_order=kind(1), max_order=kind(5))
    assert solver == Adams(min_order=1, max_order=5) and type(solver.max_order) is int
    assert Hermite(past_points=(kind(1), kind(2))) == Hermite(past_points=(1, 2))
    check_steps(kind(200))
    assert len(train(n=kind(3)).system.body_names) == 3


def test_half_an_order_is_named():
    with pytest.raises(ValueError, match=r"max_order must be an integer of at least 1, got 2\.5"):
        Adams(max_order=2.5)


def test_what_is_no_count_is_named():
    for value in (True, 2.0, "2", None, np.float64(2.0), 0, -1):
        with pytest.raises(ValueError, match=re.escape(f"number must be an integer of at least 1, got {value!r}")):
            whole_number("number", value)
