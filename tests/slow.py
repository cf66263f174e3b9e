"""Run the slow tests that have gone longest without a run, and keep what came out.

    python -m tests.slow [--minutes 20] [--since COMMIT] [--jobs 2] [PATH ...]

runs, for so many minutes, tests that failed when they last ran, then those that never ran, then the oldest.
`--since main` begins with tests of what has changed since that commit, as the imports tell. `slow.json` has a line for
each test: the commit at which it ran, with a + for changes that were not committed, its seconds, whether it passed.
Paths choose tests. The exit status is 1 if a test fails.
"""

import argparse
import ast
import collections
import functools
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TESTS, PACKAGE, RECORD = ROOT / "tests", ROOT / "jaxmb", ROOT / "tests" / "slow.json"
# How long tests may begin, and since which commit changes come first.
MINUTES, SINCE = "JAXMB_TESTS_MINUTES", "JAXMB_TESTS_SINCE"


def main(arguments: list[str]) -> int:
    """Run tests as the command line says; the exit status of pytest."""
    parser = argparse.ArgumentParser(description="Run the slow tests that have gone longest without a run.")
    parser.add_argument("paths", nargs="*", default=["tests"])
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--since", default="", help="tests of what has changed since this commit come first")
    parser.add_argument("--jobs", type=int, default=2)
    chosen = parser.parse_args(arguments)
    os.environ.update({MINUTES: str(chosen.minutes), SINCE: chosen.since})
    # Files go to the processes whole, in order, since the tests of a file share compiled programs.
    side_by_side = ["-n", str(chosen.jobs), "--dist", "loadfile", "--no-loadscope-reorder"]
    options = ["-p", "tests.slow", "--all", "--durations=10", *side_by_side]
    return subprocess.run([sys.executable, "-m", "pytest", *options, *chosen.paths], cwd=ROOT).returncode


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    """Keep the slow tests, the longest without a run first, and those of one file together."""
    from slow_marks import is_slow

    record, age = read_record(), _ages()
    changed = _git("diff", "--name-only", os.environ[SINCE]).split() if os.environ.get(SINCE) else []
    far = {path: distance(path, changed) if changed else 0 for path in {item.path for item in items}}

    def rank(item):
        last = record.get(item.nodeid)
        if last is None or not last["passed"]:
            return 0 if last else 1
        return 2 + age.get(last["commit"].rstrip("+"), 0)

    slow = [item for item in items if is_slow(item)]
    first = collections.defaultdict(lambda: sys.maxsize)
    for item in slow:
        first[item.path] = min(first[item.path], rank(item))
    config.hook.pytest_deselected(items=[item for item in items if not is_slow(item)])
    items[:] = sorted(slow, key=lambda item: (far[item.path], first[item.path], item.path, rank(item)))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item):
    """Leave out what would begin too late, as seen from the first test of this process."""
    return True if time.monotonic() > _begun() + 60 * float(os.environ[MINUTES]) else None


@functools.cache
def _begun() -> float:
    """The time of the first call."""
    return time.monotonic()


class Outcomes:
    """What came out of the tests of this run, and at which commit."""

    def __init__(self):
        changed = _git("status", "--porcelain", "--", ".", ":!tests/slow.json")
        self.commit = _git("rev-parse", "--short=10", "HEAD").strip() + "+" * bool(changed)
        self.seconds, self.failed, self.collected = collections.Counter[str](), set[str](), set[str]()

    def pytest_runtest_logreport(self, report):
        """Add a phase of a test."""
        if report.failed:
            self.failed.add(report.nodeid)
        if not report.skipped:
            self.seconds[report.nodeid] += report.duration

    def pytest_xdist_node_collection_finished(self, ids):
        """Note which slow tests there are."""
        self.collected = set(ids)

    def pytest_sessionfinish(self, session):
        """Keep them in the record, which loses tests that have gone."""
        record = read_record() | {
            test: {"commit": self.commit, "seconds": round(seconds, 1), "passed": test not in self.failed}
            for test, seconds in self.seconds.items()
        }
        if session.config.args == ["tests"]:
            record = {test: last for test, last in record.items() if test in self.collected}
        lines = (f" {json.dumps(test)}: {json.dumps(record[test])}" for test in sorted(record))
        RECORD.write_text("{\n" + ",\n".join(lines) + "\n}\n")


def pytest_configure(config):
    """One process keeps the record."""
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(Outcomes())


def read_record() -> dict[str, dict]:
    """The record: a test's identifier → the commit, its seconds and whether it passed."""
    return json.loads(RECORD.read_text()) if RECORD.exists() else {}


def _ages() -> dict[str, int]:
    """Commits, with the oldest at zero and the latest at their number."""
    commits = _git("rev-list", "--reverse", "--abbrev=10", "--abbrev-commit", "HEAD").split()
    return {commit: k for k, commit in enumerate(commits)}


def _git(*arguments: str) -> str:
    """The output of a command of git in this checkout."""
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout


def distance(path: Path, changed: Iterable[str]) -> int:
    """Imports between a file of tests and the next changed file: zero for itself and for tests in a folder of its name.

    Files that nothing connects come last.
    """
    goals = {ROOT / name for name in changed}
    folders = {TESTS / goal.relative_to(PACKAGE).parent for goal in goals if PACKAGE in goal.parents} - {TESTS}
    if folders & set(path.parents):
        return 0
    steps, seen, reached = 0, {path}, {path}
    while reached:
        if reached & goals:
            return steps
        reached = {source for file in reached for source in _sources(file)} - seen
        seen |= reached
        steps += 1
    return sys.maxsize


@functools.cache
def _sources(path: Path) -> set[Path]:
    """Files from which a file imports, or names of the package come that it mentions."""
    tree = list(ast.walk(ast.parse(path.read_text())))
    sources = {file for node in tree if isinstance(node, ast.ImportFrom) for file in _imported(node, path)}
    mentioned = {node.attr for node in tree if isinstance(node, ast.Attribute)} if TESTS in path.parents else set()
    return sources | {_names()[name] for name in mentioned & _names().keys()}


@functools.cache
def _names() -> dict[str, Path]:
    """The public names of the package and the files that define them."""
    names = {}
    for stub in PACKAGE.rglob("*.pyi"):
        for node in ast.parse(stub.read_text()).body:
            for file in _imported(node, stub) if isinstance(node, ast.ImportFrom) else ():
                names.update({alias.asname or alias.name: file for alias in node.names})
    return names


def _imported(node: ast.ImportFrom, path: Path) -> set[Path]:
    """The files of an import from the package or from what tests share."""
    parts = node.module.split(".") if node.module else []
    if node.level:
        folders = [path.parents[node.level - 1]]
    else:
        folders = [ROOT, TESTS / "support"]
    places = [folder.joinpath(*parts) for folder in folders]
    places += [place / alias.name for place in places for alias in node.names]
    return {file for place in places for file in (place.with_suffix(".py"), place / "__init__.py") if file.exists()}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
