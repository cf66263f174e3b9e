"""A run as several calls of one program: results do not depend on where a call ends; Ctrl-C; progress; further runs."""

import copy
import pickle
import signal
import subprocess
import sys

import diffrax
import jax
import numpy as np
import optimistix as optx
import pytest

import jaxmb as mb
from jaxmb import planar
from jaxmb.simulate import calls, solve

MOST_PROGRAMS = 115
TIMES = np.linspace(0.0, 1.0, 37)


def ball(t1=1.5, **options):
    body = planar.PointMass("ball", mass=1.0, position=(0.0, 0.5))
    floor = mb.RigidContact("floor", "ball", terrain=mb.terrain.Flat(), radius=0.1, restitution=0.6)
    system = mb.Scene([body], joints=[floor], forces=[mb.Gravity((0.0, -9.81))]).compile()
    return mb.simulate(system, system.guess, t1=t1, **options)


def spinning():
    body = planar.Body("bar", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))
    system = mb.Scene([body], joints=[pin]).compile()
    state = mb.assemble(system, rates={"pin.angle": 30.0})
    return mb.simulate(system, state, t1=1.0, saveat=np.linspace(0.0, 1.0, 5))


def of_four_bar(**options):
    def run():
        machine = mb.mechanisms.four_bar()
        return mb.simulate(machine.system, machine.state, **{"t1": 1.0} | options)

    return run


EVENT = diffrax.Event(lambda t, y, args, **_: y.u[0], optx.Newton(1e-10, 1e-10))


@pytest.fixture
def traced(monkeypatch):
    """The programs of runs that are traced."""
    found = []
    monkeypatch.setattr(solve, "tracing_begins", lambda: found.append(None))
    return found


RUNS = {
    "times": of_four_bar(saveat=TIMES),
    "backward": of_four_bar(t1=-1.0, saveat=diffrax.SaveAt(t0=True, ts=-TIMES[:5], t1=True)),
    "steps": of_four_bar(saveat=diffrax.SaveAt(t0=True, steps=3, t1=True)),
    "dense": of_four_bar(saveat=diffrax.SaveAt(t0=True, steps=True, dense=True)),
    "function": of_four_bar(saveat=diffrax.SaveAt(ts=TIMES, fn=lambda t, y, args: y.q * t)),
    "event": of_four_bar(t1=2.0, saveat=diffrax.SaveAt(t0=True, steps=True), event=EVENT),
    "jumps": of_four_bar(jumps=[0.3], saveat=TIMES),
    "Hermite": of_four_bar(solver=mb.solvers.Hermite()),
    "Tsit5": of_four_bar(solver=diffrax.Tsit5(), saveat=TIMES),
    "projection": of_four_bar(manifold=mb.manifold.Projection()),
    "contacts": lambda: ball(saveat=diffrax.SaveAt(t0=True, ts=TIMES, steps=True)),
    "turns": spinning,
}


@pytest.mark.slow(but=("dense", "contacts"))
@pytest.mark.parametrize("name", RUNS)
def test_results_do_not_depend_on_where_a_call_ends(name, monkeypatch):
    """To the last bit."""

    def found():
        motion = RUNS[name]()
        dense = [motion.at(t).q for t in (0.05, 0.77)] if name == "dense" else ()
        kept = motion.trimmed()
        return jax.tree.leaves((kept.ts, kept.ys, kept.stats, kept.result, kept.found_events, kept.event_mask, dense))

    monkeypatch.setattr(calls, "_STEPS", 10**6)
    whole = found()
    monkeypatch.setattr(calls, "_STEPS", 7)
    monkeypatch.setattr(calls, "_MORE", 1)
    for a, b in zip(found(), whole, strict=True):
        np.testing.assert_array_equal(a, b)


def test_any_number_of_steps_is_one_program(traced):
    machine = mb.mechanisms.four_bar()
    run = lambda t1: mb.simulate(machine.system, machine.state, t1=t1, saveat=diffrax.SaveAt(steps=True)).ts.size
    assert run(0.1) < calls._STEPS < run(5.0)
    assert len(traced) <= 1


def test_too_few_steps_for_several_calls(monkeypatch):
    monkeypatch.setattr(calls, "_STEPS", 7)
    monkeypatch.setattr(calls, "_MORE", 1)
    machine = mb.mechanisms.pendulum()
    motion = mb.simulate(machine.system, machine.state, t1=1.0, max_steps=20, throw=False)
    assert (int(motion.stats["num_steps"]), int(motion.stats["max_steps"])) == (20, 20)
    assert motion.result == mb.RESULTS.max_steps_reached
    with pytest.raises(RuntimeError, match="max_steps = 20 steps"):
        mb.simulate(machine.system, machine.state, t1=1.0, max_steps=20)


@pytest.fixture
def stopped(monkeypatch):
    """The user presses Ctrl-C in the third call."""
    monkeypatch.setattr(calls, "_STEPS", 7)
    monkeypatch.setattr(calls, "_MORE", 1)
    count, call = [], calls.call

    def called(*arguments):
        count.append(None)
        if len(count) == 3:
            raise KeyboardInterrupt
        return call(*arguments)

    monkeypatch.setattr(calls, "call", called)


def test_interrupted_run_gives_the_motion_so_far(stopped):
    machine, saveat = mb.mechanisms.pendulum(), diffrax.SaveAt(t0=True, steps=True)
    with pytest.raises(KeyboardInterrupt, match=r"interrupted at t = [\d.]+; the motion so far") as error:
        mb.simulate(machine.system, machine.state, t1=5.0, saveat=saveat)
    motion = error.value.motion
    assert motion.result == mb.RESULTS.interrupted and int(motion.stats["num_steps"]) == 14
    assert motion.ts.size == 1 + int(motion.stats["num_accepted_steps"]) and np.all(np.isfinite(motion.ys.q))


