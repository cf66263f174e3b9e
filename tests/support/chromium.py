"""A page in Chromium without a window: what it shows, and what it asks for."""

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
import numpy as np

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
_OPTIONS = (
    "headless no-sandbox disable-gpu disable-quic no-first-run disable-background-networking disable-component-update "
    "disable-sync disable-extensions enable-unsafe-swiftshader use-angle=swiftshader hide-scrollbars "
    "remote-debugging-port=0"
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

    def go_online(self):
        """Reach servers of this machine."""
        self.call(
            "Network.emulateNetworkConditions", offline=False, latency=0, downloadThroughput=-1, uploadThroughput=-1
        )

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

    def hide_notices(self, document="document"):
        """A notice of software rendering would come at any time; `document`: that of the page, or of a frame."""
        self.value(
            f"(() => {{ const own = {document}; const style = own.createElement('style'); "
            "style.textContent = '.mantine-Notification-root {display: none}'; own.head.append(style); })()"
        )

    def picture(self):
        """What is seen, shape (height, width, 3), from 0 to 1, when it no longer changes."""
        last = None
        for _ in range(40):
            now = self.seen()
            if last is not None and np.array_equal(now, last):
                return now
            last = now
            time.sleep(1.0)
        raise AssertionError("The picture does not come to rest.")

    def seen(self):
        self.call("Runtime.evaluate", expression=_DRAWN, awaitPromise=True)
        data = self.call("Page.captureScreenshot", format="png")["data"]
        return matplotlib.image.imread(io.BytesIO(base64.b64decode(data)))[..., :3]


@contextlib.contextmanager
def browser(folder, width=900, height=620):
    """An open browser; `folder`: for its profile; `width` and `height` [pixels] of the page."""
    from websockets.sync.client import connect

    words = [CHROMIUM, *(f"--{option}" for option in _OPTIONS.split())]
    words += [f"--window-size={width},{height}", f"--user-data-dir={folder}", "about:blank"]
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
