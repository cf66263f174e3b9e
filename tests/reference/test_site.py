"""The reference as HTML: it builds without a warning, all its links lead somewhere, and every public name is in it."""

import collections
import html.parser
import sys
import urllib.parse
from pathlib import Path

import pytest

from jaxmb.cli import main
from jaxmb.reference import build
from jaxmb.reference.entries import entries, members

# Signatures stand in `dt`.
CODE = {"code", "dt", "pre", "script", "style"}
NOTEBOOKS = Path(__file__).parents[2] / "notebooks"


class Page(html.parser.HTMLParser):
    """The targets and the links of a page, its tags, and its text without code."""

    def __init__(self, path):
        super().__init__()
        self.ids, self.links, self.tags, self.text, self.code = collections.Counter(), [], set(), "", 0
        self.feed(path.read_text())

    def handle_starttag(self, tag, attrs):
        own = dict(attrs)
        self.tags.add(tag)
        self.code += tag in CODE
        self.ids.update([own["id"]] if "id" in own else [])
        self.links += [own[name] for name in ("href", "src") if own.get(name)]

    def handle_endtag(self, tag):
        self.code -= tag in CODE

    def handle_data(self, data):
        self.text += "" if self.code else data


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reference") / "made"
    assert build(folder, notebooks=NOTEBOOKS) == []
    return {path: Page(path) for path in sorted(folder.glob("*.html"))}


@pytest.mark.long
def test_every_link_leads_somewhere(pages):
    broken, count = [], 0
    for path, page in pages.items():
        for link in page.links:
            address = urllib.parse.urlparse(link)
            if address.scheme or address.netloc:
                continue
            target = (path.parent / urllib.parse.unquote(address.path)).resolve() if address.path else path
            count += 1
            known = pages[target].ids if target in pages else {}
            if not target.exists() or (target in pages and address.fragment and address.fragment not in known):
                broken.append(f"{path.name}: {link}")
    assert count > 5000 and broken == []


@pytest.mark.long
def test_every_public_name_is_in_it_once(pages):
    ids = sum((page.ids for page in pages.values()), collections.Counter())
    for entry in entries().values():
        lead = "module-" if entry.kind == "module" else ""
        assert ids[f"{lead}jaxmb.{entry.name}"] == 1, entry.name
        if entry.kind == "class":
            for member in members(entry):
                assert ids[f"jaxmb.{member.name}"] == 1, member.name


@pytest.mark.long
def test_no_private_module_is_in_it(pages):
    for page in pages.values():
        assert not [own for own in page.ids if own.startswith("jaxmb.") and "._" in own]


@pytest.mark.long
def test_notebooks_are_in_it(pages):
    names = {path.stem for path in pages}
    assert names >= {path.stem for path in NOTEBOOKS.glob("*.ipynb")} | {"index", "search"}


@pytest.mark.long
def test_docstrings_are_rendered(pages):
    """No line of a docstring is taken for a quotation, and no marks of its text are left."""
    for path, page in pages.items():
        if not path.stem[0].isdigit():
            assert "blockquote" not in page.tags, path.name
            assert [mark for mark in ("**", "`", "??? ", "][", "$", "{py:") if mark in page.text] == [], path.name


def test_other_files_are_kept(tmp_path, capsys):
    (tmp_path / "thesis.tex").write_text("")
    assert main(["reference", str(tmp_path)]) == 2
    assert "holds other files; give a new folder" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_site_of_another_project_is_kept(tmp_path, capsys):
    inventory = tmp_path / "objects.inv"
    inventory.write_bytes(b"# Sphinx inventory version 2\n# Project: another\n")
    assert main(["reference", str(tmp_path)]) == 2
    assert "holds other files" in capsys.readouterr().err and inventory.exists()


def test_a_folder_without_notebooks(tmp_path, capsys):
    assert main(["reference", str(tmp_path / "made"), "--notebooks", str(tmp_path)]) == 2
    assert "There are no notebooks in" in capsys.readouterr().err


def test_without_sphinx(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "myst_nb", None)
    assert main(["reference", str(tmp_path / "made")]) == 1
    assert 'pip install "jaxmb[docs]"' in capsys.readouterr().err
    assert not (tmp_path / "made").exists()
