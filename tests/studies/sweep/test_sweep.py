"""Sweeps of small functions: outputs, status, stores, refusals; killed and damaged ones."""

import json
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import threading
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sweeping
import xarray as xr
from sweeping import CASES, CHUNKS, files, forked, marks, run, spring, wait_for

import jaxmb as mb
from jaxmb.cli import main
from jaxmb.studies.sweep import store as stores
from jaxmb.studies.sweep.chunk import Work


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    store = tmp_path_factory.mktemp("sweep") / "runs.zarr"
    return store, run(store)


def test_outputs_of_any_shape_over_a_grid(tmp_path):
    def function(a, p):
        return {
            "x": a * p,
            "y": {"m": jnp.outer(p, p) * a, "n": jnp.int32(2)},
            "z": a > 1.0,
            "w": jax.lax.complex(a, p[0]),
        }

    cases = mb.cases.grid(a=[1.0, 2.0, 3.0], p=[[1.0, 2.0], [3.0, 4.0]])
    options = {"dims": {"x": ["axis"]}, "coords": {"axis": [7, 8]}, "units": {"a": "m", "x": "N", "axis": "s"}}
    found = mb.sweep(function, cases, chunk=4, progress=False, **options)
    assert found["x"].dims == ("a", "p_index", "axis") and found["y.m"].dims == ("a", "p_index", "y.m_0", "y.m_1")
    for i, a in enumerate([1.0, 2.0, 3.0]):
        for j, p in enumerate(np.array([[1.0, 2.0], [3.0, 4.0]])):
            np.testing.assert_array_equal(found["x"][i, j], a * p)
            np.testing.assert_array_equal(found["y.m"][i, j], a * np.outer(p, p))
            np.testing.assert_array_equal(found["w"][i, j], a + 1j * p[0])
            assert found["z"][i, j] == (a > 1) and found["y.n"][i, j] == 2
    assert found["x"].attrs == {"units": "N"} and found["a"].attrs == {"units": "m"} and found["p"].shape == (2, 2)
    assert np.all(found["status"] == 1) and np.all(found["message"] == "")
    kept = mb.sweep(function, cases, tmp_path / "s", chunk=4, progress=False, **options)
    xr.testing.assert_identical(kept, found)


@pytest.mark.slow
def test_a_plain_reader_opens_the_store(undisturbed):
    store, found = undisturbed
    plain = xr.open_zarr(store, chunks=None)
    np.testing.assert_array_equal(plain["wave"], found["wave"])
    assert set(plain.coords) == {"a", "b"} and plain["status"].attrs["flag_meanings"].split()[1] == "ok"
    assert (
        plain.attrs["x64"] == "True" and plain.attrs["chunk"] == sweeping.CHUNK and len(plain.attrs["function"]) == 64
    )
    assert json.loads((store / "wave" / "zarr.json").read_text())["zarr_format"] == 3


def test_values_equal_a_bare_vmap_and_failures_cost_nothing_to_others(undisturbed):
    _, found = undisturbed
    bare = jax.jit(jax.vmap(spring))(jnp.asarray(CASES.columns["a"]), jnp.asarray(CASES.columns["b"]))
    np.testing.assert_allclose(found["wave"], bare["wave"], rtol=1e-14, atol=1e-15)
    np.testing.assert_array_equal(found["status"], np.where(CASES.columns["a"] < 1.5, 2, 1))
    assert found["message"].to_numpy()[0] == "An output is not finite." and found["more.count"].dtype == np.int32


@pytest.fixture
def copied(undisturbed, tmp_path):
    return shutil.copytree(undisturbed[0], tmp_path / "runs.zarr")


@pytest.mark.slow
def test_a_sweep_that_is_done_computes_nothing_and_one_that_is_not_what_is_missing(undisturbed, copied, monkeypatch):
    before, computed, own = files(copied), [], Work.__call__
    counted = lambda work, task, tell: (computed.append(task.place), own(work, task, tell))[1]
    monkeypatch.setattr(Work, "__call__", counted)
    xr.testing.assert_identical(run(copied).load(), undisturbed[1].load())
    assert computed == []
    # A chunk that lacks its mark, and a leftover of a killed writer.
    (copied / "status" / "c" / "9").unlink()
    (copied / "status" / "c" / "9.0123.partial").write_bytes(b"half")
    run(copied)
    assert computed == [9] and files(copied) == before


