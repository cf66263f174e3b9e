"""Drivers and forces with kinks and jumps that are announced."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxmb as mb
from jaxmb import planar

# A driven arm of length A; on its end a rod with its mass centre at B.
A, B, MASS, INERTIA, G = 0.8, 0.5, 1.5, 0.2, 9.81
BEFORE, AFTER, WHEN, END = 0.4, 2.5, 0.6, 1.1


def turned(t, p):
    """A rate that jumps from `before` to `after`."""
    when = p["when"]
    return jnp.where(t < when, p["before"] * t, p["before"] * when + p["after"] * (t - when))


def driven_arm(*forces):
    bodies = [
        planar.Body("arm", mass=1.0, inertia=0.1, position=(A / 2, 0.0)),
        planar.Body("rod", mass=MASS, inertia=INERTIA, position=(A + B, 0.0)),
    ]
    numbers = {"before": BEFORE, "after": AFTER, "when": WHEN}
    joints = [
        planar.Revolute("pin", "ground", "arm", point=(0.0, 0.0)),
        planar.Revolute("elbow", "arm", "rod", point=(A, 0.0)),
        planar.Driver("drive", "ground", "arm", quantity="angle", motion=turned, parameters=numbers),
    ]
    return mb.Scene(bodies, joints=joints, forces=[mb.Gravity((0.0, -G)), *forces]).compile()


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


@pytest.mark.parametrize(
    "options",
    [
        {},
        pytest.param({"manifold": mb.manifold.Projection()}, marks=pytest.mark.long),
        pytest.param({"solver": mb.solvers.Hermite()}, marks=pytest.mark.long),
        pytest.param({"solver": diffrax.Dopri8()}, marks=pytest.mark.long),
    ],
)
def test_a_jump_of_a_driver_is_an_impulse(arm, options):
    motion = run(arm, **options)
    found = np.stack([motion["rod"].angle, motion["rod"].angular_velocity], axis=1)
    np.testing.assert_allclose(found, np.stack(angle_of_rod()), rtol=0, atol=1e-7)
    np.testing.assert_allclose(motion["arm"].angular_velocity, AFTER, rtol=0, atol=1e-9)
    assert np.all(motion.constraint_violation.velocity < 1e-9)


@pytest.mark.long
def test_derivatives_over_a_jump(arm):
    def end(x, adjoint):
        values = {"drive.before": x[0], "drive.after": x[1]}
        return run(arm, values, adjoint=adjoint, saveat=None, max_steps=512)["rod"].angle[-1]

    x, h = jnp.array([BEFORE, AFTER]), 1e-4
    forward = jax.jit(jax.jacfwd(lambda x: end(x, diffrax.ForwardMode())))(x)
    reverse = jax.jit(jax.grad(lambda x: end(x, None)))(x)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)
    oracle = lambda *x: angle_of_rod(*x)[1][0]
    before = (oracle(BEFORE + h, AFTER) - oracle(BEFORE - h, AFTER)) / (2 * h)
    after = (oracle(BEFORE, AFTER + h) - oracle(BEFORE, AFTER - h)) / (2 * h)
    np.testing.assert_allclose(forward, [before, after], rtol=0, atol=1e-6)


def test_a_force_that_is_switched_on():
    """Exact in few steps, where a jump that nobody announces is found by steps that are too long."""
    law = lambda poses, velocities, t, p: jnp.stack([jnp.where(t < 0.3, 0.0, 2.0), 0.0 * t, 0.0 * t])[None]
    system = mb.Scene([planar.PointMass("body", mass=1.0)], forces=[mb.Force("push", "body", law)]).compile()
    ends = [mb.simulate(system, mb.assemble(system), t1=1.0, jumps=jumps) for jumps in ([0.3], None)]
    np.testing.assert_allclose(ends[0]["body"].position[-1, 0], 0.7**2, rtol=0, atol=1e-13)
    assert ends[0].stats["num_steps"] < 0.5 * ends[1].stats["num_steps"]


@pytest.mark.long
def test_members_of_a_batch_jump_each_at_its_time(arm):
    def end(when):
        return run(arm, {"drive.when": when}, jumps=when[None], saveat=None, rtol=1e-8, max_steps=256)["rod"].angle[-1]

    times = jnp.array([0.3, WHEN])
    together = jax.jit(jax.vmap(end))(times)
    np.testing.assert_allclose(together[1], angle_of_rod()[1][0], rtol=0, atol=1e-6)
    assert abs(together[0] - together[1]) > 1e-2


PROGRAMS = {
    "jump of the rate": lambda t, p: jnp.where(t < 0.6, 0.4 * t, 0.24 + 2.5 * (t - 0.6)),
    "kink of the rate": lambda t, p: jnp.where(t < 0.6, 0.0 * t, (t - 0.6) ** 2),
    "smooth and steep": lambda t, p: 0.1 * jnp.tanh(100.0 * (t - 0.6)),
}


@pytest.mark.parametrize("case", PROGRAMS)
def test_a_jump_that_is_not_announced_is_warned_of(case):
    body = planar.Body("arm", mass=1.0, inertia=0.1)
    drive = planar.Driver("drive", "ground", "arm", quantity="angle", motion=PROGRAMS[case])
    system = mb.Scene([body], joints=[drive]).compile()
    run = lambda: mb.simulate(system, mb.assemble(system), t1=1.0, rtol=1e-5)
    if case == "smooth and steep":
        run()
    else:
        with pytest.warns(UserWarning, match=r"'drive' prescribes has a jump or a kink at t = 0.6,.*jumps=\[0.6\]"):
            run()


REFUSED = {
    "NaN": ({"jumps": [np.nan]}, "jumps must not be NaN"),
    "endless": ({"jumps": [np.inf]}, "jumps must be a vector of finite times"),
    "one number": ({"jumps": 0.3}, "jumps must be a vector of finite times"),
    "words": ({"jumps": ["soon"]}, "jumps must be an array of real numbers"),
    "without impulses": ({"manifold": mb.manifold.Baumgarte()}, "a constrained system needs manifold="),
}


@pytest.mark.parametrize("case", REFUSED)
def test_jumps_that_are_refused(arm, case):
    changes, message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        run(arm, **changes)
