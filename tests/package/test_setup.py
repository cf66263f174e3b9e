"""The settings of JAX, how programs are compiled, and kept on disk, in processes of their own."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import filelock
import jax
import numpy as np
import pytest
from compiling import QUICKLY

import jaxmb as mb
from jaxmb import _setup
from jaxmb._compat import computes_on_processors, takes_option
from jaxmb._machine import cores

# Counts of the programs that JAX asked for, and of those that it found.
COUNTING = """
import collections, jax
counts = collections.Counter()
jax.monitoring.register_event_listener(lambda event, **_: counts.update([event.rsplit("/", 1)[-1]]))
import jax.numpy as jnp, jaxmb as mb
jax.config.update("jax_enable_x64", True)
KEEP = dict(compile=None)
"""
REPORT = """
print(dict(asked=counts["compile_requests_use_cache"], found=counts["cache_hits"], kept=counts["cache_misses"]))
"""


def process(code, **environment):
    """What a process prints: its last line as a Python value, and its warnings. JAX's own settings are left out."""
    own = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "JAXMB_", "XDG_CACHE"))}
    command = [sys.executable, "-c", COUNTING + code]
    run = subprocess.run(command, env=own | environment, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return ast.literal_eval(run.stdout.splitlines()[-1]), run.stderr


@pytest.fixture
def new_user(monkeypatch, tmp_path):
    """The home of somebody who has told JAX nothing; nothing is compiled meanwhile."""
    names = ("jax_compilation_cache_dir", "jax_enable_compilation_cache", *_setup.SETTINGS)
    before = {name: getattr(jax.config, name) for name in names}
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for name in (_setup.VARIABLE, "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    jax.config.update("jax_compilation_cache_dir", None)
    yield tmp_path / "home"
    for name, value in before.items():
        jax.config.update(name, value)


def kept(folder=True, **options):
    """Where programs are kept after a call; and JAX forgets it."""
    mb.setup(compile=None, keep=folder, **options)
    found = _setup.kept_in()
    jax.config.update("jax_compilation_cache_dir", None)
    return found


def options_of(code, flags=""):
    """The options of XLA after some calls, and what was said."""
    return process(f'import os\n{code}\nprint(repr(os.environ["XLA_FLAGS"]))', XLA_FLAGS=flags)


@pytest.mark.slow
def test_options_of_the_compiler_are_set_before_jax_starts():
    way = "for speed"
    flags = {option: value for option, value in _setup._OPTIONS[way].items() if takes_option(option)}
    call = f"mb.setup(compile={way!r}, keep=False)"
    code = f"{call}\n{call}\njnp.ones(3)\n{call}"
    own, said = options_of(code)
    assert said == "" and set(own.split()) == {f"--{option}={value}" for option, value in flags.items()}
    # Those of the user stay.
    given = "--xla_disable_hlo_passes=reshape-mover --xla_cpu_enable_fast_math=false"
    both, _ = options_of(code, given)
    others = [f"--{option}={value}" for option, value in flags.items() if option != "xla_disable_hlo_passes"]
    assert both == " ".join([given, *others])
    late, said = options_of("jnp.ones(3)\n" + code)
    assert late == "" and "JAX has computed something already" in said and said.count("UserWarning") == 3


@pytest.mark.slow
def test_the_last_way_to_compile_counts():
    quickly, fast = "mb.setup(keep=False)", "mb.setup(compile='for speed', keep=False)"
    for code, last in (
        (f"{quickly}\n{fast}", "for speed"),
        (f"{fast}\n{quickly}", "quickly"),
        (f"{fast}\nmb.setup(compile=None, keep=False)", None),
    ):
        own, said = options_of(code)
        flags = [f"--{name}={value}" for name, value in _setup._OPTIONS[last].items() if takes_option(name)]
        assert said == "" and own.split() == flags
    # Options that XLA does not know are left out.
    code = 'from jaxmb import _setup\n_setup._QUICKLY["xla_cpu_no_option_of_this_name"] = "true"\n'
    flags, said = options_of(f"{code}{quickly}\njnp.ones(3)")
    assert said == "" and "xla_disable_hlo_passes" in flags and "xla_cpu_no_option_of_this_name" not in flags


@pytest.mark.parametrize("platforms, on_processors", [("cpu", True), ("cuda,cpu", False), (None, True)])
def test_options_are_those_of_processors(platforms, on_processors, monkeypatch):
    before = jax.config.jax_platforms
    jax.config.update("jax_platforms", platforms)
    try:
        assert computes_on_processors() == on_processors
    finally:
        jax.config.update("jax_platforms", before)


@pytest.mark.slow
def test_what_is_asked_for_alone_is_set():
    code = "mb.setup(x64=False, compile=None, keep=False)\nprint([float(jnp.pi), os.environ.get('XLA_FLAGS', '')])"
    (pi, flags), said = process("import os\njax.config.update('jax_enable_x64', False)\n" + code, XLA_FLAGS="")
    assert (pi, flags, said) == (np.pi, "", "")
    code = "jax.config.update('jax_enable_x64', False)\nmb.setup(compile=None)\nprint(repr(str(jnp.ones(1).dtype)))"
    assert process(code, JAXMB_CACHE="off") == ("float64", "")
    with pytest.raises(ValueError, match='compile must be "quickly", "for speed", "for batches", "later" or None'):
        mb.setup(compile="fast")  # pyright: ignore[reportArgumentType]
    for keep in (None, 3):
        with pytest.raises(ValueError, match=f"keep must be True, False or the folder .* got {keep}"):
            mb.setup(keep=keep)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("name", ["compile_quickly", "run_quickly", "keep_compiled"])
def test_names_of_the_last_release_tell_the_new_one(name):
    with pytest.raises(AttributeError, match=rf"jaxmb\.{name} is now jaxmb\.setup\("):
        getattr(mb, name)


@pytest.mark.slow
@pytest.mark.skipif(not takes_option("xla_cpu_use_fusion_emitters"), reason="XLA leaves loops to its new emitters")
def test_the_loop_over_steps_is_one_kernel():
    code = """
import dataclasses
machine = mb.mechanisms.get("four_bar")

def angle(u):
    state = dataclasses.replace(machine.state, u=u)
    return mb.simulate(machine.system, state, t1=1.0, rtol=1e-8)["rocker"].angle[-1]

found = []
for function in (angle, jax.grad(angle)):
    program = jax.jit(function).lower(machine.state.u).compile()
    rest, start = program.as_text().split("ENTRY")
    found.append([rest.count(" while("), start.count(" while("), program(machine.state.u).tolist()])
print(found)
"""
    plain, quick = (
        process(call + code, XLA_FLAGS="")[0] for call in ("", "mb.setup(compile='for speed', keep=False)\n")
    )
    for one, other in zip(plain, quick, strict=True):
        assert one[1] > 0 == other[1] and other[0] > 0
        np.testing.assert_allclose(other[2], one[2], rtol=1e-8, atol=1e-8)


@pytest.mark.slow
def test_python_looks_for_garbage_less_often():
    code = "import gc\nbefore = gc.get_threshold()\nmb.setup(keep=False)\nprint([before, gc.get_threshold()])"
    before, after = process(code)[0]
    assert after[0] > before[0] and after[1:] == before[1:]
    for first in (0, 10**6):
        assert process(f"import gc\ngc.set_threshold({first})\n" + code)[0][1][0] == first


@pytest.mark.slow
def test_the_second_process_finds_what_the_first_compiled(tmp_path):
    """While another process of JAX holds its lock of the folder: nothing is said, and all is kept.

    What was compiled before the call is not kept.
    """
    before = "f = jax.jit(lambda x: jnp.sin(x) + x)\nf(1.0)\n"
    code = "mb.setup(**KEEP)\nprint(f(1.0), f(jnp.ones(3)))" + REPORT
    with filelock.FileLock(tmp_path / ".lockfile"):
        runs = [process(own + code, JAXMB_CACHE=str(tmp_path)) for own in (before, before.split("\n")[0] + "\n") * 2]
    (late, first, again, second), said = zip(*runs, strict=True)
    assert not any("compilation cache" in text for text in said)
    assert 0 < late["kept"] < late["asked"] and again["kept"] == 0
    assert first["kept"] > 0 and second == {"asked": first["asked"], "found": first["asked"], "kept": 0}


@pytest.mark.slow
def test_a_motion_and_its_gradient_are_compiled_once(tmp_path):
    code = """
mb.setup(**KEEP)
machine = mb.mechanisms.get("pendulum")

def height(mass):
    system = mb.with_parameters(machine.system, {"bob.mass": mass})
    state = mb.assemble(system, machine.state)
    return mb.simulate(system, state, t1=0.1, saveat=[0.05, 0.1], rtol=1e-6)["bob"].position[-1, 1]

found = [float(f(2.0)).hex() for f in (height, jax.grad(height), jax.jit(height))]
from jaxmb._kept_traces import _executables
traces = [executable is not None for each in _executables.values() for executable in each.values()]
print(dict(found=found, asked=counts["compile_requests_use_cache"], hits=counts["cache_hits"], traces=traces))
"""
    first, second = (process(code, JAXMB_CACHE=str(tmp_path), XLA_FLAGS=QUICKLY)[0] for _ in range(2))
    assert second["found"] == first["found"]
    assert second["hits"] == second["asked"] == first["asked"] > first["hits"]
    # Large programs by their traces, without lowering them.
    assert all(second["traces"]) and not any(first["traces"]) and len(second["traces"]) == len(first["traces"]) >= 3


def test_the_folder(new_user, tmp_path, monkeypatch):
    user, other = kept(), tmp_path / "other"
    assert user.is_relative_to(new_user) and user.name == "jaxmb" and user.stat().st_mode & 0o077 == 0
    assert kept(other) == kept(str(other)) == other and other.is_dir()
    assert kept("~/own") == new_user / "own"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    assert kept() == tmp_path / "caches" / "jaxmb"
    # One variable for the user of the machine, before what a program says.
    monkeypatch.setenv("JAXMB_CACHE", str(tmp_path / "named"))
    assert kept() == kept(other) == tmp_path / "named"
    monkeypatch.setenv("JAXMB_CACHE", "off")
    assert kept() is None and kept(tmp_path / "off") is None and not (tmp_path / "off").exists()


@pytest.mark.parametrize("system, folder", [("linux", ".cache"), ("darwin", "Library/Caches"), ("win32", "Local")])
def test_the_folder_of_a_system(system, folder, new_user, monkeypatch):
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setenv("LOCALAPPDATA", str(new_user / "Local"))
    assert kept() == new_user / folder / "jaxmb"


@pytest.mark.slow
def test_settings_of_jax_stay(new_user, tmp_path, monkeypatch):
    size = jax.config.jax_compilation_cache_max_size
    monkeypatch.setenv("JAXMB_CACHE", str(tmp_path / "not"))
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "of_jax"))
    assert kept(max_bytes=size + 1) == tmp_path / "of_jax"
    assert jax.config.jax_compilation_cache_max_size == size
    jax.config.update("jax_enable_compilation_cache", False)
    assert kept() is None and not (tmp_path / "not").exists()
    # From the environment, which JAX reads when it is imported.
    own = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "of_jax"), "JAXMB_CACHE": str(tmp_path / "not")}
    assert process("mb.setup(**KEEP)\nprint(repr(jax.config.jax_compilation_cache_dir))", **own)[0] == str(
        tmp_path / "of_jax"
    )


