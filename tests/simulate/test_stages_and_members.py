"""The end of a motion, motions of several stages, members of a batch, and motions without states."""

import dataclasses
from typing import ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from scenarios import Derived
from trajectories import bounced, motion_of

import jaxmb as mb
from jaxmb import planar
from jaxmb.trajectory import at_rows, picture_of

MOST_PROGRAMS = 160

G, MASS, HEAVY = 10.0, 2.0, 5.0
FIRST, LATER = np.linspace(0.0, 0.4, 3), np.linspace(0.4, 1.0, 4)


@pytest.fixture(scope="module")
def stone():
    stone = planar.Body("stone", mass=MASS, inertia=0.1)
    return mb.Scene([stone], forces=[mb.Gravity((0.0, -G))]).compile()


def thrown(system, ts, speed=3.0):
    """A stone that is thrown upward, in closed form."""
    ts = jnp.asarray(ts)
    still = jnp.zeros_like(ts)
    q = jnp.stack([still, speed * ts - G * ts**2 / 2, still], axis=1)
    return motion_of(system, ts, q, jnp.stack([still, speed - G * ts, still], axis=1))


@pytest.fixture(scope="module")
def heavy(stone):
    return mb.with_parameters(stone, {"stone.mass": HEAVY})


@pytest.fixture(scope="module")
def joined(stone, heavy):
    return thrown(stone, FIRST) + thrown(heavy, LATER)


# The end


def test_end_is_the_last_state_that_a_run_reached(stone):
    motion = thrown(stone, [0.0, 0.2, 0.4])
    early = dataclasses.replace(motion, ts=jnp.array([0.0, 0.2, jnp.inf]))
    for run, k in ((motion, 2), (early, 1), (at_rows(motion, np.array([0])), 0)):
        assert isinstance(run.end, mb.State) and run.end.z is None
        np.testing.assert_array_equal(run.end.q, motion.ys.q[k])
        np.testing.assert_array_equal(run.end.u, motion.ys.u[k])


@pytest.mark.slow
def test_end_of_a_batch_of_a_traced_run_and_of_one_that_an_event_ends(stone):
    motion = thrown(stone, [0.0, 0.2, 0.4])
    early = dataclasses.replace(motion, ts=jnp.array([0.0, 0.2, jnp.inf]))
    several = jax.tree.map(lambda *x: jnp.stack(x), motion, early)
    np.testing.assert_array_equal(several.end.q, motion.ys.q[jnp.array([2, 1])])
    last = jax.jit(lambda ts: dataclasses.replace(motion, ts=ts).end.u)(early.ts)
    np.testing.assert_array_equal(last, motion.ys.u[1])
    along = lambda speed: dataclasses.replace(thrown(stone, FIRST, speed), ts=early.ts).end.q[1]
    assert jax.grad(along)(3.0) == pytest.approx(0.2) and jax.jacfwd(along)(3.0) == pytest.approx(0.2)

    lands = diffrax.Event(lambda t, y, args, **others: y.u[1], optimistix.Newton(1e-10, 1e-10))
    saveat = diffrax.SaveAt(ts=jnp.array([0.1, 0.2, 4.0, 5.0]), t1=True)
    run = lambda state: mb.simulate(stone, state, t1=9.0, event=lands, saveat=saveat)
    state = mb.State(jnp.zeros(3), jnp.array([0.0, 3.0, 0.0]))
    rise, padded = run(state), eqx.filter_jit(run)(state)
    assert rise.end.q[1] == pytest.approx(9 / (2 * G)) and rise.ts.size == 3 and padded.ts.size == 5
    np.testing.assert_allclose(padded.end.q, rise.end.q)
    fall = mb.simulate(stone, rise.end, t0=0.3, t1=0.6, rtol=1e-10)
    assert fall.end.q[1] == pytest.approx(0.0, abs=1e-8)


@pytest.mark.slow
def test_end_of_a_stage_has_derivatives():
    spring = planar.SpringDamper("spring", "ground", "stone", stiffness=30.0, damping=0.5, free_length=0.3)
    hung = mb.Scene([planar.Body("stone", mass=MASS, inertia=0.1, position=(0.5, 0.0))], forces=[spring]).compile()

    def reached(x, rtol):
        system, times = mb.with_parameters(hung, {"stone.mass": x[0]}), jnp.linspace(0.0, 0.5, 3)
        state = mb.State(hung.guess.q, x[1] * jnp.array([0.0, 1.0, 0.0]))
        first = mb.simulate(system, state, t1=0.5, rtol=rtol, saveat=times)
        later = mb.simulate(system, first.end, t0=0.5, t1=1.0, rtol=rtol, saveat=0.5 + times)
        both = first + later
        return jnp.stack([jnp.sum(both.energy), later.end.q[0], both["stone"].position[1, 1]])

    Derived(reached, [1.3, 0.1], near=1e-5).check()


