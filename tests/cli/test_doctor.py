"""The doctor: what it says of a machine, and what it measures there."""

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
# Durations without calls.
NUMBERS = f"print({[0.25 * k for k in range(1 + max(doctor._SHOWN.values()))]})"


def said(capsys, *words):
    """What is printed, by the names in front, and what else."""
    assert main(["doctor", *words]) == 0
    facts, *tables = capsys.readouterr().out.split("\n\n")
    joined = re.sub(r"\n {18}", " ", facts).splitlines()
    return {line[:18].strip(): line[18:] for line in joined}, tables


def test_doctor_is_quick(capsys):
    facts, tables = said(capsys)
    assert tables == []
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
    assert said(capsys)[0]["shifted arrays"].endswith("is right here" if right else wrong)
    monkeypatch.setattr(doctor, "shifts_rightly", lambda: not right)
    assert said(capsys)[0]["shifted arrays"].endswith(wrong if right else "is right here")


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
    facts, _ = said(capsys)
    jax.config.update("jax_compilation_cache_max_size", before)
    assert facts["kept programs"] == f"2 in ~/cache, 1.0{of} MiB"


def test_doctor_says_where_none_are_kept(capsys, monkeypatch):
    monkeypatch.setattr(doctor, "kept_in", lambda: None)
    monkeypatch.setenv("JAXMB_CACHE", "off")
    assert said(capsys)[0]["kept programs"] == "none, JAXMB_CACHE=off"


def test_doctor_says_what_is_missing(capsys, monkeypatch):
    monkeypatch.setattr(doctor, "_OPTIONAL", {"plot": ("numpy",), "view": ("numpy", "no_such_package")})
    numpy = f"numpy {importlib.metadata.version('numpy')}"
    facts, _ = said(capsys)
    assert facts["for plot"] == numpy
    assert facts["for view"] == f'{numpy}, no_such_package missing; pip install "jaxmb[view]"'


def test_doctor_knows_the_extras_of_the_package():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    names = {extra: tuple(re.match(r"[\w-]+", each).group() for each in own) for extra, own in extras.items()}
    assert {extra: names[extra] for extra in ("docs", "plot", "view", "import", "studies")} == doctor._OPTIONAL


@pytest.mark.slow
def test_doctor_measures(capsys, monkeypatch):
    monkeypatch.setattr(doctor, "_FIRST_CALLS", NUMBERS)
    monkeypatch.setattr(doctor, "_STEPPED", ("pendulum",))
    _, (_, calls, _, steps) = said(capsys, "--measure")
    rows = dict(re.match(r"(.*\S)\s+([\d.]+)\s+[\d.]+$", line).groups() for line in calls.splitlines()[1:])
    assert rows == {name: f"{0.25 * place:.3f}" for name, place in doctor._SHOWN.items()}
    head, row = (line.split("  ") for line in steps.splitlines())
    name, bodies, end, count, milliseconds, microseconds = " ".join(row).split()
    machine = mb.mechanisms.get("pendulum")
    motion = mb.simulate(machine.system, machine.state, t1=machine.t1, rtol=1e-8)
    assert (name, bodies, float(end), int(count)) == ("pendulum", "1", machine.t1, int(motion.stats["num_steps"]))
    assert float(microseconds) == pytest.approx(1e3 * float(milliseconds) / int(count), rel=0.05, abs=0.1)
    assert "step [µs]" in " ".join(head)


def test_doctor_tells_of_a_process_that_fails(capsys, monkeypatch):
    monkeypatch.setattr(doctor, "_FIRST_CALLS", "raise SystemExit('no such thing')")
    assert main(["doctor", "--measure"]) == 1
    assert capsys.readouterr().err == "jaxmb: A new process failed: no such thing\n"


def test_doctor_tells_of_a_motion_that_fails(monkeypatch):
    monkeypatch.setattr(doctor, "_STEPPED", ("pendulum",))
    monkeypatch.setattr(doctor, "interleaved", lambda runs, repeats: [(1.0,)])
    stats, result = {"num_steps": 1}, mb.RESULTS.max_steps_reached
    monkeypatch.setattr(doctor, "_motion", lambda *arguments: (stats, result, None))
    with pytest.raises(RuntimeError, match="pendulum: The maximum number of solver steps"):
        doctor._steps()


@pytest.mark.slow
def test_doctor_finds_that_the_second_process_waits_less():
    """Without what this process has told JAX of kept programs."""
    _, *rows = doctor._first_calls()
    assert [row[0] for row in rows] == list(doctor._SHOWN)
    times = {name: (float(first), float(second)) for name, first, second in rows}
    for name in ("four_bar: first value", "four_bar: first gradient"):
        assert times[name][1] < times[name][0]
        # Those that follow compile nothing.
        assert times[name.replace("first", "another")][0] < times[name][1]


def test_doctor_prints_what_the_readme_quotes():
    block = re.search(
        r"`jaxmb doctor(?: --measure)?` .*?```text\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL
    ).group(1)
    names = [line.split("  ")[0] for line in block.splitlines() if re.match(r"\w.*  ", line)]
    printed = [*doctor._SHOWN, *doctor._STEPPED]
    assert names and names == [name for name in printed if name in names]


@pytest.mark.parametrize(
    "given, told",
    [("3", "; computations take 3"), ("auto", ", NPROC=auto, which is not a number: all of them"), ("", "")],
)
def test_doctor_says_how_many_threads(given, told, monkeypatch):
    monkeypatch.delenv("PJRT_NPROC", raising=False)
    monkeypatch.setenv("NPROC", given)
    assert re.fullmatch(rf"\d+ cores?{told}", doctor._cores())
