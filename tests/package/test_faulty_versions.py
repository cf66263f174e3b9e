"""Versions of other packages that compute wrong numbers: what is said of them."""

import ast
import importlib.metadata
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb._faulty_versions import FAULTS, fault_of, warn_of_jaxlib
from jaxmb.cli import main

INSTALLED = importlib.metadata.version


@pytest.fixture
def faulty(monkeypatch):
    versions = dict(FAULTS.keys())
    monkeypatch.setattr(importlib.metadata, "version", lambda name: versions.get(name) or INSTALLED(name))


def test_a_faulty_jaxlib_is_warned_of(faulty):
    with pytest.warns(UserWarning, match=r"jaxlib 0\.10\.2: on CPUs, .* pip install .*jaxlib!=0\.10\.2") as caught:
        warn_of_jaxlib()
    assert len(caught) == 1


@pytest.mark.slow
def test_the_import_warns_once():
    code = "import importlib.metadata as m; own = m.version; m.version = lambda name: '0.10.2' if name == 'jaxlib' else"
    code += " own(name)\nimport jaxmb, jaxmb.spatial, jaxmb.planar"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stderr
    assert said.count("UserWarning: jaxlib 0.10.2") == 1


@pytest.mark.filterwarnings("error")
def test_of_other_versions_nothing_is_said(monkeypatch):
    for version in ("0.10.1", "0.10.3", "0.10.20"):
        monkeypatch.setattr(importlib.metadata, "version", lambda name, version=version: version)
        warn_of_jaxlib()
    monkeypatch.undo()
    assert fault_of("no such package") is None


def test_the_doctor_says_it(faulty, capsys):
    assert main(["doctor"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "wrong numbers jaxlib 0.10.2: on CPUs" in said and "mujoco 4.0.0: motions with constraints" in said


def test_the_doctor_says_nothing_of_other_versions(monkeypatch, capsys):
    versions = {"jaxlib": "0.10.1", "mujoco": "4.0.1"}
    monkeypatch.setattr(importlib.metadata, "version", lambda name: versions.get(name) or INSTALLED(name))
    assert main(["doctor"]) == 0
    assert "wrong numbers" not in capsys.readouterr().out


def test_products_of_many_rows_on_this_machine():
    """As the faulty version computes them: the sum of the squares of each of 16385 rows times the identity."""
    rows = jnp.stack([jnp.arange(16_385.0) % 7, jnp.zeros(16_385), jnp.ones(16_385)], axis=1)
    norms = jax.jit(jax.vmap(lambda row: jnp.sum((jnp.eye(3) @ row) ** 2)))(rows)
    np.testing.assert_allclose(norms, np.sum(np.asarray(rows) ** 2, axis=1), rtol=1e-6)


def shifts(code):
    """The lines where an array is updated in a slice by a slice of its own, as in `b.at[1:].set(b[:-1])`."""

    def slices(node):
        return any(isinstance(part, ast.Slice) for part in ast.walk(node))

    for node in ast.walk(ast.parse(code)):
        match node:
            case ast.Call(
                func=ast.Attribute(value=ast.Subscript(value=ast.Attribute(value=base, attr="at"), slice=place)),
                args=[value, *_],
            ) if slices(place):
                parts = [part for part in ast.walk(value) if isinstance(part, ast.Subscript) and slices(part.slice)]
                if any(ast.dump(part.value) == ast.dump(base) for part in parts):
                    yield node.lineno


def test_no_array_is_shifted_in_place():
    """XLA computes it wrongly before a new axis; `concatenate` does it rightly. Only the doctor tries it."""
    root = Path(mb.__file__).parent
    found = {path.relative_to(root).as_posix() for path in root.rglob("*.py") if any(shifts(path.read_text()))}
    assert found == {"cli/doctor.py"}


@pytest.mark.parametrize(
    "code, count",
    [
        ("b.at[1:].set(b[:-1])", 1),
        ("f(y.q.at[:, 2:].add(2 * y.q[:, :-2] + 1)[None])", 1),
        ("a.b.at[k].set(a.b[:-1])", 0),
        ("b.at[1:].set(a[:-1])", 0),
        ("b.at[1:].set(-b[0])", 0),
    ],
)
def test_a_shift_in_place_is_found(code, count):
    assert len(list(shifts(code))) == count
