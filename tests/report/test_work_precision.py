"""Work–precision reports: errors, references, counts of evaluations, and what is written."""

import dataclasses
import json
import sys
import time

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from jaxmb import mechanisms
from jaxmb.formulations import Multipliers, Partitioned
from jaxmb.report import every_formulation, formulation_costs, interleaved, work_precision
from jaxmb.report.evaluations import evaluations
from jaxmb.report.reference import reference
from jaxmb.solvers import Adams, MultistepController


@pytest.fixture(scope="module")
def pendulum():
    """The pendulum's first second, with its published values there."""
    made = mechanisms.get("pendulum")
    known = made.references
    first = dataclasses.replace(known, times=known.times[:1], values=known.values[:1])
    return dataclasses.replace(made, t1=1.0, references=first)


@pytest.fixture(scope="module")
def precision(pendulum):
    solvers = {"Adams": Adams(), "Dopri8": diffrax.Dopri8()}
    return work_precision(pendulum, solvers=solvers, tolerances=(1e-5, 1e-9), repeats=3)


def test_errors_fall_with_the_tolerance(precision):
    runs = {(run.solver, run.rtol): run for run in precision.runs}
    for solver in ("Adams", "Dopri8"):
        loose, tight = runs[solver, 1e-5], runs[solver, 1e-9]
        assert tight.error < 1e-7 and tight.error < 1e-2 * loose.error
        assert tight.evaluations > loose.evaluations > 0
        for run in (loose, tight):
            assert len(run.times) == 3
            assert 0 < run.shortest <= run.median
            assert run.compile_time > run.median
            assert 0 <= run.rejected < run.steps


def test_forms(precision, tmp_path):
    """A table for a terminal and for a notebook, plain data, and a picture."""
    assert len(str(precision).splitlines()) == 2 + 1 + 4
    assert "elliptic functions" in str(precision)
    assert precision._repr_html_().count("<tr>") == 5
    assert json.loads(json.dumps(precision.to_dict()))["runs"][0]["solver"] == "Adams"
    precision.figure(tmp_path / "figure.png")
    with Image.open(tmp_path / "figure.png") as image:
        assert image.format == "PNG" and json.loads(image.text["Description"]) == json.loads(
            json.dumps(precision.to_dict())
        )
    precision.figure(tmp_path / "figure.svg")
    assert "&quot;disagreement&quot;" in (text := (tmp_path / "figure.svg").read_text()) or '"disagreement"' in text
    precision.figure(tmp_path / "figure.pdf")


def test_computed_reference(pendulum):
    """Without published values: two methods two orders tighter, which agree with each other and with those."""
    known = reference(dataclasses.replace(pendulum, references=None), 1e-9)
    assert "Dopri8" in known.source
    assert 0 < known.tolerance < 1e-9
    published = dict(zip(pendulum.references.labels, pendulum.references.values[-1], strict=True))
    for label, value in zip(known.labels, known.values[-1], strict=True):
        np.testing.assert_allclose(value, published[label], rtol=0, atol=1e-9)


def test_failed_run_keeps_its_row(pendulum):
    lost = dataclasses.replace(pendulum, state=jax.tree.map(lambda x: x * jnp.nan, pendulum.state))
    failed = work_precision(lost, solvers={"Tsit5": diffrax.Tsit5()}, tolerances=(1e-5,), repeats=1)
    (run,) = failed.runs
    assert np.isnan(run.error) and run.message
    assert "failed" in str(failed) and run.message in str(failed)


@pytest.mark.parametrize("solver", [Adams(), diffrax.Tsit5(), diffrax.Dopri8(), diffrax.Bosh3()])
def test_evaluations_are_those_that_happen(solver):
    count = 0

    def field(t, y, args):
        jax.debug.callback(tick)
        return -y * (1 + jnp.sin(20 * t))

    def tick():
        nonlocal count
        count += 1

    controller = (MultistepController if isinstance(solver, Adams) else diffrax.PIDController)(rtol=1e-6, atol=1e-8)
    saveat = diffrax.SaveAt(t1=True, solver_state=True)
    term = diffrax.ODETerm(field)
    solution = diffrax.diffeqsolve(
        term, solver, 0.0, 2.0, None, jnp.ones(1), stepsize_controller=controller, saveat=saveat
    )
    jax.block_until_ready(solution.ys)
    jax.effects_barrier()
    stats = dict(solution.stats)
    if isinstance(solver, Adams):
        stats["num_evaluations"] = solution.solver_state.step_counts[0] + 2 * stats["num_steps"]
    uncounted = 0 if isinstance(solver, Adams) else 2
    assert 0 <= count - evaluations(solver, stats) <= uncounted


def test_evaluations_of_implicit_methods_are_unknown():
    assert evaluations(diffrax.Kvaerno5(), {"num_steps": 3}) is None


def test_interleaved_takes_turns():
    calls = []

    def run(k):
        calls.append(k)
        time.sleep(0.002 * k)

    short, long = interleaved([lambda: run(1), lambda: run(2)], 3)
    assert calls == [1, 2] * 4
    assert len(short) == len(long) == 3 and min(long) > min(short)


def test_no_arguments_to_work_with(pendulum):
    for arguments in ({"solvers": {}}, {"tolerances": ()}, {"repeats": 0}):
        with pytest.raises(ValueError, match="at least one"):
            work_precision(pendulum, **arguments)


def test_figures_without_matplotlib(precision, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r"jaxmb\[plot\]"):
        precision.figure(tmp_path / "figure.png")


# Formulations


def test_costs_of_formulations(pendulum):
    report = formulation_costs(pendulum, {"one": Partitioned(), "other": Multipliers()}, repeats=1)
    assert [cost.formulation for cost in report.costs] == ["one", "other"]
    for cost in report.costs:
        assert cost.evaluation > 0 and cost.forward > 0 and cost.reverse > 0
        assert 0 < cost.lines[0] < cost.lines[1] and cost.deviation < 1e-13
    text = str(report).splitlines()
    assert len(text) == 4 and text[2].startswith("one")


def test_formulations_that_a_mechanism_does_not_allow(pendulum):
    with pytest.raises(ValueError, match="no constraints"):
        formulation_costs(mechanisms.get("free_body"))
    singular = mechanisms.get("spherical_four_bar")
    with pytest.raises(ValueError, match="singular"):
        formulation_costs(singular, {"one": Multipliers()})
    assert len(every_formulation()) == 7