# Stages


def test_views_of_a_joined_motion_are_those_of_its_stages(stone, heavy, joined):
    ts = np.concatenate([FIRST[:-1], LATER])
    height, speed = 3.0 * ts - G * ts**2 / 2, 3.0 - G * ts
    mass = np.where(ts < 0.4, MASS, HEAVY)
    np.testing.assert_array_equal(joined.ts, ts)
    np.testing.assert_allclose(joined["stone"].position[:, 1], height, atol=1e-15)
    np.testing.assert_allclose(joined.kinetic_energy, mass * speed**2 / 2, rtol=1e-14)
    np.testing.assert_allclose(joined.energy, mass * (speed**2 / 2 + G * height), rtol=1e-14)
    np.testing.assert_allclose(joined.linear_momentum[:, 1], mass * speed, rtol=1e-14)
    np.testing.assert_allclose(joined.rates[:, 1], speed, rtol=1e-14)
    assert joined.trimmed().ts.shape == ts.shape and "stone" in joined and joined.undetermined_reactions == ()
    np.testing.assert_array_equal(joined.end.q, thrown(heavy, LATER).end.q)
    # A third stage, and rows in both directions of time.
    third = joined + thrown(stone, [1.0, 1.5])
    assert len(third.stages) == 3 and third.ts.size == 7
    rows = np.array([6, 3, 0])
    np.testing.assert_allclose(at_rows(third, rows).energy, third.energy[rows], rtol=1e-15)
    np.testing.assert_allclose(picture_of(third).positions["stone"][:, 1], third["stone"].position[:, 1])
    with pytest.raises(ValueError, match=r"loads takes a single run; motion\.stages"):
        mb.loads(third, "stone")


@pytest.mark.slow
def test_tables_and_events_of_joined_motions(joined):
    table = joined.to_xarray()
    np.testing.assert_array_equal(table.t, joined.ts)
    np.testing.assert_array_equal(table["energy"], joined.energy)
    assert table.indexes["t"].is_monotonic_increasing and table.indexes["t"].is_unique
    assert joined.to_pandas().shape == (6, 8) and joined.to_dict()["stone.angle"].shape == (6,)

    bounce = bounced()
    found = bounce.found_events._replace(times=jnp.array([2.5]))
    ys = dataclasses.replace(bounce.ys, q=bounce.ys.q.at[0].set(bounce.end.q))
    later = dataclasses.replace(bounce, ts=bounce.ts + 1.5, found_events=found, ys=ys)
    assert [event.time for event in (bounce + later).events] == pytest.approx([1.0, 2.5])


def test_motions_that_do_not_meet(stone, heavy, joined):
    first = thrown(stone, FIRST)
    for later, message in (
        (thrown(heavy, [0.5, 1.0]), r"saved until t = 0\.4, and the later from t = 0\.5 on"),
        (joined, r"saved until t = 0\.4, and the later from t = 0 on"),
        (thrown(heavy, LATER, 4.0), r"begins elsewhere: 'stone\.y' is 0\.4 where the first ends, and 0\.8 where"),
        (thrown(heavy, LATER, jnp.nan), "begins elsewhere"),
        (dataclasses.replace(first, ys=None), "This motion has no states, since it saved nothing"),
        (jax.tree.map(lambda x: x[None], thrown(heavy, LATER)), "batches of other shapes"),
    ):
        with pytest.raises(ValueError, match=message):
            first + later
    ball = mb.Scene([planar.Body("ball", mass=1.0, inertia=0.1)]).compile()
    with pytest.raises(ValueError, match=r"one of these has ball\.acceleration, .*stone\.position"):
        first + thrown(ball, LATER)
    with pytest.raises(TypeError):
        first + 1.0
    # Under jit the numbers are unknown.
    ends = eqx.filter_jit(lambda speed: (first + thrown(heavy, LATER, speed)).energy)
    assert np.all(np.isfinite(ends(3.0))) and np.isnan(ends(4.0)[2:]).all() and np.isfinite(ends(4.0)[:2]).all()


