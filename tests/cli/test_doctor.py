"""The doctor: what it says of a machine."""

import importlib.metadata
import platform
import re
import tomllib
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxmb as mb
from jaxmb.cli import doctor, main

ROOT = Path(__file__).parents[2]


def said(capsys):
    """What is printed, by the names in front."""
    assert main(["doctor"]) == 0
    joined = re.sub(r"\n {18}", " ", capsys.readouterr().out).splitlines()
    return {line[:18].strip(): line[18:] for line in joined}


def test_doctor_is_quick(capsys):
    facts = said(capsys)
    assert facts["jaxmb"] == f"{mb.__version__}, Python {platform.python_version()}"
    for name in ("jax", "jaxlib", "diffrax", "equinox"):
        assert f"{name} {importlib.metadata.version(name)}" in facts["needed"]
    assert platform.machine() in facts["machine"] and re.search(r"\d+ cores?\b", facts["machine"])
    assert re.match(r"\d+ \w+ \(.+\)", facts["devices"])
    assert list(facts)[-2:] == ["double precision", "kept programs"]


def test_doctor_says_whether_arrays_are_shifted_rightly(capsys, monkeypatch):
    """As this machine does, and in words for either case."""
    moved = jax.jit(lambda x: (x + 1).at[1:].set((x + 1)[:-1])[None])(np.arange(8.0))[0]
    right = np.array_equal(moved, [1.0, *np.arange(1.0, 8.0)])
    wrong = "is wrong here, a fault of XLA: write jnp.concatenate([b[:1], b[:-1]])"
    assert doctor.shifts_rightly() == right
    assert said(capsys)["shifted arrays"].endswith("is right here" if right else wrong)
    monkeypatch.setattr(doctor, "shifts_rightly", lambda: not right)
    assert said(capsys)["shifted arrays"].endswith(wrong if right else "is right here")


def test_doctor_prints_short_lines_but_for_paths(capsys, monkeypatch, tmp_path):
    folder = tmp_path / ("long" * 20)
    folder.mkdir()
    monkeypatch.setattr(doctor, "kept_in", lambda: folder)
    monkeypatch.setattr(doctor, "_processor", lambda: "a processor of many words " * 5)
    assert main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert all(len(line) <= 80 for line in lines if str(folder) not in line)
    assert any(str(folder) in line for line in lines)


@pytest.mark.parametrize("bound, of", [(2**27, " of 128"), (-1, "")])
def test_doctor_says_where_programs_are_kept(bound, of, capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    folder = tmp_path / "cache"
    folder.mkdir()
    for name in ("a-cache", "b-cache"):
        (folder / name).write_bytes(bytes(2**19))
    (folder / "a-atime").write_bytes(bytes(8))
    monkeypatch.setattr(doctor, "kept_in", lambda: folder)
    before = jax.config.jax_compilation_cache_max_size
    jax.config.update("jax_compilation_cache_max_size", bound)
    facts = said(capsys)
    jax.config.update("jax_compilation_cache_max_size", before)
    assert facts["kept programs"] == f"2 in ~/cache, 1.0{of} MiB"


def test_doctor_says_where_none_are_kept(capsys, monkeypatch):
    monkeypatch.setattr(doctor, "kept_in", lambda: None)
    monkeypatch.setenv("JAXMB_CACHE", "off")
    assert said(capsys)["kept programs"] == "none, JAXMB_CACHE=off"


def test_doctor_says_what_is_missing(capsys, monkeypatch):
    monkeypatch.setattr(doctor, "_OPTIONAL", {"plot": ("numpy",), "view": ("numpy", "no_such_package")})
    numpy = f"numpy {importlib.metadata.version('numpy')}"
    facts = said(capsys)
    assert facts["for plot"] == numpy
    assert facts["for view"] == f'{numpy}, no_such_package missing; pip install "jaxmb[view]"'


def test_doctor_knows_the_extras_of_the_package():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    names = {extra: tuple(re.match(r"[\w-]+", each).group() for each in own) for extra, own in extras.items()}
    assert {extra: names[extra] for extra in ("docs", "plot", "view", "import", "studies")} == doctor._OPTIONAL


@pytest.mark.parametrize(
    "given, told",
    [("3", "; computations take 3"), ("auto", ", NPROC=auto, which is not a number: all of them"), ("", "")],
)
def test_doctor_says_how_many_threads(given, told, monkeypatch):
    monkeypatch.delenv("PJRT_NPROC", raising=False)
    monkeypatch.setenv("NPROC", given)
    assert re.fullmatch(rf"\d+ cores?{told}", doctor._cores())
