"""Costs of features that a scene does not use, and of methods: what is measured is the same motion."""

import numpy as np
import pytest
import reported_machines
from left_out import in_time, left_out, nonholonomic, with_damper
from method_costs import method_costs
from reported_machines import udot

import jaxmb as mb

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def pendulum():
    return reported_machines.pendulum()


def test_variants_do_not_change_the_motion(pendulum):
    system, state = pendulum
    driven, rolling = in_time(system, state), nonholonomic(system, state)
    assert system.drift_free and not driven.drift_free
    assert rolling.velocity_rows == 4 and rolling.position_rows == 2 and rolling.velocity_rank == 2
    for variant in (driven, rolling, with_damper(system, state)):
        np.testing.assert_allclose(udot(variant, state), udot(system, state), rtol=0, atol=1e-12)


def test_what_a_pendulum_leaves_out(pendulum):
    system, state = pendulum
    table = left_out(system, state, t1=1.0, repeats=1)
    names = table["put in"]
    assert names[0] == "nothing" and {"a joint twice", "rows between velocities", "an event"} < set(names)
    assert min(table["trace [s]"]) > 0 and min(table["compile [s]"]) > 0 and min(table["run [ms]"]) > 0
    lines = dict(zip(names, table["lines of HLO"], strict=True))
    # A joint with a term in time is known by its residual alone, which is a shorter program for one pin.
    own, _ = lines.pop("nothing"), lines.pop("a term in time")
    assert min(lines.values()) > own
    assert np.ptp(table["evaluations"]) <= 40
    assert "not needed: derivatives of constraints" in str(table) and "charts, a dense Jacobian: " in str(table)


def test_costs_of_methods():
    """What partitioning costs, and the same with all coordinates."""
    table = method_costs(mb.mechanisms.get("pendulum").until(1.0), repeats=1)
    assert set(table["bound"]) == {1e-3, 1e-5, 1e-7} and "multipliers, Baumgarte" in str(table)
    for _, bound, error, _, evaluations, _, flops, *_ in table.rows:
        assert 0 < error <= bound and evaluations > 0 and flops > 0
