"""Recorded durations of tests: they belong to tests that exist, and decide which of them run without `--all`."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
DURATIONS = TESTS / "durations.json"
LITTLE_TESTS = """
import time
import pytest

@pytest.mark.parametrize("seconds", [0.0, 1.1])
def test_sleeps(seconds):
    time.sleep(seconds)

def test_is_not_timed_yet():
    pass

@pytest.mark.always
def test_runs_always():
    pass

def test_fails():
    assert False
"""


def pytest_on(folder, *options):
    """What pytest prints in a process of its own, without the options of this one."""
    own = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    command = [sys.executable, "-m", "pytest", "-q", *options]
    return subprocess.run(command, cwd=folder, env=own, capture_output=True, text=True).stdout


@pytest.mark.always
def test_every_recorded_test_exists():
    found = {line for line in pytest_on(TESTS.parent, "--collect-only", "--all").splitlines() if "::" in line}
    assert f"{Path(__file__).relative_to(TESTS.parent)}::{test_every_recorded_test_exists.__name__}" in found
    assert json.loads(DURATIONS.read_text()).keys() - found == set()


def test_only_tests_that_ran_are_timed_anew(tmp_path):
    (tmp_path / "conftest.py").write_text((TESTS / "conftest.py").read_text())
    (tmp_path / "test_little.py").write_text(LITTLE_TESTS)
    (tmp_path / "pytest.ini").write_text(
        f"[pytest]\npythonpath = {TESTS / 'support'}\nmarkers =\n  long: .\n  always: .\n"
    )
    names = ["sleeps[0.0]", "sleeps[1.1]", "is_not_timed_yet", "runs_always", "fails"]
    quick, slow, unknown, always, failing = (f"test_little.py::test_{name}" for name in names)
    recorded = tmp_path / "durations.json"

    before = {quick: 60.0, slow: 0.1, unknown: None, always: 60.0, failing: 1.1}
    recorded.write_text(json.dumps(before))
    collected = pytest_on(tmp_path, "--collect-only")
    assert [name for name in (quick, slow, unknown, always, failing) if name in collected] == [slow, always, failing]

    assert "1 failed, 3 passed, 1 deselected" in pytest_on(tmp_path, "--all", "--record-durations", "-k", "not timed")
    after = json.loads(recorded.read_text())
    assert 1.1 <= after.pop(slow) < 60.0
    # Quick ones are not kept; one that failed and one that did not run stay as they were.
    assert after == {unknown: None, failing: 1.1}
