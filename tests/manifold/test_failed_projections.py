"""Steps and states between them that cannot be returned to the constraints."""

import dataclasses
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.bodies.joint_graph import joint_order

pytestmark = pytest.mark.slow

METHOD: dict[str, Any] = {"solver": diffrax.Tsit5(), "manifold": mb.manifold.Projection(), "max_steps": 3000}
FIXED: dict[str, Any] = METHOD | {"stepsize_controller": diffrax.ConstantStepSize()}


@pytest.fixture(scope="module")
def pendulum():
    """A rod that turns at thirty radians a second."""
    rod = planar.Body("rod", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0))
    system = mb.Scene([rod], joints=[pin], forces=[mb.Gravity((0.0, -9.81))]).compile()
    return system, mb.assemble(system, rates={"rod.angle": 30.0})


def by_blocks(system):
    """The system with sparse elimination, also where a dense matrix is faster."""
    return dataclasses.replace(system, elimination=joint_order(system, ()))


@pytest.mark.parametrize("structure", [lambda system: system, by_blocks], ids=["dense", "sparse"])
def test_steps_that_are_too_long_fail(pendulum, structure):
    """Nothing shortens them, and the run ends, of that member of a batch alone."""
    (system, state), options = pendulum, {"t1": 2.0, "saveat": [0.1, 0.8, 2.0], **FIXED}
    run = lambda dt, throw: mb.simulate(structure(system), state, dt0=dt, throw=throw, **options)
    batch = jax.jit(jax.vmap(lambda dt: run(dt, False)))(jnp.array([0.05, 0.4]))
    np.testing.assert_array_equal(batch.result == mb.RESULTS.newton_failed, [False, True])
    assert np.all(np.isfinite(batch.ys.q[0])) and np.all(np.isnan(batch.ys.q[1]))
    residual = jax.vmap(lambda q: system.position_residual(0.0, q))(batch.ys.q[0])
    np.testing.assert_allclose(residual, 0.0, atol=1e-12)
    with pytest.raises(RuntimeError, match="no state on the constraints"):
        run(0.4, True)


def test_derivatives_of_a_run_whose_first_steps_fail(pendulum):
    system, state = pendulum

    def end(x, rtol=1e-7):
        own = mb.with_parameters(system, {"rod.inertia": x[0], "pin.point_a": jnp.stack([0.0 * x[1], x[1]])})
        start = mb.assemble(own, mb.State(state.q, x[2] * state.u))
        motion = mb.simulate(own, start, t1=0.41, dt0=0.4, rtol=rtol, **METHOD | {"max_steps": 1024})
        return motion.ys.q[-1, 2], motion.stats["num_rejected_steps"]

    x, h, value = jnp.array([0.1, 0.0, 1.0]), 1e-5, jax.jit(lambda x: end(x, 1e-10))
    assert value(x)[1] > 0
    forward, reverse = (jax.jit(way(lambda x: end(x)[0]))(x) for way in (jax.jacfwd, jax.grad))
    central = [(value(x + h * e)[0] - value(x - h * e)[0]) / (2 * h) for e in jnp.eye(3)]
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)
    np.testing.assert_allclose(forward, central, rtol=1e-4, atol=1e-5)


def crank_beyond_reach():
    """A driven crank of length 1 and a rod of 0.8: the slider cannot follow beyond 53 degrees."""
    bodies = [
        planar.Body("crank", mass=1.0, inertia=0.1, position=(0.5, 0.0)),
        planar.Body("rod", mass=1.0, inertia=0.1, position=(1.4, 0.0)),
        planar.Body("slider", mass=1.0, inertia=0.1, position=(1.8, 0.0)),
    ]
    joints = [
        planar.Revolute("a", "ground", "crank", point=(0.0, 0.0)),
        planar.Revolute("b", "crank", "rod", point=(1.0, 0.0)),
        planar.Revolute("c", "rod", "slider", point=(1.8, 0.0)),
        planar.Prismatic("guide", "ground", "slider", point=(1.8, 0.0), axis=(1.0, 0.0)),
        planar.Driver("drive", "ground", "crank", quantity="angle", motion=lambda t, p: 2.0 * t),
    ]
    why = r"came to t = 0\.46\d+ of 4\..* that 'drive' prescribes leaves its reach"
    return mb.Scene(bodies, joints=joints).compile(), {}, np.arcsin(0.8) / 2, "singular_configuration", why


