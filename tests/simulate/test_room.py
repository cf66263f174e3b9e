"""What is kept of each step has room for as many steps as a motion takes."""

import diffrax
import jax
import numpy as np
import pytest

import jaxmb as mb
from jaxmb.simulate import arguments


@pytest.fixture(scope="module")
def pendulum():
    rod = mb.planar.Body("rod", mass=1.0, inertia=1 / 12, position=(0.5, 0.0))
    pin = mb.planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0))
    system = mb.Scene([rod], joints=[pin], forces=[mb.Gravity((0.0, -9.81))]).compile()
    return system, mb.assemble(system)


@pytest.mark.parametrize("kept", [pytest.param("dense", marks=pytest.mark.always), "steps"])
def test_a_long_motion_finds_more_room(pendulum, monkeypatch, kept):
    system, state = pendulum
    saveat = diffrax.SaveAt(**{kept: True})
    with monkeypatch.context() as patch:
        patch.setattr(arguments, "_ROOM", 1.0)
        patch.setattr(arguments, "_FEWEST_STEPS", 16)
        found = mb.simulate(system, state, t1=1.0, saveat=saveat)
        steps = int(found.stats["num_steps"])
        assert steps > 16 and found.stats["max_steps"] == 65536 and found.result == mb.RESULTS.successful
        with pytest.raises(RuntimeError, match=f"max_steps = {steps - 1} steps"):
            mb.simulate(system, state, t1=1.0, saveat=saveat, max_steps=steps - 1)
    # A program that is traced cannot be computed again.
    whole = jax.jit(lambda state: mb.simulate(system, state, t1=1.0, saveat=saveat, max_steps=256))(state)
    if kept == "dense":
        np.testing.assert_array_equal(found.at(0.7).q, whole.at(0.7).q)
    else:
        count = found.ts.size
        np.testing.assert_array_equal(found.ys.q, whole.ys.q[:count])
        assert not np.isfinite(whole.ts[count])
