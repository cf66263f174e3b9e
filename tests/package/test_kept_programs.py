"""The folder of compiled programs that processes share, without JAX."""

import os
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from jax._src.lru_cache import LRUCache

from jaxmb._kept_programs import KeptPrograms

HOUR = 3600.0


def aged(folder, key, seconds):
    """Let a program have been used so long ago."""
    for ending in ("-cache", "-atime"):
        os.utime(folder / f"{key}{ending}", (time.time() - seconds,) * 2)


def programs(folder):
    return {path.name.removesuffix("-cache") for path in folder.glob("*-cache")}


def test_programs_that_have_not_been_used_for_longest_are_dropped(tmp_path):
    store = KeptPrograms(str(tmp_path), max_size=3000)
    for age, key in enumerate("abc"):
        store.put(key, bytes(1000))
        aged(tmp_path, key, HOUR * (3 - age))
    assert store.get("a") == bytes(1000) and store.get("x") is None
    store.put("d", bytes(1500))
    assert programs(tmp_path) == {"a", "d"}
    assert {path.name for path in tmp_path.iterdir()} == {f"{key}{own}" for key in "ad" for own in ("-cache", "-atime")}
    store.put("larger", bytes(3001))
    assert programs(tmp_path) == {"a", "d"}


def test_the_size_is_looked_for_at_times(tmp_path):
    """After a 32nd of the bound, which the folder may exceed by as much; a new process looks at once."""
    store = KeptPrograms(str(tmp_path), max_size=3200)
    for k in range(40):
        store.put(f"{k}", bytes(100))
        assert 100 * len(programs(tmp_path)) <= 3300
    assert len(programs(tmp_path)) >= 32
    KeptPrograms(str(tmp_path), max_size=1000).put("more", bytes(10))
    assert len(programs(tmp_path)) == 10
    unbounded = KeptPrograms(str(tmp_path), max_size=-1)
    for k in range(40):
        unbounded.put(f"{k}", bytes(100))
    assert len(programs(tmp_path)) >= 40


def test_what_is_read_is_whole_whoever_writes_meanwhile(tmp_path):
    stores = [KeptPrograms(str(tmp_path), max_size=2**24) for _ in range(4)]
    values = {bytes([k]) * 2**20 for k in range(4)}

    def use(k):
        for _ in range(20):
            stores[k].put("program", bytes([k]) * 2**20)
            assert stores[k - 1].get("program") in values

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(use, range(4)))
    assert programs(tmp_path) == {"program"} and not list(tmp_path.glob("*.new"))


def test_a_program_that_could_not_be_read_is_replaced(tmp_path):
    (tmp_path / "program-cache").write_bytes(b"cut off")
    store = KeptPrograms(str(tmp_path), max_size=2**20)
    store.put("program", b"whole")
    assert store.get("program") == b"whole"


def test_what_a_process_that_died_was_writing_is_dropped(tmp_path):
    for name, age in (("old.new", 2 * HOUR), ("young.new", 0.0)):
        (tmp_path / name).write_bytes(bytes(10))
        os.utime(tmp_path / name, (time.time() - age,) * 2)
    KeptPrograms(str(tmp_path), max_size=2**20).put("program", b"")
    assert [path.name for path in tmp_path.glob("*.new")] == ["young.new"]


@pytest.mark.filterwarnings("error")
def test_a_folder_that_is_gone_is_one_warning(tmp_path):
    store = KeptPrograms(str(tmp_path / "folder"), max_size=2**20)
    (tmp_path / "folder").rmdir()
    with pytest.warns(UserWarning, match="compiled programs are not kept from now on: .*folder"):
        store.put("a", b"a")
    store.put("b", b"b")
    assert store.get("a") is store.get("b") is None


def test_jax_can_use_the_folder_as_well(tmp_path):
    """It drops those that were used before others."""
    own, of_jax = KeptPrograms(str(tmp_path), max_size=250), LRUCache(str(tmp_path), max_size=250)
    own.put("a", bytes(100))
    of_jax.put("b", bytes(100))
    assert own.get("b") == of_jax.get("a") == bytes(100)
    of_jax.put("c", bytes(100))
    assert programs(tmp_path) == {"a", "c"}
    aged(tmp_path, "c", HOUR)
    own.put("d", bytes(100))
    assert programs(tmp_path) == {"a", "d"}
