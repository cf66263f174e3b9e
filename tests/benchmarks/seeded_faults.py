"""Do the tests find faults? `faults.py` has a wrong sign, factor, limit or branch for each law of the package.

    python tests/benchmarks/seeded_faults.py [WORD ...] [--jobs 2] [--minutes 60] [--slow] [--all-files]

runs, with each fault or those whose text contains a word, the short tests that call the function with the fault, those
of its folder first, until one fails. Each file of tests runs in a fork of a process that has imported everything, with
the fault in this fork alone. `seeded_faults.json` keeps the outcomes, so that a later call goes on. An outcome holds
as long as the texts of the fault and of its module are the same, and its tests exist. The exit status is 1 if
a fault is not noticed. `--tests tests/parts` asks whether these tests alone notice the faults; nothing is kept then.

Which functions the tests of a file call is found out with the first fault that none of them notices, and kept in
pytest's cache folder as long as the file is the same; `--renew` finds it out again. A test that fails with a fault runs
once more without it: a test that fails then as well notices nothing.
"""

import argparse
import contextlib
import hashlib
import json
import os
import re
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Generator, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import fault_switch
import jax
import pytest
from fault_switch import PACKAGE, Fault
from faults import FAULTS

ROOT = Path(__file__).parents[2]
TABLE = Path(__file__).with_suffix(".json")
# Most seconds of one file's tests.
LIMIT = 600.0
# Files whose tests look at the text of the package, in other processes.
LEFT_OUT = ("tests/package/test_quality.py", "tests/package/test_lowest_versions.py")


@dataclass(frozen=True)
class Run:
    """The tests of a file until one fails, in one process: which of them, and with what.

    `notes` asks which functions of the package they call.
    """

    file: str
    fault: Fault | None = None
    notes: bool = False
    only: str | None = None
    without: tuple[str, ...] = ()
    slow: bool = False


@dataclass
class Seen:
    """What such a process saw: `died` says why it came to no end."""

    failed: dict[str, str] = field(default_factory=dict)
    functions: list[str] = field(default_factory=list)
    seconds: float = 0.0
    died: str | None = None
    refused: str | None = None


@dataclass
class Outcome:
    """What was found out about a fault in a module of this digest.

    `noticed_by` has the tests that fail with the fault alone, with what they say; `passed`, of a fault that nothing has
    noticed, the files whose tests call the function with the fault and pass, with their digests; `finished` tells
    whether all such files have run, or enough of them.
    """

    file: str
    code: str
    wrong: str
    module: str
    noticed_by: dict[str, str] = field(default_factory=dict)
    passed: dict[str, str] = field(default_factory=dict)
    died: dict[str, str] = field(default_factory=dict)
    seconds: float = 0.0
    slow: bool = False
    all_files: bool = False
    finished: bool = True
    refused: str | None = None

    def word(self) -> str:
        """Its last column in the table that is printed."""
        if self.noticed_by or self.refused:
            return ", ".join(self.noticed_by) or f"REFUSED: {self.refused}"
        said = "NOT NOTICED by" if self.finished else "not noticed so far by"
        return f"{said} {len(self.passed)} files" + "".join(f"; {file} died, {why}" for file, why in self.died.items())


class Records:
    """What each file of tests calls and how long it takes, kept in a folder."""

    def __init__(self, folder: Path):
        self._folder, self._read = folder, dict[Path, Seen]()
        folder.mkdir(parents=True, exist_ok=True)

    def _path(self, file: str) -> Path:
        return self._folder / f"{file.replace('/', '.')}.{_digest(ROOT / file)}.json"

    def get(self, file: str) -> Seen | None:
        path = self._path(file)
        if path not in self._read and path.exists():
            self._read[path] = Seen(**json.loads(path.read_text()))
        return self._read.get(path)

    def keep(self, file: str, seen: Seen) -> None:
        for old in self._folder.glob(f"{file.replace('/', '.')}.*.json"):
            old.unlink()
        _write(self._path(file), asdict(seen))
        self._read[self._path(file)] = seen

    def forget(self) -> None:
        for path in self._folder.glob("*.json"):
            path.unlink()


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def _write(path: Path, content: Any) -> None:
    other = path.with_suffix(f".{os.getpid()}.new")
    other.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n")
    other.replace(path)


