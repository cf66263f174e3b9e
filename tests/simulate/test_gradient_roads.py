"""Gradients along every other road to a motion: solvers, formulations, saved times, events, kinds of constraints.

On small planar scenes with a spring; as in `test_gradients`, forward mode = reverse mode, and both = central
differences of a tighter solution.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sprung_pendulums import GRAVITY, HANGING, SPRING, double_pendulum, pendulum, rod

import jaxmb as mb
from jaxmb import planar

pytestmark = pytest.mark.slow


def driven_pendulum():
    """Nothing is free: the driver says where the rod is."""
    turn = lambda t, p: p["amplitude"] * jnp.sin(p["rate"] * t)
    drive = planar.Driver(
        "drive", "ground", "rod", quantity="angle", motion=turn, parameters={"amplitude": 0.7, "rate": 3.0}
    )
    system, _, _, _ = pendulum(drive)
    return system, ["pin.point_b", "drive.amplitude", "drive.rate"], {}, None


def steady_particle(*laws):
    """The speed of the mass centre is kept by a constraint that is not linear in it."""
    speed = lambda poses, velocities, t, p: velocities[0, 0] ** 2 + velocities[0, 1] ** 2 - p["speed"] ** 2
    pace = mb.VelocityConstraint("pace", "rod", speed, parameters={"speed": 1.2})
    system = mb.Scene([rod()], joints=[pace], forces=[SPRING, GRAVITY, *laws]).compile()
    return system, ["rod.mass", "rod.inertia", "spring.stiffness", "pace.speed"], {}, "rod.y"


def rubbing_particle():
    """The same with a constraint that is not ideal: it turns the rod and its path, by a share of its force."""
    turning = lambda poses, velocities, reactions, t, p: (
        p["share"] * jnp.stack([-reactions[:, 1], reactions[:, 0], 0.3 * reactions[:, 0]], axis=1)
    )
    system, names, *rest = steady_particle(mb.NonIdeal("rub", "pace", turning, parameters={"share": 0.4}))
    return system, [*names, "rub.share"], *rest


def at_the_end(sol):
    return jnp.concatenate([sol.ys.q[-1], sol.ys.u[-1]])


def at_all_times(sol):
    return jnp.concatenate([sol.ys.q, sol.ys.u], axis=1).ravel()


def when_it_happens(sol):
    return jnp.concatenate([sol.ts[-1:], sol.ys.q[-1], sol.ys.u[-1]])


TIMES = np.array([0.07, 0.2, 0.31, 0.5])


ROADS = {
    "projection": (double_pendulum, {"solver": diffrax.Dopri8()}, at_the_end),
    "projection by Adams": (double_pendulum, {"manifold": mb.manifold.Projection()}, at_the_end),
    "multipliers, saved times": (
        double_pendulum,
        {"formulation": mb.formulations.Multipliers(), "saveat": TIMES},
        at_all_times,
    ),
    "event": (pendulum, {"event": HANGING}, when_it_happens),
    "nonlinear in velocity": (steady_particle, {}, at_the_end),
    "nonlinear in velocity, implicit": (steady_particle, {"solver": mb.solvers.Hermite()}, at_the_end),
    "nonlinear in velocity, not ideal, implicit": (rubbing_particle, {"solver": mb.solvers.Hermite()}, at_the_end),
    "fully driven": (driven_pendulum, {"saveat": TIMES}, at_all_times),
}


def build(road):
    scene, options, observe = ROADS[road]
    system, names, fix, rate = scene()
    start = {name: mb.parameters(system)[name] for name in names}
    if rate is not None:
        start["initial rate"] = jnp.array(0.4)

    def loss(values, rtol):
        values = dict(values)
        rates = {} if rate is None else {rate: values.pop("initial rate")}
        changed = mb.with_parameters(system, values)
        state = mb.assemble(changed, fix=fix, rates=rates, throw=False)
        sol = mb.simulate(changed, state, t1=0.5, rtol=rtol, max_steps=512, throw=False, **options)
        seen = observe(sol)
        return jnp.sum(jnp.cos(jnp.arange(seen.size, dtype=float)) * seen)

    return loss, start


@pytest.mark.parametrize("road", ROADS)
def test_forward_reverse_and_central_differences(road):
    loss, start = build(road)
    flat, unravel = jax.flatten_util.ravel_pytree(start)
    run = lambda x, rtol: loss(unravel(x), rtol)
    twice = lambda x, rtol: (run(x, rtol),) * 2
    # One program for derivatives and, at a tighter tolerance, for differences.
    derivatives_and_value = jax.jit(jax.jacfwd(twice, has_aux=True))
    forward, _ = derivatives_and_value(flat, 1e-10)
    reverse = jax.jit(jax.grad(lambda x: run(x, 1e-10)))(flat)
    scale = np.max(np.abs(forward))
    assert np.all(np.abs(forward) > 1e-6 * scale)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-9 * scale)

    h = 1e-4 * np.maximum(np.abs(flat), 1e-2)
    value = lambda k: np.array([derivatives_and_value(flat + k * step, 1e-13)[1] for step in np.diag(h)])
    plain, double = (value(1.0) - value(-1.0)) / (2 * h), (value(2.0) - value(-2.0)) / (4 * h)
    # Richardson's extrapolation of central differences, so that their own error is below the one tested.
    np.testing.assert_allclose(forward, (4 * plain - double) / 3, rtol=1e-5, atol=1e-7 * scale)