def test_a_store_can_be_read_while_it_is_written(copied):
    for place in ("status/c/4", "wave/c/4/0", "more.count/c/4", "more.square/c/4"):
        (copied / place).unlink()
    found = mb.load_sweep(copied)
    assert np.all(found["status"][40:50] == 0) and np.all(np.isnan(found["wave"][40:50]))
    assert np.all(found["message"][40:50] == "Not computed yet.") and np.all(found["status"][50:] != 0)


def _flip(file):
    flipped = bytearray(file.read_bytes())
    flipped[20] ^= 4
    file.write_bytes(flipped)


ALONE = r"without the file status/c/7 these alone are computed again.*overwrite=True"


DAMAGED = [
    # What is done to a store, the message, and whether both readers see it; what is not looked at shows later.
    (lambda s: (s / "wave/c/7/0").unlink(), f"there is no 'wave' of the members 70 to 79 .*{ALONE}", True),
    (lambda s: _flip(s / "wave/c/7/0"), f"'wave' of the members 70 to 79 .*{ALONE}", False),
    (lambda s: shutil.rmtree(s / "more.square"), "there is no 'more.square' of the members 0 to 9", True),
    (lambda s: shutil.rmtree(s / "a" / "c"), "there is no 'a'.*overwrite=True", True),
    (lambda s: _flip(s / "status/c/7"), "checksum.*overwrite=True", True),
]


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(DAMAGED)))
def test_files_that_are_lost_or_damaged_are_an_error(undisturbed, copied, number):
    change, message, in_both = DAMAGED[number]
    change(copied)
    for read in (run, mb.load_sweep) if in_both else (run,):
        with pytest.raises(ValueError, match=f"The store .*runs.zarr is damaged: .*{message}"):
            read(copied)
    (copied / "status/c/7").unlink()
    run(copied, overwrite="alone" not in message)
    assert files(copied) == files(undisturbed[0])


@pytest.mark.parametrize("name", ["xarray", "zarr"])
def test_a_package_that_is_not_installed_is_named(copied, monkeypatch, name):
    monkeypatch.setitem(sys.modules, name, None)
    for read in (run, mb.load_sweep):
        with pytest.raises(ImportError, match=rf"A sweep needs the package '{name}': pip install jaxmb\[studies\]"):
            read(copied)


def _of(name, **changes):
    return lambda data: data["consolidated_metadata"]["metadata"][name].update(changes)


def test_metadata_that_were_changed_are_an_error_that_names_the_store(copied):
    whole = (copied / "zarr.json").read_text()
    for change, message in (
        (lambda data: data.pop("attributes"), r"zarr.json cannot be used \(KeyError"),
        (lambda data: data["attributes"].update(chunk="ten"), "chunk is 'ten'"),
        (lambda data: data["attributes"].update(grid="["), "overwrite=True"),
        (_of("wave", shape=[3, 4]), "overwrite=True"),
        (_of("wave", codecs=[]), "overwrite=True"),
        (_of("status", attributes={}), "overwrite=True"),
        (lambda data: data["consolidated_metadata"]["metadata"].pop("status"), "overwrite=True"),
    ):
        data = json.loads(whole)
        change(data)
        (copied / "zarr.json").write_text(json.dumps(data))
        with pytest.raises(ValueError, match=f"The store .*runs.zarr is damaged: .*{message}"):
            mb.load_sweep(copied)
    (copied / "zarr.json").write_text("{")
    for read in (mb.load_sweep, run):
        with pytest.raises(ValueError, match=r"damaged: zarr\.json cannot be used"):
            read(copied)