@pytest.mark.slow
def test_the_size_is_bounded(tmp_path):
    code = "mb.setup(**KEEP, max_bytes=20_000)\nfor n in range(2, 20): jnp.cumsum(jnp.ones(n)).block_until_ready()"
    counts, _ = process(code + REPORT, JAXMB_CACHE=str(tmp_path))
    sizes = [path.stat().st_size for path in tmp_path.glob("*-cache")]
    assert sum(sizes) <= 20_000 and 0 < len(sizes) < counts["kept"]
    with pytest.raises(ValueError, match="max_bytes must be positive, got 0"):
        mb.setup(max_bytes=0)


def test_a_folder_that_cannot_be_written_to(new_user, tmp_path, monkeypatch):
    taken = tmp_path / "taken"
    taken.write_text("")
    for folder in (taken, taken / "deeper"):
        with pytest.warns(UserWarning, match=f"not kept: {folder} cannot be written to .*JAXMB_CACHE names another"):
            assert kept(folder) is None
    monkeypatch.setenv("HOME", str(taken))
    with pytest.warns(UserWarning, match="not kept: the cache folder cannot be written to"):
        assert kept() is None


@pytest.mark.slow
def test_the_command_line_keeps_programs(tmp_path):
    """Where it cannot, one line says so."""
    code = """
from jaxmb.cli import main
assert main(["mechanisms"]) == 0
print(repr(jax.config.jax_compilation_cache_dir))
"""
    assert process(code, JAXMB_CACHE=str(tmp_path)) == (str(tmp_path), "")
    (tmp_path / "taken").write_text("")
    folder, said = process(code, JAXMB_CACHE=str(tmp_path / "taken"))
    assert folder is None and said.startswith("jaxmb: compiled programs are not kept: ") and said.count("\n") == 1
    assert process(code, JAXMB_CACHE="off") == (None, "")