def files_of_tests(among: tuple[str, ...]) -> list[str]:
    """The files of tests whose names begin so."""
    files = (str(path.relative_to(ROOT)) for path in sorted((ROOT / "tests").rglob("test_*.py")))
    return [file for file in files if file not in LEFT_OUT and file.startswith(among)]


def by_nearness(fault: Fault, place: str | None, records: Records, among: tuple[str, ...]) -> dict[str, bool]:
    """The files of tests: those of the fault's module, those that name its class, and those of its folder, quick ones
    first; and whether they are one of these.
    """
    folder, stem = Path("tests", fault.file).parent, Path(fault.file).stem.strip("_")
    name = re.split(r"[.:]", place)[2] if place else ""
    named = re.compile(rf"\b{re.escape(name)}\b" if name[:1].isupper() else "$^")

    def order(file: str) -> tuple[Any, ...]:
        path, known = Path(file), records.get(file)
        own = path.stem == f"test_{stem}"
        inside, beside = path.parent == folder, path.parts[:2] == folder.parts[:2]
        text = (ROOT / file).read_text()
        near = not own, not (named.search(text) and beside), not named.search(text), not inside, not beside
        return *near, known.seconds if known else len(text) / 1000, file

    keys = {file: order(file) for file in files_of_tests(among)}
    return {file: not all(keys[file][:5]) for file in sorted(keys, key=keys.__getitem__)}


def search(fault: Fault, before: Outcome | None, records: Records, options: Any) -> Generator[Run, Seen, Outcome]:
    """Asks for one run after another, and returns what came out."""
    place = fault.place()
    outcome, began = Outcome(*fault, module=_digest(PACKAGE / fault.file)), time.monotonic()
    near = by_nearness(fault, place, records, tuple(options.tests or ["tests/"]))
    known = set() if before is None else {test.split("::")[0] for test in before.noticed_by}
    files = sorted(near, key=lambda file: file not in known)
    if before is not None and before.module == outcome.module and not options.retry:
        outcome.passed = {file: digest for file, digest in before.passed.items() if _is(file, digest)}
    for slow in (False, True) if options.slow else (False,):
        outcome.slow = slow
        for file in files:
            record = records.get(file)
            calls = record is None or place is None or place in record.functions
            # Slow tests may call what the short ones of their file do not.
            if not calls and not (slow and near[file]):
                continue
            if not slow and file in outcome.passed:
                continue
            if time.monotonic() - began > 60 * options.patience:
                outcome.finished = False
                return outcome
            run = Run(file, fault, record is None and not slow, slow=slow)
            yield from _with_fault(run, place, records, outcome)
            if outcome.refused or (outcome.noticed_by and not options.all_files):
                outcome.passed = {}
                return outcome
        if outcome.noticed_by:
            outcome.passed = {}
            break
    outcome.all_files = True
    return outcome


def _is(file: str, digest: str) -> bool:
    return (ROOT / file).exists() and _digest(ROOT / file) == digest


def _with_fault(run: Run, place: str | None, records: Records, outcome: Outcome) -> Generator[Run, Seen, None]:
    """Runs the file until a test fails that passes without the fault."""
    while True:
        seen = yield run
        outcome.seconds = round(outcome.seconds + seen.seconds, 1)
        outcome.refused = seen.refused
        if seen.died:
            outcome.died[run.file] = seen.died
        if not seen.failed:
            if not seen.died and not seen.refused:
                if run.notes:
                    records.keep(run.file, seen)
                if not run.slow and (not run.notes or place is None or place in seen.functions):
                    outcome.passed[run.file] = _digest(ROOT / run.file)
            return
        test, why = next(iter(seen.failed.items()))
        alone = yield Run(run.file, only=test, slow=run.slow)
        if not alone.failed and not alone.died:
            outcome.noticed_by[test] = why
            return
        run = replace(run, without=(*run.without, test))


