"""First calls that NumPy computes while the compiler works."""

import importlib
import subprocess
import sys
import time

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from by_numpy import nothing_compiled

import jaxmb as mb
from jaxmb import planar
from jaxmb.interpreted import Unsupported, interpreted, later, values
from jaxmb.linalg.jitted import jitted

MOST_PROGRAMS = 45
MACHINE = mb.mechanisms.pendulum()


@pytest.fixture(autouse=True)
def _compiles_later():
    with nothing_compiled():
        yield


@pytest.fixture
def compiler(monkeypatch):
    """The programs that the compiler is asked for; it does nothing."""
    asked = []
    monkeypatch.setattr(later._background, "add", asked.append)
    return asked


CALLS = importlib.import_module("jaxmb.simulate.calls")


def swing(system=MACHINE.system, t1=0.1, **options):
    return mb.simulate(system, MACHINE.state, t1=t1, rtol=1e-8, **options)


def test_programs_are_computed_and_compiled_when_called_again(compiler, monkeypatch):
    calls = []

    @jitted
    def function(tree, shift):
        calls.append(tree)
        return {"a": tree["x"] + shift, "b": jnp.sum(tree["x"]) > 0}

    x = np.arange(3.0)
    for _ in range(3):
        out = function({"x": x, "name": "text"}, 1.0)
        assert isinstance(out["a"], jax.Array) and out["b"].dtype == bool and out["b"].shape == ()
        np.testing.assert_array_equal(out["a"], x + 1.0)
    (program,) = compiler
    assert len(calls) == 1 and not program.has
    program.compile()
    np.testing.assert_array_equal(function({"x": x, "name": "text"}, 1.0)["a"], x + 1.0)
    assert len(calls) == 1 and program.has
    # Others under a trace, and where JAX is told to look for NaN.
    monkeypatch.setattr(later, "interpreted", lambda program: pytest.fail("computed by NumPy"))
    jax.jit(lambda x: function({"x": x, "name": "text"}, 2.0)["a"])(x)
    jax.vmap(lambda x: function({"x": x, "name": "text"}, 2.0)["a"])(x[:, None])
    monkeypatch.undo()


def test_programs_that_only_the_compiler_knows(compiler):
    said = []

    @jitted
    def with_callback(x):
        jax.debug.callback(lambda x: said.append(float(x)), x)
        return 2 * x

    @jitted
    def with_random_numbers(x, key):
        return x + jax.random.uniform(key)

    assert with_callback(np.float64(3.0)) == 6.0
    jax.effects_barrier()
    assert said == [3.0]
    assert 3.0 <= with_random_numbers(np.float64(3.0), jax.random.key(0)) < 4.0
    assert compiler == []
    with pytest.raises(Unsupported, match="top_k"):
        interpreted(jax.make_jaxpr(lambda x: jax.lax.top_k(x, 2))(np.arange(4.0)))


def test_source_names_the_lines_of_the_package():
    def twice(x):
        return jnp.sin(x) * 2.0

    source = interpreted(jax.make_jaxpr(twice)(1.0)).source
    assert "sine(" in source and "test_later.py" in source and "twice)" in source


def test_arrays_are_updated_in_place(monkeypatch):
    """The rows of a table that a loop fills, also under a condition and in a loop within."""

    def filled(x, table):
        def turn(k, carry):
            table, count = carry
            table, count = jax.lax.cond(
                k % 2 == 0, lambda: (table.at[count].set(k * x), count + 1), lambda: (table, count)
            )
            return jax.lax.fori_loop(0, 2, lambda n, c: (c[0].at[0, n].add(1.0), c[1]), (table, count))

        return jax.lax.fori_loop(0, 40, turn, (table, 0))[0], table

    table = np.zeros((20, 3))
    traced = jax.make_jaxpr(filled)(np.ones(3), table)
    found, before = interpreted(traced)([np.ones(3), table])
    expected = np.zeros((20, 3))
    expected += np.arange(0.0, 40.0, 2.0)[:, None]
    expected[0, :2] += 40.0
    np.testing.assert_array_equal(found, expected)
    assert not before.any() and not table.any()
    copies, writable = [], values._writable

    def counted(count, x):
        out = writable(count, x)
        copies.append(out is not x)
        return out

    monkeypatch.setattr(values, "_writable", counted)
    interpreted(traced)([np.ones(3), table])
    # Only the array that was given.
    assert sum(copies) == 1 and len(copies) == 100


def test_motions_that_fail_say_so_in_the_same_words(monkeypatch):
    with pytest.raises(RuntimeError, match="max_steps = 4 steps") as by_numpy:
        swing(t1=1.0, max_steps=4)
    monkeypatch.setattr(later, "compiles_later", lambda: False)
    with pytest.raises(RuntimeError) as compiled:
        swing(t1=1.0, max_steps=4)
    assert str(by_numpy.value) == str(compiled.value)


