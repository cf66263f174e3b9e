"""What is kept of each step has room for as many steps as a motion takes, and derivatives for a few at first."""

import collections
import importlib

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb.simulate import room, saves, solve

run = importlib.import_module("jaxmb.simulate.run")


@pytest.fixture(scope="module")
def pendulum():
    rod = mb.planar.Body("rod", mass=1.0, inertia=1 / 12, position=(0.5, 0.0))
    pin = mb.planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0))
    system = mb.Scene([rod], joints=[pin], forces=[mb.Gravity((0.0, -9.81))]).compile()
    return system, mb.assemble(system)


@pytest.mark.slow
@pytest.mark.parametrize("kept", ["dense", "steps"])
def test_tables_of_a_call_hold_a_part_of_a_motion(pendulum, monkeypatch, kept):
    system, state = pendulum
    saveat = diffrax.SaveAt(**{kept: True})
    run = lambda state, **options: mb.simulate(system, state, t1=1.0, saveat=saveat, **options)
    with monkeypatch.context() as patch:
        patch.setattr(room, "_MEMORY", 1.0)
        patch.setattr(room, "_FEWEST_STEPS", 16)
        found = run(state)
        steps = int(found.stats["num_steps"])
        assert steps > 16 and found.stats["max_steps"] == 65536 and found.result == mb.RESULTS.successful
        with pytest.raises(RuntimeError, match=f"max_steps = {steps - 1} steps"):
            run(state, max_steps=steps - 1)
    # A program that is traced has tables for all steps.
    whole, count = jax.jit(lambda state: run(state, max_steps=256))(state), found.ts.size
    if kept == "dense":
        np.testing.assert_array_equal(found.at(0.7).q, whole.at(0.7).q)
    else:
        np.testing.assert_array_equal(found.ys.q, whole.ys.q[:count])
        assert not np.isfinite(whole.ts[count])


@pytest.fixture
def rooms(monkeypatch):
    """For how many steps the programs have room that are used. Derivatives keep 16 of them."""
    used, solved = [], run.solved

    def spied(problem):
        used.append(problem.room.rows)
        return solved(problem)

    for where in (room, solve):
        monkeypatch.setattr(where, "MOST_ROWS", 16)
    monkeypatch.setattr(room, "_FEWEST_ROWS", 16)
    monkeypatch.setattr(room, "_long", collections.deque(maxlen=2))
    monkeypatch.setattr(run, "solved", spied)
    return used


def end(system, state, t1, **options):
    """The angle of the rod at the end, as a function of the gravity."""

    def angle(gravity):
        changed = mb.with_parameters(system, {"gravity.acceleration": jnp.array([0.0, -gravity])})
        return mb.simulate(changed, state, t1=t1, **options)["rod"].angle[-1]

    return angle


@pytest.mark.slow
def test_derivative_that_takes_more_steps_than_it_keeps_is_computed_again(pendulum, rooms):
    long = end(*pendulum, 1.0)
    whole = jax.jit(jax.grad(long))(9.81)
    assert rooms == [65536]
    rooms.clear()
    np.testing.assert_allclose(jax.grad(long)(9.81), whole, rtol=1e-12)
    assert rooms == [16, 65536]
    # From now on it is known.
    rooms.clear()
    np.testing.assert_allclose(jax.jacfwd(long)(9.81), whole, rtol=1e-9)
    assert rooms == [65536]
    # A number of steps that does not suffice is said as before, and few steps have a small program.
    for most, used in ((20, 64), (3, 4), (16, 16)):
        assert np.isnan(jax.grad(end(*pendulum, 1.0, max_steps=most))(9.81)) and rooms[-1] == used


@pytest.mark.slow
def test_motion_tells_its_derivative_how_many_steps_it_takes(pendulum, rooms):
    """A long one needs a long program, and a short one a short program."""
    for t1, rtol, rows in ((1e-2, 1e-4, 16), (1.0, 1e-8, 65536)):
        run = end(*pendulum, t1, rtol=rtol)
        value = run(9.81)
        rooms.clear()
        other, slope = jax.value_and_grad(run)(9.81)
        np.testing.assert_allclose(other, value, rtol=1e-6)
        assert rooms == [rows]
        # Of a batch it is not known beforehand how many steps its members take.
        np.testing.assert_allclose(jax.vmap(jax.grad(run))(jnp.array([9.81]))[0], slope, rtol=1e-9)
        assert rooms[-1] == 65536
        if rows == 16:
            assert np.isfinite(jax.hessian(run)(9.81)) and rooms[-1] == 16


@pytest.fixture(scope="module")
def narrow():
    """Two rods that a short coupler keeps parallel: constraints are nearly dependent all the time."""
    start, across = np.array([np.cos(-1.0), np.sin(-1.0)]), np.array([2e-4, 0.0])
    rod = lambda name, at: mb.planar.Body(name, mass=1.0, inertia=1 / 12, position=start / 2 + at, angle=-1.0)
    coupler = mb.planar.Body("coupler", mass=0.01, inertia=1e-9, position=start + across / 2)
    pin = lambda name, a, b, at, on: mb.planar.Revolute(name, a, b, point_a=at, point_b=on)
    joints = [
        pin("A", "ground", "rod", (0.0, 0.0), (-0.5, 0.0)),
        pin("B", "ground", "other", (2e-4, 0.0), (-0.5, 0.0)),
        pin("C", "rod", "coupler", (0.5, 0.0), (-1e-4, 0.0)),
        pin("D", "other", "coupler", (0.5, 0.0), (1e-4, 0.0)),
    ]
    bodies = [rod("rod", 0 * across), rod("other", across), coupler]
    system = mb.Scene(bodies, joints=joints, forces=[mb.Gravity((0.0, -9.81))]).compile()
    return system, mb.assemble(system)


@pytest.mark.slow
def test_too_few_steps_are_no_singularity(narrow, rooms):
    """What is nearly singular everywhere has not failed for that."""
    system, state = narrow
    short = mb.simulate(system, state, t1=1.0, max_steps=20, throw=False)
    assert short.result == mb.RESULTS.max_steps_reached
    long = end(system, state, 1.0)
    room._long.clear()
    rooms.clear()
    slope = jax.grad(long)(9.81)
    assert rooms == [16, 65536]
    np.testing.assert_allclose(slope, (long(9.82) - long(9.80)) / 0.02, rtol=1e-4)


def test_room_counts_internal_states():
    """Of which a system may have many more than coordinates."""
    saveat = saves.with_end(diffrax.SaveAt(steps=True), jnp.zeros(()), mb.State(jnp.zeros(8), jnp.zeros(8)))
    few, many = mb.State(jnp.zeros(8), jnp.zeros(8)), mb.State(jnp.zeros(8), jnp.zeros(8), jnp.zeros(4096))
    rows = [room.room_of_calls(saveat, state) for state in (few, many)]
    assert rows == [4096, 256]
    assert rows[1] * (16 + 4096) * 8 < room._MEMORY


def test_few_systems_are_remembered_as_long():
    assert 0 < room._long.maxlen < 100


def test_states_of_every_eighth_step_take_an_eighth_of_the_memory():
    state = mb.State(jnp.zeros(8000), jnp.zeros(8000))
    saveat = lambda steps: diffrax.SaveAt(subs=(diffrax.SubSaveAt(steps=steps), diffrax.SubSaveAt(t1=True)))
    one, eight = (room.room_of_calls(saveat(steps), state) for steps in (True, 8))
    assert (one, eight) == (128, 1024)