def test_a_second_sweep_does_not_write_a_store_at_the_same_time(tmp_path):
    """Neither one that is there, nor one that another process has made between the look and the rename."""
    store, cases, refused = tmp_path / "runs.zarr", mb.cases.table(a=[1.0, 2.0]), []
    function = lambda a: {"x": 2 * a}

    class Both(ThreadPoolExecutor):
        """Starts the same sweep once more while the first one computes."""

        def submit(self, *args, **kwargs):
            for overwrite in (False, True):
                with pytest.raises(RuntimeError, match=r"Another process is writing the store .*the same call goes on"):
                    mb.sweep(function, cases, store, overwrite=overwrite, progress=False)
                refused.append(overwrite)
            return super().submit(*args, **kwargs)

    with Both(1) as executor:
        found = mb.sweep(function, cases, store, executor=executor, progress=False)
    np.testing.assert_array_equal(found["x"], [2.0, 4.0])
    assert refused == [False, True] and mb.sweep(function, cases, store, progress=False).identical(found)
    before = files(store)
    with pytest.raises(RuntimeError, match="Another process is writing the store"):
        stores.create(store, {}, {}, 2)
    assert files(store) == before and [p.name for p in tmp_path.iterdir()] == ["runs.zarr"]


def test_the_store_of_another_study_is_refused(copied, tmp_path):
    store, before = copied, files(copied)
    factor = 2.0
    other = lambda a, b: {"wave": a * b * factor}
    with pytest.raises(ValueError, match=r"another sweep: it differs in the function and outputs.*overwrite=True"):
        mb.sweep(other, CASES, store, progress=False)
    with pytest.raises(ValueError, match="differs in the cases"):
        mb.sweep(spring, mb.cases.table(a=[1.0], b=[2.0]), store, progress=False)
    with pytest.raises(ValueError, match="begun with chunk=10, got 20"):
        mb.sweep(spring, CASES, store, chunk=20, progress=False)
    assert files(store) == before
    cases = mb.cases.table(a=[1.0], b=[2.0])
    assert mb.sweep(other, cases, store, overwrite=True, progress=False)["wave"].item() == 4.0
    # A number that the function refers to is a part of the study.
    factor = 3.0
    with pytest.raises(ValueError, match=r"differs in the function\."):
        mb.sweep(other, cases, store, progress=False)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("x")
    for overwrite in (False, True):
        with pytest.raises(ValueError, match="holds no sweep"):
            mb.sweep(other, cases, tmp_path / "mine", overwrite=overwrite, progress=False)
    assert (tmp_path / "mine" / "thesis.txt").exists()


def _counting():
    calls = []

    def function(a):
        calls.append(0)
        return {f"x{len(calls)}": a}

    return function


def _random():
    generator = np.random.default_rng(0)
    return lambda a: {"x": a + generator.standard_normal()}