def gear_past_its_end():
    """A gear whose ratio is no whole number, which serves half a turn to either side."""
    inertia = np.diag([0.1, 0.1, 0.1])
    bodies = [spatial.Body(name, mass=1.0, inertia=inertia, position=(x, 0.0, 0.0)) for name, x in (("a", 0), ("b", 1))]
    joints = [
        spatial.Revolute("axle a", "ground", "a", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0)),
        spatial.Revolute("axle b", "ground", "b", point=(1.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0)),
        mb.JointCoupling("gear", "axle a.angle", "axle b.angle", coefficients=(0.0, 1.5)),
    ]
    return (
        mb.Scene(bodies, joints=joints).compile(),
        {"axle b.angle": 2.0},
        np.pi / 2,
        "newton_failed",
        r"came to t = 1\.57\d+ of 4\..*largest residuals .* are of gear.*jumps where 'axle b.angle' is half a turn",
    )


@pytest.mark.parametrize("case", [crank_beyond_reach, gear_past_its_end])
def test_a_motion_ends_where_constraints_cannot_be_met(case):
    system, rates, when, result, why = case()
    state = mb.assemble(system, rates=rates)
    kept = mb.simulate(system, state, t1=4.0, saveat=diffrax.SaveAt(steps=True), throw=False, **METHOD)
    assert kept.result == getattr(mb.RESULTS, result)
    assert np.all(kept.constraint_violation.position < 1e-10)
    np.testing.assert_allclose(kept.ts[-1], when, rtol=0, atol=1e-4)
    with pytest.raises(RuntimeError, match=why):
        mb.simulate(system, state, t1=4.0, **METHOD)
    with pytest.raises(RuntimeError, match="no state on the constraints"):
        mb.simulate(system, state, t1=4.0, dt0=0.05, **FIXED)


def test_a_state_that_cannot_be_returned_is_not_a_number(pendulum):
    """Together with its derivatives, beside one that can be."""
    system, state = pendulum

    @jax.jit
    @jax.vmap
    def projected(size):
        found = lambda x: mb.manifold.project(system, 0.0, mb.State(state.q + x, state.u)).q
        return found(size), jax.jacfwd(found)(size), jax.jacrev(found)(size)

    value, *derivatives = projected(jnp.array([1e-3, 30.0]))
    assert np.all(np.isfinite(value[0])) and np.all(np.isnan(value[1]))
    for derivative in derivatives:
        assert np.all(np.isfinite(derivative[0])) and np.all(np.isnan(derivative[1]))


class Losing(mb.manifold.Projection):
    """A projection that finds no state from the middle of a run on, of those that are saved."""

    def correction(self, interpolated):
        return lambda system, t, y: mb.State(jnp.where(t > 0.5, jnp.nan, y.q), y.u)


def test_a_saved_state_that_cannot_be_returned_is_a_failure(pendulum):
    method: Any = METHOD | {"manifold": Losing(), "saveat": [0.3, 1.0], "rtol": 1e-4}
    found = mb.simulate(*pendulum, t1=1.0, throw=False, **method)
    assert found.result == mb.RESULTS.newton_failed
    assert np.all(np.isfinite(found.ys.q[0])) and np.all(np.isnan(found.ys.q[1]))
    with pytest.raises(RuntimeError, match="interpolated"):
        mb.simulate(*pendulum, t1=1.0, **method)
