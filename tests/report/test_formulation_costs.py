"""Costs of formulations on a mechanism."""

import pytest

from jaxmb import mechanisms
from jaxmb.formulations import Multipliers, Partitioned
from jaxmb.report import every_formulation, formulation_costs


def test_costs_of_formulations():
    report = formulation_costs(mechanisms.get("pendulum"), {"one": Partitioned(), "other": Multipliers()}, repeats=1)
    assert [cost.formulation for cost in report.costs] == ["one", "other"]
    for cost in report.costs:
        assert cost.evaluation > 0 and cost.forward > 0 and cost.reverse > 0
        assert 0 < cost.lines[0] < cost.lines[1] and cost.deviation < 1e-13
    text = str(report).splitlines()
    assert len(text) == 4 and text[2].startswith("one")


def test_formulations_that_a_mechanism_does_not_allow():
    with pytest.raises(ValueError, match="no constraints"):
        formulation_costs(mechanisms.get("free_body"))
    singular = mechanisms.get("spherical_four_bar")
    with pytest.raises(ValueError, match="singular"):
        formulation_costs(singular, {"one": Multipliers()})
    assert len(every_formulation()) == 7
