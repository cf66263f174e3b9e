"""A run that fails for several reasons has one result: that of the first reason, in a fixed order."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import RESULTS, planar
from jaxmb.simulate.outcome import first_of

# In their order.
REASONS = {
    "parameter": RESULTS.invalid_parameters,
    "start": RESULTS.assembly_failed,
    "backward": RESULTS.impacts_backward,
    "events": RESULTS.too_many_events,
    "steps": RESULTS.max_steps_reached,
    "input": RESULTS.input_ended,
    "saved": RESULTS.saved_outside,
}
SETS = [set(own) for count in (0, 1, 2, 7) for own in itertools.combinations(REASONS, count)]


@pytest.fixture(scope="module")
def results():
    """Those of a bouncing ball, of each set of reasons, from one program."""
    ball = planar.Body("ball", mass=1.0, inertia=planar.disc(1.0, 0.1), position=(0.0, 0.5))
    floor = mb.RigidContact("floor", "ball", terrain=mb.terrain.Flat(), radius=0.1, restitution=0.0)

    def law(poses, velocities, t, p):
        return jnp.stack([p["size"] + p["shift"] + 0.01 * jnp.sin(p["rate"] * t), 0.0 * t, 0.0 * t])[None]

    push = mb.Force("push", "ball", law, parameters={"size": 0.0, "rate": 1.0, "shift": 0.0})
    system = mb.Scene([ball], joints=[floor], forces=[mb.Gravity((0.0, -9.81)), push]).compile()
    state = mb.assemble(system)

    def result(*holds):
        own = dict(zip(REASONS, holds, strict=True))
        numbers = {
            "ball.mass": jnp.where(own["parameter"], -1.0, 1.0),
            "floor.restitution": jnp.where(own["events"], 0.9, 0.0),
            "push.rate": jnp.where(own["steps"], 1e5, 1.0),
        }
        size = mb.Series(jnp.where(own["input"], 0.1, 10.0) * jnp.array([0.0, 1.0]), jnp.zeros(2))
        motion = mb.simulate(
            mb.with_parameters(system, numbers),
            mb.State(jnp.where(own["start"], jnp.nan, state.q), state.u),
            t1=jnp.where(own["backward"], -2.0, 2.0),
            saveat=jnp.where(own["backward"] ^ own["saved"], -1, 1) * jnp.array([0.0, 0.4, 0.8]),
            inputs={"push.size": size, "push.shift": lambda t: 0.0 * t},
            max_steps=1000,
            max_events=3,
        )
        return motion.result

    holds = jnp.array([[name in own for name in REASONS] for own in SETS])
    return jax.jit(jax.vmap(result))(*holds.T)


@pytest.mark.slow
def test_first_reason_counts(results):
    for k, own in enumerate(SETS):
        # Events need steps, and an endless step has none.
        holds = own - ({"events"} if {"steps", "events"} <= own else set())
        expected = next((reason for name, reason in REASONS.items() if name in holds), RESULTS.successful)
        assert jax.tree.map(lambda x, k=k: x[k], results) == expected, own


def test_the_first_that_holds():
    reasons = [RESULTS.too_many_events, RESULTS.newton_failed, RESULTS.saved_outside]
    for holds in itertools.product([False, np.array(False), np.array(True)], repeat=3):
        expected = next((own for own, held in zip(reasons, holds, strict=True) if held), RESULTS.successful)
        assert first_of(list(zip(holds, reasons, strict=True)), RESULTS.successful) == expected
