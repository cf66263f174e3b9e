"""Work–precision reports: errors, references, and what is written."""

import dataclasses
import importlib
import json
import sys
import types

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from jaxmb import mechanisms
from jaxmb.report import Table, work_precision
from jaxmb.report.reference import reference
from jaxmb.solvers import Adams

work_precision_module = importlib.import_module("jaxmb.report.work_precision")


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


@pytest.mark.slow
def test_work_precision_has_errors_that_fall_with_the_tolerance(precision, tmp_path, monkeypatch):
    """In a table for a terminal and for a notebook, plain data, and a picture with these."""
    runs = {(run["solver"], run["rtol"]): run for run in precision.to_dict()["rows"]}
    for solver in ("Adams", "Dopri8"):
        loose, tight = runs[solver, 1e-5], runs[solver, 1e-9]
        assert tight["error"] < 1e-7 and tight["error"] < 1e-2 * loose["error"]
        assert tight["evaluations"] > loose["evaluations"] > 0
        for run in (loose, tight):
            assert 0 < run["run [ms]"] <= run["median [ms]"] < 1e3 * run["compile [s]"]
            assert 0 <= run["rejected"] < run["steps"]
    assert len(str(precision).splitlines()) == 1 + 1 + 4 + 1
    assert "elliptic functions" in str(precision)
    assert precision._repr_html_().count("<tr>") == 5 and "elliptic functions" in precision._repr_html_()
    plain = json.loads(json.dumps(precision.to_dict()))
    assert plain["rows"][0]["solver"] == precision["solver"][0] == "Adams"
    errors, _ = precision.plot().axes
    for line, solver in zip(errors.get_lines(), dict.fromkeys(precision["solver"]), strict=False):
        shown = [row["error"] for row in plain["rows"] if row["solver"] == solver]
        np.testing.assert_array_equal(line.get_ydata(), shown)
    precision.figure(tmp_path / "figure.png")
    with Image.open(tmp_path / "figure.png") as image:
        assert image.format == "PNG" and json.loads(image.text["Description"]) == plain
    precision.figure(tmp_path / "figure.svg")
    assert "&quot;evaluations&quot;" in (text := (tmp_path / "figure.svg").read_text()) or '"evaluations"' in text
    precision.figure(tmp_path / "figure.pdf")
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r"jaxmb\[plot\]"):
        precision.figure(tmp_path / "figure.png")


def test_work_precision_counts_the_error_at_the_end(pendulum):
    """The largest one relative to the scale of its label; no number below the accuracy of the reference."""
    known = mechanisms.References([0.5, 1.0], ("x", "y"), [[1.0, 4.0], [2.0, 0.0]], "here", 1e-9)
    for end, expected in ((2e-6, 1e-6), (1e-12, "small")):
        values = {"x": np.array([1.3, 2.0 + end]), "y": np.array([4.0, 1e-12])}
        own = dataclasses.replace(pendulum, observe=lambda _, values=values: values)
        found = work_precision_module._error(own, known, types.SimpleNamespace(ts=known.times))
        assert found == (pytest.approx(expected, rel=1e-6) if expected != "small" else "small")


def test_table_in_words():
    rows = [("one", 0.5, 3), ("other", "small", None)]
    table = Table("a <title>", {"name": "", "x": ".1e", "n": "d"}, rows, ["a note"])
    lines = ["name         x  n", "one    5.0e-01  3", "other    small  –"]
    assert str(table).splitlines() == ["a <title>", *lines, "a note"]
    assert "a &lt;title&gt;" in table._repr_html_() and table["n"] == [3, None]
    for drawn in (table.plot, lambda: table.figure("figure.png")):
        with pytest.raises(ValueError, match="no figure of this table: a <title>"):
            drawn()


@pytest.mark.slow
def test_reference_that_is_computed(pendulum):
    """Without published values: two methods two orders tighter, which agree with each other and with those."""
    known = reference(dataclasses.replace(pendulum, references=None), 1e-9)
    assert "Dopri8" in known.source
    assert 0 < known.tolerance < 1e-9
    published = dict(zip(pendulum.references.labels, pendulum.references.values[-1], strict=True))
    for label, value in zip(known.labels, known.values[-1], strict=True):
        np.testing.assert_allclose(value, published[label], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_work_precision_keeps_the_row_of_a_failed_run(pendulum):
    lost = dataclasses.replace(pendulum, state=jax.tree.map(lambda x: x * jnp.nan, pendulum.state))
    failed = work_precision(lost, solvers={"Tsit5": diffrax.Tsit5()}, tolerances=(1e-5,), repeats=1)
    assert failed["error"] == ["failed"] and failed.notes[-1].startswith("Tsit5 at 1e-05: ")


def test_work_precision_without_arguments_to_work_with_is_refused(pendulum):
    for arguments in ({"solvers": {}}, {"tolerances": ()}, {"repeats": 0}):
        with pytest.raises(ValueError, match="at least one"):
            work_precision(pendulum, **arguments)