def test_errors_of_users_show_their_lines():
    def law(t, y, args, **_):
        raise ZeroDivisionError("mine")

    with pytest.raises(ZeroDivisionError, match="mine") as raised:
        mb.simulate(MACHINE.system, MACHINE.state, t1=0.1, event=diffrax.Event(law))
    assert raised.traceback[-1].name == "law"


def test_interruptions_end_a_motion_at_once(monkeypatch):
    function = later.Interpreted.__call__
    count = []

    def interrupted(self, arrays):
        count.append(None)
        if len(count) > 1:
            raise KeyboardInterrupt
        return function(self, arrays)

    monkeypatch.setattr(later.Interpreted, "__call__", interrupted)
    monkeypatch.setattr(CALLS, "_STEPS", 16)
    with pytest.raises(KeyboardInterrupt) as raised:
        swing(t1=10.0)
    motion = raised.value.motion
    assert motion.stats["interpreted"] and motion.end.q.size > 0 and motion.stats["num_steps"] == 16


def test_motions_go_on_in_the_program_when_it_is_there(compiler, monkeypatch):
    """The background compiles after the second call of the program."""
    monkeypatch.setattr(CALLS, "_STEPS", 16)
    monkeypatch.setattr(later._background, "add", lambda program: program.compile())
    ways = []
    call = CALLS.call

    def noted(*arguments):
        out = call(*arguments)
        ways.append(bool(out[0].stats["interpreted"]))
        return out

    monkeypatch.setattr(CALLS, "call", noted)
    # Of another structure than elsewhere.
    times = np.linspace(0.0, 2.0, 21)
    motion = swing(t1=2.0, saveat=times)
    assert ways[:3] == [True, True, False] and motion.stats["interpreted"]
    again = swing(t1=2.0, saveat=times)
    assert not again.stats["interpreted"] and again.ts.shape == motion.ts.shape
    np.testing.assert_allclose(again.ys.q, motion.ys.q, rtol=0, atol=1e-7)


@pytest.mark.slow
def test_derivatives_are_computed_too(monkeypatch):
    """In reverse and in forward mode; under `jit` they are compiled."""
    computed, call = [], later.Interpreted.__call__
    monkeypatch.setattr(later.Interpreted, "__call__", lambda self, x: computed.append(None) or call(self, x))

    end = lambda x: jnp.sum(mb.simulate(MACHINE.system, mb.State(MACHINE.state.q, x), t1=0.3, rtol=1e-9).ys.q)
    u = np.asarray(MACHINE.state.u) + 0.1
    backward, forward = jax.grad(end)(u), jax.jacfwd(end)(u)
    count = len(computed)
    assert count >= 3
    compiled = jax.jit(jax.grad(end))(u)
    assert len(computed) == count
    np.testing.assert_allclose(backward, compiled, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(forward, compiled, rtol=1e-6, atol=1e-8)
    monkeypatch.setattr(later, "compiles_later", lambda: False)
    np.testing.assert_allclose(jax.grad(end)(u), compiled, rtol=1e-6, atol=1e-8)
    assert len(computed) == count


SCRIPT = """
import sys, time
import jaxmb as mb
from jaxmb.interpreted import later
mb.setup(compile="later", keep=False)
machine = mb.mechanisms.get("four_bar")
for _ in range(int(sys.argv[1])):
    mb.simulate(machine.system, machine.state, t1=0.05)
later._REST = 0.0
time.sleep(float(sys.argv[2]))
sys.exit(7)
"""


@pytest.mark.slow
@pytest.mark.parametrize("runs, wait", [(1, 0.0), (2, 0.0), (2, 0.3), (2, 1.0), (2, 3.0), (2, 6.0)])
def test_processes_end_while_the_compiler_works(runs, wait):
    done = subprocess.run([sys.executable, "-c", SCRIPT, str(runs), str(wait)], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (7, "") and "terminate" not in done.stderr


@pytest.mark.slow
def test_compiler_works_in_the_background(monkeypatch):
    """It waits for a rest; what it fails to make stays with NumPy."""
    monkeypatch.setattr(later, "_REST", 0.2)
    swing(t1=0.3, saveat=np.linspace(0.0, 0.3, 6))
    began = time.monotonic()
    while swing(t1=0.3, saveat=np.linspace(0.0, 0.3, 6)).stats["interpreted"]:
        assert time.monotonic() - began < 120
        time.sleep(0.5)
    monkeypatch.setattr(later._Program, "compile", lambda self: 1 / 0)
    ball = mb.Scene([planar.Body("ball", mass=1.0, inertia=1.0)]).compile()
    for _ in range(3):
        motion = mb.simulate(ball, mb.assemble(ball), t1=0.1)
        time.sleep(0.5)
        assert motion.stats["interpreted"]