def execute(run: Run, cache: Path) -> Seen:
    """In a process of its own: run the tests with the fault."""
    seen = Seen()
    try:
        functions = fault_switch.note_functions(run.fault) if run.notes else set()
        if run.fault is not None and not run.notes:
            fault_switch.switch_on(run.fault)
    except ValueError as refusal:
        seen.refused = f"{refusal}"
        return seen
    arguments = ["-q", "-n", "0", "-o", f"cache_dir={cache}", "-o", "addopts=--strict-markers", run.only or run.file]
    # Plugins of pytest have been imported already.
    arguments += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]
    arguments += ["-x", *["--all", "-m", "slow"] * run.slow]
    arguments += [f"--deselect={test}" for test in run.without]
    began, watch = time.perf_counter(), _Watch()
    code = pytest.main(arguments, plugins=[watch])
    seen.seconds, seen.failed = round(time.perf_counter() - began, 1), watch.failed
    seen.functions = sorted(functions)
    if code not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED, pytest.ExitCode.NO_TESTS_COLLECTED):
        seen.died = None if watch.failed else f"pytest ended with {code}"
    return seen


class _Watch:
    """A plugin of pytest: the tests that fail, with the last line of what they say."""

    def __init__(self):
        self.failed: dict[str, str] = {}

    def pytest_runtest_logreport(self, report: Any) -> None:
        self._note(report)

    def pytest_collectreport(self, report: Any) -> None:
        self._note(report)

    def _note(self, report: Any) -> None:
        if report.failed and report.nodeid not in self.failed:
            crash = getattr(report.longrepr, "reprcrash", None)
            lines = (crash.message if crash else str(report.longrepr)).strip().splitlines()
            self.failed[report.nodeid] = re.sub(r"\s+", " ", " ".join(lines[:3]))[:160]


class Fork:
    """A run in a child process, which ends by itself or at the limit."""

    def __init__(self, run: Run, cache: Path, limit: float):
        self.run = run
        self._out = tempfile.NamedTemporaryFile("w+", suffix=".json")  # noqa: SIM115
        self._end, self._limit = time.monotonic() + limit, limit
        sys.stdout.flush()
        self.pid = os.fork()
        if not self.pid:
            self._child(cache)

    def _child(self, cache: Path) -> None:
        """Never returns."""
        try:
            os.setpgid(0, 0)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            log = cache / "seeded_faults" / f"{os.getpid()}.log"
            opened = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
            os.dup2(opened, 1)
            os.dup2(opened, 2)
            seen = execute(self.run, cache)
            Path(self._out.name).write_text(json.dumps(asdict(seen)))
            log.unlink()
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(0)

    def seen(self) -> Seen | None:
        """What it saw; None while it runs."""
        ended, status = os.waitpid(self.pid, os.WNOHANG)
        if not ended and time.monotonic() < self._end:
            return None
        if not ended:
            self.end()
            return Seen(died=f"longer than {self._limit:g} s", seconds=self._limit)
        text = Path(self._out.name).read_text()
        if text and not status:
            return Seen(**json.loads(text))
        return Seen(died=f"status {status}" if status else "an error of the runner, in a log beside the records")

    def end(self) -> None:
        """Ends it and the processes that it started."""
        for call in (lambda: os.killpg(self.pid, signal.SIGKILL), lambda: os.waitpid(self.pid, 0)):
            with contextlib.suppress(ProcessLookupError, ChildProcessError):
                call()


def in_turns(searches: Iterator[Generator[Run, Seen, Outcome]], jobs: int, start: Callable[[Run], Fork]):
    """Advances so many searches side by side, and yields their outcomes."""
    going: list[tuple[Generator[Run, Seen, Outcome], Fork]] = []
    try:
        while True:
            while len(going) < jobs and (search := next(searches, None)) is not None:
                yield from _advance(search, None, going, start)
            if not going:
                return
            time.sleep(0.05)
            for item in list(going):
                seen = item[1].seen()
                if seen is not None:
                    going.remove(item)
                    yield from _advance(item[0], seen, going, start)
    finally:
        for _, fork in going:
            fork.end()


def _advance(search: Generator[Run, Seen, Outcome], seen: Seen | None, going: list, start: Callable[[Run], Fork]):
    try:
        going.append((search, start(search.send(seen) if seen else next(search))))
    except StopIteration as end:
        yield end.value


def holds(outcome: Outcome, options: Any) -> bool:
    """Whether an earlier outcome is what this call asks for."""
    if outcome.module != _digest(PACKAGE / outcome.file) or outcome.refused or not outcome.finished:
        return False
    if outcome.noticed_by:
        return all(map(_exists, outcome.noticed_by)) and (outcome.all_files or not options.all_files)
    return not options.retry and (outcome.slow or not options.slow)


