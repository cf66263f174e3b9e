"""Costs of formulations on a mechanism."""

import pytest
from formulation_costs import every_formulation, formulation_costs

from jaxmb import mechanisms
from jaxmb.formulations import Multipliers, Partitioned

pytestmark = pytest.mark.slow


def test_costs_of_formulations():
    table = formulation_costs(mechanisms.get("pendulum"), {"one": Partitioned(), "other": Multipliers()}, repeats=1)
    assert table["formulation"] == ["one", "other"]
    for _, *times, lines, forward, reverse, deviation in table.rows:
        assert min(times) > 0 and 0 < lines < min(forward, reverse) and deviation < 1e-13


def test_formulations_that_a_mechanism_does_not_allow():
    with pytest.raises(ValueError, match="no constraints"):
        formulation_costs(mechanisms.get("free_body"))
    singular = mechanisms.get("spherical_four_bar")
    with pytest.raises(ValueError, match="singular"):
        formulation_costs(singular, {"one": Multipliers()})
    assert len(every_formulation()) == 7