REFUSED = [
    (lambda a: a, {}, "must return a dictionary of outputs by name, got"),
    (lambda a: {}, {}, "no outputs"),
    (lambda a: {"x": "word"}, {}, "'x' must be an array of numbers, got 'word'"),
    (lambda a: {"x": {"y": (a, a)}}, {}, "'x.y' must be an array"),
    (lambda a: {"a": a}, {}, "cannot have the name 'a'"),
    (lambda a: {"x": a, "result": 3}, {}, "'result' must be a trajectory"),
    (lambda alpha: {"x": alpha}, {}, "The cases: Unknown argument of the function 'a'"),
    (lambda a, b: {"x": a}, {}, "needs the parameter 'b'"),
    (_counting(), {}, "not pure.*names, shapes or types of 'x1', 'x2'"),
    (_random(), {}, "not pure: traced twice, it has other numbers"),
    (lambda a: {"x": a + jnp.zeros((2,)) + jnp.zeros((3,))}, {}, "shapes"),
    (
        lambda a: {"x": a if a > 0 else -a},
        {},
        r"test_sweep.py:\d+: `.*if a > 0.*` needs a parameter as a number.*jnp",
    ),
    (lambda a: {"x": np.sin(a)}, {}, r"`.*np.sin\(a\).*` needs a parameter as a number, and .* is traced by JAX"),
    (lambda a: {"x": jnp.arange(int(a))}, {}, r"`.*int\(a\).*` needs a parameter as a number"),
    (lambda a: {"x": a}, {"dims": {"y": []}}, "Unknown output in dims 'y'"),
    (lambda a: {"x": a}, {"dims": {"x": ["t"]}}, "must be a list of 0 names"),
    (lambda a: {"x": a * jnp.ones(2)}, {"dims": {"x": ["a"]}}, "'a' of 'x' has the name of something else"),
    (lambda a: {"x": a * jnp.ones((2, 3))}, {"dims": {"x": ["t", "t"]}}, "length 2, but in 'x' 3"),
    (lambda a: {"x": a * jnp.ones(2)}, {"dims": {"x": ["time"]}, "coords": {"tim": [1]}}, "mean 'time'"),
    (lambda a: {"x": a * jnp.ones(2)}, {"dims": {"x": ["t"]}, "coords": {"t": [1]}}, "must be 2 numbers"),
    (lambda a: {"x": a}, {"units": {"y": "m"}}, "Unknown name in units 'y'"),
    (lambda a: {"x": a}, {"units": "m"}, "units must be a dictionary"),
    (lambda a: {"x": a}, {"chunk": 0}, "chunk must be"),
    (lambda a: {"x": a}, {"processes": 0}, "processes must be"),
    (lambda a: {"x": a}, {"executor": 3}, "executor must be a concurrent"),
    (lambda a: {"x": a}, {"executor": ThreadPoolExecutor(1), "processes": 2}, "Give either processes or an"),
    (lambda a: {"x": a}, {"devices": 2}, "no argument 'devices' any more: give executor="),
    (lambda a: {"x": a}, {"budget": 5}, "no argument 'budget' any more: leave it out"),
]


def test_what_sweep_refuses():
    for function, options, message in REFUSED:
        with pytest.raises((ValueError, TypeError), match=message):
            mb.sweep(function, mb.cases.table(a=[1.0, 2.0]), progress=False, **options)


class _Solution:
    def __init__(self, result, stats):
        self.result, self.stats = result, stats


def words_of(found):
    return list(np.array(found["status"].attrs["flag_meanings"].split())[found["status"]])


def test_times_after_the_last_event_are_no_failure():
    def function(a):
        result = diffrax.RESULTS.where(a < 3, diffrax.RESULTS.successful, diffrax.RESULTS.singular)
        times = jnp.where(a > 1, jnp.array([0.1, jnp.inf]), jnp.inf).at[0].multiply(jnp.where(a == 2, jnp.nan, 1.0))
        return {"times": times, "result": _Solution(result, {"num_steps": 1})}

    found = mb.sweep(function, mb.cases.table(a=[0.0, 1.5, 2.0, 3.0]), progress=False)
    assert words_of(found) == ["ok", "ok", "not_finite", "singular"]


def test_steps_and_their_limit_are_told():
    def function(n, max_steps=100):
        """As a simulation of n steps."""
        taken = jax.lax.while_loop(lambda k: k < jnp.minimum(n, max_steps), lambda k: k + 1, 0)
        result = diffrax.RESULTS.where(n > max_steps, diffrax.RESULTS.max_steps_reached, diffrax.RESULTS.successful)
        return {"twice": 2 * n, "result": _Solution(result, {"num_steps": taken})}

    found = mb.sweep(function, mb.cases.table(n=[10, 100, 300]), progress=False)
    assert words_of(found) == ["ok", "ok", "max_steps_reached"] and list(found["num_steps"]) == [10, 100, 100]
    assert "maximum number of solver steps" in str(found["message"][2].item())


@pytest.mark.slow
def test_motions_that_fail_have_a_status():
    mechanism = mb.mechanisms.get("pendulum")
    name = next(name for name in mb.parameters(mechanism.system) if name.endswith("mass"))

    def motion(mass):
        system = mb.with_parameters(mechanism.system, {name: mass})
        sol = mb.simulate(system, mechanism.state, t1=0.1, rtol=1e-5, throw=False)
        return {"q": sol.ys.q[-1], "result": sol}

    found = mb.sweep(motion, mb.cases.table(mass=[1.0, -1.0, 2.0]), progress=False)
    assert words_of(found) == ["ok", "invalid_parameters", "ok"]
    assert "not in the range that its part asks for" in str(found["message"][1].item())
    assert np.all(np.isnan(found["q"][1])) and np.all(found["num_steps"][::2] > 0)
    np.testing.assert_allclose(found["q"][0], found["q"][2], rtol=1e-12)


