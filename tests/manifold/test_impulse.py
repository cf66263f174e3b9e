"""Drivers and forces with kinks and jumps that are announced."""

import warnings
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from driven_arm import AFTER, BEFORE, END, INERTIA, MASS, WHEN, A, B, G, driven_arm
from scipy.integrate import solve_ivp

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.linalg.recent import Recent
from jaxmb.manifold.impulse import after_jumps, find_jumps
from jaxmb.simulate import outcome


@pytest.fixture(scope="module")
def arm():
    return driven_arm()


def angle_of_rod(before=BEFORE, after=AFTER):
    """The rod's angle and rate at the jump and in the end, in minimal coordinates."""
    moment, coupling = INERTIA + MASS * B**2, MASS * A * B

    def rates(t, y, rate, start):
        arm = start + rate * t
        return [y[1], (coupling * rate**2 * np.sin(arm - y[0]) - MASS * G * B * np.cos(y[0])) / moment]

    solve = lambda y, span, *args: solve_ivp(rates, (0.0, span), y, args=args, rtol=1e-12, atol=1e-13).y[:, -1]
    angle, rate = solve([0.0, 0.0], WHEN, before, 0.0)
    # Its moment of momentum about the elbow does not jump.
    rate = rate - coupling * np.cos(before * WHEN - angle) * (after - before) / moment
    return np.array([angle, rate]), solve([angle, rate], END - WHEN, after, before * WHEN)


def run(arm, values=None, **options):
    system = arm if values is None else mb.with_parameters(arm, values)
    start = mb.assemble(system, rates={"rod.angle": 0.0})
    options = {"jumps": [WHEN], "saveat": [WHEN, END], "rtol": 1e-10} | options
    return mb.simulate(system, start, t1=END, **options)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [{}, {"manifold": mb.manifold.Projection()}, {"solver": mb.solvers.Hermite()}],
    ids=["chart", "projection", "implicit"],
)
def test_jump_of_a_driver_is_an_impulse(arm, options):
    motion = run(arm, **options)
    found = np.stack([motion["rod"].angle, motion["rod"].angular_velocity], axis=1)
    np.testing.assert_allclose(found, np.stack(angle_of_rod()), rtol=0, atol=1e-7)
    np.testing.assert_allclose(motion["arm"].angular_velocity, AFTER, rtol=0, atol=1e-9)
    assert np.all(motion.constraint_violation.velocity < 1e-9)


@pytest.mark.slow
def test_derivatives_at_a_jump_and_over_it(arm):
    """Of the rod's rate just after it, and of the angle at the end; members of a batch jump each at its time."""

    def seen(x, when=WHEN):
        values = {"drive.before": x[0], "drive.after": x[1], "drive.when": when}
        dense = diffrax.SaveAt(t1=True, dense=True)
        motion = run(arm, values, jumps=jnp.stack([when]), saveat=dense, max_steps=256)
        return jnp.stack([motion.at(when).u[5], motion["rod"].angle[-1]])

    x, h = jnp.array([BEFORE, AFTER]), 1e-4
    forward, reverse = jax.jit(jax.jacfwd(seen))(x, WHEN), jax.jit(jax.jacrev(seen))(x, WHEN)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)
    oracle = lambda x: (lambda both: np.array([both[0][1], both[1][0]]))(angle_of_rod(*x))
    differences = [(oracle(x + h * e) - oracle(x - h * e)) / (2 * h) for e in np.eye(2)]
    np.testing.assert_allclose(forward, np.transpose(differences), rtol=0, atol=1e-6)
    together = jax.jit(jax.vmap(seen, (None, 0)))(x, jnp.array([0.3, WHEN]))
    np.testing.assert_allclose(together[1], oracle(x), rtol=0, atol=1e-6)
    assert abs(together[0, 1] - together[1, 1]) > 1e-2


def test_times_at_jumps_move_beyond_them_with_derivative_one():
    shifted = lambda times: after_jumps(times, np.array([0.5]), 0.0, 1.0)
    found, slope = jax.jit(lambda times: (shifted(times), jax.jacrev(shifted)(times)))(np.array([0.2, 0.5, 1.0]))
    np.testing.assert_array_equal(found, [0.2, np.nextafter(0.5, 1.0), np.nextafter(1.0, 0.0)])
    np.testing.assert_array_equal(slope, np.eye(3))


REFUSED: list[tuple[Any, str]] = [
    ({"jumps": [np.nan]}, "jumps must not be NaN"),
    ({"jumps": [np.inf]}, "jumps must be a vector of finite times"),
    ({"jumps": 0.3}, "jumps must be a vector of finite times"),
    ({"jumps": ["soon"]}, "jumps must be an array of real numbers"),
    ({"jumps": [WHEN], "manifold": mb.manifold.Baumgarte()}, "a constrained system needs manifold="),
]


