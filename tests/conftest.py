import collections
import gc
import json
import os
import shutil
from pathlib import Path

import equinox as eqx
import jax
import pytest
from compiling import compile_for_tests

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# A test that took longer runs with `--all` only [s].
LONG = 2.5
# How long tests took [s], by their ids, but for quick ones; null where one is long and has not been timed yet.
DURATIONS = Path(__file__).parent / "durations.json"
KEPT = 0.5
# Where Linux lists the memory maps of this process, and with how many of them compiled programs are given back.
MAPS, MOST_MAPS = Path("/proc/self/maps"), 30_000


def pytest_addoption(parser):
    parser.addoption("--all", action="store_true", help="run the long tests as well, some of them as users compile")
    record = "write into durations.json how long the tests of this run took, with all programs compiled anew"
    parser.addoption("--record-durations", action="store_true", help=record)


def pytest_collection_modifyitems(config, items):
    """Leave out long tests without `--all`: those marked so, and those that took long when they were timed."""
    if config.getoption("--all"):
        return
    recorded = json.loads(DURATIONS.read_text())

    def is_long(item):
        seconds = recorded.get(item.nodeid, 0.0)
        took_long = seconds is None or seconds > LONG
        return item.get_closest_marker("long") or (took_long and not item.get_closest_marker("always"))

    left_out = [item for item in items if is_long(item)]
    config.hook.pytest_deselected(items=left_out)
    items[:] = [item for item in items if not is_long(item)]


class Stopwatch:
    """Durations of the tests of this run, in the process that sees the reports of all workers."""

    def __init__(self):
        self.seconds = collections.Counter()
        self.not_passed = set()

    def pytest_runtest_logreport(self, report):
        self.seconds[report.nodeid] += report.duration
        if not report.passed:
            self.not_passed.add(report.nodeid)

    def pytest_sessionfinish(self):
        """Those of other tests stay, and so do those of tests that failed or were skipped."""
        recorded = json.loads(DURATIONS.read_text())
        for name in self.seconds.keys() - self.not_passed:
            recorded.pop(name, None)
            if self.seconds[name] > KEPT:
                recorded[name] = round(self.seconds[name], 1)
        DURATIONS.write_text(json.dumps(dict(sorted(recorded.items())), indent=1, ensure_ascii=False) + "\n")


def pytest_configure(config):
    """Let all modules, workers and notebooks, and the next run, share the programs that take long to compile.

    A test that runs alone has the programs that users have.
    """
    if config.getoption("numprocesses", default=None):
        compile_for_tests()
    programs = config.cache.mkdir("programs")
    if config.getoption("--record-durations") and not hasattr(config, "workerinput"):
        config.pluginmanager.register(Stopwatch())
        shutil.rmtree(programs)
    # Tracing makes and drops many objects, few of them in cycles: to collect as often as usual takes a tenth of it.
    gc.set_threshold(100_000, 20, 20)
    settings = {
        "jax_compilation_cache_dir": str(programs),
        "jax_persistent_cache_min_compile_time_secs": 1.0,
        # With a bound on its size the cache is locked while it is written.
        "jax_compilation_cache_max_size": 2**30,
        # Where in the source each instruction comes from, which is a tenth of the time to lower and compile.
        "jax_traceback_in_locations_limit": 0,
    }
    for name, value in settings.items():
        jax.config.update(name, value)
        os.environ[name.upper()] = str(value)


@pytest.fixture(autouse=True, scope="module")
def _forget_programs():
    """Give back the memory maps of a module's compiled programs: a process may have 65530 of them and no more."""
    yield
    _clear_caches()


@pytest.fixture(autouse=True)
def _forget_many_programs():
    """The same within a module whose programs have many of them."""
    yield
    if MAPS.exists() and MAPS.read_bytes().count(b"\n") > MOST_MAPS:
        _clear_caches()


def _clear_caches():
    eqx.clear_caches()
    jax.clear_caches()