def test_an_interruption_keeps_what_is_done(undisturbed, tmp_path, monkeypatch):
    store, own = tmp_path / "runs.zarr", Work.__call__

    def interrupted(work, task, tell):
        if task.place == 5:
            raise KeyboardInterrupt
        return own(work, task, tell)

    with monkeypatch.context() as patch:
        patch.setattr(Work, "__call__", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run(store)
    assert marks(store) == 5
    run(store)
    assert files(store) == files(undisturbed[0])


def halved(a, b):
    """A loop of several steps, so that members are computed in blocks."""
    x = jax.lax.while_loop(lambda x: x > 1.0, lambda x: 0.5 * x, a)
    return {"x": jnp.where(a > 6.0, jnp.nan, x * b)}


def test_blocks_of_a_chunk_take_turns_on_all_cores(monkeypatch, capsys):
    """Two blocks are computed at a time, with the same bits as one after the other."""
    cases = mb.cases.grid(a=np.linspace(1.5, 7.0, 12), b=[1.0, 3.0])
    own = Work._computed
    monkeypatch.setattr("jaxmb.studies.batch._MOST", 4)
    together = threading.Barrier(2)

    def both(program, block):
        together.wait(timeout=60)
        return own(program, block)

    with monkeypatch.context() as patch:
        patch.setenv("NPROC", "2")
        patch.setattr(Work, "_computed", both)
        found = mb.sweep(halved, cases)
    shown = capsys.readouterr().err.strip().split("\r")[-1]
    assert "24/24" in shown and f"{int(np.sum(found.status != 1))} failed" in shown
    xr.testing.assert_identical(found, mb.sweep(halved, cases, progress=False))


def test_a_sweep_is_interrupted_between_blocks(monkeypatch):
    """Blocks that have not begun are not computed then."""
    computed, own = [], Work._computed
    monkeypatch.setattr("jaxmb.studies.batch._MOST", 4)

    def interrupted(program, block):
        computed.append(block)
        if len(computed) == 2:
            raise KeyboardInterrupt
        if len(computed) > 2:
            time.sleep(0.2)  # On a busy machine the main thread hears of the interruption only then.
        return own(program, block)

    monkeypatch.setenv("NPROC", "1")
    monkeypatch.setattr(Work, "_computed", interrupted)
    with pytest.raises(KeyboardInterrupt):
        mb.sweep(halved, mb.cases.grid(a=np.linspace(1.5, 7.0, 40), b=[1.0, 3.0]), progress=False)
    assert len(computed) < 5


def test_progress_tells_of_compiling_the_time_left_and_failures(capsys):
    mb.sweep(lambda a: {"x": jnp.sqrt(a)}, mb.cases.table(a=[-1.0, 1.0]))
    shown = capsys.readouterr().err.strip()
    first, *_, last = shown.split("\r")
    assert first.startswith("compiling:   0%") and "0/2" in first and "\n" not in shown
    assert last.startswith("100%") and "2/2" in last and "00:00" in last and "1 failed" in last


def test_the_command_line(capsys, tmp_path):
    file = tmp_path / "study.py"
    file.write_text(
        "import jax.numpy as jnp, numpy as np, jaxmb as mb\n"
        "def function(a, b):\n    return {'x': jnp.sqrt(a) * b}\n"
        "cases = mb.cases.grid(a=[-1.0, 4.0], b=np.arange(3.0))\nunits = {'x': 'm'}\n"
        "def bad(a, b):\n    return {'x': float(a)}\n"
    )
    words = ["sweep", str(file), "--out", str(tmp_path / "runs.zarr"), "--chunk", "2"]
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "6 members, 3 of them failed" in out and "3 not_finite: An output is not finite." in out
    found = mb.load_sweep(tmp_path / "runs.zarr")
    np.testing.assert_array_equal(found["x"].sel(a=4.0), [0.0, 2.0, 4.0])
    assert found["x"].attrs == {"units": "m"}
    for source, code, message in (
        ("study.py", 2, "There is no file"),
        (f"{file}:function", 2, "must be file.py or file.py:function:cases"),
        (f"{file}:functon:cases", 2, "did you mean 'function'"),
        (f"{file}:bad:cases", 2, "study.py:7: `return {'x': float(a)}` needs a parameter as a number"),
    ):
        assert main(["sweep", source, *words[2:]]) == code
        assert message in capsys.readouterr().err


def _with_small_disk(store):
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
    jax.config.update("jax_enable_x64", True)
    grow = lambda a: {"x": jnp.sin(a * jnp.arange(400.0) ** 2)}
    return mb.sweep(grow, mb.cases.table(a=np.arange(1.0, 21.0)), store, chunk=10, progress=False)


@pytest.mark.slow
def test_a_full_disk_is_a_clear_error(tmp_path):
    refused = pytest.raises(OSError, match=r"cannot be written.*The chunks that are done are kept")
    with ProcessPoolExecutor(1, mp_context=forked()) as processes, refused:
        processes.submit(_with_small_disk, tmp_path / "runs.zarr").result()
    assert not list((tmp_path / "runs.zarr").rglob("*.partial"))


@pytest.mark.slow
def test_killed_five_times_it_ends_with_the_same_bits(undisturbed, tmp_path):
    store, random = tmp_path / "runs.zarr", np.random.default_rng()
    done = []
    for count in np.sort(random.integers(1, CHUNKS - 5, 5)):
        process = forked().Process(target=run, args=(store,))
        process.start()
        wait_for(store, count)
        process.join(random.uniform(0.0, 0.005))
        process.kill()
        process.join()
        done.append(marks(store))
    assert done == sorted(done) and done[0] < CHUNKS
    run(store)
    assert files(store) == files(undisturbed[0])


@pytest.mark.slow
def test_workers_and_the_session_killed(undisturbed, tmp_path):
    """Workers die one after another, then the session with all of its workers; nothing stays behind."""
    store, killed = tmp_path / "runs.zarr", []

    def kill():
        for count in (5, 25, 45):
            wait_for(store, count)
            workers = [p for p in multiprocessing.active_children() if p.name.startswith("SpawnProcess")]
            os.kill(workers[0].pid, signal.SIGKILL)
            killed.append(workers[0].pid)

    thread = threading.Thread(target=kill)
    thread.start()
    run(store, processes=2)
    thread.join()
    assert len(killed) == 3 and files(store) == files(undisturbed[0])

    other = tmp_path / "other.zarr"
    session = forked().Process(target=run, args=(other,), kwargs={"processes": 2})
    session.start()
    wait_for(other, 3)
    with open(f"/proc/{session.pid}/task/{session.pid}/children") as children:
        workers = [int(pid) for pid in children.read().split()]
    session.kill()
    session.join()
    assert marks(other) < CHUNKS
    run(other)
    assert files(other) == files(undisturbed[0])
    assert not any(_runs(pid) for pid in workers)


def _runs(pid):
    try:
        with open(f"/proc/{pid}/stat") as stat:
            return stat.read().split(") ")[1][0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.slow
def test_a_lambda_and_a_closure_go_to_processes(tmp_path):
    factor = jnp.asarray(3.0)
    found = mb.sweep(lambda a: {"x": factor * a}, mb.cases.grid(a=[1.0, 2.0]), processes=2, chunk=1, progress=False)
    np.testing.assert_array_equal(found["x"], [3.0, 6.0])
    lock = threading.Lock()
    with pytest.raises(ValueError, match="cannot be sent to other processes"):
        mb.sweep(lambda a: {"x": a + float(lock.locked())}, mb.cases.grid(a=[1.0, 2.0]), processes=2, progress=False)
