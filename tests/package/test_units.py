"""Default tolerances do not depend on units: neither on those of length, mass and time, nor on the size of a motion."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar
from jaxmb.lagrangian import LagrangianSystem

pytestmark = pytest.mark.slow

SOLVERS = {"Adams": mb.solvers.Adams(), "Dopri8": diffrax.Dopri8(), "Hermite": mb.solvers.Hermite()}


def swing(metre, kilogram, second, solver):
    """A double pendulum with a spring, in units of which a metre, a kilogram and a second have so many."""
    newton = kilogram * metre / second**2
    rod = lambda name, x: planar.Body(name, mass=kilogram, inertia=0.1 * kilogram * metre**2, position=(x * metre, 0.0))
    pin = lambda name, a, b, at: planar.Revolute(name, a, b, point=(at * metre, 0.0))
    spring = planar.SpringDamper(
        "spring",
        "ground",
        "lower",
        stiffness=50.0 * newton / metre,
        damping=0.3 * newton * second / metre,
        free_length=0.5 * metre,
        point_a=(1.0 * metre, 1.0 * metre),
        point_b=(0.1 * metre, 0.0),
    )
    scene = mb.Scene(
        [rod("upper", 0.5), rod("lower", 1.5)],
        joints=[pin("A", "ground", "upper", 0.0), pin("B", "upper", "lower", 1.0)],
        forces=[mb.Gravity((0.0, -9.81 * metre / second**2)), spring],
    )
    system = scene.compile()
    sol = mb.simulate(system, mb.assemble(system), t1=1.5 * second, rtol=1e-7, solver=SOLVERS[solver])
    return sol["lower"].position[-1] / metre, int(sol.stats["num_steps"]), sol.constraint_violation.position[-1]


@pytest.mark.parametrize("solver", ["Adams", "Hermite"])
def test_a_machine_in_other_units(solver):
    place, steps, _ = swing(1.0, 1.0, 1.0, solver)
    # In micrometres, nanograms and microseconds.
    other, count, violation = swing(1e6, 1e12, 1e6, solver)
    assert abs(count - steps) <= 0.02 * steps
    np.testing.assert_allclose(other, place, rtol=1e-6)
    assert violation < 1e-9


@pytest.mark.parametrize("solver", ["Adams", "Dopri8"])
def test_small_and_slow_oscillations(solver):
    """Of a metre, a micrometre and a nanometre, and with a period of a million seconds."""

    def run(amplitude, rate, turns):
        system = LagrangianSystem(
            kinetic=lambda t, q, v, p: 0.5 * v[0] ** 2,
            potential=lambda t, q, p: 0.5 * (p["rate"] * q[0]) ** 2,
            q=(amplitude,),
            parameters={"rate": rate},
        )
        state = mb.State(jnp.array([amplitude]), jnp.zeros(1))
        sol = mb.simulate(system, state, t1=turns / rate, rtol=1e-5, solver=SOLVERS[solver])
        return abs(float(sol.ys.q[-1, 0]) / amplitude - np.cos(turns)), int(sol.stats["num_steps"])

    error, steps = run(1.0, 10.0, 30.0)
    assert error < 2e-4
    for amplitude, rate in ((1e-6, 10.0), (1e-9, 10.0), (1.0, 2e-6 * np.pi)):
        other, count = run(amplitude, rate, 30.0)
        assert abs(count - steps) <= max(0.02 * steps, 1) and other < 2e-4
