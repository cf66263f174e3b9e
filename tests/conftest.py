import collections
import gc
import os
from pathlib import Path

import equinox as eqx
import jax
import pytest
from compiling import compile_for_tests
from slow_marks import case_of, is_slow

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# The programs that the short tests of a file may compile, eager operations too, unless it states its `MOST_PROGRAMS`.
MOST_PROGRAMS = 60
# Where Linux lists the memory maps of this process, and with how many of them traced and compiled programs are given
# back after a file and after a test: a process may have 65530. Until then files share programs, which saves a sixth of
# the processor seconds.
MAPS, MANY_MAPS, MOST_MAPS = Path("/proc/self/maps"), 10_000, 30_000


def pytest_addoption(parser):
    parser.addoption("--all", action="store_true", help="run slow tests as well, some of them as users compile")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Leave out slow tests without `--all`."""
    if not any("::" in argument for argument in config.args):
        check_cases(items)
    if not config.getoption("--all"):
        config.hook.pytest_deselected(items=[item for item in items if is_slow(item)])
        items[:] = [item for item in items if not is_slow(item)]


def check_cases(items):
    """Refuse a mark with a case that its test does not have."""
    cases = collections.defaultdict(set)
    for item in items:
        cases[item.nodeid.split("[")[0]].add(case_of(item))
    for item in items:
        for mark in item.iter_markers("slow"):
            unknown = {*mark.args, *mark.kwargs.get("but", ())} - cases[item.nodeid.split("[")[0]]
            if unknown:
                raise pytest.UsageError(f"{item.nodeid}: slow names cases that do not exist, {sorted(unknown)}")


def pytest_configure(config):
    """Let all modules, workers and notebooks, and the next run, share the programs that take long to compile.

    A test that runs alone has the programs that users have.
    """
    if config.getoption("numprocesses", default=None):
        compile_for_tests()
    programs = config.cache.mkdir("programs")
    # Tracing makes and drops many objects, few of them in cycles: to collect as often as usual takes a tenth of it.
    gc.set_threshold(200_000, 50, 50)
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
def _few_programs(request):
    """Fail a file whose short tests compile more programs than it states: most of the tests' time is compiling."""
    before, most = _compiled["programs"], getattr(request.module, "MOST_PROGRAMS", MOST_PROGRAMS)
    yield
    count = _compiled["programs"] - before
    if not request.config.getoption("--all"):
        assert count <= most, f"{request.module.__name__} compiles {count} programs, and may compile {most}"


def _note_compilation(event, seconds, **details):
    del seconds, details
    _compiled["programs"] += event == "/jax/core/compile/backend_compile_duration"


_compiled = collections.Counter()
jax.monitoring.register_event_duration_secs_listener(_note_compilation)


@pytest.fixture(autouse=True, scope="module")
def _forget_programs_of_files():
    yield
    _forget_programs(MANY_MAPS)


@pytest.fixture(autouse=True)
def _forget_programs_of_tests():
    yield
    _forget_programs(MOST_MAPS)


def _forget_programs(most):
    """Give back the memory maps of compiled programs."""
    if MAPS.exists() and MAPS.read_bytes().count(b"\n") > most:
        eqx.clear_caches()
        jax.clear_caches()
