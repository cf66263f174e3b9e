"""Part of the tests once more, with the compiler options that users have: tests that run side by side have others."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

TESTS = Path(__file__).parents[1]
MODULES = ["simulate/test_simulate.py", "solvers/test_manifold_term.py"]


@pytest.mark.parametrize("module", MODULES)
def test_as_users_compile(module):
    own = {name: value for name, value in os.environ.items() if not name.startswith(("XLA_", "NPROC", "PYTEST_"))}
    command = [sys.executable, "-m", "pytest", "-q", str(TESTS / module)]
    run = subprocess.run(command, cwd=TESTS.parent, env=own, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout[-4000:] + run.stderr[-2000:]