@pytest.mark.slow
def test_states_at_any_time_of_a_joined_motion(stone, heavy):
    state = mb.State(jnp.zeros(3), jnp.array([0.0, 3.0, 0.0]))
    for sign in (1.0, -1.0):
        dense = lambda t0, t1: diffrax.SaveAt(dense=True, ts=jnp.array([t0, t1]))
        first = mb.simulate(stone, state, t1=0.4 * sign, saveat=dense(0.0, 0.4 * sign))
        later = mb.simulate(heavy, first.end, t0=0.4 * sign, t1=sign, saveat=dense(0.4 * sign, sign))
        both, ts = first + later, sign * jnp.array([0.1, 0.4, 0.7, 1.0])
        np.testing.assert_allclose(both.at(ts).q[:, 1], 3.0 * ts - G * ts**2 / 2, atol=1e-9)
        assert np.isnan(both.at(sign * 1.1).q).all() and np.isnan(both.at(-sign * 0.1).q).all()
        slope = jax.jacrev(lambda t, both=both: both.at(t).q[1])(0.1 * sign)
        assert slope == pytest.approx(3.0 - G * 0.1 * sign, rel=1e-7)


# Members of a batch


def test_a_batch_has_members(stone):
    states = [thrown(stone, FIRST, speed) for speed in (1.0, 2.0)]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *states)
    assert len(batch) == 2 and "stone" in batch
    for own, alone in zip(batch, states, strict=True):
        np.testing.assert_array_equal(own.ys.q, alone.ys.q)
    np.testing.assert_array_equal(batch[-1].end.u, states[1].end.u)
    for index, message in ((2, "index 2 is out of bounds"), ((0, 0), "too many indices")):
        with pytest.raises(IndexError, match=message):
            batch[index]
    with pytest.raises(IndexError, match=r"single motion, which has parts by their names, such as motion\['stone'\]"):
        batch[0][0]
    table = batch.to_xarray("stone.angle")
    assert table["stone.angle"].dims == ("member", "t") and np.array_equal(table.t, FIRST)


@pytest.mark.slow
def test_batch_has_views_members_of_members_and_stages(stone):
    speeds = jnp.array([1.0, 2.0, 3.0])
    of_speeds = lambda ts: jax.vmap(lambda speed: thrown(stone, ts, speed))
    batch = of_speeds(FIRST)(speeds)
    for k, member in enumerate(batch):
        alone = thrown(stone, FIRST, speeds[k])
        for own in (member, batch[k], batch[k - 3], batch[1:][k - 1] if k else member, batch[np.array([k, 0])][0]):
            np.testing.assert_array_equal(own.energy, alone.energy)
            np.testing.assert_array_equal(own["stone"].position, alone["stone"].position)
    np.testing.assert_array_equal(jax.jit(lambda k: batch[k].end.q)(2), batch[2].end.q)
    grid = jax.tree.map(lambda x: x[None], batch)
    np.testing.assert_array_equal(grid[0, 2].energy, batch[2].energy)
    assert grid[0].ts.shape == batch.ts.shape and len(grid) == 1
    both = batch + of_speeds(LATER)(speeds)
    np.testing.assert_allclose(both.energy, np.broadcast_to(MASS * speeds[:, None] ** 2 / 2, (3, 6)), rtol=1e-13)
    np.testing.assert_array_equal(both[1].energy, both.energy[1])
    with pytest.raises(ValueError, match="begins elsewhere"):
        batch + of_speeds(LATER)(speeds[::-1])


@pytest.mark.slow
def test_a_batch_as_xarray(stone):
    speeds = jnp.array([1.0, 2.0])
    batch = jax.vmap(lambda speed: thrown(stone, FIRST, speed))(speeds)
    table = batch.to_xarray(["stone.position", "energy"])
    assert table["stone.position"].dims == ("member", "t", "axis") and table["energy"].dims == ("member", "t")
    np.testing.assert_array_equal(table.t, FIRST)
    np.testing.assert_array_equal(table["energy"].isel(member=1), batch[1].to_xarray(["energy"])["energy"])
    early = dataclasses.replace(batch, ts=batch.ts.at[0, 2].set(jnp.inf))
    np.testing.assert_array_equal(early.to_xarray().t, FIRST)
    apart = dataclasses.replace(batch, ts=batch.ts.at[0].add(0.1)).to_xarray(["energy"])
    assert apart["energy"].dims == ("member", "save") and apart.t.dims == ("member", "save")
    grid = jax.tree.map(lambda x: x[None], batch).to_xarray("stone.angle")
    assert grid["stone.angle"].dims == ("member_0", "member_1", "t")
    with pytest.raises(ValueError, match=r"batch of shape \(2,\); choose a member, such as batch\[0\], or take"):
        batch.to_pandas()


