"""Every notebook runs from top to bottom, prints what it shows, and is fit to be committed; so are the README's figure
and example.
"""

import json
import os
import re
from pathlib import Path

import nbformat
import numpy as np
import pytest
from compiling import QUICKLY
from execute_notebooks import FOLDER, GALLERY, difference, digest, executed, printed, readme_examples
from oracles.half_car import heave_and_roll
from PIL import Image

import jaxmb as mb
from jaxmb.cli.commands import parser

ROOT = FOLDER.parent
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
LARGEST = 2 * 2**20
# What a notebook must not hold: paths of somebody's machine, downloads, and shell commands.
FORBIDDEN = re.compile(
    r"/(home|root|tmp|Users|work|workspace)/|[A-Z]:\\\\|https?://|urllib|requests|^[!%](?!matplotlib inline)", re.M
)
# A formula whose backslashes are doubled is shown as it is written.
DOUBLED = re.compile(r"\$[^$]*\\\\[a-zA-Z,;][^$]*\$")
# The machine is drawn by the package; a notebook is named by a link.
MACHINE = re.compile(r"viz\.(plot_scene|plot_mechanism|show)\(")
UNLINKED = re.compile(r"`\d\d_\w+`")
COMMAND = re.compile(r"`jaxmb\s+(\w+)")
COMMANDS = set(parser()._subparsers._group_actions[0].choices)  # pyright: ignore


