"""Every part of a scene has an example with a picture: in a notebook or in a topic of the help, and in the table of
examples. A new part without one fails here.
"""

import re

import nbformat
import pytest
from execute_notebooks import FOLDER
from exports import OF_SCENES, exported

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.parts.frames import AbstractFixedFrame
from jaxmb.reference import topics

PICTURE = re.compile(r"\.plot\(|viz\.(plot|show)")
# A row of the table: the name of a notebook or topic, and the names of parts.
ROW = re.compile(r"^\| \[([\w-]+)\]\([^)]*\) \|[^|]*\|(.*)\|$", re.M)
SPACES = {"planar": planar, "spatial": spatial, "(?:jaxmb|mb)": mb}


def notebook(path):
    cells = nbformat.read(path, as_version=4).cells
    return "\n".join(cell.source for cell in cells if cell.cell_type == "code")


CODE = {path.stem: notebook(path) for path in FOLDER.glob("*.ipynb")}
CODE |= {name: "\n".join(re.findall(r"```python\n(.*?)```", topic.text, re.S)) for name, topic in topics().items()}
CODE = {name: code for name, code in CODE.items() if PICTURE.search(code)}
TABLE = {example: re.findall(r"`(\w+)`", parts) for example, parts in ROW.findall(topics()["examples"].text)}


def patterns():
    """For each part its name, and a pattern of the ways to write it: a class of both spaces has two."""
    out = {}
    for space, module in SPACES.items():
        for name in exported(module, (*OF_SCENES, AbstractFixedFrame)):
            out.setdefault(getattr(module, name), (name, []))[1].append(rf"\b{space}\.{name}\b")
    return [(name, "|".join(ways)) for name, ways in out.values()]


def lacking(parts):
    """The parts without an example in the table whose code has them."""
    at = lambda name, pattern: [x for x, names in TABLE.items() if name in names and re.search(pattern, CODE[x])]
    return [pattern for name, pattern in parts if not at(name, pattern)]


def test_part_without_an_example_is_found():
    assert lacking([("Sleeve", r"\bplanar\.Sleeve\b"), ("Gear", r"\bplanar\.Gear\b")]) == [r"\bplanar\.Sleeve\b"]


def test_every_part_has_an_example_with_a_picture():
    """A new part needs a job in a notebook, or a picture in a topic, and its name in the topic `examples`."""
    assert lacking(patterns()) == []


@pytest.mark.parametrize("example", TABLE)
def test_table_names_parts_that_the_example_has(example):
    assert [name for name in TABLE[example] if not re.search(rf"\b\w+\.{name}\b", CODE[example])] == []