def test_refused(arm):
    for changes, message in REFUSED:
        with pytest.raises(ValueError, match=message):
            mb.simulate(arm, arm.guess, t1=END, **changes)


# States between steps


@pytest.mark.slow
def test_states_at_a_jump_are_those_after_it(arm):
    """Of a run over the jump, and of one back to its start, saved and between steps."""
    start = mb.assemble(arm, rates={"rod.angle": 0.0})
    both: Any = {"jumps": jnp.array([WHEN]), "rtol": 1e-9, "max_steps": 512}
    saved: Any = lambda *ts: {"saveat": diffrax.SaveAt(ts=jnp.array(ts), dense=True)}
    forward = mb.simulate(arm, start, t1=END, **both, **saved(0.0, WHEN, END))
    end = jax.tree.map(lambda y: y[-1], forward.ys)
    back = mb.simulate(arm, end, t0=END, t1=0.0, **both, **saved(END, WHEN, 0.0))
    np.testing.assert_array_equal(back.ts, [END, WHEN, 0.0])
    np.testing.assert_allclose(back["rod"].angular_velocity[-1], 0.0, rtol=0, atol=1e-7)
    (angle, after), _ = angle_of_rod()
    # Before the jump no impulse has turned the rod: its moment of momentum about the elbow is the same.
    before = after + MASS * A * B * np.cos(BEFORE * WHEN - angle) * (AFTER - BEFORE) / (INERTIA + MASS * B**2)
    for motion in (forward, back):
        between = motion.at(jnp.array([np.nextafter(WHEN, 0.0), WHEN, np.nextafter(WHEN, 1.0)]))
        np.testing.assert_allclose(between.u[:, 5], [before, after, after], rtol=0, atol=1e-6)
        np.testing.assert_allclose(between.u[:, 2], [BEFORE, AFTER, AFTER], rtol=0, atol=1e-9)
        np.testing.assert_allclose(motion["rod"].angular_velocity[1], after, rtol=0, atol=1e-6)
        assert np.all(motion.constraint_violation.velocity < 1e-9)
        assert np.all(np.isnan(motion.at(2 * END).q)) and np.all(np.isfinite(motion.at(jnp.array([0.0, END])).q))


# The search for jumps that nobody announced


def motion_of(t, p):
    wave = p["amplitude"] * jnp.sin(p["frequency"] * t) + p["step"] * jnp.tanh(p["steepness"] * (t - 0.55))
    kink = lambda when, rate: jnp.where(t < when, 0.0 * t, rate * (t - when))
    return wave + kink(p["first"], p["rate"]) + kink(p["second"], p["rate"])


NUMBERS = {
    "amplitude": 0.0,
    "frequency": 3.0,
    "step": 0.0,
    "steepness": 300.0,
    "first": 9.0,
    "second": 9.0,
    "rate": 1.0,
}


@pytest.fixture(scope="module")
def two_driven():
    bodies = [planar.Body(name, mass=1.0, inertia=0.1) for name in ("a", "b")]
    turn = lambda name: planar.Driver(
        f"turn {name}", "ground", name, quantity="angle", motion=motion_of, parameters=NUMBERS
    )
    return mb.Scene(bodies, joints=[turn("a"), turn("b")]).compile()


SMOOTH = {"amplitude": 1.0}
KINKED = SMOOTH | {"first": 1 / 3}
# The numbers of both drivers, the restarts, and the jumps: the row of which driver, and when.
SEARCHED = {
    "none": (SMOOTH, SMOOTH, [], []),
    "fast": ({"amplitude": 1.0, "frequency": 150.0}, {"step": 0.1}, [], []),
    "one": (KINKED, SMOOTH, [], [("a", 1 / 3)]),
    "behind a steep step": ({"step": 0.1}, KINKED, [], [("b", 1 / 3)]),
    "behind a fast driver": ({"amplitude": 5.0, "frequency": 60.0}, KINKED, [], [("b", 1 / 3)]),
    "behind a driver a million times as fast": ({"amplitude": 1e7}, KINKED, [], [("b", 1 / 3)]),
    "on a fast driver": ({"amplitude": 0.1, "frequency": 60.0, "first": 0.7}, SMOOTH, [], [("a", 0.7)]),
    "beside a restart": (KINKED, SMOOTH, [0.3, 0.5], [("a", 1 / 3)]),
    "at a restart": (KINKED, SMOOTH, [1 / 3], []),
    "between many restarts": (KINKED, SMOOTH, np.linspace(0.05, 0.95, 19), [("a", 1 / 3)]),
    "two rows": (KINKED, SMOOTH | {"first": 0.8}, [], [("a", 1 / 3), ("b", 0.8)]),
    "one of two is known": (KINKED | {"second": 0.8}, SMOOTH, [1 / 3], [("a", 0.8)]),
    "both of two": (KINKED | {"second": 0.8}, SMOOTH, [0.5], [("a", 1 / 3), ("a", 0.8)]),
    "small": (KINKED | {"rate": 1e-3}, SMOOTH, [], [("a", 1 / 3)]),
    "late": (KINKED | {"first": 1 - 1e-4}, SMOOTH, [], [("a", 1 - 1e-4)]),
}