def test_there_are_notebooks():
    assert NOTEBOOKS


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_lint(path):
    assert path.stat().st_size < LARGEST
    notebook = nbformat.read(path, as_version=4)
    assert notebook.cells[0].cell_type == "markdown" and notebook.cells[0].source.startswith("# ")
    first = next(cell.source for cell in notebook.cells if cell.cell_type == "code").splitlines()
    assert first[-1] == "mb.setup()"
    assert notebook.metadata.kernelspec.name == "python3"
    assert any(MACHINE.search(cell.source) for cell in notebook.cells if cell.cell_type == "code")
    for cell in notebook.cells:
        texts = [cell.source]
        for output in cell.get("outputs", []):
            assert output.output_type != "error"
            texts += [output.get("text", ""), output.get("data", {}).get("text/plain", "")]
        for text in texts:
            assert not FORBIDDEN.search(text), f"{path.name}: {FORBIDDEN.search(text)!r}"
        if cell.cell_type == "markdown":
            assert not DOUBLED.search(cell.source), f"{path.name}: {DOUBLED.search(cell.source)!r}"
            assert not UNLINKED.search(cell.source), f"{path.name}: {UNLINKED.search(cell.source)!r}"
            assert set(COMMAND.findall(cell.source)) <= COMMANDS, path.name


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_outputs_are_those_of_the_cells(path):
    """After a change of a cell or of the version: `python tests/support/execute_notebooks.py NAME`."""
    notebook = nbformat.read(path, as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert notebook.metadata.jaxmb.version == mb.__version__
    assert notebook.metadata.jaxmb.executed == {cell.id: digest(cell.source) for cell in cells}
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert all("execution" not in cell.metadata for cell in cells)


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
# Of the kernel's own files, which this package does not touch.
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_runs_and_prints_what_it_shows(path, monkeypatch):
    # The numbers of steps of some motions depend on how programs are compiled: as users do, as what is stored was.
    if os.environ.get("XLA_FLAGS") == QUICKLY:
        monkeypatch.delenv("XLA_FLAGS")
    stored, new = nbformat.read(path, as_version=4), executed(path)
    for before, after in zip(stored.cells, new.cells, strict=True):
        if after.cell_type == "code" and "varies" not in after.metadata.get("tags", []):
            found = difference(printed(before), printed(after))
            assert found is None, f"{path.name}, cell {after.id}: {found}"


def test_what_counts_as_another_output():
    shown = "fit: 0.49986 ± 2.2e-04\nenergy drifts by 3e-15, 120 steps"
    for same in (
        "fit: 0.49985 ± 2.4e-04\nenergy drifts by 8e-14, 121 steps",
        "fit:  0.4999 ± 1.9e-03\n energy drifts by 0.0, 118 steps",
    ):
        assert difference(shown, same) is None
    for other in (
        shown.replace("0.49986", "0.55"),
        shown.replace("2.2e-04", "2.2e-01"),
        shown.replace("3e-15", "3e-06"),
        shown.replace("120", "150"),
        shown.replace("steps", "evaluations"),
        shown + "\nmore",
    ):
        assert difference(shown, other) is not None


@pytest.mark.slow
def test_the_figure_of_the_readme_shows_what_is_computed():
    """After a change: `python tests/support/execute_notebooks.py work_precision`."""
    with Image.open(FOLDER / "work_precision.png") as image:
        shown = json.loads(image.text["Description"])
    assert shown["jaxmb"] == mb.__version__ and shown["title"].startswith("andrews, ")
    assert {run["solver"] for run in shown["rows"]} == {"Adams", "Tsit5", "Dopri8"}
    tolerances = [1e-4, 1e-8]
    solvers = {"Adams": mb.solvers.Adams()}
    now = mb.report.work_precision(mb.mechanisms.get("andrews"), solvers=solvers, tolerances=tolerances, repeats=1)
    for run in now.to_dict()["rows"]:
        (before,) = (old for old in shown["rows"] if (old["solver"], old["rtol"]) == (run["solver"], run["rtol"]))
        # Programs that are compiled in another way may round a step to the other side of its bound.
        assert run["evaluations"] == pytest.approx(before["evaluations"], rel=0.02)
        assert before["error"] / 3 < run["error"] < 3 * before["error"]


def promised(code):
    """The numbers that an example of the README promises."""
    return [float(number) for number in code.rsplit("#", 1)[1].split()]


@pytest.mark.slow
def test_examples_of_the_readme_print_what_it_promises(capsys):
    """The second goes on from the first."""
    scope = {}
    for code in readme_examples():
        exec(code, scope)
        found = [float(number) for number in capsys.readouterr().out.split()]
        np.testing.assert_allclose(found, promised(code), rtol=0, atol=1e-6)


def test_the_moving_picture_of_the_readme_is_of_its_last_example():
    examples = readme_examples()
    assert len(examples) == 3
    for code in examples:
        compile(code, "README.md", "exec")
    with Image.open(FOLDER / "four_bar.gif") as image:
        shown = json.loads(image.info["comment"])
    assert shown["jaxmb"] == mb.__version__
    np.testing.assert_allclose(shown["angle"], promised(examples[-1])[0], rtol=0, atol=1e-6)


def test_pictures_and_links_of_the_readme_are_there():
    text = (ROOT / "README.md").read_text()
    assert (FOLDER / "four_bar.gif").stat().st_size < 1e6
    assert all((FOLDER / f"{name}.png").stat().st_size < 6e4 for name in GALLERY)
    linked = re.findall(r"notebooks/[\w.]+", text)
    assert {path.name for path in NOTEBOOKS} < {Path(name).name for name in linked}
    assert all((ROOT / name).is_file() for name in linked)


@pytest.mark.slow
def test_half_car():
    """The numbers that notebook 15 compares its half-car with are those of Lagrange's equations."""
    cells = nbformat.read(FOLDER / "15_others.ipynb", as_version=4).cells
    (source,) = [cell.source for cell in cells if "BY_LAGRANGE =" in cell.source]
    scope: dict = {}
    exec(source[source.index("BY_LAGRANGE =") : source.index("\n}") + 2], scope)
    times, values = zip(*scope["BY_LAGRANGE"].items(), strict=True)
    np.testing.assert_allclose(1e3 * heave_and_roll(times), values, rtol=0.0, atol=1e-6)
