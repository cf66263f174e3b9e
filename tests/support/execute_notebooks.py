"""Execute notebooks, and record in them what was executed: `python tests/support/execute_notebooks.py [name …]`.

Without names all notebooks are executed, and the README's pictures are made: `work_precision`, `four_bar`, `sliders`,
which needs Chromium, and those of `GALLERY`. A notebook keeps the version of jaxmb and a digest of each code cell as it
was executed; `test_notebooks.py` compares them with the package and with the cells, and in its long tests what is
printed with what a new execution prints. Cells with the tag `varies` print what differs between machines and runs, such
as times, and are not compared.
"""

import base64
import hashlib
import io
import json
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import chromium
import equinox as eqx
import jax
import nbformat
from nbclient import NotebookClient
from PIL import Image

import jaxmb

FOLDER = Path(__file__).parents[2] / "notebooks"
# The rounding errors of two machines have nothing in common, and errors of solutions their size.
ROUNDING, OF_ERRORS, OF_VALUES = 1e-9, 20.0, 0.05
# Figures of notebooks that the README shows: the notebook and the cell.
GALLERY = {
    "excavator": ("16_loads", "loads-06"),
    "forces": ("16_loads", "loads-06b"),
    "worst_loads": ("16_loads", "loads-11"),
    "coupler_point": ("09_design_and_stability", "cell8"),
    "bicycle": ("09_design_and_stability", "cell12"),
    "belt": ("20_ropes", "ropes-13"),
    "trailer": ("21_wheels", "wheels-09"),
    "robot": ("22_handling", "handling-09"),
    "geneva": ("22_handling", "handling-13"),
}
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d*)?(?:e[-+]?\d+)?(?![\w])", re.IGNORECASE)


def digest(source: str) -> str:
    """The identity of a cell's source."""
    return hashlib.sha256(source.encode()).hexdigest()[:16]


def executed(path: Path) -> nbformat.NotebookNode:
    """The notebook after a new execution, with the record of it."""
    notebook = nbformat.read(path, as_version=4)
    resources = {"metadata": {"path": str(path.parent)}}
    NotebookClient(notebook, timeout=1800, kernel_name="python3", resources=resources, record_timing=False).execute()
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    for cell in cells:
        cell.outputs = _tidy(cell.outputs)
        cell.metadata.pop("execution", None)
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
        "jaxmb": {"version": jaxmb.__version__, "executed": {cell.id: digest(cell.source) for cell in cells}},
    }
    return notebook


def _tidy(outputs):
    """What was printed in pieces as one output, without the error stream: progress, and what compilers log."""
    out = []
    for output in outputs:
        if output.get("name") == "stdout" and out and out[-1].get("name") == "stdout":
            out[-1].text += output.text
        elif output.get("name") != "stderr":
            out.append(output)
    return out


def printed(cell: nbformat.NotebookNode) -> str:
    """The text of a cell's outputs, without figures."""
    texts = [output.text for output in cell.outputs if output.get("name") == "stdout"]
    texts += [
        output.data["text/plain"]
        for output in cell.outputs
        if output.output_type in ("execute_result", "display_data") and set(output.data) == {"text/plain"}
    ]
    return "\n".join(texts)


def difference(stored: str, new: str) -> str | None:
    """The first pair of lines that do not say the same; None if all do.

    Words are to be equal, integers and other numbers to 5 %, numbers with an exponent, which are mostly errors, within
    a factor of 20.
    """
    lines = [[" ".join(line.split()) for line in text.strip().splitlines()] for text in (stored, new)]
    for a, b in zip(*lines, strict=False):
        words = [_NUMBER.sub("#", line) for line in (a, b)]
        numbers = [_NUMBER.findall(line) for line in (a, b)]
        if words[0] != words[1] or not all(map(_agree, *numbers)):
            return f"stored: {a}\nnew:    {b}"
    return None if len(lines[0]) == len(lines[1]) else f"{len(lines[0])} lines stored, {len(lines[1])} new"


def _agree(a: str, b: str) -> bool:
    x, y = float(a), float(b)
    size = max(abs(x), abs(y))
    if size <= ROUNDING:
        return True
    if "e" in a.lower() and "e" in b.lower() and x * y > 0:
        return size <= OF_ERRORS * min(abs(x), abs(y))
    return abs(x - y) <= OF_VALUES * size


def readme_examples() -> list[str]:
    """The README's blocks of code."""
    return re.findall(r"```python\n(.*?)```", (FOLDER.parent / "README.md").read_text(), re.DOTALL)


