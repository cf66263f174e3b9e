"""Pages of moving pictures in a browser without a network: they load, they show something, and it moves."""

import time

import nbformat
import numpy as np
import pytest
from chromium import CHROMIUM, browser

import jaxmb as mb

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)"),
    # Of the notebook's kernel and of the browser's socket, which this package does not touch.
    pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning"),
]

# The time slider of viser's client, in the page or in a frame of it, and the pictures of its canvas.
DOCUMENT = "(document.querySelector('iframe')?.contentDocument ?? document)"
SLIDER = f"{DOCUMENT}.querySelector('.mantine-Slider-root')"
LOADED = f"[...{DOCUMENT}.querySelectorAll('canvas')].some(own => own.width > 100) && {SLIDER}?.clientWidth > 50"


@pytest.fixture(scope="module")
def motions():
    """A closed loop of the plane, and a vehicle with wheels, springs and a track on terrain."""
    out = {}
    for name, t1 in (("four_bar", 2.0), ("tracked_vehicle", 1.5)):
        mechanism = mb.mechanisms.get(name)
        ts = np.linspace(0.0, t1, 61)
        out[name] = mb.simulate(mechanism.system, mechanism.state, t1=t1, rtol=1e-5, saveat=ts)
    return out


@pytest.fixture
def page(tmp_path):
    with browser(tmp_path / "profile") as own:
        yield own


def check_it_plays(page):
    """It shows more than a ground; another time looks different, and the first one again as before."""
    page.wait(LOADED)
    page.hide_notices(DOCUMENT)
    box = page.value(
        f"(() => {{ const a = document.querySelector('iframe')?.getBoundingClientRect() ?? {{x: 0, y: 0}}; "
        f"const b = {SLIDER}.getBoundingClientRect(); "
        "return [a.x + b.x, a.y + b.y, b.width, b.height]; })()"
    )
    x, y, width, height = box
    seen = []
    for share in (0.15, 0.7, 0.15):
        page.click(x + share * width, y + height / 2)
        seen.append(page.picture()[: int(y) - 10])
    first, later, again = seen
    colors = np.unique((first.reshape(-1, 3) * 16).round(), axis=0)
    assert len(colors) > 30
    moved, same = (np.count_nonzero(np.abs(first - own).max(axis=-1) > 0.1) for own in (later, again))
    assert moved > 1000 and same < 0.05 * moved
    assert not page.complaints
    return first


@pytest.mark.parametrize("name", ["four_bar", "tracked_vehicle"])
def test_page_plays(name, motions, page, tmp_path):
    path = mb.viz.save_html(motions[name], tmp_path / "motion.html", points=[], reactions=[])
    assert path.stat().st_size < 1.2e6
    page.open(path, "?fixedDpr=1")
    check_it_plays(page)
    assert {url.split(":")[0] for url in page.requests} <= {"file", "data", "blob"}


def test_notebook_that_was_exported_plays(page, tmp_path):
    """Run by a kernel and exported by nbconvert, a notebook still plays."""
    nbconvert, nbclient = pytest.importorskip("nbconvert"), pytest.importorskip("nbclient")
    source = """
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
import jaxmb as mb
bodies = [mb.planar.Body("bar", mass=1.0, inertia=0.1, position=(0.5, 0.0))]
pin = mb.planar.Revolute("pin", "ground", "bar", point_a=(0.0, 0.0), point_b=(-0.5, 0.0))
system = mb.Scene(bodies, joints=[pin], forces=[mb.Gravity((0.0, -9.81))]).compile()
motion = mb.simulate(system, mb.assemble(system), t1=1.0, rtol=1e-5, saveat=np.linspace(0.0, 1.0, 31))
mb.viz.show(motion, points=["bar"])
"""
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source)])
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
    text, _ = nbconvert.HTMLExporter(embed_images=True).from_notebook_node(notebook)
    (tmp_path / "notebook.html").write_text(text, encoding="utf-8")
    page.open(tmp_path / "notebook.html")
    page.wait(f"{SLIDER} != null")
    page.value("document.querySelector('iframe').scrollIntoView()")
    check_it_plays(page)


@pytest.mark.parametrize("in_a_cell", [False, True])
def test_explorer_moves_with_its_sliders(in_a_cell, motions, page, tmp_path):
    """On its page, and in the frame of a notebook's cell: a slider that a user moves changes picture and curve."""
    page.go_online()
    system, bounds = motions["four_bar"].system, {"coupler.mass": (1.0, 5.0)}
    explorer = mb.viz.explore(
        system, bounds, state=mb.mechanisms.get("four_bar").state, quantities="rocker.angle", t1=1.0
    )
    try:
        cell = tmp_path / "cell.html"
        cell.write_text(f"<html><body>{explorer._repr_html_()}</body></html>")
        page.call("Page.navigate", url=cell.as_uri() if in_a_cell else explorer.url)
        end = time.monotonic() + 120
        while len(np.unique((page.seen().reshape(-1, 3) * 16).round(), axis=0)) < 40:
            assert time.monotonic() < end
            time.sleep(0.5)
        first = page.picture()
        explorer.set({"A.angle": 0.4})
        # The linkage at the left, and at the right the slider, the numbers and the curve.
        for side in (slice(400), slice(500, None)):
            while np.count_nonzero(np.abs(page.seen() - first)[:, side].max(axis=-1) > 0.1) < 300:
                assert time.monotonic() < end
                time.sleep(0.5)
        if not in_a_cell:
            sliders = "document.querySelectorAll('.mantine-Slider-root')"
            box = page.value(
                f"(() => {{ const b = {sliders}[1].getBoundingClientRect(); return [b.x, b.y, b.width, b.height]; }})()"
            )
            page.click(box[0] + 0.1 * box[2], box[1] + 0.5 * box[3])
            while explorer.values["coupler.mass"] == 3.0:
                assert time.monotonic() < end
                time.sleep(0.1)
            assert 1.0 <= explorer.values["coupler.mass"] < 2.0
        assert not page.complaints
    finally:
        explorer.close()