def test_the_readme_names_each_way_to_compile():
    text = (Path(__file__).parents[2] / "README.md").read_text()
    ways = [way for way in _setup._OPTIONS if way is not None]
    assert len(ways) == 4 and all(f'`"{way}"`' in text for way in ways)


@pytest.mark.slow
@pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="Threads are counted where the system lists them.")
def test_lapack_has_one_thread_unless_the_environment_has_a_number():
    code = """
import os
os.environ.pop("OMP_NUM_THREADS", None), os.environ.pop("OPENBLAS_NUM_THREADS", None)
os.environ.update({})
mb.setup(keep=False)
before = len(os.listdir("/proc/self/task"))
import scipy.linalg
print(len(os.listdir("/proc/self/task")) - before)
"""
    given = code.replace("update({})", "update(OPENBLAS_NUM_THREADS='2')")
    # OpenBLAS starts no more threads than there are cores.
    assert [process(each)[0] for each in (code, given)] == [0, min(cores(), 2) - 1]


@pytest.mark.slow
def test_a_kept_program_calls_lapack_in_a_process_that_has_lowered_none(tmp_path):
    """JAX finds LAPACK while it lowers a program, and a program that is found by its trace is not lowered."""
    code = """
mb.setup(keep=True, compile=None)
def singular(x):
    for _ in range(120):
        x = jnp.sin(x) + 1.0
    return jnp.linalg.svd(x @ x.T, compute_uv=False)
import numpy as np
given = np.linspace(0.0, 1.0, 9).reshape(3, 3)
values = jax.jit(singular)(given)
from jaxmb import _kept_traces
read = any(x for known in _kept_traces._executables.values() for x in known.values())
print([read, values.tolist()])
"""
    (found, first), (again, second) = (process(code, JAXMB_CACHE=str(tmp_path))[0] for _ in range(2))
    assert not found and again
    np.testing.assert_array_equal(first, second)
