"""Every notebook runs from top to bottom and is fit to be committed; the README's example prints what it says."""

import re
from pathlib import Path

import nbformat
import numpy as np
import pytest
from compiling import flags_to_run_long
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
LARGEST = 2 * 2**20
# Those that run longer than they compile.
RUN_LONG = {"04_vehicles"}
# What a notebook must not hold: paths of somebody's machine, downloads, and shell commands.
FORBIDDEN = re.compile(
    r"/(home|root|tmp|Users|work|workspace)/|[A-Z]:\\\\|https?://|urllib|requests|^[!%](?!matplotlib inline)", re.M
)


def test_there_are_notebooks():
    assert NOTEBOOKS


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_lint(path):
    assert path.stat().st_size < LARGEST
    notebook = nbformat.read(path, as_version=4)
    assert notebook.cells[0].cell_type == "markdown" and notebook.cells[0].source.startswith("# ")
    assert any("jax_enable_x64" in cell.source for cell in notebook.cells)
    assert notebook.metadata.kernelspec.name == "python3"
    for cell in notebook.cells:
        texts = [cell.source]
        for output in cell.get("outputs", []):
            assert output.output_type != "error"
            texts += [output.get("text", ""), output.get("data", {}).get("text/plain", "")]
        for text in texts:
            assert not FORBIDDEN.search(text), f"{path.name}: {FORBIDDEN.search(text)!r}"


@pytest.mark.long
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
# Of the kernel's own files, which this package does not touch.
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_runs(path, monkeypatch):
    if path.stem in RUN_LONG:
        for name, value in flags_to_run_long().items():
            monkeypatch.setenv(name, value)
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(FOLDER)}})
    client.execute()


def test_readme_example(capsys):
    code = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert code is not None
    exec(code.group(1), {})
    promised = [float(number) for number in code.group(1).rsplit("#", 1)[1].split()]
    printed = [float(number) for number in capsys.readouterr().out.split()]
    np.testing.assert_allclose(printed, promised, rtol=0, atol=1e-6)
