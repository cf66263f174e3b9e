"""Programs that a user's calls need, and what is told while one compiles."""

import importlib
import re

import jax
import numpy as np
import pytest

import jaxmb as mb
from jaxmb.simulate import compiling

pytestmark = pytest.mark.slow

# `jaxmb.simulate` is the function.
solve = importlib.import_module("jaxmb.simulate.solve")
integrate = importlib.import_module("jaxmb.simulate.integrate")


@pytest.fixture
def programs(monkeypatch):
    """The solver's programs that are traced."""
    traced = []
    monkeypatch.setattr(solve, "tracing_begins", lambda: traced.append(None))
    return traced


def test_calls_of_a_user_with_other_numbers_need_few_programs(programs):
    """Times, tolerances, numbers of steps and of saved times, errors, other parameters."""
    machine = mb.mechanisms.pendulum()
    system, state = machine.system, machine.state
    other, still = mb.with_parameters(system, {"bob.mass": 2.0}), mb.State(state.q, 0.5 * state.u)
    run = lambda system=system, state=state, t1=0.1, **options: mb.simulate(system, state, t1=t1, **options)
    for options in (
        {},
        {"t1": 0.2, "t0": 0.05},
        {"t1": -0.1},
        {"rtol": 1e-6},
        {"rtol": 1e-6, "atol": 1e-8, "max_steps": 20_000},
        {"max_steps": 40_000, "throw": False},
        {"system": other},
        {"state": still},
    ):
        run(**options)
    counts, motions = (9, 16, 12, 17, 32), []
    for count in counts:
        motions.append(run(saveat=np.linspace(0.0, 0.1, count), error=count == 12))
    run(t1=-0.1, saveat=-np.linspace(0.0, 0.1, 9))
    # The state at the end, with tolerances of either kind, and up to 16 and up to 32 saved states.
    assert len(programs) == 4
    for motion, count in zip(motions, counts, strict=True):
        np.testing.assert_array_equal(motion.ts, np.linspace(0.0, 0.1, count))
        assert motion.ys.q.shape == (count, system.nq)
        np.testing.assert_allclose(motion.ys.q[-1], motions[0].ys.q[-1], rtol=0, atol=1e-9)


def test_run_that_is_differentiated_is_traced_once(monkeypatch):
    """A derivative that is known to be taken needs no program of the run without one."""
    traced, states = [], integrate._solution

    def counted(*arguments):
        traced.append(arguments[-1] is not None)
        return states(*arguments)

    monkeypatch.setattr(integrate, "_solution", counted)
    machine = mb.mechanisms.pendulum(length=1.25)

    def end(strength):
        system = mb.with_parameters(machine.system, {"gravity.acceleration": strength * np.array([0.0, -1.0])})
        return mb.simulate(system, machine.state, t1=0.1, rtol=1e-9).ys.q[-1, 1]

    known, h = jax.grad(end)(9.81), 1e-3
    assert traced == [True]
    np.testing.assert_allclose(jax.jvp(end, (9.81,), (1.0,))[1], known, rtol=1e-12)
    np.testing.assert_allclose((end(9.81 + h) - end(9.81 - h)) / (2 * h), known, rtol=1e-5)
    traced.clear()
    # Here JAX traces the run first, and learns of the derivative afterwards.
    np.testing.assert_allclose(jax.grad(jax.jit(end))(9.81), known, rtol=1e-12)
    assert traced == [False, True]


def test_motion_that_fails_under_jit(programs):
    """It is NaN, and an error where that is asked for."""
    machine = mb.mechanisms.pendulum()

    def end(t1, **options):
        return mb.simulate(machine.system, machine.state, t1=t1, max_steps=4, **options).ys.q[-1]

    with pytest.raises(RuntimeError, match="max_steps = 4 steps"):
        end(1.0)
    assert np.all(np.isnan(jax.jit(end)(1.0))) and np.all(np.isnan(jax.jacfwd(end)(1.0)))
    with pytest.raises(Exception, match="maximum number of"):
        jax.block_until_ready(jax.jit(lambda t1: end(t1, throw=True))(1.0))


def test_user_is_told_what_compiles(monkeypatch, capsys):
    machine = mb.mechanisms.pendulum()
    # Each of these numbers of saved times is a program.
    run = lambda count: mb.simulate(machine.system, machine.state, t1=0.1, saveat=np.linspace(0.0, 0.1, count))
    monkeypatch.setattr(compiling, "_PATIENCE", 0.01)
    run(128)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(compiling.sys.stderr, "isatty", lambda: True, raising=False)
    run(128)
    assert capsys.readouterr().err == ""
    run(256)
    text = capsys.readouterr().err
    took, way = r"\d+\.\d s; a later call takes [\d.]+ m?s", r'setup\(compile="later"\) does not wait'
    assert re.fullmatch(rf"jaxmb: compiling a motion of bob \.\.\. {took}; {way}\n", text)
    jax.jit(lambda t1: mb.simulate(machine.system, machine.state, t1=t1, saveat=np.zeros(512)).ys.q)(0.1)
    assert capsys.readouterr().err == ""