def _exists(test: str) -> bool:
    """Whether the file of a test still has its function."""
    file, _, name = test.partition("::")
    return (ROOT / file).exists() and name.split("::")[-1].split("[")[0] in (ROOT / file).read_text()


def read_table() -> dict[Fault, Outcome]:
    kept = json.loads(TABLE.read_text())["outcomes"] if TABLE.exists() else []
    outcomes = [Outcome(**entry) for entry in kept]
    return {Fault(item.file, item.code, item.wrong): item for item in outcomes}


def write_table(outcomes: dict[Fault, Outcome]) -> None:
    """In the order of the faults, without those that are no longer among them."""
    note = "An outcome holds while the fault, its module (whose digest stands here) and its tests are the same."
    usual = asdict(Outcome("", "", "", ""))
    said = lambda outcome: {name: value for name, value in asdict(outcome).items() if value != usual[name]}
    _write(TABLE, {"note": note, "outcomes": [said(outcomes[fault]) for fault in FAULTS if fault in outcomes]})


def prepare() -> None:
    """Import everything, let programs compile as with `-n`, and see that nothing was computed."""
    sys.path.insert(0, str(ROOT / "tests/support"))
    from compiling import compile_for_tests

    compile_for_tests()
    fault_switch.prepare()
    if jax._src.xla_bridge._backends:  # pyright: ignore[reportAttributeAccessIssue]
        raise RuntimeError("an import of the package has computed something: forks of this process would not work")


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*", help="faults whose file or code contains one of them")
    parser.add_argument("--jobs", type=int, default=2, help="processes side by side")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="start no fault after so many")
    parser.add_argument("--patience", type=float, default=float("inf"), help="go on after so many minutes of a fault")
    parser.add_argument("--limit", type=float, default=LIMIT, help="most seconds of one file's tests")
    parser.add_argument("--slow", action="store_true", help="slow tests as well, if no short one notices")
    parser.add_argument("--all-files", action="store_true", help="every file that notices, not the first alone")
    parser.add_argument("--tests", action="append", help="a file or folder of tests, all by default")
    parser.add_argument("--retry", action="store_true", help="faults again that were not noticed")
    parser.add_argument("--renew", action="store_true", help="find out again what each file calls")
    parser.add_argument("--cache", type=Path, default=ROOT / ".pytest_cache", help="pytest's cache folder")
    return parser.parse_args()


def main() -> int:
    options = arguments()
    # Whoever ends this process ends its forks.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    os.chdir(ROOT)
    prepare()
    records = Records(options.cache / "seeded_faults")
    if options.renew:
        records.forget()
    keeps = not options.tests
    outcomes, began = read_table() if keeps else {}, time.monotonic()
    chosen = [f for f in FAULTS if not options.words or any(word in str(f) for word in options.words)]

    def searches():
        for fault in chosen:
            before = outcomes.get(fault)
            if before is not None and holds(before, options):
                continue
            if time.monotonic() - began > 60 * options.minutes:
                return
            yield search(fault, before, records, options)

    for outcome in in_turns(searches(), options.jobs, lambda run: Fork(run, options.cache, options.limit)):
        fault = Fault(outcome.file, outcome.code, outcome.wrong)
        outcomes[fault] = outcome
        if keeps:
            write_table(outcomes)
        print(f"{fault}: {outcome.word()} ({outcome.seconds:.0f} s)", flush=True)
    return show(chosen, outcomes)


def show(chosen: list[Fault], outcomes: dict[Fault, Outcome]) -> int:
    """Print the table; 1 if a fault is not noticed."""
    for fault in chosen:
        print(f"{fault}\n    {outcomes[fault].word() if fault in outcomes else 'not tried yet'}")
    tried = [outcomes[fault] for fault in chosen if fault in outcomes and outcomes[fault].finished]
    noticed = sum(bool(outcome.noticed_by) for outcome in tried)
    print(f"{len(chosen)} faults, {noticed} noticed, {len(tried) - noticed} not, {len(chosen) - len(tried)} open")
    return int(noticed < len(tried))


if __name__ == "__main__":
    sys.exit(main())
