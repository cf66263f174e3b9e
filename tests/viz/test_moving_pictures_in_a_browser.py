"""Pages of moving pictures in a browser without a network: they load, they show something, and it moves."""

import base64
import contextlib
import io
import json
import os
import shutil
import signal
import subprocess
import time
import urllib.request

import matplotlib.image
import nbformat
import numpy as np
import pytest

import jaxmb as mb

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
_OPTIONS = (
    "headless no-sandbox disable-gpu disable-quic no-first-run disable-background-networking disable-component-update "
    "disable-sync disable-extensions enable-unsafe-swiftshader use-angle=swiftshader hide-scrollbars "
    "remote-debugging-port=0 window-size=900,620"
)

# True once the page has drawn this many times: a picture taken while it is busy, as with its first, is an old one.
_DRAWN = (
    "new Promise(done => { let left = 10; "
    "const next = () => left-- ? requestAnimationFrame(next) : done(true); next(); })"
)


class Browser:
    """One page; `requests`: what it asked for, `complaints`: errors that it reported."""

    def __init__(self, socket):
        self._socket, self._count = socket, 0
        self.requests, self.complaints = [], []
        for domain in ("Page", "Network", "Runtime"):
            self.call(f"{domain}.enable")
        self.call("Network.emulateNetworkConditions", offline=True, latency=0, downloadThroughput=0, uploadThroughput=0)

    def call(self, method, **parameters):
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=120))
            if message.get("id") == self._count:
                assert "error" not in message, message
                return message["result"]
            if message["method"] == "Network.requestWillBeSent":
                self.requests.append(message["params"]["request"]["url"])
            if message["method"] == "Runtime.exceptionThrown":
                self.complaints.append(message["params"]["exceptionDetails"])

    def open(self, path, query=""):
        self.call("Page.navigate", url=path.resolve().as_uri() + query)

    def value(self, expression):
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def wait(self, expression, seconds=90):
        """Until an expression is true."""
        end = time.monotonic() + seconds
        while not self.value(expression):
            assert time.monotonic() < end, f"{expression}; {self.complaints}"
            time.sleep(0.2)

    def click(self, x, y):
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def picture(self):
        """What is seen, shape (height, width, 3), from 0 to 1, when it no longer changes."""
        last = None
        for _ in range(40):
            now = self._seen()
            if last is not None and np.array_equal(now, last):
                return now
            last = now
            time.sleep(1.0)
        raise AssertionError("The picture does not come to rest.")

    def _seen(self):
        self.call("Runtime.evaluate", expression=_DRAWN, awaitPromise=True)
        data = self.call("Page.captureScreenshot", format="png")["data"]
        return matplotlib.image.imread(io.BytesIO(base64.b64decode(data)))[..., :3]


@contextlib.contextmanager
def browser(folder):
    """An open browser; `folder`: for its profile."""
    from websockets.sync.client import connect

    words = [CHROMIUM, *(f"--{option}" for option in _OPTIONS.split()), f"--user-data-dir={folder}", "about:blank"]
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        where = folder / "DevToolsActivePort"
        for _ in range(300):
            if where.exists() and where.read_text():
                break
            time.sleep(0.2)
        port = where.read_text().split()[0]
        direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        with direct.open(f"http://127.0.0.1:{port}/json/list") as listed:
            page = next(own for own in json.load(listed) if own["type"] == "page")
        with connect(page["webSocketDebuggerUrl"], max_size=None, proxy=None) as socket:
            yield Browser(socket)
    finally:
        os.killpg(process.pid, signal.SIGTERM)
        process.wait()


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
    # A notice of software rendering would come at any time.
    page.value(
        f"(() => {{ const own = {DOCUMENT}; const style = own.createElement('style'); "
        "style.textContent = '.mantine-Notification-root {display: none}'; own.head.append(style); })()"
    )
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
    page.call("Network.emulateNetworkConditions", offline=False, latency=0, downloadThroughput=-1, uploadThroughput=-1)
    system, bounds = motions["four_bar"].system, {"coupler.mass": (1.0, 5.0)}
    explorer = mb.viz.explore(
        system, bounds, state=mb.mechanisms.get("four_bar").state, quantities="rocker.angle", t1=1.0
    )
    try:
        cell = tmp_path / "cell.html"
        cell.write_text(f"<html><body>{explorer._repr_html_()}</body></html>")
        page.call("Page.navigate", url=cell.as_uri() if in_a_cell else explorer.url)
        end = time.monotonic() + 120
        while len(np.unique((page._seen().reshape(-1, 3) * 16).round(), axis=0)) < 40:
            assert time.monotonic() < end
            time.sleep(0.5)
        first = page.picture()
        explorer.set({"A.angle": 0.4})
        # The linkage at the left, and at the right the slider, the numbers and the curve.
        for side in (slice(400), slice(500, None)):
            while np.count_nonzero(np.abs(page._seen() - first)[:, side].max(axis=-1) > 0.1) < 300:
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
