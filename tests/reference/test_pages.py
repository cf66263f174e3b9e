"""The pages of names, topics and notebooks: they build without a warning, their links lead somewhere, and every public
name is in them once.
"""

import collections
import re
import subprocess
import sys
from pathlib import Path

import pytest
from pages.__main__ import broken

from jaxmb.reference.entries import entries
from jaxmb.reference.topics import topics

ROOT = Path(__file__).parents[2]


def test_link_that_leads_nowhere_is_found(tmp_path):
    (tmp_path / "a.html").write_text('<p id="top"><a href="b.html#here">b</a><a href="#top">up</a>')
    (tmp_path / "b.html").write_text('<p id="here"><a href="https://elsewhere.org/x">x</a><img src="a.html?v=1">')
    assert broken(tmp_path) == []
    (tmp_path / "b.html").write_text('<p><img src="c.png"><a href="a.html#middle">a</a>')
    assert broken(tmp_path) == ["a.html: b.html#here", "b.html: a.html#middle", "b.html: c.png"]


@pytest.mark.slow
def test_pages_build_with_every_name_once(tmp_path):
    command = [sys.executable, "-m", "tests.pages", str(tmp_path)]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
    pages = {path.stem: path.read_text() for path in tmp_path.rglob("*.html")}
    assert {"index", *topics(), *(path.stem for path in (ROOT / "notebooks").glob("*.ipynb"))} <= pages.keys()
    ids = collections.Counter(found for page in pages.values() for found in re.findall(r'id="([^"]*)"', page))
    for entry in entries().values():
        name = f"module-jaxmb.{entry.name}" if entry.kind == "module" else f"jaxmb.{entry.name}"
        assert ids[name] == 1, name
    # Names in docstrings are links, and no marks of Markdown are left in their text.
    (spatial,) = [page for page in pages.values() if 'id="jaxmb.spatial.Revolute"' in page]
    assert 'title="jaxmb.DryFriction"' in spatial
    text = re.sub(r"<(pre|code|dt|script|style).*?</\1>", "", spatial, flags=re.DOTALL)
    assert not [mark for mark in ("**", "`", "$$") if mark in text]