@pytest.mark.parametrize("case", SEARCHED)
def test_every_row_is_searched_between_all_restarts(two_driven, case):
    *numbers, restarts, expected = SEARCHED[case]
    values = {
        f"turn {name}.{key}": value
        for name, own in zip("ab", numbers, strict=True)
        for key, value in (NUMBERS | own).items()
    }
    system = mb.with_parameters(two_driven, values)
    names = [*system.rows[: system.velocity_rows], *system.rows]
    for ends in ((0.0, 1.0), (1.0, 0.0)):
        jumps = find_jumps(system, system.guess.q, *ends, restarts)
        found = sorted({(float(jump.t), names[jump.row][0][-1]) for jump in jumps})
        # To the last digit, since a restart elsewhere would miss it.
        assert found == [(when, name) for name, when in expected]


@pytest.mark.slow
@pytest.mark.parametrize("turns, kinks", [(1.2, []), (300.0, []), (8.0, [0.7])])
def test_only_the_kink_of_turns_in_space_is_found(turns, kinks):
    """Rows of angles in space wrap half a turn away, in rapid turns within each interval that is looked at."""
    speed, later = 2 * np.pi * turns, 0.5 * len(kinks)
    motion = lambda t, p: speed * (t + jnp.where(t < 0.7, 0.0, later * (t - 0.7)))
    axis = {"axis": (0.0, 0.6, 0.8)}
    joints = [
        spatial.Revolute("hinge", "ground", "arm", point=(0.0, 0.0, 0.0), **axis),
        spatial.Driver("drive", "ground", "arm", quantity="angle", motion=motion, **axis),
    ]
    system = mb.Scene([spatial.Body("arm", mass=1.0, inertia=(0.1, 0.2, 0.2))], joints=joints).compile()
    assert sorted({float(jump.t) for jump in find_jumps(system, system.guess.q, 0.0, 1.0, [])}) == kinks


@pytest.mark.slow
def test_jump_that_is_not_announced_is_warned_of(arm, monkeypatch):
    """Each time, by one search a system and interval; a kink as well, and one between restarts of an input."""
    searches, known = [], outcome.find_jumps
    monkeypatch.setattr(outcome, "find_jumps", lambda *own: searches.append(own) or known(*own))
    monkeypatch.setattr(outcome, "_jumps", Recent(8))

    def warned(system=arm, **options):
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            mb.simulate(system, mb.assemble(system), **({"t1": 1.0, "rtol": 1e-4} | options))
        told = [str(warning.message) for warning in found if "jump" in str(warning.message)]
        assert all("'drive' prescribes" in text for text in told)
        return [text.split(" t = ")[1][:3] + text.split("jumps=")[1][:12] for text in told]

    once = ["0.6[0.6]"]
    assert [[text[:8] for text in warned()] for _ in range(3)] == [once] * 3 and len(searches) == 1
    assert warned(t1=0.5) == [] and len(searches) == 2
    assert warned(jumps=[0.6]) == [] and len(searches) == 3
    assert [text[:8] for text in warned()] == once and len(searches) == 3
    assert [text[:13] for text in warned(jumps=[0.3])] == ["0.6[0.3, 0.6]"]
    pushed = driven_arm(planar.Torque("push", "rod", torque=0.0))
    pushed = mb.with_inputs(pushed, {"push.torque": mb.Series([0.0, 0.2, 2.0], [0.0, 1.0, 1.0], "held")})
    assert [text[:8] for text in warned(pushed)] == once
    body = planar.Body("arm", mass=1.0, inertia=0.1)
    for motion, expected in (
        (lambda t, p: jnp.where(t < 0.6, 0.0 * t, (t - 0.6) ** 2), once),
        (lambda t, p: 0.1 * jnp.tanh(100.0 * (t - 0.6)), []),
    ):
        drive = planar.Driver("drive", "ground", "arm", quantity="angle", motion=motion)
        assert [text[:8] for text in warned(mb.Scene([body], joints=[drive]).compile())] == expected
