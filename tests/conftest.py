import gc
import os
from pathlib import Path

import equinox as eqx
import jax
import pytest
from compiling import compile_quickly

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")


def pytest_addoption(parser):
    parser.addoption("--all", action="store_true", help="run the long tests as well, some of them as users compile")


def pytest_collection_modifyitems(config, items):
    """Leave out long tests without `--all`: those marked so, and those listed by their measured time in `long.txt`."""
    if config.getoption("--all"):
        return
    listed = set((Path(__file__).parent / "long.txt").read_text().splitlines())
    is_long = lambda item: item.get_closest_marker("long") or {item.nodeid, item.nodeid.split("[")[0]} & listed
    left_out = [item for item in items if is_long(item)]
    config.hook.pytest_deselected(items=left_out)
    items[:] = [item for item in items if not is_long(item)]


def pytest_configure(config):
    """Let all modules, workers and notebooks, and the next run, share the programs that take long to compile.

    A test that runs alone has the programs that users have.
    """
    if config.getoption("numprocesses", default=None):
        compile_quickly()
    # Tracing makes and drops many objects, few of them in cycles: to collect as often as usual takes a tenth of it.
    gc.set_threshold(100_000, 20, 20)
    settings = {
        "jax_compilation_cache_dir": str(config.cache.mkdir("programs")),
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
    eqx.clear_caches()
    jax.clear_caches()