# Motions without states, and systems of one's own

VIEWS = {
    "energy": lambda motion: motion.energy,
    "a body": lambda motion: motion["stone"],
    "a quantity": lambda motion: motion.quantity("stone.position"),
    "accelerations": lambda motion: motion.accelerations,
    "rates": lambda motion: motion.rates,
    "forces": lambda motion: motion.forces["weight"],
    "violation": lambda motion: motion.constraint_violation,
    "shares": lambda motion: motion.undetermined_reactions,
    "a table": lambda motion: motion.to_xarray(),
    "a dictionary": lambda motion: motion.to_dict(),
    "a file": lambda motion: motion.save("motion.npz"),
    "the end": lambda motion: motion.end,
    "a picture": lambda motion: mb.viz.plot_mechanism(motion),
    "a plot": lambda motion: mb.viz.plot_motion(motion),
    "loads": lambda motion: mb.loads(motion, "stone"),
}


def test_views_of_motions_that_saved_no_states_say_so():
    push = planar.PointForce("weight", "stone", point=(0.0, 0.0), force=(0.0, -1.0))
    system = mb.Scene([planar.Body("stone", mass=MASS, inertia=0.1)], forces=[push]).compile()
    motion = thrown(system, FIRST)
    heights = dataclasses.replace(motion, ys=motion.ys.q[:, 1])
    assert str(heights.trimmed()) and heights.ts.shape == (3,)
    for view in VIEWS.values():
        with pytest.raises(ValueError, match=r"no states, since it saved the values of SaveAt\(fn=…\) in motion\.ys"):
            view(heights)


class Swing(mb.system.AbstractSystem):
    """A pendulum in one coordinate, with scales that are plain numbers."""

    mass: jax.Array
    guess: mb.State
    length: float = 1.0
    design: tuple = ()
    nq: ClassVar[int] = 1
    nu: ClassVar[int] = 1

    def coordinate_names(self):
        return {"angle": [0]}

    def coordinate_scale(self):
        return jnp.ones(1)

    def velocity_scale(self):
        return jnp.ones(1)

    def inertia(self, t, q, u):
        return mb.system.DiagonalInertia(self.mass * jnp.ones(1))

    def force(self, t, q, u):
        return -G * self.mass * jnp.sin(q)

    def kinetic_energy(self, t, q, u):
        return 0.5 * self.mass * jnp.vdot(u, u)

    def potential_energy(self, t, q):
        return -G * self.mass * jnp.cos(q[0])


def test_views_and_messages_of_a_system_with_plain_numbers():
    swing = Swing(jnp.ones(()), mb.State(jnp.array([0.5]), jnp.zeros(1)))
    ts, q = jnp.linspace(0.0, 1.0, 3), jnp.array([[0.5], [0.1], [-0.4]])
    motion = motion_of(swing, ts, q, -q)
    np.testing.assert_array_equal(motion["angle"], q[:, 0])
    np.testing.assert_array_equal(motion["angle_rate"], -q[:, 0])
    np.testing.assert_allclose(motion.energy, q[:, 0] ** 2 / 2 - G * np.cos(q[:, 0]))
    assert {"angle", "angle_rate", "energy"} <= motion.to_dict().keys() and "angle" in motion
    shown = dataclasses.replace(motion, stats={"num_steps": jnp.array(7)})
    assert str(shown).endswith("in 7 steps; successful\nNames: angle, angle_rate")
    with pytest.raises(mb.UnknownNameError, match="did you mean 'angle'"):
        mb.assemble(swing, fix={"angel": 0.0})
    with pytest.raises(mb.UnknownNameError, match="did you mean 'angle'"):
        motion["angel"]
    # The scale stays a plain number in a batch that is made by equinox.
    batch = eqx.filter_vmap(lambda k: motion_of(swing, ts, k * q, -q))(jnp.array([1.0, 2.0]))
    np.testing.assert_array_equal(batch["angle_rate"][1], -q[:, 0])
    np.testing.assert_array_equal(batch[1]["angle"], 2 * q[:, 0])
