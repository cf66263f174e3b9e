"""Versions of other packages that compute wrong numbers: what is said of them."""

import importlib.metadata
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

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