def readme_machine() -> dict[str, Any]:
    """The names of the README's last block of code."""
    scope: dict[str, Any] = {}
    exec(readme_examples()[-1].rsplit("print(", 1)[0], scope)
    return scope


def _bare(figure, width, height):
    """Its axes, without anything beside the machine, and as large as the figure [inches]."""
    (axes,) = figure.axes
    axes.set(title="")
    for legend in (*figure.legends, *filter(None, [axes.get_legend()])):
        legend.remove()
    axes.axis("off")
    figure.set_size_inches(width, height)
    figure.set_layout_engine("none")
    axes.set_position((0.0, 0.0, 1.0, 1.0))
    return axes


def _save(shown: Any, path: Path) -> None:
    # Colours that cover all, not the commonest: a body may be a few pixels.
    shown.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(path, optimize=True)


def picture(name: str, path: Path) -> None:
    """A small PNG of a figure of `GALLERY`."""
    notebook, cell = GALLERY[name]
    (outputs,) = [x.outputs for x in nbformat.read(FOLDER / f"{notebook}.ipynb", as_version=4).cells if x.id == cell]
    (data,) = [output.data["image/png"] for output in outputs if "image/png" in output.get("data", {})]
    shown = Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")
    shown.thumbnail((640, 480), Image.Resampling.LANCZOS)
    _save(shown, path)


def moving_picture(trajectory: jaxmb.Trajectory, path: Path) -> None:
    """An animated GIF of a planar motion, one frame for each saved time."""
    frames = []
    for k in range(trajectory.ts.shape[0]):
        until = lambda x, k=k: x[max(k - 12, 0) : k + 1]
        shown = eqx.tree_at(lambda t: (t.ts, t.ys), trajectory, jax.tree.map(until, (trajectory.ts, trajectory.ys)))
        figure = jaxmb.viz.plot_mechanism(shown, frames=3)
        _bare(figure, 5.2, 4.0).set(xlim=(-1.2, 3.2), ylim=(-1.3, 2.1))
        file = io.BytesIO()
        figure.savefig(file, dpi=70)
        frames.append(Image.open(file).convert("P", palette=Image.Palette.ADAPTIVE, colors=64))
    text = {"jaxmb": jaxmb.__version__, "angle": float(trajectory["rocker"].angle[-1])}
    frames[0].save(
        path, save_all=True, append_images=frames[1:], duration=50, loop=0, optimize=True, comment=json.dumps(text)
    )


def sliders(path: Path) -> None:
    """A PNG of a page of `viz.explore`: one joint turned, the rest as at the start."""
    linkage = jaxmb.mechanisms.four_bar()
    bounds = {"coupler.mass": (1.0, 5.0), "B.point_b[0]": (-3.0, -0.2)}
    explorer = jaxmb.viz.explore(linkage.system, bounds, quantities="rocker.angle", state=linkage.state, t1=2.0)
    with tempfile.TemporaryDirectory() as folder, chromium.browser(Path(folder), 1040, 726) as page:
        page.go_online()
        page.call("Page.navigate", url=explorer.url)
        page.wait("document.querySelectorAll('.mantine-Slider-root').length == 4")
        page.hide_notices()
        explorer.set({"A.angle": 1.0})
        page.picture()
        x, y, width, height = page.value(
            "(() => { const b = document.querySelector('.mantine-Slider-root').getBoundingClientRect(); "
            "return [b.x, b.y, b.width, b.height]; })()"
        )
        page.click(x + 0.2 * width, y + height / 2)
        shown = Image.fromarray((255 * page.picture()).round().astype("uint8"))
    explorer.close()
    shown.thumbnail((800, 600), Image.Resampling.LANCZOS)
    _save(shown, path)


def main(names: list[str]) -> None:
    known = {path.stem: path for path in sorted(FOLDER.glob("*.ipynb"))}
    for name in names or [*known, "work_precision", "four_bar", "sliders", *GALLERY]:
        print(name, flush=True)
        if name == "work_precision":
            jaxmb.report.work_precision(jaxmb.mechanisms.get("andrews")).figure(FOLDER / f"{name}.png")
        elif name == "four_bar":
            moving_picture(readme_machine()["motion"](2.0), FOLDER / f"{name}.gif")
        elif name == "sliders":
            sliders(FOLDER / f"{name}.png")
        elif name in GALLERY:
            picture(name, FOLDER / f"{name}.png")
        else:
            nbformat.write(executed(known[name]), known[name])


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(sys.argv[1:])