def test_interrupted_run_without_an_error(stopped):
    machine = mb.mechanisms.pendulum()
    motion = mb.simulate(machine.system, machine.state, t1=5.0, throw=False)
    assert motion.result == mb.RESULTS.interrupted and 0 < motion.ts[-1] < 5.0
    with pytest.raises(ValueError, match="Only a motion as simulate returns it can be continued"):
        motion.continued(t1=6.0)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="there are no such signals")
def test_signal_ends_a_run():
    code = (
        # A process in the background may ignore it.
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "import jaxmb as mb; mb.setup(); machine = mb.mechanisms.four_bar()\n"
        "run = lambda t1: mb.simulate(machine.system, machine.state, t1=t1, max_steps=10**9)\n"
        "run(0.1); print('ready', flush=True)\n"
        "try:\n    run(1e6)\nexcept KeyboardInterrupt as error:\n    print(float(error.motion.ts[-1]) > 0.1)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline() == "ready\n"
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(3)
            process.send_signal(signal.SIGINT)
            assert process.communicate(timeout=20)[0] == "True\n"
        finally:
            process.kill()


def test_meter_is_told_the_progress_between_calls(monkeypatch, traced):
    class Meter(diffrax.AbstractProgressMeter):
        def init(self):
            return ()

        def step(self, state, progress):
            return (*state, float(progress))

        def close(self, state):
            told.extend(state)

    told = []
    machine = mb.mechanisms.pendulum()
    run = lambda **options: mb.simulate(machine.system, machine.state, t1=2.0, **options)
    run()
    monkeypatch.setattr(calls, "_STEPS", 20)
    monkeypatch.setattr(calls, "_MORE", 1)
    run(progress_meter=Meter())
    assert len(traced) <= 1 and told == sorted(told) and told[-1] == 1.0 and len(told) > 3


@pytest.mark.parametrize("name", ["Adams", "Hermite", "Tsit5"])
@pytest.mark.slow(but=("Adams",))
def test_continued_motion_goes_on_with_its_history(name):
    solver = {"Adams": None, "Hermite": mb.solvers.Hermite(), "Tsit5": diffrax.Tsit5()}[name]
    machine = mb.mechanisms.four_bar()
    run = lambda **options: mb.simulate(machine.system, machine.state, solver=solver, rtol=1e-9, **options)
    whole, first = run(t1=2.0), run(t1=1.0)
    later = first.continued(t1=2.0)
    np.testing.assert_allclose(later.ys.q, whole.ys.q, rtol=1e-8, atol=1e-8)
    # No start at order one: one step is cut at the end of the first.
    counts = [int(motion.stats["num_steps"]) for motion in (first, later, whole)]
    assert counts[0] + counts[1] <= counts[2] + 4
    again = mb.simulate(machine.system, first.end, t0=1.0, t1=2.0, solver=solver, rtol=1e-9)
    assert counts[1] < again.stats["num_steps"] or name == "Tsit5"


@pytest.mark.slow
def test_continued_motions_join(traced):
    machine = mb.mechanisms.four_bar()
    first = mb.simulate(machine.system, machine.state, t1=1.0, saveat=[0.0, 0.5, 1.0])
    later = first.continued(t1=1.5, saveat=[1.0, 1.25, 1.5])
    last = later.continued(t1=2.0, saveat=[1.5, 1.75, 2.0])
    assert len(traced) <= 1
    joined = first + later + last
    with pytest.raises(ValueError, match="not one that was joined"):
        joined.continued(t1=3.0)
    with pytest.raises(ValueError, match=r"t1 must be beyond the end of the motion at 1, got 0\.1"):
        first.continued(t1=0.1)
    with pytest.raises(ValueError, match="not continued under jit"):
        jax.jit(lambda t1: first.continued(t1=t1).ys.q)(1.3)
    for other in (copy.deepcopy(first), pickle.loads(pickle.dumps(first))):
        with pytest.raises(ValueError, match="Only a motion as simulate returns it can be continued"):
            other.continued(t1=2.0)
    np.testing.assert_allclose(joined.ts, [0, 0.5, 1, 1.25, 1.5, 1.75, 2])
    whole = mb.simulate(machine.system, machine.state, t1=2.0)
    np.testing.assert_allclose(last.ys.q[-1], whole.ys.q[-1], rtol=1e-7, atol=1e-7)


@pytest.mark.slow
def test_continued_motion_has_its_own_events():
    whole, first = ball(1.5), ball(0.7)
    later = first.continued(t1=1.5)
    assert len(first.events) > 0 and len(first.events) + len(later.events) == len(whole.events)
    np.testing.assert_allclose(later.ys.q, whole.ys.q, rtol=1e-9)
    assert int(later.stats["num_events"]) == int(whole.stats["num_events"]) - int(first.stats["num_events"])


def test_continued_motion_starts_anew_where_inputs_jump():
    machine = mb.mechanisms.pendulum()
    pushed = lambda **options: mb.simulate(machine.system, machine.state, jumps=[0.5], **options)
    later = pushed(t1=1.0).continued(t1=2.0)
    np.testing.assert_allclose(later.ys.q, pushed(t1=2.0).ys.q, rtol=1e-7, atol=1e-7)
