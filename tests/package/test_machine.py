"""The number of threads, by the environment: as XLA reads it."""

import os
import subprocess
import sys

import pytest

from jaxmb._machine import cores, limit_of_threads, threads

GIVEN = {"": None, "auto": None, "2.5": None, "1e1": None, "99999999999": None, "²": None}
GIVEN |= {"0": 1, "-1": 1, " 4 ": 4, "+3": 3, "007": 7, "1": 1}
# The threads of XLA have this name.
COUNTING = """
import os, jax
jax.numpy.ones(3).block_until_ready()
names = [open(f"/proc/self/task/{task}/comm").read().strip() for task in os.listdir("/proc/self/task")]
print(names.count("tf_XLAEigen"))
"""


def test_a_number_of_threads_or_all_cores(monkeypatch):
    for given, limit in GIVEN.items():
        monkeypatch.delenv("PJRT_NPROC", raising=False)
        monkeypatch.setenv("NPROC", given)
        assert limit_of_threads() == limit and threads() == (limit or cores())
        monkeypatch.setenv("PJRT_NPROC", "5")
        assert threads() == 5
        monkeypatch.setenv("PJRT_NPROC", "auto")
        assert limit_of_threads() == limit


@pytest.mark.slow
@pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="Threads are counted where the system lists them.")
@pytest.mark.parametrize("given", ["", "1e1", "0", "+3", "²"])
def test_xla_takes_as_many(given):
    own = {name: value for name, value in os.environ.items() if name != "PJRT_NPROC"} | {"NPROC": given}
    run = subprocess.run([sys.executable, "-c", COUNTING], env=own, capture_output=True, text=True, check=True)
    assert int(run.stdout) == (GIVEN[given] or cores())
